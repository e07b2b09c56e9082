//! Tests of the part log: interrupted, torn and damaged logs continue, foreign ones are refused.

use super::super::part::tests::{format, part};
use super::*;
use std::fs;

/// The part of a batch of three points.
fn small(batch: u32) -> Part {
    let first = 10 * u64::from(batch);
    part(&format(), batch, &[first + 2, first, first + 5], |_| false)
}

fn all(log: &mut PartLog) -> Result<Vec<u32>> {
    log.rewind()?;
    let (mut batches, mut read) = (Vec::new(), Part::default());
    while log.next(&mut read)? {
        let mut expected = small(read.batch).indices;
        expected.sort();
        assert_eq!(read.indices, expected);
        batches.push(read.batch);
    }
    Ok(batches)
}

/// A log of batches 4, 0, 2, 7 of ten, and where each frame begins, and the end.
fn filled(path: &Path) -> Vec<usize> {
    let mut log = PartLog::open(path, &format(), 10).expect("a log");
    let mut borders = vec![log.end as usize];
    for batch in [4, 0, 2, 7] {
        log.append(&small(batch)).expect("appended");
        borders.push(log.end as usize);
    }
    borders
}

/// Catches parts that are lost or changed over closing and opening, and batches that are baked again.
#[test]
fn a_closed_log_continues() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("trees.parts");
    filled(&path);
    let mut log = PartLog::open(&path, &format(), 10).expect("a log");
    assert_eq!(log.recovery(), Recovery { parts: 4, damaged: 0, truncated_bytes: 0 });
    assert_eq!(all(&mut log).expect("read"), [0, 2, 4, 7]);
    log.append(&small(9)).expect("appended");
    assert_eq!(all(&mut log).expect("read"), [0, 2, 4, 7, 9]);
    assert_eq!(log.completed().count(), 5);
    assert!(log.completed().contains(9) && !log.completed().contains(1));
}

/// Catches a log that two processes write at once.
#[test]
fn a_log_has_one_owner() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("trees.parts");
    let _log = PartLog::open(&path, &format(), 10).expect("a log");
    assert_eq!(PartLog::open(&path, &format(), 10).expect_err("busy").kind(), ErrorKind::Busy);
}

/// Catches a batch that is written twice with different results, or that does not exist.
#[test]
fn a_batch_has_one_result() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut log = PartLog::open(folder.path().join("trees.parts"), &format(), 10).expect("a log");
    log.append(&small(3)).expect("appended");
    let end = log.end;
    log.append(&small(3)).expect("the same again");
    assert_eq!(log.end, end);
    let other = part(&format(), 3, &[30, 32, 35], |index| index == 32);
    let error = log.append(&other).expect_err("another result");
    assert_eq!(error.message(), "batch `3` was baked twice with different results");
    log.append(&small(10)).expect_err("no such batch");
    assert_eq!(all(&mut log).expect("read"), [3]);
}

/// Catches a log of other inputs that is continued.
#[test]
fn a_log_of_another_bake_is_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("trees.parts");
    filled(&path);
    let sound = fs::read(&path).expect("bytes");
    let other = PartFormat::new(1, format().attributes(), format().points_max()).expect("a format");
    assert_eq!(PartLog::open(&path, &other, 10).expect_err("another bake").kind(), ErrorKind::Invalid);
    assert_eq!(PartLog::open(&path, &format(), 11).expect_err("another plan").kind(), ErrorKind::Invalid);
    assert_eq!(fs::read(&path).expect("bytes"), sound, "a refused log stays as it is");
}

/// Catches a torn end that is taken for a part, that stops the bake, or that costs whole parts before it: the
/// file cut at every length.
#[test]
fn a_torn_log_continues_wherever_it_is_torn() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("trees.parts");
    let borders = filled(&path);
    let sound = fs::read(&path).expect("bytes");
    for length in 0..sound.len() {
        fs::write(&path, &sound[..length]).expect("written");
        if length < borders[0] {
            PartLog::open(&path, &format(), 10).expect_err("no header");
            continue;
        }
        let whole = borders.iter().filter(|&&border| border <= length).count() - 1;
        let mut log = PartLog::open(&path, &format(), 10).expect("a log");
        assert_eq!(log.recovery().parts as usize, whole);
        assert_eq!(log.recovery().truncated_bytes as usize, length - borders[whole]);
        [4, 0, 2, 7].iter().for_each(|&batch| log.append(&small(batch)).expect("appended"));
        drop(log);
        assert_eq!(fs::read(&path).expect("bytes"), sound, "continued at {length}");
    }
}

/// Catches a flipped byte that becomes a result, a panic or an endless loop: every byte after the header. At most
/// the parts from the damage on are lost, and all can be appended again.
#[test]
fn damaged_parts_are_not_done() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("trees.parts");
    let borders = filled(&path);
    let sound = fs::read(&path).expect("bytes");
    for at in borders[0]..sound.len() {
        let mut bytes = sound.clone();
        bytes[at] ^= 0x11;
        fs::write(&path, &bytes).expect("written");
        let mut log = PartLog::open(&path, &format(), 10).expect("a log");
        let hit = borders.iter().filter(|&&border| border <= at).count() - 1;
        let in_frame_header = at < borders[hit] + FRAME_BYTES as usize;
        assert_eq!(log.recovery().parts as usize, if in_frame_header { hit } else { 3 }, "byte {at}");
        assert_eq!(log.recovery().damaged, u64::from(!in_frame_header));
        [4, 0, 2, 7].iter().for_each(|&batch| log.append(&small(batch)).expect("appended"));
        assert_eq!(all(&mut log).expect("read"), [0, 2, 4, 7]);
    }
}

/// Catches damage after opening that the merge would take for results.
#[test]
fn damage_under_way_is_an_error() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("trees.parts");
    let borders = filled(&path);
    let mut log = PartLog::open(&path, &format(), 10).expect("a log");
    let mut bytes = fs::read(&path).expect("bytes");
    bytes[borders[2] - 20] ^= 4;
    fs::write(&path, &bytes).expect("written");
    assert_eq!(all(&mut log).expect_err("damage").kind(), ErrorKind::Corrupt);
}
