//! What is spilled: quantised microgrids as records.
//!
//! Records are packed, not compressed: coordinates do not compress, and the disk is faster than the compressor.
//!
//! ```text
//! record  vertices - 1  u8      faces  u16      shift  u8
//!         flags         u8      1: coordinates are u16, not u32; 2: regular grid; 4: extinctions; 8: radii
//!         columns       u8      quads across, regular grids only
//!         low           3 x i32 lattice coordinates of the lower corner
//!         coordinates   3 x u16 or u32 per vertex, relative to `low`
//!         arities, indices      as in a microgrid, unless regular
//!         extinctions   u16 per face, if flagged
//!         radii         f32 per vertex in lattice steps, if flagged
//! ```

use glam::IVec3;

use crate::brick::LatticeBox;

const SHORT: u8 = 1;
const REGULAR: u8 = 2;
const EXTINCTIONS: u8 = 4;
const RADII: u8 = 8;

/// A microgrid on the lattice.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Quantised {
    /// Coordinates.
    pub vertices: Vec<IVec3>,
    /// As in a microgrid.
    pub arities: Vec<u8>,
    /// As in a microgrid.
    pub indices: Vec<u8>,
    /// One per face, or none when all faces are opaque.
    pub extinctions: Vec<u16>,
    /// One per vertex in lattice steps, or none when there are neither points nor lines.
    pub radii: Vec<f32>,
    /// Lattice shift of the geometry.
    pub shift: u8,
    /// Quads across when the faces are a regular grid in rows, otherwise 0.
    pub columns: u8,
}

impl Quantised {
    /// Empties it, keeping memory.
    pub fn clear(&mut self) {
        self.vertices.clear();
        self.arities.clear();
        self.indices.clear();
        self.extinctions.clear();
        self.radii.clear();
        (self.shift, self.columns) = (0, 0);
    }

    /// The box of its vertices.
    pub fn bounds(&self) -> LatticeBox {
        self.vertices.iter().fold(LatticeBox::EMPTY, |mut all, &vertex| {
            all.add(vertex);
            all
        })
    }

    /// Sees whether the faces are a regular grid of quads in rows, and notes how many are in a row.
    pub fn find_columns(&mut self) {
        self.columns = 0;
        let faces = self.arities.len();
        if faces < 4 || self.arities.iter().any(|&arity| arity != 4) {
            return;
        }
        // The first face is 0, 1, w+2, w+1 or 0, w+1, w+2, 1 for rows of w quads
        let wide = usize::from(self.indices[1].max(self.indices[3]));
        let columns = wide.wrapping_sub(1);
        if !(1..=254).contains(&columns)
            || !faces.is_multiple_of(columns)
            || self.vertices.len() != (faces / columns + 1) * wide
        {
            return;
        }
        let across_first = self.indices[1] == 1;
        let regular = self.indices.chunks_exact(4).enumerate().all(|(face, corners)| {
            let a = (face / columns) * wide + face % columns;
            let [b, d] = if across_first { [a + 1, a + wide] } else { [a + wide, a + 1] };
            [a, b, a + wide + 1, d] == [0, 1, 2, 3].map(|i| usize::from(corners[i]))
        });
        if regular {
            self.columns = columns as u8;
        }
    }

    /// Appends the grid as a record.
    pub fn encode(&self, out: &mut Vec<u8>) {
        let low = self.vertices.iter().fold(IVec3::MAX, |low, &v| low.min(v));
        let high = self.vertices.iter().fold(IVec3::MIN, |high, &v| high.max(v));
        let short = (high - low).max_element() < 1 << 16;
        let flag = |on: bool, flag: u8| if on { flag } else { 0 };
        let flags = flag(short, SHORT)
            | flag(self.columns > 0, REGULAR)
            | flag(!self.extinctions.is_empty(), EXTINCTIONS)
            | flag(!self.radii.is_empty(), RADII);
        out.push((self.vertices.len() - 1) as u8);
        out.extend_from_slice(&(self.arities.len() as u16).to_le_bytes());
        out.extend_from_slice(&[self.shift, flags, self.columns]);
        low.to_array().iter().for_each(|c| out.extend_from_slice(&c.to_le_bytes()));
        let start = out.len();
        if short {
            out.resize(start + 6 * self.vertices.len(), 0);
            for (bytes, &vertex) in out[start..].as_chunks_mut::<6>().0.iter_mut().zip(&self.vertices) {
                let [x, y, z] = (vertex - low).to_array().map(|c| (c as u16).to_le_bytes());
                *bytes = [x[0], x[1], y[0], y[1], z[0], z[1]];
            }
        } else {
            out.resize(start + 12 * self.vertices.len(), 0);
            for (bytes, &vertex) in out[start..].as_chunks_mut::<12>().0.iter_mut().zip(&self.vertices) {
                bytes.copy_from_slice((vertex - low).to_array().map(i32::to_le_bytes).as_flattened());
            }
        }
        if self.columns == 0 {
            out.extend_from_slice(&self.arities);
            out.extend_from_slice(&self.indices);
        }
        self.extinctions.iter().for_each(|e| out.extend_from_slice(&e.to_le_bytes()));
        self.radii.iter().for_each(|r| out.extend_from_slice(&r.to_le_bytes()));
    }

