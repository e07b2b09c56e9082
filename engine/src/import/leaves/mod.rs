//! Triangles whose texture lets light through, cut along it: to edges of two texels and less where coverage changes, in
//! larger parts where it does not, and without the parts that are wholly clear.
//!
//! Triangles of equal texture coordinates, as the cards of a tree are, share one pattern. It is cut and parted into grids
//! once; each triangle then only says where its vertices lie.

mod grids;
mod pattern;
pub(super) mod texture;

use std::rc::Rc;

use glam::{DVec3, Vec2};

use self::pattern::{LEVEL_MAX, Pattern, Patterns, Wanted};
use self::texture::{AlphaMode, Averager, Texture};
use super::emit::{Emitter, Placement, power_of_two, resolution};
use super::mesh::{Face, Mesh};
use super::{ImportOptions, ImportReport};
use crate::dice::Rate;
use crate::math::Bounds;
use crate::{Error, ErrorKind, Result};

/// Texels along the edges of a part at most, unless [`ImportOptions::texels`] says otherwise.
const TEXELS: f64 = 2.0;

/// What cutting takes at its peak: the patterns remembered, and the one being made.
pub(super) const BYTES: u64 = 80 << 20;

/// The faces of a finished mesh of triangles on their way along a texture.
pub(super) struct Leaves<'a> {
    mesh: &'a Mesh,
    /// Texture coordinates and alpha of a corner.
    corner: &'a dyn Fn(usize) -> (Vec2, f32),
    averager: Averager<'a>,
    texels: f32,
    rate: Option<&'a Rate>,
    patterns: Patterns,
}

impl<'a> Leaves<'a> {
    /// Whether options ask for leaves to be cut: where faces are diced, or texels are named.
    pub fn are_wanted(options: &ImportOptions) -> bool {
        options.dice.is_some() || options.texels.is_some()
    }

    /// The faces of `mesh`, by a texture whose alpha is read as `alpha` and multiplied by `factor`. `corner` gives the
    /// texture coordinates and the alpha of each of its corners. Parts are at most so many texels long, and as dicing asks.
    pub fn new(
        mesh: &'a Mesh,
        (texture, alpha, factor): (&'a Texture, AlphaMode, f32),
        corner: &'a dyn Fn(usize) -> (Vec2, f32),
        (texels, rate): (Option<f64>, Option<&'a Rate>),
    ) -> Self {
        Self {
            mesh,
            corner,
            averager: Averager::new(texture, alpha, factor, mesh.faces.len()),
            texels: texels.unwrap_or(TEXELS) as f32,
            rate,
            patterns: Patterns::default(),
        }
    }

    /// How many micropolygons a copy becomes.
    pub fn count(&mut self, placement: &Placement) -> Result<u64> {
        let mesh = self.mesh;
        mesh.faces.iter().try_fold(0, |sum, face| Ok(sum + self.pattern(face, placement)?.faces))
    }

    /// Writes a copy.
    pub fn emit(
        &mut self,
        emitter: &mut Emitter<'_>,
        placement: &Placement,
        first_id: u32,
        report: &mut ImportReport,
    ) -> Result<()> {
        let mesh = self.mesh;
        if emitter.is_out_of_range(mesh, placement, report) {
            return Ok(());
        }
        let mut bounds = Bounds::EMPTY;
        let corners = mesh.faces.iter().flat_map(|face| mesh.face_corners(face));
        corners.for_each(|&corner| bounds.add(placement.point(mesh.positions[corner as usize])));
        let step = power_of_two(resolution(bounds.size().max_element()));
        for face in &mesh.faces {
            let pattern = self.pattern(face, placement)?;
            report.skip("parts of textured faces that are wholly clear", pattern.clear);
            if pattern.coarse > 0 {
                report.warn("a face with too many texels is cut less finely than was asked for".into());
            }
            emitter.emit_pattern((mesh, face), placement, &pattern, (first_id, step), report)?;
        }
        Ok(())
    }

    fn pattern(&mut self, face: &Face, placement: &Placement) -> Result<Rc<Pattern>> {
        let corners: [(Vec2, f32); 3] = std::array::from_fn(|i| (self.corner)(face.start as usize + i));
        let wanted = Wanted { texels: self.texels, level: self.level(face, placement) };
        self.patterns.find(&self.averager, corners.map(|c| c.0), corners.map(|c| c.1), wanted)
    }

    /// How often the edges of a face are halved to be as short as dicing asks.
    fn level(&self, face: &Face, placement: &Placement) -> u32 {
        let Some(rate) = self.rate else { return 0 };
        let corners = self.mesh.face_corners(face);
        let p: [DVec3; 3] =
            std::array::from_fn(|i| placement.point(self.mesh.positions[corners[i] as usize]));
        let levels = (0..3).map(|i| rate.level(p[i], p[(i + 1) % 3]));
        u32::from(levels.max().unwrap_or(0)).min(LEVEL_MAX)
    }
}

/// Refuses leaves that would become more micropolygons than allowed.
pub(super) fn check_count(count: u64, options: &ImportOptions) -> Result<()> {
    if count <= options.leaves_max {
        return Ok(());
    }
    let texels = options.texels.unwrap_or(TEXELS);
    let message = format!(
        "cut to {texels} texels, leaves would become {count} micropolygons, {} are allowed",
        options.leaves_max
    );
    Err(Error::new(ErrorKind::Limit, message).hint(format!(
        "cut them less finely, with `texels:{}` where it says how to dice, or allow more (`--leaves-max`)",
        2.0 * texels
    )))
}

#[cfg(test)]
mod tests;
#[cfg(test)]
mod trees;
