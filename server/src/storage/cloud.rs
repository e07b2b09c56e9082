//! Objects in S3 and its like, Google Cloud Storage or Azure: opened by URL, reached by others with signed URLs.
//!
//! Credentials, region and endpoint come from the environment, as each provider's own tools read it (`AWS_…`, `GOOGLE_…`,
//! `AZURE_…`), and from options, which win. An endpoint that begins with `http://` is asked without TLS.

use std::collections::BTreeMap;
use std::fmt::{Debug, Display};
use std::sync::Arc;
use std::time::Duration;

use axum::http::header::{HeaderName, HeaderValue};
use object_store::aws::{AmazonS3Builder, AmazonS3ConfigKey};
use object_store::azure::{AzureConfigKey, MicrosoftAzureBuilder};
use object_store::gcp::{GoogleCloudStorageBuilder, GoogleConfigKey};
use object_store::path::Path;
use object_store::prefix::PrefixStore;
use object_store::signer::{Method, SignedUrlOptions, Signer};
use object_store::{ClientConfigKey, ObjectStore, RetryConfig};
use protocol::storage::ObjectUrl;

use super::{Expected, Storage};
use crate::{Error, Result};

/// Bytes that one request can put at most: the least of what the providers allow, and some less.
const PUT_BYTES_MAX: u64 = 4 << 30;
/// Time in which a request is repeated: whoever waits for us gives up after 30 s.
const PATIENCE: Duration = Duration::from_secs(20);
/// How long a connection may take, and how long nothing may come. What comes at all may take its time.
const TIMEOUTS: [(ClientConfigKey, &str); 3] = [
    (ClientConfigKey::ConnectTimeout, "5 seconds"),
    (ClientConfigKey::ReadTimeout, "20 seconds"),
    (ClientConfigKey::Timeout, "86400 seconds"),
];

/// What signs URLs, and what its provider wants besides.
#[derive(Clone, Debug)]
pub(super) struct Cloud {
    signer: Arc<dyn Signer>,
    provider: Provider,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Provider {
    S3,
    Google,
    Azure,
}

/// A builder of one provider, with our timeouts and the caller's options.
macro_rules! set_up {
    ($builder:ty, $key:ident, $place:expr, $options:expr, $endpoints:expr) => {{
        let mut builder = <$builder>::from_env().with_url($place);
        for (key, value) in TIMEOUTS {
            builder = builder.with_config($key::Client(key), value);
        }
        for (name, value) in $options {
            let key: $key = name.parse().map_err(|_| unknown_option(name))?;
            builder = builder.with_config(key, value);
        }
        let endpoints: &[$key] = $endpoints;
        let is_plain = |key| builder.get_config_value(key).is_some_and(|url| url.starts_with("http://"));
        if endpoints.iter().any(is_plain) {
            builder = builder.with_config($key::Client(ClientConfigKey::AllowHttp), "true");
        }
        let retry = RetryConfig { retry_timeout: PATIENCE, ..RetryConfig::default() };
        builder.with_retry(retry).build().map_err(|error| unusable($place, &error))?
    }};
}

/// Opens the storage at a URL such as `s3://bucket/prefix`.
pub(super) fn open(place: &str, options: &BTreeMap<String, String>) -> Result<Storage> {
    // Another part of the process may have done it
    let _ = rustls::crypto::ring::default_provider().install_default();
    let (scheme, rest) = place.split_once("://").unwrap_or_default();
    let prefix = rest.split_once('/').map_or("", |(_, prefix)| prefix);
    let prefix = Path::parse(prefix.trim_matches('/')).map_err(|error| unusable(place, &error))?;
    match scheme {
        "s3" | "s3a" => {
            let endpoints = &[AmazonS3ConfigKey::Endpoint];
            let store = set_up!(AmazonS3Builder, AmazonS3ConfigKey, place, options, endpoints);
            Ok(below(store, prefix, Provider::S3))
        }
        "gs" => {
            let endpoints = &[GoogleConfigKey::BaseUrl];
            let store = set_up!(GoogleCloudStorageBuilder, GoogleConfigKey, place, options, endpoints);
            Ok(below(store, prefix, Provider::Google))
        }
        "az" | "azure" | "abfs" | "abfss" => {
            let endpoints = &[AzureConfigKey::Endpoint];
            let store = set_up!(MicrosoftAzureBuilder, AzureConfigKey, place, options, endpoints);
            Ok(below(store, prefix, Provider::Azure))
        }
        other => {
            Err(Error::invalid(format!("`{other}` is no storage that is known")).hint("`s3`, `gs` or `az`"))
        }
    }
}

/// The part of a bucket below `prefix`, which may be all of it.
fn below<S: ObjectStore + Signer>(store: S, prefix: Path, provider: Provider) -> Storage {
    let store = Arc::new(PrefixStore::new(store, prefix));
    Storage { store: store.clone(), cloud: Some(Cloud { signer: store, provider }) }
}

fn unusable(place: &str, error: &dyn Display) -> Error {
    Error::invalid(format!("`{place}` cannot be used as storage: {error}"))
        .hint("docs/operations.md says what the environment must hold")
}

fn unknown_option(name: &str) -> Error {
    Error::invalid(format!("storage has no option `{name}`"))
        .hint("they are called as in the environment, such as `aws_endpoint`")
}

impl Cloud {
    /// Where an object can be read.
    pub async fn get_url(&self, path: &Path, ttl: Duration) -> Result<ObjectUrl> {
        let url = self.signer.signed_url(Method::GET, path, ttl).await?;
        Ok(ObjectUrl { url: url.into(), headers: BTreeMap::new() })
    }

