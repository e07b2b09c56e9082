//! A range of frames, baked one after the other into folders of their own, with one folder of brick maps for all.
//!
//! A brick map's name is a hash of what stands in it: what does not change from frame to frame is built once.

use std::path::Path;
use std::str::FromStr;
use std::time::Instant;

use serde::Serialize;

use super::folder::{Folder, write_atomically};
use super::{BakeOptions, Control, Progress, bake_with_maps};
use crate::scene::Scene;
use crate::stats::Report;
use crate::{Error, ErrorKind, Result};

/// Frames that a range may have.
pub const FRAMES_MAX: u64 = 100_000;

/// Frames from the first to the last, every so many.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Frames {
    first: i64,
    last: i64,
    step: u64,
}

impl Frames {
    /// The frames in order.
    pub fn iter(&self) -> impl Iterator<Item = i64> + use<> {
        (self.first..=self.last).step_by(self.step as usize)
    }
}

impl FromStr for Frames {
    type Err = Error;

    /// Reads `FIRST-LAST` or `FIRST-LASTxSTEP`.
    fn from_str(text: &str) -> Result<Self> {
        let wrong = || {
            Error::invalid(format!("`{text}` is no range of frames"))
                .hint("frames 1 to 24: `1-24`; every second one: `1-24x2`")
        };
        let (range, step) = text.split_once('x').unwrap_or((text, "1"));
        // A first frame may be negative: its sign does not part the range
        let dash = range.char_indices().skip(1).find(|(_, c)| *c == '-').ok_or_else(wrong)?.0;
        let number = |text: &str| text.parse::<i32>().map(i64::from).map_err(|_| wrong());
        let (first, last) = (number(&range[..dash])?, number(&range[dash + 1..])?);
        let step = step.parse::<u32>().map_err(|_| wrong())?;
        if first > last || step == 0 {
            return Err(wrong());
        }
        let frames = Self { first, last, step: u64::from(step) };
        if (last - first) as u64 / frames.step >= FRAMES_MAX {
            let message = format!("`{text}` are more than {FRAMES_MAX} frames");
            return Err(Error::new(ErrorKind::Limit, message).hint("bake them in several ranges"));
        }
        Ok(frames)
    }
}

/// What became of a range of frames.
#[derive(Debug, Default, Serialize)]
pub struct FramesReport {
    /// The frames in order.
    pub frames: Vec<FrameReport>,
    /// Frames all of whose brick maps were there already.
    pub maps_reused: u64,
    /// Seconds for all.
    pub seconds: f64,
}

/// What became of a frame.
#[derive(Debug, Serialize)]
pub struct FrameReport {
    /// Its number.
    pub frame: i64,
    /// The report of its bake.
    pub report: Report,
}

/// Bakes `frames` of the scene that `load` reads, each as [`bake`](super::bake) does, into `target/FRAME`; the brick maps
/// stand in `target/brickmap`. Frames are numbered with at least four digits.
///
/// # Errors
/// What `load` says of any frame, before the first is baked; then as [`bake`](super::bake), with the frames before the
/// failed one complete.
pub fn bake_frames(
    frames: Frames,
    load: &dyn Fn(i64) -> Result<Scene>,
    options: &BakeOptions,
    target: &Path,
    control: Control<'_>,
) -> Result<FramesReport> {
    let start = Instant::now();
    for frame in frames.iter() {
        load(frame)?;
        control.check()?;
    }
    let folder = Folder::open(target)?;
    let maps = folder.path().join("brickmap");
    let mut report = FramesReport::default();
    for frame in frames.iter() {
        let progress = Numbered { frame, progress: control.progress };
        let own = Control { progress: &progress, ..control };
        let name = folder.path().join(format!("{frame:04}"));
        let baked = bake_with_maps(&load(frame)?, options, &name, &maps, own)?;
        report.maps_reused += u64::from(baked.brickmap.seconds == 0.0);
        report.frames.push(FrameReport { frame, report: baked });
    }
    report.seconds = start.elapsed().as_secs_f64();
    let json = serde_json::to_vec_pretty(&report).map_err(|e| Error::invalid(e.to_string()))?;
    write_atomically(&target.join("report.json"), &json)?;
    Ok(report)
}

