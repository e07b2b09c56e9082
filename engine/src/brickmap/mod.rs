//! stub
use crate::Result;
use crate::brick::{Lattice, LatticeBox};
#[derive(Debug)]
pub struct BrickMap;
impl BrickMap {
    pub fn lattice(&self) -> Lattice {
        unreachable!()
    }
    pub fn brick_count(&self) -> u32 {
        0
    }
    pub fn brick_bytes(&self, _n: u32) -> u32 {
        0
    }
    pub fn bytes(&self) -> u64 {
        0
    }
    pub fn root(&self) -> u32 {
        0
    }
    pub fn root_box(&self) -> LatticeBox {
        unreachable!()
    }
    pub fn path(&self) -> &std::path::Path {
        unreachable!()
    }
    pub fn read(&self, _first: u32, _count: u32, _out: &mut [u8]) -> Result<()> {
        Ok(())
    }
}
