//! Lists that people page through, filtered and sorted by the database: jobs, and the leases that run.

use protocol::job::{Counts, JobPage};
use protocol::overview::LeaseDetail;
use protocol::{JobState, PassKind, PassState};

use super::view::{COUNTS, SUMMARY, summary};
use super::{Row, Store};
use crate::{Result, values};

/// What a list of jobs is sorted by.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum JobSort {
    /// When it was submitted.
    #[default]
    Created,
    /// Its name.
    Name,
    /// Its project.
    Project,
    /// Its state.
    State,
    /// Its priority.
    Priority,
    /// Who submitted it.
    Owner,
}

impl JobSort {
    fn column(self) -> &'static str {
        match self {
            Self::Created => "id",
            Self::Name => "LOWER(name)",
            Self::Project => "project",
            Self::State => "state",
            Self::Priority => "priority",
            Self::Owner => "LOWER(submitted_by)",
        }
    }
}

/// Which jobs, in which order, and which page of them.
#[derive(Clone, Debug, Default)]
pub struct JobList<'a> {
    /// Of one project.
    pub project: Option<&'a str>,
    /// In one state.
    pub state: Option<JobState>,
    /// Whose name, owner, shot, comment or id holds this.
    pub search: &'a str,
    /// The order.
    pub sort: JobSort,
    /// Least first.
    pub ascending: bool,
    /// Jobs before this one only: the cursor of the default order.
    pub before: Option<&'a str>,
    /// Entries to leave out.
    pub offset: i64,
    /// Entries at most.
    pub limit: i64,
}

/// Which jobs a list has: parameters 1 to 4 are project, state, search and cursor.
const WHERE: &str = "deleted = 0 AND ($1 = '' OR project = $1) AND ($2 = -1 OR state = $2) AND id < $4 AND ($3 = ''
    OR LOWER(name) LIKE $3 ESCAPE '!' OR LOWER(submitted_by) LIKE $3 ESCAPE '!' OR LOWER(shot) LIKE $3 ESCAPE '!'
    OR LOWER(comment) LIKE $3 ESCAPE '!' OR LOWER(id) LIKE $3 ESCAPE '!')";

/// What `LIKE` finds where it finds `text` anywhere.
fn anywhere(text: &str) -> String {
    let mut pattern = String::with_capacity(text.len() + 2);
    for c in text.to_lowercase().chars() {
        if "!%_".contains(c) {
            pattern.push('!');
        }
        pattern.push(c);
    }
    if pattern.is_empty() { pattern } else { format!("%{pattern}%") }
}

impl Store {
    /// Jobs, latest first unless another order is asked for.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn jobs(&self, list: &JobList<'_>) -> Result<JobPage> {
        let state = list.state.map_or(-1, JobState::code);
        let (project, before) = (list.project.unwrap_or_default(), list.before.unwrap_or("~"));
        let search = anywhere(list.search);
        let total = self
            .query_one(
                format!("SELECT COUNT(*) FROM job WHERE {WHERE}"),
                values![project, state, &search, before],
            )
            .await?
            .map_or(Ok(0), |row| row.int(0))?;
        let (column, direction) = (list.sort.column(), if list.ascending { "ASC" } else { "DESC" });
        let sql = format!(
            "WITH page AS (SELECT id, ROW_NUMBER() OVER (ORDER BY {column} {direction}, id DESC) AS place FROM job
                WHERE {WHERE} ORDER BY {column} {direction}, id DESC LIMIT $5 OFFSET $6)
            {SUMMARY} FROM page JOIN job j ON j.id = page.id {COUNTS} ORDER BY page.place"
        );
        let rows = self.query(sql, values![project, state, &search, before, list.limit, list.offset]).await?;
        let jobs = rows.iter().map(summary).collect::<Result<Vec<_>>>()?;
        let by_id = list.sort == JobSort::Created && !list.ascending;
        let next = if by_id && jobs.len() as i64 == list.limit { jobs.last() } else { None };
        Ok(JobPage { next: next.map(|job| job.id.clone()), jobs, total, live: Default::default() })
    }

    /// Jobs in a state, of one project where one is given.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn count_jobs(&self, project: Option<&str>, state: JobState) -> Result<i64> {
        let sql = "SELECT COUNT(*) FROM job WHERE deleted = 0 AND state = $1 AND ($2 = '' OR project = $2)";
        let row = self.query_one(sql, values![state.code(), project.unwrap_or_default()]).await?;
        row.map_or(Ok(0), |row| row.int(0))
    }

    /// Leases, oldest first, of one project where one is given.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn leases(&self, project: Option<&str>, limit: i64) -> Result<Vec<LeaseDetail>> {
        let sql = "SELECT j.id, j.name, j.project, p.id, p.kind, p.name, l.seg, l.worker, l.n, l.granted_at, l.expires_at,
                COALESCE(NULLIF(s.ewma_ms, 0), (SELECT CAST(AVG(o.ewma_ms) AS BIGINT) FROM segment o WHERE o.pass_id = p.id AND o.ewma_ms > 0), 0)
            FROM lease l JOIN pass p ON p.id = l.pass_id JOIN job j ON j.id = p.job_id
            LEFT JOIN segment s ON s.pass_id = l.pass_id AND s.seg = l.seg
            WHERE $1 = '' OR j.project = $1 ORDER BY l.granted_at, l.id LIMIT $2";
        let lease = |row: &Row| {
            Ok(LeaseDetail {
                job: row.text(0)?,
                job_name: row.text(1)?,
                project: row.text(2)?,
                pass: row.int(3)?,
                kind: row.word(4, PassKind::from_code)?,
                name: row.text(5)?,
                segment: row.int(6)?,
                worker: row.text(7)?,
                batches: row.int(8)?,
                granted_at: row.int(9)?,
                expires_at: row.int(10)?,
                batch_ms: row.int(11)?,
            })
        };
        self.query(sql, values![project.unwrap_or_default(), limit]).await?.iter().map(lease).collect()
    }

    /// Batches that are done of every job with an open bake pass.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn counts_of_live_jobs(&self) -> Result<Vec<(String, Counts)>> {
        let sql = "SELECT p.job_id, CAST(SUM(s.n_ready) AS BIGINT), CAST(SUM(s.n_leased) AS BIGINT), CAST(SUM(s.n_done) AS BIGINT),
                CAST(SUM(s.n_failed) AS BIGINT), CAST(SUM(s.n_skipped) AS BIGINT)
            FROM pass p JOIN segment s ON s.pass_id = p.id
            WHERE p.kind = $1 AND p.job_id IN (SELECT job_id FROM pass WHERE state = $2 AND state <= 2 AND kind = $1) GROUP BY p.job_id";
        let rows = self.query(sql, values![PassKind::Bake.code(), PassState::Open.code()]).await?;
        rows.iter().map(|row| Ok((row.text(0)?, super::view::counts(row, 1)?))).collect()
    }
}

#[cfg(test)]
mod tests {
    /// Catches a search in which a person's `%` or `_` stands for anything.
    #[test]
    fn a_search_is_text() {
        assert_eq!(super::anywhere("50%_Off!"), "%50!%!_off!!%");
        assert_eq!(super::anywhere(""), "");
    }
}
