//! The farm, read anew from the database: what [`crate::scheduler`] decides by.

use std::collections::BTreeMap;

use protocol::PassState;
use protocol::job::JobRequest;
use protocol::work::Task;

use super::Store;
use crate::scheduler::failure::BLOCK_AFTER;
use crate::scheduler::farm::{Farm, Job, Pass, Project, Segment, Worker};
use crate::{Error, Result, values};

impl Store {
    /// The farm as it is now.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn load_farm(&self, now: i64) -> Result<Farm> {
        let mut farm = Farm::default();
        self.load_jobs(&mut farm).await?;
        if !farm.passes.is_empty() {
            self.load_segments(&mut farm).await?;
            self.load_leases(&mut farm).await?;
        }
        for row in self.query("SELECT name, share, running_max FROM project", vec![]).await? {
            let project =
                Project { share: row.int(1)?, running_max: row.int_or_null(2)?, running: 0, leases: 0 };
            farm.projects.insert(row.text(0)?, project);
        }
        let sql = "SELECT name, labels, memory_bytes, locked + draining, sick_until, last_seen FROM worker";
        for row in self.query(sql, vec![]).await? {
            let worker = Worker {
                labels: serde_json::from_str(&row.text(1)?)?,
                memory_bytes: row.int(2)?,
                withheld: row.int(3)? > 0 || row.int(4)? > now,
                last_seen: row.int(5)?,
            };
            farm.workers.insert(row.text(0)?, worker);
        }
        let sql = "SELECT b.worker, b.job_id FROM worker_block b JOIN job j ON j.id = b.job_id WHERE b.n >= $1 AND j.ended_at IS NULL";
        for row in self.query(sql, values![BLOCK_AFTER]).await? {
            farm.blocks.entry(row.text(0)?).or_default().insert(row.text(1)?);
        }
        for job in farm.jobs.values() {
            if let Some(project) = farm.projects.get_mut(&job.project) {
                project.running += job.running;
                project.leases += job.leases;
            }
        }
        Ok(farm)
    }

    async fn load_jobs(&self, farm: &mut Farm) -> Result<()> {
        let sql = "SELECT p.id, j.id, j.project, j.priority, j.paused, j.running_max, j.request
            FROM pass p JOIN job j ON j.id = p.job_id WHERE p.state = $1 AND p.state <= 2 ORDER BY p.id";
        for row in self.query(sql, values![PassState::Open.code()]).await? {
            let (pass, id) = (row.int(0)?, row.text(1)?);
            farm.passes.insert(pass, Pass { job: id.clone(), segments: BTreeMap::new() });
            if let Some(job) = farm.jobs.get_mut(&id) {
                job.passes.push(pass);
                continue;
            }
            let request: JobRequest = serde_json::from_str(&row.text(6)?)?;
            let job = Job {
                project: row.text(2)?,
                priority: row.int(3)?,
                paused: row.flag(4)?,
                running_max: row.int_or_null(5)?,
                running: 0,
                leases: 0,
                requires: request.requires,
                passes: vec![pass],
            };
            farm.jobs.insert(id, job);
        }
        Ok(())
    }

    async fn load_segments(&self, farm: &mut Farm) -> Result<()> {
        let sql =
            "SELECT s.pass_id, s.seg, s.n_ready, s.n_leased, s.owner, s.owner_until, s.ewma_ms, s.not_before
            FROM pass p JOIN segment s ON s.pass_id = p.id WHERE p.state = $1 AND p.state <= 2 AND s.n_ready + s.n_leased > 0";
        for row in self.query(sql, values![PassState::Open.code()]).await? {
            let Some(pass) = farm.passes.get_mut(&row.int(0)?) else { continue };
            if let Some(job) = farm.jobs.get_mut(&pass.job) {
                job.running += row.int(3)?;
            }
            let segment = Segment {
                ready: row.int(2)?,
                owner: row.text_or_null(4)?,
                owner_until: row.int(5)?,
                batch_ms: row.int(6)?,
                not_before: row.int(7)?,
            };
            pass.segments.insert(row.int(1)?, segment);
        }
        Ok(())
    }

    async fn load_leases(&self, farm: &mut Farm) -> Result<()> {
        let sql = "SELECT pass_id, COUNT(*) FROM lease GROUP BY pass_id";
        for row in self.query(sql, vec![]).await? {
            let job = farm.passes.get(&row.int(0)?).and_then(|pass| farm.jobs.get_mut(&pass.job));
            if let Some(job) = job {
                job.leases += row.int(1)?;
            }
        }
        Ok(())
    }

    /// What a pass does.
    ///
    /// # Errors
    /// When there is no such pass.
    pub async fn task(&self, pass: i64) -> Result<Task> {
        let row = self.query_one("SELECT task FROM pass WHERE id = $1", values![pass]).await?;
        let row = row.ok_or_else(|| Error::not_found("pass", pass))?;
        Ok(serde_json::from_str(&row.text(0)?)?)
    }
}
