//! Tests of leaves: a card cut along its texture looks like it.

use super::*;
use crate::import::assets::Collect;
use crate::import::emit::Carried;
use crate::stream::Microgrid;
use crate::stream::schema::names;

const CORNERS: [[f64; 3]; 4] = [[0.0; 3], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]];

/// Edge of the test's image, in texels.
const SIZE: usize = 128;

/// Alpha of a ring with a soft rim, off the image's middle.
fn ring(x: usize, y: usize) -> u8 {
    let from = ((x as f32 - 70.0).powi(2) + (y as f32 - 55.0).powi(2)).sqrt();
    (255.0 * (1.0 - ((from - 35.0).abs() - 12.0) / 6.0).clamp(0.0, 1.0)) as u8
}

/// A card over the unit square, cut along the ring.
fn cut(alpha: AlphaMode, texels: f64) -> (Collect, ImportReport) {
    let image = (0..SIZE * SIZE).flat_map(|i| [20, 200, 10, ring(i % SIZE, i / SIZE)]).collect();
    let texture = Texture::square(SIZE as u32, image);
    let mut card = Mesh::default();
    let mut report = ImportReport::default();
    let face = Face { start: 0, arity: 0, material: 0, object: 0, opacity: 255, hole: false };
    card.positions = CORNERS.map(DVec3::from).into();
    card.colors = vec![[255; 3]; 4];
    card.push_face(face, &[0, 1, 2], &mut report).unwrap();
    card.push_face(face, &[0, 2, 3], &mut report).unwrap();
    card.finish(&mut report).unwrap();
    // The card's edges lie a hair inside of the image, which repeats
    let uvs = [[0.0, 0.0], [0.9999, 0.0], [0.9999, 0.9999], [0.0, 0.9999]].map(Vec2::from_array);
    let corner = |corner: usize| (uvs[card.corners[corner] as usize], 1.0);
    let options = ImportOptions::default();
    let mut leaves = Leaves::new(&card, (&texture, alpha, 1.0), &corner, (Some(texels), None));
    let count = leaves.count(&Placement::HERE).unwrap();
    let mut sink = Collect::default();
    let carried = Carried { normal: true, albedo: true, opacity: true, ..Carried::default() };
    let mut emitter = Emitter::new(&mut sink, carried, &options).unwrap();
    leaves.emit(&mut emitter, &Placement::HERE, 7, &mut report).unwrap();
    assert_eq!(report.micropolygons, count);
    assert!(sink.values(names::ID).iter().all(|&id| id == 7.0));
    (sink, report)
}

/// The corners of every part, and its opacity.
fn faces(sink: &Collect) -> Vec<([DVec3; 3], f32)> {
    let column = sink.schema.find(names::OPACITY).unwrap();
    let grids = sink.grids.iter().flat_map(|grid| grid.faces().map(move |face| (grid, face)));
    let face = |(grid, face): (&Microgrid, &[u8])| {
        let opacity = grid.unit_value(&sink.schema, column, usize::from(face[0]), 0);
        (std::array::from_fn(|i| grid.position(usize::from(face[i]))), opacity)
    };
    grids.map(face).collect()
}

/// What a picture of `n` by `n` pixels shows of a mesh in the unit square: opacities, looked at along z.
fn picture(sink: &Collect, n: usize) -> Vec<f32> {
    let mut pixels = vec![0.0; n * n];
    for (points, opacity) in faces(sink) {
        let side = |i: usize, p: DVec3| {
            (points[(i + 1) % 3] - points[i]).truncate().perp_dot((p - points[i]).truncate())
        };
        let (low, high) = points.iter().fold((points[0], points[0]), |(l, h), p| (l.min(*p), h.max(*p)));
        let pixel = |x: f64| ((x * n as f64) as usize).min(n - 1);
        for y in pixel(low.y)..=pixel(high.y) {
            for x in pixel(low.x)..=pixel(high.x) {
                let p = DVec3::new((x as f64 + 0.5137) / n as f64, (y as f64 + 0.4871) / n as f64, 0.0);
                if (0..3).all(|i| side(i, p) >= 0.0) {
                    pixels[y * n + x] = opacity;
                }
            }
        }
    }
    pixels
}

/// Catches a leaf whose outline or density is not its texture's: one that is opaque, shifted, shrunk or blurred.
#[test]
fn a_card_looks_like_its_texture() {
    for alpha in [AlphaMode::Mask(0.5), AlphaMode::Mask(0.9), AlphaMode::Blend] {
        let (sink, _) = cut(alpha, 2.0);
        let n = 400;
        let seen = picture(&sink, n);
        let wanted: Vec<f32> = (0..n * n)
            .map(|i| [i % n, i / n].map(|x| x * SIZE / n))
            .map(|[x, y]| texture::coverage(alpha, f32::from(ring(x, y)) / 255.0))
            .collect();
        let mean = |values: &[f32]| values.iter().sum::<f32>() / values.len() as f32;
        assert!((mean(&seen) / mean(&wanted) - 1.0).abs() < 0.005, "{} {}", mean(&seen), mean(&wanted));
        let pairs = || seen.iter().zip(&wanted).map(|(a, b)| [*a >= 0.5, *b >= 0.5]);
        let both = pairs().filter(|[a, b]| *a && *b).count() as f32;
        let either = pairs().filter(|[a, b]| *a || *b).count() as f32;
        assert!(both / either > 0.97, "{alpha:?} {}", both / either);
    }
}

/// Catches parts larger than the texels asked for where coverage changes, clear ones that stay, even ones that are cut,
/// and colours that are lost.
#[test]
fn only_the_rim_is_cut_to_texels() {
    let longest =
        |p: &[DVec3; 3]| (0..3).map(|i| p[i].distance(p[(i + 1) % 3])).fold(0.0, f64::max) * SIZE as f64;
    for texels in [2.0, 8.0] {
        let soft = faces(&cut(AlphaMode::Blend, texels).0);
        let partly = soft.iter().filter(|(_, opacity)| *opacity < 1.0);
        assert!(partly.clone().count() > 100 && partly.clone().all(|(p, _)| longest(p) < texels * 1.01));
    }
    let (sink, report) = cut(AlphaMode::Mask(0.5), 2.0);
    let hard = faces(&sink);
    assert!(hard.iter().all(|(_, opacity)| *opacity > 0.0));
    assert!(hard.iter().any(|(p, opacity)| *opacity == 1.0 && longest(p) > 4.0));
    assert!(hard.len() < SIZE * SIZE / 2, "{}", hard.len());
    let clear = report.skipped.iter().find(|(reason, _)| reason.contains("wholly clear")).unwrap().1;
    assert!(clear > 100, "{clear}");
    let albedo = sink.schema.find(names::ALBEDO).unwrap();
    for grid in &sink.grids {
        let colors = (0..grid.vertex_count()).map(|vertex| grid.vec3(&sink.schema, albedo, vertex));
        assert!(colors.clone().all(|rgb| rgb.y > rgb.x && rgb.y > rgb.z));
    }
}

/// Catches a count that is not refused, and a refusal without a way out.
#[test]
fn too_many_leaves_are_refused_with_a_hint() {
    let options = ImportOptions { leaves_max: 1000, ..ImportOptions::default() };
    assert!(check_count(1000, &options).is_ok());
    let error = check_count(1001, &options).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::Limit);
    assert!(error.hint_text().unwrap().contains("texels:4"), "{error}");
}
