// Rays that go on: a lane has an item of the list that an earlier dispatch has left.

@compute @workgroup_size(64)
fn resume(@builtin(global_invocation_id) invocation: vec3<u32>) {
    let at = batch.first + invocation.x;
    if at >= batch.items {
        return;
    }
    let item = items_in.list[at];
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
