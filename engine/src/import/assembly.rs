//! Scopes placed in scopes: how often and where a prototype stands, without a list of all its copies.
//!
//! Nested instances multiply: fifteen trees of five thousand twigs are seventy thousand matrices, and a forest of such
//! groves many millions. They are products along the paths from the root to the prototype, walked depth first.

use std::sync::Arc;

use glam::DMat4;

use crate::Result;
use crate::stream::adapt::MatrixSource;

/// A scope placed in another.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Use {
    /// The scope that is placed.
    pub scope: u32,
    /// Where it stands in the scope that places it.
    pub outer_from_inner: DMat4,
    /// Whether the file's own count of prims has it: of a point instancer's copies one for each prototype.
    pub listed: bool,
    /// Whether there is anything to see of it: not if its transform is flat.
    pub placed: bool,
}

/// All scopes, by what they place. A scope places only such as were added before it, so that no path ever closes; the
/// last one is the root.
#[derive(Debug, Default)]
pub(super) struct Assembly {
    scopes: Vec<Vec<Use>>,
}

/// Per scope what it places: the scope's number and the bits of its matrix. Uses that are not placed are left out.
pub(super) type SavedScopes = Vec<Vec<(u32, [u64; 16])>>;

impl Assembly {
    /// The scopes for [`load`](Self::load).
    pub fn save(&self) -> SavedScopes {
        let bits = |inner: &Use| (inner.scope, inner.outer_from_inner.to_cols_array().map(f64::to_bits));
        let placed = |uses: &Vec<Use>| uses.iter().filter(|inner| inner.placed).map(bits).collect();
        self.scopes.iter().map(placed).collect()
    }

    /// The scopes that were saved; none if one places a later one.
    pub fn load(saved: SavedScopes) -> Option<Self> {
        let mut assembly = Self::default();
        for (number, uses) in saved.into_iter().enumerate() {
            if uses.iter().any(|(scope, _)| *scope as usize >= number) {
                return None;
            }
            let place = |(scope, bits): (u32, [u64; 16])| Use {
                scope,
                outer_from_inner: DMat4::from_cols_array(&bits.map(f64::from_bits)),
                listed: true,
                placed: true,
            };
            assembly.add(uses.into_iter().map(place).collect());
        }
        Some(assembly)
    }

    /// Adds a scope. Returns its number.
    pub fn add(&mut self, uses: Vec<Use>) -> u32 {
        debug_assert!(uses.iter().all(|inner| (inner.scope as usize) < self.scopes.len()));
        self.scopes.push(uses);
        self.scopes.len() as u32 - 1
    }

    /// Per scope, how often the root places it, by the uses that are `wanted`; at most `u64::MAX`.
    pub fn counts(&self, wanted: impl Fn(&Use) -> bool) -> Vec<u64> {
        let mut counts = vec![0_u64; self.scopes.len()];
        if let Some(root) = counts.last_mut() {
            *root = 1;
        }
        for outer in (0..self.scopes.len()).rev() {
            let times = counts[outer];
            for inner in self.scopes[outer].iter().filter(|inner| wanted(inner)) {
                let count = &mut counts[inner.scope as usize];
                *count = count.saturating_add(times);
            }
        }
        counts
    }

    /// Whether `scope` is placed by each scope, directly or not; a scope reaches itself.
    fn reaching(&self, scope: u32) -> Vec<bool> {
        let mut reaches = vec![false; self.scopes.len()];
        for (outer, uses) in self.scopes.iter().enumerate() {
            reaches[outer] = outer as u32 == scope
                || uses.iter().any(|inner| inner.placed && reaches[inner.scope as usize]);
        }
        reaches
    }
}

/// Where the copies of a prototype stand: a matrix for each path from the root to it, in constant memory.
#[derive(Clone, Debug)]
pub struct Copies {
    assembly: Arc<Assembly>,
    scope: u32,
    reaches: Arc<[bool]>,
    /// How many there are.
    count: u64,
    /// The scopes on the way to the next copy: each with the next of its uses to look at.
    stack: Vec<(u32, usize, DMat4)>,
    returned: u64,
}

impl Copies {
    /// The copies of a scope, `count` of them.
    pub(super) fn new(assembly: Arc<Assembly>, scope: u32, count: u64) -> Self {
        let reaches = assembly.reaching(scope).into();
        let mut copies = Self { assembly, scope, reaches, count, stack: Vec::new(), returned: 0 };
        copies.restart();
        copies
    }

    /// The copies of a scope that may not be there, or not as often.
    pub(super) fn checked(assembly: &Arc<Assembly>, scope: u32, count: u64) -> Option<Self> {
        let counts = assembly.counts(|inner| inner.placed);
        (counts.get(scope as usize) == Some(&count)).then(|| Self::new(assembly.clone(), scope, count))
    }

    /// The scope, and how many copies there are.
    pub(super) fn key(&self) -> (u32, u64) {
        (self.scope, self.count)
    }

