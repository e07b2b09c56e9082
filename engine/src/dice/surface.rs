//! Catmull-Clark surfaces, diced on their limit.
//!
//! Every quad of the cage is a patch, and every other face one for each corner. Some faces and those around them are refined
//! level by level; each border of a patch is read off at a level of its own, which depends on the border alone, and the
//! inside at the patch's. What lies on the limit is the same at all levels, up to the last bits: reading a border off at one
//! level makes these the same as well.

use glam::DVec3;

use super::cage::{Prepared, sorted};
use super::level::Level;
use super::limit;
use super::patch::{Diced, Key, NO_POINT, Vertex, quad};
use super::refine::refine;

/// Marks keys of what lies inside a face.
const INSIDE: u32 = 1 << 31;

/// A part of the surface with four sides.
struct Patch {
    face: u32,
    /// The corner of a face that is no quad.
    child: Option<u32>,
    /// Levels of the sides, counted from the patch's own first level.
    levels: [u8; 4],
    /// The level at which each corner, each side and the inside is read off.
    corner_depths: [u8; 4],
    side_depths: [u8; 4],
    inside_depth: u8,
    /// Faces of the current level, row by row.
    cells: Vec<u32>,
    corners: [Option<Vertex>; 4],
    sides: [Vec<Vertex>; 4],
    inside: Vec<Vertex>,
}

impl Patch {
    /// The level at which the patch is one cell.
    fn first(&self) -> u8 {
        u8::from(self.child.is_some())
    }

    /// The last level at which something is read off.
    fn last(&self) -> u8 {
        let all = self.corner_depths.iter().chain(&self.side_depths);
        all.copied().max().unwrap_or(1).max(self.inside_depth)
    }

    fn u(&self) -> u8 {
        self.levels[0].max(self.levels[2])
    }

    fn v(&self) -> u8 {
        self.levels[1].max(self.levels[3])
    }
}

/// A level of the surface, and that of each of its skins: the same faces over points of their own.
struct Levels {
    places: Level,
    skins: Vec<Level>,
}

