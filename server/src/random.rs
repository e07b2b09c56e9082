//! Ids and secrets from the operating system's random numbers.

const DIGITS: &[u8; 32] = b"0123456789abcdefghjkmnpqrstvwxyz";

/// 64 random bits.
pub fn bits() -> u64 {
    let mut bytes = [0; 8];
    fill(&mut bytes);
    u64::from_le_bytes(bytes)
}

fn fill(bytes: &mut [u8]) {
    // Without random numbers there are no secrets: nothing can go on
    getrandom::fill(bytes).expect("the operating system has random numbers");
}

/// An id of 26 characters that sorts by time: 48 bits of milliseconds, 80 random bits, in Crockford's base 32 (as ULIDs).
pub fn id(now_ms: i64) -> String {
    let mut random = [0; 16];
    fill(&mut random[6..]);
    random[..6].copy_from_slice(&(now_ms as u64).to_be_bytes()[2..]);
    digits(u128::from_be_bytes(random), 26)
}

/// The time in an id that [`id`] made; none where `text` is none.
pub fn time_of(text: &str) -> Option<i64> {
    let place = |byte| DIGITS.iter().position(|&digit| digit == byte);
    let value = text.bytes().try_fold(0_u128, |value, byte| Some(value << 5 | place(byte)? as u128));
    (text.len() == 26).then_some(value? >> 80).map(|ms| ms as i64)
}

/// A secret of 160 bits, 32 characters.
pub fn secret() -> String {
    let mut bytes = [0; 32];
    fill(&mut bytes);
    bytes.iter().map(|byte| char::from(DIGITS[usize::from(byte & 31)])).collect()
}

fn digits(value: u128, count: u32) -> String {
    (0..count).rev().map(|place| char::from(DIGITS[(value >> (5 * place)) as usize & 31])).collect()
}

#[cfg(test)]
mod tests {
    /// Catches ids that do not sort by time, by which lists are paged.
    #[test]
    fn ids_sort_by_time() {
        let ids: Vec<String> = (0..200).map(|i| super::id(1_700_000_000_000 + i)).collect();
        assert!(ids.is_sorted() && ids.iter().all(|id| id.len() == 26));
        assert_ne!(super::id(5), super::id(5));
        assert_eq!(super::time_of(&ids[7]), Some(1_700_000_000_007));
        assert_eq!(super::time_of("default"), None);
    }
}
