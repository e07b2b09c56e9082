//! Publication: the manifest that makes a job's results visible.

use protocol::job::{Manifest, Output};
use protocol::keys;
use protocol::work::PassResult;

use super::Coordinator;
use crate::Result;
use crate::db::graph::Publication;

/// The layout of `manifest.json`.
const VERSION: u32 = 1;

impl Coordinator {
    /// Writes the manifest. Done twice, it writes the same bytes.
    pub(super) async fn publish(&self, publication: &Publication) -> Result<()> {
        let output = |(set, folder, sha256, result): &(String, String, String, PassResult)| {
            let (points, baked, bytes) = match *result {
                PassResult::Merge { points, baked, bytes } => (points, baked, bytes),
                _ => (0, 0, 0),
            };
            let name = format!("{set}.mgs");
            Output { key: format!("{folder}/{name}"), name, sha256: sha256.clone(), bytes, points, baked }
        };
        let manifest = Manifest {
            version: VERSION,
            job: publication.job.clone(),
            name: publication.name.clone(),
            incomplete: publication.incomplete,
            outputs: publication.merges.iter().map(output).collect(),
        };
        let json = serde_json::to_vec_pretty(&manifest)?;
        self.storage.put(&keys::manifest(&publication.job), json).await
    }

    /// What a job has published; none before it has.
    ///
    /// # Errors
    /// When storage refuses or the manifest is damaged.
    pub async fn manifest(&self, job: &str) -> Result<Option<Manifest>> {
        let json = self.storage.get(&keys::manifest(job)).await?;
        Ok(json.map(|json| serde_json::from_slice(&json)).transpose()?)
    }
}
