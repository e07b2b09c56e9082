//! Triangles whose texture lets light through, cut along it: to edges of two texels and less where coverage changes, in
//! larger parts where it does not, and without the parts that are wholly clear.

use std::collections::HashMap;
use std::rc::Rc;

use glam::{DVec3, Vec2, Vec3};

use super::primitive::{Surface, vertex_color};
use super::texture::{Averager, Images};
use crate::Result;
use crate::import::emit::{Placement, corner_normal, opacity_byte, power_of_two, resolution};
use crate::import::mesh::{Face, Mesh};
use crate::import::{ImportReport, srgb};

/// Texels along the edges of a part at most, where coverage changes.
const TEXELS_MAX: f32 = 2.0;

/// An edge is halved so often at most: 16,384 texels to two.
const LEVEL_MAX: u32 = 13;

/// The corners' weights in a point of a triangle add up to this.
const WHOLE: u16 = 1 << LEVEL_MAX;

/// Parts that a triangle is cut to, about; the last ones are larger than wanted and averaged.
const PARTS_MAX: usize = 1 << 17;

/// Parts of all patterns remembered: cards of one leaf share theirs.
const KEPT_MAX: usize = 1 << 19;

/// Faces after which a mesh is handed on.
const CHUNK_MAX: usize = 1 << 17;

/// What cutting takes at its peak: the mesh made, and the patterns.
pub(super) const BYTES: u64 = 64 << 20;

/// What the faces of a primitive are cut by.
pub(super) struct Leaves {
    pub surface: Surface,
    /// Two coordinates a vertex.
    pub uvs: Vec<f32>,
    /// Colours of vertices and their components, if there are any.
    pub colors: Option<(Vec<f32>, usize)>,
    pub with_albedo: bool,
}

type Weights = [u16; 3];

/// A triangle cut along its texture.
#[derive(Default)]
struct Pattern {
    /// Where the points lie, and the texture's linear colour around them.
    points: Vec<(Weights, [f32; 3])>,
    /// Parts that stop light, and their opacity.
    faces: Vec<([u32; 3], u8)>,
    /// Parts that are wholly clear.
    clear: u64,
    /// Parts that should have been cut further.
    coarse: u64,
}

impl Leaves {
    /// Cuts a finished mesh of triangles and hands the parts over, mesh by mesh.
    pub fn cut(
        &self,
        mesh: &Mesh,
        images: &Images,
        report: &mut ImportReport,
        mut take: impl FnMut(&Mesh) -> Result<()>,
    ) -> Result<()> {
        let texture = self.surface.texture.as_ref().expect("leaves have a texture");
        let (alpha, factor) = (self.surface.alpha, self.surface.factor[3]);
        let averager = Averager::new(images, texture, alpha, factor, mesh.faces.len());
        let step = power_of_two(resolution(mesh.bounds().size().max_element()));
        let mut patterns = Patterns::default();
        let mut part = Mesh::default();
        for face in &mesh.faces {
            let corners = mesh.face_corners(face);
            let pattern = patterns.find(&averager, self.corner_uvs(corners), self.corner_alphas(corners));
            report.skip("parts of textured faces that are wholly clear", pattern.clear);
            if pattern.coarse > 0 {
                report.warn("a face with too many texels is cut less finely than to two of them".into());
            }
            self.add(mesh, face, &pattern, step, &mut part);
            if part.faces.len() >= CHUNK_MAX {
                part.finish(report)?;
                take(&part)?;
                part = Mesh::default();
            }
        }
        if part.faces.is_empty() {
            return Ok(());
        }
        part.finish(report)?;
        take(&part)
    }

    fn corner_uvs(&self, corners: &[u32]) -> [Vec2; 3] {
        std::array::from_fn(|i| Vec2::from_slice(&self.uvs[2 * corners[i] as usize..]))
    }

    fn corner_alphas(&self, corners: &[u32]) -> [f32; 3] {
        std::array::from_fn(|i| vertex_color(self.colors.as_ref(), corners[i] as usize)[3])
    }

