//! Cuts a mesh into compact clusters of faces that fit a microgrid.
//!
//! Faces are parted recursively at the plane that makes the parts' boxes small and the clusters full: the surface
//! area heuristic (Goldsmith and Salmon 1987), with a part weighed by the clusters it will need. Everything downstream
//! profits from small boxes: batches, bricks, cuts. The work is O(n log n), parallel, and does not depend on threads.

use glam::Vec3;

use super::mesh::{Face, Mesh};
use crate::stream::VERTICES_MAX;

/// Faces of a cluster at most: about what 256 vertices carry in a mesh of quads, border included.
const FACES_TARGET: usize = 192;

/// Vertices that a cluster aims at when faces share few of them.
const VERTICES_TARGET: usize = 232;

/// Bins along each axis in which planes are compared.
const BINS: usize = 16;

/// Parts larger than this are cut by several threads.
const PARALLEL_MIN: usize = 1 << 16;

/// Faces in clusters: cluster i is `faces[ends[i - 1]..ends[i]]`.
#[derive(Debug, Default)]
pub(super) struct Clusters {
    faces: Vec<u32>,
    ends: Vec<u32>,
}

impl Clusters {
    /// The clusters as slices of face indices; neighbours in a slice are near to each other in space.
    pub fn iter(&self) -> impl Iterator<Item = &[u32]> {
        let mut start = 0;
        self.ends.iter().map(move |&end| {
            let cluster = &self.faces[start..end as usize];
            start = end as usize;
            cluster
        })
    }
}

/// What makes a vertex of a grid: corners with equal keys share one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct VertexKey {
    position_normal: u64,
    material_opacity: u64,
    variant: u32,
}

impl VertexKey {
    /// The key of a face's corner; `corner` indexes the mesh's corners.
    pub fn new(mesh: &Mesh, face: &Face, corner: usize) -> Self {
        let position = u64::from(mesh.corners[corner]) << 32;
        let thin = u64::from(face.arity < 3);
        Self {
            position_normal: position | u64::from(mesh.normal_index(corner)),
            material_opacity: u64::from(face.material) << 32 | u64::from(face.opacity) << 1 | thin,
            variant: mesh.variant(corner).unwrap_or(0),
        }
    }

    fn hash(&self) -> usize {
        let variant = u64::from(self.variant).wrapping_mul(0xd6e8_feb8_6659_fd93);
        let mixed = self.position_normal ^ self.material_opacity.rotate_left(17) ^ variant;
        let mixed = mixed ^ self.position_normal >> 29;
        (mixed.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 48) as usize
    }
}

/// A small hash table from vertex keys to indices in order of first use, emptied in constant time.
#[derive(Debug)]
pub(super) struct VertexTable {
    slots: Vec<(u32, u16, VertexKey)>,
    stamp: u32,
    count: usize,
}

impl VertexTable {
    /// A table for at most [`FACES_TARGET`] faces of 4 corners, or 256 points.
    pub fn new() -> Self {
        let empty = VertexKey { position_normal: 0, material_opacity: 0, variant: 0 };
        Self { slots: vec![(0, 0, empty); 2048], stamp: 0, count: 0 }
    }

    /// Forgets all keys.
    pub fn clear(&mut self) {
        self.stamp = self.stamp.wrapping_add(1);
        if self.stamp == 0 {
            self.slots.iter_mut().for_each(|slot| slot.0 = 0);
            self.stamp = 1;
        }
        self.count = 0;
    }

    /// The index of a key, and whether it is new.
    pub fn add(&mut self, key: VertexKey) -> (usize, bool) {
        let mask = self.slots.len() - 1;
        let mut at = key.hash() & mask;
        loop {
            let slot = &mut self.slots[at];
            if slot.0 != self.stamp {
                *slot = (self.stamp, self.count as u16, key);
                self.count += 1;
                return (self.count - 1, true);
            }
            if slot.2 == key {
                return (usize::from(slot.1), false);
            }
            at = (at + 1) & mask;
        }
    }
}

/// A face on its way into a cluster.
#[derive(Clone, Copy, Debug)]
struct Item {
    centroid: Vec3,
    face: u32,
}

