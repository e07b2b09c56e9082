//! An opened adapter: its queue, its errors as values, and whether it is still there.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use wgpu::{Buffer, BufferDescriptor, BufferUsages, ErrorFilter, Features, PollType};

use super::adapter::Adapter;
use super::{ready, shader::Dialect};
use crate::{Error, ErrorKind, Result};

/// How long a dispatch may take before the device counts as lost. Dispatches are sized to take a tenth of a second.
const PATIENCE: Duration = Duration::from_secs(30);

/// An opened adapter.
#[derive(Debug)]
pub struct Gpu {
    /// What was opened.
    pub adapter: Adapter,
    /// What its shaders may use.
    pub dialect: Dialect,
    pub(super) device: wgpu::Device,
    pub(super) queue: wgpu::Queue,
    lost: Arc<AtomicBool>,
}

impl Gpu {
    /// Opens an adapter. `wide` lets kernels use subgroup operations if the adapter has them.
    ///
    /// # Errors
    /// [`ErrorKind::Device`] when the driver refuses.
    pub fn open(adapter: &Adapter, wide: bool) -> Result<Self> {
        let dialect = Dialect {
            wide: wide && adapter.subgroup.is_some_and(|[_, largest]| largest <= 64),
            has_double: adapter.has_double,
            is_exact: adapter.has_double && adapter.kind == super::AdapterKind::Software,
        };
        let mut features = Features::empty();
        features.set(Features::SUBGROUP, dialect.wide);
        features.set(Features::SHADER_F64, dialect.has_double);
        let descriptor = wgpu::DeviceDescriptor {
            label: Some("pantaray"),
            required_features: features,
            required_limits: adapter.inner.limits(),
            ..Default::default()
        };
        let opened = ready(adapter.inner.request_device(&descriptor))
            .unwrap_or_else(|| unreachable!("native requests are answered at once"));
        let (device, queue) =
            opened.map_err(|error| fault(&adapter.name, "cannot be opened").caused_by(error))?;
        let lost = Arc::new(AtomicBool::new(false));
        let flag = lost.clone();
        device.set_device_lost_callback(move |reason, message| {
            if reason != wgpu::DeviceLostReason::Destroyed {
                tracing::warn!("the device was lost: {message}");
            }
            flag.store(true, Ordering::Relaxed);
        });
        let flag = lost.clone();
        // Whatever no scope has caught makes results doubtful: the device is given up
        device.on_uncaptured_error(Arc::new(move |error| {
            tracing::warn!("the device reports: {error}");
            flag.store(true, Ordering::Relaxed);
        }));
        Ok(Self { adapter: adapter.clone(), dialect, device, queue, lost })
    }

    /// Whether it is gone.
    pub fn is_lost(&self) -> bool {
        self.lost.load(Ordering::Relaxed)
    }

    /// Ends the device, as a driver's reset would. For tests.
    pub fn destroy(&self) {
        self.device.destroy();
        self.lost.store(true, Ordering::Relaxed);
    }

    /// Does something that the driver may refuse.
    ///
    /// # Errors
    /// [`ErrorKind::Device`] when it does.
    pub(super) fn guarded<T>(&self, what: &str, work: impl FnOnce(&wgpu::Device) -> T) -> Result<T> {
        let scopes = [ErrorFilter::Validation, ErrorFilter::OutOfMemory, ErrorFilter::Internal]
            .map(|filter| self.device.push_error_scope(filter));
        let result = work(&self.device);
        let mut errors =
            scopes.into_iter().rev().filter_map(|scope| ready(scope.pop()).flatten()).collect::<Vec<_>>();
        match errors.pop() {
            None if self.is_lost() => Err(self.gone()),
            None => Ok(result),
            Some(error) => Err(fault(&self.adapter.name, what).caused_by(error)),
        }
    }

    /// A buffer of `bytes`, at least 16, a multiple of 16, zeroed.
    ///
    /// # Errors
    /// [`ErrorKind::Device`] when there is no memory for it.
    pub(super) fn buffer(&self, label: &str, bytes: u64, usage: BufferUsages) -> Result<Buffer> {
        let descriptor = BufferDescriptor {
            label: Some(label),
            size: bytes.max(16).next_multiple_of(16),
            usage: usage | BufferUsages::COPY_DST | BufferUsages::COPY_SRC,
            mapped_at_creation: false,
        };
        self.guarded("has no memory", |device| device.create_buffer(&descriptor))
    }

    /// A buffer that results are read from.
    ///
    /// # Errors
    /// [`ErrorKind::Device`] when there is no memory for it.
    pub(super) fn readback(&self, bytes: u64) -> Result<Buffer> {
        let descriptor = BufferDescriptor {
            label: Some("readback"),
            size: bytes.max(16).next_multiple_of(16),
            usage: BufferUsages::COPY_DST | BufferUsages::MAP_READ,
            mapped_at_creation: false,
        };
        self.guarded("has no memory", |device| device.create_buffer(&descriptor))
    }

    /// Waits until everything that was submitted is done.
    ///
    /// # Errors
    /// [`ErrorKind::Device`] when the device is lost meanwhile.
    pub fn wait(&self) -> Result<()> {
        let waited = self.device.poll(PollType::Wait { submission_index: None, timeout: Some(PATIENCE) });
        match waited {
            Ok(_) if !self.is_lost() => Ok(()),
            Ok(_) => Err(self.gone()),
            Err(error) => {
                self.lost.store(true, Ordering::Relaxed);
                Err(self.gone().caused_by(error))
            }
        }
    }

    /// Reads the first `bytes` of a readback buffer, once all work is done.
    ///
    /// # Errors
    /// [`ErrorKind::Device`] when the device is lost meanwhile.
    pub(super) fn read(&self, buffer: &Buffer, bytes: u64) -> Result<Vec<u32>> {
        let slice = buffer.slice(..bytes.next_multiple_of(8));
        slice.map_async(wgpu::MapMode::Read, |_| {});
        self.wait()?;
        let view = slice.get_mapped_range().map_err(|error| self.gone().caused_by(error))?;
        let words = bytemuck::pod_collect_to_vec(&view[..bytes as usize]);
        drop(view);
        buffer.unmap();
        Ok(words)
    }

    fn gone(&self) -> Error {
        fault(&self.adapter.name, "was lost")
    }
}

/// An error of a device.
pub(super) fn fault(name: &str, what: &str) -> Error {
    Error::new(ErrorKind::Device, format!("the device `{name}` {what}"))
        .hint("`--device cpu` needs no device; an update of the driver may help")
}
