//! The elements of a mesh on disk, as they were read, and the faces among them that can be used.

use std::path::{Path, PathBuf};

use glam::{DVec3, Vec3};

use super::chunks::{Parts, Sorted};
use super::records::{self, NONE, Records, Vertex};
use crate::import::emit::Carried;
use crate::import::mesh::{Face, Mesh, NO_NORMAL};
use crate::import::{ImportReport, polygon};
use crate::math::Bounds;
use crate::{Error, ErrorKind, Result};

/// Corners of faces that are checked together.
const BLOCK_CORNERS: usize = 1 << 17;

/// Vertices whose normals are summed in one pass over the faces: 48 MiB.
const SUMS_MAX: u64 = 2 << 20;

/// What is said of all of a mesh.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Traits {
    pub colors: bool,
    pub opacities: bool,
    pub radii: bool,
    /// Whether corners name their normals; they are those of positions otherwise.
    pub indexed_normals: bool,
    /// Whether a position is no single precision number.
    pub double_precision: bool,
}

/// The elements of a mesh, in files.
pub(super) struct Spill {
    folder: PathBuf,
    vertices: Records<Vertex>,
    normals: Records<[f32; 3]>,
    /// Faces in their order: corners, material, object, opacity, then the position and the normal of each corner.
    faces: Records<u32>,
    traits: Traits,
}

impl Spill {
    pub fn new(folder: &Path) -> Result<Self> {
        Ok(Self {
            folder: folder.to_path_buf(),
            vertices: Records::new(folder)?,
            normals: Records::new(folder)?,
            faces: Records::new(folder)?,
            traits: Traits::default(),
        })
    }

    pub fn positions(&self) -> u64 {
        self.vertices.len()
    }

    pub fn normals(&self) -> u64 {
        self.normals.len()
    }

    /// Takes a mesh's elements over; what they share stays.
    pub fn take(&mut self, mesh: &mut Mesh) -> Result<()> {
        let traits = &mut self.traits;
        traits.colors |= !mesh.colors.is_empty();
        traits.opacities |= !mesh.opacities.is_empty();
        traits.radii |= !mesh.radii.is_empty();
        traits.indexed_normals |= !mesh.corner_normals.is_empty();
        traits.double_precision |= !mesh.single_precision;
        for (i, position) in mesh.positions.iter().enumerate() {
            self.vertices.push(Vertex {
                position: position.to_array(),
                radius: mesh.radii.get(i).copied().unwrap_or(f32::NAN),
                color: mesh.colors.get(i).copied().unwrap_or([128; 3]),
                opacity: mesh.opacities.get(i).copied().unwrap_or(255),
            })?;
        }
        mesh.normals.iter().try_for_each(|normal| self.normals.push(normal.to_array()))?;
        for face in &mesh.faces {
            let head = [face.arity, face.material, face.object, u32::from(face.opacity)];
            head.into_iter().try_for_each(|word| self.faces.push(word))?;
            for corner in face.start..face.start + face.arity {
                let normal = mesh.corner_normals.get(corner as usize).copied().unwrap_or(NO_NORMAL);
                self.faces.push(mesh.corners[corner as usize])?;
                self.faces.push(normal)?;
            }
        }
        mesh.positions.clear();
        mesh.normals.clear();
        mesh.colors.clear();
        mesh.opacities.clear();
        mesh.radii.clear();
        mesh.corners.clear();
        mesh.corner_normals.clear();
        mesh.faces.clear();
        Ok(())
    }

    /// Checks all faces and sorts them by place into chunks. `shared` has what all faces share.
    pub fn sort(mut self, shared: Mesh, chunk_faces_max: u64, report: &mut ImportReport) -> Result<Sorted> {
        self.vertices.flush()?;
        self.normals.flush()?;
        self.faces.flush()?;
        if self.vertices.len().max(self.normals.len()) > u64::from(u32::MAX) {
            return Err(Error::new(ErrorKind::Limit, "more than 4,294,967,295 vertices or normals"));
        }
        let checked = self.check(report)?;
        let smooth = match checked.carried.normal && checked.needs_smooth {
            true => Some(self.smooth(&checked.faces)?),
            false => None,
        };
        let mut carried = checked.carried;
        carried.albedo = self.traits.colors || !shared.palette.is_empty();
        let parts = Parts {
            vertices: self.vertices,
            normals: self.normals,
            smooth,
            palette: shared.palette,
            traits: self.traits,
            carried,
            bounds: checked.bounds,
            extent_max: checked.extent_max,
            thin: checked.thin,
        };
        Sorted::new(&self.folder, checked.faces, parts, chunk_faces_max)
    }

    /// Checks faces block by block and brings those that can be used to a file.
    fn check(&self, report: &mut ImportReport) -> Result<Checked> {
        let mut checked = Checked::new(&self.folder)?;
        checked.carried.normal = self.normals.len() > 0;
        let (mut waiting, mut block, mut corners) = (Vec::new(), Vec::new(), 0);
        self.faces.for_each_run(|_, words| {
            for &word in words {
                waiting.push(word);
                if waiting.len() > 4 && waiting.len() as u64 == 4 + 2 * u64::from(waiting[0]) {
                    corners += waiting[0] as usize;
                    block.append(&mut waiting);
                }
                if corners >= BLOCK_CORNERS {
                    self.check_block(&block, &mut checked, report)?;
                    block.clear();
                    corners = 0;
                }
            }
            Ok(())
        })?;
        self.check_block(&block, &mut checked, report)?;
        checked.faces.flush()?;
        Ok(checked)
    }