/// Cuts a finished mesh. Faces of different objects never share a cluster.
pub(super) fn cut(mesh: &Mesh) -> Clusters {
    let bounds = mesh.bounds();
    let origin = bounds.center();
    let mut items: Vec<Item> = (mesh.faces.iter().enumerate())
        .map(|(index, face)| {
            let corners = mesh.face_corners(face);
            let sum: glam::DVec3 = corners.iter().map(|&c| mesh.positions[c as usize] - origin).sum();
            Item { centroid: (sum / corners.len() as f64).as_vec3(), face: index as u32 }
        })
        .collect();
    let object = |item: &Item| mesh.faces[item.face as usize].object;
    if !items.is_sorted_by_key(object) {
        items.sort_by_key(object);
    }
    let mut ends = Vec::new();
    let mut start = 0;
    for part in items.chunk_by_mut(|a, b| object(a) == object(b)) {
        let first = ends.len();
        split(part, mesh, &mut VertexTable::new(), &mut ends);
        ends[first..].iter_mut().for_each(|end| *end += start);
        start += part.len() as u32;
    }
    Clusters { faces: items.iter().map(|item| item.face).collect(), ends }
}

/// Reorders `items` into clusters and appends where each ends, counted from the start of `items`.
fn split(items: &mut [Item], mesh: &Mesh, table: &mut VertexTable, ends: &mut Vec<u32>) {
    let mut target = FACES_TARGET;
    if items.len() <= VERTICES_MAX {
        let vertices = count_vertices(items, mesh, table);
        let thin = vertices == items.len();
        if vertices <= VERTICES_MAX && (items.len() <= FACES_TARGET || thin) {
            order(items);
            ends.push(items.len() as u32);
            return;
        }
        target = (items.len() * VERTICES_TARGET / vertices).clamp(1, FACES_TARGET);
    }
    let middle = part(items, target);
    let (left, right) = items.split_at_mut(middle);
    let base = middle as u32;
    if left.len() + right.len() < PARALLEL_MIN {
        split(left, mesh, table, ends);
        let first = ends.len();
        split(right, mesh, table, ends);
        ends[first..].iter_mut().for_each(|end| *end += base);
    } else {
        let run = |part: &mut [Item]| {
            let mut ends = Vec::new();
            split(part, mesh, &mut VertexTable::new(), &mut ends);
            ends
        };
        let (before, behind) = rayon::join(|| run(left), || run(right));
        ends.extend(before);
        ends.extend(behind.iter().map(|end| end + base));
    }
}

/// Distinct vertices of at most 256 faces.
fn count_vertices(items: &[Item], mesh: &Mesh, table: &mut VertexTable) -> usize {
    table.clear();
    for item in items {
        let face = &mesh.faces[item.face as usize];
        for corner in face.start..face.start + face.arity {
            table.add(VertexKey::new(mesh, face, corner as usize));
        }
    }
    table.count
}

/// Sorts a cluster's faces along a Morton curve through its own box.
fn order(items: &mut [Item]) {
    let (min, size) = extent(items);
    let scale = 1023.0 / size.max(Vec3::splat(f32::MIN_POSITIVE));
    items.sort_unstable_by_key(|item| {
        let cell = ((item.centroid - min) * scale).as_uvec3();
        (spread(cell.x) | spread(cell.y) << 1 | spread(cell.z) << 2, item.face)
    });
}

/// Spreads the low 10 bits of a number to every third bit.
fn spread(x: u32) -> u32 {
    let x = (x | x << 16) & 0x0300_00ff;
    let x = (x | x << 8) & 0x0300_f00f;
    let x = (x | x << 4) & 0x030c_30c3;
    (x | x << 2) & 0x0924_9249
}

fn extent(items: &[Item]) -> (Vec3, Vec3) {
    let (min, max) = items
        .iter()
        .fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(a, b), i| (a.min(i.centroid), b.max(i.centroid)));
    (min, max - min)
}

/// What one bin holds.
#[derive(Clone, Copy)]
struct Bin {
    count: usize,
    min: Vec3,
    max: Vec3,
}

impl Bin {
    const EMPTY: Self = Self { count: 0, min: Vec3::INFINITY, max: Vec3::NEG_INFINITY };

    fn join(&mut self, other: &Self) {
        self.count += other.count;
        self.min = self.min.min(other.min);
        self.max = self.max.max(other.max);
    }

    /// Half the area of the padded box times the clusters needed.
    fn cost(&self, pad: f32, target: usize) -> f32 {
        let size = self.max - self.min + pad;
        (size.x * size.y + size.y * size.z + size.z * size.x) * self.count.div_ceil(target) as f32
    }
}

/// Parts the items in two near each other; returns how many come first. Neither part is empty.
fn part(items: &mut [Item], target: usize) -> usize {
    let n = items.len();
    let (min, size) = extent(items);
    if let Some((axis, bin)) = best_plane(items, min, size, target) {
        let scale = BINS as f32 / size[axis];
        let is_left = |item: &Item| bin_of(item.centroid[axis], min[axis], scale) < bin;
        return partition(items, is_left);
    }
    // No plane is good: the median along the longest axis, ties by the order in the file
    let axis = size.max_position();
    let key = |item: &Item| (item.centroid[axis], item.face);
    items.select_nth_unstable_by(n / 2, |a, b| {
        let (a, b) = (key(a), key(b));
        a.0.total_cmp(&b.0).then(a.1.cmp(&b.1))
    });
    n / 2
}