    /// Where an object can be written; none where it is too large for one request. S3 holds what comes against its hash.
    pub async fn put_url(
        &self,
        path: &Path,
        expected: Expected<'_>,
        ttl: Duration,
    ) -> Result<Option<ObjectUrl>> {
        if expected.bytes.is_none_or(|bytes| bytes > PUT_BYTES_MAX) {
            return Ok(None);
        }
        let (mut options, mut headers) = (SignedUrlOptions::default(), BTreeMap::new());
        if self.provider == Provider::S3 {
            let (name, value) = ("x-amz-checksum-sha256", base64(expected.sha256));
            let signed = HeaderValue::from_str(&value).map_err(|_| Error::invalid("this is no hash"))?;
            options = options.with_signed_header(HeaderName::from_static(name), signed);
            headers.insert(name.into(), value);
        }
        if self.provider == Provider::Azure {
            headers.insert("x-ms-blob-type".into(), "BlockBlob".into());
        }
        let url = self.signer.signed_url_opts(Method::PUT, path, ttl, &options).await?.into();
        Ok(Some(ObjectUrl { url, headers }))
    }
}

/// Hexadecimal digits as base64.
fn base64(hex: &str) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let nibble = |digit: u8| char::from(digit).to_digit(16).unwrap_or_default();
    let mut text = String::with_capacity(hex.len() * 2 / 3 + 4);
    // Three hexadecimal digits are two of base64
    for digits in hex.as_bytes().chunks(3) {
        let bits = (0..3).fold(0, |bits, at| bits << 4 | digits.get(at).map_or(0, |&digit| nibble(digit)));
        let count = if digits.len() == 1 { 1 } else { 2 };
        (0..count).for_each(|at| text.push(char::from(DIGITS[(bits >> (6 - 6 * at) & 63) as usize])));
    }
    while !text.len().is_multiple_of(4) {
        text.push('=');
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn options(pairs: &[(&str, &str)]) -> BTreeMap<String, String> {
        pairs.iter().map(|&(name, value)| (name.into(), value.into())).collect()
    }

    fn expected(bytes: u64) -> Expected<'static> {
        let sha256 = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855";
        Expected { sha256, bytes: Some(bytes), bytes_max: u64::MAX }
    }

    /// Catches a hash that S3 would hold against another: that of nothing, as S3's own documentation spells it.
    #[test]
    fn hashes_become_base64() {
        assert_eq!(base64(expected(0).sha256), "47DEQpj8HBSa+/TImW+5JCeuQeRkm5NMpJWZG3hSuFU=");
        assert_eq!(base64("66"), "Zg==");
        assert_eq!(base64("666f"), "Zm8=");
    }

    /// Catches a prefix or an endpoint that URLs leave out, a hash that is not signed, and a put that is too large for one
    /// request.
    #[tokio::test]
    async fn urls_are_signed_below_the_prefix() {
        let options = options(&[
            ("aws_endpoint", "http://127.0.0.1:9"),
            ("aws_access_key_id", "a"),
            ("aws_secret_access_key", "b"),
        ]);
        let storage = open("s3://bucket/films/one/", &options).unwrap();
        let (cloud, key, ttl) = (storage.cloud.unwrap(), Path::from("a/b"), Duration::from_secs(60));
        let get = cloud.get_url(&key, ttl).await.unwrap();
        assert!(get.url.starts_with("http://127.0.0.1:9/bucket/films/one/a/b?"), "{}", get.url);
        let put = cloud.put_url(&key, expected(5), ttl).await.unwrap().unwrap();
        assert!(put.url.contains("X-Amz-SignedHeaders=host%3Bx-amz-checksum-sha256"), "{}", put.url);
        assert_eq!(put.headers["x-amz-checksum-sha256"], base64(expected(5).sha256));
        assert!(cloud.put_url(&key, expected(PUT_BYTES_MAX + 1), ttl).await.unwrap().is_none());
    }

    /// Catches an Azure upload without the header that it wants.
    #[tokio::test]
    async fn azure_is_told_what_sort_of_blob_comes() {
        let key = "Eby8vdM02xNOcqFlqUwJPLlmEtlCDXJ1OUzFT50uSRZ6IFsuFq2UVErCz4I6tq/K1SZFPTOtr/KBHBeksoGMGw==";
        let options = options(&[("azure_storage_account_name", "films"), ("azure_storage_account_key", key)]);
        let cloud = open("az://container", &options).unwrap().cloud.unwrap();
        let put = cloud.put_url(&Path::from("a"), expected(5), Duration::from_secs(60)).await.unwrap();
        let put = put.unwrap();
        assert!(put.url.starts_with("https://films.blob.core.windows.net/container/a?"), "{}", put.url);
        assert_eq!(put.headers["x-ms-blob-type"], "BlockBlob");
    }

    /// Catches options and schemes that are misspelt and passed over.
    #[test]
    fn what_is_not_known_is_refused() {
        assert!(open("s3://bucket", &options(&[("aws_endpiont", "x")])).is_err());
        assert!(open("ftp://bucket", &BTreeMap::new()).is_err());
    }
}
