//! Reads the text of an OBJ file into a mesh.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use glam::{DVec3, Vec3};

use super::mtl::{self, Material, rest_of};
use crate::import::large::Elements;
use crate::import::lines::{self, LineReader};
use crate::import::mesh::{Face, NO_NORMAL};
use crate::import::{ImportOptions, ImportReport, confine};
use crate::{Error, ErrorKind, Result};

/// Statements that describe curves and surfaces of higher order.
const FREE_FORM: [&[u8]; 19] = [
    b"vp", b"deg", b"bmat", b"step", b"cstype", b"curv", b"curv2", b"surf", b"parm", b"trim", b"hole",
    b"scrv", b"sp", b"end", b"con", b"bzp", b"bsp", b"cdc", b"res",
];

/// Statements that say nothing about shape or colour, or that are done without.
const IGNORED: [&[u8]; 12] = [
    b"vt",
    b"s",
    b"mg",
    b"usemap",
    b"maplib",
    b"bevel",
    b"c_interp",
    b"d_interp",
    b"lod",
    b"shadow_obj",
    b"trace_obj",
    b"vw",
];

/// Albedo of materials that have none.
const ALBEDO_DEFAULT: [u8; 3] = [128; 3];

/// Bytes of the names of objects at most.
const NAME_BYTES_MAX: u64 = 32 << 20;

/// Reads the file at `path`.
pub(super) fn read<'a>(
    path: &Path,
    options: &'a ImportOptions,
    report: &mut ImportReport,
) -> Result<Elements<'a>> {
    let mut reader = LineReader::open(path)?;
    let mut state = State::new(path, options);
    while reader.advance(true)? {
        state.statement(&reader, report)?;
        state.elements.relieve()?;
    }
    state.finish(report)
}

/// The furthest index that was ahead of what it refers to, and where it stood.
#[derive(Clone, Copy, Debug)]
struct Ahead {
    index: u64,
    line: u64,
    column: u64,
}

struct State<'a> {
    path: PathBuf,
    elements: Elements<'a>,
    /// Object and group names; together they name what gets an `id`.
    object: Vec<u8>,
    group: Vec<u8>,
    ids: HashMap<Vec<u8>, u32>,
    /// Bytes of all names in `ids`.
    name_bytes: u64,
    id: Option<u32>,
    materials: Vec<Material>,
    /// Material and opacity of the faces that follow; 0 is no material.
    material: u32,
    opacity: u8,
    positions_ahead: Option<Ahead>,
    normals_ahead: Option<Ahead>,
    corners: Vec<u32>,
    corner_normals: Vec<u32>,
}

impl<'a> State<'a> {
    fn new(path: &Path, options: &'a ImportOptions) -> Self {
        let mut elements = Elements::new(path, options);
        elements.mesh.single_precision = true;
        Self {
            path: path.to_path_buf(),
            elements,
            object: Vec::new(),
            group: Vec::new(),
            ids: HashMap::new(),
            name_bytes: 0,
            id: None,
            materials: Vec::new(),
            material: 0,
            opacity: 255,
            positions_ahead: None,
            normals_ahead: None,
            corners: Vec::new(),
            corner_normals: Vec::new(),
        }
    }

    /// Takes one line.
    fn statement(&mut self, reader: &LineReader, report: &mut ImportReport) -> Result<()> {
        let line = reader.line();
        let mut words = lines::tokens(line).take_while(|word| word[0] != b'#');
        let Some(keyword) = words.next() else { return Ok(()) };
        match keyword {
            b"v" => self.vertex(reader, keyword, words),
            b"vn" => self.normal(reader, keyword, words),
            b"f" | b"fo" | b"l" | b"p" => {
                self.corners.clear();
                self.corner_normals.clear();
                for word in words {
                    self.corner(reader, word)?;
                }
                self.element(keyword, report)
            }
            b"o" | b"g" => {
                let name = rest_of(line, keyword).to_vec();
                *(if keyword == b"o" { &mut self.object } else { &mut self.group }) = name;
                self.id = None;
                Ok(())
            }
            b"usemtl" => {
                self.use_material(rest_of(line, keyword), report);
                Ok(())
            }
            b"mtllib" => {
                self.libraries(rest_of(line, keyword), report);
                Ok(())
            }
            _ if IGNORED.contains(&keyword) => Ok(()),
            _ if FREE_FORM.contains(&keyword) => {
                report.skip("statements of curves and surfaces of higher order", 1);
                Ok(())
            }
            _ => {
                report.skip("unknown statements", 1);
                Ok(())
            }
        }
    }

