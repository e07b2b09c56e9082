//! The faces of a partition's leaves as the shooter reads them: decoded vertices, sixteen at a time.

use glam::IVec3;

use crate::brick::leaf::{Contents, FACES_MAX, Kind, OPAQUE, TRIANGLES_MAX, VERTICES_MAX};

/// Triangles of a leaf: two a face, or one.
pub const TRIANGLES: usize = TRIANGLES_MAX;

/// Vertices of a block.
pub const BLOCK: usize = 16;

/// The faces of a leaf.
#[derive(Clone, Copy, Debug)]
pub struct Shape {
    /// Its first block of vertices.
    first: u32,
    /// Where its extinctions and radii are, if not all faces are opaque and flat.
    special: Option<u32>,
    /// Whether it has two blocks.
    pub is_large: bool,
    /// What the faces are.
    pub kind: Kind,
    /// Faces.
    pub faces: u8,
    /// Lanes that hold a triangle.
    pub present: u16,
    /// Corners of the triangles: corner, lane. A quad's second triangle is eight lanes above its first.
    pub corners: [[u8; TRIANGLES]; 3],
}

/// What leaves have that are not made of opaque triangles.
#[derive(Clone, Copy, Debug)]
pub struct Special {
    /// Radii of the vertices of points and lines.
    pub radii: [f32; VERTICES_MAX],
    /// Extinction of each face.
    pub extinctions: [u16; TRIANGLES],
}

/// The faces of many leaves.
#[derive(Debug, Default)]
pub struct Shapes {
    blocks: Vec<[[i32; BLOCK]; 3]>,
    shapes: Vec<Shape>,
    special: Vec<Special>,
}

impl Shapes {
    /// Adds a leaf.
    pub fn push(&mut self, leaf: &Contents<'_>) {
        let is_large = leaf.vertices.len() > BLOCK;
        let first = self.blocks.len() as u32;
        for part in leaf.vertices.chunks(BLOCK) {
            // Unused lanes repeat a vertex, so that ranges over lanes are ranges over vertices
            let mut block = [[0; BLOCK]; 3];
            for lane in 0..BLOCK {
                let vertex = part[lane.min(part.len() - 1)];
                (0..3).for_each(|axis| block[axis][lane] = vertex[axis]);
            }
            self.blocks.push(block);
        }

        let mut corners = [[0; TRIANGLES]; 3];
        for face in 0..leaf.faces {
            let [a, b, c, d] = [0, 1, 2, 3].map(|corner| leaf.index(face, corner) as u8);
            for (corner, (lower, upper)) in corners.iter_mut().zip([(a, a), (b, c), (c, d)]) {
                corner[face] = lower;
                if leaf.kind != Kind::Triangles {
                    corner[face + FACES_MAX] = upper;
                }
            }
        }
        let present = ((1_u32 << leaf.faces) - 1) as u16;
        let present = if leaf.kind == Kind::Triangles { present } else { present | present << FACES_MAX };
        let special = (leaf.kind == Kind::Round || !leaf.extinctions.is_empty()).then(|| {
            let mut special = Special { radii: [0.0; VERTICES_MAX], extinctions: [OPAQUE; TRIANGLES] };
            special.extinctions[leaf.faces..].fill(0);
            special.radii[..leaf.radii.len()].copy_from_slice(leaf.radii);
            special.extinctions[..leaf.extinctions.len()].copy_from_slice(leaf.extinctions);
            self.special.push(special);
            self.special.len() as u32 - 1
        });
        let (kind, faces) = (leaf.kind, leaf.faces as u8);
        self.shapes.push(Shape { first, special, is_large, kind, faces, present, corners });
    }

    /// A leaf's faces.
    #[inline(always)]
    pub fn shape(&self, leaf: u32) -> &Shape {
        &self.shapes[leaf as usize]
    }

    /// The first block of a leaf's vertices.
    #[inline(always)]
    pub fn block(&self, shape: &Shape) -> &[[i32; BLOCK]; 3] {
        &self.blocks[shape.first as usize]
    }

    /// The second block of a large leaf's vertices, else the first.
    #[inline(always)]
    pub fn second_block(&self, shape: &Shape) -> &[[i32; BLOCK]; 3] {
        &self.blocks[shape.first as usize + usize::from(shape.is_large)]
    }

    /// What is special about a leaf.
    #[inline(always)]
    pub fn special(&self, shape: &Shape) -> Option<&Special> {
        shape.special.map(|special| &self.special[special as usize])
    }

    /// A vertex.
    #[inline(always)]
    pub fn vertex(&self, shape: &Shape, index: u8) -> IVec3 {
        let block = &self.blocks[shape.first as usize + usize::from(index) / BLOCK];
        IVec3::from_array([0, 1, 2].map(|axis| block[axis][usize::from(index) % BLOCK]))
    }

    /// Leaves.
    pub fn len(&self) -> usize {
        self.shapes.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.shapes.is_empty()
    }
}
