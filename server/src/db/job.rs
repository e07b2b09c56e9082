//! Submissions: a job is in the database before its submitter hears of it.

use std::sync::Arc;

use protocol::JobState;
use protocol::job::JobRequest;

use super::event::NewEvent;
use super::{Row, Store, Tx};
use crate::error::Kind;
use crate::{Error, Result, values};

/// A job to be.
#[derive(Clone, Debug)]
pub struct NewJob {
    /// Its id.
    pub id: String,
    /// What was asked for, without the scene, which is in storage; the frames of a submission share it.
    pub request: Arc<JobRequest>,
    /// A hash of the request as it came.
    pub request_sha256: String,
    /// The key under which the same request is not carried out twice.
    pub idempotency_key: Option<String>,
    /// The frame.
    pub frame: Option<i64>,
    /// By whom.
    pub submitted_by: String,
    /// The job of which it is an edited copy.
    pub resubmit_of: Option<String>,
}

impl Store {
    /// The jobs that an earlier request with this key made.
    ///
    /// # Errors
    /// [`Kind::Conflict`] when that was another request.
    pub async fn find_idempotent(
        &self,
        project: &str,
        key: &str,
        request_sha256: &str,
    ) -> Result<Option<Vec<String>>> {
        let sql = "SELECT id, request_sha256 FROM job WHERE project = $1 AND idempotency_key = $2 AND deleted = 0 ORDER BY id";
        let rows = self.query(sql, values![project, key]).await?;
        same_request(key, request_sha256, &rows)
    }

    /// Adds the jobs of one request. If a request with the same key was faster, its jobs are returned instead.
    ///
    /// # Errors
    /// [`Kind::NotFound`] when the project or a job that it depends on is not there.
    pub async fn submit(&self, jobs: &[NewJob], now: i64) -> Result<Vec<String>> {
        let Some(first) = jobs.first() else { return Ok(Vec::new()) };
        let project = &first.request.project;
        let mut tx = self.begin().await?;
        // The project's row orders requests with the same key
        let sql = format!("SELECT name FROM project WHERE name = $1{}", self.dialect().lock);
        if tx.query(sql.into(), values![project]).await?.is_empty() {
            return Err(Error::not_found("project", project));
        }
        if let Some(key) = &first.idempotency_key {
            let sql = "SELECT id, request_sha256 FROM job WHERE project = $1 AND idempotency_key = $2 AND deleted = 0 ORDER BY id";
            let rows = tx.query(sql.into(), values![project, key]).await?;
            if let Some(known) = same_request(key, &first.request_sha256, &rows)? {
                return Ok(known);
            }
        }
        let file_set = self.refer_to_files(&mut tx, &first.request, now).await?;
        for job in jobs {
            self.insert(&mut tx, job, file_set.as_deref(), now).await?;
        }
        self.commit("submit", tx).await?;
        Ok(jobs.iter().map(|job| job.id.clone()).collect())
    }

    async fn insert(&self, tx: &mut Tx, job: &NewJob, file_set: Option<&str>, now: i64) -> Result<()> {
        let request = &job.request;
        let mut blocked = false;
        for needed in &request.depends_on {
            let sql = "SELECT state FROM job WHERE id = $1 AND project = $2 AND deleted = 0";
            let rows = tx.query(sql.into(), values![needed, &request.project]).await?;
            let row = rows.first().ok_or_else(|| Error::not_found("job", needed))?;
            match row.word(0, JobState::from_code)? {
                JobState::Succeeded => {}
                state if state.is_final() => {
                    let message = format!("the job `{needed}`, which must succeed before, has {state}");
                    return Err(Error::new(Kind::Conflict, message));
                }
                _ => blocked = true,
            }
        }
        let shot = [&request.show, &request.sequence, &request.shot].map(String::as_str);
        let shot = &shot.into_iter().filter(|name| !name.is_empty()).collect::<Vec<_>>().join("/");
        let state = if blocked { JobState::Blocked } else { JobState::Ready };
        let reason = if blocked { "another job must succeed before" } else { "" };
        let sql = "INSERT INTO job (id, project, name, state, paused, reason, priority, running_max, failed_max,
                partial, request, request_sha256, idempotency_key, shot, comment, frame, submitted_by, resubmit_of, created_at,
                file_set)
            VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9, $10, $11, $12, $13, $14, $15, $16, $17, $18, $19, $20)";
        tx.execute(
            sql.into(),
            values![
                &job.id,
                &request.project,
                &request.name,
                state.code(),
                request.paused,
                reason,
                request.priority,
                request.running_max,
                request.failed_max,
                request.partial,
                serde_json::to_string(&**request)?,
                &job.request_sha256,
                job.idempotency_key.clone(),
                shot,
                &request.comment,
                job.frame,
                &job.submitted_by,
                job.resubmit_of.clone(),
                now,
                file_set,
            ],
        )
        .await?;
        for needed in &request.depends_on {
            let sql = "INSERT INTO dependency (job_id, needs) VALUES ($1, $2) ON CONFLICT DO NOTHING";
            tx.execute(sql.into(), values![&job.id, needed]).await?;
        }
        let event = NewEvent {
            kind: "job.submitted",
            project: &request.project,
            job: Some(&job.id),
            actor: &job.submitted_by,
            detail: &request.name,
        };
        self.record(tx, now, event).await
    }

    /// The request of a job, without its scene, and its project.
    ///
    /// # Errors
    /// [`Kind::NotFound`].
    pub async fn job_request(&self, job: &str) -> Result<JobRequest> {
        let row = self.query_one("SELECT request FROM job WHERE id = $1", values![job]).await?;
        let row = row.ok_or_else(|| Error::not_found("job", job))?;
        Ok(serde_json::from_str(&row.text(0)?)?)
    }
}

fn same_request(key: &str, request_sha256: &str, rows: &[Row]) -> Result<Option<Vec<String>>> {
    if rows.is_empty() {
        return Ok(None);
    }
    for row in rows {
        if row.text(1)? != request_sha256 {
            let message = format!("the idempotency key `{key}` was used for another request");
            return Err(Error::new(Kind::Conflict, message));
        }
    }
    rows.iter().map(|row| row.text(0)).collect::<Result<_>>().map(Some)
}
