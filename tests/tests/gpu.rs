//! A whole bake on software Vulkan against the same bake on the CPU.

use std::path::Path;
use std::sync::atomic::AtomicBool;

use engine::ErrorKind;
use engine::bake::{BakeOptions, Control, Quiet, bake};
use engine::cut::Lod;
use engine::scene;
use engine::stats::Report;
use engine::trace::Device;

const SCENE: &str = r#"<?xml version="1.0" encoding="UTF-8"?>
<scene version="1" units="m" up="y">
  <shaders>
    <shader name="uniform" type="sh_occlusion"><param name="samples" value="32"/></shader>
    <shader name="cosine" type="sh_occlusion">
      <param name="samples" value="16"/> <param name="weight" value="cosine"/> <param name="maxdistance" value="2"/>
    </shader>
  </shaders>
  <geometries>
    <geometry name="jungle" occluder="true">
      <stream procedural="jungle" seed="5" micropolygons="3000"/>
      <bakeset name="jungle">
        <attribute name="uniform" shader="uniform"/> <attribute name="cosine" shader="cosine"/>
      </bakeset>
    </geometry>
  </geometries>
</scene>
"#;

fn baked(scene: &Path, folder: &Path, device: Device, lod: Lod) -> engine::Result<(Report, Vec<u8>)> {
    let scene = scene::load(scene)?;
    let options = BakeOptions { device, lod, points_max: Some(4000), threads: 2, ..BakeOptions::default() };
    let control = Control { progress: &Quiet, cancel: &AtomicBool::new(false) };
    let report = bake(&scene, &options, folder, control)?;
    Ok((report, std::fs::read(folder.join("jungle.mgs")).expect("the bake leaves its stream")))
}

/// Catches a bake on a device that differs from the CPU's in a single byte, or that the CPU quietly did.
#[test]
fn a_bake_on_software_vulkan_has_the_bytes_of_the_cpu() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = folder.path().join("scene.xml");
    std::fs::write(&scene, SCENE).expect("the scene is written");
    for (number, lod) in [Lod::Off, Lod::Footprint { quality: 1.0 }].into_iter().enumerate() {
        let at = |name: &str| folder.path().join(format!("{name}{number}"));
        let (report, found) = match baked(&scene, &at("device"), Device::Software, lod) {
            Err(error) if matches!(error.kind(), ErrorKind::NotFound | ErrorKind::Unsupported) => {
                assert!(std::env::var_os("PANTARAY_NEEDS_VULKAN").is_none(), "{error}");
                eprintln!("skipped: {error}");
                return;
            }
            baked => baked.expect("the device bakes"),
        };
        assert!(report.bake.device_batches > 0 && report.bake.cpu_batches == 0, "{:?}", report.warnings);
        assert!(report.bake.device_bytes_per_ray > 0.0);
        let (_, expected) = baked(&scene, &at("cpu"), Device::Cpu, lod).expect("the CPU bakes");
        assert!(found == expected, "the bytes differ");
    }
}
