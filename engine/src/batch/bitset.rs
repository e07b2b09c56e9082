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
}
