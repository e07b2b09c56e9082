// Leaves: the layout and the plain decoder. Twin: engine/src/brick/leaf.

const LEAF_QUADS: u32 = 0u;
const LEAF_TRIANGLES: u32 = 1u;
const LEAF_ROUND: u32 = 2u;
const LEAF_TILE: u32 = 3u;
const LEAF_HEADER_BYTES: u32 = 4u;

struct Leaf {
    // Address in words
    word: u32,
    kind: u32,
    faces: u32,
    vertices: u32,
    // Quads across a tile
    columns: u32,
    // Vertices from one row of quads to the next; 0 where faces have an index for every corner
    stride: u32,
    bits: vec3<u32>,
    // Of what is stored between the corners of a predicted tile
    is_predicted: bool,
    rest_bits: vec3<u32>,
    shift: u32,
    is_opaque: bool,
    // What packed coordinates are relative to
    origin: vec3<i32>,
    // Byte offset
    indices: u32,
    index_bits: u32,
    index_bytes: u32,
    // Byte offsets
    coordinates: vec3<u32>,
    extinctions: u32,
    radii: u32,
}

fn read_leaf(line: u32, slot: u32) -> Leaf {
    var leaf: Leaf;
    leaf.word = line * WORDS_PER_LINE + location(line, slot);
    let header = word(leaf.word);
    leaf.kind = (header >> 28u) & 3u;
    let first = (header & 7u) + 1u;
    let second = ((header >> 3u) & 31u) + 1u;
    leaf.faces = first;
    leaf.vertices = second;
    leaf.columns = 0u;
    leaf.stride = 0u;
    leaf.is_predicted = false;
    leaf.rest_bits = vec3<u32>(0u);
    leaf.indices = LEAF_HEADER_BYTES;
    var columns_of_indices = 4u;
    let variant = (header >> 31u) != 0u;
    let more = word(leaf.word + 1u);
    switch leaf.kind {
        case LEAF_TILE: {
            leaf.faces = first * second;
            leaf.columns = second;
            leaf.stride = second + 1u;
            leaf.vertices = (first + 1u) * leaf.stride;
            columns_of_indices = 0u;
            if variant {
                leaf.is_predicted = true;
                leaf.rest_bits = vec3<u32>(more & 31u, (more >> 5u) & 31u, (more >> 10u) & 31u);
                leaf.indices += 2u;
            }
        }
        case LEAF_TRIANGLES: {
            leaf.faces = first + select(0u, 8u, variant);
            columns_of_indices = 3u;
        }
        case LEAF_ROUND: {
            columns_of_indices = 2u;
        }
        default: {
            if variant {
                leaf.stride = more & 255u;
                columns_of_indices = 1u;
                leaf.indices += 1u;
            }
        }
    }
    leaf.shift = (header >> 8u) & 31u;
    leaf.bits = vec3<u32>((header >> 13u) & 31u, (header >> 18u) & 31u, (header >> 23u) & 31u);
    leaf.is_opaque = ((header >> 30u) & 1u) == 0u;
    let shifts = vec3<u32>(leaf.shift);
    leaf.origin = (lower_corner(read_boxes(line), slot) >> shifts) << shifts;
    leaf.index_bits = select(4u, 5u, leaf.vertices > 16u);
    leaf.index_bytes = (leaf.faces * leaf.index_bits + 7u) / 8u;
    var coordinate_bits = leaf.vertices * leaf.bits;
    if leaf.is_predicted {
        coordinate_bits = 4u * leaf.bits + (leaf.vertices - 4u) * leaf.rest_bits;
    }
    let bytes = (coordinate_bits + vec3<u32>(7u)) / vec3<u32>(8u);
    let x = leaf.indices + columns_of_indices * leaf.index_bytes;
    leaf.coordinates = vec3<u32>(x, x + bytes.x, x + bytes.x + bytes.y);
    leaf.extinctions = leaf.coordinates.z + bytes.z;
    leaf.radii = leaf.extinctions + select(2u * leaf.faces, 0u, leaf.is_opaque);
    return leaf;
}