    /// Reads a record that [`encode`](Self::encode) wrote, and returns what follows it. The log is private and
    /// without a name, so only this process can have written it.
    pub fn decode<'a>(&mut self, bytes: &'a [u8]) -> &'a [u8] {
        self.clear();
        let vertices = usize::from(bytes[0]) + 1;
        let faces = usize::from(u16::from_le_bytes([bytes[1], bytes[2]]));
        let flags = bytes[4];
        (self.shift, self.columns) = (bytes[3], bytes[5]);
        let (low, mut rest) = bytes[6..].split_at(12);
        let low = IVec3::from_array(
            [0, 4, 8].map(|i| i32::from_le_bytes(low[i..i + 4].try_into().expect("4 bytes"))),
        );
        let mut take = |count: usize| {
            let (taken, left) = rest.split_at(count);
            rest = left;
            taken
        };
        if flags & SHORT != 0 {
            self.vertices.extend(take(6 * vertices).chunks_exact(6).map(|c| {
                low + IVec3::new(
                    i32::from(u16::from_le_bytes([c[0], c[1]])),
                    i32::from(u16::from_le_bytes([c[2], c[3]])),
                    i32::from(u16::from_le_bytes([c[4], c[5]])),
                )
            }));
        } else {
            self.vertices.extend(take(12 * vertices).chunks_exact(12).map(|c| {
                low + IVec3::from_array(
                    [0, 4, 8].map(|i| i32::from_le_bytes(c[i..i + 4].try_into().expect("4 bytes"))),
                )
            }));
        }
        if flags & REGULAR != 0 {
            let (columns, wide) = (usize::from(self.columns), usize::from(self.columns) + 1);
            self.arities.resize(faces, 4);
            for face in 0..faces {
                let a = (face / columns) * wide + face % columns;
                self.indices.extend([a, a + 1, a + wide + 1, a + wide].map(|index| index as u8));
            }
        } else {
            self.arities.extend_from_slice(take(faces));
            let corners = self.arities.iter().map(|&arity| usize::from(arity)).sum();
            self.indices.extend_from_slice(take(corners));
        }
        if flags & EXTINCTIONS != 0 {
            self.extinctions
                .extend(take(2 * faces).chunks_exact(2).map(|c| u16::from_le_bytes([c[0], c[1]])));
        }
        if flags & RADII != 0 {
            let word = |c: &[u8]| f32::from_le_bytes(c.try_into().expect("4 bytes"));
            self.radii.extend(take(4 * vertices).chunks_exact(4).map(word));
        }
        rest
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// A small grid, regular or of all sorts of faces, narrow or wide.
    pub fn sample(regular: bool, far: bool) -> Quantised {
        let mut grid = Quantised { shift: 2, ..Quantised::default() };
        let scale = if far { 100_000 } else { 40 };
        grid.vertices = (0..12).map(|i| IVec3::new(i % 4, i / 4, i * i % 5) * scale - 70_000).collect();
        for face in 0..6_u8 {
            let a = face / 3 * 4 + face % 3;
            grid.arities.push(4);
            grid.indices.extend([a, a + 1, a + 5, a + 4]);
        }
        if !regular {
            grid.arities.extend([1, 2, 3]);
            grid.indices.extend([0, 1, 2, 3, 4, 5]);
            grid.extinctions = (0..9).collect();
            grid.radii = (0..12).map(|i| i as f32).collect();
        }
        grid.find_columns();
        grid
    }

    /// Catches a grid that changes on its way through the disk.
    #[test]
    fn grids_come_back_as_they_went() {
        let grids = [sample(true, false), sample(false, false), sample(true, true), sample(false, true)];
        assert_eq!(grids.each_ref().map(|grid| grid.columns), [3, 0, 3, 0]);
        let (mut bytes, mut back) = (Vec::new(), Quantised::default());
        grids.iter().for_each(|grid| grid.encode(&mut bytes));
        let mut rest = &bytes[..];
        for grid in &grids {
            rest = back.decode(rest);
            assert_eq!(back, *grid);
        }
        assert!(rest.is_empty());
    }
}
