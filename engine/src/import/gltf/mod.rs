//! stub
use super::*;
pub(super) fn import(path: &Path, _: &ImportOptions, _: &mut dyn GridSink) -> Result<ImportReport> {
    Err(Error::unsupported("glTF is not supported yet").at(path))
}
