//! SHA-256, the name by which farm and storage know bytes.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use engine::Error;
use protocol::storage::FolderFile;
use sha2::{Digest, Sha256};

/// A hash that grows as bytes pass by.
#[derive(Default)]
pub struct Hasher {
    hash: Sha256,
    bytes: u64,
}

impl Hasher {
    /// Adds bytes.
    pub fn update(&mut self, bytes: &[u8]) {
        self.hash.update(bytes);
        self.bytes += bytes.len() as u64;
    }

    /// Bytes so far.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// The hash and the number of all bytes.
    pub fn finish(self) -> FolderFile {
        let digits = self.hash.finalize();
        FolderFile { sha256: digits.iter().map(|byte| format!("{byte:02x}")).collect(), bytes: self.bytes }
    }
}

/// The hash of bytes in memory.
pub fn of_bytes(bytes: &[u8]) -> FolderFile {
    let mut hasher = Hasher::default();
    hasher.update(bytes);
    hasher.finish()
}

/// The hash of a file's content.
///
/// # Errors
/// When it cannot be read.
pub fn of_file(path: &Path) -> engine::Result<FolderFile> {
    let io = |error| Error::io("read", path, error);
    let mut file = File::open(path).map_err(io)?;
    let mut hasher = Hasher::default();
    let mut buffer = vec![0; 1 << 18];
    loop {
        match file.read(&mut buffer).map_err(io)? {
            0 => return Ok(hasher.finish()),
            count => hasher.update(&buffer[..count]),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a hash that other programs do not know, and a file that hashes otherwise than its bytes.
    #[test]
    fn hashes_are_those_of_the_standard() {
        let known = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        assert_eq!(of_bytes(b"abc"), FolderFile { sha256: known.into(), bytes: 3 });
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("abc");
        std::fs::write(&path, b"abc").unwrap();
        assert_eq!(of_file(&path).unwrap(), of_bytes(b"abc"));
    }
}
