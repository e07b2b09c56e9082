//! Summaries, comparisons and exports of small streams against numbers computed by hand.

use std::path::Path;

use glam::{DVec3, Vec3};

use super::compare::compare;
use super::export::{export, export_ply};
use super::inspect::inspect_stream;
use crate::stream::{Attribute, Microgrid, MicrogridStream, Rate, Schema, ValueType};
use crate::{ErrorKind, Result};

/// Grids in memory.
#[derive(Clone)]
struct Grids {
    schema: Schema,
    grids: Vec<Microgrid>,
    next: usize,
}

impl MicrogridStream for Grids {
    fn schema(&self) -> &Schema {
        &self.schema
    }

    fn rewind(&mut self) -> Result<()> {
        self.next = 0;
        Ok(())
    }

    fn next(&mut self, grid: &mut Microgrid) -> Result<bool> {
        let Some(next) = self.grids.get(self.next) else { return Ok(false) };
        grid.clone_from(next);
        self.next += 1;
        Ok(true)
    }
}

/// `count` squares of four vertices side by side. `value` gives attribute, grid, vertex and component a number.
fn squares(
    attributes: Vec<Attribute>,
    count: usize,
    value: impl Fn(&str, usize, usize, usize) -> f32,
) -> Grids {
    let schema = Schema { attributes, ..Schema::default() };
    let grid = |number: usize| {
        let mut grid = Microgrid::default();
        grid.clear(schema.attributes.len());
        grid.anchor = DVec3::new(2.0 * number as f64, 0.0, 0.0);
        grid.positions = vec![Vec3::ZERO, Vec3::X, Vec3::new(1.0, 1.0, 0.0), Vec3::Y];
        grid.push_face(&[0, 1, 2, 3]);
        for (column, attribute) in schema.attributes.iter().enumerate() {
            for vertex in 0..if attribute.rate == Rate::Vertex { 4 } else { 1 } {
                let values: Vec<f32> = (0..usize::from(attribute.components))
                    .map(|component| value(&attribute.name, number, vertex, component))
                    .collect();
                grid.push_values(attribute, column, &values);
            }
        }
        grid.validate(&schema).unwrap();
        grid
    };
    Grids { grids: (0..count).map(grid).collect(), schema, next: 0 }
}

fn sh(value_type: ValueType, components: u16) -> Vec<Attribute> {
    vec![Attribute::vertex("sh", value_type, components)]
}

/// Catches wrong counts, ranges, means or JSON names, and large integers rounded to f32.
#[test]
fn inspect_counts_and_averages() {
    let attributes = vec![
        Attribute::vertex("heat", ValueType::F16, 2),
        Attribute::vertex("opacity", ValueType::U8, 1),
        Attribute::grid("id", ValueType::U32, 1),
    ];
    let mut stream = squares(attributes, 3, |name, grid, vertex, component| match name {
        "heat" => (vertex as f32 - 1.0) * if component == 0 { 1.0 } else { 0.5 },
        "opacity" => 255.0 * (grid == 2) as u8 as f32,
        _ => 0.0,
    });
    for (number, grid) in stream.grids.iter_mut().enumerate() {
        grid.columns[2] = (16_777_217 + number as u32).to_le_bytes().to_vec();
    }
    let summary = inspect_stream(&mut stream).unwrap();
    let expected = serde_json::json!({
        "grids": 3, "micropolygons": 3, "vertices": 12,
        "bounds": {"min": [0.0, 0.0, 0.0], "max": [5.0, 1.0, 0.0]},
        "attributes": [
            {"name": "heat", "type": "f16", "components": 2, "min": [-1.0, -0.5], "max": [2.0, 1.0], "mean": [0.5, 0.25]},
            {"name": "opacity", "type": "u8", "components": 1, "min": [0.0], "max": [255.0], "mean": [85.0]},
            {"name": "id", "type": "u32", "components": 1,
             "min": [16_777_217.0], "max": [16_777_219.0], "mean": [16_777_218.0]},
        ],
    });
    assert_eq!(serde_json::to_value(&summary).unwrap(), expected);
    let text = summary.to_string();
    assert!(
        text.contains("micropolygons  3\n") && text.contains("heat_1") && text.contains("u32/grid"),
        "{text}"
    );
}

/// Catches a NaN that spoils a mean or is hidden, and an empty stream that panics.
#[test]
fn inspect_survives_nan_and_nothing() {
    let mut stream =
        squares(sh(ValueType::F32, 1), 1, |_, _, vertex, _| [1.0, f32::NAN, f32::INFINITY, 3.0][vertex]);
    let summary = inspect_stream(&mut stream).unwrap();
    let attribute = &summary.attributes[0];
    assert_eq!(
        (attribute.min[0], attribute.max[0], attribute.mean[0], attribute.not_finite),
        (1.0, 3.0, 2.0, 2)
    );
    let empty = inspect_stream(&mut squares(sh(ValueType::F32, 1), 0, |_, _, _, _| 0.0)).unwrap();
    assert!(serde_json::to_value(&empty).unwrap()["bounds"]["min"][0].is_null());
    assert!(!empty.to_string().contains("bounds"));
}

