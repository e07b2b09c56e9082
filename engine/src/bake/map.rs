//! The brick map of a bake set: which geometries it sees, the name of their map, and its construction.

use std::path::Path;
use std::time::Instant;

use xxhash_rust::xxh3::Xxh3;

use super::inputs::Inputs;
use super::{BakeOptions, Control};
use crate::brickmap::{BrickMap, BuildOptions, BuildReport, OccluderStream, build, content_key};
use crate::scene::{BakeSet, Scene};
use crate::stats::Report;
use crate::stream::adapt::MatrixSource;
use crate::{Error, Result};

/// The geometries that a bake set sees, by number.
///
/// # Errors
/// [`ErrorKind::Invalid`](crate::ErrorKind::Invalid) when there is none.
pub fn occluders_of(scene: &Scene, bake_set: &BakeSet) -> Result<Vec<usize>> {
    let sees = |name: &String| bake_set.occluders.is_empty() || bake_set.occluders.contains(name);
    let geometries = scene.geometries.iter().enumerate();
    let seen = geometries.filter(|(_, g)| g.occluder && sees(&g.name)).map(|(number, _)| number).collect();
    some(scene, seen)
}

/// All geometries that occlude, by number.
///
/// # Errors
/// [`ErrorKind::Invalid`](crate::ErrorKind::Invalid) when there is none.
pub fn all_occluders(scene: &Scene) -> Result<Vec<usize>> {
    some(scene, (0..scene.geometries.len()).filter(|&g| scene.geometries[g].occluder).collect())
}

fn some(scene: &Scene, geometries: Vec<usize>) -> Result<Vec<usize>> {
    if geometries.is_empty() {
        return Err(Error::invalid("the scene has no occluder")
            .at(&scene.path)
            .hint("give at least one <geometry> occluder=\"true\""));
    }
    Ok(geometries)
}

/// The name under which the brick map of the given geometries is kept: equal names, equal bytes.
pub fn map_key(inputs: &Inputs, geometries: &[usize], options: &BakeOptions) -> String {
    let mut hash = Xxh3::new();
    geometries.iter().for_each(|&geometry| hash.update(&inputs.identities[geometry].to_le_bytes()));
    content_key(hash.digest128(), &build_options(options, Path::new("")))
}

fn build_options(options: &BakeOptions, scratch: &Path) -> BuildOptions {
    BuildOptions {
        memory_bytes: options.memory_bytes,
        threads: options.threads,
        scratch: scratch.to_path_buf(),
        far_field: options.far_field,
    }
}

/// Builds the brick map of the given geometries as the folder `target`, which appears when it is complete; none when
/// it is there already.
///
/// # Errors
/// See [`build`].
pub fn build_if_missing(
    scene: &Scene,
    inputs: &Inputs,
    geometries: &[usize],
    options: &BakeOptions,
    scratch: &Path,
    target: &Path,
    control: Control<'_>,
) -> Result<Option<BuildReport>> {
    if target.join("manifest.json").exists() {
        return Ok(None);
    }
    let mut opened = Vec::new();
    for &geometry in geometries {
        let parts = inputs.open_parts(scene, geometry)?;
        opened.extend(parts.into_iter().enumerate().map(|(number, part)| (number > 0, part)));
    }
    let mut occluders: Vec<OccluderStream<'_>> = opened
        .iter_mut()
        .map(|(continues, part)| OccluderStream {
            stream: part.stream.as_mut(),
            instances: part.copies.as_mut().map(|copies| copies.as_mut() as &mut dyn MatrixSource),
            continues: *continues,
        })
        .collect();
    let progress = |stage: &str, done: f64| control.progress.update(stage, done, "");
    build(&mut occluders, &build_options(options, scratch), target, &progress, control.cancel).map(Some)
}

/// Opens the brick map of the given geometries below `maps`, building it if it is not there, and reports on it.
///
/// # Errors
/// As [`build_if_missing`].
pub(super) fn open_map(
    scene: &Scene,
    inputs: &Inputs,
    geometries: &[usize],
    options: &BakeOptions,
    (maps, scratch): (&Path, &Path),
    report: &mut Report,
    control: Control<'_>,
) -> Result<BrickMap> {
    let path = maps.join(map_key(inputs, geometries, options));
    let start = Instant::now();
    let built = build_if_missing(scene, inputs, geometries, options, scratch, &path, control)?;
    let map_report = &mut report.brickmap;
    map_report.reused = built.is_none();
    if let Some(built) = built {
        map_report.seconds += start.elapsed().as_secs_f64();
        let phases = [built.count_seconds, built.fill_seconds, built.build_seconds];
        map_report.phase_seconds.iter_mut().zip(phases).for_each(|(sum, seconds)| *sum += seconds);
        map_report.partitions += built.partitions as u64;
        map_report.partitions_continued += built.continued_partitions as u64;
        map_report.scratch_bytes += built.spilled_bytes;
        report.skipped.extend(built.skipped());
    }
    let map = BrickMap::open(&path)?;
    let manifest = map.manifest();
    report.micropolygons += manifest.micropolygons;
    report.grids += manifest.grids;
    map_report.bricks += u64::from(map.brick_count());
    map_report.bytes += manifest.bytes;
    map_report.bytes_per_micropolygon = map_report.bytes as f64 / report.micropolygons.max(1) as f64;
    if map_report.seconds > 0.0 {
        map_report.micropolygons_per_second = report.micropolygons as f64 / map_report.seconds;
    }
    Ok(map)
}
