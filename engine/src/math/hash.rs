//! Integer hashes for everything random: the same integers on every machine and on the GPU.

/// A 32-bit hash with good avalanche: `lowbias32` (C. Wellons, "Hash Function Prospector", 2018).
pub fn hash32(mut x: u32) -> u32 {
    x ^= x >> 16;
    x = x.wrapping_mul(0x7feb_352d);
    x ^= x >> 15;
    x = x.wrapping_mul(0x846c_a68b);
    x ^ (x >> 16)
}

/// Hashes `value` into `state`, order dependent.
pub fn combine(state: u32, value: u32) -> u32 {
    hash32(state ^ value.wrapping_mul(0x9e37_79b9).wrapping_add(0x7f4a_7c15))
}

/// The top 24 bits of a hash as a number in [0, 1).
pub fn unit_f32(hash: u32) -> f32 {
    (hash >> 8) as f32 * (1.0 / 16_777_216.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a change of the hash, which would change every bake.
    #[test]
    fn hashes_are_frozen() {
        assert_eq!([hash32(1), hash32(12345)], [0x688990c0, 0x912efcf7]);
        assert!(unit_f32(u32::MAX) < 1.0);
    }
}
