//! Streams as USD: a Points prim, or overs on the prims that the stream came from.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::Path;

use glam::DVec3;
use openusd::gf::{Vec3f, vec3d};
use openusd::sdf::{self, ChildrenKey, Data, FieldKey, SpecType, Specifier, Value};
use openusd::usda::TextWriter;

use super::super::values;
use super::{ExportOptions, ExportReport, each_grid};
use crate::import::PRIMS_KEY;
use crate::math::Bounds;
use crate::stream::file::AtomicFile;
use crate::stream::schema::{UpAxis, names};
use crate::stream::{Attribute, MicrogridStream, Rate, Schema};
use crate::{Error, ErrorKind, Result};

/// The prim of exported points.
const POINTS_PATH: &str = "/Points";

/// Exports all vertices as one Points prim, about the middle of their box, which its transform puts in place. Normals, widths (two
/// radii) and `displayColor`, `displayOpacity`; every other attribute is a primvar of its name with its components as
/// `elementSize`.
///
/// # Errors
/// [`ErrorKind::Limit`] when the layer takes more memory than allowed, those of the stream, and what the system says.
pub(super) fn export_points(
    stream: &mut dyn MicrogridStream,
    path: &Path,
    options: &ExportOptions<'_>,
) -> Result<ExportReport> {
    let schema = stream.schema().clone();
    let (mut bounds, mut count) = (Bounds::EMPTY, 0_u64);
    each_grid(stream, |grid| {
        bounds = bounds.union(&grid.bounds());
        count += grid.vertex_count() as u64;
        Ok(())
    })?;
    let components: u64 = schema.attributes.iter().map(|attribute| u64::from(attribute.components)).sum();
    need(count * (12 + 4 * components), options, path)?;
    let middle = if bounds.is_empty() { DVec3::ZERO } else { bounds.center() };
    let mut points = Vec::with_capacity(count as usize);
    let mut columns: Vec<Vec<f32>> = vec![Vec::new(); schema.attributes.len()];
    let mut scratch = Vec::new();
    each_grid(stream, |grid| {
        for vertex in 0..grid.vertex_count() {
            points.push(Vec3f::from((grid.position(vertex) - middle).as_vec3().to_array()));
        }
        for ((attribute, from), to) in schema.attributes.iter().zip(&grid.columns).zip(&mut columns) {
            values::unit_values(attribute, from, &mut scratch);
            let times = if attribute.rate == Rate::Grid { grid.vertex_count() } else { 1 };
            (0..times).for_each(|_| to.extend(scratch.iter().map(|&value| value as f32)));
        }
        Ok(())
    })?;

    let mut layer = Layer::new(&schema);
    layer.prim(POINTS_PATH, Specifier::Def, Some("Points"));
    layer.attribute(POINTS_PATH, "points", "point3f[]", Value::Vec3fVec(points), None);
    let translate = Value::Vec3d(vec3d(middle.x, middle.y, middle.z));
    layer.attribute(POINTS_PATH, "xformOp:translate", "double3", translate, None);
    let order = Value::TokenVec(vec!["xformOp:translate".into()]);
    layer.attribute(POINTS_PATH, "xformOpOrder", "token[]", order, None);
    for (attribute, values) in schema.attributes.iter().zip(columns) {
        layer.values(POINTS_PATH, attribute, values);
    }
    let bytes = layer.write(path)?;
    Ok(ExportReport { vertices: count, points: count, bytes, ..ExportReport::default() })
}

