//! Relighting from stream to picture, on scenes whose pictures are known.

use glam::{DMat4, DVec3, Vec3};

use super::*;
use crate::scene::UpAxis;
use crate::shade::sh::{COEFFICIENTS_MAX, evaluate};
use crate::stream::{Attribute, Rate};

/// A stream of grids in memory.
struct Grids {
    schema: Schema,
    grids: Vec<Microgrid>,
    at: usize,
}

impl MicrogridStream for Grids {
    fn schema(&self) -> &Schema {
        &self.schema
    }

    fn rewind(&mut self) -> Result<()> {
        self.at = 0;
        Ok(())
    }

    fn next(&mut self, grid: &mut Microgrid) -> Result<bool> {
        let Some(next) = self.grids.get(self.at) else { return Ok(false) };
        grid.clone_from(next);
        self.at += 1;
        Ok(true)
    }
}

/// The open hemisphere about `normal` in 3 bands: √π, √(3π)/2 Y-wise, 0 (design, section 6).
fn open_hemisphere(normal: Vec3) -> [f32; 9] {
    let mut basis = [0.0; COEFFICIENTS_MAX];
    evaluate(3, normal, &mut basis);
    // For a zonal function about n, coefficient (l, m) is f_l √(4π/(2l+1)) Y_lm(n).
    std::array::from_fn(|i| match i {
        0 => 1.772_454,
        1..=3 => 1.534_99 * (4.0 * std::f32::consts::PI / 3.0).sqrt() * basis[i],
        _ => 0.0,
    })
}

fn schema() -> Schema {
    Schema {
        attributes: vec![
            Attribute::vertex(names::NORMAL, ValueType::F32, 3),
            Attribute::vertex("sh_occlusion", ValueType::F32, 9),
            Attribute::grid(names::ALBEDO, ValueType::U8, 3),
            Attribute::vertex(names::BAKED, ValueType::U8, 1),
        ],
        ..Schema::default()
    }
}

/// A quad of unoccluded vertices that face +z, of a reflectance in steps of 1/255.
fn quad(center: DVec3, half: f32, albedo: f32) -> Microgrid {
    let schema = schema();
    let mut grid = Microgrid::default();
    grid.clear(4);
    grid.anchor = center;
    for (x, y) in [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)] {
        grid.positions.push(half * Vec3::new(x, y, 0.0));
        grid.push_values(&schema.attributes[0], 0, &[0.0, 0.0, 1.0]);
        grid.push_values(&schema.attributes[1], 1, &open_hemisphere(Vec3::Z));
        grid.push_values(&schema.attributes[3], 3, &[1.0]);
    }
    grid.push_values(&schema.attributes[2], 2, &[albedo; 3]);
    grid.push_face(&[0, 1, 2, 3]);
    grid.validate(&schema).expect("a grid");
    grid
}

fn stream(grids: Vec<Microgrid>) -> Grids {
    Grids { schema: schema(), grids, at: 0 }
}

/// 90° wide and high, looking along -z.
fn camera(eye: DVec3) -> Camera {
    Camera {
        name: "test".into(),
        fov_degrees: 90.0,
        resolution: [32, 32],
        world_from_camera: DMat4::from_translation(eye),
    }
}

fn options(eye: DVec3) -> RelightOptions {
    RelightOptions {
        viewpoint: Viewpoint::Camera(camera(eye)),
        background: false,
        ..RelightOptions::new(Environment::uniform([1.0, 2.0, 4.0]))
    }
}

fn draw(grids: Vec<Microgrid>, options: &RelightOptions) -> Picture {
    relight(&mut stream(grids), options, &mut |_| {}).expect("a picture")
}

/// Catches any factor lost on the way: an unoccluded plate of reflectance 51/255 under L = (1, 2, 4) sends out 0.2 L.
#[test]
fn a_white_furnace_shows_the_albedo() {
    let picture = draw(vec![quad(DVec3::new(0.0, 0.0, -2.0), 1.0, 51.0)], &options(DVec3::ZERO));
    for y in 0..32 {
        for x in 0..32 {
            let at = y * 32 + x;
            let inside = (8..24).contains(&x) && (8..24).contains(&y);
            assert_eq!(picture.alpha[at], f32::from(u8::from(inside)), "pixel {x} {y}");
            for (color, light) in [1.0, 2.0, 4.0].into_iter().enumerate() {
                let expected = if inside { 0.2 * light } else { 0.0 };
                let found = picture.rgb[3 * at + color];
                assert!((found - expected).abs() < 1e-4, "pixel {x} {y}: {found}, {expected} expected");
            }
        }
    }
    assert_eq!(picture.stats.drawn, draw::Drawn { grids: 1, grids_in_view: 1, faces: 1, faces_unbaked: 0 });
    assert_eq!(picture.stats.attribute, "sh_occlusion");
}

