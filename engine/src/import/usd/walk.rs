//! What a stage holds: its prims with a shape, and the scopes that instances and point instancers place.

use std::collections::HashMap;
use std::rc::Rc;

use glam::{DMat4, DVec3, DVec4};
use openusd::sdf::Specifier;

use super::curves::{PART_POINTS, POINT_BYTES, SAMPLE_BYTES, SAMPLES_PER_POINT};
use super::primvar::{self, Primvar};
use super::read::Stage;
use super::{dress, instancer, material, polygons, xform};
use crate::import::ImportReport;
use crate::import::assembly::{Assembly, Use};
use crate::import::emit::Placement;
use crate::stream::Attribute;
use crate::stream::schema::UpAxis;
use crate::{Error, ErrorKind, Result};

/// Depth of prims at most.
const DEPTH_MAX: usize = 512;

/// Prototypes within prototypes at most.
const NESTING_MAX: usize = 64;

/// Prims that a walk visits at most: references that multiply end here.
const PRIMS_MAX: u64 = 10_000_000;

/// Copies of prims, all prototypes together, at most: as many as `instance` can number.
const COPIES_MAX: u64 = u32::MAX as u64;

/// What kind of shape a prim has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    Mesh,
    Points,
    Curves,
}

/// A prim with a shape.
#[derive(Clone, Debug)]
pub(super) struct Prim {
    /// Its path.
    pub path: String,
    /// What it is.
    pub kind: Kind,
    /// The scope it stands in.
    pub scope: u32,
    /// Where it stands there.
    pub scope_from_prim: DMat4,
    /// Its primvars, its own and inherited ones.
    pub primvars: Vec<Primvar>,
    /// How many points it has.
    pub points: usize,
    /// Parts that it is read in.
    pub parts: usize,
    /// Whether it writes normals of its own.
    pub has_normals: bool,
    /// The surface shaders of its materials, and the subsets of faces that have them, if any lets light through.
    pub materials: Vec<(String, Option<String>)>,
    /// Whether it stands in a prototype, where an over would reach all copies or none.
    pub is_shared: bool,
}

/// Everything that a stage shows.
#[derive(Debug)]
pub(super) struct Catalogue {
    /// Prims in the order of the stage.
    pub prims: Vec<Prim>,
    /// The scopes they stand in.
    pub assembly: Assembly,
    /// The attributes that primvars become.
    pub attributes: Vec<Attribute>,
    /// Metres per unit, and the up axis, of the stage.
    pub space: (f64, UpAxis),
    /// Bytes that reading takes at most: the layers, and the largest prim.
    pub memory_bytes: u64,
    /// What was left out.
    pub report: ImportReport,
}

/// Lists what a stage shows.
pub(super) fn catalogue(stage: &Stage) -> Result<Catalogue> {
    let space = space(stage);
    let found = Catalogue {
        prims: Vec::new(),
        assembly: Assembly::default(),
        attributes: Vec::new(),
        space,
        memory_bytes: 0,
        report: ImportReport::default(),
    };
    let mut walk = Walk { stage, found, scopes: HashMap::new(), visited: 0, uses: 0 };
    if let Some(odd) = meters_per_unit(stage).filter(|units| !is_length(*units)) {
        walk.found.report.warn(format!("`metersPerUnit` is {odd}: centimetres are assumed"));
    }
    walk.scope("/", world_from_stage(stage, space), 0)?;
    let found = &mut walk.found;
    for error in stage.stage.composition_errors() {
        found.report.warn(error.to_string());
    }
    found.attributes = dress::attributes(&found.prims, &mut found.report);
    let attributes = found.attributes.clone();
    for prim in &found.prims {
        let length = |name| {
            stage
                .value(&prim.path, name)
                .and_then(|value| super::value::integers(&value))
                .map_or(0, |all| all.len())
        };
        let (points, corners, faces) = match prim.kind {
            Kind::Mesh => (prim.points, length("faceVertexIndices"), length("faceVertexCounts")),
            Kind::Points => (prim.points, prim.points, prim.points),
            Kind::Curves => {
                let samples = SAMPLES_PER_POINT * prim.points.min(PART_POINTS);
                (samples, 2 * samples, samples)
            }
        };
        let mut bytes = polygons::need_memory(stage, &prim.path, points, corners, faces, &attributes)?;
        if prim.kind == Kind::Curves {
            bytes += points as u64 * SAMPLE_BYTES + prim.points as u64 * POINT_BYTES;
        }
        found.memory_bytes = found.memory_bytes.max(bytes);
    }
    found.memory_bytes += stage.layer_bytes();
    let counts = found.assembly.counts(|inner| inner.placed);
    if counts.iter().fold(0_u64, |sum, &count| sum.saturating_add(count)) > COPIES_MAX {
        let message = format!("more than {COPIES_MAX} copies of prototypes");
        return Err(Error::new(ErrorKind::Limit, message).at(&stage.path));
    }
    Ok(walk.found)
}