    /// `v x y z [w]` or `v x y z [w] r g b`.
    fn vertex<'b>(
        &mut self,
        reader: &LineReader,
        keyword: &[u8],
        words: impl Iterator<Item = &'b [u8]>,
    ) -> Result<()> {
        let (values, count) = numbers::<7>(reader, keyword, words)?;
        let position = DVec3::new(values[0], values[1], values[2]);
        let mesh = &mut self.elements.mesh;
        mesh.single_precision &= position.as_vec3().as_dvec3() == position;
        let color = match count {
            6 => Some([values[3], values[4], values[5]]),
            7 => Some([values[4], values[5], values[6]]),
            _ => None,
        };
        if color.is_some() && mesh.colors.is_empty() {
            mesh.colors.resize(mesh.positions.len(), ALBEDO_DEFAULT);
        }
        mesh.positions.push(position);
        if color.is_some() || !mesh.colors.is_empty() {
            let byte = |value: f64| crate::import::srgb::unit_byte(value as f32);
            mesh.colors.push(color.map_or(ALBEDO_DEFAULT, |color| color.map(byte)));
        }
        Ok(())
    }

    fn normal<'b>(
        &mut self,
        reader: &LineReader,
        keyword: &[u8],
        words: impl Iterator<Item = &'b [u8]>,
    ) -> Result<()> {
        let (values, _) = numbers::<3>(reader, keyword, words)?;
        self.elements.mesh.normals.push(Vec3::from_array(values.map(|value| value as f32)));
        Ok(())
    }

    /// `v`, `v/vt`, `v//vn` or `v/vt/vn`.
    fn corner(&mut self, reader: &LineReader, word: &[u8]) -> Result<()> {
        let mut parts = word.split(|&b| b == b'/');
        let position = parts.next().unwrap_or_default();
        let texture = parts.next().unwrap_or_default();
        let normal = parts.next().unwrap_or_default();
        let count = self.elements.positions();
        let position = index(reader, word, position, count, "vertex", &mut self.positions_ahead)?;
        if !texture.is_empty() {
            integer(reader, word, texture)?;
        }
        let normal = match normal {
            b"" => NO_NORMAL,
            _ => {
                let count = self.elements.normals();
                index(reader, word, normal, count, "normal", &mut self.normals_ahead)?
            }
        };
        self.corners.push(position);
        self.corner_normals.push(normal);
        Ok(())
    }

    /// Makes faces of the corners that a statement lists.
    fn element(&mut self, keyword: &[u8], report: &mut ImportReport) -> Result<()> {
        let corners = std::mem::take(&mut self.corners);
        let normals = std::mem::take(&mut self.corner_normals);
        let arity = match keyword {
            b"p" => 1,
            b"l" => 2,
            _ => corners.len().max(3),
        };
        if corners.len() < arity {
            let few = if arity == 2 { "lines of one point" } else { "faces of fewer than three corners" };
            report.skip(few, u64::from(arity > 1));
        } else {
            let face = self.face()?;
            for start in 0..=corners.len() - arity {
                let mesh = &mut self.elements.mesh;
                mesh.push_face(face, &corners[start..start + arity], report)?;
                mesh.corner_normals.extend_from_slice(&normals[start..start + arity]);
            }
        }
        (self.corners, self.corner_normals) = (corners, normals);
        Ok(())
    }

    /// A face as the statements before it say.
    fn face(&mut self) -> Result<Face> {
        let object = match self.id {
            Some(id) => id,
            None => {
                let name = [self.object.as_slice(), &self.group].join(&0);
                let (next, bytes) = (self.ids.len() as u32, name.len() as u64);
                let id = *self.ids.entry(name).or_insert(next);
                // A name in a hash table costs about 64 bytes besides itself
                self.name_bytes += if id == next { bytes + 64 } else { 0 };
                if self.name_bytes > NAME_BYTES_MAX {
                    let message = format!("names of objects that take more than {NAME_BYTES_MAX} bytes");
                    return Err(Error::new(ErrorKind::Limit, message).hint("cut the file into parts"));
                }
                *self.id.insert(id)
            }
        };
        Ok(Face { start: 0, arity: 0, material: self.material, object, opacity: self.opacity, hole: false })
    }

    fn use_material(&mut self, name: &[u8], report: &mut ImportReport) {
        match self.materials.iter().rposition(|material| material.name == name) {
            Some(found) => {
                self.material = found as u32 + 1;
                self.opacity = self.materials[found].opacity;
                if self.opacity == 0 {
                    let name = String::from_utf8_lossy(name).into_owned();
                    report.warn(format!("material `{}` is fully transparent", name.escape_debug()));
                }
            }
            None => {
                (self.material, self.opacity) = (0, 255);
                let name = String::from_utf8_lossy(&name[..name.len().min(80)]).into_owned();
                report.warn(format!("material `{}` is not defined", name.escape_debug()));
            }
        }
    }

    /// Reads the libraries that a statement names: one whose name may hold spaces, or several. Those that are not
    /// there are missed only when none is.
    fn libraries(&mut self, names: &[u8], report: &mut ImportReport) {
        let whole = String::from_utf8_lossy(names).into_owned();
        let names = match confine::beside(&self.path, &whole) {
            Ok(_) => vec![whole],
            Err(_) => split_names(&whole),
        };
        let mut failure = None;
        let mut any = false;
        for name in names {
            let read = confine::beside(&self.path, &name)
                .and_then(|path| mtl::read(&path, &mut self.materials, report));
            match read {
                Ok(()) => any = true,
                Err(error) => failure = Some((name, error)),
            }
        }
        if let Some((name, error)) = failure.filter(|_| !any) {
            report.warn(format!("material library `{}`: {}", name.escape_debug(), error.message()));
        }
    }

    /// Checks the indices that were ahead, and hands over the mesh.
    fn finish(mut self, report: &mut ImportReport) -> Result<Elements<'a>> {
        let positions = self.elements.positions();
        if let Some(ahead) = self.positions_ahead.filter(|ahead| ahead.index >= positions) {
            return Err(Error::invalid(format!("vertex `{}` of {positions} vertices", ahead.index + 1))
                .at_text(&self.path, ahead.line, ahead.column));
        }
        let normals = self.elements.normals();
        if let Some(ahead) = self.normals_ahead.filter(|ahead| ahead.index >= normals) {
            // Files of bare topology refer to normals that nobody wrote
            let (line, column, index) = (ahead.line, ahead.column, ahead.index + 1);
            report.warn(format!(
                "normal `{index}` of {normals} (line {line}, column {column}): normals that are not there are computed"
            ));
            let is_missing = |normal: &&mut u32| u64::from(**normal) >= normals;
            self.elements
                .mesh
                .corner_normals
                .iter_mut()
                .filter(is_missing)
                .for_each(|normal| *normal = NO_NORMAL);
        }
        if self.materials.iter().any(|material| material.albedo.is_some()) {
            let albedos = self.materials.iter().map(|material| material.albedo.unwrap_or(ALBEDO_DEFAULT));
            self.elements.mesh.palette = std::iter::once(ALBEDO_DEFAULT).chain(albedos).collect();
        }
        report.source.vertices = positions;
        Ok(self.elements)
    }
}

