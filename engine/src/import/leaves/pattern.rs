//! How a triangle is cut along its texture: in four, again and again, while its parts are neither small nor even.

use std::collections::HashMap;
use std::rc::Rc;

use glam::{DVec3, Vec2};

use super::texture::Averager;
use crate::Result;
use crate::import::ImportReport;
use crate::import::cut::{self, VertexKey, VertexTable};
use crate::import::emit::opacity_byte;
use crate::import::mesh::{Face, Mesh};

/// An edge is halved so often at most: 16,384 texels to two.
pub(super) const LEVEL_MAX: u32 = 13;

/// The corners' weights in a point of a triangle add up to this.
pub(super) const WHOLE: u16 = 1 << LEVEL_MAX;

/// Parts that a triangle is cut to, about: a card of 1,024 by 1,024 texels, cut everywhere to two. With more, the last
/// ones are larger than wanted and averaged.
const PARTS_MAX: usize = 1 << 18;

/// Parts of all patterns remembered: cards of one leaf share theirs.
const KEPT_MAX: usize = 1 << 20;

/// A point of a triangle, by how much each corner weighs.
pub(super) type Weights = [u16; 3];

/// A vertex of a pattern.
pub(super) struct Vertex {
    pub weights: Weights,
    /// The texture's linear colour around it.
    pub rgb: [f32; 3],
    pub opacity: u8,
}

/// Parts of a pattern that make a microgrid.
#[derive(Default)]
pub(super) struct PatternGrid {
    pub vertices: Vec<Vertex>,
    pub faces: Vec<[u8; 3]>,
}

/// A triangle cut along its texture, in grids that every triangle of the same coordinates shares.
#[derive(Default)]
pub(super) struct Pattern {
    pub grids: Vec<PatternGrid>,
    /// Parts that stop light.
    pub faces: u64,
    /// Parts that are wholly clear.
    pub clear: u64,
    /// Parts that should have been cut further.
    pub coarse: u64,
}

/// What a triangle is cut by.
#[derive(Clone, Copy)]
pub(super) struct Wanted {
    /// Texels along the edges of a part at most, where coverage changes.
    pub texels: f32,
    /// How often edges are halved at least.
    pub level: u32,
}

/// Patterns by the coordinates and alphas of their corners, and by how finely they are cut at least.
#[derive(Default)]
pub(super) struct Patterns {
    known: HashMap<[u32; 10], Rc<Pattern>>,
    parts: usize,
}

impl Patterns {
    /// The pattern of a triangle of given texture coordinates and vertex alphas.
    pub fn find(
        &mut self,
        averager: &Averager<'_>,
        uv: [Vec2; 3],
        alphas: [f32; 3],
        wanted: Wanted,
    ) -> Result<Rc<Pattern>> {
        let key = std::array::from_fn(|i| match i {
            0..6 => uv[i / 2][i % 2].to_bits(),
            6..9 => alphas[i - 6].to_bits(),
            _ => wanted.level,
        });
        if let Some(known) = self.known.get(&key) {
            return Ok(known.clone());
        }
        let pattern = Rc::new(Pattern::new(averager, uv, alphas, wanted)?);
        self.parts += pattern.faces as usize + 1;
        if self.parts > KEPT_MAX {
            self.known.clear();
            self.parts = pattern.faces as usize + 1;
        }
        self.known.insert(key, pattern.clone());
        Ok(pattern)
    }
}

impl Pattern {
    fn new(averager: &Averager<'_>, uv: [Vec2; 3], alphas: [f32; 3], wanted: Wanted) -> Result<Self> {
        let mut pattern = Self::default();
        let parts = pattern.cut(averager, uv, alphas, wanted);

        // What each part shows, and the colour around each point
        let (mut numbers, mut points, mut kept) = (HashMap::new(), Vec::new(), Vec::new());
        for (part, area) in parts {
            let average =
                averager.sample(part.map(|point| blend(point, uv)), part.map(|point| blend(point, alphas)));
            if average.opacity <= 0.0 {
                pattern.clear += 1;
                continue;
            }
            let weight = area * average.opacity;
            for point in part {
                let number = *numbers.entry(point).or_insert_with(|| {
                    points.push((point, [0.0_f32; 4]));
                    points.len() as u32 - 1
                });
                let sums = &mut points[number as usize].1;
                (0..3).for_each(|i| sums[i] += average.rgb[i] * weight);
                sums[3] += weight;
            }
            kept.push((part, opacity_byte(average.opacity)));
        }

        // Larger parts take up the points of smaller ones on their edges: no gap opens there
        let mut mesh = Mesh { positions: texels(averager, uv, &points), ..Mesh::default() };
        for (part, opacity) in kept {
            conform(part, &numbers, &mut |part| {
                let face = Face { start: 0, arity: 0, material: 0, object: 0, opacity, hole: false };
                let corners = part.map(|point| numbers[&point]);
                mesh.push_face(face, &corners, &mut ImportReport::default())
            })?;
        }
        pattern.faces = mesh.faces.len() as u64;
        pattern.grids = grids(&mesh, &points);
        Ok(pattern)
    }

