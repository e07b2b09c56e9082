// Directions and limits of rays. Twin: engine/src/shade/sample.rs, which has the meaning.

const SPREAD_HEMISPHERE: u32 = 0u;
const SPREAD_COSINE: u32 = 1u;
const SURVIVAL_TRANSMITTANCE: f32 = 0.1;
const EXTINCTION_PER_OCTAVE: u32 = 4096u;
const STRATA: u32 = 256u;

fn hash32(value: u32) -> u32 {
    var x = value;
    x ^= x >> 16u;
    x *= 0x7feb352du;
    x ^= x >> 15u;
    x *= 0x846ca68bu;
    return x ^ (x >> 16u);
}

// The top 24 bits of a hash as a number in [0, 1)
fn unit_f32(hash: u32) -> f32 {
    return f32(hash >> 8u) * (1.0 / 16777216.0);
}

fn table_f32(at: u32) -> f32 {
    return bitcast<f32>(tables[at]);
}

// The sample that the lane `i` of a point traces: neighbours in this order are neighbours in direction
fn sample_in_order(i: u32) -> u32 {
    return tables[2u * batch.samples + i];
}

fn direction(point: Point, sample: u32) -> vec3<f32> {
    let height = (f32(sample) + unit_f32(point.hash)) * batch.step;
    var z = 1.0 - height;
    if point.spread == SPREAD_COSINE {
        z = root(max(1.0 - height, 0.0));
    } else if point.spread != SPREAD_HEMISPHERE {
        z = 1.0 - 2.0 * height;
    }
    let radius = root(max(1.0 - z * z, 0.0));
    let c = table_f32(2u * sample);
    let s = table_f32(2u * sample + 1u);
    let x = radius * (c * point.cosine - s * point.sine);
    let y = radius * (c * point.sine + s * point.cosine);

    // Duff et al. 2017, as on the CPU
    let n = point.normal;
    let sign = select(1.0, -1.0, (bitcast<u32>(n.z) >> 31u) != 0u);
    let a = point.frame;
    let b = n.x * n.y * a;
    let tangent = vec3<f32>(1.0 + sign * n.x * n.x * a, sign * b, -sign * n.x);
    let bitangent = vec3<f32>(b, sign + n.y * n.y * a, -n.y);
    return x * tangent + y * bitangent + z * n;
}

// The extinction past which a ray ends
fn limit(point: Point, sample: u32) -> u32 {
    let threshold = hash32(point.hash ^ 0x02e5be93u);
    let stratum = (threshold + sample * 0x9e3779b9u) >> 24u;
    return tables[3u * batch.samples + stratum];
}

// What a ray counts that ended with the given extinction
fn visibility(extinction: u32, limit: u32) -> f32 {
    if extinction > limit {
        return 0.0;
    }
    if extinction == 0u {
        return 1.0;
    }
    let octaves = extinction / EXTINCTION_PER_OCTAVE;
    if octaves > 120u {
        return SURVIVAL_TRANSMITTANCE;
    }
    let fraction = table_f32(3u * batch.samples + STRATA + extinction % EXTINCTION_PER_OCTAVE);
    return max(fraction * bitcast<f32>((127u - octaves) << 23u), SURVIVAL_TRANSMITTANCE);
}
