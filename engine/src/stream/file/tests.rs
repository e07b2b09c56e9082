//! Round trips, flipped bits and lies in `.mgs` files.

use std::path::Path;

use glam::{DVec3, Vec3};

use super::*;
use crate::stream::{Attribute, MicrogridStream, Schema, ValueType};

fn schema() -> Schema {
    Schema {
        attributes: vec![
            Attribute::vertex("N", ValueType::F32, 3),
            Attribute::vertex("opacity", ValueType::F16, 1),
            Attribute::vertex("albedo", ValueType::U8, 3),
            Attribute::grid("id", ValueType::U32, 1),
        ],
        ..Schema::default()
    }
}

/// A strip of `quads` quads whose values differ with `seed`.
fn strip(schema: &Schema, seed: u32, quads: usize) -> Microgrid {
    let mut grid = Microgrid::default();
    grid.clear(schema.attributes.len());
    grid.anchor = DVec3::new(f64::from(seed), 1e6, -0.125);
    let mut state = seed;
    let mut random = move || {
        state = crate::math::hash::combine(state, 1);
        crate::math::hash::unit_f32(state)
    };
    for i in 0..2 * (quads + 1) {
        grid.positions.push(Vec3::new(i as f32 + random(), random(), -random()));
    }
    for quad in 0..quads as u8 {
        grid.push_face(&[2 * quad, 2 * quad + 1, 2 * quad + 3, 2 * quad + 2]);
    }
    for (index, attribute) in schema.attributes.iter().enumerate() {
        let values = if attribute.rate == crate::stream::Rate::Vertex { grid.vertex_count() } else { 1 };
        let values: Vec<f32> =
            (0..values * usize::from(attribute.components)).map(|_| 200.0 * random()).collect();
        grid.push_values(attribute, index, &values);
    }
    grid
}

fn write(path: &Path, schema: &Schema, grids: &[Microgrid]) -> StreamCounts {
    let mut writer = MgsWriter::create(path, schema, &[("sh".into(), "real, l(l+1)+m".into())]).unwrap();
    grids.iter().for_each(|grid| writer.write(grid).unwrap());
    writer.finish().unwrap()
}

fn read(path: &Path) -> crate::Result<Vec<Microgrid>> {
    let mut reader = MgsReader::open(path)?;
    let mut grids = Vec::new();
    let mut grid = Microgrid::default();
    while reader.next(&mut grid)? {
        grids.push(grid.clone());
    }
    Ok(grids)
}

/// Catches a lost or mixed-up column, counts that do not fit, a rewind that does not, and block boundaries.
#[test]
fn grids_come_back_bit_exact() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mgs");
    let schema = schema();
    let grids: Vec<Microgrid> = (0..2000).map(|i| strip(&schema, i, 1 + i as usize % 100)).collect();
    let counts = write(&path, &schema, &grids);
    assert_eq!(counts.grids, 2000);
    let mut reader = MgsReader::open(&path).unwrap();
    assert_eq!(reader.schema(), &schema);
    assert_eq!(reader.metadata(), [("sh".to_string(), "real, l(l+1)+m".to_string())]);
    let footer = reader.footer().unwrap();
    assert_eq!(footer.counts, counts);
    assert!(footer.blocks > 3);
    let mut grid = Microgrid::default();
    for _ in 0..2 {
        for expected in &grids {
            assert!(reader.next(&mut grid).unwrap());
            assert_eq!(&grid, expected);
        }
        assert!(!reader.next(&mut grid).unwrap());
        assert!(!reader.next(&mut grid).unwrap());
        reader.rewind().unwrap();
    }
}
