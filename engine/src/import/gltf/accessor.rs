//! Accessors: typed views of buffers, dense or sparse, as plain arrays.

use super::container::{Container, missing};
use super::document::Accessor;
use crate::{Error, Result};

/// The type of a component.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Component {
    I8,
    U8,
    I16,
    U16,
    U32,
    F32,
}

impl Component {
    fn of(code: u32) -> Option<Self> {
        Some(match code {
            5120 => Self::I8,
            5121 => Self::U8,
            5122 => Self::I16,
            5123 => Self::U16,
            5125 => Self::U32,
            5126 => Self::F32,
            _ => return None,
        })
    }

    fn bytes(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::U32 | Self::F32 => 4,
        }
    }

    /// A component as an integer; none for floating point.
    fn integer(self, b: &[u8]) -> Option<i64> {
        Some(match self {
            Self::I8 => i64::from(b[0] as i8),
            Self::U8 => i64::from(b[0]),
            Self::I16 => i64::from(i16::from_le_bytes([b[0], b[1]])),
            Self::U16 => i64::from(u16::from_le_bytes([b[0], b[1]])),
            Self::U32 => i64::from(u32::from_le_bytes([b[0], b[1], b[2], b[3]])),
            Self::F32 => return None,
        })
    }

    /// A component as a number; normalised integers reach from 0 or -1 to 1 (specification, section 3.6.2.2).
    fn number(self, b: &[u8], normalized: bool) -> f32 {
        let Some(integer) = self.integer(b) else {
            return f32::from_le_bytes([b[0], b[1], b[2], b[3]]);
        };
        let most = match self {
            Self::I8 => 127.0,
            Self::U8 => 255.0,
            Self::I16 => 32_767.0,
            Self::U16 => 65_535.0,
            Self::U32 | Self::F32 => 4_294_967_295.0,
        };
        if normalized { (integer as f32 / most).max(-1.0) } else { integer as f32 }
    }
}

/// Says what is wrong with an accessor by itself, against a view of `view_bytes` bytes and its stride.
pub(super) fn fault(accessor: &Accessor, view: Option<(u64, Option<u64>)>) -> Option<String> {
    let Some(component) = Component::of(accessor.component_type) else {
        return Some(format!("has the component type `{}`", accessor.component_type));
    };
    let size = match (components(&accessor.shape), accessor.shape.as_str()) {
        (Some(components), _) => components,
        // Columns of matrices begin at multiples of four bytes; nothing here reads them
        (None, "MAT2" | "MAT3" | "MAT4") => return None,
        _ => return Some(format!("has the type `{}`", accessor.shape.escape_debug())),
    };
    if accessor.count == 0 {
        return Some("has no elements".into());
    }
    let Some((length, stride)) = view else {
        return (accessor.byte_offset > 0).then(|| "has an offset, but no buffer view".into());
    };
    let layout = Layout::new(
        (component, size),
        (accessor.byte_offset, stride),
        accessor.count,
        usize::try_from(length).ok()?,
    );
    layout.is_none().then(|| format!("does not fit its buffer view of {length} bytes"))
}

/// Components of a shape.
fn components(shape: &str) -> Option<usize> {
    Some(match shape {
        "SCALAR" => 1,
        "VEC2" => 2,
        "VEC3" => 3,
        "VEC4" => 4,
        _ => return None,
    })
}

/// Where the elements of an accessor lie in a view.
struct Layout {
    component: Component,
    components: usize,
    offset: usize,
    stride: usize,
    count: usize,
}

impl Layout {
    /// Checks that `count` elements lie inside a view of `length` bytes.
    fn new(
        (component, components): (Component, usize),
        (offset, stride): (u64, Option<u64>),
        count: u64,
        length: usize,
    ) -> Option<Self> {
        let size = (component.bytes() * components) as u64;
        let stride = stride.unwrap_or(size);
        let end = count.checked_sub(1)?.checked_mul(stride)?.checked_add(size)?.checked_add(offset)?;
        let fits = stride >= size && end <= length as u64;
        fits.then_some(Self {
            component,
            components,
            offset: offset as usize,
            stride: stride as usize,
            count: count as usize,
        })
    }

    /// The bytes of every component in order.
    fn each<'a>(&'a self, bytes: &'a [u8]) -> impl Iterator<Item = &'a [u8]> {
        let size = self.component.bytes();
        (0..self.count).flat_map(move |i| {
            let start = self.offset + i * self.stride;
            bytes[start..start + size * self.components].chunks_exact(size)
        })
    }
}

/// What [`Container::read`] needs of an accessor, taken out so that views can be borrowed.
struct Outline {
    view: Option<usize>,
    offset: u64,
    kind: (Component, usize),
    normalized: bool,
    count: u64,
    sparse: Option<SparseOutline>,
}

/// The sparse part: which elements to replace, and with what.
#[derive(Clone, Copy)]
struct SparseOutline {
    count: u64,
    indices: (usize, u64, Component),
    values: (usize, u64),
}

impl Container {
    /// An accessor's elements as numbers, and how many components each has; `shapes` are those allowed.
    pub fn floats(&mut self, accessor: usize, shapes: &[usize]) -> Result<(Vec<f32>, usize)> {
        self.read(accessor, shapes, |component, normalized, bytes| Some(component.number(bytes, normalized)))
    }

