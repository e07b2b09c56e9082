// Real spherical harmonics as the bake has them: orthonormal, index l(l+1)+m, no Condon-Shortley phase; and the product of
// light, visibility and clamped cosine. docs/relight.md has the mathematics; this is the same to rounding.

/** The clamped cosine's bands, A_l, over π: what a diffuse reflector makes of them. */
const COSINE = [1, 2 / 3, 1 / 4, 0, -1 / 24, 0];

/** The basis functions of so many bands in a unit direction. */
export function basis(bands, x, y, z, out = new Float64Array(36)) {
  out[0] = 0.28209479177387814;
  if (bands === 1) return out;
  out[1] = 0.4886025119029199 * y;
  out[2] = 0.4886025119029199 * z;
  out[3] = 0.4886025119029199 * x;
  if (bands === 2) return out;
  const zz = z * z;
  const c2 = x * x - y * y;
  const s2 = 2 * x * y;
  const p21 = 1.0925484305920792 * z;
  out[4] = 0.5462742152960396 * s2;
  out[5] = p21 * y;
  out[6] = 0.31539156525252005 * (3 * zz - 1);
  out[7] = p21 * x;
  out[8] = 0.5462742152960396 * c2;
  if (bands === 3) return out;
  const c3 = x * c2 - y * s2;
  const s3 = x * s2 + y * c2;
  const p31 = 0.4570457994644658 * (5 * zz - 1);
  const p32 = 1.445305721320277 * z;
  out[9] = 0.5900435899266435 * s3;
  out[10] = p32 * s2;
  out[11] = p31 * y;
  out[12] = 0.3731763325901154 * z * (5 * zz - 3);
  out[13] = p31 * x;
  out[14] = p32 * c2;
  out[15] = 0.5900435899266435 * c3;
  if (bands === 4) return out;
  const c4 = x * c3 - y * s3;
  const s4 = x * s3 + y * c3;
  const p41 = 0.6690465435572892 * z * (7 * zz - 3);
  const p42 = 0.47308734787878004 * (7 * zz - 1);
  const p43 = 1.7701307697799304 * z;
  out[16] = 0.6258357354491761 * s4;
  out[17] = p43 * s3;
  out[18] = p42 * s2;
  out[19] = p41 * y;
  out[20] = 0.10578554691520431 * ((35 * zz - 30) * zz + 3);
  out[21] = p41 * x;
  out[22] = p42 * c2;
  out[23] = p43 * c3;
  out[24] = 0.6258357354491761 * c4;
  if (bands === 5) return out;
  const c5 = x * c4 - y * s4;
  const s5 = x * s4 + y * c4;
  const p51 = 0.45294665119569694 * ((21 * zz - 14) * zz + 1);
  const p52 = 2.396768392486662 * z * (3 * zz - 1);
  const p53 = 0.4892382994352504 * (9 * zz - 1);
  const p54 = 2.0756623148810416 * z;
  out[25] = 0.6563820568400701 * s5;
  out[26] = p54 * s4;
  out[27] = p53 * s3;
  out[28] = p52 * s2;
  out[29] = p51 * y;
  out[30] = 0.11695032245342359 * z * ((63 * zz - 70) * zz + 15);
  out[31] = p51 * x;
  out[32] = p52 * c2;
  out[33] = p53 * c3;
  out[34] = p54 * c4;
  out[35] = 0.6563820568400701 * c5;
  return out;
}

/** Nodes and weights of Gauss and Legendre, by Newton's iteration from Chebyshev's nodes. */
export function gaussLegendre(count) {
  return Array.from({ length: count }, (_, at) => {
    let x = Math.cos((Math.PI * (at + 0.75)) / (count + 0.5));
    let slope = 1;
    for (let step = 0; step < 20; step += 1) {
      let [before, value] = [1, x];
      for (let n = 2; n <= count; n += 1) [before, value] = [value, ((2 * n - 1) * x * value - (n - 1) * before) / n];
      slope = (count * (x * value - before)) / (x * x - 1);
      x -= value / slope;
    }
    return [x, 2 / ((1 - x * x) * slope * slope)];
  });
}

/** Directions and weights that integrate polynomials of a degree over the sphere exactly. */
function quadrature(degree) {
  const around = degree + 1;
  return gaussLegendre(Math.ceil((degree + 1) / 2)).flatMap(([z, weight]) => Array.from({ length: around }, (_, at) => {
    const [r, phi] = [Math.sqrt(1 - z * z), (2 * Math.PI * at) / around];
    return [r * Math.cos(phi), r * Math.sin(phi), z, (weight * 2 * Math.PI) / around];
  }));
}

const quadratures = new Map();

/**
 * What turns visibility into radiance: for each cosine coefficient k and visibility coefficient j three colours, in texels of
 * four numbers, row by row. `light` has 36 coefficients per colour in the map's frame, tapered already; `mapFromScene`
 * turns a direction. Cosine-weighted visibility has the cosine in it and one row.
 */
export function transfer({ light, lightBands, bands, cosineWeighted, mapFromScene, tint }) {
  const count = bands * bands;
  const rows = cosineWeighted ? 1 : count;
  const degree = lightBands - 1 + (bands - 1) * (cosineWeighted ? 1 : 2);
  if (!quadratures.has(degree)) quadratures.set(degree, quadrature(degree));
  const out = new Float32Array(4 * rows * count);
  const sums = new Float64Array(3 * rows * count);
  const [here, there] = [new Float64Array(36), new Float64Array(36)];
  const lights = lightBands * lightBands;
  for (const [x, y, z, weight] of quadratures.get(degree)) {
    basis(bands, x, y, z, here);
    basis(lightBands, ...mapFromScene(x, y, z), there);
    for (let color = 0; color < 3; color += 1) {
      let radiance = 0;
      for (let i = 0; i < lights; i += 1) radiance += light[color][i] * there[i];
      radiance *= weight * tint[color];
      for (let k = 0; k < rows; k += 1) {
        const row = radiance * (cosineWeighted ? 1 / Math.PI : here[k] * COSINE[Math.floor(Math.sqrt(k))]);
        for (let j = 0; j < count; j += 1) sums[color * rows * count + k * count + j] += row * here[j];
      }
    }
  }
  for (let at = 0; at < rows * count; at += 1) for (let color = 0; color < 3; color += 1) out[4 * at + color] = sums[color * rows * count + at];
  return { rows, count, texels: out };
}

/** Radiance of a white reflector: what the shader computes for a point, for the panel that names its numbers. */
export function radiance({ rows, count, texels }, bands, normal, visibility) {
  const y = rows === 1 ? [1] : normal ? basis(bands, ...normal) : [0.28209479177387814];
  const sum = [0, 0, 0];
  for (let k = 0; k < Math.min(rows, normal || rows === 1 ? rows : 1); k += 1) for (let j = 0; j < count; j += 1) for (let color = 0; color < 3; color += 1) sum[color] += y[k] * texels[4 * (k * count + j) + color] * visibility[j];
  return sum;
}