    fn check_block(&self, words: &[u32], checked: &mut Checked, report: &mut ImportReport) -> Result<()> {
        // A mesh of these faces alone, whose normals are numbers of the file
        let mut mesh = Mesh::default();
        let mut rest = words;
        while let [arity, material, object, opacity, ..] = *rest {
            let (own, tail) = rest[4..].split_at(2 * arity as usize);
            let start = mesh.corners.len() as u32;
            mesh.corners.extend(own.iter().step_by(2));
            mesh.corner_normals.extend(own.iter().skip(1).step_by(2));
            mesh.faces.push(Face { start, arity, material, object, opacity: opacity as u8, hole: false });
            rest = tail;
        }
        let numbers = renumber(&mut mesh.corners);
        let vertices = self.vertices.gather(&numbers)?;
        mesh.positions = vertices.iter().map(|vertex| DVec3::from_array(vertex.position)).collect();
        mesh.keep_usable(report)?;

        for face in &mesh.faces {
            let mut record = records::Face {
                normal: [0.0; 3],
                center: [0.0; 3],
                corners: [NONE; 4],
                normals: [NONE; 4],
                material: face.material,
                object: face.object,
                opacity: u32::from(face.opacity),
            };
            let (mut points, n) = ([DVec3::ZERO; 4], face.arity as usize);
            let mut bounds = Bounds::EMPTY;
            for (i, &corner) in mesh.face_corners(face).iter().enumerate() {
                points[i] = mesh.positions[corner as usize];
                bounds.add(points[i]);
                record.corners[i] = numbers[corner as usize];
                let normal = mesh.corner_normals[face.start as usize + i];
                // Normals that nobody wrote are computed
                let is_there = u64::from(normal) < self.normals.len();
                record.normals[i] = match self.traits.indexed_normals {
                    true if is_there => normal,
                    false if u64::from(record.corners[i]) < self.normals.len() => record.corners[i],
                    _ => NONE,
                };
            }
            if n > 2 {
                record.normal = polygon::area_normal(&points[..n]).to_array();
                checked.carried.normal = true;
                checked.needs_smooth |= record.normals[..n].contains(&NONE);
            }
            record.center = bounds.center().as_vec3().to_array();
            checked.carried.radius |= n < 3;
            checked.thin[0] += u64::from(n == 1);
            checked.thin[1] += u64::from(n == 2);
            checked.carried.opacity |= face.opacity < 255;
            checked.carried.opacity |=
                mesh.face_corners(face).iter().any(|&corner| vertices[corner as usize].opacity < 255);
            checked.extent_max = checked.extent_max.max(bounds.size().max_element());
            checked.bounds = checked.bounds.union(&bounds);
            checked.faces.push(record)?;
        }
        Ok(())
    }

    /// Area-weighted normals of all positions, so many at a time as fit in memory.
    fn smooth(&self, faces: &Records<records::Face>) -> Result<Records<[f32; 3]>> {
        let mut smooth = Records::new(&self.folder)?;
        let (mut first, count) = (0, self.vertices.len());
        while first < count {
            let mut sums = vec![DVec3::ZERO; SUMS_MAX.min(count - first) as usize];
            faces.for_each_run(|_, run| {
                for face in run {
                    for &corner in &face.corners[..face.arity()] {
                        let at = u64::from(corner).wrapping_sub(first);
                        if let Some(sum) = sums.get_mut(at as usize) {
                            *sum += DVec3::from_array(face.normal);
                        }
                    }
                }
                Ok(())
            })?;
            let unit = |sum: &DVec3| -> Vec3 { sum.normalize_or_zero().as_vec3() };
            sums.iter().try_for_each(|sum| smooth.push(unit(sum).to_array()))?;
            first += sums.len() as u64;
        }
        smooth.flush()?;
        Ok(smooth)
    }
}

/// Faces that can be used, and what is known of them all.
struct Checked {
    faces: Records<records::Face>,
    carried: Carried,
    /// Whether a corner has no normal of its own.
    needs_smooth: bool,
    bounds: Bounds,
    /// The longest edge of a face's box.
    extent_max: f64,
    /// Points and lines among them.
    thin: [u64; 2],
}

impl Checked {
    fn new(folder: &Path) -> Result<Self> {
        Ok(Self {
            faces: Records::new(folder)?,
            carried: Carried::default(),
            needs_smooth: false,
            bounds: Bounds::EMPTY,
            extent_max: 0.0,
            thin: [0; 2],
        })
    }
}

/// Replaces numbers by their places among the distinct ones, which are returned in ascending order.
pub(super) fn renumber(numbers: &mut [u32]) -> Vec<u32> {
    let mut distinct = numbers.to_vec();
    distinct.sort_unstable();
    distinct.dedup();
    for number in numbers {
        *number = distinct.partition_point(|known| known < number) as u32;
    }
    distinct
}
