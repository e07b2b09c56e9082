//! Whether the database agrees with itself: counts equal the rows they count. For tests, and for whoever is in doubt.

use super::Store;
use crate::{Result, values};

/// A segment whose counts are not those of its batches.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Drift {
    /// The pass.
    pub pass: i64,
    /// The segment.
    pub segment: i64,
    /// Ready, leased, done, failed, skipped as counted.
    pub counted: [i64; 5],
    /// And as they are.
    pub actual: [i64; 5],
}

impl Store {
    /// Segments whose counts are not those of their batches; none, always.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn drift(&self) -> Result<Vec<Drift>> {
        let counts = ["0", "1", "2", "3", "4, 5"]
            .map(|states| format!("SUM(CASE WHEN state IN ({states}) THEN 1 ELSE 0 END)"));
        // Batches are counted in one pass over them: no index has them all by segment
        let sql = format!(
            "SELECT s.pass_id, s.seg, s.n_ready, s.n_leased, s.n_done, s.n_failed, s.n_skipped, {}
            FROM segment s LEFT JOIN (SELECT pass_id, seg, {} FROM batch GROUP BY pass_id, seg) b
            ON b.pass_id = s.pass_id AND b.seg = s.seg",
            [0, 1, 2, 3, 4].map(|n| format!("CAST(COALESCE(b.n{n}, 0) AS BIGINT)")).join(", "),
            (0..5).map(|n| format!("{} AS n{n}", counts[n])).collect::<Vec<_>>().join(", ")
        );
        let mut drifts = Vec::new();
        for row in self.query(sql, vec![]).await? {
            let five = |first: usize| -> Result<[i64; 5]> {
                let mut counts = [0; 5];
                for (place, count) in counts.iter_mut().enumerate() {
                    *count = row.int(first + place)?;
                }
                Ok(counts)
            };
            let (counted, actual) = (five(2)?, five(7)?);
            if counted != actual {
                drifts.push(Drift { pass: row.int(0)?, segment: row.int(1)?, counted, actual });
            }
        }
        Ok(drifts)
    }

    /// The job of a pass; none where there is no such pass.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn job_of(&self, pass: i64) -> Result<Option<String>> {
        let row = self.query_one("SELECT job_id FROM pass WHERE id = $1", values![pass]).await?;
        row.map(|row| row.text(0)).transpose()
    }

    /// Batches that are leased to no lease, and leases that count other batches than they have; none, always.
    ///
    /// # Errors
    /// When the database refuses.
    pub async fn orphans(&self) -> Result<i64> {
        let sql = "SELECT (SELECT COUNT(*) FROM batch b WHERE b.state = 1
                AND NOT EXISTS (SELECT 1 FROM lease l WHERE l.id = b.lease_id)) +
            (SELECT COUNT(*) FROM lease l WHERE l.n <>
                (SELECT COUNT(*) FROM batch b WHERE b.lease_id = l.id AND b.state = 1))";
        self.query_one(sql, vec![]).await?.map_or(Ok(0), |row| row.int(0))
    }
}
