//! A set of small integers, one bit each: which grids are visible, which points are written, which batches are done.

/// A set of numbers below a fixed length, one bit each. 2^32 members cost 512 MiB.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct BitSet {
    words: Vec<u64>,
    len: u64,
}

impl BitSet {
    /// An empty set of numbers below `len`.
    pub fn new(len: u64) -> Self {
        let mut set = Self::default();
        set.reset(len);
        set
    }

    /// Empties the set and makes it one of numbers below `len`; keeps its memory.
    pub fn reset(&mut self, len: u64) {
        self.words.clear();
        self.grow(len);
        self.len = len;
    }

    /// Makes the set one of numbers below `len` where that is more than before.
    pub fn grow(&mut self, len: u64) {
        if len > self.len || self.words.is_empty() {
            self.words.resize(usize::try_from(len.div_ceil(64)).expect("bits fit into memory"), 0);
            self.len = self.len.max(len);
        }
    }

    /// Members are below this.
    pub fn len(&self) -> u64 {
        self.len
    }

    /// Whether no number can be a member.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Whether `number` is a member; false from [`len`](Self::len) on.
    pub fn contains(&self, number: u64) -> bool {
        number < self.len && self.words[(number / 64) as usize] >> (number % 64) & 1 == 1
    }

    /// Adds `number`, which is below [`len`](Self::len). True when it was not a member before.
    ///
    /// # Panics
    /// When `number` is not below [`len`](Self::len).
    pub fn insert(&mut self, number: u64) -> bool {
        assert!(number < self.len, "{number} in a set of numbers below {}", self.len);
        let (word, bit) = (&mut self.words[(number / 64) as usize], 1 << (number % 64));
        let new = *word & bit == 0;
        *word |= bit;
        new
    }

    /// Members.
    pub fn count(&self) -> u64 {
        self.words.iter().map(|word| u64::from(word.count_ones())).sum()
    }

    /// The smallest number that is not a member.
    pub fn first_missing(&self) -> Option<u64> {
        let word = self.words.iter().position(|&word| word != u64::MAX)?;
        let number = 64 * word as u64 + u64::from(self.words[word].trailing_ones());
        (number < self.len).then_some(number)
    }

    /// Appends the members as bits, number `i` in bit `i % 8` of byte `i / 8`.
    pub fn write_bytes(&self, out: &mut Vec<u8>) {
        let bytes = self.words.iter().flat_map(|word| word.to_le_bytes());
        out.extend(bytes.take(self.len.div_ceil(8) as usize));
    }

    /// Takes over the numbers below `len` that [`write_bytes`](Self::write_bytes) wrote. False, and an empty set, when
    /// there are not as many bytes, or an unused bit of the last one is set.
    pub fn read_bytes(&mut self, bytes: &[u8], len: u64) -> bool {
        let sound = bytes.len() as u64 == len.div_ceil(8)
            && (len.is_multiple_of(8) || bytes[bytes.len() - 1] >> (len % 8) == 0);
        self.reset(if sound { len } else { 0 });
        if sound {
            for (word, bytes) in self.words.iter_mut().zip(bytes.chunks(8)) {
                let mut whole = [0; 8];
                whole[..bytes.len()].copy_from_slice(bytes);
                *word = u64::from_le_bytes(whole);
            }
        }
        sound
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches an off-by-one at word borders and a first gap that lies in the unused bits of the last word.
    #[test]
    fn words_and_their_borders() {
        for len in [0, 1, 63, 64, 65, 128, 200] {
            let mut set = BitSet::new(len);
            for number in 0..len {
                assert_eq!(set.first_missing(), Some(number));
                assert!(!set.contains(number) && set.insert(number) && set.contains(number));
                assert!(!set.insert(number));
                assert_eq!(set.count(), number + 1);
            }
            assert_eq!(set.first_missing(), None);
            assert!(!set.contains(len));
        }
    }

    /// Catches members that survive a reset, and members lost by growing.
    #[test]
    fn growing_keeps_and_reset_forgets() {
        let mut set = BitSet::new(10);
        set.insert(9);
        set.grow(1000);
        assert!(set.contains(9) && !set.contains(999) && set.len() == 1000);
        set.grow(5);
        assert_eq!(set.len(), 1000);
        set.reset(20);
        assert_eq!((set.count(), set.len()), (0, 20));
    }

    /// Catches members that move in their bytes, and bytes with more members than can be.
    #[test]
    fn bytes_hold_the_members_and_nothing_else() {
        for len in [0, 1, 8, 9, 64, 130] {
            let mut set = BitSet::new(len);
            for number in (0..len).step_by(3) {
                set.insert(number);
            }
            let mut bytes = Vec::new();
            set.write_bytes(&mut bytes);
            assert_eq!(bytes.len() as u64, len.div_ceil(8));
            let mut read = BitSet::new(5);
            assert!(read.read_bytes(&bytes, len) && read == set);
            bytes.push(0);
            assert!(!read.read_bytes(&bytes, len) && read.is_empty());
        }
        assert!(!BitSet::default().read_bytes(&[0b1000], 3));
    }
}