impl Prepared<'_> {
    /// Dices some of the faces.
    pub fn dice(&self, faces: &[u32]) -> Diced {
        let mut faces = faces.to_vec();
        faces.sort_unstable();
        let numbers = self.with_neighbours(&faces);
        let mut levels = Levels {
            places: self.part(&numbers),
            skins: self.skins.iter().map(|skin| skin.part(&numbers)).collect(),
        };
        let mut patches: Vec<Patch> = faces.iter().flat_map(|&face| self.patches(face)).collect();

        // Which patch and cell a face of the level is
        let mut cells: Vec<Option<(u32, u32, u32)>> = vec![None; numbers.len()];
        let mut first_patches = vec![0; numbers.len()];
        for (number, patch) in patches.iter_mut().enumerate().rev() {
            let face = numbers.binary_search(&patch.face).expect("a part has its own faces");
            first_patches[face] = number as u32;
            cells[face] = Some((number as u32, 0, 0));
            patch.cells = vec![face as u32];
        }
        let last = patches.iter().map(Patch::last).max().unwrap_or(0);
        for depth in 1..=last {
            let level = &levels.places;
            let kept = kept(level, &cells, |patch| patches[patch as usize].last() >= depth);
            let is_quad = |face: u32| level.face(face).len() == 4;
            let turned = |face, child| if is_quad(face) { (4 - child) % 4 } else { 0 };
            let step = refine(level, &kept, &turned);
            let skins = levels.skins.iter().map(|skin| refine(skin, &kept, &turned).level).collect();
            let place = |&(parent, child): &(u32, u32)| -> Option<(u32, u32, u32)> {
                let (patch, i, j) = cells[parent as usize]?;
                let is_done = |patch: u32| patches[patch as usize].last() < depth;
                if !is_quad(parent) {
                    let patch = first_patches[parent as usize] + child;
                    return (!is_done(patch)).then_some((patch, 0, 0));
                }
                let (right, up) = ([0, 1, 1, 0][child as usize], [0, 0, 1, 1][child as usize]);
                (!is_done(patch)).then_some((patch, 2 * i + right, 2 * j + up))
            };
            let next: Vec<Option<(u32, u32, u32)>> = step.parents.iter().map(place).collect();
            for patch in patches.iter_mut().filter(|patch| patch.last() >= depth) {
                let n = 1_usize << (depth - patch.first());
                patch.cells = vec![0; n * n];
            }
            for (face, cell) in next.iter().enumerate() {
                if let Some((patch, i, j)) = *cell {
                    let patch = &mut patches[patch as usize];
                    let n = 1 << (depth - patch.first());
                    patch.cells[(j * n + i) as usize] = face as u32;
                }
            }
            (levels, cells) = (Levels { places: step.level, skins }, next);
            patches
                .iter_mut()
                .filter(|patch| patch.last() >= depth)
                .for_each(|patch| self.read(&levels, depth, patch));
        }
        let mut diced = Diced::default();
        patches.iter().for_each(|patch| self.emit(patch, &mut diced));
        diced
    }

    /// Faces, in order, as a level of its own.
    fn part(&self, numbers: &[u32]) -> Level {
        let cage = self.cage;
        let corners = || numbers.iter().flat_map(|&face| &cage.corners[cage.face(face)]).copied();
        let mut points: Vec<u32> = corners().collect();
        points.sort_unstable();
        points.dedup();
        let local = |point: u32| points.binary_search(&point).expect("its own points") as u32;
        let width = 3 + cage.smooth_width;
        let mut level = Level { width, corners: corners().map(local).collect(), ..Level::default() };
        for &point in &points {
            level.rows.extend(cage.positions[point as usize].to_array());
            let values = point as usize * cage.smooth_width..(point as usize + 1) * cage.smooth_width;
            level.rows.extend(cage.smooth[values].iter().map(|&value| f64::from(value)));
            level.vertex_sharpness.push(self.point_sharpness(point));
        }
        let mut end = 0;
        for &face in numbers {
            end += cage.face(face).len() as u32;
            level.ends.push(end);
        }
        let mut creases = std::collections::HashMap::new();
        for (i, &face) in numbers.iter().enumerate() {
            for side in 0..level.face(i as u32).len() {
                let ends = sorted(cage.edge(face, side));
                if let Some(&sharpness) = cage.creases.get(&ends) {
                    creases.insert(ends.map(local), sharpness);
                }
            }
        }
        level.connect(&creases);
        level
    }

    /// The patches of a face.
    fn patches(&self, face: u32) -> Vec<Patch> {
        let cage = self.cage;
        let corners = &cage.corners[cage.face(face)];
        let count = corners.len();
        let edges: Vec<[u32; 2]> = (0..count).map(|side| cage.edge(face, side)).collect();
        let levels: Vec<u8> = edges.iter().map(|&ends| self.level(ends)).collect();
        let patch = |child, levels: [u8; 4], corner_depths, side_depths, first: u8| {
            let finest = levels.into_iter().max().unwrap_or(0);
            let inside_depth = (first + finest).max(1);
            let (cells, inside) = (Vec::new(), Vec::new());
            let (corners, sides) = (Default::default(), Default::default());
            Patch {
                face,
                child,
                levels,
                corner_depths,
                side_depths,
                inside_depth,
                cells,
                corners,
                sides,
                inside,
            }
        };
        if count == 4 {
            let corner_depths = std::array::from_fn(|i| self.point_depth(corners[i]));
            let side_depths = std::array::from_fn(|i| self.edge_depth(edges[i]));
            return vec![patch(None, std::array::from_fn(|i| levels[i]), corner_depths, side_depths, 0)];
        }
        // From the middles of the edges to that of the face the level is that of the finest edge
        let spoke = levels.iter().copied().max().unwrap_or(1) - 1;
        let children = (0..count).map(|i| {
            let before = (i + count - 1) % count;
            let [here, there] = [edges[i], edges[before]].map(|ends| self.edge_depth(ends));
            let corner_depths = [self.point_depth(corners[i]), here, spoke + 1, there];
            let side_depths = [here, spoke + 1, spoke + 1, there];
            patch(
                Some(i as u32),
                [levels[i] - 1, spoke, spoke, levels[before] - 1],
                corner_depths,
                side_depths,
                1,
            )
        });
        children.collect()
    }

    /// Reads off what a patch has at this level.
    fn read(&self, levels: &Levels, depth: u8, patch: &mut Patch) {
        let n = 1_usize << (depth - patch.first());
        for corner in (0..4).filter(|&corner| patch.corner_depths[corner] == depth) {
            let (i, j) = [(0, 0), (n, 0), (n, n), (0, n)][corner];
            patch.corners[corner] = Some(self.vertex(levels, patch, n, i, j));
        }
        for side in (0..4).filter(|&side| patch.side_depths[side] == depth) {
            let steps = 1_usize << patch.levels[side];
            let stride = n / steps;
            let at = |step: usize| match side {
                0 => (step * stride, 0),
                1 => (n, step * stride),
                2 => (n - step * stride, n),
                _ => (0, n - step * stride),
            };
            let points = (1..steps).map(at).map(|(i, j)| self.vertex(levels, patch, n, i, j));
            patch.sides[side] = points.collect();
        }
        if patch.inside_depth == depth {
            let [us, vs] = [patch.u(), patch.v()].map(|level| 1_usize << level);
            let places = (1..vs).flat_map(|j| (1..us).map(move |i| (i * n / us, j * n / vs)));
            patch.inside = places.map(|(i, j)| self.vertex(levels, patch, n, i, j)).collect();
        }
    }

    /// The vertex of the limit surface at a place of a patch's `n` by `n` cells.
    fn vertex(&self, levels: &Levels, patch: &Patch, n: usize, i: usize, j: usize) -> Vertex {
        let level = &levels.places;
        let (column, line) = (i.min(n - 1), j.min(n - 1));
        let which = match (i - column, j - line) {
            (0, 0) => 0,
            (1, 0) => 1,
            (1, 1) => 2,
            _ => 3,
        };
        let corner = level.face(patch.cells[line * n + column]).start + which;
        let row = limit::row(level, level.corners[corner]);
        let mut values: Vec<f32> = row[3..].iter().map(|&value| value as f32).collect();
        for skin in &levels.skins {
            let row = limit::row(skin, skin.corners[corner]);
            values.extend(row[3..].iter().map(|&value| value as f32));
        }
        values.extend(self.linear(patch, i as f32 / n as f32, j as f32 / n as f32));
        let position = DVec3::from_slice(&row);
        Vertex { position, normal: limit::normal(level, corner as u32), values, point: NO_POINT }
    }

    /// The values of a face's corners at a place in a patch.
    fn linear(&self, patch: &Patch, s: f32, t: f32) -> Vec<f32> {
        let cage = self.cage;
        let width = cage.linear_width;
        let range = cage.face(patch.face);
        let count = range.len();
        let own = |corner: usize, k: usize| cage.linear[(range.start + corner % count) * width + k];
        let weights = [(1.0 - s) * (1.0 - t), s * (1.0 - t), s * t, (1.0 - s) * t];
        let value = |k: usize| -> f32 {
            let corners: [f32; 4] = match patch.child {
                None => std::array::from_fn(|i| own(i, k)),
                Some(child) => {
                    let i = child as usize;
                    let middle = |i: usize| 0.5 * (own(i, k) + own(i + 1, k));
                    let center = (0..count).map(|i| own(i, k)).sum::<f32>() / count as f32;
                    [own(i, k), middle(i), center, middle(i + count - 1)]
                }
            };
            corners.iter().zip(weights).map(|(value, weight)| value * weight).sum()
        };
        (0..width).map(value).collect()
    }

    /// Adds a patch that is complete.
    fn emit(&self, patch: &Patch, diced: &mut Diced) {
        let mut border = |diced: &mut Diced, side: usize, step: usize| {
            let steps = 1_usize << patch.levels[side];
            let vertex = match step {
                0 => patch.corners[side].as_ref(),
                step if step == steps => patch.corners[(side + 1) % 4].as_ref(),
                step => patch.sides[side].get(step - 1),
            };
            let vertex = vertex.expect("every level up to the patch's last was read");
            let key = self.key(patch, side, step as u32);
            let point = if key[1] == NO_POINT && key[0] < INSIDE { key[0] } else { NO_POINT };
            diced.push_border(key, &Vertex { point, ..vertex.clone() })
        };
        let us = 1_usize << patch.u();
        let mut inside =
            |diced: &mut Diced, i: usize, j: usize| diced.push(&patch.inside[(j - 1) * (us - 1) + i - 1]);
        quad(diced, patch.levels, patch.face, &mut border, &mut inside);
    }

    /// What identifies a step of a side.
    fn key(&self, patch: &Patch, side: usize, step: u32) -> Key {
        let steps = 1_u32 << patch.levels[side];
        let count = self.cage.face(patch.face).len();
        let Some(child) = patch.child else {
            return edge_key(self.cage.edge(patch.face, side), steps, step);
        };
        let child = child as usize;
        let before = (child + count - 1) % count;
        // An edge of the face has as many steps again behind its middle
        let half = |side: usize, step: u32| {
            let ends = self.cage.edge(patch.face, side);
            edge_key(ends, 1 << self.level(ends), step)
        };
        let spoke = |side: usize, step: u32| match step {
            0 => {
                let ends = self.cage.edge(patch.face, side);
                edge_key(ends, 1 << self.level(ends), 1 << (self.level(ends) - 1))
            }
            step if step == steps => [patch.face | INSIDE, NO_POINT, 0],
            step => [patch.face | INSIDE, side as u32, step],
        };
        match side {
            0 => half(child, step),
            1 => spoke(child, step),
            2 => spoke(before, steps - step),
            _ => half(before, steps + step),
        }
    }
}

/// What identifies a step of an edge, whichever way it is walked.
fn edge_key([from, to]: [u32; 2], steps: u32, step: u32) -> Key {
    let (ends, step) = if from <= to { ([from, to], step) } else { ([to, from], steps - step) };
    match step {
        0 => [ends[0], NO_POINT, 0],
        step if step == steps => [ends[1], NO_POINT, 0],
        step => [ends[0], ends[1], step],
    }
}

/// The faces to refine: those of patches that are not done, and all that share a vertex with them.
fn kept(level: &Level, cells: &[Option<(u32, u32, u32)>], is_wanted: impl Fn(u32) -> bool) -> Vec<bool> {
    let mut touched = vec![false; level.vertex_sharpness.len()];
    for (face, _) in
        cells.iter().enumerate().filter(|(_, cell)| cell.is_some_and(|(patch, ..)| is_wanted(patch)))
    {
        level.face(face as u32).for_each(|corner| touched[level.corners[corner] as usize] = true);
    }
    let faces = 0..level.ends.len() as u32;
    faces.map(|face| level.face(face).any(|corner| touched[level.corners[corner] as usize])).collect()
}
