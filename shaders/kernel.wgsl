// Every ray of a batch through its cut, one lane a ray (paper, section 4.4, figure 7). Twin: engine/src/trace/kernel.rs.
//
// A lane goes down the tree with a short stack of nodes whose children it has yet to visit. Hits add up as whole numbers, in
// any order; so what does not fit the stack, or is left when the lane has taken its share of steps, is put on a list of
// items, which later dispatches resume, as are rays that meet a brick which is not in the arena.

const NO_LEAF: u32 = 0xffffffffu;
const STACK_ENTRIES: u32 = 12u;
// Children that a lane visits between leaf tests at most
const STEPS_PER_TURN: u32 = 4u;
// Places of bricks that are nowhere
const MISSING: u32 = 0xffffffffu;
const NOT_IN_CUT: u32 = 0xfffffffeu;

@group(1) @binding(6) var<storage, read> items_in: ItemsRead;
@group(1) @binding(7) var<storage, read_write> items_out: Items;

var<workgroup> workgroup_nodes: atomic<u32>;
var<workgroup> workgroup_leaf_rays: atomic<u32>;

struct ItemsRead {
    counts: array<u32, 4>,
    list: array<Item>,
}

var<private> ray_index: u32;
var<private> ray_origin: vec3<i32>;
var<private> ray_direction: vec3<f32>;
var<private> ray_inverse: vec3<f32>;
var<private> ray_offset: vec3<f32>;
var<private> ray_limit: u32;
var<private> group_reference: vec3<i32>;
var<private> group_lower: vec3<f32>;
var<private> group_upper: vec3<f32>;

// Extinction that this lane has added
var<private> total: u32;
// Extinction of the ray before
var<private> before: u32;
var<private> is_active: bool;
var<private> steps: u32;
var<private> spilled: u32;
var<private> counted_nodes: u32;
var<private> counted_leaf_rays: u32;

// The node whose children are visited, and those to come: 3 bits each, the next one lowest, their number from bit 24 on
var<private> current_line: u32;
var<private> current_order: u32;
var<private> stack: array<vec2<u32>, 12>;
var<private> stack_top: u32;
var<private> stack_count: u32;
// The leaf that the lane has come to: child `leaf_slot` of the node at `leaf_line`
var<private> leaf_line: u32;
var<private> leaf_slot: u32;

fn location(line: u32, slot: u32) -> u32 {
    return child_bits(line, slot) & ((1u << LOCATION_BITS) - 1u);
}

fn child_bits(line: u32, slot: u32) -> u32 {
    return (word(line * WORDS_PER_LINE + 4u + slot / 2u) >> (16u * (slot & 1u))) & 0xffffu;
}

fn begin_ray(index: u32) {
    ray_index = index;
    let point = points[index / batch.samples];
    let sample = index % batch.samples;
    let group = groups[point.group];
    group_reference = group.reference;
    group_lower = group.lower;
    group_upper = group.upper;
    ray_origin = point.origin;
    ray_direction = direction(point, sample);
    ray_limit = limit(point, sample);
    // A component of zero would make 0 * infinity; a tiny one is as good
    let tiny = bitcast<vec3<f32>>((bitcast<vec3<u32>>(ray_direction) & vec3<u32>(0x80000000u)) | vec3<u32>(0x219392efu));
    let d = select(ray_direction, tiny, abs(ray_direction) < vec3<f32>(1e-18));
    ray_inverse = vec3<f32>(quotient(1.0, d.x), quotient(1.0, d.y), quotient(1.0, d.z));
    ray_offset = vec3<f32>(ray_origin - group_reference) * ray_inverse;
    total = 0u;
    before = 0u;
    steps = 0u;
    spilled = 0u;
    counted_nodes = 0u;
    counted_leaf_rays = 0u;
    current_order = 0u;
    stack_top = 0u;
    stack_count = 0u;
    leaf_slot = NO_LEAF;
    is_active = true;
}

fn extinguish(extinction: u32) {
    total += extinction;
    if before + total > ray_limit {
        is_active = false;
        leaf_slot = NO_LEAF;
    }
}

fn meet_faces(leaf: Leaf, faces: u32) {
    if faces != 0u {
        extinguish(faces_extinction(leaf, faces));
    }
}

fn meet_triangles(leaf: Leaf, triangles: u32, near: u32) {
    if near == 0u {
        meet_faces(leaf, faces_of_triangles(leaf, triangles));
    } else {
        meet_faces(leaf, retested_faces(leaf, triangles, near));
    }
}

// Puts something on the list of items
fn spill(line: u32, order: u32) {
    spilled += 1u;
    let at = atomicAdd(&items_out.count, 1u);
    if at < batch.capacity {
        items_out.list[at] = Item(ray_index, line, order);
        if order == WAITS_FOR_BRICK {
            atomicAdd(&items_out.waiting, 1u);
        }
    }
}

// Puts the current node aside for another one
fn push(line: u32, order: u32) {
    if (current_order >> 24u) != 0u {
        if stack_count == STACK_ENTRIES {
            // The oldest entry is the one that the ring comes to next
            let oldest = stack[stack_top];
            spill(oldest.x, oldest.y);
            stack_count -= 1u;
        }
        stack[stack_top] = vec2<u32>(current_line, current_order);
        stack_top = (stack_top + 1u) % STACK_ENTRIES;
        stack_count += 1u;
    }
    current_line = line;
    current_order = order;
}

fn pop() -> bool {
    if stack_count == 0u {
        return false;
    }
    stack_top = (stack_top + STACK_ENTRIES - 1u) % STACK_ENTRIES;
    stack_count -= 1u;
    current_line = stack[stack_top].x;
    current_order = stack[stack_top].y;
    return true;
}