/// Metres per unit and up axis of a stage; the schema's fallbacks are centimetres and +y.
fn space(stage: &Stage) -> (f64, UpAxis) {
    let up = stage.stage.stage_metadata("upAxis").ok().flatten();
    let up = up.and_then(|value| super::value::text(&value));
    (
        meters_per_unit(stage).filter(|units| is_length(*units)).unwrap_or(0.01),
        if up.is_some_and(|axis| axis == "Z") { UpAxis::Z } else { UpAxis::Y },
    )
}

/// Metres per unit as the stage says, if it does.
fn meters_per_unit(stage: &Stage) -> Option<f64> {
    let value = stage.stage.stage_metadata("metersPerUnit").ok().flatten()?;
    super::value::numbers(&value)?.first().copied()
}

fn is_length(units: f64) -> bool {
    units.is_finite() && units > 0.0
}

/// World from stage: from its units and up axis to the scene's.
fn world_from_stage(stage: &Stage, (meters_per_unit, up): (f64, UpAxis)) -> DMat4 {
    let scale = meters_per_unit / stage.options.meters_per_unit;
    let axes = match (up, stage.options.up) {
        (UpAxis::Z, UpAxis::Y) => [DVec3::X, DVec3::NEG_Z, DVec3::Y],
        (UpAxis::Y, UpAxis::Z) => [DVec3::X, DVec3::Z, DVec3::NEG_Y],
        _ => [DVec3::X, DVec3::Y, DVec3::Z],
    };
    let [x, y, z] = axes.map(|axis| (axis * scale).extend(0.0));
    DMat4::from_cols(x, y, z, DVec4::W)
}

/// A walk over a stage.
pub(super) struct Walk<'a> {
    /// The stage.
    pub stage: &'a Stage,
    /// What was found so far.
    pub found: Catalogue,
    /// Scopes by the path of their root; none while one is being walked.
    scopes: HashMap<String, Option<u32>>,
    visited: u64,
    uses: u64,
}

/// A prim to visit.
struct Node {
    path: String,
    depth: usize,
    scope_from_parent: DMat4,
    /// What its ancestors say of their primvars and their purpose.
    inherited: Rc<Vec<Primvar>>,
    purpose: Rc<str>,
    /// Whether it is visited though nothing defines it: the root of a prototype.
    is_root: bool,
}

