//! Adapters against hand-computed results.

use glam::{DMat4, DVec3, Vec3};

use super::*;
use crate::scene::{Procedural, ProceduralKind};
use crate::stream::procedural::ProceduralStream;
use crate::stream::schema::UpAxis;
use crate::stream::{Attribute, Microgrid, MicrogridStream, Schema, ValueType};
use crate::{ErrorKind, Result};

/// Grids in memory.
struct Grids {
    schema: Schema,
    grids: Vec<Microgrid>,
    next: usize,
}

impl Grids {
    fn new(schema: Schema, grids: Vec<Microgrid>) -> Self {
        grids.iter().for_each(|grid| grid.validate(&schema).unwrap());
        Self { schema, grids, next: 0 }
    }
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

/// The unit square facing +z at `anchor`, with values for every attribute of the schema.
fn square(schema: &Schema, anchor: DVec3, values: &[&[f32]]) -> Microgrid {
    let mut grid = Microgrid::default();
    grid.clear(schema.attributes.len());
    grid.anchor = anchor;
    grid.positions = vec![Vec3::ZERO, Vec3::X, Vec3::new(1.0, 1.0, 0.0), Vec3::Y];
    grid.push_face(&[0, 1, 2, 3]);
    for (index, attribute) in schema.attributes.iter().enumerate() {
        let count = if attribute.rate == crate::stream::Rate::Vertex { 4 } else { 1 };
        (0..count).for_each(|_| grid.push_values(attribute, index, values[index]));
    }
    grid
}

fn with(attributes: Vec<Attribute>) -> Schema {
    Schema { attributes, ..Schema::default() }
}

fn all(stream: &mut dyn MicrogridStream) -> Result<Vec<Microgrid>> {
    let mut grids = Vec::new();
    let mut grid = Microgrid::default();
    while stream.next(&mut grid)? {
        grid.validate(stream.schema())?;
        grids.push(grid.clone());
    }
    Ok(grids)
}

/// Catches columns that end in the wrong place, wrong defaults, bytes not read as value / 255, and grid values that
/// are not spread over vertices.
#[test]
fn concat_joins_schemas() {
    let left = with(vec![
        Attribute::vertex("opacity", ValueType::U8, 1),
        Attribute::grid("id", ValueType::U32, 1),
        Attribute::grid("heat", ValueType::F16, 2),
    ]);
    let right = with(vec![
        Attribute::vertex("N", ValueType::F32, 3),
        Attribute::vertex("heat", ValueType::F32, 2),
        Attribute::vertex("opacity", ValueType::F32, 1),
        Attribute::vertex("albedo", ValueType::U8, 3),
    ]);
    let left_grid = square(&left, DVec3::X, &[&[51.0], &[7.0], &[1.5, 2.5]]);
    let right_grid = square(&right, DVec3::Y, &[&[0.0, 0.0, 1.0], &[3.0, 4.0], &[0.25], &[1.0, 2.0, 3.0]]);
    let streams: Vec<Box<dyn MicrogridStream>> = vec![
        Box::new(Grids::new(left, vec![left_grid.clone()])),
        Box::new(Grids::new(right, vec![right_grid.clone(), right_grid.clone()])),
    ];
    let mut concat = Concat::new(streams).unwrap();
    let names: Vec<&str> = concat.schema().attributes.iter().map(|a| a.name.as_str()).collect();
    assert_eq!(names, ["opacity", "id", "heat", "N", "albedo"]);
    for _ in 0..2 {
        let grids = all(&mut concat).unwrap();
        assert_eq!(grids.len(), 3);
        assert_eq!((grids[0].anchor, &grids[0].positions), (DVec3::X, &left_grid.positions));
        let values = |grid: usize, column: usize, component: usize| -> Vec<f32> {
            (0..4).map(|vertex| grids[grid].unit_value(concat.schema(), column, vertex, component)).collect()
        };
        assert_eq!(values(0, 0, 0), [51.0 * (1.0 / 255.0); 4]);
        assert_eq!(values(2, 0, 0), [0.25; 4]);
        assert_eq!([values(0, 1, 0)[0], values(1, 1, 0)[0]], [7.0, 0.0]);
        assert_eq!([values(0, 2, 1), values(2, 2, 1)], [[2.5; 4], [4.0; 4]]);
        assert_eq!([values(0, 3, 2), values(1, 3, 2)], [[0.0; 4], [1.0; 4]]);
        assert!((values(0, 4, 1)[0] - 0.5).abs() < 0.003 && values(1, 4, 1)[0] == 2.0 * (1.0 / 255.0));
        concat.rewind().unwrap();
    }
}

/// Catches joins that would lose values or mix spaces in silence.
#[test]
fn concat_refuses_what_does_not_fit() {
    let stream = |schema: Schema| -> Box<dyn MicrogridStream> { Box::new(Grids::new(schema, vec![])) };
    let id = |value_type| with(vec![Attribute::grid("id", value_type, 1)]);
    let refused = |a, b| Concat::new(vec![stream(a), stream(b)]).err().map(|error| error.kind());
    assert_eq!(refused(id(ValueType::U32), id(ValueType::F32)), Some(ErrorKind::Invalid));
    assert_eq!(refused(id(ValueType::U32), id(ValueType::U8)), None);
    let sh = |components| with(vec![Attribute::vertex("sh", ValueType::F32, components)]);
    assert_eq!(refused(sh(4), sh(9)), Some(ErrorKind::Invalid));
    assert_eq!(refused(sh(4), Schema { up: UpAxis::Z, ..sh(4) }), Some(ErrorKind::Invalid));
    assert!(Concat::new(vec![]).is_err());
}

/// Catches a turn the wrong way round, and radii or anchors left in the old unit.
#[test]
fn units_and_up_axis_are_converted() {
    let attributes =
        vec![Attribute::vertex("N", ValueType::F32, 3), Attribute::vertex("radius", ValueType::F32, 1)];
    let schema = Schema { meters_per_unit: 0.01, up: UpAxis::Z, attributes };
    let grid = square(&schema, DVec3::new(100.0, 200.0, 300.0), &[&[0.0, 0.0, 1.0], &[50.0]]);
    let mut stream = Convert::to_units(Grids::new(schema, vec![grid.clone()]), 1.0, UpAxis::Y).unwrap();
    let converted = all(&mut stream).unwrap().remove(0);
    let schema = stream.schema().clone();
    assert_eq!((schema.meters_per_unit, schema.up), (1.0, UpAxis::Y));
    assert!((converted.anchor - DVec3::new(1.0, 3.0, -2.0)).length() < 1e-12);
    assert!((converted.positions[2] - Vec3::new(0.01, 0.0, -0.01)).length() < 1e-9);
    assert_eq!(converted.vec3(&schema, 0, 0), Vec3::Y);
    assert!((converted.value(&schema, 1, 0, 0) - 0.5).abs() < 1e-7);
    assert_eq!(converted.indices, grid.indices);
    let mut back = Convert::to_units(Grids::new(schema, vec![converted]), 0.01, UpAxis::Z).unwrap();
    let back = all(&mut back).unwrap().remove(0);
    assert!((back.position(2) - grid.position(2)).length() < 1e-5);
}

/// Catches copies in the wrong order or number, a prototype that ends early, and a second pass that differs.
#[test]
fn instances_are_instance_major_and_rewind() {
    let schema = with(vec![Attribute::grid("id", ValueType::U32, 1)]);
    let grids: Vec<Microgrid> =
        (0..3).map(|i| square(&schema, DVec3::X * f64::from(i), &[&[i as f32]])).collect();
    let matrices = (0..4).map(|i| DMat4::from_translation(DVec3::Y * f64::from(i))).collect();
    let mut stream = Instance::new(Grids::new(schema, grids), MatrixList::new(matrices)).unwrap();
    // A rewind in the middle of the first copy must not leave half a prototype behind.
    let mut grid = Microgrid::default();
    assert!(stream.next(&mut grid).unwrap() && stream.next(&mut grid).unwrap());
    for _ in 0..2 {
        stream.rewind().unwrap();
        let copies = all(&mut stream).unwrap();
        let found: Vec<(f64, f64, f32, f32)> = copies
            .iter()
            .map(|g| {
                let value = |column| g.value(stream.schema(), column, 0, 0);
                (g.anchor.y, g.anchor.x, value(1), value(0))
            })
            .collect();
        let expected: Vec<_> =
            (0..12).map(|i| (f64::from(i / 3), f64::from(i % 3), (i / 3) as f32, (i % 3) as f32)).collect();
        assert_eq!(found, expected);
    }
}

/// Catches a prototype that is cut off, or read once only, when it does not fit the memory set aside for it.
#[test]
fn a_large_prototype_is_read_again_for_every_copy() {
    let schema = Schema::default();
    let quads: Vec<[u8; 4]> = (0..FACES).map(|i| [i as u8, 1, 2, 3]).collect();
    const FACES: usize = 1000;
    let mut grid = square(&schema, DVec3::ZERO, &[]);
    grid.positions = vec![Vec3::ONE; 256];
    quads.iter().for_each(|quad| grid.push_face(quad));
    let count = PROTOTYPE_BYTES_MAX / (256 * 12 + FACES * 5) + 1;
    let matrices = vec![DMat4::IDENTITY; 3];
    let mut stream = Instance::new(Grids::new(schema, vec![grid; count]), MatrixList::new(matrices)).unwrap();
    for _ in 0..2 {
        stream.rewind().unwrap();
        let mut found = 0;
        let mut grid = Microgrid::default();
        while stream.next(&mut grid).unwrap() {
            found += 1;
        }
        assert_eq!(found, 3 * count);
    }
}

/// Catches normals turned like positions, radii scaled by one axis only, and mirrored faces that look inwards.
#[test]
fn normals_radii_and_winding_follow_the_matrix() {
    let schema =
        with(vec![Attribute::vertex("N", ValueType::F32, 3), Attribute::vertex("radius", ValueType::F16, 1)]);
    let slope = Vec3::new(1.0, 0.0, 1.0).normalize();
    let mut grid = square(&schema, DVec3::ZERO, &[&slope.to_array(), &[1.0]]);
    for position in &mut grid.positions {
        position.z = -position.x;
    }
    let check = |matrix: DMat4, radius: f32| {
        let inner = Grids::new(schema.clone(), vec![grid.clone()]);
        let mut stream = Instance::new(inner, MatrixList::new(vec![matrix])).unwrap();
        let copy = all(&mut stream).unwrap().remove(0);
        let [a, b, c] = [0, 1, 2].map(|i| copy.positions[usize::from(copy.indices[i])]);
        let facing = (b - a).cross(c - a).normalize();
        let normal = copy.vec3(stream.schema(), 0, 0);
        assert!((facing - normal).length() < 1e-6, "{facing} {normal}");
        assert_eq!(copy.value(stream.schema(), 1, 0, 0), radius);
        assert_eq!(copy.indices[0], 0);
    };
    check(DMat4::IDENTITY, 1.0);
    check(DMat4::from_scale(DVec3::new(1.0, 1.0, 8.0)), 2.0);
    check(DMat4::from_scale(DVec3::new(-1.0, 1.0, 1.0)), 1.0);
    check(DMat4::from_rotation_y(0.3) * DMat4::from_scale(DVec3::new(2.0, 2.0, -2.0)), 2.0);
}

/// Catches single precision in the wrong place: a copy ten million units away must keep its shape to the last bits.
#[test]
fn far_copies_keep_their_precision() {
    let schema = Schema::default();
    let mut grid = square(&schema, DVec3::new(0.1, 0.2, 0.3), &[]);
    grid.positions[1] = Vec3::new(0.123_456_78, 1e-6, 0.0);
    let far = DVec3::new(1e7 + 0.1, -1e7, 3e6);
    let matrix = DMat4::from_translation(far) * DMat4::from_rotation_z(0.5);
    let inner = Grids::new(schema, vec![grid.clone()]);
    let mut stream = Instance::new(inner, MatrixList::new(vec![matrix])).unwrap();
    let copy = all(&mut stream).unwrap().remove(0);
    for vertex in 0..4 {
        let exact = matrix.transform_point3(grid.position(vertex));
        assert!((copy.position(vertex) - exact).length() < 1e-7, "vertex {vertex}");
    }
}

/// Catches a matrix that is accepted although it flattens the copy; the message must name the copy.
#[test]
fn a_singular_instance_is_named() {
    let schema = Schema::default();
    let grid = square(&schema, DVec3::ZERO, &[]);
    let matrices = vec![DMat4::IDENTITY, DMat4::from_scale(DVec3::new(1.0, 0.0, 1.0))];
    let mut stream = Instance::new(Grids::new(schema, vec![grid]), MatrixList::new(matrices)).unwrap();
    let error = all(&mut stream).unwrap_err();
    assert_eq!(
        (error.kind(), error.message()),
        (ErrorKind::Invalid, "instance 1: a matrix is not invertible")
    );
}

struct Push(DVec3);

impl Displacement for Push {
    fn displace(&self, grid: &mut Microgrid, _: &Schema) -> Result<()> {
        grid.positions.iter_mut().for_each(|position| *position += self.0.as_vec3());
        Ok(())
    }
}

/// Catches anchors left far behind the vertices, and displacements to infinity that pass.
#[test]
fn displaced_grids_get_near_anchors() {
    let schema = Schema::default();
    let grid = square(&schema, DVec3::ONE, &[]);
    let displaced = |by: DVec3| {
        let inner = Grids::new(schema.clone(), vec![grid.clone()]);
        all(&mut Displace::new(inner, Push(by))).map(|mut grids| grids.remove(0))
    };
    let far = displaced(DVec3::new(0.0, 0.0, 1024.0)).unwrap();
    assert!(far.positions.iter().all(|p| p.length() <= 1.0));
    assert_eq!(far.position(2), DVec3::new(2.0, 2.0, 1025.0));
    assert_eq!(displaced(DVec3::splat(0.25)).unwrap().anchor, DVec3::ONE);
    assert!(displaced(DVec3::splat(f64::INFINITY)).is_err());
}

/// All grids of a stream, read in pieces, and how many pieces there were.
fn all_pieces(stream: &mut dyn MicrogridStream) -> (Vec<Microgrid>, usize) {
    let (mut grids, mut grid, mut pieces) = (Vec::new(), Microgrid::default(), 0);
    stream.rewind().unwrap();
    while let Some(piece) = stream.next_piece().unwrap() {
        pieces += 1;
        let mut push = |grid: &Microgrid| {
            grids.push(grid.clone());
            Ok(())
        };
        piece.read(&mut grid, &mut push).unwrap();
    }
    (grids, pieces)
}

/// Catches pieces of an adapter that differ from its grids: a part left out, a copy's number, a matrix.
#[test]
fn pieces_are_the_whole_stream() {
    let jungle = |seed| {
        let parameters = Procedural { kind: ProceduralKind::Jungle, seed, micropolygons: 30_000 };
        ProceduralStream::new(&parameters, 0.01, UpAxis::Z).unwrap()
    };
    let matrices = |count: u32| {
        let turned =
            |i| DMat4::from_rotation_y(0.1 * f64::from(i)) * DMat4::from_scale(DVec3::new(1.0, -2.0, 3.0));
        MatrixList::new((0..count).map(turned).collect())
    };
    let few = Instance::new(jungle(1), matrices(3)).unwrap();
    let metres = Convert::to_units(jungle(2), 1.0, UpAxis::Y).unwrap();
    let metres_again = Convert::to_units(few, 1.0, UpAxis::Y).unwrap();
    let small = Grids::new(metres.schema().clone(), Vec::new());
    let mut joined = Concat::new(vec![Box::new(metres), Box::new(small), Box::new(metres_again)]).unwrap();
    let whole = all(&mut joined).unwrap();
    let (grids, pieces) = all_pieces(&mut joined);
    assert!(grids == whole && pieces > 4, "{pieces} pieces");
    joined.rewind().unwrap();
    assert!(all(&mut joined).unwrap() == whole, "pieces left something behind");

    // A prototype too large to keep, and one of which many fit a piece
    let parameters = Procedural { kind: ProceduralKind::Terrain, seed: 1, micropolygons: 700_000 };
    let large = ProceduralStream::new(&parameters, 1.0, UpAxis::Y).unwrap();
    let mut large = Instance::new(large, matrices(2)).unwrap();
    assert!(all(&mut large).unwrap() == all_pieces(&mut large).0);
    let parameters = Procedural { micropolygons: 100, ..parameters };
    let tiny = ProceduralStream::new(&parameters, 1.0, UpAxis::Y).unwrap();
    let mut many = Instance::new(tiny, matrices(1000)).unwrap();
    let (grids, pieces) = all_pieces(&mut many);
    many.rewind().unwrap();
    assert!(grids == all(&mut many).unwrap() && pieces < 20, "{pieces} pieces");
}
