// Projection of the rays' results to spherical harmonics: one workgroup a point. Twin: engine/src/shade/sh_occlusion.rs.

// Rays of a piece at most: the CPU adds up so many at a time
const PIECE_RAYS: u32 = 2048u;
const LANES: u32 = 64u;

struct Results {
    // Bit i: point i is complete
    coverage: array<atomic<u32>, 2048>,
    // bands² a point
    coefficients: array<f32>,
}

@group(1) @binding(8) var<storage, read_write> results: Results;

var<workgroup> products: array<f32, 2304>;
var<workgroup> incomplete: atomic<u32>;

@compute @workgroup_size(64)
fn project(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let index = batch.first + workgroup.x;
    let point = points[index];
    let count = batch.bands * batch.bands;
    let measure = select(
        select(batch.measure_sphere, batch.measure_cosine, point.spread == SPREAD_COSINE),
        batch.measure_hemisphere,
        point.spread == SPREAD_HEMISPHERE,
    );
    var sum = 0.0;
    var total = 0.0;
    for (var base = 0u; base < batch.samples; base += LANES) {
        // Every lane evaluates one ray
        let sample = base + lane;
        var weight = 0.0;
        if sample < batch.samples {
            let ray = index * batch.samples + sample;
            if atomicLoad(&rays[ray].state) != 1u {
                atomicAdd(&incomplete, 1u);
            }
            weight = visibility(atomicLoad(&rays[ray].extinction), limit(point, sample));
            evaluate(batch.bands, direction(point, sample));
        }
        for (var i = 0u; i < count; i++) {
            products[lane * count + i] = separate(weight * basis[i]);
        }
        workgroupBarrier();
        // Every lane that has a coefficient adds up the rays in their order: the same sum whatever the adapter
        if lane < count {
            let end = min(LANES, batch.samples - base);
            for (var i = 0u; i < end; i++) {
                sum += products[i * count + lane];
            }
        }
        workgroupBarrier();
        if (base + LANES) % PIECE_RAYS == 0u {
            total += separate(measure * sum);
            sum = 0.0;
        }
    }
    if batch.samples % PIECE_RAYS != 0u {
        total += separate(measure * sum);
    }
    if lane < count {
        results.coefficients[index * count + lane] = total;
    }
    if lane == 0u && atomicLoad(&incomplete) == 0u {
        atomicOr(&results.coverage[index / 32u], 1u << (index % 32u));
    }
}
