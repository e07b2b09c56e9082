//! The steps of one bake set: batches, their parts, the decorated stream. A bake takes them in turn, a farm's workers
//! take them one by one, and the bytes are the same.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use xxhash_rust::xxh3::{Xxh3, xxh3_64};

use super::inputs::Inputs;
use super::map::occluders_of;
use super::run::{Column, Run, Runs};
use super::tracer::BatchTracer;
use super::{BakeOptions, Control};
use crate::batch::{BatchPlan, KeepAll, RAYS_PER_BATCH_MAX, SplitOptions, split};
use crate::brickmap::BrickMap;
use crate::output::{MergeOptions, MergeReport, PartFormat, PartSource, merge};
use crate::scene::{BakeSet, Scene, ShOcclusion, ShaderKind};
use crate::trace::{Backend, TraceOptions};
use crate::{Error, Result};

/// A bake set with everything that its results depend on.
#[derive(Clone)]
pub struct SetBake<'a> {
    scene: &'a Scene,
    inputs: &'a Inputs,
    options: &'a BakeOptions,
    /// The bake set.
    pub bake_set: &'a BakeSet,
    /// The geometry that carries it, by number.
    pub geometry: usize,
    /// The geometries that it sees, by number, in the order of its brick map's streams.
    pub occluders: Vec<usize>,
    identity: u64,
}

/// Refuses a scene without bake sets, before anything is imported for it.
///
/// # Errors
/// [`ErrorKind::Invalid`](crate::ErrorKind::Invalid).
pub fn require_sets(scene: &Scene) -> Result<()> {
    if scene.geometries.iter().any(|geometry| !geometry.bake_sets.is_empty()) {
        return Ok(());
    }
    Err(Error::invalid("the scene has no bake set")
        .at(&scene.path)
        .hint("add a <bakeset> to a <geometry>, or use `pantaray build` for the brick map alone"))
}

/// A hash of everything that the baked bytes depend on.
pub fn identity(scene: &Scene, inputs: &Inputs, options: &BakeOptions) -> u64 {
    let mut hash = Xxh3::new();
    inputs.identities.iter().for_each(|identity| hash.update(&identity.to_le_bytes()));
    for geometry in &scene.geometries {
        hash.update(format!("{} {} {:?}\n", geometry.name, geometry.occluder, geometry.bake_sets).as_bytes());
    }
    let BakeOptions { lod, far_field, seed, samples, points_max, .. } = options;
    hash.update(
        format!("{:?}\n{lod:?} {far_field:?} {seed} {samples:?} {points_max:?}", scene.shaders).as_bytes(),
    );
    hash.digest()
}

impl<'a> SetBake<'a> {
    /// Every bake set of the scene, in its order.
    ///
    /// # Errors
    /// [`ErrorKind::Invalid`](crate::ErrorKind::Invalid) when one sees no occluder.
    pub fn all(scene: &'a Scene, inputs: &'a Inputs, options: &'a BakeOptions) -> Result<Vec<Self>> {
        let identity = identity(scene, inputs, options);
        let mut sets = Vec::new();
        for (geometry, carrier) in scene.geometries.iter().enumerate() {
            for bake_set in &carrier.bake_sets {
                let occluders = occluders_of(scene, bake_set)?;
                sets.push(Self { scene, inputs, options, bake_set, geometry, occluders, identity });
            }
        }
        Ok(sets)
    }

    /// Splits the set's points into batches, left in `folder`: those of an earlier call if they are there.
    ///
    /// # Errors
    /// See [`split`].
    pub fn plan(&self, folder: &Path, control: Control<'_>) -> Result<BatchPlan> {
        if let Ok(plan) = BatchPlan::open(folder) {
            return Ok(plan);
        }
        let samples = self.runs(0)?.runs.iter().map(|run| run.samples).max().unwrap_or(1);
        let options = SplitOptions {
            bake_set: self.bake_set.name.clone(),
            points_per_batch_max: (RAYS_PER_BATCH_MAX / samples).max(1),
            scratch: PathBuf::from(folder),
            memory_bytes: self.options.memory_bytes / 2,
        };
        let mut stream = self.inputs.open(self.scene, self.geometry)?;
        split(stream.as_mut(), &mut KeepAll, &options, &mut control.stage("batches"))
    }

    /// The batches that the options ask for, in the order in which they are best baked.
    pub fn batches(&self, plan: &BatchPlan) -> Vec<u32> {
        let all = || (0..plan.len() as u32).collect();
        self.options.points_max.map_or_else(all, |points| plan.table().evenly_spaced(points))
    }

