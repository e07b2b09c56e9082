//! The cage of a Catmull-Clark surface, and the levels to which its edges are diced.

use std::collections::{HashMap, HashSet};

use glam::DVec3;

use super::level::SHARP;
use super::rate::Rate;

/// Steps of subdivision at most before a semi-sharp crease counts as what it has become.
const DEPTH_MAX: u8 = 6;

/// A polygon mesh that stands for its Catmull-Clark limit surface.
#[derive(Debug, Default)]
pub struct Cage {
    /// Points.
    pub positions: Vec<DVec3>,
    /// Corners of the faces, three or more each, no point twice in a face.
    pub corners: Vec<u32>,
    /// Where the corners of each face end.
    pub ends: Vec<u32>,
    /// Values per point that follow the surface, `smooth_width` each.
    pub smooth: Vec<f32>,
    /// Smooth values of a point.
    pub smooth_width: usize,
    /// Values per corner that are linear in each face, `linear_width` each.
    pub linear: Vec<f32>,
    /// Linear values of a corner.
    pub linear_width: usize,
    /// Values per corner that follow the surface: cages of the same faces, whose points are several at a seam.
    pub skins: Vec<Cage>,
    /// Sharp edges by their ends, the lower first, from 0 to [`SHARP`].
    pub creases: HashMap<[u32; 2], f32>,
    /// Sharp points.
    pub sharp_points: HashMap<u32, f32>,
    /// Whether points of one face alone are sharp: USD's `edgeAndCorner`.
    pub sharp_corners: bool,
}

/// A cage and what is known of its neighbourhoods and rates.
pub struct Prepared<'a> {
    /// The cage.
    pub cage: &'a Cage,
    /// How fine.
    pub rate: &'a Rate,
    /// Per point where its faces end.
    face_ends: Vec<u32>,
    /// Faces by point, in order.
    faces: Vec<u32>,
    /// Edges of faces that are no quads: they are halved at least once.
    halved: HashSet<[u32; 2]>,
    /// Points at creases that are sharp for a while: the level behind which they are not.
    depths: HashMap<u32, u8>,
    /// Points whose faces are neither one fan nor meet along one line: they stay where they are.
    knots: HashSet<u32>,
    /// The cage's skins.
    pub(super) skins: Vec<Prepared<'a>>,
}

impl Cage {
    /// The corners of a face.
    pub(super) fn face(&self, face: u32) -> std::ops::Range<usize> {
        let start = face.checked_sub(1).map_or(0, |before| self.ends[before as usize]);
        start as usize..self.ends[face as usize] as usize
    }

    /// The ends of the edge behind a corner, in its face's direction.
    pub(super) fn edge(&self, face: u32, side: usize) -> [u32; 2] {
        let corners = &self.corners[self.face(face)];
        [corners[side], corners[(side + 1) % corners.len()]]
    }

    /// Looks at neighbourhoods.
    pub fn prepare<'a>(&'a self, rate: &'a Rate) -> Prepared<'a> {
        let faces = self.ends.len() as u32;
        let mut face_ends = vec![0_u32; self.positions.len()];
        self.corners.iter().for_each(|&point| face_ends[point as usize] += 1);
        let mut sum = 0;
        for end in &mut face_ends {
            sum += *end;
            *end = sum - *end;
        }
        let mut by_point = vec![0; sum as usize];
        let mut halved = HashSet::new();
        for face in 0..faces {
            let range = self.face(face);
            for (side, &point) in self.corners[range.clone()].iter().enumerate() {
                by_point[face_ends[point as usize] as usize] = face;
                face_ends[point as usize] += 1;
                if range.len() != 4 {
                    halved.insert(sorted(self.edge(face, side)));
                }
            }
        }
        let mut depths: HashMap<u32, u8> = HashMap::new();
        let mut deepen = |point: u32, sharpness: f32| {
            if sharpness > 0.0 && sharpness < SHARP {
                let depth = (sharpness.ceil() as u8 + 1).min(DEPTH_MAX);
                let known = depths.entry(point).or_default();
                *known = depth.max(*known);
            }
        };
        for (ends, &sharpness) in &self.creases {
            ends.iter().for_each(|&end| deepen(end, sharpness));
        }
        self.sharp_points.iter().for_each(|(&point, &sharpness)| deepen(point, sharpness));
        let skins = self.skins.iter().map(|skin| skin.prepare(rate)).collect();
        let knots = HashSet::new();
        let mut prepared =
            Prepared { cage: self, rate, face_ends, faces: by_point, halved, depths, knots, skins };
        prepared.knots = (0..self.positions.len() as u32).filter(|&point| prepared.is_knot(point)).collect();
        prepared
    }
}

