//! The grammar as a whole: what is accepted; in the files beside, what is not.

mod damaged;
mod files;
mod refused;

use std::path::Path;

use glam::{DMat4, DVec3};

use super::*;
use crate::stream::ValueType;

/// Uses everything that this version can do, but for files.
const SCENE: &str = r#"<?xml version="1.0" encoding="UTF-8"?>
<scene version="1" units="cm" up="z">
  <camera name="shot" fov="40" resolution="1920 1080" matrix="1 0 0 0  0 1 0 0  0 0 1 0  1 2 3 1"/>
  <shaders>
    <shader name="occlusion" type="sh_occlusion">
      <param name="bands" value="4"/> <param name="samples" value="1024"/>
      <param name="domain" value="sphere"/> <param name="weight" value="cosine"/>
      <param name="maxdistance" value="12.5"/> <param name="storage" value="f16"/>
    </shader>
    <shader name="plain" type="sh_occlusion"/>
  </shaders>
  <geometries>
    <geometry name="trees" occluder="true">
      <stream procedural="jungle" micropolygons="1000"/>
      <instance matrix="2,0,0,0, 0,2,0,0, 0,0,2,0, 5,6,7,1"/>
      <bakeset name="trees" occluders="trees ground">
        <attribute name="sh" shader="occlusion"/>
        <attribute name="shadow" shader="plain"/> <attribute name="ao" shader="occlusion" output="ambient_occlusion"/>
        <attribute name="noise" shader="occlusion" output="error"/>
      </bakeset>
    </geometry>
    <geometry name="ground" occluder="true">
      <stream procedural="terrain" seed="7" micropolygons="1000000"/>
    </geometry>
    <geometry name="probes">
      <stream procedural="grass" seed="18446744073709551615" micropolygons="1000000000000"/>
      <bakeset name="probes"> <attribute name="sh" shader="plain"/> </bakeset>
    </geometry>
  </geometries>
</scene>
"#;

fn read(text: &str) -> Result<Scene> {
    parse(Path::new("folder/s.xml"), text)
}

/// Catches a value that is lost, defaulted or read in another unit or order.
#[test]
fn a_whole_scene_is_read() {
    let scene = read(SCENE).unwrap();
    let sh_occlusion = ShOcclusion {
        bands: 4,
        samples: 1024,
        domain: Domain::Sphere,
        weight: Weight::Cosine,
        max_distance: Some(12.5),
        storage: ValueType::F16,
    };
    let shader =
        |name: &str, parameters| Shader { name: name.into(), kind: ShaderKind::ShOcclusion(parameters) };
    let attribute = |name: &str, shader: &str, output: &str| BakeAttribute {
        name: name.into(),
        shader: shader.into(),
        output: output.into(),
    };
    let procedural =
        |kind, seed, micropolygons| vec![StreamSource::Procedural(Procedural { kind, seed, micropolygons })];
    let expected = Scene {
        path: "folder/s.xml".into(),
        frame: None,
        meters_per_unit: 0.01,
        up: UpAxis::Z,
        cameras: vec![Camera {
            name: "shot".into(),
            fov_degrees: 40.0,
            resolution: [1920, 1080],
            world_from_camera: DMat4::from_translation(DVec3::new(1.0, 2.0, 3.0)),
        }],
        shaders: vec![shader("occlusion", sh_occlusion), shader("plain", ShOcclusion::default())],
        geometries: vec![
            Geometry {
                name: "trees".into(),
                occluder: true,
                streams: procedural(ProceduralKind::Jungle, 0, 1000),
                instances: vec![Instances::Matrix(
                    DMat4::from_translation(DVec3::new(5.0, 6.0, 7.0)) * DMat4::from_scale(DVec3::splat(2.0)),
                )],
                bake_sets: vec![BakeSet {
                    name: "trees".into(),
                    occluders: vec!["trees".into(), "ground".into()],
                    attributes: vec![
                        attribute("sh", "occlusion", "coefficients"),
                        attribute("shadow", "plain", "coefficients"),
                        attribute("ao", "occlusion", "ambient_occlusion"),
                        attribute("noise", "occlusion", "error"),
                    ],
                }],
            },
            Geometry {
                name: "ground".into(),
                occluder: true,
                streams: procedural(ProceduralKind::Terrain, 7, 1_000_000),
                instances: vec![],
                bake_sets: vec![],
            },
            Geometry {
                name: "probes".into(),
                occluder: false,
                streams: procedural(ProceduralKind::Grass, u64::MAX, 1_000_000_000_000),
                instances: vec![],
                bake_sets: vec![BakeSet {
                    name: "probes".into(),
                    occluders: vec![],
                    attributes: vec![attribute("sh", "plain", "coefficients")],
                }],
            },
        ],
    };
    assert_eq!(scene, expected);
}

/// Catches a unit that is off by a factor.
#[test]
fn units_are_metres() {
    let exact = [
        ("m", 1.0),
        ("cm", 0.01),
        ("mm", 0.001),
        ("km", 1e3),
        ("in", 0.0254),
        ("ft", 0.3048),
        ("yd", 0.9144),
    ];
    for (unit, metres) in exact {
        let scene = read(&SCENE.replace("units=\"cm\"", &format!("units=\"{unit}\""))).unwrap();
        assert_eq!(scene.meters_per_unit, metres, "{unit}");
    }
}

/// Catches a reading that depends on what XML leaves open: byte order mark, line ends, quotes, references, order of
/// sections, attributes for editors, comments.
#[test]
fn the_same_scene_can_be_written_in_many_ways() {
    let expected = read(SCENE).unwrap();
    let (head, rest) = SCENE.split_once("  <geometries>").unwrap();
    let (head, shaders) = head.split_once("  <shaders>").unwrap();
    let (geometries, tail) = rest.split_once("</scene>").unwrap();
    let schema = "<scene xmlns:xsi='http://www.w3.org/2001/XMLSchema-instance' xsi:noNamespaceSchemaLocation='../docs/scene.xsd'";
    for text in [
        format!("\u{feff}{SCENE}"),
        SCENE.replace('\n', "\r\n"),
        SCENE.replace('"', "'"),
        SCENE.replace("\"shot\"", "\"&#115;h&#x6F;t\"").replace("1 2 3 1", "1&#32;2 3\n\t1"),
        SCENE.replace("<scene", schema),
        SCENE.replace("<param", "<!-- a < b --><?editor hint?><param"),
        SCENE.replace("<shader name=\"plain\"", "</shaders><shaders><shader name=\"plain\""),
        format!("{head}<geometries>{geometries}<shaders>{shaders}</scene>{tail}"),
    ] {
        assert_eq!(read(&text).expect(&text), expected, "{text}");
    }
}
