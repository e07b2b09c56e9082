//! Level-of-detail selection: which bricks a batch's rays can tell apart (paper, section 4.4, figure 6).

use std::collections::BTreeMap;

use glam::IVec3;

use super::Arena;
use crate::brick::far;
use crate::brick::node::{Child, LatticeBox, Node};
use crate::brick::{Brick, Instance};
use crate::{Error, Result};

/// How far to open the brick map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Lod {
    /// Everything is opened.
    Off,
    /// As the paper: bricks whose diagonal is seen under less than σ = 2π/n (4π/n for the sphere), taken as an angle,
    /// stay closed; an open brick is opened whole.
    Paper,
    /// Bricks and nodes whose diagonal is below `quality` footprints of a ray, √σ, stay closed.
    Footprint {
        /// Footprints; 1 by default, smaller is finer.
        quality: f32,
    },
}

impl Lod {
    /// Reads `off`, `paper`, `footprint` or `footprint:Q`.
    ///
    /// # Errors
    /// [`ErrorKind::Invalid`](crate::ErrorKind::Invalid) for anything else.
    pub fn parse(text: &str) -> Result<Self> {
        let wrong = || {
            Error::invalid(format!("`{text}` is no level of detail"))
                .hint("one of: off, paper, footprint, footprint:Q")
        };
        match text.split_once(':') {
            None if text == "off" => Ok(Self::Off),
            None if text == "paper" => Ok(Self::Paper),
            None if text == "footprint" => Ok(Self::Footprint { quality: 1.0 }),
            Some(("footprint", quality)) => {
                let quality: f32 = quality.parse().map_err(|_| wrong())?;
                if (0.001..=100.0).contains(&quality) {
                    Ok(Self::Footprint { quality })
                } else {
                    Err(Error::invalid(format!(
                        "a level of detail of `{quality}` footprints is out of range"
                    ))
                    .hint("0.001 to 100 are possible"))
                }
            }
            _ => Err(wrong()),
        }
    }

    /// The squared angle below which a brick stays closed, for rays of `solid_angle` steradians each.
    pub fn brick_open2(self, solid_angle: f32) -> f32 {
        match self {
            Self::Off => 0.0,
            Self::Paper => solid_angle * solid_angle,
            Self::Footprint { quality } => quality * quality * solid_angle,
        }
    }

    /// The squared angle below which a node of an open brick stays closed.
    pub fn node_open2(self, solid_angle: f32) -> f32 {
        match self {
            Self::Off | Self::Paper => 0.0,
            Self::Footprint { .. } => self.brick_open2(solid_angle),
        }
    }
}

impl std::fmt::Display for Lod {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Off => f.write_str("off"),
            Self::Paper => f.write_str("paper"),
            Self::Footprint { quality } => write!(f, "footprint:{quality}"),
        }
    }
}

/// The bricks that a batch needs.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Cut {
    /// Brick numbers, ascending.
    pub bricks: Vec<u32>,
    /// Their bytes.
    pub bytes: u64,
}

/// Selects the cut of a batch whose origins lie in `batch` and loads it. False when it does not fit into the arena: the
/// cut is complete all the same, and tracing loads the rest as rays ask for it.
///
/// # Errors
/// When bricks cannot be read.
pub fn select(
    arena: &mut Arena,
    batch: &LatticeBox,
    lod: Lod,
    solid_angle: f32,
    cut: &mut Cut,
) -> Result<bool> {
    arena.begin_batch();
    cut.bricks.clear();
    cut.bytes = 0;
    let map = arena.map().clone();
    if lod == Lod::Off {
        // Every brick is in the cut. Either all fit and stay, or rays ask for them one by one
        cut.bytes = map.bytes();
        return arena.load_everything();
    }
    let open2 = [lod.brick_open2(solid_angle), lod.node_open2(solid_angle)];
    let mut selection =
        Selection { seen: Seen::From(*batch), open2, next: Vec::new(), prototypes: BTreeMap::new() };
    let mut fits = selection.open(vec![map.root()], arena, cut)?;

    // Every prototype once, as its nearest instance needs it
    for (root, distance2) in std::mem::take(&mut selection.prototypes) {
        selection.seen = Seen::FromAfar(distance2);
        fits &= selection.open(vec![root], arena, cut)?;
    }
    cut.bricks.sort_unstable();
    Ok(fits)
}

