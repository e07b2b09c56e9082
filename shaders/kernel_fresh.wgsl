// New rays: a workgroup has neighbouring directions of one point.

@compute @workgroup_size(64)
fn trace(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(local_invocation_index) index: u32,
    LANE_BUILTINS
) {
    let number = batch.first + workgroup.x;
    let point = number / batch.slices;
    let turn = (number % batch.slices) * 64u + index;
    let exists = point < batch.points && turn < batch.samples;
    begin_ray(min(point, batch.points - 1u) * batch.samples + sample_in_order(min(turn, batch.samples - 1u)));
    is_active = false;
    if exists {
        is_active = true;
        current_line = 0u;
        current_order = 0u;
        begin_brick(batch.root);
    }
    walk(lane, size);
    if exists {
        end_ray(1u);
    }
}