// `count` bits, at most 30, from bit `bit` of the leaf on
fn leaf_bits(leaf: Leaf, bit: u32, count: u32) -> u32 {
    let at = leaf.word + (bit >> 5u);
    let shift = bit & 31u;
    let both = (word(at) >> shift) | ((word(at + 1u) << 1u) << (31u - shift));
    return both & ((1u << count) - 1u);
}

fn stored_index(leaf: Leaf, face: u32, column: u32) -> u32 {
    let byte = leaf.indices + column * leaf.index_bytes;
    return leaf_bits(leaf, 8u * byte + face * leaf.index_bits, leaf.index_bits);
}

fn leaf_index(leaf: Leaf, face: u32, corner: u32) -> u32 {
    if leaf.stride == 0u {
        return stored_index(leaf, face, corner);
    }
    let step = select(select(leaf.stride, leaf.stride + 1u, corner == 2u), corner, corner < 2u);
    if leaf.columns > 0u {
        return face + face / leaf.columns + step;
    }
    return stored_index(leaf, face, 0u) + step;
}

// The lattice coordinates of a vertex
fn leaf_vertex(leaf: Leaf, vertex: u32) -> vec3<i32> {
    if leaf.is_predicted {
        return leaf.origin + (predicted_vertex(leaf, vertex) << vec3<u32>(leaf.shift));
    }
    return leaf.origin + vec3<i32>(packed_vertex(leaf, vertex) << vec3<u32>(leaf.shift));
}

// A vertex as it is stored; in a predicted tile, a corner by its number among the corners
fn packed_vertex(leaf: Leaf, vertex: u32) -> vec3<u32> {
    return vec3<u32>(
        leaf_bits(leaf, 8u * leaf.coordinates.x + vertex * leaf.bits.x, leaf.bits.x),
        leaf_bits(leaf, 8u * leaf.coordinates.y + vertex * leaf.bits.y, leaf.bits.y),
        leaf_bits(leaf, 8u * leaf.coordinates.z + vertex * leaf.bits.z, leaf.bits.z),
    );
}

// A vertex of a tile between its corners: bilinear between them, and what it differs by from that. Twin: leaf/predict.rs
fn predicted_vertex(leaf: Leaf, vertex: u32) -> vec3<i32> {
    let places = vec4<u32>(0u, leaf.stride - 1u, leaf.vertices - leaf.stride, leaf.vertices - 1u);
    let before = dot(select(vec4<u32>(0u), vec4<u32>(1u), places < vec4<u32>(vertex)), vec4<u32>(1u));
    if any(places == vec4<u32>(vertex)) {
        return vec3<i32>(packed_vertex(leaf, before));
    }
    let bit = 8u * leaf.coordinates + 4u * leaf.bits + (vertex - before) * leaf.rest_bits;
    let rest = vec3<i32>(
        signed_bits(leaf, bit.x, leaf.rest_bits.x),
        signed_bits(leaf, bit.y, leaf.rest_bits.y),
        signed_bits(leaf, bit.z, leaf.rest_bits.z),
    );
    let rows = leaf.vertices / leaf.stride - 1u;
    let across = (vertex % leaf.stride) * (256u / leaf.columns);
    let down = (vertex / leaf.stride) * (256u / rows);
    let first = vec3<i32>(packed_vertex(leaf, 0u));
    let width = vec3<i32>(packed_vertex(leaf, 1u)) - first;
    let below = vec3<i32>(packed_vertex(leaf, 2u));
    let height = below - first;
    let twist = vec3<i32>(packed_vertex(leaf, 3u)) - below - width;
    let sum = i32(across) * width + i32(down) * height + i32((across * down) >> 8u) * twist;
    return first + (sum >> vec3<u32>(8u)) + rest;
}

// `count` bits from bit `bit` of the leaf on, the highest of which is the sign
fn signed_bits(leaf: Leaf, bit: u32, count: u32) -> i32 {
    let unused = 32u - max(count, 1u);
    return bitcast<i32>(leaf_bits(leaf, bit, count) << unused) >> unused;
}

