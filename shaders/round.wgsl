// Points and lines: spheres and round cones, in double precision where the adapter has it. Twin: engine/src/brick/intersect.rs.

alias Real3 = vec3<Real>;

fn real(x: f32) -> Real {
    return Real(x);
}

fn meets_sphere(center: Real3, radius: Real, d: Real3, reach: Real) -> bool {
    let along = dot3(center, d);
    let square = dot3(center, center) - radius * radius;
    let side = cross3(center, d);
    let beside = dot3(side, side);
    if square <= Real(0.0) || along <= Real(0.0) || beside > radius * radius {
        return false;
    }
    return along - sqrt(radius * radius - beside) <= reach;
}

fn dot3(a: Real3, b: Real3) -> Real {
    return (a.x * b.x) + (a.y * b.y) + (a.z * b.z);
}

fn cross3(a: Real3, b: Real3) -> Real3 {
    return Real3(a.y * b.z - b.y * a.z, a.z * b.x - b.z * a.x, a.x * b.y - b.x * a.y);
}

fn meets_cone(a: Real3, b: Real3, ra: Real, rb: Real, d: Real3, reach: Real) -> bool {
    let axis = b - a;
    let length2 = dot3(axis, axis);
    let dr = ra - rb;
    // One sphere holds the other
    if length2 <= dr * dr {
        if ra >= rb {
            return meets_sphere(a, ra, d, reach);
        }
        return meets_sphere(b, rb, d, reach);
    }
    if cone_distance(a, axis, length2, ra, dr) <= Real(0.0) {
        return false;
    }
    if meets_sphere(a, ra, d, reach) || meets_sphere(b, rb, d, reach) {
        return true;
    }
    let oa = -a;
    let m1 = dot3(axis, oa);
    let m2 = dot3(axis, d);
    let m3 = dot3(d, oa);
    let m5 = dot3(oa, oa);
    let d2 = length2 - dr * dr;
    let k2 = d2 - m2 * m2;
    let k1 = d2 * m3 - m1 * m2 + m2 * ra * dr;
    let k0 = d2 * m5 - m1 * m1 + Real(2.0) * m1 * ra * dr - length2 * ra * ra;
    let h = k1 * k1 - k0 * k2;
    if h < Real(0.0) || k2 == Real(0.0) {
        return false;
    }
    let rooted = sqrt(h);
    let y0 = m1 - ra * dr;
    return on_mantle((-rooted - k1) / k2, y0, m2, d2, reach) || on_mantle((rooted - k1) / k2, y0, m2, d2, reach);
}

fn on_mantle(t: Real, y0: Real, m2: Real, d2: Real, reach: Real) -> bool {
    let y = y0 + t * m2;
    return t > Real(0.0) && t <= reach && y > Real(0.0) && y < d2;
}

// Signed distance of zero from the hull's surface, negative inside
fn cone_distance(a: Real3, axis: Real3, length2: Real, ra: Real, dr: Real) -> Real {
    let length = sqrt(length2);
    let along = -dot3(a, axis) / length;
    let beside = sqrt(max(dot3(a, a) - along * along, Real(0.0)));
    let slope = dr / sqrt(length2 - dr * dr);
    let center = min(max(along - beside * slope, Real(0.0)), length);
    let across = along - center;
    return sqrt(across * across + beside * beside) - (ra - dr * center / length);
}

// The round faces that the ray meets
fn round_faces(leaf: Leaf) -> u32 {
    let d = Real3(ray_direction);
    var reach = Real(F32_MAX);
    if batch.is_limited != 0u {
        reach = real(batch.reach);
    }
    var faces = 0u;
    for (var face = 0u; face < leaf.faces; face++) {
        let i = leaf_index(leaf, face, 0u);
        let j = leaf_index(leaf, face, 1u);
        let a = Real3(leaf_vertex(leaf, i) - ray_origin);
        let ra = real(leaf_radius(leaf, i));
        var met = false;
        if i == j {
            met = meets_sphere(a, ra, d, reach);
        } else {
            let b = Real3(leaf_vertex(leaf, j) - ray_origin);
            met = meets_cone(a, b, ra, real(leaf_radius(leaf, j)), d, reach);
        }
        faces |= u32(met) << face;
    }
    return faces;
}
