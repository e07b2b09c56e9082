//! Binary USD layers, looked at before the library reads them: it allocates whatever a count says, and follows dictionaries by
//! calling itself. Every count must fit the file, or the memory allowed where data is compressed; offsets, tables and the
//! rest are the library's own to check.

/// Values within values at most.
const DEPTH_MAX: u32 = 64;

/// Values that are looked at for each byte of the file, at most: there are no more than one in 8, but they may overlap.
const VALUES_PER_BYTE: u64 = 4;

/// Bytes that a byte of LZ4 becomes at most.
const LZ4_RATIO: u64 = 255;

/// Bytes of the library's own for a number, a path and a string, above what they hold.
const ITEM_BYTES: u64 = 32;

const ARRAY: u64 = 1 << 63;
const INLINED: u64 = 1 << 62;
const COMPRESSED: u64 = 1 << 61;
const PAYLOAD: u64 = (1 << 48) - 1;

type Checked<T = ()> = Result<T, String>;

/// Says why a binary layer must not be read, if so; `bytes_max` is what any one table or value may take.
pub(super) fn check(bytes: &[u8], bytes_max: u64) -> Checked {
    let version = bytes.get(8..11).map(|v| [v[0], v[1], v[2]]).ok_or("the header is cut off")?;
    let mut layer =
        Layer { bytes, version, bytes_max, longest: 0, values_left: bytes.len() as u64 * VALUES_PER_BYTE };
    let toc = layer.u64(16)?;
    let sections = layer.count(toc, 32, 32)?;
    let mut reps = Vec::new();
    // Tokens come before the values that name them
    for wanted in ["TOKENS", "STRINGS", "FIELDS", "FIELDSETS", "PATHS", "SPECS"] {
        for number in 0..sections {
            let at = toc + 8 + 32 * number;
            let name = layer.slice(at, 16)?;
            let name = name.split(|byte| *byte == 0).next().unwrap_or_default();
            if name == wanted.as_bytes() {
                let start = layer.u64(at + 16)?;
                layer.section(wanted, start, &mut reps)?;
            }
        }
    }
    reps.into_iter().try_for_each(|rep| layer.value(rep, 0))
}

/// A layer under examination. Places are offsets in its bytes.
struct Layer<'a> {
    bytes: &'a [u8],
    version: [u8; 3],
    bytes_max: u64,
    /// Bytes of the longest token.
    longest: u64,
    values_left: u64,
}

