//! What there is to see of a bake that is under way: a preview of some of the parts that are committed. It is made when
//! somebody looks, and not again for half a minute.

use std::collections::HashMap;
use std::path::Path;
use std::sync::Mutex;

use engine::batch::PlanTable;
use engine::preview::{PartsPreview, Setting};
use engine::scene::{Roots, Scene, ShOcclusion, ShaderKind};
use futures_util::{StreamExt, TryStreamExt, stream};
use object_store::GetRange;
use protocol::job::{JobRequest, JobSummary, PassDetail};
use protocol::overview::Provisional;
use protocol::work::{PartEntry, Task};
use protocol::{PassKind, keys};

use super::{Coordinator, lock};
use crate::error::Kind;
use crate::{Error, Result};

/// A preview is used for so long.
const FRESH_MS: i64 = 30_000;
/// Parts of a preview, about: half a million points at most.
const PARTS: i64 = 192;
/// Points that a preview has at most.
const POINTS_MAX: usize = 500_000;
/// Parts that are read at once.
const READS: usize = 8;
/// Bytes of a plan's table at most that is read for this: a million batches.
const TABLE_BYTES_MAX: u64 = 72 << 20;
/// Passes whose latest preview is remembered.
const REMEMBERED_MAX: usize = 1_024;

/// The latest preview of each pass with when the one before it was made, and what keeps two from being made at once.
#[derive(Default)]
pub struct Provisionals {
    latest: Mutex<HashMap<i64, (Provisional, Option<i64>)>>,
    making: tokio::sync::Mutex<()>,
}

impl Coordinator {
    /// What there is to see of a job's bake passes; nothing of one of which no part is committed.
    ///
    /// # Errors
    /// When storage or the database refuse, or a part is damaged.
    pub async fn provisional(&self, job: &JobSummary) -> Result<Vec<Provisional>> {
        let passes = self.store.pass_details(&job.id).await?;
        let mut found = Vec::new();
        for pass in passes.iter().filter(|pass| pass.kind == PassKind::Bake && pass.batches.done > 0) {
            found.extend(self.provisional_of(job, pass).await?);
        }
        Ok(found)
    }

    async fn provisional_of(&self, job: &JobSummary, pass: &PassDetail) -> Result<Option<Provisional>> {
        let fresh =
            |latest: &Provisional| latest.done == pass.batches.done || self.now() - latest.made_at < FRESH_MS;
        let known = || lock(&self.provisionals.latest).get(&pass.id).cloned();
        if let Some((latest, _)) = known().filter(|(latest, _)| fresh(latest)) {
            return Ok(Some(latest));
        }
        let _one_at_a_time = self.provisionals.making.lock().await;
        let before = known();
        if let Some((latest, _)) = before.clone().filter(|(latest, _)| fresh(latest)) {
            return Ok(Some(latest));
        }
        let Some((made, bytes)) = self.make_provisional(job, pass).await? else { return Ok(None) };
        self.storage.put(&keys::provisional(&job.id, pass.id, made.made_at), bytes).await?;
        // Somebody may still read the one before this, nobody the one before that
        let (previous, oldest) = before.map(|(latest, oldest)| (latest.made_at, oldest)).unzip();
        {
            let mut latest = lock(&self.provisionals.latest);
            if latest.len() >= REMEMBERED_MAX {
                latest.clear();
            }
            latest.insert(pass.id, (made.clone(), previous));
        }
        if let Some(oldest) = oldest.flatten() {
            self.storage.remove(&keys::provisional(&job.id, pass.id, oldest).into()).await?;
        }
        Ok(Some(made))
    }

    /// Reads some parts and their points, and makes a preview of them.
    async fn make_provisional(
        &self,
        job: &JobSummary,
        pass: &PassDetail,
    ) -> Result<Option<(Provisional, Vec<u8>)>> {
        let task = self.task(pass.id).await?;
        let (parts, done) = self.store.some_parts(pass.id, PARTS).await?;
        let Some(plan) = task.plan.clone() else { return Ok(None) };
        let made_at = self.now();
        let setting = self.setting(job, &task).await?;
        let table = self.table(&plan).await?;
        // The batches that the settings leave out have no number in the pass
        let kept = task.settings.max_points.map(|points| table.evenly_spaced(points));
        let reads = stream::iter(parts).map(|part| {
            let number = usize::try_from(part.batch).ok();
            let number = match &kept {
                Some(kept) => number.and_then(|number| kept.get(number)).map(|&batch| batch as usize),
                None => number,
            };
            self.read_batch(&job.id, pass.id, part, &plan, number.map(|number| (number, &table)))
        });
        let batches: Vec<_> = reads.buffered(READS).try_collect().await?;
        let points_each = i64::from(table.points_per_batch_max());
        let baked = done.saturating_mul(points_each).unsigned_abs();
        let made = tokio::task::spawn_blocking(move || -> engine::Result<Option<(u64, Vec<u8>)>> {
            let mut preview = PartsPreview::new(setting, table.points_per_batch_max());
            let mut points = Vec::new();
            for Batch { number, key, part, planned } in batches.into_iter().flatten() {
                if preview.len() > POINTS_MAX {
                    break;
                }
                table.decode(number, &planned, Path::new(&key), &mut points)?;
                preview.add(&part, Path::new(&key), &points)?;
            }
            let points = preview.len() as u64;
            Ok(preview.encode(baked).map(|bytes| (points, bytes)))
        });
        let made = made.await.map_err(|error| Error::new(Kind::Internal, error.to_string()))?;
        let made = made.map_err(|error| Error::new(Kind::Internal, error.to_string()))?;
        let Some((points, bytes)) = made else { return Ok(None) };
        let (name, batches) = (format!("{}.mgs", pass.name), pass.batches.total());
        Ok(Some((Provisional { name, pass: pass.id, done, batches, points, made_at }, bytes)))
    }

