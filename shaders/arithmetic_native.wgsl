// Arithmetic as the adapter has it: a fused multiply-add, and quotients and roots to a few last places.

fn fused(a: f32, b: f32, c: f32) -> f32 {
    return fma(a, b, c);
}

fn fused3(a: vec3<f32>, b: vec3<f32>, c: vec3<f32>) -> vec3<f32> {
    return fma(a, b, c);
}

fn quotient(a: f32, b: f32) -> f32 {
    return a / b;
}

fn root(a: f32) -> f32 {
    return sqrt(a);
}
