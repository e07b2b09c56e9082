//! Material libraries of OBJ: diffuse colour and opacity.

use std::path::Path;

use crate::Result;
use crate::import::ImportReport;
use crate::import::emit::opacity_byte;
use crate::import::lines::{self, LineReader};
use crate::import::srgb;

/// Materials of a library at most.
const MATERIALS_MAX: usize = 1 << 16;

/// A material.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Material {
    pub name: Vec<u8>,
    /// Linear albedo, from `Kd`.
    pub albedo: Option<[u8; 3]>,
    /// Opacity, from `d` or `Tr`; 255 is opaque.
    pub opacity: u8,
}

/// Adds the materials of a library. Lines that are not understood are left out: a material never stops an import.
pub(super) fn read(path: &Path, materials: &mut Vec<Material>, report: &mut ImportReport) -> Result<()> {
    let mut reader = LineReader::open(path)?;
    let first = materials.len();
    while reader.advance(true)? {
        let line = reader.line();
        let mut words = lines::tokens(line);
        let Some(keyword) = words.next() else { continue };
        if keyword == b"newmtl" {
            if materials.len() >= MATERIALS_MAX {
                report.warn(format!("materials beyond the first {MATERIALS_MAX} are not read"));
                return Ok(());
            }
            materials.push(Material { name: rest_of(line, keyword).to_vec(), albedo: None, opacity: 255 });
            continue;
        }
        if materials.len() == first {
            continue;
        }
        let material = materials.last_mut().expect("one was added");
        let mut numbers = [None; 3];
        for (slot, word) in numbers.iter_mut().zip(words) {
            *slot = lines::number(word).filter(|value| value.is_finite());
        }
        match (keyword, numbers) {
            (b"Kd", [Some(r), g, b]) => {
                let rgb = [r, g.unwrap_or(r), b.unwrap_or(r)];
                material.albedo = Some(rgb.map(|value| srgb::unit_byte(value as f32)));
            }
            (b"d", [Some(d), ..]) => material.opacity = opacity_byte(d as f32),
            (b"Tr", [Some(tr), ..]) => material.opacity = opacity_byte((1.0 - tr) as f32),
            (b"map_Kd" | b"map_d", _) => report.warn("textures of OBJ materials are not read".into()),
            _ => {}
        }
    }
    Ok(())
}

/// What stands behind a line's keyword, without the spaces around it.
pub(super) fn rest_of<'a>(line: &'a [u8], keyword: &[u8]) -> &'a [u8] {
    line.trim_ascii_start().get(keyword.len()..).unwrap_or_default().trim_ascii()
}
