//! Streams for other programs: binary PLY, USD, EXR of meshes with texture coordinates.

mod exr;
mod usd;

use std::fmt::Write as _;
use std::io::{BufWriter, Write};
use std::path::Path;

use serde::Serialize;

use super::values;
use crate::math::Bounds;
use crate::stream::file::AtomicFile;
use crate::stream::schema::{UpAxis, names};
use crate::stream::{Attribute, Microgrid, MicrogridStream, Rate, Schema};
use crate::{Error, ErrorKind, Result};

/// What an export wrote.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Serialize)]
pub struct ExportReport {
    /// Vertices.
    pub vertices: u64,
    /// Triangles and quads.
    pub faces: u64,
    /// Lines.
    pub lines: u64,
    /// Points; they are vertices that no face needs to mention.
    pub points: u64,
    /// Bytes of the file.
    pub bytes: u64,
    /// Whether positions are written as doubles, because floats would move them visibly.
    pub double_positions: bool,
    /// Overs: vertices in prototypes, where an over cannot reach. Pictures: faces outside of 0 to 1.
    pub left_out: u64,
    /// Overs: points that no face uses, which are zero.
    pub points_without: u64,
}

/// How to export.
#[derive(Clone, Copy, Debug)]
pub struct ExportOptions<'a> {
    /// USD: overs on the prims that the stream came from, instead of points.
    pub over: bool,
    /// EXR: the attribute of texture coordinates.
    pub uv: &'a str,
    /// EXR: pixels across and down.
    pub resolution: [u32; 2],
    /// What USD and EXR may take.
    pub memory_bytes: u64,
    /// What the stream says about itself.
    pub metadata: &'a [(String, String)],
}

impl Default for ExportOptions<'_> {
    fn default() -> Self {
        Self { over: false, uv: "st", resolution: [1024; 2], memory_bytes: 4 << 30, metadata: &[] }
    }
}

/// Positions become doubles when a float at the far end of the bounds is off by more than this much of an edge.
const POSITION_ERROR_MAX: f64 = 1e-3;

/// Bytes gathered before a write.
const BUFFER_BYTES: usize = 1 << 20;

/// Exports a stream in the format that the file's extension names.
///
/// # Errors
/// [`ErrorKind::Unsupported`] for any but `.ply`, `.usd`, `.usda` and `.exr`, [`ErrorKind::Limit`] when USD or EXR
/// take more memory than allowed; otherwise like [`export_ply`].
pub fn export(
    stream: &mut dyn MicrogridStream,
    path: &Path,
    options: &ExportOptions<'_>,
) -> Result<ExportReport> {
    let extension =
        path.extension().and_then(|extension| extension.to_str()).unwrap_or("").to_ascii_lowercase();
    match extension.as_str() {
        "ply" => export_ply(stream, path),
        "usd" | "usda" if options.over => usd::export_over(stream, path, options),
        "usd" | "usda" => usd::export_points(stream, path, options),
        // What the library writes as binary, OpenUSD opens without its prims
        "usdc" => Err(Error::unsupported("export to binary USD is not supported")
            .at(path)
            .hint("export to .usda, and convert it: `usdcat in.usda -o out.usdc`")),
        "exr" => exr::export_exr(stream, path, options),
        _ => Err(Error::unsupported(format!("cannot export to `.{extension}`"))
            .at(path)
            .hint("export to .ply, .usda or .exr")),
    }
}

