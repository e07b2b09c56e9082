//! Compiled kernels and what they are bound to.

use wgpu::{
    BindGroup, BindGroupLayout, BindGroupLayoutEntry, BindingType, Buffer, BufferBindingType,
    ComputePipeline, ShaderStages,
};

use super::device::Gpu;
use super::mirror::Mirror;
use super::shader::{Dialect, Pages};
use crate::Result;

/// The kernels for one way of cutting the arena into pages.
#[derive(Debug)]
pub struct Kernels {
    /// New rays.
    pub(super) trace: ComputePipeline,
    /// Rays that go on.
    pub(super) resume: ComputePipeline,
    /// Projection to spherical harmonics.
    pub(super) project: ComputePipeline,
    arena: BindGroupLayout,
    batch: BindGroupLayout,
}

/// Whether a kernel writes each of a batch's buffers, by binding; the first one holds the batch's numbers.
const WRITTEN: [bool; 9] = [false, false, false, false, false, true, false, true, true];

impl Kernels {
    /// Compiles them.
    ///
    /// # Errors
    /// [`ErrorKind::Device`](crate::ErrorKind::Device) when the driver refuses.
    pub fn new(gpu: &Gpu, pages: Pages) -> Result<Self> {
        let entry = |binding: u32, ty: BufferBindingType| BindGroupLayoutEntry {
            binding,
            visibility: ShaderStages::COMPUTE,
            ty: BindingType::Buffer { ty, has_dynamic_offset: false, min_binding_size: None },
            count: None,
        };
        let storage = |read_only: bool| BufferBindingType::Storage { read_only };
        let layout = |label: &str, entries: &[BindGroupLayoutEntry]| {
            let descriptor = wgpu::BindGroupLayoutDescriptor { label: Some(label), entries };
            gpu.guarded("refuses a layout", |device| device.create_bind_group_layout(&descriptor))
        };
        let pages_entries: Vec<_> = (0..pages.count).map(|page| entry(page, storage(true))).collect();
        let mut batch_entries = vec![entry(0, BufferBindingType::Uniform)];
        batch_entries.extend((1_u32..).zip(&WRITTEN[1..]).map(|(i, &written)| entry(i, storage(!written))));
        let (arena, batch) = (layout("arena", &pages_entries)?, layout("batch", &batch_entries)?);
        let plain = Dialect { wide: false, ..gpu.dialect };
        let pipeline = |source: String, entry: &str| {
            gpu.guarded(&format!("refuses the kernel `{entry}`"), |device| {
                let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
                    label: Some(entry),
                    source: wgpu::ShaderSource::Wgsl(source.into()),
                });
                let layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
                    label: Some(entry),
                    bind_group_layouts: &[Some(&arena), Some(&batch)],
                    immediate_size: 0,
                });
                device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                    label: Some(entry),
                    layout: Some(&layout),
                    module: &module,
                    entry_point: Some(entry),
                    compilation_options: wgpu::PipelineCompilationOptions::default(),
                    cache: None,
                })
            })
        };
        Ok(Self {
            trace: pipeline(gpu.dialect.kernel(pages), "trace")?,
            resume: pipeline(plain.kernel(pages), "resume")?,
            project: pipeline(gpu.dialect.projection(), "project")?,
            arena,
            batch,
        })
    }

    /// The arena's pages as a group.
    ///
    /// # Errors
    /// [`ErrorKind::Device`](crate::ErrorKind::Device) when the driver refuses.
    pub(super) fn bind_arena(&self, gpu: &Gpu, mirror: &Mirror) -> Result<BindGroup> {
        self.bind(gpu, "arena", &self.arena, &mirror.buffers.iter().collect::<Vec<_>>())
    }

    /// A batch's buffers as a group.
    ///
    /// # Errors
    /// [`ErrorKind::Device`](crate::ErrorKind::Device) when the driver refuses.
    pub(super) fn bind_batch(&self, gpu: &Gpu, buffers: &[&Buffer; WRITTEN.len()]) -> Result<BindGroup> {
        self.bind(gpu, "batch", &self.batch, buffers)
    }

    fn bind(
        &self,
        gpu: &Gpu,
        label: &str,
        layout: &BindGroupLayout,
        buffers: &[&Buffer],
    ) -> Result<BindGroup> {
        let entries: Vec<_> = (0..)
            .zip(buffers)
            .map(|(binding, buffer)| wgpu::BindGroupEntry { binding, resource: buffer.as_entire_binding() })
            .collect();
        let descriptor = wgpu::BindGroupDescriptor { label: Some(label), layout, entries: &entries };
        gpu.guarded("refuses its bindings", |device| device.create_bind_group(&descriptor))
    }
}