    /// Adds the parts of a face to a mesh. Points on an edge are the same seen from both sides.
    fn add(&self, mesh: &Mesh, face: &Face, pattern: &Pattern, step: f64, part: &mut Mesh) {
        let first = part.positions.len() as u32;
        let corners = mesh.face_corners(face);
        let positions: [DVec3; 3] = std::array::from_fn(|i| mesh.positions[corners[i] as usize]);
        let here = |i: usize| corner_normal(mesh, face, face.start as usize + i, &Placement::HERE);
        let normals: [Vec3; 3] = std::array::from_fn(here);
        let colors: [[f32; 4]; 3] =
            std::array::from_fn(|i| vertex_color(self.colors.as_ref(), corners[i] as usize));
        for (weights, texture) in &pattern.points {
            let [a, b, c] = weights.map(|weight| f64::from(weight) / f64::from(WHOLE));
            let position = positions[0] * a + positions[1] * b + positions[2] * c;
            part.positions.push((position / step).round() * step);
            let share = [a as f32, b as f32, c as f32];
            let sum = normals[0] * share[0] + normals[1] * share[1] + normals[2] * share[2];
            part.normals.push(sum.try_normalize().unwrap_or(normals[0]));
            if self.with_albedo {
                part.colors.push(std::array::from_fn(|i| {
                    let own: f32 = (0..3).map(|corner| colors[corner][i] * share[corner]).sum();
                    srgb::unit_byte(self.surface.factor[i] * texture[i] * own)
                }));
            }
        }
        for &(points, opacity) in &pattern.faces {
            let start = part.corners.len() as u32;
            part.corners.extend(points.map(|point| first + point));
            part.faces.push(Face { start, arity: 3, opacity, ..*face });
        }
    }
}

/// Patterns by the coordinates and alphas of their corners.
#[derive(Default)]
struct Patterns {
    known: HashMap<[u32; 9], Rc<Pattern>>,
    parts: usize,
}

impl Patterns {
    fn find(&mut self, averager: &Averager<'_>, uv: [Vec2; 3], alphas: [f32; 3]) -> Rc<Pattern> {
        let key = std::array::from_fn(|i| match i {
            0..6 => uv[i / 2][i % 2].to_bits(),
            _ => alphas[i - 6].to_bits(),
        });
        if let Some(known) = self.known.get(&key) {
            return known.clone();
        }
        let pattern = Rc::new(Pattern::new(averager, uv, alphas));
        self.parts += pattern.faces.len() + 1;
        if self.parts > KEPT_MAX {
            self.known.clear();
            self.parts = pattern.faces.len() + 1;
        }
        self.known.insert(key, pattern.clone());
        pattern
    }
}

impl Pattern {
    fn new(averager: &Averager<'_>, uv: [Vec2; 3], alphas: [f32; 3]) -> Self {
        let mut pattern = Self::default();
        let parts = pattern.cut(averager, uv, alphas);
        let (mut numbers, mut sums) = (HashMap::new(), Vec::new());
        for (part, area) in parts {
            let average =
                averager.sample(part.map(|point| blend(point, uv)), part.map(|point| blend(point, alphas)));
            if average.opacity <= 0.0 {
                pattern.clear += 1;
                continue;
            }
            let points = part.map(|point| {
                *numbers.entry(point).or_insert_with(|| {
                    pattern.points.push((point, [0.0; 3]));
                    sums.push(0.0_f32);
                    sums.len() as u32 - 1
                })
            });
            let weight = area * average.opacity;
            for point in points {
                let sum = &mut pattern.points[point as usize].1;
                (0..3).for_each(|i| sum[i] += average.rgb[i] * weight);
                sums[point as usize] += weight;
            }
            pattern.faces.push((points, opacity_byte(average.opacity)));
        }
        for ((_, rgb), weight) in pattern.points.iter_mut().zip(sums) {
            *rgb = rgb.map(|sum| sum / weight);
        }
        pattern
    }

