//! USDZ packages, looked at before the library opens them: it would inflate compressed files, however large, which the format
//! does not allow them to be.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

/// Bytes of the record that ends an archive, and of a comment behind it at most.
const END_BYTES: u64 = 22 + 65_535;

/// Bytes of an archive's directory that are read at most.
const DIRECTORY_BYTES_MAX: u64 = 64 << 20;

/// Says why the archive at `path` must not be opened, if so. What is no archive is for the library to refuse.
pub(super) fn check(path: &Path) -> Result<(), String> {
    let Some(directory) = File::open(path).ok().and_then(directory) else { return Ok(()) };
    let mut rest = directory.as_slice();
    while rest.len() >= 46 && rest.starts_with(b"PK\x01\x02") {
        let short = |at: usize| usize::from(u16::from_le_bytes([rest[at], rest[at + 1]]));
        let (method, name) = (short(10), short(28));
        if method != 0 {
            let name = String::from_utf8_lossy(rest.get(46..46 + name).unwrap_or_default()).into_owned();
            return Err(format!("`{name}` in the package is compressed, which USDZ does not allow"));
        }
        let bytes = 46 + name + short(30) + short(32);
        rest = rest.get(bytes..).unwrap_or_default();
    }
    Ok(())
}

/// The central directory of an archive.
fn directory(mut file: File) -> Option<Vec<u8>> {
    let size = file.seek(SeekFrom::End(0)).ok()?;
    let start = size.saturating_sub(END_BYTES);
    file.seek(SeekFrom::Start(start)).ok()?;
    let mut tail = Vec::new();
    file.by_ref().take(END_BYTES).read_to_end(&mut tail).ok()?;
    let end = tail.windows(22).rposition(|window| window.starts_with(b"PK\x05\x06"))?;
    let long = |at: usize| u64::from(u32::from_le_bytes(std::array::from_fn(|i| tail[end + at + i])));
    let (bytes, offset) = (long(12), long(16));
    file.seek(SeekFrom::Start(offset)).ok()?;
    let mut directory = Vec::new();
    file.take(bytes.min(DIRECTORY_BYTES_MAX)).read_to_end(&mut directory).ok()?;
    Some(directory)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An archive of one empty file, packed by a method.
    fn archive(method: u8) -> Vec<u8> {
        let mut local = [0; 30];
        local[..4].copy_from_slice(b"PK\x03\x04");
        (local[8], local[26]) = (method, 6);
        let mut central = [0; 46];
        central[..4].copy_from_slice(b"PK\x01\x02");
        (central[10], central[28]) = (method, 6);
        let mut end = [0; 22];
        end[..4].copy_from_slice(b"PK\x05\x06");
        (end[8], end[10], end[12], end[16]) = (1, 1, 52, 36);
        [&local[..], b"a.usda", &central, b"a.usda", &end].concat()
    }

    /// Catches a compressed file that is let through, and a package as it should be that is not.
    #[test]
    fn compressed_packages_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.usdz");
        let check = |bytes: &[u8]| {
            std::fs::write(&path, bytes).unwrap();
            check(&path)
        };
        assert_eq!(check(&archive(0)), Ok(()));
        assert!(check(&archive(8)).unwrap_err().contains("`a.usda`"));
        assert!(check(&[&archive(8)[..], &[0; 500]].concat()).is_err());
        assert!(check(b"no archive").is_ok() && check(&archive(8)[..60]).is_ok());
    }
}
