// One preview on the GPU: which of its nodes are worth drawing at this moment, within a budget of points; what of them is
// still to be fetched; how they are drawn.

import { vectors } from "/dashboard/viewer/camera.js";
import { coefficientSlots, pointFragment, pointVertex } from "/dashboard/viewer/shaders.js";

const FETCHES_MAX = 4;
const { sub, dot } = vectors;

/** What can be shown, and the shader's number for it; bands begin at 10. */
export const SHOWS = { lit: 0, sky: 1, bent: 2, albedo: 3, normal: 4, error: 5 };

/** Compiles a program; its uniforms by name. */
export function compile(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(`a shader does not compile: ${gl.getShaderInfoLog(shader)}`);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(`a program does not link: ${gl.getProgramInfoLog(program)}`);
  const at = {};
  for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i += 1) {
    const { name } = gl.getActiveUniform(program, i);
    at[name.replace("[0]", "")] = gl.getUniformLocation(program, name);
  }
  return { program, at };
}

/** The projection times the rotation of a view, column by column; positions are relative to the eye. */
function clipMatrix(camera, aspect, near, far) {
  const [x, y, z] = camera.axes();
  const f = 1 / Math.tan((camera.fov * Math.PI) / 360);
  const [a, b] = [(far + near) / (near - far), (2 * far * near) / (near - far)];
  const rows = [x.map((v) => (v * f) / aspect), y.map((v) => v * f), z.map((v) => v * a), z.map((v) => -v)];
  return new Float32Array([rows[0][0], rows[1][0], rows[2][0], rows[3][0], rows[0][1], rows[1][1], rows[2][1], rows[3][1], rows[0][2], rows[1][2], rows[2][2], rows[3][2], 0, 0, b, 0]);
}

/** One preview on the GPU. */
export class Layer {
  constructor(gl, preview, changed) {
    Object.assign(this, { gl, preview, changed, fetching: 0, failed: null });
    const { header } = preview;
    this.program = compile(gl, pointVertex(header.bands, header.hasError), pointFragment);
    this.matrix = gl.createTexture();
    this.rows = 1;
    this.open = header.cosineWeighted ? 0.886227 : header.sphere ? 3.544908 : 1.772454;
    this.drawn = [];
    this.points = 0;
  }