/// Exports what a bake added as overs on the prims that the stream was imported from: a primvar of interpolation `vertex` for each
/// attribute, so that the layer can be put above the asset's. A point with several vertices has their mean; a point that
/// no face uses has zeros, and is counted.
///
/// # Errors
/// [`ErrorKind::Invalid`] for a stream that does not say which prims it came from; otherwise as [`export_points`].
pub(super) fn export_over(
    stream: &mut dyn MicrogridStream,
    path: &Path,
    options: &ExportOptions<'_>,
) -> Result<ExportReport> {
    let schema = stream.schema().clone();
    let listed = options.metadata.iter().find(|(key, _)| key == PRIMS_KEY).map(|(_, list)| list.as_str());
    let (Some(listed), Some(id), Some(point)) = (listed, schema.find(names::ID), schema.find(names::POINT))
    else {
        return Err(Error::invalid("this stream does not say which prims it came from").at(path).hint(
            "bake a USD file in a geometry of its own, without instances; or export points, without `--over`",
        ));
    };
    let prims: Vec<Option<(u64, &str)>> = listed.lines().map(parse_prim).collect();
    let baked: Vec<usize> = (0..schema.attributes.len())
        .filter(|&column| is_baked(&schema.attributes[column], options.metadata))
        .collect();
    if baked.is_empty() {
        return Err(Error::invalid("a bake added nothing to this stream").at(path).hint("bake it first"));
    }
    let width: usize = baked.iter().map(|&column| usize::from(schema.attributes[column].components)).sum();
    let points: u64 = prims.iter().flatten().map(|(points, _)| *points).sum();
    need(points.saturating_mul(8 * width as u64 + 4), options, path)?;

    // Sum the vertices of each point
    let mut sums: Vec<Vec<f64>> = Vec::with_capacity(prims.len());
    let mut counts: Vec<Vec<u32>> = Vec::with_capacity(prims.len());
    for prim in &prims {
        let points = prim.map_or(0, |(points, _)| points as usize);
        sums.push(vec![0.0; points * width]);
        counts.push(vec![0; points]);
    }
    let mut report = ExportReport::default();
    let mut columns: Vec<Vec<f64>> = vec![Vec::new(); schema.attributes.len()];
    let (mut ids, mut numbers) = (Vec::new(), Vec::new());
    each_grid(stream, |grid| {
        values::unit_values(&schema.attributes[id], &grid.columns[id], &mut ids);
        values::unit_values(&schema.attributes[point], &grid.columns[point], &mut numbers);
        for &column in &baked {
            values::unit_values(&schema.attributes[column], &grid.columns[column], &mut columns[column]);
        }
        let prim = ids.first().map_or(usize::MAX, |&id| id as usize);
        if !prims.get(prim).is_some_and(Option::is_some) {
            report.left_out += grid.vertex_count() as u64;
            return Ok(());
        }
        for (vertex, &number) in numbers.iter().enumerate() {
            let number = number as usize;
            let Some(count) = counts[prim].get_mut(number) else {
                report.left_out += u64::from(number != u32::MAX as usize);
                continue;
            };
            *count += 1;
            let mut sum = sums[prim][number * width..(number + 1) * width].iter_mut();
            for &column in &baked {
                let n = usize::from(schema.attributes[column].components);
                columns[column][vertex * n..(vertex + 1) * n]
                    .iter()
                    .zip(&mut sum)
                    .for_each(|(v, sum)| *sum += v);
            }
        }
        Ok(())
    })?;

    let mut layer = Layer::new(&schema);
    for ((prim, sums), counts) in prims.iter().zip(&sums).zip(&counts) {
        let Some((_, prim)) = prim else { continue };
        if counts.iter().all(|&count| count == 0) {
            continue;
        }
        report.vertices += counts.len() as u64;
        report.points_without += counts.iter().filter(|&&count| count == 0).count() as u64;
        layer.over(prim);
        let mut first = 0;
        for &column in &baked {
            let n = usize::from(schema.attributes[column].components);
            let mean = |(i, &count): (usize, &u32)| {
                let sum = &sums[i * width + first..i * width + first + n];
                sum.iter().map(move |sum| (sum / f64::from(count.max(1))) as f32).collect::<Vec<_>>()
            };
            let values = counts.iter().enumerate().flat_map(mean).collect();
            layer.values(prim, &schema.attributes[column], values);
            first += n;
        }
    }
    report.bytes = layer.write(path)?;
    Ok(report)
}

/// A line of the list of prims: points and path; none for a prim that an over cannot reach.
fn parse_prim(line: &str) -> Option<(u64, &str)> {
    let (points, path) = line.split_once(' ')?;
    Some((points.parse().ok()?, path)).filter(|(_, path)| sdf::Path::new(path).is_ok())
}

/// Whether a bake added an attribute: it says by which shader.
fn is_baked(attribute: &Attribute, metadata: &[(String, String)]) -> bool {
    metadata.iter().any(|(key, _)| key.strip_suffix(".shader") == Some(&attribute.name))
}

/// Refuses a layer that takes more memory than allowed: it is held whole, and beside it its text of some ten bytes for a number.
fn need(bytes: u64, options: &ExportOptions<'_>, path: &Path) -> Result<()> {
    let need = bytes.saturating_mul(4);
    if need <= options.memory_bytes {
        return Ok(());
    }
    let (need, have) = (need.div_ceil(1 << 20), options.memory_bytes >> 20);
    let message = format!("the layer takes {need} MiB of memory, {have} MiB are allowed");
    Err(Error::new(ErrorKind::Limit, message)
        .at(path)
        .hint("allow more (`--memory`), or export to .ply, which streams"))
}

/// A layer under construction.
struct Layer {
    data: Data,
    /// Prims and their children, the root's under the empty path.
    children: BTreeMap<String, Vec<String>>,
    properties: BTreeMap<String, Vec<String>>,
    meters_per_unit: f64,
    up: UpAxis,
}

