//! What tracing took, added up over batches and bake sets.

use super::BakeOptions;
use crate::stats::BakeReport;
use crate::trace::{Backend, BatchCounts};

/// What all bake sets together took.
#[derive(Debug, Default)]
pub struct BakeWork {
    /// Batches traced.
    pub batches: u64,
    /// Rays traced.
    pub rays: u64,
    /// Seconds of selecting, loading, tracing and projecting.
    pub seconds: f64,
    counts: BatchCounts,
    requests: u64,
    misses: u64,
    read_bytes: u64,
    /// Batches and shaders that devices traced; the CPU traced the others.
    device_batches: u64,
    cpu_batches: u64,
    device: String,
    reason: String,
    troubles: Vec<String>,
}

impl BakeWork {
    pub(super) fn add(&mut self, counts: &BatchCounts) {
        self.rays += counts.rays;
        self.counts.walk += counts.walk;
        self.counts.cut_bytes += counts.cut_bytes;
        self.counts.select_seconds += counts.select_seconds;
        self.counts.device_bytes += counts.device_bytes;
        self.counts.device_seconds += counts.device_seconds;
        *(if counts.is_device { &mut self.device_batches } else { &mut self.cpu_batches }) += 1;
    }

    /// Bytes that went to devices.
    pub fn device_bytes(&self) -> u64 {
        self.counts.device_bytes
    }

    /// Seconds that the busiest device was at work.
    pub fn device_seconds(&self) -> f64 {
        self.counts.device_seconds
    }

    /// What went wrong with devices.
    pub fn troubles(&self) -> &[String] {
        &self.troubles
    }

    pub(super) fn add_backend(&mut self, backend: &Backend) {
        let counts = backend.arena_counts();
        self.requests += counts.requests;
        self.misses += counts.misses;
        self.read_bytes += counts.read_bytes;
        (self.device, self.reason) = (backend.name.clone(), backend.reason.clone());
        for trouble in backend.troubles() {
            if !self.troubles.contains(trouble) {
                self.troubles.push(trouble.clone());
            }
        }
    }

    /// The tracing part of a report.
    pub fn report(&self, options: &BakeOptions) -> BakeReport {
        let ratio = |a: u64, b: u64| a as f64 / b.max(1) as f64;
        let walk = &self.counts.walk;
        BakeReport {
            rays: self.rays,
            batches: self.batches,
            seconds: self.seconds,
            rays_per_second: self.rays as f64 / self.seconds.max(1e-9),
            device: if self.device.is_empty() { "cpu".into() } else { self.device.clone() },
            device_reason: self.reason.clone(),
            device_batches: self.device_batches,
            cpu_batches: self.cpu_batches,
            device_bytes_per_ray: ratio(self.counts.device_bytes, self.rays),
            device_busy_ratio: self.counts.device_seconds / self.seconds.max(1e-9),
            instructions: options.instructions.name().into(),
            threads: options.threads as u64,
            lod: options.lod.to_string(),
            io_bytes_per_ray: ratio(self.read_bytes, self.rays),
            io_bytes_per_batch: ratio(self.read_bytes, self.batches),
            cache_hit_ratio: 1.0 - ratio(self.misses, self.requests),
            double_precision_ratio: ratio(walk.retests, walk.hits),
            nodes_per_ray: ratio(walk.nodes, self.rays),
            rays_per_node_visit: ratio(walk.node_rays, walk.nodes),
            leaves_per_ray: ratio(walk.leaves, self.rays),
            cut_bytes_per_batch: ratio(self.counts.cut_bytes, self.batches),
            select_seconds: self.counts.select_seconds,
            ..BakeReport::default()
        }
    }
}