  /** Sets the light's matrix. */
  light({ rows, count, texels }) {
    const { gl } = this;
    this.rows = rows;
    gl.bindTexture(gl.TEXTURE_2D, this.matrix);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, count, rows, 0, gl.RGBA, gl.FLOAT, texels);
    for (const what of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, what, gl.NEAREST);
  }

  /** Chooses nodes: the largest on the screen first, until the budget is spent or all are fine enough. */
  choose(camera, aspect, pixels, budget, fine) {
    const queue = [];
    const inView = this.viewTest(camera, aspect);
    const push = (node) => {
      if (!inView(node)) return;
      const middle = node.corner.map((value) => value + node.edge / 2);
      const away = Math.max(Math.hypot(...sub(middle, camera.eye)) - node.edge * 0.87, 1e-3 * node.edge);
      queue.push([(node.spacing * pixels) / away, node]);
      queue.sort((a, b) => a[0] - b[0]);
    };
    push(this.preview.nodes[0]);
    this.drawn = [];
    this.points = 0;
    let missing = [];
    while (queue.length > 0) {
      const [size, node] = queue.pop();
      if (this.points + node.points > budget && this.drawn.length > 0) break;
      if (node.state !== "here") {
        missing.push(node);
        this.points += node.points;
        continue;
      }
      node.shown = true;
      this.drawn.push(node);
      this.points += node.points;
      if (size > fine) node.children.forEach((child) => child && push(child));
    }
    missing.slice(0, FETCHES_MAX - this.fetching).forEach((node) => this.fetch(node));
    this.missing = missing.length;
  }

  /** Whether a node may be in view: its ball against the sides of the view. */
  viewTest(camera, aspect) {
    const [x, y, z] = camera.axes();
    const t = Math.tan((camera.fov * Math.PI) / 360);
    const sides = [[1, 0], [-1, 0], [0, 1], [0, -1]].map(([h, v]) => {
      const [across, wide] = h ? [x.map((c) => c * h), t * aspect] : [y.map((c) => c * v), t];
      const size = Math.hypot(1, wide);
      return across.map((c, axis) => (c + z[axis] * wide) / size);
    });
    return (node) => {
      const to = sub(node.corner.map((value) => value + node.edge / 2), camera.eye);
      return sides.every((side) => dot(side, to) < node.edge * 0.87);
    };
  }

  async fetch(node) {
    if (node.state !== "away") return;
    node.state = "coming";
    this.fetching += 1;
    try {
      node.bytes = await this.preview.points(node);
      this.upload(node);
      node.state = "here";
    } catch (problem) {
      node.state = "broken";
      this.failed = problem;
    }
    this.fetching -= 1;
    this.changed();
  }

  upload(node) {
    const { gl } = this;
    const { record, coefficients, hasError } = this.preview.header;
    node.array = gl.createVertexArray();
    gl.bindVertexArray(node.array);
    node.buffer = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, node.buffer);
    gl.bufferData(gl.ARRAY_BUFFER, node.bytes, gl.STATIC_DRAW);
    gl.vertexAttribPointer(0, 3, gl.UNSIGNED_SHORT, true, record, 0);
    gl.vertexAttribIPointer(1, 2, gl.SHORT, record, 6);
    gl.vertexAttribPointer(2, 4, gl.UNSIGNED_BYTE, true, record, 10);
    coefficientSlots(coefficients).forEach((size, slot) => gl.vertexAttribPointer(3 + slot, size, gl.HALF_FLOAT, false, record, 14 + 8 * slot));
    let attributes = 3 + coefficientSlots(coefficients).length;
    if (hasError) gl.vertexAttribPointer(attributes++, 1, gl.HALF_FLOAT, false, record, 14 + 2 * coefficients);
    for (let at = 0; at < attributes; at += 1) gl.enableVertexAttribArray(at);
    gl.bindVertexArray(null);
  }

  /** Gives the GPU's memory back. */
  end() {
    const { gl } = this;
    for (const node of this.preview.nodes) {
      if (!node.array) continue;
      gl.deleteVertexArray(node.array);
      gl.deleteBuffer(node.buffer);
    }
    gl.deleteTexture(this.matrix);
    gl.deleteProgram(this.program.program);
  }

  /** Draws the chosen nodes. */
  draw(camera, aspect, pixels, look, pick = false) {
    const { gl, program: { program, at } } = this;
    const { header } = this.preview;
    gl.useProgram(program);
    const far = Math.hypot(...sub(header.corner.map((value) => value + header.edge / 2), camera.eye)) + header.edge;
    gl.uniformMatrix4fv(at.u_clip, false, clipMatrix(camera, aspect, Math.max(far * 1e-5, Math.min(far * 1e-3, camera.distance() * 0.01)), far));
    gl.uniform1f(at.u_pixels, pixels);
    gl.uniform1f(at.u_exposure, 2 ** look.stops);
    gl.uniform1i(at.u_show, look.show.startsWith("band") ? 10 + Math.min(Number(look.show.slice(4)), header.bands - 1) : SHOWS[look.show] ?? 0);
    gl.uniform1i(at.u_rows, this.rows);
    gl.uniform1f(at.u_open, this.open);
    gl.uniform1i(at.u_sphere, header.sphere ? 1 : 0);
    gl.uniform1i(at.u_pick, pick ? 1 : 0);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.matrix);
    gl.uniform1i(at.u_matrix, 0);
    const shown = new Set(this.drawn);
    this.drawn.forEach((node, index) => {
      gl.uniform3fv(at.u_corner, sub(node.corner, camera.eye));
      gl.uniform1f(at.u_edge, node.edge);
      gl.uniform1fv(at.u_spacing, node.children.map((child) => (child && shown.has(child) ? child.spacing : node.spacing)));
      gl.uniform1i(at.u_node, index + 1);
      gl.bindVertexArray(node.array);
      gl.drawArrays(gl.POINTS, 0, node.points);
    });
    gl.bindVertexArray(null);
  }

  /** Everything about a point of a node. */
  point(node, number) {
    const { header } = this.preview;
    const view = new DataView(node.bytes.buffer, node.bytes.byteOffset + number * header.record, header.record);
    const place = [0, 1, 2].map((axis) => node.corner[axis] + (node.edge * view.getUint16(2 * axis, true)) / 65535);
    const code = [view.getInt16(6, true), view.getInt16(8, true)];
    const visibility = Array.from({ length: header.coefficients }, (_, at) => half(view.getUint16(14 + 2 * at, true)));
    const error = header.hasError ? half(view.getUint16(14 + 2 * header.coefficients, true)) : null;
    return { place, normal: code[0] === -32768 ? null : unfold(code), albedo: [0, 1, 2].map((at) => linear(view.getUint8(10 + at))), visibility, error };
  }
}

const linear = (byte) => (byte / 255 <= 0.04045 ? byte / 255 / 12.92 : ((byte / 255 + 0.055) / 1.055) ** 2.4);

function half(bits) {
  const [sign, exponent, fraction] = [bits >> 15 ? -1 : 1, (bits >> 10) & 31, bits & 1023];
  if (exponent === 0) return sign * fraction * 2 ** -24;
  return exponent === 31 ? (fraction ? NaN : sign * Infinity) : sign * (1 + fraction / 1024) * 2 ** (exponent - 15);
}

function unfold([a, b]) {
  let [x, y] = [a / 32767, b / 32767];
  const z = 1 - Math.abs(x) - Math.abs(y);
  const fold = Math.max(-z, 0);
  x -= x < 0 ? -fold : fold;
  y -= y < 0 ? -fold : fold;
  const size = Math.hypot(x, y, z);
  return [x / size, y / size, z / size];
}
