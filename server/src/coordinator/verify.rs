//! What a worker says it has put must be there, with the length that it says: checked before a result counts.

use futures_util::{StreamExt, TryStreamExt};
use protocol::work::{CompleteItem, CompleteRequest, Outcome, Task};
use protocol::{FailureClass, PassKind, keys};

use super::Coordinator;
use crate::Result;

/// Objects that are looked at at once.
const LOOKS: usize = 16;

impl Coordinator {
    /// The items of a report; those whose object is not there, or has another length, as failures.
    pub(super) async fn verified(&self, request: &CompleteRequest) -> Result<Vec<CompleteItem>> {
        let task = self.task(request.pass).await?;
        let (task, pass) = (&*task, request.pass);
        let items = futures_util::stream::iter(request.items.clone());
        items.map(|item| self.checked(task, pass, item)).buffered(LOOKS).try_collect().await
    }

    async fn checked(&self, task: &Task, pass: i64, item: CompleteItem) -> Result<CompleteItem> {
        let Outcome::Done { sha256, bytes, .. } = &item.outcome else { return Ok(item) };
        let folder = keys::result_folder(&task.job, pass, item.fence);
        let (key, wanted) = match (task.kind, &task.map, &task.set) {
            // A batch without points has no part
            (PassKind::Bake, ..) if *bytes == 0 => return Ok(item),
            (PassKind::Bake, ..) => {
                (keys::part(&task.job, pass, item.batch, item.fence, sha256), Some(*bytes as u64))
            }
            (PassKind::Merge, _, Some(set)) => (format!("{folder}/{set}.mgs"), Some(*bytes as u64)),
            (PassKind::Build, Some(map), _) => (keys::index(&keys::brick_map(map)), None),
            _ => (keys::index(&folder), None),
        };
        let found = self.storage.bytes(&key).await?;
        if found.is_some() && wanted.is_none_or(|wanted| found == Some(wanted)) {
            return Ok(item);
        }
        let found = found.map_or("is not there".to_owned(), |found| format!("has {found} bytes"));
        let message = format!("`{key}` {found}");
        let (class, bad_parts) = (FailureClass::Verify, Vec::new());
        Ok(CompleteItem { outcome: Outcome::Failed { class, message, bad_parts }, ..item })
    }
}
