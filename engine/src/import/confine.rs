//! Files named inside a file: they must lie in its folder or below.

use std::path::{Component, Path, PathBuf};

use crate::{Error, Result};

/// The path of the file that `path` calls `name`.
///
/// # Errors
/// Invalid when the name is absolute, goes up, or leads out of the folder by a link; not found when nothing is there.
pub(super) fn beside(path: &Path, name: &str) -> Result<PathBuf> {
    let refuse = || {
        Error::invalid(format!(
            "`{}` does not lie in the folder of the file that names it",
            name.escape_debug()
        ))
        .at(path)
        .hint("put the files side by side and name them without `..` or a leading `/`")
    };
    // Exporters on Windows write backslashes
    let name = name.replace('\\', "/");
    let relative = Path::new(&name);
    let inside = |c: Component| matches!(c, Component::Normal(_) | Component::CurDir);
    let is_plain = !name.contains('\0') && !name.contains(':') && !name.is_empty();
    if !is_plain || !relative.components().all(inside) {
        return Err(refuse());
    }
    let folder = path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let target = folder.join(relative);
    let resolve = |path: &Path| path.canonicalize().map_err(|e| Error::io("open the file", path, e));
    let resolved = resolve(&target)?;
    if !resolved.starts_with(resolve(folder)?) {
        return Err(refuse());
    }
    if !resolved.is_file() {
        return Err(Error::invalid("this is not a file").at(&target));
    }
    Ok(target)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ErrorKind;

    /// Catches a name that reads a file elsewhere on the machine.
    #[test]
    fn names_stay_in_the_folder() {
        let folder = tempfile::tempdir().unwrap();
        let scene = folder.path().join("inside/scene.gltf");
        std::fs::create_dir_all(folder.path().join("inside/textures")).unwrap();
        std::fs::write(folder.path().join("outside.bin"), b"x").unwrap();
        std::fs::write(folder.path().join("inside/textures/a.png"), b"x").unwrap();
        assert!(beside(&scene, "textures/a.png").is_ok() && beside(&scene, ".\\textures\\a.png").is_ok());
        let absolute = folder.path().join("outside.bin");
        for name in
            ["../outside.bin", "textures/../../outside.bin", absolute.to_str().unwrap(), "", "C:x", "a\0"]
        {
            assert_eq!(beside(&scene, name).unwrap_err().kind(), ErrorKind::Invalid, "{name}");
        }
        assert_eq!(beside(&scene, "b.png").unwrap_err().kind(), ErrorKind::NotFound);
        assert_eq!(beside(&scene, "textures").unwrap_err().kind(), ErrorKind::Invalid);
        #[cfg(unix)]
        {
            std::os::unix::fs::symlink(&absolute, folder.path().join("inside/link.bin")).unwrap();
            assert_eq!(beside(&scene, "link.bin").unwrap_err().kind(), ErrorKind::Invalid);
        }
    }
}