// Tests the ray against a node's children: far fields add up, those to open come next, near ones first
fn visit(line: u32) {
    counted_nodes += 1u;
    let boxes = read_boxes(line);
    var keys = array<u32, 8>(
        0xffffffffu, 0xffffffffu, 0xffffffffu, 0xffffffffu, 0xffffffffu, 0xffffffffu, 0xffffffffu, 0xffffffffu
    );
    var opened = 0u;
    for (var slot = 0u; slot < boxes.count; slot++) {
        let child = child_box(boxes, slot);
        let passes = passage(child);
        let sizes = seen(child);
        if passes.x > passes.y || (batch.is_limited != 0u && sizes.x > batch.reach2) {
            continue;
        }
        if sizes.y < batch.open2 * sizes.x {
            let record = far_record(line, slot);
            if !must_open(record) {
                meet_far_field(record, child, passes);
                continue;
            }
        }
        // Squared distances are not negative: their bits are in their order
        var key = (bitcast<u32>(sizes.x) & 0xfffffff8u) | slot;
        for (var i = 0u; i < WIDTH; i++) {
            let other = keys[i];
            keys[i] = min(other, key);
            key = max(other, key);
        }
        opened += 1u;
    }
    if !is_active {
        return;
    }
    var order = opened << 24u;
    for (var i = 0u; i < WIDTH; i++) {
        order |= select(0u, (keys[i] & 7u) << (3u * i), i < opened);
    }
    push(line, order);
}

fn meet_far_field(record: vec2<u32>, child: ChildBox, passes: vec2<f32>) {
    let center = child.center - vec3<f32>(ray_origin - group_reference);
    extinguish(far_extinction(record, center, child.half, passes));
}

// Goes on to a brick's root; its far field stands in for it where it is not in the cut
fn enter_brick(line: u32, slot: u32, number: u32) {
    let place = places[number];
    if place == MISSING {
        spill(number, WAITS_FOR_BRICK);
    } else if place == NOT_IN_CUT {
        let child = child_box(read_boxes(line), slot);
        meet_far_field(far_record(line, slot), child, passage(child));
    } else {
        visit(place + BRICK_HEADER_LINES);
    }
}

// Starts at a brick's root, or waits for it
fn begin_brick(number: u32) {
    let place = places[number];
    if place >= NOT_IN_CUT {
        spill(number, WAITS_FOR_BRICK);
        is_active = false;
    } else {
        visit(place + BRICK_HEADER_LINES);
    }
}

// Visits the next child
fn advance() {
    if (current_order >> 24u) == 0u && !pop() {
        is_active = false;
        return;
    }
    if steps >= batch.budget {
        // The rest goes on in a later dispatch
        spill(current_line, current_order);
        while pop() {
            spill(current_line, current_order);
        }
        is_active = false;
        return;
    }
    steps += 1u;
    let line = current_line;
    let slot = current_order & 7u;
    current_order = ((current_order & 0xffffffu) >> 3u) | (((current_order >> 24u) - 1u) << 24u);
    let bits = child_bits(line, slot);
    let place = bits & ((1u << LOCATION_BITS) - 1u);
    switch bits >> LOCATION_BITS {
        case KIND_NODE: {
            visit(line + place / WORDS_PER_LINE);
        }
        case KIND_LEAF: {
            leaf_line = line;
            leaf_slot = slot;
        }
        case KIND_BRICK: {
            enter_brick(line, slot, word(line * WORDS_PER_LINE + place));
        }
        default: {}
    }
}

// Walks until all lanes have ended
fn walk(lane: u32, size: u32) {
    while any_lane(is_active) {
        for (var turn = 0u; turn < STEPS_PER_TURN; turn++) {
            if is_active && leaf_slot == NO_LEAF {
                advance();
            }
        }
        meet_leaves(lane, size);
    }
}

// Adds the lane's part to the ray's result; `done` is 1 for a new ray and takes 2 away for an item
fn end_ray(done: u32) {
    atomicAdd(&rays[ray_index].extinction, min(total, EXTINCTION_ENDED));
    atomicAdd(&rays[ray_index].state, 2u * spilled + done);
}

// Adds what the lanes of a workgroup counted to the dispatch's sums
fn add_counts(index: u32) {
    atomicAdd(&workgroup_nodes, counted_nodes);
    atomicAdd(&workgroup_leaf_rays, counted_leaf_rays);
    workgroupBarrier();
    if index == 0u {
        atomicAdd(&items_out.nodes, atomicLoad(&workgroup_nodes));
        atomicAdd(&items_out.leaf_rays, atomicLoad(&workgroup_leaf_rays));
    }
}

// New rays: a workgroup has neighbouring directions of one point
fn trace_slice(workgroup: u32, index: u32, lane: u32, size: u32) {
    let number = batch.first + workgroup;
    let point = number / batch.slices;
    let turn = (number % batch.slices) * 64u + index;
    let exists = point < batch.points && turn < batch.samples;
    begin_ray(min(point, batch.points - 1u) * batch.samples + sample_in_order(min(turn, batch.samples - 1u)));
    is_active = exists;
    if exists {
        begin_brick(batch.root);
    }
    walk(lane, size);
    if exists {
        end_ray(1u);
    }
    add_counts(index);
}

fn resume_item(item: Item) {
    begin_ray(item.ray);
    before = min(atomicLoad(&rays[item.ray].extinction), EXTINCTION_ENDED);
    if before <= ray_limit {
        if item.order == WAITS_FOR_BRICK {
            begin_brick(item.line);
        } else {
            current_line = item.line;
            current_order = item.order;
        }
        walk(0u, 1u);
    }
    end_ray(0xfffffffeu);
}
