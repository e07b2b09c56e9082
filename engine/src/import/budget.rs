//! What an import may hold in memory, and the error for a file that needs more.

use std::path::{Path, PathBuf};

use crate::{Error, ErrorKind, Result};

const MIB: u64 = 1 << 20;

/// A limit on bytes held at once, and the bytes held now.
#[derive(Debug)]
pub(super) struct Budget {
    limit: u64,
    held: u64,
    path: PathBuf,
}

impl Budget {
    /// A budget of `limit` bytes for the import of `path`.
    pub fn new(limit: u64, path: &Path) -> Self {
        Self { limit, held: 0, path: path.to_path_buf() }
    }

    /// Takes `bytes` for `what`, before they are allocated.
    pub fn take(&mut self, bytes: u64, what: &str) -> Result<()> {
        let need = self.held.saturating_add(bytes);
        self.check(need, what)?;
        self.held = need;
        Ok(())
    }

    /// Refuses a need of `bytes`, all together, that `what` would cause.
    pub fn check(&self, bytes: u64, what: &str) -> Result<()> {
        if bytes <= self.limit {
            return Ok(());
        }
        let (need, have) = (bytes.div_ceil(MIB), self.limit / MIB);
        let message = format!("{what} would take the import to {need} MiB, {have} MiB are allowed");
        Err(Error::new(ErrorKind::Limit, message)
            .at(&self.path)
            .hint("allow more memory (`--memory`), or cut the file into parts"))
    }

    /// Bytes held now.
    pub fn held(&self) -> u64 {
        self.held
    }

    /// Gives back `bytes`.
    pub fn give(&mut self, bytes: u64) {
        self.held = self.held.saturating_sub(bytes);
    }

    /// Bytes that may still be taken.
    pub fn left(&self) -> u64 {
        self.limit.saturating_sub(self.held)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a need that wraps around, and a refusal without a way out.
    #[test]
    fn a_need_beyond_the_limit_is_refused_with_a_hint() {
        let mut budget = Budget::new(10 * MIB, Path::new("a.ply"));
        budget.take(6 * MIB, "positions").unwrap();
        for bytes in [5 * MIB, u64::MAX] {
            let error = budget.take(bytes, "faces").unwrap_err();
            assert_eq!(error.kind(), ErrorKind::Limit);
            assert!(error.hint_text().is_some());
        }
        budget.give(6 * MIB);
        budget.take(10 * MIB, "faces").unwrap();
    }
}
