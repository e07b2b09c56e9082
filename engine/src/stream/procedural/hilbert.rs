//! The Hilbert curve in the plane: the order in which patches are streamed.

/// The cell at place `d` of the curve over a square of `2^order` cells a side. Order at most 31.
pub fn cell(order: u32, d: u64) -> [u32; 2] {
    let (mut x, mut y) = (0u32, 0u32);
    let mut rest = d;
    for level in 0..order {
        let side = 1u32 << level;
        let right = (rest >> 1) as u32 & 1;
        let up = (rest as u32 ^ right) & 1;
        if up == 0 {
            if right == 1 {
                (x, y) = (side - 1 - x, side - 1 - y);
            }
            (x, y) = (y, x);
        }
        x += side * right;
        y += side * up;
        rest >>= 2;
    }
    [x, y]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a curve that jumps or visits a cell twice.
    #[test]
    fn every_cell_once_and_each_beside_the_last() {
        let mut seen = vec![false; 32 * 32];
        let mut last = cell(5, 0);
        for d in 0..1024 {
            let [x, y] = cell(5, d);
            assert!(!std::mem::replace(&mut seen[(y * 32 + x) as usize], true));
            assert!(d == 0 || x.abs_diff(last[0]) + y.abs_diff(last[1]) == 1);
            last = [x, y];
        }
    }
}
