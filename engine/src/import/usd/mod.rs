//! USD, as text, binary or package, composed: meshes, points, curves, instances and primvars (`docs/import.md`).
//!
//! The `openusd` library composes and reads, behind a `fence` in a thread of its own; `walk` lists what a stage shows;
//! each prim becomes a mesh when its turn comes. What stands once is written as it is, each prototype once for all its
//! copies.

#[cfg(test)]
mod aloud_tests;
mod arcs;
mod basis;
mod binary;
mod cover;
mod curves;
mod dress;
mod fence;
mod guard;
mod instancer;
mod material;
mod package;
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

use self::cover::Leaf;
use self::fence::Reader;
use self::read::Geometry;
use self::walk::{Catalogue, Kind, Prim};
use super::assembly::Assembly;
use super::emit::{Carried, Emitter, Placement};
use super::leaves::{self, Leaves};
use super::mesh::Mesh;
use super::{Copies, Expected, GridSink, ImportOptions, ImportReport, SourceCounts, cut, diced, radius};
use crate::dice::Rate;
use crate::stream::Attribute;
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
    let Catalogue { prims, assembly, attributes, space, memory_bytes, mut report } = catalogue;
    let carried = Carried {
        normal: prims.iter().any(|prim| prim.kind == Kind::Mesh || prim.has_normals),
        albedo: has(&prims, "displayColor"),
        opacity: has(&prims, "displayOpacity") || prims.iter().any(|prim| !prim.materials.is_empty()),
        radius: prims.iter().any(|prim| prim.kind != Kind::Mesh),
        extras: attributes.clone(),
        point: true,
    };
    let assembly = Arc::new(assembly);
    let up = if space.1 == UpAxis::Z { "Z" } else { "Y" };
    let mut metadata = vec![(UNITS_KEY.into(), space.0.to_string()), (UP_KEY.into(), up.into())];
    metadata.extend(list(&prims, &mut report).map(|list| (PRIMS_KEY.into(), list)));
    let mut import = Import {
        reader,
        options,
        attributes,
        listed: assembly.counts(|inner| inner.listed),
        counts: assembly.counts(|inner| inner.placed),
        assembly,
        report,
    };
    let leaves = import.count_leaves(&prims)?;
    sink.expect(&Expected { memory_bytes, leaves })?;
    let mut emitter = Emitter::with_metadata(sink, carried, options, &metadata)?;
    import.run(&prims, &mut emitter)?;
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
    /// What primvars become.
    attributes: Vec<Attribute>,
    report: ImportReport,
}

/// A prim that is ready to be written.
struct Prepared {
    /// What is written as it is; not finished if it is a surface to be diced.
    mesh: Mesh,
    clusters: cut::Clusters,
    radius: f32,
    leaves: Vec<Leaf>,
    /// The centre of all of it, in its scope.
    center: glam::DVec3,
}

