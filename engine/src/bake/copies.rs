//! Where the copies of a geometry stand: by the scene, and within that by an imported file.

use glam::DMat4;

use crate::Result;
use crate::scene::Instances;
use crate::scene::instances::InstanceReader;
use crate::stream::adapt::MatrixSource;

/// Copies of copies: every inner one in every outer one.
pub struct Product<Outer, Inner> {
    outer: Outer,
    inner: Inner,
    /// The outer copy that inner ones are read in.
    world_from_outer: Option<DMat4>,
}

impl<Outer: MatrixSource, Inner: MatrixSource> Product<Outer, Inner> {
    /// All of `inner` in each of `outer`.
    pub fn new(outer: Outer, inner: Inner) -> Self {
        Self { outer, inner, world_from_outer: None }
    }
}

impl<Outer: MatrixSource, Inner: MatrixSource> MatrixSource for Product<Outer, Inner> {
    fn rewind(&mut self) -> Result<()> {
        self.world_from_outer = None;
        self.outer.rewind()
    }

    fn next(&mut self) -> Result<Option<DMat4>> {
        loop {
            if let Some(world_from_outer) = self.world_from_outer
                && let Some(outer_from_inner) = self.inner.next()?
            {
                return Ok(Some(world_from_outer * outer_from_inner));
            }
            self.world_from_outer = self.outer.next()?;
            if self.world_from_outer.is_none() {
                return Ok(None);
            }
            self.inner.rewind()?;
        }
    }
}

/// A geometry's copies as the instance adapter reads them: inline matrices and files, one after the other.
pub struct Matrices {
    instances: Vec<Instances>,
    next: usize,
    reader: Option<InstanceReader>,
}

impl Matrices {
    /// The copies of a geometry of the scene.
    pub fn new(instances: &[Instances]) -> Self {
        Self { instances: instances.to_vec(), next: 0, reader: None }
    }
}

impl MatrixSource for Matrices {
    fn rewind(&mut self) -> Result<()> {
        (self.next, self.reader) = (0, None);
        Ok(())
    }

    fn next(&mut self) -> Result<Option<DMat4>> {
        loop {
            if let Some(reader) = &mut self.reader {
                if let Some(matrix) = reader.next()? {
                    return Ok(Some(matrix));
                }
                self.reader = None;
            }
            let Some(instances) = self.instances.get(self.next) else { return Ok(None) };
            self.next += 1;
            match instances {
                Instances::Matrix(matrix) => return Ok(Some(*matrix)),
                Instances::File(path) => self.reader = Some(InstanceReader::open(path)?),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stream::adapt::MatrixList;
    use glam::DVec3;

    /// Catches copies of copies in the wrong frame or order, too few of them, or none after a rewind.
    #[test]
    fn every_inner_copy_stands_in_every_outer_one() {
        let list = |matrices: Vec<DMat4>| MatrixList::new(matrices);
        let at = |x: f64| DMat4::from_translation(DVec3::X * x);
        let turned = DMat4::from_scale(DVec3::splat(10.0));
        let mut product = Product::new(list(vec![at(100.0), turned]), list(vec![at(1.0), at(2.0), at(3.0)]));
        for _ in 0..2 {
            product.rewind().unwrap();
            let mut found = Vec::new();
            while let Some(matrix) = product.next().unwrap() {
                found.push(matrix.transform_point3(DVec3::ZERO).x);
            }
            assert_eq!(found, [101.0, 102.0, 103.0, 10.0, 20.0, 30.0]);
            assert!(product.next().unwrap().is_none());
        }
        let mut none = Product::new(list(vec![at(1.0); 3]), list(Vec::new()));
        none.rewind().unwrap();
        assert!(none.next().unwrap().is_none());
    }
}
