//! Objects: a local folder, or S3, Google Cloud Storage or Azure. Keys come from [`protocol::keys`]; an object appears
//! whole or not at all.

mod cloud;

use std::collections::BTreeMap;
use std::path::Path as FilePath;
use std::sync::Arc;
use std::time::Duration;

use axum::body::{Body, Bytes};
use futures_util::{StreamExt, TryStreamExt};
use object_store::path::Path;
use object_store::{GetOptions, GetRange, ObjectMeta, ObjectStore, ObjectStoreExt, WriteMultipart};
use protocol::storage::ObjectUrl;
use sha2::{Digest, Sha256};

use self::cloud::Cloud;
use crate::error::Kind;
use crate::{Error, Result};

/// Bytes of an object that is read whole at most: scenes, manifests, logs.
const SMALL_BYTES_MAX: u64 = 64 << 20;
/// Parts of one upload that are on their way to storage at once.
const PARTS_IN_FLIGHT: usize = 4;

/// Bytes of a part of an upload at least; larger ones where there would be more parts than storage takes.
const PART_BYTES_MIN: u64 = 8 << 20;
/// Parts of an upload at most.
const PARTS_MAX: u64 = 9_000;
/// Time that storage has to show itself when it is opened.
const FIRST_ANSWER: Duration = Duration::from_secs(30);

/// Where objects are.
#[derive(Clone, Debug)]
pub struct Storage {
    store: Arc<dyn ObjectStore>,
    /// Signs URLs; none for a local folder, whose bytes go through the coordinator.
    cloud: Option<Cloud>,
}

/// What an upload must turn out to be.
#[derive(Clone, Copy, Debug)]
pub struct Expected<'a> {
    /// SHA-256 in hexadecimal.
    pub sha256: &'a str,
    /// How many bytes, where that is known.
    pub bytes: Option<u64>,
    /// Bytes at most.
    pub bytes_max: u64,
}

/// An object on its way out.
pub struct Outgoing {
    /// Its bytes, or a range of them.
    pub body: Body,
    /// The range.
    pub range: std::ops::Range<u64>,
    /// Bytes of the whole object.
    pub bytes: u64,
}

impl Storage {
    /// Opens a folder, which is made if need be, or the storage at a URL such as `s3://bucket/prefix`. `options` are those
    /// of the provider, called as in the environment: `aws_endpoint` and so on.
    ///
    /// # Errors
    /// When the folder cannot be made, or the URL or an option is not understood.
    pub fn open(place: &str, options: &BTreeMap<String, String>) -> Result<Self> {
        if place.contains("://") {
            return cloud::open(place, options);
        }
        std::fs::create_dir_all(place)?;
        let folder = FilePath::new(place).canonicalize()?;
        let local = object_store::local::LocalFileSystem::new_with_prefix(folder)?;
        let local = local.with_fsync(true).with_automatic_cleanup(true);
        Ok(Self { store: Arc::new(local), cloud: None })
    }

    /// Looks whether storage answers: wrong credentials or a bucket that is not there are better known at once.
    ///
    /// # Errors
    /// [`Kind::Invalid`] with the storage's own words.
    pub async fn probe(&self) -> Result<()> {
        let mut found = self.store.list(Some(&Path::from("assets")));
        let answer = tokio::time::timeout(FIRST_ANSWER, found.next()).await;
        let words = match answer {
            Ok(None | Some(Ok(_))) => return Ok(()),
            Ok(Some(Err(error))) => error.to_string(),
            Err(_) => "no answer".into(),
        };
        Err(Error::invalid(format!("storage cannot be used: {words}"))
            .hint("are bucket, endpoint and credentials right, and may they list, read, write and delete?"))
    }

    /// A URL at which the object can be read without us; none for a local folder.
    ///
    /// # Errors
    /// When it cannot be signed.
    pub async fn get_url(&self, key: &str, ttl: Duration) -> Result<Option<ObjectUrl>> {
        let Some(cloud) = &self.cloud else { return Ok(None) };
        cloud.get_url(&path(key)?, ttl).await.map(Some)
    }