impl Import<'_> {
    /// The scopes that are written once for all their copies, in ascending order.
    fn prototypes(&self, prims: &[Prim]) -> Vec<u32> {
        let scopes = prims.iter().map(|prim| prim.scope);
        let mut prototypes: Vec<u32> = scopes.filter(|&scope| self.counts[scope as usize] > 1).collect();
        prototypes.sort_unstable();
        prototypes.dedup();
        prototypes.truncate(PROTOTYPES_MAX);
        prototypes
    }

    fn copies(&self, scope: u32) -> Copies {
        Copies::new(self.assembly.clone(), scope, self.counts[scope as usize])
    }

    /// Writes what stands once, then each prototype.
    fn run(&mut self, prims: &[Prim], emitter: &mut Emitter<'_>) -> Result<()> {
        let prototypes = self.prototypes(prims);
        for (number, prim) in prims.iter().enumerate() {
            if prototypes.binary_search(&prim.scope).is_err() {
                (0..prim.parts).try_for_each(|part| self.prim((number, part), prim, false, emitter))?;
            }
        }
        for scope in prototypes {
            emitter.copies(&self.copies(scope))?;
            for (number, prim) in prims.iter().enumerate().filter(|(_, prim)| prim.scope == scope) {
                (0..prim.parts).try_for_each(|part| self.prim((number, part), prim, true, emitter))?;
            }
        }
        Ok(())
    }

    /// How many micropolygons leaves will become; refuses more than allowed.
    fn count_leaves(&mut self, prims: &[Prim]) -> Result<u64> {
        let prototypes = self.prototypes(prims);
        let mut count = 0_u64;
        for (number, prim) in prims.iter().enumerate() {
            if !Leaves::are_wanted(self.options) || prim.materials.is_empty() {
                continue;
            }
            // What is found on the way is reported when it is read to be written
            let Ok(prepared) = self.prepare((number, 0), prim, &mut ImportReport::default()) else {
                continue;
            };
            let is_prototype = prototypes.binary_search(&prim.scope).is_ok();
            self.each_place(prim, &prepared, is_prototype, |placement, rate| {
                for leaf in &prepared.leaves {
                    let corner = |corner| leaf.corner(corner);
                    count = count.saturating_add(self.leaves(leaf, &corner, rate).count(placement)?);
                }
                Ok(())
            })?;
        }
        leaves::check_count(count, self.options)?;
        Ok(count)
    }

    /// A leaf, cut as options ask at a rate.
    fn leaves<'b>(
        &self,
        leaf: &'b Leaf,
        corner: &'b dyn Fn(usize) -> (glam::Vec2, f32),
        rate: Option<&'b Rate>,
    ) -> Leaves<'b> {
        let look = (&leaf.texture, leaf.alpha, leaf.opacity);
        Leaves::new(&leaf.mesh, look, corner, (self.options.texels, rate))
    }

    /// Reads a part of a prim and makes it ready.
    fn prepare(&self, which: (usize, usize), prim: &Prim, report: &mut ImportReport) -> Result<Prepared> {
        let Geometry { mut mesh, report: own, covers } = self.reader.geometry(which.0, which.1)?;
        *report = own;
        let is_surface = self.options.dice.is_some() && mesh.subdivision.is_some();
        if !is_surface {
            mesh.open_holes();
        }
        let cut = Leaves::are_wanted(self.options) && !is_surface;
        let leaves = cover::apply(&mut mesh, covers, &self.attributes, cut, report)?;
        // Dicing finishes what it makes, and needs the polygons of a surface as they are
        let raw = is_surface.then(|| mesh.clone());
        mesh.open_holes();
        mesh.finish(report)?;
        let clusters = cut::cut(&mesh);
        let radius = radius::default_radius(&mesh, &clusters, self.options.meters_per_unit);
        radius::warn_radius(&mesh, radius, report);
        let center = prim.scope_from_prim.transform_point3(cover::center(&mesh, &leaves));
        Ok(Prepared { mesh: raw.unwrap_or(mesh), clusters, radius, leaves, center })
    }

    /// Reads a part of a prim and writes it: once for each copy, or once as a part of their prototype.
    fn prim(
        &mut self,
        (number, part): (usize, usize),
        prim: &Prim,
        is_prototype: bool,
        emitter: &mut Emitter<'_>,
    ) -> Result<()> {
        let id = u32::try_from(number).map_err(|_| Error::new(ErrorKind::Limit, "more than 2^32 prims"))?;
        let mut own = ImportReport::default();
        let prepared = match self.prepare((number, part), prim, &mut own) {
            Ok(prepared) => prepared,
            // A broken layer ends its geometry; a limit, or a reader that is gone, ends the import
            Err(error) if error.kind() == ErrorKind::Invalid => {
                self.report.skip("prims that cannot be read", 1);
                self.report.warn(error.to_string());
                return Ok(());
            }
            Err(error) => return Err(error),
        };
        self.count(&own, self.listed[prim.scope as usize]);
        let mut report = std::mem::take(&mut self.report);
        let Prepared { mesh, clusters, radius, leaves, .. } = &prepared;
        let flat = self.each_place(prim, &prepared, is_prototype, |placement, rate| {
            emitter.emit_diced(mesh, clusters, placement, rate, (id, *radius), &mut report)?;
            for leaf in leaves {
                let corner = |corner| leaf.corner(corner);
                self.leaves(leaf, &corner, rate).emit(emitter, placement, id, &mut report)?;
            }
            Ok(())
        });
        self.report = report;
        self.report.skip("prims whose transform is flat or not finite", flat?);
        Ok(())
    }

    /// Calls `take` for each place where a prim is written, and with the rate there. Returns how many are flat.
    fn each_place(
        &self,
        prim: &Prim,
        prepared: &Prepared,
        is_prototype: bool,
        mut take: impl FnMut(&Placement, Option<&Rate>) -> Result<()>,
    ) -> Result<u64> {
        let (mut copies, rate) = (self.copies(prim.scope), self.options.dice.as_ref());
        let mut flat = 0;
        let mut place = |matrix: glam::DMat4, rate: Option<&Rate>| -> Result<()> {
            match Placement::new(matrix * prim.scope_from_prim) {
                Some(placement) => take(&placement, rate)?,
                None => flat += 1,
            }
            Ok(())
        };
        if is_prototype {
            let rate =
                rate.map(|rate| diced::prototype_rate(rate, &mut copies, prepared.center)).transpose()?;
            place(glam::DMat4::IDENTITY, rate.as_ref())?;
            return Ok(flat);
        }
        while let Some(world_from_scope) = copies.next()? {
            place(world_from_scope, rate)?;
        }
        Ok(flat)
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
