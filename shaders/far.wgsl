// The far field of a child that is not opened. Twin: engine/src/brick/far.rs, which has the meaning.

const EXTINCTION_OPAQUE: u32 = 1u << 24u;
const OPAQUE: u32 = 0xffffu;
const PLATE_ERROR: f32 = 1.0 / 2097152.0;

// The six bytes of a child's record, the first one lowest
fn far_record(line: u32, slot: u32) -> vec2<u32> {
    // 6 bytes start at a multiple of 2 bytes
    let at = line * WORDS_PER_LINE + 20u + (6u * slot) / 4u;
    let first = word(at);
    let second = word(at + 1u);
    if (slot & 1u) == 0u {
        return vec2<u32>(first, second & 0xffffu);
    }
    return vec2<u32>((first >> 16u) | (second << 16u), second >> 16u);
}

fn far_byte(record: vec2<u32>, at: u32) -> u32 {
    return (select(record.x, record.y, at >= 4u) >> (8u * (at & 3u))) & 255u;
}

fn far_signed(record: vec2<u32>, at: u32) -> i32 {
    return bitcast<i32>(far_byte(record, at) << 24u) >> 24u;
}

fn must_open(record: vec2<u32>) -> bool {
    return (far_byte(record, 5u) & 1u) != 0u;
}

// What the ray loses that passes the box of a child, whose centre is relative to the ray's origin, from `passes.x` to `passes.y`
fn far_extinction(record: vec2<u32>, center: vec3<f32>, half: vec3<f32>, passes: vec2<f32>) -> u32 {
    switch (far_byte(record, 3u) & 1u) | ((far_byte(record, 4u) & 1u) << 1u) {
        case 0u, 1u: {
            return aggregate_extinction(record, half);
        }
        case 2u: {
            return select(0u, EXTINCTION_OPAQUE, meets_plate(record, center, half, passes));
        }
        default: {
            return stored_extinction(record.x & 0xffffu);
        }
    }
}

fn stored_extinction(stored: u32) -> u32 {
    return select(stored, EXTINCTION_OPAQUE, stored == OPAQUE);
}

fn aggregate_extinction(record: vec2<u32>, h: vec3<f32>) -> u32 {
    let d = ray_direction;
    let roots = vec3<f32>(f32(far_byte(record, 0u)), f32(far_byte(record, 1u)), f32(far_byte(record, 2u)))
        * (1.0 / 128.0);
    let c = roots * roots;
    let r = vec3<f32>(
        f32(far_signed(record, 3u) >> 1u),
        f32(far_signed(record, 4u) >> 1u),
        f32(far_signed(record, 5u) >> 1u),
    ) * (1.0 / 63.0);
    let face = vec3<f32>((h.y * h.z) * d.x, (h.z * h.x) * d.y, (h.x * h.y) * d.z);
    let shown = c * face;
    let projected = (abs(face.x) + abs(face.y)) + abs(face.z);
    let squares = (separate(shown.x * shown.x) + separate(shown.y * shown.y)) + separate(shown.z * shown.z);
    let products = (separate(r.x * (shown.x * shown.y)) + separate(r.y * (shown.y * shown.z)))
        + separate(r.z * (shown.x * shown.z));
    let square = squares + 2.0 * products;
    var x = 0.0;
    if square > 0.0 && projected > 0.0 {
        x = quotient(root(square), projected);
    }
    let layered = (far_byte(record, 3u) & 1u) != 0u;
    let transmittance = 1.0 - x * select(1.0, 0.125, layered);
    if transmittance > 0.0 {
        let units = octaves(transmittance) * select(4096.0, 8.0 * 4096.0, layered);
        return u32(max(round(units), 0.0));
    }
    return EXTINCTION_OPAQUE;
}

// -log2(t) for 0 < t <= 1
fn octaves(t: f32) -> f32 {
    let bits = bitcast<u32>(t);
    let exponent = f32(i32(bits >> 23u) - 127);
    let f = bitcast<f32>((bits & 0x007fffffu) | 0x3f800000u) - 1.0;
    let q = separate(separate(separate(-0.044873955 * f + 0.1505332) * f - 0.269578) * f + 0.44241858);
    return -(exponent + (f + separate((f * (1.0 - f)) * q)));
}

fn plate_reach(normal: vec3<f32>, half: vec3<f32>) -> f32 {
    return abs(normal.x * half.x) + abs(normal.y * half.y) + abs(normal.z * half.z);
}

fn plate_product(n: vec3<f32>, v: vec3<f32>) -> f32 {
    return (separate(n.x * v.x) + separate(n.y * v.y)) + separate(n.z * v.z);
}

fn meets_plate(record: vec2<u32>, center: vec3<f32>, half: vec3<f32>, passes: vec2<f32>) -> bool {
    let a = far_signed(record, 0u);
    let b = far_signed(record, 1u);
    let n = vec3<f32>(vec3<i32>(a + b, a - b, 254 - 2 * max(abs(a), abs(b))));
    let extent = plate_reach(n, half);
    let low = separate(f32(far_byte(record, 2u)) * (extent * (2.0 / 255.0))) - extent;
    let high = separate(f32(far_byte(record, 3u) >> 1u) * (extent * (2.0 / 127.0))) - extent;
    let slope = plate_product(n, ray_direction);
    let middle = plate_product(n, center);
    let pad = (plate_reach(n, center) + extent) * PLATE_ERROR;
    let p = passes.x * slope;
    let q = passes.y * slope;
    return min(p, q) <= (middle + high) + pad && max(p, q) >= (middle + low) - pad;
}
