// Leaf tests of one lane after the other: for adapters without subgroups, and for rays that no longer share an origin.

fn any_lane(value: bool) -> bool {
    return value;
}

// Tests the leaf that the lane has come to, if any
fn meet_leaves(lane: u32, size: u32) {
    if leaf_slot == NO_LEAF {
        return;
    }
    let leaf = read_leaf(leaf_line, leaf_slot);
    leaf_slot = NO_LEAF;
    counted_leaf_rays += 1u;
    if leaf.kind == LEAF_ROUND {
        meet_faces(leaf, round_faces(leaf));
        return;
    }
    var triangles = 0u;
    var near = 0u;
    for (var triangle = 0u; triangle < 16u; triangle++) {
        let met = meet_planes(triangle_planes(leaf, triangle), ray_direction);
        triangles |= (met & 1u) << triangle;
        near |= (met >> 1u) << triangle;
    }
    meet_triangles(leaf, triangles, near);
}

@compute @workgroup_size(64)
fn trace(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) index: u32) {
    trace_slice(workgroup.x, index, 0u, 1u);
}

// Rays that go on: a lane has an item of the list that an earlier dispatch has left
@compute @workgroup_size(64)
fn resume(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) index: u32) {
    let at = (batch.first + workgroup.x) * 64u + index;
    if at < batch.items {
        resume_item(items_in.list[at]);
    }
    add_counts(index);
}