/// Catches a bias of the wrong sign, and bands cut at the wrong coefficients.
#[test]
fn compare_measures_components_and_bands() {
    let mut a = squares(sh(ValueType::F32, 4), 2, |_, _, _, _| 1.0);
    let mut b = squares(sh(ValueType::F16, 4), 2, |_, _, vertex, component| {
        1.0 + match component {
            0 => 0.5,
            1 => [1.0, -1.0, 1.0, -1.0][vertex],
            3 => [2.0, 0.0, 0.0, 0.0][vertex],
            _ => 0.0,
        }
    });
    let found = compare(&mut a, &mut b).unwrap();
    let band_1 = ((1.0_f64 + 0.0 + 1.0) / 3.0).sqrt();
    let expected = serde_json::json!({"attributes": [{
        "name": "sh", "rmse": [0.5, 1.0, 0.0, 1.0], "max": [0.5, 1.0, 0.0, 2.0], "bias": [0.5, 0.0, 0.0, 0.5],
        "bands": [0.5, band_1],
    }]});
    assert_eq!(serde_json::to_value(&found).unwrap(), expected);
    assert_eq!((found.vertices, found.skipped), (8, 0));
    assert!(found.to_string().contains("sh band 1"));
    let bands = |components| {
        let stream = squares(sh(ValueType::F32, components), 1, |_, _, _, _| 1.0);
        compare(&mut stream.clone(), &mut stream.clone()).unwrap().attributes[0].bands.len()
    };
    assert_eq!([1, 3, 4, 9, 16, 25, 36, 49].map(bands), [1, 0, 2, 3, 4, 5, 6, 0]);
}

/// Catches vertices that were not baked and count as zeros, in either stream.
#[test]
fn compare_skips_what_was_not_baked() {
    let mut attributes = sh(ValueType::F32, 1);
    attributes.push(Attribute::vertex("baked", ValueType::U8, 1));
    let baked = |which: usize| {
        squares(attributes.clone(), 2, move |name, grid, vertex, _| match name {
            "baked" => f32::from(vertex != which),
            _ if vertex == which => 100.0,
            _ => grid as f32,
        })
    };
    let found = compare(&mut baked(0), &mut baked(3)).unwrap();
    assert_eq!((found.vertices, found.skipped), (4, 4));
    assert_eq!(found.attributes.len(), 1);
    assert_eq!((found.attributes[0].rmse[0], found.attributes[0].max[0]), (0.0, 0.0));
    let mut nothing = squares(attributes.clone(), 2, |_, _, _, _| 0.0);
    let error = compare(&mut nothing.clone(), &mut nothing).unwrap_err();
    assert_eq!(error.message(), "nothing to compare: 8 vertices, none baked in both streams");
}

/// Catches a NaN that a maximum forgets.
#[test]
fn compare_does_not_hide_nan() {
    let mut a = squares(sh(ValueType::F32, 1), 1, |_, _, _, _| 1.0);
    let mut b = squares(sh(ValueType::F32, 1), 1, |_, _, vertex, _| if vertex == 1 { f32::NAN } else { 5.0 });
    let found = compare(&mut a, &mut b).unwrap().attributes.remove(0);
    assert!(found.rmse[0].is_nan() && found.max[0].is_nan() && found.bias[0].is_nan());
}

/// Catches streams of different shapes that are compared as far as they go.
#[test]
fn compare_names_the_grid_that_differs() {
    let stream = || squares(sh(ValueType::F32, 1), 3, |_, _, _, _| 1.0);
    let message = |change: fn(&mut Grids)| {
        let mut other = stream();
        change(&mut other);
        compare(&mut stream(), &mut other).map_err(|error| error.message().to_string())
    };
    assert_eq!(
        message(|b| drop(b.grids.pop())).unwrap_err(),
        "stream B ends before grid 2, stream A goes on"
    );
    assert_eq!(
        message(|b| b.grids[1].indices.swap(1, 3)).unwrap_err(),
        "grid 1 has other faces in A than in B"
    );
    let moved = message(|b| b.grids[2].positions[1].x += 0.001).unwrap_err();
    assert!(moved.starts_with("vertex 1 of grid 2 is at [5, 0, 0] in A and at [5.001"), "{moved}");
    // The same place on another anchor is no difference.
    let rebased = message(|b| {
        b.grids[2].anchor.x -= 0.1;
        b.grids[2].positions.iter_mut().for_each(|p| p.x += 0.1);
    });
    assert!(rebased.is_ok(), "{rebased:?}");
    let mut renamed = stream();
    renamed.schema.attributes[0].name = "other".into();
    let error = compare(&mut stream(), &mut renamed).unwrap_err();
    assert_eq!(error.hint_text(), Some("A has sh; B has other"));
}

/// The header's lines and the bytes behind it.
fn split_ply(path: &Path) -> (Vec<String>, Vec<u8>) {
    let bytes = std::fs::read(path).unwrap();
    let end = bytes.windows(11).position(|window| window == b"end_header\n").unwrap() + 11;
    let header = std::str::from_utf8(&bytes[..end]).unwrap().lines().map(str::to_owned).collect();
    (header, bytes[end..].to_vec())
}

