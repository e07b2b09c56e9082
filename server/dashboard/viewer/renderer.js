// Draws previews: one, two side by side, or their difference; and finds what lies under the pointer.

import { Layer, compile } from "/dashboard/viewer/layer.js";
import { differenceFragment, wholeVertex } from "/dashboard/viewer/shaders.js";

/** Everything on the canvas: one layer, or two side by side or as their difference. */
export class Renderer {
  constructor(canvas, changed) {
    this.canvas = canvas;
    this.gl = canvas.getContext("webgl2", { antialias: false, alpha: true, premultipliedAlpha: true, powerPreference: "high-performance" });
    if (!this.gl) throw new Error("this browser has no WebGL 2, or it is turned off");
    this.changed = changed;
    this.layers = [];
    this.float = this.gl.getExtension("EXT_color_buffer_float") !== null;
    this.targets = [];
  }

  add(preview) {
    const layer = new Layer(this.gl, preview, this.changed);
    this.layers.push(layer);
    return layer;
  }

  /** Puts another preview in the place of a layer's, once it has something to show. */
  async replace(layer, preview, prepare) {
    const next = new Layer(this.gl, preview, this.changed);
    prepare(next);
    await next.fetch(preview.nodes[0]);
    if (next.failed) throw next.failed;
    this.layers[this.layers.indexOf(layer)] = next;
    layer.end();
  }

  /** Which layers are drawn where: rectangles in pixels. */
  views(mode) {
    const { width, height } = this.canvas;
    if (this.layers.length < 2 || mode === "one") return [[this.layers[0], [0, 0, width, height]]];
    if (mode === "difference") return this.layers.map((layer) => [layer, [0, 0, width, height]]);
    const half = Math.floor(width / 2);
    return [[this.layers[0], [0, 0, half, height]], [this.layers[1], [half, 0, width - half, height]]];
  }

  frame(camera, look, budget) {
    const { gl, canvas } = this;
    const scale = Math.min(devicePixelRatio, 2);
    const [width, height] = [Math.round(canvas.clientWidth * scale), Math.round(canvas.clientHeight * scale)];
    if (canvas.width !== width || canvas.height !== height) {
      canvas.width = width;
      canvas.height = height;
      this.targets.forEach((target) => target.end());
      this.targets = [];
    }
    if (!width || !height) return;
    gl.enable(gl.DEPTH_TEST);
    gl.clearColor(0, 0, 0, 0);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const views = this.views(look.compare);
    const difference = look.compare === "difference" && views.length === 2;
    views.forEach(([layer, [x, y, w, h]], at) => {
      const pixels = h / (2 * Math.tan((camera.fov * Math.PI) / 360));
      layer.choose(camera, w / h, pixels, budget / views.length, 1.2);
      if (difference) {
        this.targets[at] ??= this.makeTarget(width, height);
        gl.bindFramebuffer(gl.FRAMEBUFFER, this.targets[at].buffer);
        gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      }
      gl.viewport(x, y, w, h);
      layer.draw(camera, w / h, pixels, look);
    });
    if (difference) this.drawDifference(look);
    this.last = { camera, look };
  }

  makeTarget(width, height) {
    const { gl } = this;
    const [texture, depth, buffer] = [gl.createTexture(), gl.createRenderbuffer(), gl.createFramebuffer()];
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, this.float ? gl.RGBA16F : gl.RGBA8, width, height);
    for (const what of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, what, gl.NEAREST);
    gl.bindRenderbuffer(gl.RENDERBUFFER, depth);
    gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, depth);
    return { texture, buffer, end: () => { gl.deleteTexture(texture); gl.deleteRenderbuffer(depth); gl.deleteFramebuffer(buffer); } };
  }

  drawDifference(look) {
    const { gl } = this;
    this.difference ??= compile(gl, wholeVertex, differenceFragment);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.disable(gl.DEPTH_TEST);
    gl.useProgram(this.difference.program);
    this.targets.forEach(({ texture }, at) => {
      gl.activeTexture(gl.TEXTURE0 + at);
      gl.bindTexture(gl.TEXTURE_2D, texture);
    });
    gl.uniform1i(this.difference.at.u_first, 0);
    gl.uniform1i(this.difference.at.u_second, 1);
    gl.uniform1f(this.difference.at.u_gain, look.gain);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /** The point under a place of the canvas, in CSS pixels, or the nearest to it. */
  pick(x, y) {
    const { gl, canvas, last } = this;
    if (!last) return null;
    const scale = canvas.width / canvas.clientWidth;
    const [px, py] = [Math.round(x * scale), Math.round(canvas.height - y * scale)];
    const target = this.makeTarget8(canvas.width, canvas.height);
    let found = null;
    for (const [layer, [vx, vy, w, h]] of this.views(last.look.compare)) {
      if (px < vx || px >= vx + w) continue;
      gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
      gl.viewport(vx, vy, w, h);
      gl.enable(gl.DEPTH_TEST);
      gl.clearColor(0, 0, 0, 0);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      layer.draw(last.camera, w / h, h / (2 * Math.tan((last.camera.fov * Math.PI) / 360)), last.look, true);
      const around = 6;
      const size = 2 * around + 1;
      const ids = new Uint8Array(4 * size * size);
      gl.readPixels(px - around, py - around, size, size, gl.RGBA, gl.UNSIGNED_BYTE, ids);
      let best = Infinity;
      for (let at = 0; at < size * size; at += 1) {
        const index = ids[4 * at] + 256 * ids[4 * at + 1];
        const away = (at % size - around) ** 2 + (Math.floor(at / size) - around) ** 2;
        if (index === 0 || away >= best) continue;
        best = away;
        found = { layer, ...layer.point(layer.drawn[index - 1], ids[4 * at + 2] + 256 * ids[4 * at + 3]) };
      }
      break;
    }
    target.end();
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    return found;
  }

  makeTarget8(width, height) {
    const { float } = this;
    this.float = false;
    const target = this.makeTarget(width, height);
    this.float = float;
    return target;
  }

  /** Gives the GPU's memory back. */
  end() {
    this.gl.getExtension("WEBGL_lose_context")?.loseContext();
  }
}