/// From where boxes are seen.
#[derive(Clone, Copy, Debug)]
enum Seen {
    /// From a box on their own lattice.
    From(LatticeBox),
    /// From at least this far away, squared: the boxes are a prototype's, and this holds for all its instances.
    FromAfar(f64),
}

/// The selection of one tree.
struct Selection {
    seen: Seen,
    /// Squared angles below which bricks and nodes stay closed.
    open2: [f32; 2],
    /// Bricks of the next level.
    next: Vec<u32>,
    /// Roots of prototypes that have an open instance, each with the least squared distance on its lattice from which it is seen.
    prototypes: BTreeMap<u32, f64>,
}

impl Selection {
    /// Selects from the bricks of `level` down and loads what is selected. False when it did not fit.
    fn open(&mut self, mut level: Vec<u32>, arena: &mut Arena, cut: &mut Cut) -> Result<bool> {
        let mut fits = true;
        while !level.is_empty() {
            level.sort_unstable();
            arena.add_to_cut(&level);
            cut.bricks.extend_from_slice(&level);
            let mut rest = level.as_slice();
            while !rest.is_empty() {
                let mut loaded = arena.load(rest)?;
                if loaded == 0 {
                    // The cut is larger than the arena: go on selecting with what comes in now
                    fits = false;
                    arena.release();
                    loaded = arena.load(rest)?.max(1);
                }
                for &number in &rest[..loaded] {
                    cut.bytes += u64::from(arena.map().brick_bytes(number));
                    let Some(brick) = arena.brick(number) else { continue };
                    self.open_children(&brick);
                }
                rest = &rest[loaded..];
            }
            level.clear();
            std::mem::swap(&mut level, &mut self.next);
        }
        Ok(fits)
    }

    /// Adds the child bricks that are to be opened to `next`, and the prototypes of instances to `prototypes`.
    fn open_children(&mut self, brick: &Brick<'_>) {
        let [brick_open2, node_open2] = self.open2;
        let mut stack = [0_u8; 256];
        let mut depth = 1;
        while depth > 0 {
            depth -= 1;
            let index = usize::from(stack[depth]);
            let node = brick.node(index);
            for slot in 0..usize::from(node.count) {
                match node.child(slot) {
                    Some(Child::Node(child)) if self.is_open(node, slot, node_open2) => {
                        stack[depth] = brick.child_node(index, child) as u8;
                        depth += 1;
                    }
                    Some(Child::Brick(child)) if self.is_open(node, slot, brick_open2) => {
                        self.next.push(brick.child_brick_at(index, child));
                    }
                    Some(Child::Instance(child)) if self.is_open(node, slot, brick_open2) => {
                        let instance = Instance::read(brick.at(index, child));
                        let distance2 = self.distance2(&node.child_box(slot));
                        self.add_prototype(instance.brick, instance.distance2_inside(distance2));
                    }
                    _ => {}
                }
            }
        }
    }

    /// Notes that a prototype is seen from a squared distance.
    fn add_prototype(&mut self, root: u32, distance2: f64) {
        let least = self.prototypes.entry(root).or_insert(distance2);
        *least = least.min(distance2);
    }

    /// The squared distance of a box, at least.
    fn distance2(&self, bounds: &LatticeBox) -> f64 {
        match &self.seen {
            Seen::From(batch) => {
                let gap = (bounds.min - batch.max).max(batch.min - bounds.max).max(IVec3::ZERO);
                gap.as_dvec3().length_squared()
            }
            Seen::FromAfar(distance2) => *distance2,
        }
    }

    /// Whether a child's diagonal is seen under at least the angle whose square is `open2`. A child that must be opened always is.
    fn is_open(&self, node: &Node, slot: usize, open2: f32) -> bool {
        let child = node.child_box(slot);
        let diagonal = (child.max - child.min).as_dvec3();
        far::must_open(&node.far[slot])
            || diagonal.length_squared() >= f64::from(open2) * self.distance2(&child)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a level of detail that is read as another one.
    #[test]
    fn levels_of_detail_parse_and_print() {
        for text in ["off", "paper", "footprint:1", "footprint:0.5"] {
            assert_eq!(Lod::parse(text).unwrap().to_string(), text);
        }
        assert_eq!(Lod::parse("footprint").unwrap(), Lod::Footprint { quality: 1.0 });
        for text in ["", "on", "paper:1", "footprint:", "footprint:nan", "footprint:0", "footprint:-1"] {
            assert!(Lod::parse(text).is_err(), "{text}");
        }
    }
}
