// Real spherical harmonics. Twin: engine/src/shade/sh.rs, which has the meaning; the order of operations is its own.

const COEFFICIENTS_MAX: u32 = 36u;

var<private> basis: array<f32, 36>;

// Writes the bands² basis functions in direction `d`, a unit vector, to `basis`
fn evaluate(bands: u32, d: vec3<f32>) {
    let x = d.x;
    let y = d.y;
    let z = d.z;
    basis[0] = 0.28209479177387814;
    if bands == 1u {
        return;
    }
    basis[1] = 0.4886025119029199 * y;
    basis[2] = 0.4886025119029199 * z;
    basis[3] = 0.4886025119029199 * x;
    if bands == 2u {
        return;
    }
    // cN and sN are the real and imaginary parts of (x + iy)^N.
    let zz = z * z;
    let c2 = x * x - y * y;
    let s2 = 2.0 * x * y;
    let p21 = 1.0925484305920792 * z;
    basis[4] = 0.5462742152960396 * s2;
    basis[5] = p21 * y;
    basis[6] = 0.31539156525252005 * (3.0 * zz - 1.0);
    basis[7] = p21 * x;
    basis[8] = 0.5462742152960396 * c2;
    if bands == 3u {
        return;
    }
    let c3 = x * c2 - y * s2;
    let s3 = x * s2 + y * c2;
    let p31 = 0.4570457994644658 * (5.0 * zz - 1.0);
    let p32 = 1.445305721320277 * z;
    basis[9] = 0.5900435899266435 * s3;
    basis[10] = p32 * s2;
    basis[11] = p31 * y;
    basis[12] = 0.3731763325901154 * z * (5.0 * zz - 3.0);
    basis[13] = p31 * x;
    basis[14] = p32 * c2;
    basis[15] = 0.5900435899266435 * c3;
    if bands == 4u {
        return;
    }
    let c4 = x * c3 - y * s3;
    let s4 = x * s3 + y * c3;
    let p41 = 0.6690465435572892 * z * (7.0 * zz - 3.0);
    let p42 = 0.47308734787878004 * (7.0 * zz - 1.0);
    let p43 = 1.7701307697799304 * z;
    basis[16] = 0.6258357354491761 * s4;
    basis[17] = p43 * s3;
    basis[18] = p42 * s2;
    basis[19] = p41 * y;
    basis[20] = 0.10578554691520431 * ((35.0 * zz - 30.0) * zz + 3.0);
    basis[21] = p41 * x;
    basis[22] = p42 * c2;
    basis[23] = p43 * c3;
    basis[24] = 0.6258357354491761 * c4;
    if bands == 5u {
        return;
    }
    let c5 = x * c4 - y * s4;
    let s5 = x * s4 + y * c4;
    let p51 = 0.45294665119569694 * ((21.0 * zz - 14.0) * zz + 1.0);
    let p52 = 2.396768392486662 * z * (3.0 * zz - 1.0);
    let p53 = 0.4892382994352504 * (9.0 * zz - 1.0);
    let p54 = 2.0756623148810416 * z;
    basis[25] = 0.6563820568401701 * s5;
    basis[26] = p54 * s4;
    basis[27] = p53 * s3;
    basis[28] = p52 * s2;
    basis[29] = p51 * y;
    basis[30] = 0.11695032245342359 * z * ((63.0 * zz - 70.0) * zz + 15.0);
    basis[31] = p51 * x;
    basis[32] = p52 * c2;
    basis[33] = p53 * c3;
    basis[34] = p54 * c4;
    basis[35] = 0.6563820568401701 * c5;
}