/// Exports a stream as binary little-endian PLY, in constant memory and three or four passes: PLY wants the counts
/// first and all vertices before all faces.
///
/// Vertices carry `x y z nx ny nz`, the normal zero where there is none, and a float `NAME_i` for every component of
/// every other attribute; `opacity` and `albedo` in bytes become value / 255, attributes per grid are repeated.
/// Triangles and quads become `face`, lines `edge`; points are vertices alone.
///
/// # Errors
/// [`ErrorKind::Limit`] for 2^32 vertices and more, [`ErrorKind::Invalid`] for a stream that changes between passes,
/// those of the stream, and what the operating system says. Nothing half-written stays.
pub fn export_ply(stream: &mut dyn MicrogridStream, path: &Path) -> Result<ExportReport> {
    let file = AtomicFile::create(path)?;
    let schema = stream.schema().clone();
    let mut report = count(stream)?;
    if report.vertices > u64::from(u32::MAX) {
        let message = format!("{} vertices, a PLY file can hold {}", report.vertices, u32::MAX);
        return Err(Error::new(ErrorKind::Limit, message).at(path));
    }
    let mut out = Output { writer: BufWriter::with_capacity(BUFFER_BYTES, file), path, bytes: 0 };
    out.write(header(&schema, &report).as_bytes())?;
    let mut written = [0; 3];
    written[0] = write_vertices(stream, &schema, report.double_positions, &mut out)?;
    written[1] = write_faces(stream, &mut out, |arity| arity > 2, true)?;
    if report.lines > 0 {
        written[2] = write_faces(stream, &mut out, |arity| arity == 2, false)?;
    }
    if written != [report.vertices, report.faces, report.lines] {
        return Err(Error::invalid("the stream changed while it was exported").at(path));
    }
    report.bytes = out.bytes;
    let file = out.writer.into_inner().map_err(|error| Error::io("write", path, error.into_error()))?;
    file.commit()?;
    Ok(report)
}

/// Counts, and decides how positions are written.
fn count(stream: &mut dyn MicrogridStream) -> Result<ExportReport> {
    let mut report = ExportReport::default();
    let mut bounds = Bounds::EMPTY;
    let (mut edges, mut sized) = (0.0, 0_u64);
    each_grid(stream, |grid| {
        let own = grid.bounds();
        bounds = bounds.union(&own);
        report.vertices += grid.vertex_count() as u64;
        for &arity in &grid.arities {
            match arity {
                1 => report.points += 1,
                2 => report.lines += 1,
                _ => report.faces += 1,
            }
        }
        let edge = typical_edge(grid);
        if edge > 0.0 {
            edges += edge;
            sized += 1;
        }
        Ok(())
    })?;
    if sized > 0 {
        let farthest = bounds.min.abs().max(bounds.max.abs()).max_element();
        let rounding = farthest * f64::from(f32::EPSILON) / 2.0;
        report.double_positions = rounding > POSITION_ERROR_MAX * edges / sized as f64;
    }
    Ok(report)
}

/// The first edge of a grid's first face. Among points, which have none, about the distance of n on a square.
fn typical_edge(grid: &Microgrid) -> f64 {
    match grid.faces().next() {
        Some(&[a, b, ..]) => {
            grid.positions[usize::from(a)].as_dvec3().distance(grid.positions[usize::from(b)].as_dvec3())
        }
        _ => grid.bounds().size().max_element() / (grid.vertex_count() as f64).sqrt(),
    }
}

fn header(schema: &Schema, report: &ExportReport) -> String {
    let mut text = String::from("ply\nformat binary_little_endian 1.0\n");
    let up = match schema.up {
        UpAxis::Y => "y",
        UpAxis::Z => "z",
    };
    let mut line = |line: String| writeln!(text, "{line}").expect("a string takes any text");
    line(format!("comment meters_per_unit {}", schema.meters_per_unit));
    line(format!("comment up {up}"));
    line(format!("element vertex {}", report.vertices));
    let position = if report.double_positions { "double" } else { "float" };
    ["x", "y", "z"].into_iter().for_each(|name| line(format!("property {position} {name}")));
    ["nx", "ny", "nz"].into_iter().for_each(|name| line(format!("property float {name}")));
    for (_, attribute) in exported(schema) {
        (0..attribute.components).for_each(|i| line(format!("property float {}_{i}", attribute.name)));
    }
    let index = if report.vertices > i32::MAX as u64 { "uint" } else { "int" };
    line(format!("element face {}", report.faces));
    line(format!("property list uchar {index} vertex_indices"));
    if report.lines > 0 {
        line(format!("element edge {}", report.lines));
        line(format!("property {index} vertex1"));
        line(format!("property {index} vertex2"));
    }
    line("end_header".to_string());
    text
}