    /// The scopes that place them.
    pub(super) fn assembly(&self) -> &Assembly {
        &self.assembly
    }

    /// How many there are.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// Calls `visit` with the matrix of each use that leads to the prototype: what the copies depend on.
    pub fn each_use(&self, mut visit: impl FnMut(&DMat4)) {
        for (scope, uses) in self.assembly.scopes.iter().enumerate().filter(|(scope, _)| self.reaches[*scope])
        {
            visit(&DMat4::from_diagonal(glam::DVec4::splat(scope as f64)));
            uses.iter().filter(|inner| inner.placed).for_each(|inner| visit(&inner.outer_from_inner));
        }
    }

    fn restart(&mut self) {
        self.stack.clear();
        self.returned = 0;
        let root = self.assembly.scopes.len() as u32;
        if let Some(root) = root.checked_sub(1) {
            self.stack.push((root, 0, DMat4::IDENTITY));
        }
    }
}

impl MatrixSource for Copies {
    fn rewind(&mut self) -> Result<()> {
        self.restart();
        Ok(())
    }

    fn next(&mut self) -> Result<Option<DMat4>> {
        while let Some((scope, next, world_from_scope)) = self.stack.last_mut() {
            let world_from_scope = *world_from_scope;
            if *scope == self.scope {
                self.stack.pop();
                self.returned += 1;
                return Ok(Some(world_from_scope));
            }
            let uses = &self.assembly.scopes[*scope as usize][*next..];
            match uses.iter().position(|inner| inner.placed && self.reaches[inner.scope as usize]) {
                Some(skipped) => {
                    let inner = uses[skipped];
                    *next += skipped + 1;
                    self.stack.push((inner.scope, 0, world_from_scope * inner.outer_from_inner));
                }
                None => _ = self.stack.pop(),
            }
        }
        Ok(None)
    }

    fn progress(&self) -> f64 {
        self.returned as f64 / self.count.max(1) as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    fn at(scope: u32, x: f64) -> Use {
        Use { scope, outer_from_inner: DMat4::from_translation(DVec3::X * x), listed: true, placed: true }
    }

    fn places(copies: &mut Copies) -> Vec<f64> {
        copies.rewind().unwrap();
        std::iter::from_fn(|| copies.next().unwrap()).map(|matrix| matrix.w_axis.x).collect()
    }

    /// Catches a copy that is lost, doubled or out of order where scopes nest and stand beside each other.
    #[test]
    fn copies_are_the_paths_from_the_root() {
        let mut assembly = Assembly::default();
        let twig = assembly.add(vec![]);
        let stone = assembly.add(vec![]);
        let flat = Use { placed: false, ..at(twig, 7.0) };
        let tree = assembly.add(vec![at(twig, 1.0), flat, at(stone, 0.0), at(twig, 2.0)]);
        assembly.add(vec![at(tree, 10.0), at(twig, 0.5), at(tree, 20.0)]);
        let counts = assembly.counts(|inner| inner.placed);
        assert_eq!(counts, [5, 2, 2, 1]);
        assert_eq!(assembly.counts(|_| true)[0], 7);
        let assembly = Arc::new(assembly);
        let mut twigs = Copies::new(assembly.clone(), twig, counts[0]);
        assert_eq!(places(&mut twigs), [11.0, 12.0, 0.5, 21.0, 22.0]);
        assert_eq!(places(&mut twigs), [11.0, 12.0, 0.5, 21.0, 22.0]);
        assert_eq!(places(&mut Copies::new(assembly, stone, 2)), [10.0, 20.0]);
    }

    /// Catches copies that are others after they were saved, and a damaged record that makes a circle.
    #[test]
    fn saved_copies_are_the_same() {
        let mut assembly = Assembly::default();
        let twig = assembly.add(vec![]);
        let tree = assembly.add(vec![at(twig, 0.1), at(twig, 1e-300)]);
        assembly.add(vec![at(tree, 10.0), at(tree, -0.3)]);
        let saved = assembly.save();
        let text = serde_json::to_string(&saved).unwrap();
        let loaded = Arc::new(Assembly::load(serde_json::from_str(&text).unwrap()).unwrap());
        let mut before = Copies::new(Arc::new(assembly), twig, 4);
        assert_eq!(places(&mut Copies::checked(&loaded, twig, 4).unwrap()), places(&mut before));
        assert!(Copies::checked(&loaded, twig, 5).is_none() && Copies::checked(&loaded, 7, 0).is_none());
        assert!(Assembly::load(vec![vec![(0, [0; 16])]]).is_none());
    }

    /// Catches a count that wraps around: sixty-four doublings are more than a count holds.
    #[test]
    fn counts_saturate() {
        let mut assembly = Assembly::default();
        let mut scope = assembly.add(vec![]);
        for _ in 0..70 {
            scope = assembly.add(vec![at(scope, 0.0), at(scope, 1.0)]);
        }
        assert_eq!(assembly.counts(|_| true)[0], u64::MAX);
    }
}
