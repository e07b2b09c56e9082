//! Builds that are stopped in the middle, politely and not, and builds that have nothing to do.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;

use crate::command::{Run, json, names, pantaray, run};

/// Six partitions: enough to be killed between two of them.
const MICROPOLYGONS: u32 = 3_000_000;

fn scene(micropolygons: u32, matrix: &str, samples: u32) -> String {
    format!(
        r#"<scene version="1" units="m" up="y">
  <shaders>
    <shader name="occlusion" type="sh_occlusion"><param name="samples" value="{samples}"/></shader>
  </shaders>
  <geometries>
    <geometry name="ground" occluder="true">
      <stream procedural="terrain" seed="3" micropolygons="{micropolygons}"/>
      <instance matrix="{matrix}"/>
      <bakeset name="ground"><attribute name="sh_occlusion" shader="occlusion"/></bakeset>
    </geometry>
  </geometries>
</scene>"#
    )
}

const UNMOVED: &str = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1";

/// A folder with a scene.
struct Desk(tempfile::TempDir);

impl Desk {
    fn with(scene: &str) -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        std::fs::write(folder.path().join("scene.xml"), scene).expect("written");
        Self(folder)
    }

    fn at(&self, name: &str) -> String {
        self.0.path().join(name).to_string_lossy().into_owned()
    }

    fn arguments(&self, out: &str) -> Vec<String> {
        ["build", &self.at("scene.xml"), "-o", &self.at(out), "--threads", "2"].map(String::from).to_vec()
    }

    fn build(&self, out: &str) -> Value {
        json(self.arguments(out))
    }

    fn spawn(&self, out: &str) -> Child {
        let mut command = pantaray();
        command.args(self.arguments(out)).stdout(Stdio::piped()).stderr(Stdio::piped());
        command.spawn().expect("pantaray runs")
    }

    /// What is in the folder of the maps, with the complete map's path if it is there.
    fn maps(&self, out: &str) -> (Vec<String>, Option<PathBuf>) {
        let folder = Path::new(&self.at(out)).join("brickmap");
        let found = if folder.exists() { names(&folder) } else { Vec::new() };
        let whole = found.iter().find(|name| !name.starts_with('.')).map(|name| folder.join(name));
        (found, whole)
    }

    /// Waits until a build that writes to `out` has finished a few partitions.
    fn wait_for_partitions(&self, out: &str, child: &mut Child) {
        let folder = Path::new(&self.at(out)).join("brickmap");
        let journal = || {
            let unfinished = std::fs::read_dir(&folder).ok()?.next()?.ok()?.path();
            Some(std::fs::metadata(unfinished.join("journal")).ok()?.len())
        };
        let start = Instant::now();
        while journal().is_none_or(|bytes| bytes < 1000) {
            assert!(
                child.try_wait().expect("a child").is_none(),
                "the build ended before it could be stopped"
            );
            assert!(start.elapsed() < Duration::from_secs(120), "no partition was finished");
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}

/// Every file of a folder, by name.
fn files(folder: &Path) -> Vec<(String, Vec<u8>)> {
    names(folder).into_iter().map(|name| (name.clone(), std::fs::read(folder.join(name)).unwrap())).collect()
}

/// The files of the only map below `out`.
fn only_map(desk: &Desk, out: &str) -> Vec<(String, Vec<u8>)> {
    let (found, whole) = desk.maps(out);
    assert_eq!(found.len(), 1, "something is left behind: {found:?}");
    files(&whole.expect("a complete map"))
}

/// Catches a build that, killed at any moment, leaves half a map under its name, scratch, or something from which other
/// bytes grow; and one that begins again from nothing every time.
#[test]
fn a_build_that_is_killed_at_ten_moments_continues_to_the_same_bytes() {
    let desk = Desk::with(&scene(MICROPOLYGONS, UNMOVED, 16));
    let start = Instant::now();
    desk.build("quiet");
    let whole = start.elapsed();
    let expected = only_map(&desk, "quiet");

    let (mut kills, mut runs) = (0, 0);
    while kills < 10 {
        runs += 1;
        assert!(runs < 60, "builds end before they can be killed");
        let mut child = desk.spawn("killed");
        // Moments spread evenly over the length of a whole build, in no order
        let moment = whole.mul_f64((0.05 + 0.618 * f64::from(runs)).fract());
        let begun = Instant::now();
        while begun.elapsed() < moment && child.try_wait().expect("a child").is_none() {
            std::thread::sleep(Duration::from_millis(2));
        }
        child.kill().expect("killed");
        let status = child.wait().expect("an end");
        let (found, map) = desk.maps("killed");
        if status.success() {
            assert!(only_map(&desk, "killed") == expected, "other bytes after {kills} kills");
            std::fs::remove_dir_all(desk.at("killed")).unwrap();
            continue;
        }
        kills += 1;
        if let Some(map) = map {
            assert!(files(&map) == expected, "half a map after {kills} kills");
            std::fs::remove_dir_all(desk.at("killed")).unwrap();
            continue;
        }
        assert!(found.len() <= 1, "{found:?}");
        let scratch = Path::new(&desk.at("killed")).join("work/build");
        if scratch.exists() {
            assert!(files(&scratch).iter().all(|(_, bytes)| bytes.is_empty()), "scratch is left");
        }
        if kills % 3 == 0 {
            desk.build("killed");
            assert!(only_map(&desk, "killed") == expected, "other bytes after {kills} kills");
            std::fs::remove_dir_all(desk.at("killed")).unwrap();
        }
    }

    // One more, when it is known that partitions are done
    let mut child = desk.spawn("late");
    desk.wait_for_partitions("late", &mut child);
    child.kill().expect("killed");
    assert!(!child.wait().expect("an end").success());
    let report = desk.build("late");
    let continued = report["brickmap"]["partitions_continued"].as_u64().expect("a count");
    assert!(continued > 0, "no partition was kept");
    assert!(only_map(&desk, "late") == expected, "other bytes after a late kill");
}

/// Catches a polite stop that leaves scratch, loses what is done, or does not say how to go on.
#[test]
fn a_build_that_is_cancelled_keeps_its_partitions() {
    let desk = Desk::with(&scene(MICROPOLYGONS, UNMOVED, 16));
    let mut child = desk.spawn("stopped");
    desk.wait_for_partitions("stopped", &mut child);
    let kill = Command::new("kill").args(["-TERM", &child.id().to_string()]).status().expect("kill runs");
    assert!(kill.success());
    let cancelled = Run::from(child.wait_with_output().expect("an end"));
    assert_eq!((cancelled.code, cancelled.out.as_str()), (1, ""), "{cancelled:?}");
    assert!(cancelled.err.contains("hint: run the same command again"), "{cancelled:?}");
    assert!(names(&Path::new(&desk.at("stopped")).join("work/build")).is_empty(), "scratch is left");

    let report = desk.build("stopped");
    let partitions = |name: &str| report["brickmap"][name].as_u64().expect("a count");
    assert!(partitions("partitions_continued") >= 1, "{report}");
    assert!(partitions("partitions") > partitions("partitions_continued"), "{report}");
    desk.build("quiet");
    assert!(only_map(&desk, "stopped") == only_map(&desk, "quiet"), "a cancelled build gives other bytes");
}

/// Catches a map that is built again for nothing, or not built again although its geometry has moved.
#[test]
fn a_map_is_built_again_only_if_its_geometry_changes() {
    let desk = Desk::with(&scene(20_000, UNMOVED, 16));
    let is_reused = |report: &Value| report["brickmap"]["reused"].as_bool().expect("a flag");
    let first = desk.build("out");
    let (_, map) = desk.maps("out");
    let made = std::fs::metadata(map.unwrap().join("manifest.json")).unwrap().modified().unwrap();
    let again = desk.build("out");
    assert!(!is_reused(&first) && is_reused(&again), "{again}");
    assert_eq!(again["brickmap"]["bytes"], first["brickmap"]["bytes"]);
    let said = run(desk.arguments("out"));
    assert!(said.out.contains("reused"), "{said:?}");
    let (_, map) = desk.maps("out");
    assert_eq!(std::fs::metadata(map.unwrap().join("manifest.json")).unwrap().modified().unwrap(), made);

    // Other shaders and bake sets see the same occluders
    let shader = scene(20_000, UNMOVED, 64);
    let sets = shader.replace(
        "</bakeset>",
        "</bakeset><bakeset name=\"more\"><attribute name=\"a\" shader=\"occlusion\"/></bakeset>",
    );
    for same in [&shader, &sets] {
        std::fs::write(desk.at("scene.xml"), same).unwrap();
        assert!(is_reused(&desk.build("out")), "{same}");
    }
    // Moved, or more of it, is another map
    for other in [scene(20_000, &UNMOVED.replace("0 0 0 1", "0 0 3 1"), 16), scene(20_500, UNMOVED, 16)] {
        std::fs::write(desk.at("scene.xml"), &other).unwrap();
        assert!(!is_reused(&desk.build("out")), "{other}");
    }
    assert_eq!(desk.maps("out").0.len(), 3);
}
