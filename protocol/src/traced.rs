//! What tracing took: numbers that workers report for each batch, and that add up.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::limits;

/// What tracing took, in numbers that add up over batches, workers and passes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Traced {
    /// Batches.
    #[serde(default)]
    pub batches: i64,
    /// Points of them.
    #[serde(default)]
    pub points: i64,
    /// Rays.
    #[serde(default)]
    pub rays: i64,
    /// Microseconds of selecting, loading, tracing and projecting.
    #[serde(default)]
    pub trace_us: i64,
    /// Bricks that were asked of the arena.
    #[serde(default)]
    pub brick_requests: i64,
    /// Those of them that had to be loaded.
    #[serde(default)]
    pub brick_misses: i64,
    /// Bytes that went from storage or disk to the arena.
    #[serde(default)]
    pub read_bytes: i64,
    /// Bytes that went to devices.
    #[serde(default)]
    pub device_bytes: i64,
    /// Microseconds that the busiest device was at work.
    #[serde(default)]
    pub device_us: i64,
}

impl Traced {
    /// The numbers, in the order of the fields.
    pub fn to_array(self) -> [i64; 9] {
        let Self { batches, points, rays, trace_us, .. } = self;
        let Self { brick_requests, brick_misses, read_bytes, device_bytes, device_us, .. } = self;
        [batches, points, rays, trace_us, brick_requests, brick_misses, read_bytes, device_bytes, device_us]
    }

    /// From numbers in the order of the fields.
    pub fn from_array(numbers: [i64; 9]) -> Self {
        let [batches, points, rays, trace_us, rest @ ..] = numbers;
        let [brick_requests, brick_misses, read_bytes, device_bytes, device_us] = rest;
        Self {
            batches,
            points,
            rays,
            trace_us,
            brick_requests,
            brick_misses,
            read_bytes,
            device_bytes,
            device_us,
        }
    }

    /// Adds what one batch took; numbers that no batch can have count as the nearest that it could.
    pub fn add_batch(&mut self, batch: Self) {
        let (sum, batch) = (self.to_array(), batch.to_array());
        let add = |at: usize| sum[at].saturating_add(batch[at].clamp(0, limits::TRACED_MAX));
        *self = Self::from_array(std::array::from_fn(add));
    }
}

/// What a worker's batches of a pass took.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct PassWork {
    /// The pass.
    pub pass: i64,
    /// The bake set that it is about.
    pub name: String,
    /// The worker.
    pub worker: String,
    /// What traced last: `cpu`, or the names of adapters.
    pub device: String,
    /// The sums.
    pub traced: Traced,
    /// Milliseconds since 1970 when it last reported.
    pub at: i64,
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a field that is left out of the sums or mixed up with another, and a lie that spoils them.
    #[test]
    fn sums_are_of_each_field() {
        let numbers: [i64; 9] = std::array::from_fn(|at| 10 * at as i64 + 1);
        let one = Traced::from_array(numbers);
        assert_eq!(one.to_array(), numbers);
        assert_eq!((one.batches, one.brick_misses, one.device_us), (1, 51, 81));
        let mut sum = Traced::default();
        sum.add_batch(one);
        sum.add_batch(one);
        sum.add_batch(Traced { rays: i64::MAX, read_bytes: -5, ..Traced::default() });
        assert_eq!((sum.batches, sum.device_us), (2, 162));
        assert_eq!((sum.rays, sum.read_bytes), (2 * numbers[2] + limits::TRACED_MAX, 2 * numbers[6]));
    }
}
