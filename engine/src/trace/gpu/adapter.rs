//! Adapters: what this machine has, what each can do, and which one traces.

use wgpu::{Backends, DeviceType, Features, Limits};

use crate::trace::Device;
use crate::{Error, ErrorKind, Result};

/// Storage buffers of the kernels beside the arena's pages.
pub const BUFFERS_BESIDE_PAGES: u32 = 8;
/// Bytes of an arena page at most, whatever the adapter allows.
pub const PAGE_BYTES_MAX: u64 = 1 << 30;
/// Arena pages at most.
pub const PAGES_MAX: u32 = 8;
/// Bytes that a page must be able to have.
const PAGE_BYTES_MIN: u64 = 64 << 20;

/// What sort of adapter it is, the best last.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum AdapterKind {
    /// Runs on the CPU.
    Software,
    /// Unknown to the driver.
    Other,
    /// A share of a card.
    Virtual,
    /// Part of the processor.
    Integrated,
    /// A card of its own.
    Discrete,
}

impl AdapterKind {
    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Software => "software",
            Self::Other => "other",
            Self::Virtual => "virtual",
            Self::Integrated => "integrated",
            Self::Discrete => "discrete",
        }
    }
}

/// An adapter that the Vulkan loader has found.
#[derive(Clone, Debug)]
pub struct Adapter {
    /// Its name.
    pub name: String,
    /// Driver and version.
    pub driver: String,
    /// What sort it is.
    pub kind: AdapterKind,
    /// Lanes of a subgroup, smallest and largest; none without subgroup operations.
    pub subgroup: Option<[u32; 2]>,
    /// Whether it calculates in double precision.
    pub has_double: bool,
    /// Bytes that a kernel can bind at once.
    pub binding_bytes: u64,
    /// Bytes of a buffer at most.
    pub buffer_bytes: u64,
    /// Buffers that a kernel can bind.
    pub buffers: u32,
    /// Why it cannot trace, if it cannot.
    pub problem: Option<String>,
    pub(super) inner: wgpu::Adapter,
}

impl Adapter {
    fn new(inner: wgpu::Adapter) -> Self {
        let (info, features, limits) = (inner.get_info(), inner.features(), inner.limits());
        let kind = match info.device_type {
            DeviceType::Cpu => AdapterKind::Software,
            DeviceType::DiscreteGpu => AdapterKind::Discrete,
            DeviceType::IntegratedGpu => AdapterKind::Integrated,
            DeviceType::VirtualGpu => AdapterKind::Virtual,
            DeviceType::Other => AdapterKind::Other,
        };
        let subgroups = features.contains(Features::SUBGROUP);
        Self {
            name: info.name,
            driver: format!("{} {}", info.driver, info.driver_info).trim().to_string(),
            kind,
            subgroup: subgroups.then_some([info.subgroup_min_size, info.subgroup_max_size]),
            has_double: features.contains(Features::SHADER_F64),
            binding_bytes: limits.max_storage_buffer_binding_size,
            buffer_bytes: limits.max_buffer_size,
            buffers: limits.max_storage_buffers_per_shader_stage,
            problem: problem(&limits),
            inner,
        }
    }

    /// Bytes of an arena page, a power of two.
    pub fn page_bytes(&self) -> u64 {
        let most = self.binding_bytes.min(self.buffer_bytes).min(PAGE_BYTES_MAX);
        1 << most.max(1).ilog2()
    }

    /// Pages that an arena can have.
    pub fn pages_max(&self) -> u32 {
        self.buffers.saturating_sub(BUFFERS_BESIDE_PAGES).clamp(1, PAGES_MAX)
    }

    /// The name with the sort, for reports.
    pub fn title(&self) -> String {
        format!("{} ({}, {})", self.name, self.kind.name(), self.driver)
    }
}

/// Which limit is too small, if one is.
fn problem(limits: &Limits) -> Option<String> {
    let small = |what: &str, has: u64, wants: u64| {
        (has < wants).then(|| format!("its limit of {what} is {has}, {wants} are needed"))
    };
    small(
        "storage buffers per kernel",
        limits.max_storage_buffers_per_shader_stage.into(),
        u64::from(BUFFERS_BESIDE_PAGES) + 1,
    )
    .or_else(|| small("bytes of a binding", limits.max_storage_buffer_binding_size, PAGE_BYTES_MIN))
    .or_else(|| small("bytes of a buffer", limits.max_buffer_size, PAGE_BYTES_MIN))
    .or_else(|| {
        small("bytes shared by a workgroup", limits.max_compute_workgroup_storage_size.into(), 12 << 10)
    })
    .or_else(|| small("lanes of a workgroup", limits.max_compute_invocations_per_workgroup.into(), 64))
    .or_else(|| small("workgroups of a dispatch", limits.max_compute_workgroups_per_dimension.into(), 65_535))
}