/// Parts names at spaces; a backslash keeps the space behind it.
fn split_names(text: &str) -> Vec<String> {
    let mut names = vec![String::new()];
    let mut chars = text.chars().peekable();
    while let Some(c) = chars.next() {
        match c {
            '\\' if chars.peek() == Some(&' ') => {
                names.last_mut().expect("never empty").extend(chars.next());
            }
            ' ' | '\t' => names.push(String::new()),
            c => names.last_mut().expect("never empty").push(c),
        }
    }
    names.retain(|name| !name.is_empty());
    names
}

/// Three numbers and up to `N`; how many there were.
fn numbers<'a, const N: usize>(
    reader: &LineReader,
    keyword: &[u8],
    words: impl Iterator<Item = &'a [u8]>,
) -> Result<([f64; N], usize)> {
    let mut values = [0.0; N];
    let mut count = 0;
    for (slot, word) in values.iter_mut().zip(words) {
        *slot = lines::number(word).ok_or_else(|| {
            let text = String::from_utf8_lossy(&word[..word.len().min(40)]).into_owned();
            reader.error(ErrorKind::Invalid, word, format!("`{}` is not a number", text.escape_default()))
        })?;
        count += 1;
    }
    if count < 3 {
        return Err(reader.error(
            ErrorKind::Invalid,
            keyword,
            format!("{count} numbers, at least 3 expected"),
        ));
    }
    Ok((values, count))
}

fn integer(reader: &LineReader, word: &[u8], digits: &[u8]) -> Result<i64> {
    std::str::from_utf8(digits).ok().and_then(|text| text.parse().ok()).ok_or_else(|| {
        let text = String::from_utf8_lossy(&digits[..digits.len().min(40)]).into_owned();
        reader.error(ErrorKind::Invalid, word, format!("`{}` is not an index", text.escape_default()))
    })
}

/// An index from 0. In the file indices count from 1, negative ones back from the `count` read so far; those ahead
/// are checked when all is read.
fn index(
    reader: &LineReader,
    word: &[u8],
    digits: &[u8],
    count: u64,
    what: &str,
    ahead: &mut Option<Ahead>,
) -> Result<u32> {
    let value = integer(reader, word, digits)?;
    let absolute = if value < 0 { count as i64 + value } else { value - 1 };
    if absolute < 0 || absolute >= i64::from(u32::MAX) {
        let message = format!("{what} `{value}` of the {count} so far, which count from 1");
        return Err(reader.error(ErrorKind::Invalid, word, message));
    }
    if absolute as u64 >= count && ahead.is_none_or(|known| known.index < absolute as u64) {
        let column = (word.as_ptr() as usize - reader.line().as_ptr() as usize) as u64 + 1;
        *ahead = Some(Ahead { index: absolute as u64, line: reader.number, column });
    }
    Ok(absolute as u32)
}