impl<'a> Layer<'a> {
    fn slice(&self, at: u64, count: u64) -> Checked<&'a [u8]> {
        let range =
            usize::try_from(at).ok().zip(at.checked_add(count).and_then(|end| usize::try_from(end).ok()));
        let found = range.and_then(|(start, end)| self.bytes.get(start..end));
        found.ok_or_else(|| format!("{count} bytes at byte {at} of a layer that has {}", self.bytes.len()))
    }

    fn u64(&self, at: u64) -> Checked<u64> {
        Ok(u64::from_le_bytes(self.slice(at, 8)?.try_into().expect("eight bytes")))
    }

    fn u32(&self, at: u64) -> Checked<u32> {
        Ok(u32::from_le_bytes(self.slice(at, 4)?.try_into().expect("four bytes")))
    }

    /// A count at a place, of items that have `stored` bytes behind it and take `held`.
    fn count(&self, at: u64, stored: u64, held: u64) -> Checked<u64> {
        let count = self.u64(at)?;
        self.fits(at, count, held)?;
        self.slice(at + 8, count.saturating_mul(stored))?;
        Ok(count)
    }

    fn fits(&self, at: u64, count: u64, held: u64) -> Checked {
        if count.saturating_mul(held) > self.bytes_max {
            return Err(format!(
                "{count} items at byte {at}, more than the memory allowed (`--memory`) has room for"
            ));
        }
        Ok(())
    }

    /// The compressed block at a place, of what becomes so many bytes at most; and where it ends.
    fn block(&self, at: u64, bytes: u64) -> Checked<(&'a [u8], u64)> {
        let size = self.u64(at)?;
        let block = self.slice(at + 8, size)?;
        if bytes > size.saturating_mul(LZ4_RATIO).saturating_add(64) {
            return Err(format!("{size} bytes at byte {at} that claim to become {bytes}"));
        }
        Ok((block, at + 8 + size))
    }

    /// Integers at a place, so many; and where they end.
    fn integers(&self, at: u64, count: u64) -> Checked<u64> {
        self.fits(at, count, 16)?;
        // Two bits each at least
        Ok(self.block(at, count / 4)?.1)
    }

    fn decompress(&self, (block, end): (&[u8], u64), bytes: u64) -> Checked<Vec<u8>> {
        let mut out = vec![0; bytes as usize];
        let block = block.split_first().filter(|(chunks, _)| **chunks == 0).map_or(&[][..], |(_, rest)| rest);
        let size = lz4_flex::block::decompress_into(block, &mut out);
        out.truncate(size.map_err(|error| format!("compressed data before byte {end}: {error}"))?);
        Ok(out)
    }

    fn section(&mut self, name: &str, at: u64, reps: &mut Vec<u64>) -> Checked {
        match name {
            "TOKENS" => {
                let (count, bytes) = (self.u64(at)?, self.u64(at + 8)?);
                self.fits(at, count, ITEM_BYTES)?;
                self.fits(at, bytes, 4)?;
                let text = self.decompress(self.block(at + 16, bytes)?, bytes)?;
                self.longest = text.split(|byte| *byte == 0).map(<[u8]>::len).max().unwrap_or(0) as u64;
            }
            "STRINGS" => _ = self.count(at, 4, ITEM_BYTES)?,
            "FIELDS" => {
                let count = self.u64(at)?;
                let next = self.integers(at + 8, count)?;
                self.fits(at, count, ITEM_BYTES)?;
                let text = self.decompress(self.block(next, 8 * count)?, 8 * count)?;
                reps.extend(
                    text.chunks_exact(8).map(|rep| u64::from_le_bytes(rep.try_into().expect("eight bytes"))),
                );
            }
            "FIELDSETS" => _ = self.integers(at + 8, self.u64(at)?)?,
            _ => {
                // Both tables have three lists; paths are counted twice
                let count = self.u64(at)?;
                self.fits(at, count, ITEM_BYTES + self.longest)?;
                let (mut next, count) =
                    if name == "PATHS" { (at + 16, self.u64(at + 8)?) } else { (at + 8, count) };
                for _ in 0..3 {
                    next = self.integers(next, count)?;
                }
            }
        }
        Ok(())
    }

    /// Looks at a value, by what a field says of it.
    fn value(&mut self, rep: u64, depth: u32) -> Checked {
        self.values_left = self.values_left.checked_sub(1).ok_or("values within each other without end")?;
        if depth > DEPTH_MAX {
            return Err(format!("values nested more than {DEPTH_MAX} deep"));
        }
        let (kind, at) = (rep >> 48 & 0xff, rep & PAYLOAD);
        if rep & INLINED != 0 {
            return Ok(());
        }
        if rep & ARRAY != 0 {
            return if at == 0 { Ok(()) } else { self.array(kind, rep & COMPRESSED != 0, at) };
        }
        let text = ITEM_BYTES + self.longest;
        match kind {
            // Dictionary
            31 => _ = self.dictionary(at, depth)?,
            // Lists of tokens, strings, paths and what is not registered; of integers of 4 and 8 bytes
            32..=34 | 54 => self.lists(at, 4, text)?,
            36 | 38 => self.lists(at, 4, 4)?,
            37 | 39 => self.lists(at, 8, 8)?,
            35 => self.references(at, depth)?,
            55 => self.lists(at, if self.version >= [0, 8, 0] { 24 } else { 8 }, 128 + text)?,
            // Vectors of paths, tokens, strings, numbers and offsets; variants, and relocations
            40 | 41 | 50 => _ = self.count(at, 4, text)?,
            48 => _ = self.count(at, 8, 8)?,
            49 => _ = self.count(at, 16, 16)?,
            45 | 58 => _ = self.count(at, 8, 2 * text)?,
            // Samples
            46 => self.samples(at, depth)?,
            _ => {}
        }
        Ok(())
    }

    fn array(&self, kind: u64, compressed: bool, at: u64) -> Checked {
        let at = if self.version < [0, 5, 0] { at + 4 } else { at };
        let (count, at) = match self.version < [0, 7, 0] {
            true => (u64::from(self.u32(at)?), at + 4),
            false => (self.u64(at)?, at + 8),
        };
        let (stored, held) = match kind {
            1 | 2 => (1, 2),
            7 => (2, 2),
            5 | 6 | 9 | 20 | 22 | 56 => (8, 8),
            // Vectors of two to four numbers, of two to eight bytes
            19 | 28 | 30 => (16, 16),
            21 => (4, 4),
            23 => (24, 24),
            24 | 26 => (12, 12),
            25 => (6, 6),
            27 => (32, 32),
            29 => (8, 8),
            // Rotations and matrices
            16 => (32, 32),
            17 => (16, 16),
            18 => (8, 8),
            13 => (32, 32),
            14 => (72, 72),
            15 => (128, 128),
            10..=12 | 57 => (4, ITEM_BYTES + self.longest),
            _ => (4, 4),
        };
        self.fits(at, count, held)?;
        if !compressed || count < 4 || !matches!(kind, 3..=9 | 56) {
            return self.slice(at, count.saturating_mul(stored)).map(|_| ());
        }
        match kind {
            3..=6 => _ = self.integers(at, count)?,
            _ => match self.slice(at, 1)?[0] {
                b't' => {
                    let table = u64::from(self.u32(at + 1)?) * stored;
                    self.slice(at + 5, table)?;
                    self.integers(at + 5 + table, count)?;
                }
                _ => _ = self.integers(at + 1, count)?,
            },
        }
        Ok(())
    }

    /// Up to six lists behind a byte that says which.
    fn lists(&self, at: u64, stored: u64, held: u64) -> Checked {
        let mut next = at + 1;
        for _ in 0..(self.slice(at, 1)?[0] & 0x7e).count_ones() {
            next += 8 + self.count(next, stored, held)? * stored;
        }
        Ok(())
    }

    /// Lists of references: strings, paths, offsets and dictionaries.
    fn references(&mut self, at: u64, depth: u32) -> Checked {
        let mut next = at + 1;
        for _ in 0..(self.slice(at, 1)?[0] & 0x7e).count_ones() {
            let count = self.count(next, 32, 256 + 2 * self.longest)?;
            next += 8;
            for _ in 0..count {
                next = self.dictionary(next + 24, depth + 1)?;
            }
        }
        Ok(())
    }

    /// The place behind a dictionary. A value stands at a distance from where that is written, and the next key behind it.
    fn dictionary(&mut self, at: u64, depth: u32) -> Checked<u64> {
        let count = self.count(at, 0, ITEM_BYTES)?;
        let mut next = at + 8;
        for _ in 0..count {
            let rep = self.jump(next + 4)?;
            self.value(self.u64(rep)?, depth + 1)?;
            next = rep + 8;
        }
        Ok(next)
    }

    /// The place that the distance written at another leads to.
    fn jump(&self, at: u64) -> Checked<u64> {
        at.checked_add_signed(self.u64(at)? as i64)
            .ok_or_else(|| format!("a distance at byte {at} leads out of the layer"))
    }

    fn samples(&mut self, at: u64, depth: u32) -> Checked {
        let times = self.jump(at)?;
        self.value(self.u64(times)?, depth + 1)?;
        let values = self.jump(times + 8)?;
        let count = self.count(values, 8, 2 * ITEM_BYTES)?;
        (0..count).try_for_each(|i| self.value(self.u64(values + 8 + 8 * i)?, depth + 1))
    }
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use openusd::{usda, usdc};
    use proptest::prelude::*;

    use super::*;

    /// A layer of all sorts of values.
    fn layer() -> Vec<u8> {
        let numbers = (0..200).map(|i| (i * i % 91).to_string()).collect::<Vec<_>>().join(", ");
        let text = format!(
            "#usda 1.0\n( metersPerUnit = 1\n customLayerData = {{ dictionary a = {{ string b = \"c\" }} }} )\n
def Xform \"A\" ( references = [@./b.usda@</B> (offset = 1), @./c.usda@] variants = {{ string v = \"x\" }} prepend variantSets = \"v\"
    prepend inherits = </C> payload = @./d.usda@ ) {{
    int[] i = [{numbers}]
    float[] f = [{numbers}]
    double[] d = [{numbers}]
    token[] t = [\"a\", \"b\"]
    string[] s = [\"a\", \"b\"]
    point3f[] points.timeSamples = {{ 1: [(0,0,0), (1,2,3)], 2: [(0,0,0), (1,2,4)] }}
    matrix4d m = ((1,0,0,0),(0,1,0,0),(0,0,1,0),(0,0,0,1))
    rel r = [</A>, </C>]
}}\nclass \"C\" {{}}\n"
        );
        let mut binary = Cursor::new(Vec::new());
        usdc::CrateWriter::write(&usda::parse(&text).unwrap(), &mut binary).unwrap();
        binary.into_inner()
    }

    /// Catches a layer as it should be that is refused, and a check that lets a count pass.
    #[test]
    fn whole_layers_pass_and_false_counts_do_not() {
        let bytes = layer();
        assert_eq!(check(&bytes, 1 << 20), Ok(()));
        assert!(check(&bytes, 100).is_err());
        let toc = u64::from_le_bytes(bytes[16..24].try_into().unwrap()) as usize;
        let sections = bytes[toc] as usize;
        for section in 0..sections {
            let at = toc + 8 + 32 * section + 16;
            let start = u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap()) as usize;
            let mut broken = bytes.clone();
            broken[start + 5] = 1;
            assert!(check(&broken, 1 << 30).is_err(), "section {section}");
        }
        for end in 0..bytes.len() {
            assert!(check(&bytes[..end], 1 << 20).is_err(), "{end}");
        }
    }

    proptest! {
        /// Catches a broken layer that passes and makes the library take memory or stack without end: the test would be killed.
        #[test]
        fn what_passes_can_be_read(flips in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6)) {
            use openusd::sdf::AbstractData;
            let mut bytes = layer();
            flips.iter().for_each(|(at, value)| *at.get_mut(&mut bytes) = *value);
            if check(&bytes, 64 << 20).is_ok() {
                // The library may say no, or panic, which the fence is for
                _ = std::panic::catch_unwind(|| {
                    let data = usdc::CrateData::open(Cursor::new(bytes), true).ok()?;
                    for path in data.spec_paths() {
                        for field in data.list_fields(&path)? {
                            _ = data.try_field(&path, &field);
                        }
                    }
                    Some(())
                });
            }
        }
    }
}
