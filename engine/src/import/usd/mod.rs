//! USD, as text, binary or package, composed: meshes, points, curves, instances and primvars (`docs/import.md`).
//!
//! The `openusd` library composes and reads, behind a `fence` in a thread of its own; `walk` lists what a stage shows;
//! each prim becomes a mesh when its turn comes. What stands once is written as it is, each prototype once for all its
//! copies.

mod basis;
mod curves;
mod dress;
mod fence;
mod guard;
mod instancer;
mod points;
mod polygons;
mod primvar;
mod read;
#[cfg(test)]
mod tests;
mod value;
mod walk;
mod xform;

use std::path::Path;
use std::sync::Arc;

use self::fence::Reader;
use self::walk::{Catalogue, Kind, Prim};
use super::assembly::Assembly;
use super::emit::{Carried, Emitter, Placement};
use super::mesh::Mesh;
use super::{Copies, GridSink, ImportOptions, ImportReport, SourceCounts, cut, diced, radius};
use crate::dice::Rate;
use crate::stream::adapt::MatrixSource;
use crate::stream::schema::UpAxis;
use crate::{Error, ErrorKind, Result};

/// Prototypes that are files of their own at most; copies of further ones are written one by one.
const PROTOTYPES_MAX: usize = 1024;

/// Key of the metadata that lists the prims, one a line, in the order of `id`: the number of its points, or `-` for a prim that
/// an over cannot reach, and its path.
pub const PRIMS_KEY: &str = "usd.prims";

/// Keys of the metadata for the stage's own `metersPerUnit` and `upAxis`.
pub const UNITS_KEY: &str = "usd.metersPerUnit";
/// See [`UNITS_KEY`].
pub const UP_KEY: &str = "usd.upAxis";

/// Bytes of that list at most: a header has room for a megabyte.
const PRIMS_BYTES_MAX: usize = 960 << 10;

/// Imports a USD file.
pub(super) fn import(path: &Path, options: &ImportOptions, sink: &mut dyn GridSink) -> Result<ImportReport> {
    let (reader, catalogue) = Reader::open(path, options)?;
    let Catalogue { prims, assembly, attributes, space, mut report } = catalogue;
    let carried = Carried {
        normal: prims.iter().any(|prim| prim.kind == Kind::Mesh || prim.has_normals),
        albedo: has(&prims, "displayColor"),
        opacity: has(&prims, "displayOpacity"),
        radius: prims.iter().any(|prim| prim.kind != Kind::Mesh),
        extras: attributes,
        point: true,
    };
    let assembly = Arc::new(assembly);
    let up = if space.1 == UpAxis::Z { "Z" } else { "Y" };
    let mut metadata = vec![(UNITS_KEY.into(), space.0.to_string()), (UP_KEY.into(), up.into())];
    metadata.extend(list(&prims, &mut report).map(|list| (PRIMS_KEY.into(), list)));
    let mut import = Import {
        reader,
        options,
        listed: assembly.counts(|inner| inner.listed),
        counts: assembly.counts(|inner| inner.placed),
        assembly,
        emitter: Emitter::with_metadata(sink, carried, options, &metadata)?,
        report,
    };
    import.run(&prims)?;
    Ok(import.report)
}

fn has(prims: &[Prim], primvar: &str) -> bool {
    prims.iter().any(|prim| prim.primvars.iter().any(|own| own.name == primvar))
}

/// The list of paths for the metadata, if there is room.
fn list(prims: &[Prim], report: &mut ImportReport) -> Option<String> {
    let line = |prim: &Prim| match prim.is_shared {
        true => format!("- {}", prim.path),
        false => format!("{} {}", prim.points, prim.path),
    };
    let list = prims.iter().map(line).collect::<Vec<_>>().join("\n");
    if list.len() > PRIMS_BYTES_MAX {
        report.warn(
            "too many prims to remember their paths: results cannot be written back as an over-layer".into(),
        );
        return None;
    }
    Some(list)
}

/// An import under way.
struct Import<'a> {
    reader: Reader,
    options: &'a ImportOptions,
    assembly: Arc<Assembly>,
    /// Per scope how often it stands.
    counts: Vec<u64>,
    /// Per scope how often the file's own count of its prims has it.
    listed: Vec<u64>,
    emitter: Emitter<'a>,
    report: ImportReport,
}

