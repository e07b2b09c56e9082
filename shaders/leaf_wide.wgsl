// Leaf tests by the lanes of a subgroup together (paper, section 4.4, figure 8): every lane sets up one triangle of a leaf,
// then the rays that wait for this leaf are tested one after the other, each against all triangles at once. Lanes share their
// origin, so that a triangle is set up once for all of them. Works with any number of lanes.

fn any_lane(value: bool) -> bool {
    return subgroupAny(value);
}

fn lane_is_set(ballot: vec4<u32>, lane: u32) -> bool {
    return ((ballot[lane >> 5u] >> (lane & 31u)) & 1u) != 0u;
}

fn first_lane(ballot: vec4<u32>) -> u32 {
    for (var i = 0u; i < 3u; i++) {
        if ballot[i] != 0u {
            return 32u * i + firstTrailingBit(ballot[i]);
        }
    }
    return 96u + firstTrailingBit(ballot[3]);
}

// The bits of a team's lanes, at most 16
fn team_bits(ballot: vec4<u32>, first: u32, width: u32) -> u32 {
    return (ballot[first >> 5u] >> (first & 31u)) & ((1u << width) - 1u);
}

// Tests the leaves that lanes have come to
fn meet_leaves(lane: u32, size: u32) {
    // Teams of up to 16 lanes test different rays against the same triangles
    let width = min(size, 16u);
    let team = lane & ~(width - 1u);
    let mine = lane & (width - 1u);
    loop {
        let waiting = subgroupBallot(leaf_slot != NO_LEAF);
        if all(waiting == vec4<u32>(0u)) {
            break;
        }
        let leader = first_lane(waiting);
        let line = subgroupShuffle(leaf_line, leader);
        let slot = subgroupShuffle(leaf_slot, leader);
        let is_tester = leaf_slot == slot && leaf_line == line;
        let testers = subgroupBallot(is_tester);
        let leaf = read_leaf(line, slot);
        var triangles = 0u;
        var near = 0u;
        if leaf.kind != LEAF_ROUND {
            for (var base = 0u; base < 16u; base += width) {
                let planes = triangle_planes(leaf, base + mine);
                for (var member = 0u; member < width; member++) {
                    var wanted = false;
                    for (var first = 0u; first < size; first += width) {
                        wanted = wanted || lane_is_set(testers, first + member);
                    }
                    if !wanted {
                        continue;
                    }
                    let d = subgroupShuffle(ray_direction, team + member);
                    let met = meet_planes(planes, d);
                    let hits = team_bits(subgroupBallot((met & 1u) != 0u), team, width);
                    let close = team_bits(subgroupBallot((met & 2u) != 0u), team, width);
                    if is_tester && mine == member {
                        triangles |= hits << base;
                        near |= close << base;
                    }
                }
            }
        }
        if is_tester {
            leaf_slot = NO_LEAF;
            counted_leaf_rays += 1u;
            if leaf.kind == LEAF_ROUND {
                meet_faces(leaf, round_faces(leaf));
            } else {
                meet_triangles(leaf, triangles, near);
            }
        }
    }
}

@compute @workgroup_size(64)
fn trace(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(local_invocation_index) index: u32,
    @builtin(subgroup_invocation_id) lane: u32,
    @builtin(subgroup_size) size: u32,
) {
    trace_slice(workgroup.x, index, lane, size);
}