/// All adapters, real ones first, the best of them first; their numbers are what `gpu:N` means. Empty where there is no
/// Vulkan loader.
pub fn adapters() -> Vec<Adapter> {
    let mut descriptor = wgpu::InstanceDescriptor::new_without_display_handle();
    descriptor.backends = Backends::VULKAN;
    descriptor.flags = wgpu::InstanceFlags::empty();
    let instance = wgpu::Instance::new(descriptor);
    let found = super::ready(instance.enumerate_adapters(Backends::VULKAN)).unwrap_or_default();
    let mut adapters: Vec<Adapter> = found.into_iter().map(Adapter::new).collect();
    adapters.sort_by_key(|adapter| {
        std::cmp::Reverse((adapter.kind, adapter.problem.is_none(), adapter.buffer_bytes))
    });
    adapters
}

/// What is to trace, and why.
#[derive(Clone, Debug)]
pub struct Choice {
    /// The adapters; without any the CPU traces.
    pub adapters: Vec<Adapter>,
    /// One sentence on what was chosen and why.
    pub reason: String,
}

/// Finds what `device` means on this machine.
///
/// # Errors
/// [`ErrorKind::NotFound`] when a GPU is asked for by name and there is none, [`ErrorKind::Unsupported`] when it cannot trace.
pub fn choose(device: Device) -> Result<Choice> {
    match device {
        Device::Cpu => Ok(cpu("the CPU was asked for")),
        _ => choose_of(device, adapters()),
    }
}

fn cpu(reason: &str) -> Choice {
    Choice { adapters: Vec::new(), reason: reason.into() }
}

/// [`choose`] among given adapters.
fn choose_of(device: Device, all: Vec<Adapter>) -> Result<Choice> {
    let nothing =
        if all.is_empty() { "no Vulkan driver was found" } else { "only software adapters were found" };
    let of_kind = |software: bool| -> Vec<Adapter> {
        all.iter().filter(|a| (a.kind == AdapterKind::Software) == software).cloned().collect()
    };
    let real = of_kind(false);
    let able: Vec<Adapter> = real.iter().filter(|a| a.problem.is_none()).cloned().collect();
    let first_problem =
        real.iter().find_map(|a| Some(format!("`{}` cannot trace: {}", a.name, a.problem.as_ref()?)));
    let none = first_problem.clone().unwrap_or_else(|| nothing.into());
    let one = |adapter: Adapter, why: &str| Choice {
        reason: format!("{}: {why}", adapter.title()),
        adapters: vec![adapter],
    };
    match device {
        Device::Cpu => Ok(cpu("the CPU was asked for")),
        Device::Auto => Ok(match able.into_iter().next() {
            Some(adapter) => one(adapter, "the best adapter that is no software"),
            None => cpu(&format!("the CPU traces, since {none}")),
        }),
        Device::Gpu(None) => match able.into_iter().next() {
            Some(adapter) => Ok(one(adapter, "the best adapter that is no software")),
            None => Err(missing(&none, first_problem.is_some())),
        },
        Device::Gpu(Some(number)) => match real.into_iter().nth(usize::from(number)) {
            Some(adapter) if adapter.problem.is_none() => Ok(one(adapter, "asked for by number")),
            Some(_) => Err(missing(&none, true)),
            None => Err(missing(&format!("there is no GPU of number `{number}`: {nothing}"), false)),
        },
        Device::Software => match of_kind(true).into_iter().next() {
            Some(Adapter { problem: Some(problem), name, .. }) => {
                Err(missing(&format!("`{name}` cannot trace: {problem}"), true))
            }
            Some(adapter) => Ok(one(adapter, "a software adapter was asked for")),
            None => Err(missing("no software adapter was found", false)
                .hint("install one, for example Debian's mesa-vulkan-drivers and libvulkan1")),
        },
        Device::All if able.is_empty() => Err(missing(&none, first_problem.is_some())),
        Device::All => {
            Ok(Choice { reason: format!("all {} GPUs were asked for", able.len()), adapters: able })
        }
    }
}

fn missing(why: &str, is_unable: bool) -> Error {
    let kind = if is_unable { ErrorKind::Unsupported } else { ErrorKind::NotFound };
    Error::new(kind, format!("no GPU can trace: {why}"))
        .hint("`pantaray devices` lists what there is; `--device cpu` needs none")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a software adapter that `auto` or `gpu` takes, and a machine without GPUs that is an error for `auto`.
    #[test]
    fn software_is_used_when_named_alone() {
        let software: Vec<Adapter> =
            adapters().into_iter().filter(|a| a.kind == AdapterKind::Software).collect();
        for list in [software.clone(), Vec::new()] {
            let auto = choose_of(Device::Auto, list.clone()).unwrap();
            assert!(auto.adapters.is_empty(), "{}", auto.reason);
            for device in [Device::Gpu(None), Device::Gpu(Some(0)), Device::All] {
                assert_eq!(choose_of(device, list.clone()).unwrap_err().kind(), ErrorKind::NotFound);
            }
            assert_eq!(choose_of(Device::Software, list.clone()).is_ok(), !list.is_empty());
        }
    }

    /// Catches an adapter of too small limits that is used all the same, or refused without saying why.
    #[test]
    fn too_small_limits_are_named() {
        assert_eq!(problem(&Limits { max_storage_buffers_per_shader_stage: 64, ..Limits::default() }), None);
        let small = Limits { max_storage_buffers_per_shader_stage: 4, ..Limits::default() };
        assert!(problem(&small).unwrap().contains("storage buffers per kernel is 4"));
    }
}