impl Import<'_> {
    /// Writes what stands once, then each prototype.
    fn run(&mut self, prims: &[Prim]) -> Result<()> {
        let mut prototypes: Vec<u32> =
            prims.iter().map(|prim| prim.scope).filter(|&scope| self.counts[scope as usize] > 1).collect();
        prototypes.sort_unstable();
        prototypes.dedup();
        prototypes.truncate(PROTOTYPES_MAX);
        for (number, prim) in prims.iter().enumerate() {
            if prototypes.binary_search(&prim.scope).is_err() {
                let copies = Copies::new(self.assembly.clone(), prim.scope, self.counts[prim.scope as usize]);
                self.prim(number, prim, copies, false)?;
            }
        }
        for scope in prototypes {
            let copies = Copies::new(self.assembly.clone(), scope, self.counts[scope as usize]);
            self.emitter.copies(&copies)?;
            for (number, prim) in prims.iter().enumerate().filter(|(_, prim)| prim.scope == scope) {
                self.prim(number, prim, copies.clone(), true)?;
            }
        }
        Ok(())
    }

    /// Reads a prim and writes it: once for each of `copies`, or once as a part of their prototype.
    fn prim(&mut self, number: usize, prim: &Prim, mut copies: Copies, is_prototype: bool) -> Result<()> {
        let read = match self.reader.geometry(number) {
            Ok(read) => read,
            // A broken layer ends its geometry; a limit, or a reader that is gone, ends the import
            Err(error) if error.kind() == ErrorKind::Invalid => {
                self.report.skip("prims that cannot be read", 1);
                self.report.warn(error.to_string());
                return Ok(());
            }
            Err(error) => return Err(error),
        };
        let (mut mesh, mut own) = (read.mesh, read.report);
        // Dicing finishes what it makes, and needs the polygons of a surface as they are
        let raw = (self.options.dice.is_some() && mesh.subdivision.is_some()).then(|| mesh.clone());
        mesh.finish(&mut own)?;
        self.count(&own, self.listed[prim.scope as usize]);
        let clusters = cut::cut(&mesh);
        let radius = radius::default_radius(&mesh, &clusters, self.options.meters_per_unit);
        radius::warn_radius(&mesh, radius, &mut self.report);
        let center = prim.scope_from_prim.transform_point3(mesh.bounds().center());
        let mesh = raw.unwrap_or(mesh);
        let rate = self.options.dice.as_ref();
        let mut emit = |matrix: glam::DMat4, rate: Option<&Rate>| {
            self.emit(&mesh, &clusters, matrix * prim.scope_from_prim, rate, (number, radius))
        };
        if is_prototype {
            let rate = rate.map(|rate| diced::prototype_rate(rate, &mut copies, center)).transpose()?;
            return emit(glam::DMat4::IDENTITY, rate.as_ref());
        }
        while let Some(world_from_scope) = copies.next()? {
            emit(world_from_scope, rate)?;
        }
        Ok(())
    }

    fn emit(
        &mut self,
        mesh: &Mesh,
        clusters: &cut::Clusters,
        matrix: glam::DMat4,
        rate: Option<&Rate>,
        (number, radius): (usize, f32),
    ) -> Result<()> {
        let id = u32::try_from(number).map_err(|_| Error::new(ErrorKind::Limit, "more than 2^32 prims"))?;
        let Some(placement) = Placement::new(matrix) else {
            self.report.skip("prims whose transform is flat or not finite", 1);
            return Ok(());
        };
        self.emitter.emit_diced(mesh, clusters, &placement, rate, (id, radius), &mut self.report)
    }

    /// Adds what was found in a prim, as often as the file lists it.
    fn count(&mut self, own: &ImportReport, times: u64) {
        let add = |sum: &mut u64, own: u64| *sum = sum.saturating_add(own.saturating_mul(times));
        let (sum, own_counts) = (&mut self.report.source, own.source);
        let SourceCounts { vertices, triangles, quads, ngons, lines, points } = own_counts;
        add(&mut sum.vertices, vertices);
        add(&mut sum.triangles, triangles);
        add(&mut sum.quads, quads);
        add(&mut sum.ngons, ngons);
        add(&mut sum.lines, lines);
        add(&mut sum.points, points);
        own.skipped.iter().for_each(|(reason, count)| self.report.skip(reason, *count));
        own.warnings.iter().for_each(|warning| self.report.warn(warning.clone()));
    }
}