    /// A URL at which the object can be written without us; none for a local folder, or where it is too large for that.
    ///
    /// # Errors
    /// When it cannot be signed.
    pub async fn put_url(
        &self,
        key: &str,
        expected: Expected<'_>,
        ttl: Duration,
    ) -> Result<Option<ObjectUrl>> {
        let Some(cloud) = &self.cloud else { return Ok(None) };
        cloud.put_url(&path(key)?, expected, ttl).await
    }

    /// Writes a small object.
    ///
    /// # Errors
    /// When storage refuses.
    pub async fn put(&self, key: &str, bytes: impl Into<Bytes>) -> Result<()> {
        self.store.put(&path(key)?, bytes.into().into()).await?;
        Ok(())
    }

    /// Reads a small object; none where there is none.
    ///
    /// # Errors
    /// When storage refuses, or the object is not small.
    pub async fn get(&self, key: &str) -> Result<Option<Bytes>> {
        let found = match self.store.get(&path(key)?).await {
            Err(object_store::Error::NotFound { .. }) => return Ok(None),
            found => found?,
        };
        if found.meta.size > SMALL_BYTES_MAX {
            return Err(Error::new(Kind::TooLarge, format!("`{key}` has {} bytes", found.meta.size)));
        }
        Ok(Some(found.bytes().await?))
    }

    /// An object's bytes; none where there is none.
    ///
    /// # Errors
    /// When storage refuses.
    pub async fn bytes(&self, key: &str) -> Result<Option<u64>> {
        match self.store.head(&path(key)?).await {
            Err(object_store::Error::NotFound { .. }) => Ok(None),
            found => Ok(Some(found?.size)),
        }
    }

    /// Streams an upload to an object, which appears if the upload is what it must be.
    ///
    /// # Errors
    /// [`Kind::Invalid`] where it is not, [`Kind::TooLarge`] beyond the limit.
    pub async fn receive(&self, key: &str, body: Body, expected: Expected<'_>) -> Result<u64> {
        let part_bytes = expected.bytes.unwrap_or(expected.bytes_max).div_ceil(PARTS_MAX).max(PART_BYTES_MIN);
        let upload = self.store.put_multipart(&path(key)?).await?;
        let mut upload = WriteMultipart::new_with_chunk_size(upload, part_bytes as usize);
        match receive(&mut upload, body, expected).await {
            Ok(bytes) => {
                upload.finish().await?;
                Ok(bytes)
            }
            Err(error) => {
                // What cannot be taken back now is, when storage cleans up after itself
                let _ = upload.abort().await;
                Err(error)
            }
        }
    }

    /// An object, or a range of it, as a stream.
    ///
    /// # Errors
    /// [`Kind::NotFound`]; [`Kind::Range`] when it has no such range.
    pub async fn send(&self, key: &str, range: Option<GetRange>) -> Result<Outgoing> {
        let options = GetOptions { range: range.clone(), ..GetOptions::default() };
        let found = match self.store.get_opts(&path(key)?, options).await {
            Err(object_store::Error::NotFound { .. }) => return Err(Error::not_found("object", key)),
            Err(error) if range.is_some() && self.bytes(key).await?.is_some() => {
                tracing::debug!(%error, "a range");
                return Err(Error::new(Kind::Range, format!("`{key}` has no such range")));
            }
            found => found?,
        };
        let (range, bytes) = (found.range.clone(), found.meta.size);
        Ok(Outgoing { body: Body::from_stream(found.into_stream()), range, bytes })
    }

    /// Objects below a folder.
    pub fn list(&self, folder: &str) -> futures_util::stream::BoxStream<'static, Result<ObjectMeta>> {
        self.store.list(Some(&Path::from(folder))).map_err(Error::from).boxed()
    }

    /// The names of folders in a folder.
    ///
    /// # Errors
    /// When storage refuses.
    pub async fn folders(&self, folder: &str) -> Result<Vec<String>> {
        let found = self.store.list_with_delimiter(Some(&Path::from(folder))).await?;
        Ok(found.common_prefixes.iter().filter_map(|path| path.filename().map(str::to_owned)).collect())
    }

    /// Removes an object; one that is not there is no error.
    ///
    /// # Errors
    /// When storage refuses.
    pub async fn remove(&self, key: &Path) -> Result<()> {
        match self.store.delete(key).await {
            Ok(()) | Err(object_store::Error::NotFound { .. }) => Ok(()),
            Err(error) => Err(error.into()),
        }
    }
}