    /// The parts of a triangle and their share of its area: each is cut in four while it is neither small nor even.
    fn cut(
        &mut self,
        averager: &Averager<'_>,
        uv: [Vec2; 3],
        alphas: [f32; 3],
        wanted: Wanted,
    ) -> Vec<([Weights; 3], f32)> {
        let mut texels = averager.longest_edge(uv);
        let (mut open, mut done) =
            (vec![[[WHOLE, 0, 0], [0, WHOLE, 0], [0, 0, WHOLE]]], Vec::<([Weights; 3], f32)>::new());
        let mut area = 1.0;
        for level in 0..=LEVEL_MAX {
            let mut next = Vec::new();
            for part in std::mem::take(&mut open) {
                let at = part.map(|point| blend(point, uv));
                let is_fine = || {
                    texels <= wanted.texels || averager.is_even(at, part.map(|point| blend(point, alphas)))
                };
                if level >= wanted.level && is_fine() {
                    done.push((part, area));
                } else if level == LEVEL_MAX || done.len() + next.len() >= PARTS_MAX {
                    self.coarse += 1;
                    done.push((part, area));
                } else {
                    next.extend(quarters(part));
                }
            }
            open = next;
            texels *= 0.5;
            area *= 0.25;
        }
        done
    }
}

/// Where points lie on the image, in texels: grids that are compact there are compact on the card.
fn texels(averager: &Averager<'_>, uv: [Vec2; 3], points: &[(Weights, [f32; 4])]) -> Vec<DVec3> {
    let corners = averager.on_image(uv);
    points.iter().map(|(point, _)| blend(*point, corners).extend(0.0).as_dvec3()).collect()
}

/// Parts a pattern's faces into grids.
fn grids(mesh: &Mesh, points: &[(Weights, [f32; 4])]) -> Vec<PatternGrid> {
    let mut table = VertexTable::new();
    let grid = |cluster: &[u32]| {
        let mut grid = PatternGrid::default();
        table.clear();
        for &index in cluster {
            let face = &mesh.faces[index as usize];
            let corners: [usize; 3] = std::array::from_fn(|i| face.start as usize + i);
            grid.faces.push(corners.map(|corner| {
                let (number, is_new) = table.add(VertexKey::new(mesh, face, corner));
                if is_new {
                    let (weights, [r, g, b, weight]) = points[mesh.corners[corner] as usize];
                    let rgb = [r, g, b].map(|sum| sum / weight);
                    grid.vertices.push(Vertex { weights, rgb, opacity: face.opacity });
                }
                number as u8
            }));
        }
        grid
    };
    cut::cut(mesh).iter().map(grid).collect()
}

/// Parts a triangle at each point that lies in the middle of an edge, and again.
fn conform(
    part: [Weights; 3],
    points: &HashMap<Weights, u32>,
    take: &mut dyn FnMut([Weights; 3]) -> Result<()>,
) -> Result<()> {
    for i in 0..3 {
        let [a, b, c] = [part[i], part[(i + 1) % 3], part[(i + 2) % 3]];
        if (0..3).any(|i| (a[i] + b[i]) % 2 == 1) {
            continue;
        }
        let middle = middle(a, b);
        if points.contains_key(&middle) {
            conform([a, middle, c], points, take)?;
            return conform([middle, b, c], points, take);
        }
    }
    take(part)
}

fn middle(a: Weights, b: Weights) -> Weights {
    std::array::from_fn(|i| (a[i] + b[i]) / 2)
}

/// A triangle's quarters, which face as it does.
fn quarters([a, b, c]: [Weights; 3]) -> [[Weights; 3]; 4] {
    let (ab, bc, ca) = (middle(a, b), middle(b, c), middle(c, a));
    [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
}

/// The value at a point of a triangle.
pub(super) fn blend<T>(weights: Weights, values: [T; 3]) -> T
where
    T: Copy + std::ops::Mul<f32, Output = T> + std::ops::Add<Output = T>,
{
    let [a, b, c] = weights.map(|weight| f32::from(weight) / f32::from(WHOLE));
    values[0] * a + values[1] * b + values[2] * c
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::import::polygon::area_normal;

    fn area(part: [Weights; 3]) -> f64 {
        area_normal(&part.map(|w| DVec3::new(f64::from(w[0]), f64::from(w[1]), 0.0))).z
    }

    const ALL: [Weights; 3] = [[WHOLE, 0, 0], [0, WHOLE, 0], [0, 0, WHOLE]];

    /// Catches parts that face the other way, overlap or leave gaps.
    #[test]
    fn quarters_fill_the_triangle() {
        assert_eq!(quarters(ALL).map(area), [area(ALL) / 4.0; 4]);
    }

    /// Catches points in the middle of a larger part's edge, at which a gap would open, and area that is lost or doubled.
    #[test]
    fn larger_parts_take_up_the_points_of_smaller_ones() {
        let mut parts = quarters(ALL).to_vec();
        let [first, ..] = quarters(parts.swap_remove(3));
        let small = quarters(first);
        parts.extend(small);
        let points: HashMap<Weights, u32> = parts.iter().flatten().map(|&point| (point, 0)).collect();
        let mut found = Vec::new();
        for &part in &parts {
            conform(part, &points, &mut |part| (found.push(part), Ok(())).1).unwrap();
        }
        let sum = |parts: &[[Weights; 3]]| parts.iter().map(|&part| area(part)).sum::<f64>();
        assert!(found.len() > parts.len() && (sum(&found) - sum(&parts)).abs() < 1e-6);
        for part in found {
            assert!(area(part) * area(ALL) > 0.0, "{part:?}");
            assert!((0..3).all(|i| !points.contains_key(&middle(part[i], part[(i + 1) % 3]))), "{part:?}");
        }
    }
}
