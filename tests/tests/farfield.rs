//! The directional far field in whole maps: what stands in for walls is as dark as they are, and for leaves as open.

use std::f64::consts::TAU;

use engine::brickmap::FarField;
use engine::cut::Lod;
use engine::scene::{Domain, Procedural, ProceduralKind, ShOcclusion};
use engine::stream::procedural::ProceduralStream;
use engine::stream::schema::UpAxis;
use glam::{DVec3, Vec3};
use tests::{MemoryStream, Setup, build_map_with, trace};

const Y00: f64 = 0.282_094_791_773_878_14;

/// Catches proxies that light leaks through: out of a closed room, at any angle, with walls of few or of many quads, less than
/// 0.3 % of the rays escape at one footprint. The paper's far field lets far more through, or the test is empty.
#[test]
#[expect(clippy::approx_constant, reason = "about an eighth of a turn: which angle exactly does not matter")]
fn a_closed_room_does_not_leak() {
    let shader = ShOcclusion { samples: 512, domain: Domain::Sphere, ..ShOcclusion::default() };
    for tilt in [0.0, 0.2, 0.4, 0.785_398] {
        for cells in [30, 240] {
            let mut room = MemoryStream::new();
            let turn = room.push_room(tilt, cells);
            let points: Vec<_> = (0..200)
                .map(|i| {
                    let at = |step: f64| ((f64::from(i) + 0.5) * step).fract() * 1.8 - 0.9;
                    (turn * DVec3::new(at(0.754_877), at(0.569_840), at(0.819_173)), Vec3::ZERO)
                })
                .collect();
            let leak = |kind: FarField| {
                let folder = tempfile::tempdir().unwrap();
                let map = build_map_with(&mut [&mut room.clone()], kind, folder.path());
                let setup = Setup { lod: Lod::Footprint { quality: 1.0 }, threads: 2, ..Setup::default() };
                let found = trace(&map, &points, &shader, None, setup);
                let mean = found.iter().map(|v| f64::from(v[0])).sum::<f64>() / found.len() as f64;
                mean / (2.0 * TAU * Y00)
            };
            let (directional, paper) = (leak(FarField::Directional), leak(FarField::Paper));
            eprintln!("tilt {tilt}, {cells} cells: directional {directional:.5}, paper {paper:.5}");
            assert!(directional < 0.003, "tilt {tilt}, {cells} cells: {directional}");
            assert!(cells < 100 || paper > 0.05, "tilt {tilt}, {cells} cells: the paper's {paper}");
        }
    }
}

/// Catches proxies of leaves that are too dark or too light: over points of a jungle, one footprint's error against full detail
/// is below the noise of 512 rays, and its bias below 1.5 % of the mean.
#[test]
fn a_jungle_keeps_its_light() {
    let kind = Procedural { kind: ProceduralKind::Jungle, seed: 5, micropolygons: 300_000 };
    let mut stream = ProceduralStream::new(&kind, 1.0, UpAxis::Y).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let map = build_map_with(&mut [&mut stream], FarField::Directional, folder.path());
    let points = tests::points_of(&mut stream, 1_000);
    let shader = ShOcclusion { samples: 512, ..ShOcclusion::default() };
    let of = |lod, samples| {
        let setup = Setup { lod, threads: 2, ..Setup::default() };
        trace(&map, &points, &ShOcclusion { samples, ..shader.clone() }, Some(0), setup)
    };
    let (full, far) = (of(Lod::Off, 512), of(Lod::Footprint { quality: 1.0 }, 512));
    let truth = of(Lod::Off, 16_384);
    let rmse = |a: &[Vec<f32>], b: &[Vec<f32>]| {
        let squares = a.iter().flatten().zip(b.iter().flatten()).map(|(a, b)| f64::from(a - b).powi(2));
        (squares.sum::<f64>() / (9 * points.len()) as f64).sqrt()
    };
    let mean = |a: &[Vec<f32>]| a.iter().map(|v| f64::from(v[0])).sum::<f64>() / a.len() as f64;
    let (noise, error) = (rmse(&full, &truth), rmse(&far, &truth));
    let bias = mean(&far) / mean(&full) - 1.0;
    eprintln!("noise {noise:.4}, error {error:.4}, bias {bias:.4}, mean {:.3}", mean(&full));
    assert!(error < noise, "{error} against {noise}");
    assert!(bias.abs() < 0.015, "{bias}");
}
