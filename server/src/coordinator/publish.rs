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
            let (points, baked, bytes, preview, picture) = match *result {
                PassResult::Merge { points, baked, bytes, preview, picture } => {
                    (points, baked, bytes, preview, picture)
                }
                _ => (0, 0, 0, false, false),
            };
            let name = format!("{set}.mgs");
            let (key, sha256) = (format!("{folder}/{name}"), sha256.clone());
            Output { key, name, sha256, bytes, points, baked, preview, picture }
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
