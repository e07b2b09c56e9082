//! Keys of objects in storage: the only place where they are spelled.
//!
//! Every key that a worker writes holds the fence of its claim, so two claims of one batch never write the same object.

/// An uploaded file, by the SHA-256 of its content in hexadecimal.
pub fn asset(sha256: &str) -> String {
    format!("assets/{}/{sha256}", &sha256[..2])
}

/// A brick map, by its content key; shared by all jobs on the same occluders.
pub fn brick_map(key: &str) -> String {
    format!("brickmaps/{key}")
}

/// Everything of a job.
pub fn job(job: &str) -> String {
    format!("jobs/{job}")
}

/// The folder of a job's scene and the files that were uploaded with it.
pub fn scene_folder(job: &str) -> String {
    format!("jobs/{job}/scene")
}

/// A job's scene.
pub fn scene(job: &str) -> String {
    format!("jobs/{job}/scene/scene.xml")
}

/// The folder in which one claim of a pass with a single batch leaves its result.
pub fn result_folder(job: &str, pass: i64, fence: i64) -> String {
    format!("jobs/{job}/p{pass}/f{fence}")
}

/// What a folder in storage holds, written last: a [`FolderIndex`](crate::storage::FolderIndex).
pub fn index(folder: &str) -> String {
    format!("{folder}/index.json")
}

/// A batch's part; the first 16 digits of its hash keep apart what ought to be equal.
pub fn part(job: &str, pass: i64, batch: i64, fence: i64, sha256: &str) -> String {
    format!("jobs/{job}/p{pass}/b{batch:08}/f{fence}-{}.part", &sha256[..16])
}

/// The log of one claim of a batch.
pub fn log(job: &str, pass: i64, batch: i64, fence: i64) -> String {
    format!("jobs/{job}/logs/p{pass}/b{batch:08}-f{fence}.log")
}

/// The preview of a bake pass that is under way, as it was at a moment.
pub fn provisional(job: &str, pass: i64, made_at: i64) -> String {
    format!("jobs/{job}/provisional/p{pass}-{made_at}.preview")
}

/// What a job published.
pub fn manifest(job: &str) -> String {
    format!("jobs/{job}/manifest.json")
}

/// Whether `text` is a SHA-256 in lower-case hexadecimal.
pub fn is_sha256(text: &str) -> bool {
    text.len() == 64 && text.bytes().all(|b| b.is_ascii_digit() || (b'a'..=b'f').contains(&b))
}

/// Whether `path` is a plain relative path: names and slashes only, no `.` or `..`, nothing hidden from Windows.
pub fn is_relative(path: &str) -> bool {
    let plain = |name: &str| !name.is_empty() && name != "." && name != "..";
    path.len() <= 1024
        && !path.chars().any(|c| c.is_control() || c == '\\' || c == ':')
        && path.split('/').all(plain)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a path by which an upload would land outside its job's folder.
    #[test]
    fn relative_paths_stay_inside() {
        assert!(is_relative("trees/oak.mgs"));
        for path in ["", "/a", "a/", "a//b", "../a", "a/../b", "./a", "c:a", "a\\b", "a\0"] {
            assert!(!is_relative(path), "{path:?}");
        }
    }

    /// Catches a hash that is none and would cut a key short.
    #[test]
    fn hashes_are_checked_before_they_become_keys() {
        assert!(is_sha256(&"0a".repeat(32)));
        for text in ["", "ab", &"0A".repeat(32), &"zz".repeat(32), &"é".repeat(32)] {
            assert!(!is_sha256(text));
        }
    }
}
