//! The bytes of a lease by way of the coordinator: URLs are asked for, then read and written.

use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

use protocol::limits::URLS_MAX;
use protocol::storage::{FolderFile, ObjectRequest, ObjectUrl, SceneFiles, UrlsRequest};
use protocol::work::PartPage;

use crate::client::Client;
use crate::depot::{Depot, Wanted};
use crate::{Error, Result};

/// Transfers at once.
const TRANSFERS: usize = 4;

/// The bytes that one lease may reach.
#[derive(Clone, Debug)]
pub struct LeaseDepot {
    /// Whom to ask.
    pub client: Client,
    /// The worker's process.
    pub session: String,
    /// The lease.
    pub lease: String,
}

impl LeaseDepot {
    /// Where to read or write objects, up to [`URLS_MAX`].
    fn urls(&self, items: Vec<ObjectRequest>) -> Result<Vec<ObjectUrl>> {
        let (session, count) = (self.session.clone(), items.len());
        let urls = self.client.urls(&self.lease, &UrlsRequest { session, items })?.urls;
        if urls.len() != count {
            return Err(Error::Unreachable(format!("{} URLs came for {count} objects", urls.len())));
        }
        Ok(urls)
    }

    /// Uses a URL for `item`; once more with a new one where it does not hold any more, since transfers may have taken long.
    fn with_url<T>(
        &self,
        item: &ObjectRequest,
        url: &ObjectUrl,
        mut transfer: impl FnMut(&ObjectUrl) -> Result<T>,
    ) -> Result<T> {
        let again = match transfer(url) {
            Err(error) if error.status() == Some(403) && !url.url.starts_with('/') => {
                transfer(&self.urls(vec![item.clone()])?[0])
            }
            result => return result,
        };
        again.map_err(|error| match error.status() {
            Some(403) => Error::Unreachable(format!("storage: {error}")),
            _ => error,
        })
    }

    /// Reads objects whose URLs are one answer's worth, several at once.
    fn read_some(&self, wanted: &[Wanted]) -> Vec<Result<FolderFile>> {
        let items: Vec<ObjectRequest> =
            wanted.iter().map(|wanted| ObjectRequest::Get { key: wanted.key.clone() }).collect();
        let urls = match self.urls(items.clone()) {
            Ok(urls) => urls,
            Err(error) => {
                let again = |_: &Wanted| Err(error.repeated());
                return wanted.iter().map(again).collect();
            }
        };
        let next = AtomicUsize::new(0);
        let came: Mutex<Vec<Option<Result<FolderFile>>>> = Mutex::new(wanted.iter().map(|_| None).collect());
        std::thread::scope(|scope| {
            for _ in 0..TRANSFERS.min(wanted.len()) {
                scope.spawn(|| {
                    loop {
                        let number = next.fetch_add(1, Ordering::Relaxed);
                        let Some(Wanted { path, bytes_max, .. }) = wanted.get(number) else { return };
                        let result = self.with_url(&items[number], &urls[number], |url| {
                            self.client.download(url, path, *bytes_max)
                        });
                        came.lock().unwrap_or_else(PoisonError::into_inner)[number] = Some(result);
                    }
                });
            }
        });
        let lost = || Err(Error::Unreachable("the transfer was lost".into()));
        let came = came.into_inner().unwrap_or_else(PoisonError::into_inner);
        came.into_iter().map(|result| result.unwrap_or_else(lost)).collect()
    }
}

impl Depot for LeaseDepot {
    fn scene(&self) -> Result<SceneFiles> {
        self.client.lease_scene(&self.lease, &self.session)
    }

    fn read(&self, wanted: &[Wanted]) -> Vec<Result<FolderFile>> {
        wanted.chunks(URLS_MAX).flat_map(|wanted| self.read_some(wanted)).collect()
    }

    fn read_range(&self, key: &str, offset: u64, out: &mut [u8]) -> Result<()> {
        let item = ObjectRequest::Get { key: key.into() };
        let url = self.urls(vec![item.clone()])?.remove(0);
        self.with_url(&item, &url, |url| self.client.download_range(url, offset, out))
    }

    fn write(&self, key: &str, path: &Path, content: &FolderFile) -> Result<()> {
        let FolderFile { sha256, bytes } = content.clone();
        let item = ObjectRequest::Put { key: key.into(), sha256, bytes };
        let url = self.urls(vec![item.clone()])?.remove(0);
        self.with_url(&item, &url, |url| self.client.upload(url, path))
    }

    fn parts(&self, after: Option<i64>) -> Result<PartPage> {
        self.client.lease_parts(&self.lease, &self.session, after)
    }
}
