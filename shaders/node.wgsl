// Nodes: decoding, boxes against a ray, what to open. Twins: engine/src/brick/{node.rs, lanes/plain.rs}.

const WIDTH: u32 = 8u;
// 4-byte words of a node's line address
const WORDS_PER_LINE: u32 = 16u;
const BRICK_HEADER_LINES: u32 = 1u;
const LOCATION_BITS: u32 = 14u;
const KIND_NODE: u32 = 0u;
const KIND_LEAF: u32 = 1u;
const KIND_BRICK: u32 = 2u;
// Relative error of box arithmetic: a few roundings of 2^-24
const BOX_ERROR: f32 = 1.0 / 2097152.0;
const F32_MAX: f32 = 0x1.fffffep+127f;

// The boxes of a node, without its children and far fields
struct Boxes {
    origin: vec3<i32>,
    exponent: vec3<u32>,
    count: u32,
    lower: array<vec2<u32>, 3>,
    upper: array<vec2<u32>, 3>,
}

fn read_boxes(line: u32) -> Boxes {
    let at = line * 4u;
    let head = quad(at);
    let a = quad(at + 2u);
    let b = quad(at + 3u);
    let c = quad(at + 4u);
    var boxes: Boxes;
    boxes.origin = vec3<i32>(bitcast<vec4<i32>>(head).xyz);
    boxes.exponent = vec3<u32>(head.w & 255u, (head.w >> 8u) & 255u, (head.w >> 16u) & 255u);
    boxes.count = head.w >> 24u;
    boxes.lower = array<vec2<u32>, 3>(a.xy, a.zw, b.xy);
    boxes.upper = array<vec2<u32>, 3>(b.zw, c.xy, c.zw);
    return boxes;
}

// Byte `slot` of each axis
fn faces_of(bytes: array<vec2<u32>, 3>, slot: u32) -> vec3<u32> {
    let words = select(
        vec3<u32>(bytes[0].x, bytes[1].x, bytes[2].x),
        vec3<u32>(bytes[0].y, bytes[1].y, bytes[2].y),
        slot >= 4u,
    );
    return (words >> vec3<u32>(8u * (slot & 3u))) & vec3<u32>(255u);
}

// The lower corner of a child's box, in lattice coordinates
fn lower_corner(boxes: Boxes, slot: u32) -> vec3<i32> {
    return boxes.origin + vec3<i32>(faces_of(boxes.lower, slot) << boxes.exponent);
}

// A child's box relative to the group's reference, in lattice steps
struct ChildBox {
    center: vec3<f32>,
    half: vec3<f32>,
}

fn child_box(boxes: Boxes, slot: u32) -> ChildBox {
    let base = vec3<f32>(boxes.origin - group_reference);
    let half_scale = 0.5 * bitcast<vec3<f32>>((boxes.exponent + vec3<u32>(127u)) << vec3<u32>(23u));
    let lower = vec3<f32>(faces_of(boxes.lower, slot));
    let upper = vec3<f32>(faces_of(boxes.upper, slot));
    return ChildBox(fused3(lower + upper, half_scale, base), (upper - lower) * half_scale);
}

// Squared distance of a child's box from the group's origins, and its squared diagonal
fn seen(child: ChildBox) -> vec2<f32> {
    let below = group_lower - (child.center + child.half);
    let above = (child.center - child.half) - group_upper;
    let gap = max(max(below, above), vec3<f32>(0.0));
    let twice = 4.0 * child.half;
    let distance2 = fused(gap.z, gap.z, fused(gap.y, gap.y, gap.x * gap.x));
    let diagonal2 = fused(twice.z, child.half.z, fused(twice.y, child.half.y, twice.x * child.half.x));
    return vec2<f32>(distance2, diagonal2);
}

// Where the ray enters and leaves a child's box, padded against rounding
fn passage(child: ChildBox) -> vec2<f32> {
    let reach = max(abs(group_lower), abs(group_upper));
    let half = fused3(abs(child.center) + child.half + reach, vec3<f32>(BOX_ERROR), child.half);
    let steep = abs(ray_inverse);
    let middle = fused3(child.center, ray_inverse, -ray_offset);
    let enter = fused3(-half, steep, middle);
    let leave = fused3(half, steep, middle);
    return vec2<f32>(
        max(max(max(enter.x, 0.0), enter.y), enter.z),
        min(min(min(leave.x, F32_MAX), leave.y), leave.z),
    );
}
