//! A batch's points, groups and tables as the kernels read them.

use std::ops::Range;

use glam::Vec3;

use super::records::{BatchRecord, GroupRecord, PointRecord};
use crate::batch::Point;
use crate::shade::sample::{Sampler, Spread, frame_factor};
use crate::trace::setup::{Setup, Shading};

/// Lanes of a workgroup.
pub const LANES: u32 = 64;

/// The records of some pieces of a batch.
#[derive(Debug, Default)]
pub struct PointRecords {
    /// A record a point, in order.
    pub points: Vec<PointRecord>,
    /// A record for the points that decide together.
    pub groups: Vec<GroupRecord>,
}

impl PointRecords {
    /// The records of `pieces`, whole points.
    pub(super) fn new(points: &[Point], shading: &Shading, setup: &Setup, pieces: Range<usize>) -> Self {
        let mut records = Self::default();
        for piece in &setup.pieces[pieces] {
            // A point of very many samples has several pieces with the same origin
            if piece.samples.start > 0 {
                continue;
            }
            let reference = setup.origins[piece.points.start];
            let relative = || piece.points.clone().map(|point| (setup.origins[point] - reference).as_vec3());
            let group = records.groups.len() as u32;
            records.groups.push(GroupRecord {
                reference: reference.to_array(),
                lower: relative().fold(Vec3::ZERO, Vec3::min).to_array(),
                upper: relative().fold(Vec3::ZERO, Vec3::max).to_array(),
                ..GroupRecord::default()
            });
            records.points.extend(piece.points.clone().map(|point| {
                let (normal, spread) = shading.spread(points[point].normal);
                let rotation = shading.sampler.rotation(points[point].index);
                PointRecord {
                    origin: setup.origins[point].to_array(),
                    group,
                    normal: normal.to_array(),
                    hash: rotation.hash,
                    cosine: rotation.cos,
                    sine: rotation.sin,
                    frame: frame_factor(normal),
                    spread: match spread {
                        Spread::Hemisphere => 0,
                        Spread::CosineHemisphere => 1,
                        Spread::Sphere => 2,
                    },
                }
            }));
        }
        records
    }
}

/// The numbers of a batch of `points` points; dispatches set `first` and `items`.
pub(super) fn batch_record(shading: &Shading, setup: &Setup, root: u32, points: u32) -> BatchRecord {
    let samples = shading.shader.samples;
    let is_limited = setup.reach.is_finite();
    BatchRecord {
        open2: setup.open2,
        reach: if is_limited { setup.reach } else { f32::MAX },
        reach2: if is_limited { setup.reach * setup.reach } else { f32::MAX },
        near: setup.near,
        step: 1.0 / samples as f32,
        measure_hemisphere: Spread::Hemisphere.measure(samples),
        measure_cosine: Spread::CosineHemisphere.measure(samples),
        measure_sphere: Spread::Sphere.measure(samples),
        is_limited: is_limited.into(),
        samples,
        slices: samples.div_ceil(LANES),
        points,
        bands: shading.shader.bands,
        root,
        ..BatchRecord::default()
    }
}

/// What depends on the number of samples alone: angles, order, limits, transmittances. Without `is_coherent` the order is
/// the samples' own.
pub fn tables(sampler: &Sampler, is_coherent: bool) -> Vec<u32> {
    let mut words: Vec<u32> = bytemuck::cast_slice(sampler.turns()).to_vec();
    if is_coherent {
        words.extend(coherent_order(sampler));
    } else {
        words.extend(0..sampler.samples());
    }
    words.extend_from_slice(sampler.limits());
    words.extend(sampler.fractions().iter().map(|fraction| fraction.to_bits()));
    words
}

/// An order of the samples in which neighbours are neighbours in direction: halves of halves, across the longer side each time.
/// Rays that go the same way take the same path, and lanes that do stay together.
pub fn coherent_order(sampler: &Sampler) -> Vec<u32> {
    let samples = sampler.samples();
    let directions: Vec<Vec3> = (0..)
        .zip(sampler.turns())
        .map(|(i, [cos, sin])| {
            let z = 1.0 - (i as f32 + 0.5) / samples as f32;
            let radius = (1.0 - z * z).sqrt();
            Vec3::new(radius * cos, radius * sin, z)
        })
        .collect();
    let mut order: Vec<u32> = (0..samples).collect();
    let mut rest: Vec<Range<usize>> = vec![0..order.len()];
    while let Some(range) = rest.pop() {
        let part = &mut order[range.clone()];
        if part.len() <= 4 {
            continue;
        }
        let bounds = part.iter().map(|&i| directions[i as usize]);
        let low = bounds.clone().fold(Vec3::INFINITY, Vec3::min);
        let axis = (bounds.fold(Vec3::NEG_INFINITY, Vec3::max) - low).max_position();
        // Workgroups take whole multiples
        let half = part.len() / 2;
        let middle = if half >= LANES as usize { half.next_multiple_of(LANES as usize) } else { half };
        part.select_nth_unstable_by(middle, |&a, &b| {
            directions[a as usize][axis].total_cmp(&directions[b as usize][axis]).then(a.cmp(&b))
        });
        rest.extend([range.start..range.start + middle, range.start + middle..range.end]);
    }
    order
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a sample that is traced twice or not at all, and an order that is no better than none.
    #[test]
    fn the_order_is_a_permutation_of_near_neighbours() {
        for samples in [16, 100, 512, 1000, 4096] {
            let sampler = Sampler::new(samples, 0, 0);
            let order = coherent_order(&sampler);
            let mut sorted = order.clone();
            sorted.sort_unstable();
            assert!(sorted.iter().copied().eq(0..samples));
            let direction = |i: u32| {
                let [cos, sin] = sampler.turns()[i as usize];
                let z = 1.0 - (i as f32 + 0.5) / samples as f32;
                Vec3::new(cos * (1.0 - z * z).sqrt(), sin * (1.0 - z * z).sqrt(), z)
            };
            if samples >= 512 {
                // 32 neighbours fill a patch of 32 / n of the hemisphere: no farther than four times its radius across
                let radius = (2.0 * 32.0 / samples as f32).sqrt();
                let groups = order.chunks_exact(32);
                let count = groups.len() as f32;
                let wide: f32 = groups
                    .map(|group| {
                        group.iter().map(|&i| direction(i).distance(direction(group[0]))).fold(0.0, f32::max)
                    })
                    .sum();
                assert!(wide / count < 4.0 * radius, "{samples}: {} {radius}", wide / count);
            }
        }
    }
}
