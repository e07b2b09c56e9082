// A preview file, read in pieces: the beginning first, which is a coarse picture of all of it, then nodes as they are
// wanted. Everything is checked before it is used. docs/formats-preview.md has the layout.

import { getRaw } from "/dashboard/api.js";

const FIRST_BYTES = 1 << 20;
const FIXED_BYTES = 152;
const NODE_BYTES = 24;
const NODES_MAX = 1 << 20;
const NODE_DATA_MAX = 256 << 10;
const MAGIC = "PNTRPRVW";
const VERSION = 2;

const CRC = Uint32Array.from({ length: 256 }, (_, byte) => {
  let value = byte;
  for (let bit = 0; bit < 8; bit += 1) value = value & 1 ? (value >>> 1) ^ 0xedb88320 : value >>> 1;
  return value;
});

/** CRC-32 of bytes. */
export function crc32(bytes) {
  let sum = ~0;
  for (let at = 0; at < bytes.length; at += 1) sum = CRC[(sum ^ bytes[at]) & 255] ^ (sum >>> 8);
  return ~sum >>> 0;
}

/** A preview of an output of a job. */
export class Preview {
  constructor(url) {
    this.url = url;
    this.loading = 0;
    this.received = 0;
  }

  async bytes(start, end) {
    const answer = await getRaw(this.url, { headers: { Range: `bytes=${start}-${end - 1}` } });
    const bytes = new Uint8Array(await answer.arrayBuffer());
    this.received += bytes.length;
    return bytes;
  }

  /** Reads header and directory. */
  async open() {
    let head = await this.bytes(0, FIRST_BYTES);
    const view = new DataView(head.buffer);
    if (head.length < FIXED_BYTES || String.fromCharCode(...head.subarray(0, 8)) !== MAGIC) throw new Error("the file is no preview");
    const version = view.getUint32(8, true);
    if (version < 1 || version > VERSION) throw new Error(`a preview of version ${version}, 1 to ${VERSION} wanted`);
    const [length, count] = [view.getUint32(12, true), view.getUint32(80, true)];
    if (count === 0 || count > NODES_MAX || length !== FIXED_BYTES + NODE_BYTES * count + 4) throw new Error("the preview's directory is damaged");
    if (length > head.length) {
      const rest = await this.bytes(head.length, length);
      const both = new Uint8Array(head.length + rest.length);
      both.set(head);
      both.set(rest, head.length);
      head = both;
    }
    this.head = head;
    const all = new DataView(head.buffer);
    if (crc32(head.subarray(0, length - 4)) !== all.getUint32(length - 4, true)) throw new Error("the preview's directory is damaged");
    this.header = decodeHeader(all, head);
    this.nodes = decodeNodes(all, this.header, count);
  }

  /** The records of a node's points; checked. */
  async points(node) {
    const end = node.offset + node.points * this.header.record;
    const bytes = end <= this.head.length ? this.head.subarray(node.offset, end) : await this.bytes(node.offset, end);
    if (bytes.length !== end - node.offset || crc32(bytes) !== node.crc) throw new Error("a node of the preview is damaged");
    return bytes;
  }
}

function decodeHeader(view, bytes) {
  const name = bytes.subarray(88, FIXED_BYTES);
  const end = name.indexOf(0);
  const flags = view.getUint8(84);
  const header = {
    corner: [16, 24, 32].map((at) => view.getFloat64(at, true)), edge: view.getFloat64(40, true),
    points: Number(view.getBigUint64(48, true)), baked: Number(view.getBigUint64(56, true)), metersPerUnit: view.getFloat64(64, true),
    zUp: view.getUint8(72) === 1, bands: view.getUint8(73), cosineWeighted: view.getUint8(74) === 1, sphere: view.getUint8(75) === 1,
    record: view.getUint32(76, true), hasNormals: (flags & 1) !== 0, hasAlbedo: (flags & 2) !== 0, hasError: (flags & 4) !== 0,
    attribute: new TextDecoder().decode(end < 0 ? name : name.subarray(0, end)),
  };
  const coefficients = header.bands * header.bands;
  if (header.bands < 1 || header.bands > 6 || header.record !== Math.ceil((14 + 2 * (coefficients + (header.hasError ? 1 : 0))) / 4) * 4 || !(header.edge > 0) || !header.corner.every(Number.isFinite)) throw new Error("the preview's header is impossible");
  return { ...header, coefficients };
}

/** The nodes with their cubes: the directory is level by level, so a node's children follow those of the nodes before it. */
function decodeNodes(view, header, count) {
  const nodes = [];
  let next = 1;
  for (let at = 0; at < count; at += 1) {
    const from = FIXED_BYTES + NODE_BYTES * at;
    const node = nodes[at] ?? (nodes[at] = { corner: header.corner, edge: header.edge });
    Object.assign(node, { index: at, offset: Number(view.getBigUint64(from, true)), points: view.getUint32(from + 8, true), spacing: view.getFloat32(from + 12, true), crc: view.getUint32(from + 16, true), mask: view.getUint8(from + 20), level: view.getUint8(from + 21), children: new Array(8).fill(null), state: "away" });
    if (node.points * header.record > NODE_DATA_MAX) throw new Error("a node of the preview is too large");
    for (let child = 0; child < 8; child += 1) {
      if (!((node.mask >> child) & 1)) continue;
      if (next >= count) throw new Error("the preview's nodes do not add up");
      const half = node.edge / 2;
      nodes[next] = { corner: node.corner.map((value, axis) => value + ((child >> axis) & 1) * half), edge: half };
      node.children[child] = nodes[next];
      next += 1;
    }
  }
  return nodes;
}