/// Catches any byte that is not where PLY wants it: properties in order, faces behind all vertices, edges, indices
/// counted over the whole file.
#[test]
fn ply_has_every_attribute_in_place() {
    let attributes = vec![
        Attribute::vertex("albedo", ValueType::U8, 3),
        Attribute::vertex("N", ValueType::F32, 3),
        Attribute::grid("id", ValueType::U32, 1),
    ];
    let mut stream = squares(attributes, 2, |name, grid, vertex, component| match name {
        "albedo" => 51.0 * vertex as f32,
        "N" => [0.0, 0.0, 1.0][component],
        _ => 7.0 + grid as f32,
    });
    stream.grids[0].push_face(&[3, 1]);
    stream.grids[1].push_face(&[2]);
    stream.grids[1].push_face(&[0, 2, 1]);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    let report = export(&mut stream, &path, &Default::default()).unwrap();
    assert_eq!((report.vertices, report.faces, report.lines, report.points), (8, 3, 1, 1));
    assert_eq!(report.bytes, std::fs::metadata(&path).unwrap().len());
    assert!(!report.double_positions);
    let (header, body) = split_ply(&path);
    let expected = "ply|format binary_little_endian 1.0|comment meters_per_unit 1|comment up y|element vertex 8|\
        property float x|property float y|property float z|property float nx|property float ny|property float nz|\
        property float albedo_0|property float albedo_1|property float albedo_2|property float id_0|\
        element face 3|property list uchar int vertex_indices|\
        element edge 1|property int vertex1|property int vertex2|end_header";
    assert_eq!(header.join("|"), expected);
    let mut bytes = Vec::new();
    for (x, grid) in [(0.0, 0), (2.0, 1)] {
        for (vertex, [dx, dy]) in [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]].into_iter().enumerate() {
            let albedo = (f64::from(51 * vertex as u32) / 255.0) as f32;
            let values: [f32; 10] =
                [x + dx, dy, 0.0, 0.0, 0.0, 1.0, albedo, albedo, albedo, 7.0 + grid as f32];
            bytes.extend(values.iter().flat_map(|value| value.to_le_bytes()));
        }
    }
    for face in [&[0, 1, 2, 3][..], &[4, 5, 6, 7], &[4, 6, 5]] {
        bytes.push(face.len() as u8);
        bytes.extend(face.iter().flat_map(|index: &u32| index.to_le_bytes()));
    }
    bytes.extend([3_u32, 1].iter().flat_map(|index| index.to_le_bytes()));
    assert_eq!(body, bytes);
}

/// Catches vertices far from the origin that a float moves visibly, and doubles where floats do.
#[test]
fn ply_positions_are_doubles_where_they_must_be() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    let mut stream = squares(vec![], 2, |_, _, _, _| 0.0);
    assert!(!export_ply(&mut stream, &path).unwrap().double_positions);
    // A long strip must be judged by its edges, not by its length.
    stream.grids.iter_mut().for_each(|grid| {
        grid.anchor.y = 4_100.7;
        grid.positions[2].x = 10_000.0;
        grid.positions[3].x = 10_000.0;
        grid.positions[1] = Vec3::new(0.0, 0.01, 0.0);
    });
    assert!(export_ply(&mut stream, &path).unwrap().double_positions);
    stream.grids.iter_mut().for_each(|grid| grid.anchor.y = 4_100_000.7);
    assert!(export_ply(&mut stream, &path).unwrap().double_positions);
    let (header, body) = split_ply(&path);
    assert!(header.contains(&"property double y".to_string()));
    let y = f64::from_le_bytes(body[8..16].try_into().unwrap());
    assert_eq!(y, 4_100_000.7);
}

/// Catches a format that is half done, and a failed export that leaves a file or destroys an older one.
#[test]
fn a_refused_export_leaves_everything_as_it_was() {
    let folder = tempfile::tempdir().unwrap();
    let mut stream = squares(vec![], 1, |_, _, _, _| 0.0);
    for name in ["a.usdc", "a.usdz", "a.xyz", "a"] {
        let error = export(&mut stream, &folder.path().join(name), &Default::default()).unwrap_err();
        assert_eq!(error.kind(), ErrorKind::Unsupported);
    }
    /// A stream that breaks in its second pass.
    struct Breaks(Grids, u32);
    impl MicrogridStream for Breaks {
        fn schema(&self) -> &Schema {
            self.0.schema()
        }
        fn rewind(&mut self) -> Result<()> {
            self.1 += 1;
            self.0.rewind()
        }
        fn next(&mut self, grid: &mut Microgrid) -> Result<bool> {
            if self.1 > 1 { Err(crate::Error::invalid("broken")) } else { self.0.next(grid) }
        }
    }
    let path = folder.path().join("a.ply");
    std::fs::write(&path, "old").unwrap();
    assert!(export(&mut Breaks(stream, 0), &path, &Default::default()).is_err());
    assert_eq!(std::fs::read(&path).unwrap(), b"old");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
}