    /// What the parts of the set have in common.
    ///
    /// # Errors
    /// [`ErrorKind::Invalid`](crate::ErrorKind::Invalid) when a shader is unknown.
    pub fn format(&self, plan: &BatchPlan) -> Result<PartFormat> {
        let bake =
            xxh3_64(format!("{:016x} {} {:016x}", self.identity, self.bake_set.name, plan.hash()).as_bytes());
        let columns = self.runs(0)?.columns;
        let attributes: Vec<_> = columns.into_iter().map(|column| column.attribute).collect();
        PartFormat::new(bake, &attributes, plan.points_per_batch_max())
    }

    /// What traces the batches of `plan` through `map`, which is that of the set's occluders.
    ///
    /// # Errors
    /// When the arena cannot be made, or a shader is unknown.
    pub fn tracer(&self, plan: Arc<BatchPlan>, map: Arc<BrickMap>) -> Result<BatchTracer> {
        let stream = self.occluders.iter().position(|&geometry| geometry == self.geometry);
        let runs = self.runs(stream.map_or(0, |stream| map.shift(stream)))?;
        let options = TraceOptions {
            lod: self.options.lod,
            seed: self.options.seed,
            threads: self.options.threads,
            instructions: self.options.instructions,
        };
        let arena_bytes = arena_bytes(self.options, &map);
        let device = self.options.device;
        let backend = Backend::new(device, map, arena_bytes, options, self.scene.meters_per_unit)?;
        Ok(BatchTracer::new(self.format(&plan)?, plan, runs, backend))
    }

    /// Merges parts into the decorated stream `target`, which appears when it is complete. With `holes`, points may lack
    /// a result even where all were asked for. `scratch` is an existing folder for temporary data.
    ///
    /// # Errors
    /// See [`merge`].
    pub fn merge(
        &self,
        plan: &BatchPlan,
        parts: &mut dyn PartSource,
        holes: bool,
        scratch: &Path,
        target: &Path,
        control: Control<'_>,
    ) -> Result<MergeReport> {
        let mut stream = self.inputs.open(self.scene, self.geometry)?;
        let options = MergeOptions {
            scratch,
            memory_bytes: self.options.memory_bytes / 4,
            partial: holes || self.options.points_max.is_some(),
            metadata: &self.metadata(&self.runs(0)?),
        };
        merge(stream.as_mut(), plan, parts, &options, target, &mut control.stage("merge"))
    }

    /// The shaders and attributes of the set; `shift` is that of the points' own stream in the brick map.
    fn runs(&self, shift: u8) -> Result<Runs> {
        Runs::new(self.scene, self.options, self.bake_set, shift)
    }

    /// What the output says about its new attributes.
    fn metadata(&self, runs: &Runs) -> Vec<(String, String)> {
        let mut metadata = vec![(
            "sh.convention".into(),
            "real orthonormal, index l(l+1)+m, no Condon-Shortley phase".into(),
        )];
        for Column { run, output, attribute } in &runs.columns {
            let Run { shader, samples, .. } = &runs.runs[*run];
            let of = |what: &str| format!("{}.{what}", attribute.name);
            metadata.push((of("shader"), shader.kind.type_name().into()));
            metadata.push((of("output"), output.name.clone()));
            metadata.push((of("samples"), samples.to_string()));
            let ShaderKind::ShOcclusion(shader) = &shader.kind;
            if output.name == ShOcclusion::COEFFICIENTS {
                metadata.push((of("bands"), shader.bands.to_string()));
            }
            metadata.push((of("domain"), format!("{:?}", shader.domain).to_lowercase()));
            metadata.push((of("weight"), format!("{:?}", shader.weight).to_lowercase()));
        }
        let own = self.inputs.metadata(self.scene, self.geometry).iter();
        let own: Vec<_> =
            own.filter(|(key, _)| metadata.iter().all(|(known, _)| known != key)).cloned().collect();
        metadata.extend(own);
        metadata
    }
}

/// The share of the memory that the arena may take: what the rest of the bake does not need.
fn arena_bytes(options: &BakeOptions, map: &BrickMap) -> u64 {
    // Directory and arena tables per brick, a few MiB per thread, points and parts of a batch, waiting rays
    let tables = 24 * u64::from(map.brick_count());
    let fixed = (96 << 20) + (options.threads as u64 * (4 << 20)).min(options.memory_bytes / 4);
    options.memory_bytes.saturating_sub(tables + fixed).max(options.memory_bytes / 4)
}