/// Says which frame a stage is of.
struct Numbered<'a> {
    frame: i64,
    progress: &'a dyn Progress,
}

impl Progress for Numbered<'_> {
    fn update(&self, stage: &str, done: f64, detail: &str) {
        self.progress.update(&format!("frame {} {stage}", self.frame), done, detail);
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicBool;

    use super::*;
    use crate::bake::{Quiet, bake};
    use crate::scene::load_frame;

    /// Catches ranges that are misread, endless or empty.
    #[test]
    fn ranges_are_read_as_written() {
        let numbers = |text: &str| text.parse::<Frames>().map(|frames| frames.iter().collect::<Vec<_>>());
        assert_eq!(numbers("1-3").unwrap(), [1, 2, 3]);
        assert_eq!(numbers("-2-3x2").unwrap(), [-2, 0, 2]);
        assert_eq!(numbers("7-7").unwrap(), [7]);
        assert_eq!(numbers("-5--4").unwrap(), [-5, -4]);
        for text in ["", "-", "1", "3-1", "1-3x0", "1-3x", "x2", "1-2-3", "1-200000", "é-1", "1-99999999999"]
        {
            assert!(numbers(text).is_err(), "{text}");
        }
    }

    /// A square of `size` at a height, as PLY.
    fn square(size: f64, z: f64) -> String {
        format!(
            "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n\
             element face 1\nproperty list uchar int vertex_indices\nend_header\n\
             0 0 {z}\n{size} 0 {z}\n{size} {size} {z}\n0 {size} {z}\n4 0 1 2 3\n"
        )
    }

    /// Catches a still brick map that is built for every frame, a moving one that is not, and frames that differ from a bake
    /// of their own.
    #[test]
    fn frames_share_the_maps_of_what_stands_still() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        std::fs::write(at("ground.ply"), square(4.0, 0.0)).unwrap();
        (1..=3).for_each(|f| {
            std::fs::write(at(&format!("lid.{f:04}.ply")), square(1.0, 0.3 * f64::from(f))).unwrap()
        });
        let xml = r##"<scene version="1" units="m" up="z">
            <shaders><shader name="s" type="sh_occlusion"><param name="samples" value="16"/></shader></shaders>
            <geometries>
              <geometry name="ground" occluder="true"><stream file="ground.ply"/>
                <bakeset name="still" occluders="ground"><attribute name="v" shader="s"/></bakeset>
                <bakeset name="moving"><attribute name="v" shader="s"/></bakeset></geometry>
              <geometry name="lid" occluder="true"><stream file="lid.####.ply"/></geometry>
            </geometries></scene>"##;
        std::fs::write(at("scene.xml"), xml).unwrap();
        let cancel = AtomicBool::new(false);
        let control = Control { progress: &Quiet, cancel: &cancel };
        let options = BakeOptions { memory_bytes: 256 << 20, threads: 1, ..BakeOptions::default() };
        let load = |frame| load_frame(&at("scene.xml"), Some(frame));
        let frames = "1-3".parse().unwrap();
        let report = bake_frames(frames, &load, &options, &at("range"), control).unwrap();
        assert_eq!(report.frames.len(), 3);
        assert_eq!(std::fs::read_dir(at("range/brickmap")).unwrap().count(), 4);
        bake(&load(2).unwrap(), &options, &at("alone"), control).unwrap();
        for set in ["still.mgs", "moving.mgs"] {
            let read = |folder: &str| std::fs::read(at(folder).join(set)).unwrap();
            assert!(read("range/0002") == read("alone"), "{set}");
        }
        // Again, everything is there; a frame without its file is found before anything is baked
        assert_eq!(bake_frames(frames, &load, &options, &at("range"), control).unwrap().maps_reused, 3);
        let beyond = "2-4".parse().unwrap();
        assert!(
            bake_frames(beyond, &load, &options, &at("beyond"), control).is_err() && !at("beyond").exists()
        );
    }
}