/// Catches lost precision: 4,000 km from the origin the picture is the same.
#[test]
fn far_from_the_origin_the_picture_is_the_same() {
    let scene = |eye: DVec3| {
        let grids =
            vec![quad(eye + DVec3::new(0.3, 0.1, -2.0), 1.0, 80.0), quad(eye - 3.0 * DVec3::Z, 2.0, 200.0)];
        let picture = draw(grids, &options(eye));
        (picture.rgb, picture.alpha)
    };
    assert_eq!(scene(DVec3::ZERO), scene(DVec3::new(4e6, -3e6, 4e6)));
}

/// Catches points of a partial bake that are drawn as if they were black.
#[test]
fn unbaked_vertices_are_left_out() {
    let mut grid = quad(DVec3::new(0.0, 0.0, -2.0), 1.0, 51.0);
    grid.columns[3][2] = 0;
    let picture = draw(vec![grid], &options(DVec3::ZERO));
    assert!(picture.alpha.iter().all(|&alpha| alpha == 0.0));
    assert_eq!(picture.stats.drawn.faces_unbaked, 1);
    // Framing goes by what was baked; nothing was.
    let mut grid = quad(DVec3::ZERO, 1.0, 51.0);
    grid.columns[3].fill(0);
    let automatic = RelightOptions { viewpoint: Viewpoint::Automatic([32, 32]), ..options(DVec3::ZERO) };
    let error = relight(&mut stream(vec![grid]), &automatic, &mut |_| {}).expect_err("nothing to see");
    assert_eq!(error.kind(), ErrorKind::Invalid);
}

/// Catches a background that is missing or turned: what is above the camera is drawn at the top.
#[test]
fn the_environment_is_drawn_behind() {
    let map = LatLong::from_fn(256, 128, |d| [d.y.max(0.0) as f32, d.x.max(0.0) as f32, 0.5]);
    for (up, look) in
        [(UpAxis::Y, DMat4::IDENTITY), (UpAxis::Z, DMat4::from_rotation_x(std::f64::consts::FRAC_PI_2))]
    {
        let mut source = stream(vec![quad(DVec3::new(0.0, 0.0, 900.0), 1.0, 51.0)]);
        source.schema.up = up;
        let viewpoint = Viewpoint::Camera(Camera { world_from_camera: look, ..camera(DVec3::ZERO) });
        let environment = Environment::from_map(map.clone());
        let options = RelightOptions { viewpoint, background: true, environment, ..options(DVec3::ZERO) };
        let picture = relight(&mut source, &options, &mut |_| {}).expect("a picture");
        let at =
            |x: usize, y: usize| -> [f32; 3] { std::array::from_fn(|i| picture.rgb[3 * (32 * y + x) + i]) };
        assert!(
            at(16, 0)[0] > 0.6 && at(16, 31)[0] == 0.0,
            "{up:?}: top {:?}, bottom {:?}",
            at(16, 0),
            at(16, 31)
        );
        assert!(
            at(31, 16)[1] > 0.6 && at(0, 16)[1] == 0.0,
            "{up:?}: right {:?}, left {:?}",
            at(31, 16),
            at(0, 16)
        );
        assert!(picture.alpha.iter().all(|&alpha| alpha == 1.0));
    }
}

