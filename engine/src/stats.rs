//! What a bake reports: `report.json`.

use serde::{Deserialize, Serialize};

/// The report of a bake, as `report.json` has it. Bytes per ray of I/O go from storage to the arena.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// Occluding micropolygons, instances expanded.
    pub micropolygons: u64,
    /// Occluding microgrids, instances expanded.
    pub grids: u64,
    /// The brick map; sums and the slowest rate where bake sets see different occluders.
    pub brickmap: BrickMapReport,
    /// The bake sets together.
    pub bake: BakeReport,
    /// Each bake set.
    pub bake_sets: Vec<BakeSetReport>,
    /// What was left out of the occluders, and how often.
    pub skipped: Vec<(String, u64)>,
    /// What was understood differently from what an input may have meant.
    pub warnings: Vec<String>,
    /// Peak resident memory of the process in bytes, as the operating system counts it.
    pub peak_rss_bytes: u64,
    /// Seconds of the whole bake.
    pub seconds: f64,
}

/// The brick map's part of a report.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct BrickMapReport {
    /// Bricks.
    pub bricks: u64,
    /// Bytes on disk.
    pub bytes: u64,
    /// Bytes on disk per micropolygon.
    pub bytes_per_micropolygon: f64,
    /// Seconds of building, 0 if reused.
    pub seconds: f64,
    /// Micropolygons per second of building.
    pub micropolygons_per_second: f64,
    /// Whether it was there already.
    pub reused: bool,
    /// Seconds of the pass that counts, of the one that fills, and of building the partitions.
    pub phase_seconds: [f64; 3],
    /// Partitions that were built each on its own.
    pub partitions: u64,
    /// Those of them that an interrupted build had left.
    pub partitions_continued: u64,
    /// Bytes of temporary data.
    pub scratch_bytes: u64,
}

/// The tracing part of a report.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct BakeReport {
    /// Points baked.
    pub points: u64,
    /// Rays traced.
    pub rays: u64,
    /// Batches traced.
    pub batches: u64,
    /// Seconds of selecting, loading, tracing and projecting.
    pub seconds: f64,
    /// Rays per second.
    pub rays_per_second: f64,
    /// What traced.
    pub device: String,
    /// Why it was this.
    pub device_reason: String,
    /// Batches that devices traced, once a shader.
    pub device_batches: u64,
    /// Batches that the CPU traced, once a shader: all without a device, those that a device failed at with one.
    pub cpu_batches: u64,
    /// Share of the seconds that the busiest device was at work.
    pub device_busy_ratio: f64,
    /// The instruction set of the inner loops.
    pub instructions: String,
    /// Worker threads.
    pub threads: u64,
    /// The level of detail.
    pub lod: String,
    /// Bytes read from storage per ray.
    pub io_bytes_per_ray: f64,
    /// Bytes read from storage per batch.
    pub io_bytes_per_batch: f64,
    /// Bytes sent to a GPU per ray.
    pub device_bytes_per_ray: f64,
    /// Share of brick requests that were answered from the arena.
    pub cache_hit_ratio: f64,
    /// Share of hits that were tested again in double precision.
    pub double_precision_ratio: f64,
    /// Nodes visited per ray.
    pub nodes_per_ray: f64,
    /// Rays tested at a node on average.
    pub rays_per_node_visit: f64,
    /// Leaves visited per ray.
    pub leaves_per_ray: f64,
    /// Bytes of a batch's cut on average.
    pub cut_bytes_per_batch: f64,
    /// Seconds of selecting and loading cuts.
    pub select_seconds: f64,
}

/// A bake set's part of a report.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct BakeSetReport {
    /// Its name.
    pub name: String,
    /// Points that were baked.
    pub points: u64,
    /// Points of the stream.
    pub stream_points: u64,
    /// Batches traced now.
    pub batches: u64,
    /// Batches that an earlier, interrupted bake had traced.
    pub batches_continued: u64,
    /// Seconds of splitting into batches.
    pub split_seconds: f64,
    /// Seconds of merging.
    pub merge_seconds: f64,
}

/// Peak resident memory of this process in bytes; 0 where the operating system does not say.
pub fn peak_rss_bytes() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    let kibibytes = line.and_then(|line| line.trim().trim_end_matches("kB").trim().parse::<u64>().ok());
    kibibytes.unwrap_or(0) * 1024
}