fn bin_of(x: f32, min: f32, scale: f32) -> usize {
    (((x - min) * scale) as usize).min(BINS - 1)
}

/// The axis and bin border of least cost among those that leave each side a fair share.
fn best_plane(items: &[Item], min: Vec3, size: Vec3, target: usize) -> Option<(usize, usize)> {
    let n = items.len();
    // Near the leaves halves must stay large, or clusters would be small; far from them a sixteenth bounds the depth
    let least = if n <= 4 * target { n / 4 } else { n / 16 }.max(1);
    let longest = size.max_element();
    let mut bins = [[Bin::EMPTY; BINS]; 3];
    let axes: [bool; 3] = std::array::from_fn(|axis| size[axis] > 1e-3 * longest);
    let scale = BINS as f32 / size;
    if !(longest > 0.0 && longest.is_finite()) {
        return None;
    }
    for item in items {
        for axis in 0..3 {
            if axes[axis] {
                let bin = &mut bins[axis][bin_of(item.centroid[axis], min[axis], scale[axis])];
                bin.join(&Bin { count: 1, min: item.centroid, max: item.centroid });
            }
        }
    }
    // Boxes are met by things about as large as a cluster. Without that a plane would be cut into strips: all ways to
    // cut a flat box sum to the same area
    let pad = 0.5 * longest * (target as f32 / n as f32).min(1.0).sqrt();
    let mut best = None;
    let mut best_cost = f32::INFINITY;
    for axis in (0..3).filter(|&axis| axes[axis]) {
        let mut behind = [Bin::EMPTY; BINS];
        let mut sum = Bin::EMPTY;
        for i in (1..BINS).rev() {
            sum.join(&bins[axis][i]);
            behind[i] = sum;
        }
        let mut before = Bin::EMPTY;
        for i in 1..BINS {
            before.join(&bins[axis][i - 1]);
            if before.count < least || behind[i].count < least {
                continue;
            }
            let cost = before.cost(pad, target) + behind[i].cost(pad, target);
            if cost < best_cost {
                (best, best_cost) = (Some((axis, i)), cost);
            }
        }
    }
    best
}