impl Walk<'_> {
    /// The number of the scope below `root`. A prototype of the library's stands without its root, whose transform each
    /// instance has itself.
    pub fn scope(&mut self, root: &str, scope_from_root: DMat4, nesting: usize) -> Result<u32> {
        match self.scopes.get(root) {
            Some(Some(known)) => return Ok(*known),
            Some(None) => return Err(self.stage.broken(root, "a prototype that holds itself")),
            None => _ = self.scopes.insert(root.to_owned(), None),
        }
        if nesting > NESTING_MAX {
            let message = format!("prototypes nested more than {NESTING_MAX} deep");
            return Err(Error::new(ErrorKind::Limit, message).at(&self.stage.path));
        }
        let (mut prims, mut uses) = (Vec::new(), Vec::new());
        let first = Node {
            path: root.to_owned(),
            depth: 0,
            scope_from_parent: scope_from_root,
            inherited: Rc::default(),
            purpose: "default".into(),
            is_root: true,
        };
        let mut stack = match root == "/" || self.stage.stage.prim(root).is_prototype() {
            true => self.children(&first, scope_from_root, &first.inherited, &first.purpose)?,
            false => vec![first],
        };
        while let Some(node) = stack.pop() {
            self.visited += 1;
            if self.visited > PRIMS_MAX || node.depth > DEPTH_MAX {
                let message = match node.depth > DEPTH_MAX {
                    true => format!("prims nested more than {DEPTH_MAX} deep"),
                    false => format!("more than {PRIMS_MAX} prims"),
                };
                return Err(Error::new(ErrorKind::Limit, message).at(&self.stage.path));
            }
            stack.extend(self.visit(&node, scope_from_root, nesting, &mut prims, &mut uses)?);
        }
        self.uses += uses.len() as u64;
        let bytes = self.uses * size_of::<Use>() as u64;
        if bytes > self.stage.memory_bytes / 2 {
            let message = format!("instances that take {} MiB", bytes >> 20);
            return Err(Error::new(ErrorKind::Limit, message)
                .at(&self.stage.path)
                .hint("allow more memory (`--memory`), or place copies by an instance file"));
        }
        let scope = self.found.assembly.add(uses);
        prims.iter_mut().for_each(|prim: &mut Prim| (prim.scope, prim.is_shared) = (scope, root != "/"));
        self.found.prims.append(&mut prims);
        self.scopes.insert(root.to_owned(), Some(scope));
        Ok(scope)
    }

    /// The children of a prim, last one first.
    fn children(
        &self,
        node: &Node,
        scope_from_prim: DMat4,
        inherited: &Rc<Vec<Primvar>>,
        purpose: &Rc<str>,
    ) -> Result<Vec<Node>> {
        let names = self.stage.stage.prim(node.path.as_str()).child_names();
        let names = names.map_err(|error| self.stage.broken(&node.path, format!("{error:#}")))?;
        let folder = if node.path == "/" { "" } else { &node.path };
        let child = |name: &openusd::tf::Token| Node {
            path: format!("{folder}/{}", name.as_str()),
            depth: node.depth + 1,
            scope_from_parent: scope_from_prim,
            inherited: inherited.clone(),
            purpose: purpose.clone(),
            is_root: false,
        };
        Ok(names.iter().rev().map(child).collect())
    }

    /// Takes note of a prim and returns the prims below that are to be visited.
    fn visit(
        &mut self,
        node: &Node,
        scope_from_root: DMat4,
        nesting: usize,
        prims: &mut Vec<Prim>,
        uses: &mut Vec<Use>,
    ) -> Result<Vec<Node>> {
        let path = node.path.as_str();
        let prim = self.stage.stage.prim(path);
        let wrong = |error| self.stage.broken(path, format!("{error:#}"));
        let is_defined = node.is_root || prim.specifier().map_err(wrong)? == Some(Specifier::Def);
        if !is_defined || !prim.is_active().map_err(wrong)? {
            return Ok(Vec::new());
        }
        if self.stage.text(path, "visibility").is_some_and(|visibility| visibility == "invisible") {
            self.found.report.skip("invisible prims, with what is below them", 1);
            return Ok(Vec::new());
        }
        let Some((parent_from_prim, is_reset)) = xform::local(self.stage, path) else {
            self.found.report.skip("prims whose transform cannot be read, with what is below them", 1);
            return Ok(Vec::new());
        };
        let parent = if is_reset { scope_from_root } else { node.scope_from_parent };
        let scope_from_prim = parent * parent_from_prim;
        let purpose = self.stage.text(path, "purpose").map_or_else(|| node.purpose.clone(), Rc::from);
        let type_name = prim.type_name().map_err(wrong)?;
        let type_name = type_name.as_ref().map_or("", |name| name.as_str());
        let kind = match type_name {
            "Mesh" => Some(Kind::Mesh),
            "Points" => Some(Kind::Points),
            "BasisCurves" => Some(Kind::Curves),
            _ => None,
        };
        let is_instance = prim.is_instance().map_err(wrong)?;
        let is_shown = &*purpose == "default" || &*purpose == "render";
        if (kind.is_some() || type_name == "PointInstancer" || is_instance) && !is_shown {
            self.found.report.skip(&format!("prims of purpose `{purpose}`"), 1);
            return Ok(Vec::new());
        }
        match (kind, type_name) {
            (Some(kind), _) => {
                let primvars = primvar::of_prim(self.stage, path, &node.inherited);
                let has_normals = primvars.iter().any(|primvar| primvar.name == "normals")
                    || self.stage.value(path, "normals").is_some();
                let points = self.stage.value(path, "points").and_then(|value| super::value::vectors(&value));
                let points = points.map_or(0, |points| points.len());
                let materials = match kind {
                    Kind::Mesh => material::see_through(self.stage, path),
                    _ => Vec::new(),
                };
                let path = path.to_owned();
                // Scope and sharing are known once the scope is complete
                let (scope, is_shared) = (0, false);
                prims.push(Prim {
                    path,
                    kind,
                    scope,
                    scope_from_prim,
                    primvars,
                    points,
                    parts: if kind == Kind::Curves { points.div_ceil(PART_POINTS).max(1) } else { 1 },
                    has_normals,
                    materials,
                    is_shared,
                });
            }
            (None, "PointInstancer") => {
                instancer::place(self, path, scope_from_prim, nesting, uses)?;
                return Ok(Vec::new());
            }
            (None, "" | "Xform" | "Scope" | "GeomSubset") => {}
            (None, "Material" | "Shader" | "NodeGraph") => {
                self.found.report.skip(&format!("prims of type `{type_name}`"), 1);
                return Ok(Vec::new());
            }
            (None, other) => self.found.report.skip(&format!("prims of type `{other}`"), 1),
        }
        if is_instance {
            self.leave_out_primvars(primvar::inherit(self.stage, path, &node.inherited).len());
            if let Some(prototype) = prim.prototype().map_err(wrong)? {
                let scope = self.scope(prototype.as_str(), DMat4::IDENTITY, nesting + 1)?;
                self.place(
                    Use { scope, outer_from_inner: scope_from_prim, listed: true, placed: true },
                    uses,
                );
            }
            return Ok(Vec::new());
        }
        let inherited = match kind {
            Some(_) => node.inherited.clone(),
            None => primvar::inherit(self.stage, path, &node.inherited),
        };
        self.children(node, scope_from_prim, &inherited, &purpose)
    }

    /// Counts the primvars of a copy: copies share what their prototype has.
    pub fn leave_out_primvars(&mut self, count: usize) {
        self.found
            .report
            .skip("primvars of instances and instancers, whose copies share their prototype's", count as u64);
    }

    /// Adds a use; one whose transform is flat is counted, but not to be seen.
    pub fn place(&mut self, inner: Use, uses: &mut Vec<Use>) {
        let placed = Placement::new(inner.outer_from_inner).is_some();
        if !placed {
            self.found.report.skip("copies whose transform is flat or not finite", 1);
        }
        uses.push(Use { placed, ..inner });
    }
}
