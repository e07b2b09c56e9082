// Arithmetic rounded once, by way of double precision: for software adapters, whose `fma` may round twice and whose
// quotients may be off by a last place. Twice rounded sums differ from a fused operation about once in 2^29.

fn fused(a: f32, b: f32, c: f32) -> f32 {
    return f32(f64(a) * f64(b) + f64(c));
}

fn fused3(a: vec3<f32>, b: vec3<f32>, c: vec3<f32>) -> vec3<f32> {
    return vec3<f32>(vec3<f64>(a) * vec3<f64>(b) + vec3<f64>(c));
}

fn quotient(a: f32, b: f32) -> f32 {
    return f32(f64(a) / f64(b));
}

fn root(a: f32) -> f32 {
    return f32(sqrt(f64(a)));
}