    /// What the job's scene says about a bake set.
    async fn setting(&self, job: &JobSummary, task: &Task) -> Result<Setting> {
        let mut request = self.store.job_request(&job.id).await?;
        request.scene = self.scene(&job.id).await?;
        let frame = job.frame.or(request.settings.frame);
        let (roots, set) = (self.settings.roots.clone(), task.set.clone().unwrap_or_default());
        let read = tokio::task::spawn_blocking(move || setting(&request, frame, &roots, &set));
        read.await.map_err(|error| Error::new(Kind::Internal, error.to_string()))?
    }

    /// The table of the plan in a folder of storage.
    async fn table(&self, plan: &str) -> Result<PlanTable> {
        let key = format!("{plan}/plan.bin");
        let bytes = self.storage.bytes(&key).await?.ok_or_else(|| Error::not_found("plan", plan))?;
        if bytes > TABLE_BYTES_MAX {
            return Err(Error::new(Kind::TooLarge, format!("the plan's table has `{bytes}` bytes")));
        }
        let sent = self.storage.send(&key, None).await?;
        let bytes = axum::body::to_bytes(sent.body, TABLE_BYTES_MAX as usize).await;
        let bytes = bytes.map_err(|error| Error::new(Kind::Unavailable, error.to_string()))?;
        let read = tokio::task::spawn_blocking(move || {
            let folder = tempfile::tempdir()?;
            let path = folder.path().join("plan.bin");
            std::fs::write(&path, &bytes)?;
            PlanTable::open(&path).map_err(|error| Error::new(Kind::Internal, error.to_string()))
        });
        read.await.map_err(|error| Error::new(Kind::Internal, error.to_string()))?
    }

    /// A committed part and its points; none where the part has gone since.
    async fn read_batch(
        &self,
        job: &str,
        pass: i64,
        part: PartEntry,
        plan: &str,
        batch: Option<(usize, &PlanTable)>,
    ) -> Result<Option<Batch>> {
        let Some((number, table)) = batch.filter(|(number, table)| *number < table.len()) else {
            return Ok(None);
        };
        let key = keys::part(job, pass, part.batch, part.fence, &part.sha256);
        let Some(part) = self.storage.get(&key).await? else { return Ok(None) };
        let range = table.points_range(number);
        let length = (range.end - range.start) as usize;
        let sent = self.storage.send(&format!("{plan}/points.bin"), Some(GetRange::Bounded(range))).await?;
        let planned = axum::body::to_bytes(sent.body, length).await;
        let planned = planned.map_err(|error| Error::new(Kind::Unavailable, error.to_string()))?;
        Ok(Some(Batch { number, key, part: part.to_vec(), planned: planned.to_vec() }))
    }
}

/// A batch as it was read.
struct Batch {
    /// Its number in the plan.
    number: usize,
    key: String,
    part: Vec<u8>,
    planned: Vec<u8>,
}

fn setting(request: &JobRequest, frame: Option<i64>, roots: &Roots, set: &str) -> Result<Setting> {
    let scene = super::validate::scene_of(request, frame, roots)?;
    let Scene { meters_per_unit, up, shaders, geometries, .. } = &scene;
    let sets = geometries.iter().flat_map(|geometry| &geometry.bake_sets);
    let found = sets.into_iter().find(|found| found.name == set);
    let attributes = found.map(|found| &found.attributes[..]).unwrap_or_default();
    let coefficients = attributes.iter().find(|attribute| attribute.output == ShOcclusion::COEFFICIENTS);
    let shader = coefficients.and_then(|wanted| shaders.iter().find(|shader| shader.name == wanted.shader));
    let default = ShOcclusion::default();
    let (weight, domain) = shader.map_or((default.weight, default.domain), |shader| match &shader.kind {
        ShaderKind::ShOcclusion(shader) => (shader.weight, shader.domain),
    });
    let attribute = coefficients.map(|attribute| attribute.name.clone());
    Ok(Setting { attribute, weight, domain, meters_per_unit: *meters_per_unit, up: *up })
}
