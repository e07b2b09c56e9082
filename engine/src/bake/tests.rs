//! A bake from scene to stream, as one process takes its steps.

use std::sync::atomic::AtomicBool;

use super::*;
use crate::scene::parse;
use crate::stream::file::MgsReader;
use crate::stream::{Microgrid, MicrogridStream};

const SCENE: &str = r#"<scene version="1" units="m" up="y">
  <shaders><shader name="occlusion" type="sh_occlusion"> <param name="samples" value="64"/> </shader></shaders>
  <geometries><geometry name="ground" occluder="true">
    <stream procedural="terrain" seed="7" micropolygons="2000"/>
    <bakeset name="ground">
      <attribute name="ambient" shader="occlusion" output="ambient_occlusion"/>
      <attribute name="sh" shader="occlusion"/>
      <attribute name="bent" shader="occlusion" output="bent_normal"/>
      <attribute name="noise" shader="occlusion" output="error"/>
    </bakeset>
  </geometry></geometries>
</scene>"#;

/// Catches outputs of one shader that are traced once each, come in another order than asked for, or are not what the
/// coefficients beside them say.
#[test]
fn outputs_of_a_shader_share_its_rays() {
    let folder = tempfile::tempdir().unwrap();
    let scene = parse(&folder.path().join("scene.xml"), SCENE).unwrap();
    let options = BakeOptions { memory_bytes: MEMORY_BYTES_MIN, threads: 2, ..BakeOptions::default() };
    let cancel = AtomicBool::new(false);
    let control = Control { progress: &Quiet, cancel: &cancel };
    let report = bake(&scene, &options, &folder.path().join("out"), control).unwrap();
    assert_eq!(report.bake.rays, 64 * report.bake.points);

    let mut stream = MgsReader::open(&folder.path().join("out/ground.mgs")).unwrap();
    let schema = stream.schema().clone();
    let column = |name: &str| schema.find(name).unwrap_or_else(|| panic!("no {name}"));
    let (ambient, sh, bent, normal) = (column("ambient"), column("sh"), column("bent"), column("N"));
    let noise = column("noise");
    let components = [ambient, sh, bent, noise].map(|column| schema.attributes[column].components);
    assert_eq!(components, [1, 9, 3, 1]);
    let (mut grid, mut points, mut open) = (Microgrid::default(), 0, 0.0);
    let mut noise_sum = 0.0;
    while stream.next(&mut grid).unwrap() {
        for vertex in 0..grid.vertex_count() {
            let value = |column, component| grid.value(&schema, column, vertex, component);
            let band = glam::Vec3::new(value(sh, 3), value(sh, 1), value(sh, 2)) / 0.488_602_5;
            let n = grid.vec3(&schema, normal, vertex).normalize();
            // The shift along the normal is half of a 64th at most
            let expected = n.dot(band) / std::f32::consts::PI;
            assert!((value(ambient, 0) - expected).abs() < 0.02, "{} {expected}", value(ambient, 0));
            let middle = grid.vec3(&schema, bent, vertex);
            assert!((middle - band.normalize()).length() < 1e-4, "{middle} {band}");
            assert!((0.0..0.2).contains(&value(noise, 0)), "{}", value(noise, 0));
            noise_sum += f64::from(value(noise, 0));
            (points, open) = (points + 1, open + f64::from(value(ambient, 0)));
        }
    }
    assert_eq!(points, report.bake.points);
    // Halves of 64 rays differ by some hundredths
    let mean = noise_sum / points as f64;
    assert!((0.01..0.1).contains(&mean), "{mean}");
    // Hills see most of the sky, and not all of it
    let mean = open / points as f64;
    assert!((0.5..0.999).contains(&mean), "{mean}");
}