    /// An accessor's elements as unsigned integers.
    pub fn indices(&mut self, accessor: usize) -> Result<Vec<u32>> {
        let unsigned = |component: Component, _, bytes: &[u8]| u32::try_from(component.integer(bytes)?).ok();
        Ok(self.read(accessor, &[1], unsigned)?.0)
    }

    /// Whether an accessor has data of its own, in a view or sparse.
    pub fn has_data(&self, accessor: usize) -> bool {
        let found = self.document.accessors.get(accessor);
        found.is_some_and(|accessor| accessor.buffer_view.is_some() || accessor.sparse.is_some())
    }

    /// How many elements an accessor has.
    pub fn count(&self, accessor: usize) -> Result<u64> {
        let accessors = &self.document.accessors;
        accessors.get(accessor).map(|a| a.count).ok_or_else(|| missing("accessor", accessor, accessors.len()))
    }

    /// Reads all elements. Their memory is taken from the budget; [`release`](Self::release) gives it back.
    fn read<T: Copy + Default>(
        &mut self,
        accessor: usize,
        shapes: &[usize],
        convert: impl Fn(Component, bool, &[u8]) -> Option<T>,
    ) -> Result<(Vec<T>, usize)> {
        let outline = self.outline(accessor, shapes)?;
        let wrong = |what: &str| Error::invalid(format!("accessor {accessor} {what}"));
        let components = outline.kind.1;
        let total = outline.count.saturating_mul(components as u64);
        let convert = |kind: Component, bytes: &[u8]| {
            convert(kind, outline.normalized, bytes).ok_or_else(|| wrong("has components of the wrong type"))
        };
        // A view bounds the count by its bytes; without one elements are zero and the budget alone bounds them
        let layout =
            match outline.view {
                Some(view) => {
                    let (bytes, stride) = self.view(view)?;
                    let length = bytes.len();
                    let layout = Layout::new(outline.kind, (outline.offset, stride), outline.count, length);
                    Some(layout.ok_or_else(|| {
                        wrong(&format!("does not fit buffer view {view} of {length} bytes"))
                    })?)
                }
                None => None,
            };
        self.budget.take(total.saturating_mul(size_of::<T>() as u64), &format!("accessor {accessor}"))?;
        let mut values = Vec::new();
        match (layout, outline.view) {
            (Some(layout), Some(view)) => {
                values.reserve_exact(total as usize);
                let (bytes, _) = self.view(view)?;
                for bytes in layout.each(bytes) {
                    values.push(convert(layout.component, bytes)?);
                }
            }
            _ => values.resize(total as usize, T::default()),
        }
        if let Some(sparse) = outline.sparse {
            let places = self
                .sparse_places(&sparse, outline.count)
                .map_err(|what| what.unwrap_or_else(|| wrong("has sparse indices that are not in range")))?;
            let (bytes, _) = self.view(sparse.values.0)?;
            let layout = Layout::new(outline.kind, (sparse.values.1, None), sparse.count, bytes.len())
                .ok_or_else(|| wrong("has sparse values that do not fit their view"))?;
            for (i, bytes) in layout.each(bytes).enumerate() {
                values[places[i / components] * components + i % components] =
                    convert(layout.component, bytes)?;
            }
        }
        Ok((values, components))
    }

    /// Gives back the memory of what was read.
    pub fn release<T>(&mut self, values: Vec<T>) {
        self.budget.give((values.len() * size_of::<T>()) as u64);
    }

    fn outline(&self, accessor: usize, shapes: &[usize]) -> Result<Outline> {
        let accessors = &self.document.accessors;
        let found = accessors.get(accessor).ok_or_else(|| missing("accessor", accessor, accessors.len()))?;
        let wrong = |what: String| Error::invalid(format!("accessor {accessor} {what}"));
        let component =
            |code| Component::of(code).ok_or_else(|| wrong(format!("has the component type `{code}`")));
        let shape = components(&found.shape).filter(|shape| shapes.contains(shape));
        let shape = shape.ok_or_else(|| wrong(format!("has the type `{}`", found.shape.escape_debug())))?;
        if found.count == 0 {
            return Err(wrong("has no elements".into()));
        }
        let sparse = match &found.sparse {
            Some(sparse) if sparse.count == 0 || sparse.count > found.count => {
                return Err(wrong(format!("replaces {} of {} elements", sparse.count, found.count)));
            }
            Some(sparse) => Some(SparseOutline {
                count: sparse.count,
                indices: (
                    sparse.indices.buffer_view,
                    sparse.indices.byte_offset,
                    component(sparse.indices.component_type)?,
                ),
                values: (sparse.values.buffer_view, sparse.values.byte_offset),
            }),
            None => None,
        };
        Ok(Outline {
            view: found.buffer_view,
            offset: found.byte_offset,
            kind: (component(found.component_type)?, shape),
            normalized: found.normalized,
            count: found.count,
            sparse,
        })
    }

    /// The elements that a sparse accessor replaces. Fails with none when they are not in range.
    fn sparse_places(&mut self, sparse: &SparseOutline, count: u64) -> Result<Vec<usize>, Option<Error>> {
        let (view, offset, component) = sparse.indices;
        let (bytes, _) = self.view(view).map_err(Some)?;
        let layout = Layout::new((component, 1), (offset, None), sparse.count, bytes.len()).ok_or(None)?;
        let place = |bytes: &[u8]| component.integer(bytes).filter(|&i| i >= 0 && (i as u64) < count);
        layout.each(bytes).map(|bytes| place(bytes).map(|i| i as usize).ok_or(None)).collect()
    }
}
