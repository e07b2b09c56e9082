// What all kernels of a batch share: its numbers, its points, its tables, and the rays' results.

struct Batch {
    // A child whose squared diagonal is below this times its squared distance stays closed
    open2: f32,
    // Rays end after this many lattice steps, if `is_limited`
    reach: f32,
    reach2: f32,
    // Hits nearer than this are tested again in integers
    near: f32,
    // 1 / samples
    step: f32,
    // What one direction of each spread stands for
    measure_hemisphere: f32,
    measure_cosine: f32,
    measure_sphere: f32,
    is_limited: u32,
    samples: u32,
    // Workgroups that the rays of a point take
    slices: u32,
    // The first workgroup of this dispatch
    first: u32,
    // One past the last point of this dispatch
    points: u32,
    // Items of the input list
    items: u32,
    // Items that the output list has room for
    capacity: u32,
    // Steps after which a ray goes on in a later dispatch
    budget: u32,
    bands: u32,
    // The brick that rays start at
    root: u32,
    // Always 0, which compilers do not know
    zero: u32,
    unused: u32,
}

struct Point {
    // Lattice coordinates
    origin: vec3<i32>,
    group: u32,
    normal: vec3<f32>,
    hash: u32,
    // The rotation about the normal
    cosine: f32,
    sine: f32,
    // -1 / (sign(z) + z) of the normal
    frame: f32,
    spread: u32,
}

// Neighbouring points that decide together what to open, as a bundle does on the CPU
struct Group {
    reference: vec3<i32>,
    unused_a: u32,
    // Box of the origins, relative to the reference
    lower: vec3<f32>,
    unused_b: u32,
    upper: vec3<f32>,
    unused_c: u32,
}

struct Ray {
    extinction: atomic<u32>,
    // 1 when traced, plus 2 for each item that is to be resumed: 1 is complete
    state: atomic<u32>,
}

// What is left of a ray: the children of a node that it has yet to visit, or a brick that is not there
struct Item {
    ray: u32,
    line: u32,
    order: u32,
}

struct Items {
    count: atomic<u32>,
    // Those of them that wait for a brick
    waiting: atomic<u32>,
    // What the kernel counted: nodes, leaf tests of rays, leaf tests that lanes had room for
    nodes: atomic<u32>,
    leaf_rays: atomic<u32>,
    list: array<Item>,
}

// The `order` of an item that waits for the brick `line`
const WAITS_FOR_BRICK: u32 = 0xffffffffu;
// Extinction past which a ray of any limit has ended
const EXTINCTION_ENDED: u32 = 1u << 20u;

@group(1) @binding(0) var<uniform> batch: Batch;
// Where each brick is in units of 64 bytes
@group(1) @binding(1) var<storage, read> places: array<u32>;
@group(1) @binding(2) var<storage, read> points: array<Point>;
@group(1) @binding(3) var<storage, read> groups: array<Group>;
// Cosines and sines of the samples; the order to trace them in; limits; transmittances
@group(1) @binding(4) var<storage, read> tables: array<u32>;
@group(1) @binding(5) var<storage, read_write> rays: array<Ray>;

// The same number, in a way that keeps compilers from fusing the product that it is with a sum
fn separate(x: f32) -> f32 {
    return bitcast<f32>(bitcast<u32>(x) ^ batch.zero);
}

fn separate3(x: vec3<f32>) -> vec3<f32> {
    return bitcast<vec3<f32>>(bitcast<vec3<u32>>(x) ^ vec3<u32>(batch.zero));
}