    /// The parts of a triangle and their share of its area: each is cut in four while it is neither small nor even.
    fn cut(&mut self, averager: &Averager<'_>, uv: [Vec2; 3], alphas: [f32; 3]) -> Vec<([Weights; 3], f32)> {
        let mut texels = averager.longest_edge(uv);
        let (mut open, mut done) =
            (vec![[[WHOLE, 0, 0], [0, WHOLE, 0], [0, 0, WHOLE]]], Vec::<([Weights; 3], f32)>::new());
        let mut area = 1.0;
        for level in 0..=LEVEL_MAX {
            let mut next = Vec::new();
            for part in std::mem::take(&mut open) {
                let at = part.map(|point| blend(point, uv));
                if texels <= TEXELS_MAX || averager.is_even(at, part.map(|point| blend(point, alphas))) {
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

/// A triangle's quarters, which face as it does.
fn quarters([a, b, c]: [Weights; 3]) -> [[Weights; 3]; 4] {
    let middle = |a: Weights, b: Weights| -> Weights { std::array::from_fn(|i| (a[i] + b[i]) / 2) };
    let (ab, bc, ca) = (middle(a, b), middle(b, c), middle(c, a));
    [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
}

/// The value at a point of a triangle.
fn blend<T>(weights: Weights, values: [T; 3]) -> T
where
    T: Copy + std::ops::Mul<f32, Output = T> + std::ops::Add<Output = T>,
{
    let [a, b, c] = weights.map(|weight| f32::from(weight) / f32::from(WHOLE));
    values[0] * a + values[1] * b + values[2] * c
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::import::gltf::document::AlphaMode;
    use crate::import::polygon::area_normal;

    /// Edge of the test's image, in texels.
    const SIZE: usize = 128;

    /// Alpha of a ring with a soft rim, off the image's middle.
    fn ring(x: usize, y: usize) -> u8 {
        let from = ((x as f32 - 70.0).powi(2) + (y as f32 - 55.0).powi(2)).sqrt();
        (255.0 * (1.0 - ((from - 35.0).abs() - 12.0) / 6.0).clamp(0.0, 1.0)) as u8
    }

    /// A card over the unit square, cut along the ring.
    fn cut(alpha: AlphaMode) -> (Mesh, ImportReport) {
        let texels = (0..SIZE * SIZE).flat_map(|i| [20, 200, 10, ring(i % SIZE, i / SIZE)]).collect();
        let (images, texture) = Images::square(SIZE as u32, texels);
        let surface = Surface { factor: [1.0; 4], texture: Some(texture), alpha };
        let mut card = Mesh::default();
        let mut report = ImportReport::default();
        let face = Face { start: 0, arity: 0, material: 0, object: 0, opacity: 255 };
        card.positions =
            [[0.0; 3], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]].map(DVec3::from).into();
        card.push_face(face, &[0, 1, 2], &mut report).unwrap();
        card.push_face(face, &[0, 2, 3], &mut report).unwrap();
        card.finish(&mut report).unwrap();
        // The card's edges lie a hair inside of the image, which repeats
        let uvs = [0.0, 0.0, 0.9999, 0.0, 0.9999, 0.9999, 0.0, 0.9999].into();
        let leaves = Leaves { surface, uvs, colors: None, with_albedo: true };
        let mut parts = Vec::new();
        let taken = leaves.cut(&card, &images, &mut report, |part| {
            parts.push(part.clone());
            Ok(())
        });
        taken.unwrap();
        assert_eq!(parts.len(), 1);
        (parts.remove(0), report)
    }

    /// What a picture of `n` by `n` pixels shows of a mesh in the unit square: opacities, looked at along z.
    fn picture(mesh: &Mesh, n: usize) -> Vec<f32> {
        let mut pixels = vec![0.0; n * n];
        for face in &mesh.faces {
            let points: Vec<DVec3> =
                mesh.face_corners(face).iter().map(|&corner| mesh.positions[corner as usize]).collect();
            let side = |i: usize, p: DVec3| {
                (points[(i + 1) % 3] - points[i]).truncate().perp_dot((p - points[i]).truncate())
            };
            let (low, high) = points.iter().fold((points[0], points[0]), |(l, h), p| (l.min(*p), h.max(*p)));
            let pixel = |x: f64| ((x * n as f64) as usize).min(n - 1);
            for y in pixel(low.y)..=pixel(high.y) {
                for x in pixel(low.x)..=pixel(high.x) {
                    let p = DVec3::new((x as f64 + 0.5137) / n as f64, (y as f64 + 0.4871) / n as f64, 0.0);
                    if (0..3).all(|i| side(i, p) >= 0.0) {
                        pixels[y * n + x] = f32::from(face.opacity) / 255.0;
                    }
                }
            }
        }
        pixels
    }

    /// Catches a leaf whose outline or density is not its texture's: one that is opaque, shifted, shrunk or blurred.
    #[test]
    fn a_card_looks_like_its_texture() {
        for alpha in [AlphaMode::Mask(0.5), AlphaMode::Mask(0.9), AlphaMode::Blend] {
            let (mesh, _) = cut(alpha);
            let n = 400;
            let seen = picture(&mesh, n);
            let wanted: Vec<f32> = (0..n * n)
                .map(|i| [i % n, i / n].map(|x| x * SIZE / n))
                .map(|[x, y]| super::super::texture::coverage(alpha, f32::from(ring(x, y)) / 255.0))
                .collect();
            let mean = |values: &[f32]| values.iter().sum::<f32>() / values.len() as f32;
            assert!((mean(&seen) / mean(&wanted) - 1.0).abs() < 0.005, "{} {}", mean(&seen), mean(&wanted));
            let pairs = || seen.iter().zip(&wanted).map(|(a, b)| [*a >= 0.5, *b >= 0.5]);
            let both = pairs().filter(|[a, b]| *a && *b).count() as f32;
            let either = pairs().filter(|[a, b]| *a || *b).count() as f32;
            assert!(both / either > 0.97, "{alpha:?} {}", both / either);
        }
    }

    /// Catches parts larger than two texels where coverage changes, clear ones that stay, even ones that are cut, and a
    /// count that is short.
    #[test]
    fn only_the_rim_is_cut_to_texels() {
        let (mesh, report) = cut(AlphaMode::Mask(0.5));
        let longest = |mesh: &Mesh, face: &Face| {
            let points: Vec<DVec3> =
                mesh.face_corners(face).iter().map(|&c| mesh.positions[c as usize]).collect();
            (0..3).map(|i| points[i].distance(points[(i + 1) % 3])).fold(0.0, f64::max) * SIZE as f64
        };
        let (soft, _) = cut(AlphaMode::Blend);
        let partly = soft.faces.iter().filter(|face| face.opacity < 255);
        assert!(partly.clone().count() > 100 && partly.clone().all(|face| longest(&soft, face) < 2.01));
        assert!(mesh.faces.iter().all(|face| face.opacity > 0));
        assert!(mesh.faces.iter().any(|face| face.opacity == 255 && longest(&mesh, face) > 4.0));
        assert!(mesh.faces.len() < SIZE * SIZE / 2, "{}", mesh.faces.len());
        let clear = report.skipped.iter().find(|(reason, _)| reason.contains("wholly clear")).unwrap().1;
        assert!(clear > 100, "{clear}");
        assert!(mesh.colors.iter().all(|rgb| rgb[1] > rgb[0] && rgb[1] > rgb[2]));
    }

    /// Catches parts that face the other way, overlap or leave gaps.
    #[test]
    fn quarters_fill_the_triangle() {
        let at = |w: Weights| DVec3::new(f64::from(w[0]), f64::from(w[1]), 0.0);
        let area = |part: [Weights; 3]| area_normal(&part.map(at)).z;
        let whole = [[WHOLE, 0, 0], [0, WHOLE, 0], [0, 0, WHOLE]];
        let parts = quarters(whole).map(area);
        assert_eq!(parts, [area(whole) / 4.0; 4]);
    }
}