/// Catches points and lines that are not drawn at their radius: a disc and a bar of known area.
#[test]
fn points_and_lines_have_their_radius() {
    let mut attributes = schema().attributes;
    attributes[3] =
        Attribute { name: names::RADIUS.into(), value_type: ValueType::F32, components: 1, rate: Rate::Grid };
    let mut grid = quad(DVec3::new(0.0, 0.0, -2.0), 1.0, 255.0);
    grid.columns[3] = 0.5_f32.to_le_bytes().to_vec();
    (grid.arities, grid.indices) = (vec![1], vec![2]);
    let mut points = Grids { schema: Schema { attributes, ..Schema::default() }, grids: vec![grid], at: 0 };
    let area = |points: &mut Grids| -> f32 {
        let wide = Viewpoint::Camera(Camera { resolution: [256, 256], ..camera(DVec3::ZERO) });
        let options = RelightOptions { viewpoint: wide, ..options(DVec3::ZERO) };
        points.at = 0;
        relight(points, &options, &mut |_| {}).expect("a picture").alpha.iter().sum()
    };
    // 256 pixels are 4 units at depth 2: a radius of 0.5 is 32 pixels.
    let (disc, found) = (std::f32::consts::PI * 32.0 * 32.0, area(&mut points));
    assert!((found - disc).abs() < 0.01 * disc, "{found}, {disc} expected");
    // A line of 2 units, 128 pixels, 64 wide, with half a disc at either end.
    (points.grids[0].arities, points.grids[0].indices) = (vec![2], vec![2, 3]);
    points.grids[0].positions.iter_mut().for_each(|p| p.y = 0.0);
    let (bar, found) = (128.0 * 64.0 + disc, area(&mut points));
    assert!((found - bar).abs() < 0.01 * bar, "{found}, {bar} expected");
    // A point without a radius is still seen.
    points.grids[0].columns[3].fill(0);
    (points.grids[0].arities, points.grids[0].indices) = (vec![1], vec![2]);
    assert!((2.0..5.0).contains(&area(&mut points)), "{}", area(&mut points));
}

/// Catches culling that hides what is seen or keeps what is not: hidden, beside, behind, and through the near plane.
#[test]
fn visible_faces_are_those_that_show() {
    let at = |x: f64, y: f64, z: f64| DVec3::new(x, y, z);
    let mut floor = quad(at(0.0, 0.0, 0.0), 50.0, 51.0);
    floor.positions.iter_mut().for_each(|p| *p = Vec3::new(p.x, -5.0, p.y));
    let mut grids = vec![
        quad(at(0.0, 0.0, -4.0), 1.0, 51.0),
        quad(at(0.0, 0.0, -5.0), 0.5, 51.0),
        quad(at(30.0, 0.0, -4.0), 1.0, 51.0),
        quad(at(0.0, 0.0, 4.0), 1.0, 51.0),
        quad(at(2.5, 0.0, -8.0), 1.0, 51.0),
        floor,
    ];
    // Enough grids for several batches: a row of which the nearest hides the rest.
    grids.extend((0..1_000).map(|i| quad(at(-2.0, 2.0, -6.0 - f64::from(i)), 0.3, 51.0)));
    let mut source = stream(grids);
    let run = |threads: usize, source: &mut Grids| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        pool.install(|| visible_faces(source, &camera(DVec3::ZERO), 2, &mut |_| {})).expect("visible faces")
    };
    let visible = run(1, &mut source);
    let found: Vec<bool> = (0..7).map(|grid| !visible.of_grid(grid).is_empty()).collect();
    assert_eq!(found, [true, false, false, false, true, true, true]);
    assert_eq!((visible.grid_count(), visible.of_grid(1_006).len(), source.at), (1_006, 0, 0));
    assert!(visible.face_count() < 300, "{}", visible.face_count());
    for threads in [2, 5] {
        assert_eq!(run(threads, &mut source), visible, "{threads} threads");
    }
}

/// Catches a picture of the visible part alone that is not the picture of everything, a vertex or value that is mixed
/// up on the way, and parts that nobody sees.
#[test]
fn what_is_seen_makes_the_same_picture() {
    let grids: Vec<Microgrid> = (0..700)
        .map(|i| {
            let (x, y) = (f64::from(i % 30) / 5.0 - 3.0, f64::from(i / 30) / 5.0 - 3.0);
            // A face that shares an edge but hides behind the others
            let mut grid = quad(DVec3::new(x, y, -3.0 - f64::from(i % 7)), 0.3, (i % 255) as f32);
            let behind = grid.positions[0] + Vec3::new(0.0, 0.0, -90.0);
            grid.positions.insert(0, behind);
            grid.indices.iter_mut().for_each(|index| *index += 1);
            grid.push_face(&[0, 1, 2]);
            for (attribute, column) in stream(Vec::new()).schema().attributes.iter().zip(&mut grid.columns) {
                if attribute.rate == Rate::Vertex {
                    let first = column[..attribute.value_bytes()].to_vec();
                    column.splice(0..0, first);
                }
            }
            grid
        })
        .collect();
    let options = options(DVec3::ZERO);
    let Viewpoint::Camera(camera) = &options.viewpoint else { panic!("a camera") };
    let mut all = stream(grids.clone());
    let faces = visible_faces(&mut all, camera, options.supersampling, &mut |_| {}).expect("visible faces");
    let mut visible = Visible::new(all, faces.clone()).expect("a stream");
    let (mut grid, mut seen) = (Microgrid::default(), Vec::new());
    while visible.next(&mut grid).expect("a grid") {
        grid.validate(visible.schema()).expect("a sound grid");
        seen.push(grid.clone());
    }
    assert_eq!(seen.iter().map(Microgrid::face_count).sum::<usize>(), faces.face_count());
    assert!(seen.iter().map(Microgrid::vertex_count).sum::<usize>() < 5 * 700);
    let (whole, part) = (draw(grids, &options), draw(seen, &options));
    assert_eq!((whole.rgb, whole.alpha), (part.rgb, part.alpha));
}

