//! How workers reach bytes: for each object of a lease they ask for a URL, and never touch storage themselves.
//!
//! A URL that begins with `/` is the coordinator's own: it is asked with the worker's token. Any other is signed by the
//! storage and gets no token. Both hold for [`URL_TTL_MS`](crate::limits::URL_TTL_MS).

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// A worker asks where objects are read and written: `POST /v1/leases/{id}/urls`.
#[derive(Clone, Debug, Serialize, Deserialize, ToSchema)]
pub struct UrlsRequest {
    /// The process.
    pub session: String,
    /// Objects, up to [`URLS_MAX`](crate::limits::URLS_MAX).
    pub items: Vec<ObjectRequest>,
}

/// An object and what is to be done with it. Keys are those of [`crate::keys`] that the lease's task leads to.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(tag = "operation", rename_all = "snake_case")]
pub enum ObjectRequest {
    /// Read it.
    Get {
        /// Its key.
        key: String,
    },
    /// Write it.
    Put {
        /// Its key.
        key: String,
        /// SHA-256 of the bytes in hexadecimal.
        sha256: String,
        /// How many bytes.
        bytes: u64,
    },
}

/// URLs, in the order of the objects.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct UrlsReply {
    /// One for each object.
    pub urls: Vec<ObjectUrl>,
}

/// Where an object is read or written.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct ObjectUrl {
    /// The URL, for GET or PUT as was asked.
    pub url: String,
    /// Headers that must go with it.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub headers: BTreeMap<String, String>,
}

/// A job's scene as it was submitted: `GET /v1/leases/{id}/scene`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct SceneFiles {
    /// The scene, XML.
    pub scene: String,
    /// Files beside it: relative path to SHA-256 of an uploaded asset, whose key is that of [`crate::keys::asset`].
    pub files: BTreeMap<String, String>,
}

/// What a folder in storage holds: its last object, [`crate::keys::index`]. Where it is, the folder is whole.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct FolderIndex {
    /// The layout's version, 1.
    pub version: u32,
    /// Files by relative path.
    pub files: BTreeMap<String, FolderFile>,
}

/// A file of a folder in storage.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct FolderFile {
    /// SHA-256 in hexadecimal.
    pub sha256: String,
    /// Bytes.
    pub bytes: u64,
}
