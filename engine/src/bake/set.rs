//! The steps of one bake set: batches, their parts, the decorated stream. A bake takes them in turn, a farm's workers
//! take them one by one, and the bytes are the same.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use xxhash_rust::xxh3::{Xxh3, xxh3_64};

use super::inputs::Inputs;
use super::map::occluders_of;
use super::work::BakeWork;
use super::{BakeOptions, Control};
use crate::batch::{BatchPlan, KeepAll, Point, RAYS_PER_BATCH_MAX, SplitOptions, evenly_spaced, split};
use crate::brickmap::BrickMap;
use crate::output::{MergeOptions, MergeReport, Part, PartFormat, PartSource, merge};
use crate::scene::{BakeSet, Scene, Shader, ShaderKind};
use crate::stream::Attribute;
use crate::trace::{Backend, Shading, TraceOptions};
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
        let samples = self.shadings(0)?.iter().map(|shading| shading.shader.samples).max().unwrap_or(1);
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
        self.options.points_max.map_or_else(all, |points| evenly_spaced(plan, points))
    }

    /// What the parts of the set have in common.
    ///
    /// # Errors
    /// [`ErrorKind::Invalid`](crate::ErrorKind::Invalid) when a shader is unknown.
    pub fn format(&self, plan: &BatchPlan) -> Result<PartFormat> {
        let bake =
            xxh3_64(format!("{:016x} {} {:016x}", self.identity, self.bake_set.name, plan.hash()).as_bytes());
        PartFormat::new(bake, &self.attributes(&self.shadings(0)?), plan.points_per_batch_max())
    }

    /// What traces the batches of `plan` through `map`, which is that of the set's occluders.
    ///
    /// # Errors
    /// When the arena cannot be made, or a shader is unknown.
    pub fn tracer(&self, plan: Arc<BatchPlan>, map: Arc<BrickMap>) -> Result<BatchTracer> {
        let stream = self.occluders.iter().position(|&geometry| geometry == self.geometry);
        let shadings = self.shadings(stream.map_or(0, |stream| map.shift(stream)))?;
        let options = TraceOptions {
            lod: self.options.lod,
            seed: self.options.seed,
            threads: self.options.threads,
            instructions: self.options.instructions,
        };
        let arena_bytes = arena_bytes(self.options, &map);
        let device = self.options.device;
        let backend = Backend::new(device, map, arena_bytes, options, self.scene.meters_per_unit)?;
        let (format, values) = (self.format(&plan)?, vec![Vec::new(); shadings.len()]);
        let (points, next_points, row) = Default::default();
        Ok(BatchTracer { plan, shadings, format, backend, points, next: None, next_points, values, row })
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
            metadata: &self.metadata(&self.shadings(0)?),
        };
        merge(stream.as_mut(), plan, parts, &options, target, &mut control.stage("merge"))
    }

    /// The shaders of the set's attributes, with the samples that the options ask for; `shift` is that of the points'
    /// own stream in the brick map.
    fn shadings(&self, shift: u8) -> Result<Vec<Shading>> {
        let shading = |name: &str| {
            let Shader { kind, .. } = self.scene.shaders.iter().find(|shader| shader.name == name)?;
            match kind {
                ShaderKind::ShOcclusion(shader) => {
                    let mut shader = shader.clone();
                    shader.samples = self.options.samples.unwrap_or(shader.samples);
                    Some(Shading::new(&shader, self.options.seed, &self.bake_set.name, shift))
                }
            }
        };
        let unknown =
            |name: &str| Error::invalid(format!("no shader is called `{name}`")).at(&self.scene.path);
        let attributes = self.bake_set.attributes.iter();
        attributes.map(|a| shading(&a.shader).ok_or_else(|| unknown(&a.shader))).collect()
    }

    /// The output's new attributes.
    fn attributes(&self, shaders: &[Shading]) -> Vec<Attribute> {
        let pairs = self.bake_set.attributes.iter().zip(shaders);
        pairs
            .map(|(a, shading)| {
                Attribute::vertex(&a.name, shading.shader.storage, shading.coefficients() as u16)
            })
            .collect()
    }

    /// What the output says about its spherical harmonics.
    fn metadata(&self, shaders: &[Shading]) -> Vec<(String, String)> {
        let mut metadata = vec![(
            "sh.convention".into(),
            "real orthonormal, index l(l+1)+m, no Condon-Shortley phase".into(),
        )];
        for (attribute, Shading { shader, .. }) in self.bake_set.attributes.iter().zip(shaders) {
            let of = |what: &str| format!("{}.{what}", attribute.name);
            metadata.push((of("shader"), "sh_occlusion".into()));
            metadata.push((of("bands"), shader.bands.to_string()));
            metadata.push((of("samples"), shader.samples.to_string()));
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

/// Traces batches of one plan, one after the other; keeps what it has loaded.
pub struct BatchTracer {
    plan: Arc<BatchPlan>,
    shadings: Vec<Shading>,
    format: PartFormat,
    backend: Backend,
    points: Vec<Point>,
    /// The batch whose points are the next ones.
    next: Option<u32>,
    next_points: Vec<Point>,
    values: Vec<Vec<f32>>,
    row: Vec<f32>,
}

impl BatchTracer {
    /// What the parts have in common.
    pub fn format(&self) -> &PartFormat {
        &self.format
    }

    /// Says which batch is traced after the coming one, so that its bricks can be loaded meanwhile.
    ///
    /// # Errors
    /// When the plan is damaged.
    pub fn expect(&mut self, next: Option<u32>) -> Result<()> {
        self.next = next;
        match next {
            Some(batch) => self.plan.read(batch as usize, &mut self.next_points),
            None => Ok(()),
        }
    }

    /// Traces `batch`, becomes its part, and adds to `work`. The part depends on the batch alone.
    ///
    /// # Errors
    /// When the plan or the brick map is damaged, or `cancel` is set.
    pub fn trace(
        &mut self,
        batch: u32,
        part: &mut Part,
        work: &mut BakeWork,
        cancel: &AtomicBool,
    ) -> Result<()> {
        let start = Instant::now();
        self.plan.read(batch as usize, &mut self.points)?;
        for (number, (shading, values)) in self.shadings.iter().zip(&mut self.values).enumerate() {
            values.resize(self.points.len() * shading.coefficients(), 0.0);
            let next = match self.shadings.get(number + 1) {
                Some(shading) => Some((&self.points[..], shading)),
                None => self.next.map(|_| (&self.next_points[..], &self.shadings[0])),
            };
            work.add(&self.backend.trace(&self.points, shading, next, cancel, values)?);
        }
        part.start(batch, self.points.iter().map(|point| point.index), &self.format);
        for point in 0..self.points.len() {
            self.row.clear();
            for (shading, values) in self.shadings.iter().zip(&self.values) {
                let count = shading.coefficients();
                self.row.extend_from_slice(&values[point * count..(point + 1) * count]);
            }
            part.set_row(&self.format, point, &self.row);
        }
        work.batches += 1;
        work.seconds += start.elapsed().as_secs_f64();
        Ok(())
    }

    /// Adds to `work` what the arena has done since the tracer was made.
    pub fn finish(&self, work: &mut BakeWork) {
        work.add_backend(&self.backend);
    }
}

/// The share of the memory that the arena may take: what the rest of the bake does not need.
fn arena_bytes(options: &BakeOptions, map: &BrickMap) -> u64 {
    // Directory and arena tables per brick, a few MiB per thread, points and parts of a batch, waiting rays
    let tables = 24 * u64::from(map.brick_count());
    let fixed = (96 << 20) + (options.threads as u64 * (4 << 20)).min(options.memory_bytes / 4);
    options.memory_bytes.saturating_sub(tables + fixed).max(options.memory_bytes / 4)
}