/// The attributes that get properties of their own, with their columns: all but the normal.
fn exported(schema: &Schema) -> impl Iterator<Item = (usize, &Attribute)> {
    schema.attributes.iter().enumerate().filter(|(_, attribute)| attribute.name != names::NORMAL)
}

fn write_vertices(
    stream: &mut dyn MicrogridStream,
    schema: &Schema,
    double_positions: bool,
    out: &mut Output,
) -> Result<u64> {
    let normal = schema.find(names::NORMAL);
    let mut columns: Vec<Vec<f64>> = vec![Vec::new(); schema.attributes.len()];
    let mut bytes = Vec::new();
    let mut written = 0;
    each_grid(stream, |grid| {
        bytes.clear();
        for ((attribute, column), values) in schema.attributes.iter().zip(&grid.columns).zip(&mut columns) {
            values::unit_values(attribute, column, values);
        }
        let value = |column: usize, vertex: usize| {
            let attribute = &schema.attributes[column];
            let components = usize::from(attribute.components);
            let first = if attribute.rate == Rate::Vertex { vertex * components } else { 0 };
            columns[column][first..first + components].iter().map(|&value| value as f32)
        };
        for vertex in 0..grid.vertex_count() {
            let position = grid.position(vertex).to_array();
            match double_positions {
                true => bytes.extend(position.iter().flat_map(|x| x.to_le_bytes())),
                false => bytes.extend(position.iter().flat_map(|&x| (x as f32).to_le_bytes())),
            }
            match normal {
                Some(column) => bytes.extend(value(column, vertex).flat_map(f32::to_le_bytes)),
                None => bytes.extend([0; 12]),
            }
            for (column, _) in exported(schema) {
                bytes.extend(value(column, vertex).flat_map(f32::to_le_bytes));
            }
        }
        written += grid.vertex_count() as u64;
        out.write(&bytes)
    })?;
    Ok(written)
}

/// Writes the faces whose arity `wanted` likes, with the vertices' numbers in the file and perhaps their arity first.
fn write_faces(
    stream: &mut dyn MicrogridStream,
    out: &mut Output,
    wanted: fn(usize) -> bool,
    with_arity: bool,
) -> Result<u64> {
    let (mut first, mut written) = (0_u64, 0);
    let mut bytes = Vec::new();
    each_grid(stream, |grid| {
        bytes.clear();
        for face in grid.faces().filter(|face| wanted(face.len())) {
            if with_arity {
                bytes.push(face.len() as u8);
            }
            bytes.extend(face.iter().flat_map(|&index| (first as u32 + u32::from(index)).to_le_bytes()));
            written += 1;
        }
        first += grid.vertex_count() as u64;
        if first > u64::from(u32::MAX) {
            return Err(Error::invalid("the stream changed while it was exported"));
        }
        out.write(&bytes)
    })?;
    Ok(written)
}

/// Reads a stream from its start.
fn each_grid(stream: &mut dyn MicrogridStream, mut each: impl FnMut(&Microgrid) -> Result<()>) -> Result<()> {
    stream.rewind()?;
    let mut grid = Microgrid::default();
    while stream.next(&mut grid)? {
        each(&grid)?;
    }
    Ok(())
}

/// A counted, buffered file.
struct Output<'a> {
    writer: BufWriter<AtomicFile>,
    path: &'a Path,
    bytes: u64,
}

impl Output<'_> {
    fn write(&mut self, bytes: &[u8]) -> Result<()> {
        self.bytes += bytes.len() as u64;
        self.writer.write_all(bytes).map_err(|error| Error::io("write", self.path, error))
    }
}