impl Layer {
    fn new(schema: &Schema) -> Self {
        let (meters_per_unit, up) = (schema.meters_per_unit, schema.up);
        Self {
            data: Data::new(),
            children: BTreeMap::new(),
            properties: BTreeMap::new(),
            meters_per_unit,
            up,
        }
    }

    /// Adds an over, and overs on all prims above it.
    fn over(&mut self, path: &str) {
        let ends = path.match_indices('/').map(|(at, _)| at).skip(1).chain([path.len()]);
        for end in ends {
            self.prim(&path[..end], Specifier::Over, None);
        }
    }

    /// Adds a prim, unless it is there.
    fn prim(&mut self, path: &str, specifier: Specifier, type_name: Option<&str>) {
        let (parent, name) = path.rsplit_once('/').unwrap_or(("", path));
        let siblings = self.children.entry(parent.into()).or_default();
        if siblings.iter().any(|known| known == name) {
            return;
        }
        siblings.push(name.into());
        let spec = self.data.create_spec(sdf::Path::from(path), SpecType::Prim);
        spec.add(FieldKey::Specifier, Value::Specifier(specifier));
        if let Some(type_name) = type_name {
            spec.add(FieldKey::TypeName, Value::Token(type_name.into()));
        }
    }

    /// Adds an attribute; `interpolation` has components and a word.
    fn attribute(
        &mut self,
        prim: &str,
        name: &str,
        type_name: &str,
        value: Value,
        element_size: Option<i32>,
    ) {
        let spec = self.data.create_spec(sdf::Path::from(format!("{prim}.{name}")), SpecType::Attribute);
        spec.add(FieldKey::TypeName, Value::Token(type_name.into()));
        if name.starts_with("primvars:") || name == "widths" || name == "normals" {
            spec.add("interpolation", Value::Token("vertex".into()));
        }
        if let Some(size) = element_size.filter(|&size| size > 1) {
            spec.add("elementSize", Value::Int(size));
        }
        if name == "xformOpOrder" {
            spec.add(FieldKey::Variability, Value::Variability(sdf::Variability::Uniform));
        }
        spec.add(FieldKey::Default, value);
        self.properties.entry(prim.into()).or_default().push(name.into());
    }

    /// Adds a stream's attribute as USD calls it.
    fn values(&mut self, prim: &str, attribute: &Attribute, values: Vec<f32>) {
        let vectors = |values: &[f32]| {
            Value::Vec3fVec(values.chunks_exact(3).map(|v| Vec3f::from([v[0], v[1], v[2]])).collect())
        };
        match attribute.name.as_str() {
            names::NORMAL => self.attribute(prim, "normals", "normal3f[]", vectors(&values), None),
            names::RADIUS => {
                let widths = values.iter().map(|radius| 2.0 * radius).collect();
                self.attribute(prim, "widths", "float[]", Value::FloatVec(widths), None);
            }
            names::ALBEDO => {
                self.attribute(prim, "primvars:displayColor", "color3f[]", vectors(&values), None)
            }
            names::OPACITY => {
                self.attribute(prim, "primvars:displayOpacity", "float[]", Value::FloatVec(values), None);
            }
            name => {
                let size = Some(i32::from(attribute.components));
                // A dot is no part of a name in USD
                let name = format!("primvars:{}", name.replace(['.', '-'], "_"));
                self.attribute(prim, &name, "float[]", Value::FloatVec(values), size);
            }
        }
    }

    /// Writes the layer as text. Returns its bytes.
    fn write(mut self, path: &Path) -> Result<u64> {
        let tokens = |names: Vec<String>| Value::TokenVec(names.into_iter().map(Into::into).collect());
        let root = self.data.create_spec(sdf::Path::abs_root(), SpecType::PseudoRoot);
        root.add("metersPerUnit", Value::Double(self.meters_per_unit));
        root.add("upAxis", Value::Token(if self.up == UpAxis::Z { "Z" } else { "Y" }.into()));
        for (parent, names) in std::mem::take(&mut self.children) {
            let parent = if parent.is_empty() { sdf::Path::abs_root() } else { sdf::Path::from(parent) };
            if let Some(spec) = self.data.spec_mut(&parent) {
                spec.add(ChildrenKey::PrimChildren, tokens(names));
            }
        }
        for (prim, names) in std::mem::take(&mut self.properties) {
            if let Some(spec) = self.data.spec_mut(&sdf::Path::from(prim)) {
                spec.add(ChildrenKey::PropertyChildren, tokens(names));
            }
        }
        let text = TextWriter::write_to_string(&self.data)
            .map_err(|error| Error::invalid(format!("cannot make the layer: {error:#}")).at(path))?;
        let mut file = AtomicFile::create(path)?;
        file.write_all(text.as_bytes()).map_err(|error| Error::io("write", path, error))?;
        file.commit()?;
        Ok(text.len() as u64)
    }
}
