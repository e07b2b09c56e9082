//! Bakes that are stopped in the middle, politely and not: the same command goes on, and the bytes are the same.

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use crate::command::{Run, json, pantaray, run};

/// Long enough to be interrupted: about 20 batches of a million rays.
const SCENE: &str = r#"<scene version="1" units="m" up="y">
  <shaders>
    <shader name="occlusion" type="sh_occlusion"><param name="samples" value="512"/></shader>
  </shaders>
  <geometries>
    <geometry name="meadow" occluder="true">
      <stream procedural="grass" seed="3" micropolygons="20000"/>
      <bakeset name="meadow"><attribute name="sh_occlusion" shader="occlusion"/></bakeset>
    </geometry>
  </geometries>
</scene>"#;

/// Bytes of the finished batches of the bake in `out`.
fn finished(out: &Path) -> u64 {
    std::fs::metadata(out.join("work/sets/meadow/parts")).map_or(0, |file| file.len())
}

/// Waits until a batch or two were finished after `before`; there are many more.
fn wait_for_batches(child: &mut Child, out: &Path, before: u64) {
    let start = Instant::now();
    while finished(out) < before + 100_000 {
        assert!(child.try_wait().expect("a child").is_none(), "the bake ended before it could be stopped");
        assert!(start.elapsed() < Duration::from_secs(120), "no batch was finished");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Starts a bake and stops it by a signal once some batches are done.
fn interrupt(arguments: &[&str], out: &Path, name: &str) -> Run {
    let before = finished(out);
    let mut command = pantaray();
    command.args(arguments).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn().expect("pantaray runs");
    wait_for_batches(&mut child, out, before);
    let kill = Command::new("kill").args([name, &child.id().to_string()]).status().expect("kill runs");
    assert!(kill.success());
    let run = Run::from(child.wait_with_output().expect("an end"));
    assert!(!out.join("meadow.mgs").exists() && !out.join("report.json").exists(), "half a result");
    run
}

/// Catches a cancelled or killed bake that loses work, leaves half a result, is continued with other options, or ends in
/// other bytes than one that was left alone; and bytes that depend on the number of threads.
#[test]
fn an_interrupted_bake_continues_to_the_same_bytes() {
    let desk = tempfile::tempdir().expect("a folder");
    let at = |name: &str| desk.path().join(name).to_string_lossy().into_owned();
    std::fs::write(at("scene.xml"), SCENE).expect("written");
    let [scene, quiet, stopped] = ["scene.xml", "quiet", "stopped"].map(at);
    let alone = json(["bake", &scene, "-o", &quiet, "--threads", "2"]);

    let (out, arguments) = (Path::new(&stopped), ["bake", &scene, "-o", &stopped, "--threads", "1"]);
    let cancelled = interrupt(&arguments, out, "-TERM");
    assert_eq!((cancelled.code, cancelled.out.as_str()), (1, ""), "{cancelled:?}");
    assert!(cancelled.err.contains("cancelled"), "{cancelled:?}");
    assert!(cancelled.err.contains("hint: run the same command again"), "{cancelled:?}");
    let killed = interrupt(&arguments, out, "-KILL");
    assert_eq!(killed.code, -1, "{killed:?}");
    let other = run(arguments.into_iter().chain(["--seed", "9"]));
    assert_eq!(other.code, 1, "{other:?}");
    assert!(other.err.contains("--restart"), "{other:?}");

    let report = json(arguments);
    let batches = |name: &str| report["bake_sets"][0][name].as_u64().expect("a count");
    assert!(batches("batches_continued") >= 2 && batches("batches") >= 1, "{report}");
    assert_eq!(
        batches("batches_continued") + batches("batches"),
        alone["bake"]["batches"].as_u64().expect("a count")
    );
    let [whole, pieced] =
        [quiet, stopped].map(|out| std::fs::read(Path::new(&out).join("meadow.mgs")).unwrap());
    assert!(whole == pieced, "an interrupted bake gives other bytes");
}