async fn receive(upload: &mut WriteMultipart, body: Body, expected: Expected<'_>) -> Result<u64> {
    let (mut hash, mut bytes) = (Sha256::new(), 0_u64);
    let mut stream = body.into_data_stream();
    while let Some(chunk) = stream.next().await {
        let chunk = chunk.map_err(|_| Error::invalid("the upload ended early"))?;
        bytes += chunk.len() as u64;
        let bytes_max = expected.bytes.unwrap_or(expected.bytes_max).min(expected.bytes_max);
        if bytes > bytes_max {
            return Err(Error::new(Kind::TooLarge, format!("the upload has more than `{bytes_max}` bytes")));
        }
        hash.update(&chunk);
        upload.wait_for_capacity(PARTS_IN_FLIGHT).await?;
        upload.put(chunk);
    }
    if let Some(wanted) = expected.bytes.filter(|&wanted| wanted != bytes) {
        return Err(Error::invalid(format!("the upload has `{bytes}` bytes, `{wanted}` were announced")));
    }
    let actual = hex(&hash.finalize());
    if actual != expected.sha256 {
        let message = format!("the upload's SHA-256 is `{actual}`, not `{}`", expected.sha256);
        return Err(Error::invalid(message));
    }
    Ok(bytes)
}

/// The path of a key; characters that storage cannot have are written in hexadecimal.
fn path(key: &str) -> Result<Path> {
    match protocol::keys::is_relative(key) {
        true => Ok(Path::from(key)),
        false => Err(Error::invalid(format!("`{key}` is not a key"))),
    }
}

/// Bytes in lower-case hexadecimal.
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// The SHA-256 of some bytes, in hexadecimal.
pub fn sha256(bytes: &[u8]) -> String {
    hex(&Sha256::digest(bytes))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn expected(text: &str, bytes: Option<u64>) -> (String, Option<u64>) {
        (sha256(text.as_bytes()), bytes)
    }

    /// Catches an upload that is accepted though it is not what was announced, or that leaves something behind.
    #[tokio::test]
    async fn an_upload_appears_only_if_it_is_what_was_announced() {
        let folder = tempfile::tempdir().unwrap();
        let storage = Storage::open(folder.path().to_str().unwrap(), &BTreeMap::new()).unwrap();
        let cases = [
            (expected("ab", Some(2)), true),
            (expected("ab", Some(3)), false),
            (expected("xy", None), false),
        ];
        for (number, ((sha256, bytes), good)) in cases.into_iter().enumerate() {
            let key = format!("a/{number}");
            let expected = Expected { sha256: &sha256, bytes, bytes_max: 100 };
            let result = storage.receive(&key, Body::from("ab"), expected).await;
            assert_eq!(result.is_ok(), good, "{number}: {result:?}");
            assert_eq!(storage.bytes(&key).await.unwrap(), good.then_some(2));
        }
        let (sha256, _) = expected("ab", None);
        let small = Expected { sha256: &sha256, bytes: None, bytes_max: 1 };
        let error = storage.receive("a/b", Body::from("ab"), small).await.unwrap_err();
        assert_eq!(error.kind, Kind::TooLarge);
        let left: Vec<_> = std::fs::read_dir(folder.path().join("a")).unwrap().collect();
        assert_eq!(left.len(), 1, "{left:?}");
    }

    /// Catches ranges that are off by one, and a range beyond the end that is answered as if it were there.
    #[tokio::test]
    async fn ranges_are_exact() {
        let folder = tempfile::tempdir().unwrap();
        let storage = Storage::open(folder.path().to_str().unwrap(), &BTreeMap::new()).unwrap();
        storage.put("k", "0123456789").await.unwrap();
        let outgoing = storage.send("k", Some(GetRange::Bounded(2..5))).await.unwrap();
        let bytes = axum::body::to_bytes(outgoing.body, 100).await.unwrap();
        assert_eq!((&bytes[..], outgoing.range, outgoing.bytes), (&b"234"[..], 2..5, 10));
        assert_eq!(storage.send("k", Some(GetRange::Offset(10))).await.err().unwrap().kind, Kind::Range);
        assert_eq!(storage.send("l", None).await.err().unwrap().kind, Kind::NotFound);
    }
}
