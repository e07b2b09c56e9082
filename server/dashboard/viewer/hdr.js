// Radiance maps (.hdr): read a row at a time, projected to spherical harmonics with exact solid angles, in small bites so
// that the page stays awake.

import { basis } from "/dashboard/viewer/sh.js";

const BITE_MS = 12;
const PIXELS_MAX = 2 ** 27;

const breathe = () => new Promise((go) => setTimeout(go));

/** The header's end and the size that it says. */
function readHeader(bytes) {
  const text = new TextDecoder("latin1").decode(bytes.subarray(0, 4096));
  const found = text.match(/\n\n-Y (\d+) \+X (\d+)\n/);
  if (!/^#\?(RADIANCE|RGBE)/.test(text) || !found) throw new Error("the file is no Radiance map in the usual orientation (-Y +X)");
  const [height, width] = [Number(found[1]), Number(found[2])];
  if (width < 1 || height < 1 || width * height > PIXELS_MAX) throw new Error(`a map of ${width} × ${height} pixels`);
  return { width, height, at: found.index + found[0].length };
}

/** Reads rows of RGBE, packed or not. */
function* rows(bytes, { width, height, at }) {
  const row = new Uint8Array(4 * width);
  const short = () => new Error("the map ends too early");
  for (let y = 0; y < height; y += 1) {
    if (at + 4 > bytes.length) throw short();
    const packed = bytes[at] === 2 && bytes[at + 1] === 2 && bytes[at + 2] < 128 && width >= 8 && width < 32768;
    if (!packed) {
      if (at + 4 * width > bytes.length) throw short();
      row.set(bytes.subarray(at, at + 4 * width));
      at += 4 * width;
      yield row;
      continue;
    }
    at += 4;
    for (let channel = 0; channel < 4; channel += 1) {
      for (let x = 0; x < width; ) {
        if (at + 2 > bytes.length) throw short();
        const code = bytes[at++];
        const count = code > 128 ? code - 128 : code;
        if (count === 0 || x + count > width || (code <= 128 && at + count > bytes.length)) throw new Error("the map's rows are damaged");
        for (let i = 0; i < count; i += 1, x += 1) row[4 * x + channel] = code > 128 ? bytes[at] : bytes[at + i];
        at += code > 128 ? 1 : count;
      }
    }
    yield row;
  }
}

/** Thirty-six coefficients of each colour. */
export async function fromHdr(buffer) {
  const bytes = new Uint8Array(buffer);
  const header = readHeader(bytes);
  const light = [0, 1, 2].map(() => new Array(36).fill(0));
  const { width, height } = header;
  const out = new Float64Array(36);
  let y = 0;
  let start = performance.now();
  for (const row of rows(bytes, header)) {
    const [top, bottom] = [(Math.PI * y) / height, (Math.PI * (y + 1)) / height];
    const solid = ((Math.cos(top) - Math.cos(bottom)) * 2 * Math.PI) / width;
    const theta = (top + bottom) / 2;
    const [sin, up] = [Math.sin(theta), Math.cos(theta)];
    for (let x = 0; x < width; x += 1) {
      const exponent = row[4 * x + 3];
      if (exponent === 0) continue;
      const scale = solid * 2 ** (exponent - 136);
      const phi = ((x + 0.5) / width - 0.5) * 2 * Math.PI;
      basis(6, sin * Math.sin(phi), up, -sin * Math.cos(phi), out);
      for (let color = 0; color < 3; color += 1) {
        const value = scale * row[4 * x + color];
        for (let i = 0; i < 36; i += 1) light[color][i] += value * out[i];
      }
      if ((x & 255) === 255 && performance.now() - start > BITE_MS) {
        await breathe();
        start = performance.now();
      }
    }
    y += 1;
  }
  return light;
}