impl Prepared<'_> {
    /// The faces around a point.
    pub(super) fn faces_of(&self, point: u32) -> &[u32] {
        let start = point.checked_sub(1).map_or(0, |before| self.face_ends[before as usize]);
        &self.faces[start as usize..self.face_ends[point as usize] as usize]
    }

    /// The given faces and all around them, in order.
    pub(super) fn with_neighbours(&self, faces: &[u32]) -> Vec<u32> {
        let mut points =
            faces.iter().flat_map(|&face| &self.cage.corners[self.cage.face(face)]).collect::<Vec<_>>();
        points.sort_unstable();
        points.dedup();
        let mut numbers: Vec<u32> =
            points.into_iter().flat_map(|&point| self.faces_of(point)).copied().collect();
        numbers.sort_unstable();
        numbers.dedup();
        numbers
    }

    /// Whether the rules of smooth points, creases and borders say nothing of a point: its faces touch there without an
    /// edge between them, or an edge of more than two faces, or of two that face opposite ways, ends there or branches.
    fn is_knot(&self, point: u32) -> bool {
        // The neighbours behind and before the point in each face, by the first
        let faces = self.faces_of(point).iter();
        let mut links: Vec<[u32; 2]> = faces.map(|&face| self.neighbours(face, point)).collect();
        links.sort_unstable();
        let mut befores: Vec<u32> = links.iter().map(|link| link[1]).collect();
        befores.sort_unstable();
        let behinds: Vec<u32> = links.iter().map(|link| link[0]).collect();
        let twice = |all: &[u32]| -> Vec<u32> {
            all.windows(2).filter(|pair| pair[0] == pair[1]).map(|pair| pair[0]).collect()
        };
        let mut odd = [twice(&behinds), twice(&befores)].concat();
        odd.sort_unstable();
        odd.dedup();
        if !odd.is_empty() {
            let has = |all: &[u32], end: &u32| all.binary_search(end).is_ok();
            let is_border = |other: &[u32], end: &u32| !has(other, end) && !has(&odd, end);
            let on_border = behinds.iter().any(|end| is_border(&befores, end))
                || befores.iter().any(|end| is_border(&behinds, end));
            // Along a line where sheets meet, points lie on a crease
            return odd.len() != 2 || on_border;
        }
        if links.is_empty() {
            return false;
        }
        // Walk from face to face, from the border if there is one: a single fan has them all
        let first = links.iter().position(|link| befores.binary_search(&link[0]).is_err()).unwrap_or(0);
        let (mut at, mut steps) = (Some(first), 0);
        while let Some(here) = at.filter(|&here| here != first || steps == 0) {
            steps += 1;
            at = behinds.binary_search(&links[here][1]).ok();
        }
        steps < links.len()
    }

    /// The points behind and before one in a face.
    fn neighbours(&self, face: u32, point: u32) -> [u32; 2] {
        let corners = &self.cage.corners[self.cage.face(face)];
        let count = corners.len();
        let at = corners.iter().position(|&corner| corner == point).expect("a face of this point");
        [corners[(at + 1) % count], corners[(at + count - 1) % count]]
    }

    /// How sharp a point is.
    pub(super) fn point_sharpness(&self, point: u32) -> f32 {
        let is_corner = self.cage.sharp_corners && self.faces_of(point).len() == 1;
        let corner = if is_corner || self.knots.contains(&point) { SHARP } else { 0.0 };
        self.cage.sharp_points.get(&point).map_or(corner, |own| own.max(corner))
    }

    /// How often an edge is halved.
    pub(super) fn level(&self, ends: [u32; 2]) -> u8 {
        let ends = sorted(ends);
        let [a, b] = ends.map(|end| self.cage.positions[end as usize]);
        self.rate.level(a, b).max(u8::from(self.halved.contains(&ends)))
    }

    /// The level at which a point's place is read off: the same whichever face asks.
    pub(super) fn point_depth(&self, point: u32) -> u8 {
        self.depths.get(&point).map_or(1, |&depth| depth.max(1))
    }

    /// The level at which the points on an edge are read off.
    pub(super) fn edge_depth(&self, ends: [u32; 2]) -> u8 {
        let [a, b] = ends.map(|end| self.point_depth(end));
        self.level(ends).max(a).max(b)
    }

    /// Faces that a face becomes, at most.
    pub fn estimate(&self, face: u32) -> u64 {
        let count = self.cage.face(face).len();
        let finest = (0..count).map(|side| self.level(self.cage.edge(face, side))).max().unwrap_or(0);
        match count {
            4 => 1 << (2 * finest),
            _ => (count as u64) << (2 * finest.saturating_sub(1)),
        }
    }

    /// Whether a face stays coarser than asked for.
    pub fn falls_short(&self, face: u32) -> bool {
        let edges = (0..self.cage.face(face).len()).map(|side| self.cage.edge(face, side));
        let mut ends = edges.map(|ends| ends.map(|end| self.cage.positions[end as usize]));
        ends.any(|[a, b]| self.rate.falls_short(a, b))
    }

    /// The centre of a face.
    pub fn center(&self, face: u32) -> DVec3 {
        let corners = &self.cage.corners[self.cage.face(face)];
        corners.iter().map(|&point| self.cage.positions[point as usize]).sum::<DVec3>() / corners.len() as f64
    }
}

/// The ends of an edge, the lower first.
pub(super) fn sorted([a, b]: [u32; 2]) -> [u32; 2] {
    [a.min(b), a.max(b)]
}
