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
    // Quads across a tile
    columns: u32,
    bits: vec3<u32>,
    shift: u32,
    is_opaque: bool,
    // What packed coordinates are relative to
    origin: vec3<i32>,
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
    leaf.columns = 0u;
    var vertices = second;
    var columns_of_indices = 4u;
    switch leaf.kind {
        case LEAF_TILE: {
            leaf.faces = first * second;
            leaf.columns = second;
            vertices = (first + 1u) * (second + 1u);
            columns_of_indices = 0u;
        }
        case LEAF_TRIANGLES: {
            leaf.faces = first + 8u * (header >> 31u);
            columns_of_indices = 3u;
        }
        case LEAF_ROUND: {
            columns_of_indices = 2u;
        }
        default: {}
    }
    leaf.shift = (header >> 8u) & 31u;
    leaf.bits = vec3<u32>((header >> 13u) & 31u, (header >> 18u) & 31u, (header >> 23u) & 31u);
    leaf.is_opaque = ((header >> 30u) & 1u) == 0u;
    let shifts = vec3<u32>(leaf.shift);
    leaf.origin = (lower_corner(read_boxes(line), slot) >> shifts) << shifts;
    leaf.index_bits = select(4u, 5u, vertices > 16u);
    leaf.index_bytes = (leaf.faces * leaf.index_bits + 7u) / 8u;
    let bytes = (vertices * leaf.bits + vec3<u32>(7u)) / vec3<u32>(8u);
    let x = LEAF_HEADER_BYTES + columns_of_indices * leaf.index_bytes;
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

fn leaf_index(leaf: Leaf, face: u32, corner: u32) -> u32 {
    if leaf.columns > 0u {
        let wide = leaf.columns + 1u;
        let step = select(select(wide, wide + 1u, corner == 2u), corner, corner < 2u);
        return face + face / leaf.columns + step;
    }
    let byte = LEAF_HEADER_BYTES + corner * leaf.index_bytes;
    return leaf_bits(leaf, 8u * byte + face * leaf.index_bits, leaf.index_bits);
}

// The lattice coordinates of a vertex
fn leaf_vertex(leaf: Leaf, vertex: u32) -> vec3<i32> {
    let packed = vec3<u32>(
        leaf_bits(leaf, 8u * leaf.coordinates.x + vertex * leaf.bits.x, leaf.bits.x),
        leaf_bits(leaf, 8u * leaf.coordinates.y + vertex * leaf.bits.y, leaf.bits.y),
        leaf_bits(leaf, 8u * leaf.coordinates.z + vertex * leaf.bits.z, leaf.bits.z),
    );
    return leaf.origin + vec3<i32>(packed << vec3<u32>(leaf.shift));
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
