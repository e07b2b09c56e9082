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
