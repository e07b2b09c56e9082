// The second look at near hits, in integers on the lattice. Twin: engine/src/brick/intersect.rs, which uses double precision:
// the signs are the same, since neither rounds where they are decided.

// A signed number of 96 bits, lowest word first
alias Wide = vec3<u32>;

// The 64 bits of a product
fn multiply(a: u32, b: u32) -> vec2<u32> {
    let al = a & 0xffffu;
    let ah = a >> 16u;
    let bl = b & 0xffffu;
    let bh = b >> 16u;
    let low = al * bl;
    let middle = ah * bl + (low >> 16u);
    let other = al * bh + (middle & 0xffffu);
    return vec2<u32>((other << 16u) | (low & 0xffffu), ah * bh + (middle >> 16u) + (other >> 16u));
}

fn negated(a: Wide) -> Wide {
    let x = ~a.x + 1u;
    let carry = u32(x == 0u);
    let y = ~a.y + carry;
    return Wide(x, y, ~a.z + u32(carry == 1u && y == 0u));
}

fn plus(a: Wide, b: Wide) -> Wide {
    let x = a.x + b.x;
    let carry = u32(x < a.x);
    let y = a.y + b.y;
    let z = y + carry;
    return Wide(x, z, a.z + b.z + u32(y < a.y) + u32(z < y));
}

fn is_negative(a: Wide) -> bool {
    return (a.z >> 31u) != 0u;
}

fn product(a: i32, b: i32) -> Wide {
    let words = multiply(u32(abs(a)), u32(abs(b)));
    let wide = Wide(words, 0u);
    return select_wide(wide, (a < 0) != (b < 0));
}

fn select_wide(wide: Wide, negate: bool) -> Wide {
    if negate {
        return negated(wide);
    }
    return wide;
}

// A number of at most 62 bits times one of 31
fn scaled(a: Wide, b: i32) -> Wide {
    let magnitude = select_wide(a, is_negative(a));
    let factor = u32(abs(b));
    let low = multiply(magnitude.x, factor);
    let high = multiply(magnitude.y, factor);
    let y = low.y + high.x;
    return select_wide(Wide(low.x, y, high.y + u32(y < low.y)), is_negative(a) != (b < 0));
}

// A vector of whole numbers that are too long for a word
struct WideVector {
    x: Wide,
    y: Wide,
    z: Wide,
}

fn cross_wide(p: vec3<i32>, q: vec3<i32>) -> WideVector {
    return WideVector(
        plus(product(p.y, q.z), negated(product(p.z, q.y))),
        plus(product(p.z, q.x), negated(product(p.x, q.z))),
        plus(product(p.x, q.y), negated(product(p.y, q.x))),
    );
}

fn dot_wide(a: WideVector, b: vec3<i32>) -> Wide {
    return plus(plus(scaled(a.x, b.x), scaled(a.y, b.y)), scaled(a.z, b.z));
}

// To the nearest number or its neighbour: for lengths, never for signs
fn wide_to_f32(a: Wide) -> f32 {
    let m = select_wide(a, is_negative(a));
    let value = (f32(m.z) * 4294967296.0 + f32(m.y)) * 4294967296.0 + f32(m.x);
    return select(value, -value, is_negative(a));
}

// Steps of the direction's fixed point
const DIRECTION_SCALE: f32 = 1073741824.0;

fn fixed_direction(d: vec3<f32>) -> vec3<i32> {
    return vec3<i32>(round(d * DIRECTION_SCALE));
}

// Whether a ray from zero along the fixed point direction `d` meets a triangle
fn meets_triangle(a: vec3<i32>, b: vec3<i32>, c: vec3<i32>, d: vec3<i32>) -> bool {
    let bc = cross_wide(b, c);
    let volume = dot_wide(bc, a);
    let flip = is_negative(volume);
    let e0 = select_wide(dot_wide(cross_wide(a, b), d), flip);
    let e1 = select_wide(dot_wide(bc, d), flip);
    let e2 = select_wide(dot_wide(cross_wide(c, a), d), flip);
    if all(volume == Wide(0u)) || is_negative(e0) || is_negative(e1) || is_negative(e2) {
        return false;
    }
    let sum = plus(plus(e0, e1), e2);
    if batch.is_limited != 0u {
        return abs(wide_to_f32(volume)) * DIRECTION_SCALE <= batch.reach * wide_to_f32(sum);
    }
    return any(sum != Wide(0u));
}

// Whether a ray meets a flat face of a leaf
fn meets_face(leaf: Leaf, face: u32, d: vec3<i32>) -> bool {
    let zero = vec3<i32>(0);
    let a = leaf_vertex(leaf, leaf_index(leaf, face, 0u)) - ray_origin;
    let b = leaf_vertex(leaf, leaf_index(leaf, face, 1u)) - ray_origin;
    let c = leaf_vertex(leaf, leaf_index(leaf, face, 2u)) - ray_origin;
    if all(a == zero) || all(b == zero) || all(c == zero) {
        return false;
    }
    if leaf.kind == LEAF_TRIANGLES {
        return meets_triangle(a, b, c, d);
    }
    let last = leaf_vertex(leaf, leaf_index(leaf, face, 3u)) - ray_origin;
    if all(last == zero) {
        return false;
    }
    return meets_triangle(a, b, c, d) || meets_triangle(a, c, last, d);
}

// The faces that are met when the near ones of `triangles` are looked at again
fn retested_faces(leaf: Leaf, triangles: u32, near: u32) -> u32 {
    var faces = faces_of_triangles(leaf, triangles & ~near);
    let d = fixed_direction(ray_direction);
    for (var rest = faces_of_triangles(leaf, near); rest != 0u; rest &= rest - 1u) {
        let face = firstTrailingBit(rest);
        if meets_face(leaf, face, d) {
            faces |= 1u << face;
        }
    }
    return faces;
}
