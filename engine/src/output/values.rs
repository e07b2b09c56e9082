//! Attribute values as double precision numbers, which hold every f32, f16, u8 and u32 exactly.

use half::f16;

use crate::stream::schema::names;
use crate::stream::{Attribute, ValueType};

/// Calls `each` with component and value for every value of a column, in order.
pub(super) fn for_each(attribute: &Attribute, column: &[u8], mut each: impl FnMut(usize, f64)) {
    let components = usize::from(attribute.components);
    // One loop per type, so that the type is not asked for every value.
    macro_rules! walk {
        ($width:literal, $value:expr) => {
            for value in column.chunks_exact($width * components) {
                for (component, bytes) in value.as_chunks::<$width>().0.iter().enumerate() {
                    each(component, $value(*bytes));
                }
            }
        };
    }
    match attribute.value_type {
        ValueType::F32 => walk!(4, |bytes| f64::from(f32::from_le_bytes(bytes))),
        ValueType::F16 => walk!(2, |bytes| f16::from_le_bytes(bytes).to_f64()),
        ValueType::U8 => walk!(1, |bytes: [u8; 1]| f64::from(bytes[0])),
        ValueType::U32 => walk!(4, |bytes| f64::from(u32::from_le_bytes(bytes))),
    }
}

/// Replaces `out` by the column's values. `opacity` and `albedo` in bytes are read as value / 255.
pub(super) fn unit_values(attribute: &Attribute, column: &[u8], out: &mut Vec<f64>) {
    let is_unit = matches!(attribute.name.as_str(), names::OPACITY | names::ALBEDO);
    let scale = if is_unit && attribute.value_type == ValueType::U8 { 1.0 / 255.0 } else { 1.0 };
    out.clear();
    for_each(attribute, column, |_, value| out.push(scale * value));
}
