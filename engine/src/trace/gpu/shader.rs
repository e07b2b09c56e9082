//! Shaders, joined from their parts: WGSL declarations need no order, so a kernel is its files end to end.

use std::fmt::Write;

/// What an adapter's shaders may use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Dialect {
    /// Leaf tests by subgroups.
    pub wide: bool,
    /// Points and lines in double precision.
    pub has_double: bool,
    /// Single precision rounded once, by way of double precision: for software adapters, to match the CPU's bits.
    pub is_exact: bool,
}

/// The arena's pages as the kernels see them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Pages {
    /// How many.
    pub count: u32,
    /// Bytes of each, a power of two.
    pub bytes: u64,
}

macro_rules! part {
    ($name:literal) => {
        include_str!(concat!("../../../../shaders/", $name, ".wgsl"))
    };
}

impl Dialect {
    fn arithmetic(self) -> &'static str {
        if self.is_exact { part!("arithmetic_double") } else { part!("arithmetic_native") }
    }

    /// The kernel that traces new rays, and without subgroups also those that go on.
    pub fn kernel(self, pages: Pages) -> String {
        let real = if self.has_double { "alias Real = f64;\n" } else { "alias Real = f32;\n" };
        let leaf = if self.wide { part!("leaf_wide") } else { part!("leaf_plain") };
        let arena = pages.source();
        let parts = [
            part!("batch"),
            arena.as_str(),
            self.arithmetic(),
            part!("sample"),
            part!("node"),
            part!("far"),
            part!("leaf"),
            part!("intersect"),
            real,
            part!("round"),
            part!("kernel"),
            leaf,
        ];
        parts.join("\n")
    }

    /// The projection to spherical harmonics.
    pub fn projection(self) -> String {
        [part!("batch"), self.arithmetic(), part!("sample"), part!("sh"), part!("sh_occlusion")].join("\n")
    }
}

impl Pages {
    /// Declares the pages and the two functions that read them: 16 bytes, and 4.
    fn source(self) -> String {
        let mut text = String::from("// The arena, in pages\n\n");
        for page in 0..self.count {
            writeln!(text, "@group(0) @binding({page}) var<storage, read> page{page}: array<vec4<u32>>;")
                .expect("strings take everything");
        }
        let (shift, mask) = (self.bytes.ilog2() - 4, self.bytes / 16 - 1);
        text.push_str("\n// 16 bytes, by their number\nfn quad(at: u32) -> vec4<u32> {\n");
        if self.count > 1 {
            writeln!(text, "    switch at >> {shift}u {{").expect("strings take everything");
            for page in 1..self.count {
                writeln!(
                    text,
                    "        case {page}u: {{\n            return page{page}[at & {mask}u];\n        }}"
                )
                .expect("strings take everything");
            }
            text.push_str("        default: {}\n    }\n");
        }
        writeln!(text, "    return page0[at & {mask}u];\n}}").expect("strings take everything");
        text.push_str("\n// 4 bytes, by their number\nfn word(at: u32) -> u32 {\n    return quad(at >> 2u)[at & 3u];\n}\n");
        text
    }
}