fn leaf_extinction(leaf: Leaf, face: u32) -> u32 {
    return leaf_bits(leaf, 8u * (leaf.extinctions + 2u * face), 16u);
}

fn leaf_radius(leaf: Leaf, vertex: u32) -> f32 {
    let bit = 8u * (leaf.radii + 4u * vertex);
    return bitcast<f32>(leaf_bits(leaf, bit, 16u) | (leaf_bits(leaf, bit + 16u, 16u) << 16u));
}

// What a ray loses that meets the faces in the mask
fn faces_extinction(leaf: Leaf, faces: u32) -> u32 {
    if leaf.is_opaque {
        return EXTINCTION_OPAQUE;
    }
    var sum = 0u;
    for (var rest = faces; rest != 0u; rest &= rest - 1u) {
        sum += stored_extinction(leaf_extinction(leaf, firstTrailingBit(rest)));
    }
    return sum;
}

// The faces whose triangles are met: a quad's triangles are eight lanes apart
fn faces_of_triangles(leaf: Leaf, triangles: u32) -> u32 {
    return select((triangles | (triangles >> 8u)) & 255u, triangles, leaf.kind == LEAF_TRIANGLES);
}

// A triangle as planes through the ray's origin and its edges; the volume is 0 where it cannot be met
struct Planes {
    normals: array<vec3<f32>, 3>,
    volume: f32,
}

// Products are kept apart from the difference: both faces of an edge get the same numbers with opposite signs
fn cross_apart(p: vec3<f32>, q: vec3<f32>) -> vec3<f32> {
    return separate3(p.yzx * q.zxy) - separate3(p.zxy * q.yzx);
}

fn triangle_planes(leaf: Leaf, triangle: u32) -> Planes {
    let is_quad = leaf.kind != LEAF_TRIANGLES;
    let face = select(triangle, triangle & 7u, is_quad);
    var planes: Planes;
    planes.volume = 0.0;
    if face >= leaf.faces {
        return planes;
    }
    let second = is_quad && triangle >= 8u;
    let first = leaf_vertex(leaf, leaf_index(leaf, face, 0u)) - ray_origin;
    let i = leaf_vertex(leaf, leaf_index(leaf, face, 1u)) - ray_origin;
    let j = leaf_vertex(leaf, leaf_index(leaf, face, 2u)) - ray_origin;
    var k = j;
    if is_quad {
        k = leaf_vertex(leaf, leaf_index(leaf, face, 3u)) - ray_origin;
    }
    // A face with a corner at the origin is not met, nor is the other half of its quad
    let zero = vec3<i32>(0);
    if all(first == zero) || all(i == zero) || all(j == zero) || all(k == zero) {
        return planes;
    }
    let a = vec3<f32>(first);
    let b = vec3<f32>(select(i, j, second));
    let c = vec3<f32>(select(j, k, second));
    let n = cross_apart(b, c);
    let volume = fused(a.z, n.z, fused(a.y, n.y, a.x * n.x));
    let sign = select(1.0, -1.0, (bitcast<u32>(volume) >> 31u) != 0u);
    planes.normals = array<vec3<f32>, 3>(cross_apart(a, b) * sign, n * sign, cross_apart(c, a) * sign);
    planes.volume = abs(volume);
    return planes;
}

fn edge_product(n: vec3<f32>, d: vec3<f32>) -> f32 {
    return fused(d.z, n.z, fused(d.y, n.y, d.x * n.x));
}

// Whether a ray along `d` meets a triangle, and whether within the near distance: bits 0 and 1
fn meet_planes(planes: Planes, d: vec3<f32>) -> u32 {
    if planes.volume == 0.0 {
        return 0u;
    }
    let edges = vec3<f32>(
        edge_product(planes.normals[0], d),
        edge_product(planes.normals[1], d),
        edge_product(planes.normals[2], d),
    );
    if any(edges < vec3<f32>(0.0)) {
        return 0u;
    }
    let sum = edges.x + edges.y + edges.z;
    if batch.is_limited != 0u && planes.volume > batch.reach * sum {
        return 0u;
    }
    return 1u | (u32(batch.near > 0.0 && planes.volume <= batch.near * sum) << 1u);
}