/// Brings the items that satisfy `is_left` to the front; returns how many they are.
fn partition(items: &mut [Item], is_left: impl Fn(&Item) -> bool) -> usize {
    let (mut left, mut right) = (0, items.len());
    loop {
        while left < right && is_left(&items[left]) {
            left += 1;
        }
        while left < right && !is_left(&items[right - 1]) {
            right -= 1;
        }
        if left == right {
            return left;
        }
        items.swap(left, right - 1);
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::import::ImportReport;
    use crate::math::Bounds;

    const FACE: Face = Face { start: 0, arity: 0, material: 0, object: 0, opacity: 255, hole: false };

    /// A wavy sheet of `n` by `n` quads in file order by rows.
    fn sheet(n: u32) -> Mesh {
        let mut mesh = Mesh::default();
        let mut report = ImportReport::default();
        for i in 0..(n + 1) * (n + 1) {
            let (x, y) = (f64::from(i % (n + 1)), f64::from(i / (n + 1)));
            mesh.positions.push(DVec3::new(x, y, 0.02 * (x * y) % 7.0));
        }
        for i in 0..n * n {
            let at = i / n * (n + 1) + i % n;
            mesh.push_face(FACE, &[at, at + 1, at + n + 2, at + n + 1], &mut report).unwrap();
        }
        mesh.finish(&mut report).unwrap();
        mesh
    }

    /// `count` separate triangles scattered by a fixed rule.
    fn soup(count: u32) -> Mesh {
        let mut mesh = Mesh::default();
        let mut report = ImportReport::default();
        let unit = |hash: u32| f64::from(crate::math::hash::unit_f32(crate::math::hash::hash32(hash)));
        for i in 0..count {
            let at = DVec3::new(unit(3 * i), unit(3 * i + 1), unit(3 * i + 2)) * 100.0;
            mesh.positions.extend([at, at + DVec3::X, at + DVec3::Y]);
            mesh.push_face(Face { object: i % 2, ..FACE }, &[3 * i, 3 * i + 1, 3 * i + 2], &mut report)
                .unwrap();
        }
        mesh.finish(&mut report).unwrap();
        mesh
    }

    /// Mean vertices per cluster, after checking that every face is in one cluster that fits a grid.
    fn check(mesh: &Mesh) -> (Clusters, f64) {
        let clusters = cut(mesh);
        let mut seen = vec![false; mesh.faces.len()];
        let mut table = VertexTable::new();
        let (mut vertices, mut count) = (0, 0);
        for cluster in clusters.iter() {
            table.clear();
            for &index in cluster {
                assert!(!std::mem::replace(&mut seen[index as usize], true), "face {index} twice");
                let face = &mesh.faces[index as usize];
                (face.start..face.start + face.arity)
                    .for_each(|corner| _ = table.add(VertexKey::new(mesh, face, corner as usize)));
            }
            let objects = cluster.iter().map(|&face| mesh.faces[face as usize].object);
            assert_eq!(objects.clone().min(), objects.max());
            assert!((1..=VERTICES_MAX).contains(&table.count), "{} vertices", table.count);
            vertices += table.count;
            count += 1;
        }
        assert!(seen.iter().all(|&seen| seen));
        (clusters, vertices as f64 / f64::from(count))
    }

    /// Catches a face that is lost, twice, or in a cluster that does not fit; clusters that are strips or half empty.
    #[test]
    fn clusters_are_full_and_compact() {
        let mesh = sheet(300);
        let (clusters, vertices) = check(&mesh);
        let edges: Vec<(f64, f64)> = (clusters.iter())
            .map(|cluster| {
                let mut bounds = Bounds::EMPTY;
                for &face in cluster {
                    let corners = mesh.face_corners(&mesh.faces[face as usize]);
                    corners.iter().for_each(|&c| bounds.add(mesh.positions[c as usize]));
                }
                (bounds.size().x + bounds.size().y, cluster.len() as f64)
            })
            .collect();
        // How much longer the outline is than that of a square of as many quads
        let stretch =
            edges.iter().map(|(edge, faces)| edge / (2.0 * faces.sqrt())).sum::<f64>() / edges.len() as f64;
        eprintln!(
            "sheet: {} clusters, {vertices:.0} vertices, outline {stretch:.2} of a square",
            edges.len()
        );
        assert!(vertices > 140.0 && stretch < 1.2);

        let (_, vertices) = check(&soup(30_000));
        eprintln!("soup: {vertices:.0} vertices");
        assert!(vertices > 140.0);
    }

    /// Catches recursion without end, or an empty part, where all faces lie in one place or on a line.
    #[test]
    fn coinciding_faces_are_cut_too() {
        for step in [0.0, 1e-30, 1.0, 1e25] {
            let mut mesh = soup(5000);
            mesh.positions
                .iter_mut()
                .enumerate()
                .for_each(|(i, p)| *p = DVec3::new(step * (i / 9) as f64, 0.0, 0.0));
            check(&mesh);
        }
        assert_eq!(cut(&Mesh::default()).iter().count(), 0);
    }

    /// Catches clusters that depend on the number of threads.
    #[test]
    fn threads_do_not_change_clusters() {
        let mesh = soup(200_000);
        let cut_with = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let clusters = pool.install(|| cut(&mesh));
            (clusters.faces, clusters.ends)
        };
        assert!(cut_with(1) == cut_with(3));
    }

    /// Prints the rate for ten million faces; run by hand.
    #[test]
    #[ignore = "takes gigabytes and half a minute"]
    fn rate() {
        let mesh = sheet(3163);
        let start = std::time::Instant::now();
        let clusters = cut(&mesh);
        let seconds = start.elapsed().as_secs_f64();
        let faces = mesh.faces.len() as f64;
        eprintln!("{faces} faces, {} clusters: {:.2} M faces/s", clusters.ends.len(), faces / seconds / 1e6);
        struct Null;
        impl crate::import::GridSink for Null {
            fn begin(&mut self, _: &crate::stream::Schema, _: &[(String, String)]) -> crate::Result<()> {
                Ok(())
            }

            fn copies(&mut self, _: &crate::import::Copies) -> crate::Result<()> {
                Ok(())
            }
            fn grid(&mut self, _: &crate::stream::Microgrid) -> crate::Result<()> {
                Ok(())
            }
        }
        use crate::import::emit::{Carried, Emitter, Placement};
        let mut sink = Null;
        let mut emitter = Emitter::new(&mut sink, Carried::by(&mesh), &Default::default()).unwrap();
        let start = std::time::Instant::now();
        let mut report = ImportReport::default();
        emitter.emit(&mesh, &clusters, &Placement::HERE, (0, 0.0), &mut report).unwrap();
        eprintln!("emitted at {:.2} M faces/s", faces / start.elapsed().as_secs_f64() / 1e6);
    }
}