/// Catches pictures that depend on the number of threads.
#[test]
fn threads_do_not_change_the_picture() {
    let grids: Vec<Microgrid> = (0..700)
        .map(|i| {
            let (x, y) = (f64::from(i % 30) / 5.0 - 3.0, f64::from(i / 30) / 5.0 - 3.0);
            quad(DVec3::new(x, y, -3.0 - f64::from(i % 7)), 0.3, (i % 255) as f32)
        })
        .collect();
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        pool.install(|| draw(grids.clone(), &options(DVec3::ZERO)))
    };
    assert_eq!(run(1), run(3));
}

/// Catches an attribute that is guessed, or an error that does not name the candidates.
#[test]
fn the_attribute_is_found_or_the_candidates_are_named() {
    let mut schema = schema();
    assert_eq!(find_attribute(&schema, None).expect("found"), 1);
    let error = find_attribute(&schema, Some("sh_oclusion")).expect_err("a slip");
    assert_eq!((error.kind(), error.hint_text()), (ErrorKind::NotFound, Some("did you mean `sh_occlusion`")));
    assert_eq!(find_attribute(&schema, Some("N")).expect_err("no coefficients").kind(), ErrorKind::Invalid);
    schema.attributes[1].name = "visibility".into();
    let error = find_attribute(&schema, None).expect_err("no name says so");
    assert_eq!(error.hint_text(), Some("it could be `visibility`"));
    assert_eq!(find_attribute(&schema, Some("visibility")).expect("asked for"), 1);
    schema.attributes[1].components = 8;
    assert!(
        find_attribute(&schema, None).expect_err("none").hint_text().is_some_and(|h| h.contains("bake it"))
    );
}

/// Catches impossible options that reach the work.
#[test]
fn impossible_options_are_refused() {
    let good = options(DVec3::ZERO);
    for bad in [
        RelightOptions { exposure_stops: f32::NAN, ..good.clone() },
        RelightOptions { rotation_degrees: f64::INFINITY, ..good.clone() },
        RelightOptions { light_bands: Some(7), ..good.clone() },
        RelightOptions { cosine_bands: Some(0), ..good.clone() },
        RelightOptions { supersampling: 0, ..good.clone() },
        RelightOptions { viewpoint: Viewpoint::Automatic([0, 4]), ..good.clone() },
        RelightOptions { viewpoint: Viewpoint::Automatic([1 << 20, 1 << 20]), ..good.clone() },
    ] {
        let mut source = stream(vec![quad(DVec3::ZERO, 1.0, 51.0)]);
        assert!(relight(&mut source, &bad, &mut |_| {}).is_err(), "{:?}", bad.viewpoint);
    }
}

/// Catches broken coefficients that blacken their neighbours or reach the file.
#[test]
fn broken_coefficients_stay_where_they_are() {
    let mut grid = quad(DVec3::new(0.0, 0.0, -2.0), 1.0, 51.0);
    for value in [f32::NAN, f32::INFINITY, -1e30] {
        grid.columns[1][..4].copy_from_slice(&value.to_le_bytes());
        let picture = draw(vec![grid.clone()], &options(DVec3::ZERO));
        assert!(picture.rgb.iter().all(|v| v.is_finite() && *v >= 0.0), "{value}");
    }
}

/// Catches values that are lit, scaled or taken from another column when they are to be drawn as they are.
#[test]
fn values_are_shown_as_they_are() {
    let mut options = options(DVec3::ZERO);
    options.shown = Some(names::ALBEDO.into());
    let picture = draw(vec![quad(DVec3::new(0.0, 0.0, -2.0), 1.0, 51.0)], &options);
    let middle = 3 * (16 * 32 + 16);
    assert!(picture.rgb[middle..middle + 3].iter().all(|value| (value - 0.2).abs() < 1e-6));
    options.shown = Some("albedoo".into());
    let error = relight(&mut stream(vec![]), &options, &mut |_| {}).expect_err("a slip");
    assert!(error.hint_text().is_some_and(|hint| hint.contains("`albedo`")), "{error}");
}
