// A camera that circles about what it looks at, upright in scenes of either up axis.

const sub = (a, b) => a.map((value, at) => value - b[at]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const scale = (a, by) => a.map((value) => value * by);
const add = (a, b) => a.map((value, at) => value + b[at]);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const length = (a) => Math.hypot(...a);
const unit = (a) => scale(a, 1 / (length(a) || 1));

/** Vectors for others. */
export const vectors = { sub, dot, scale, add, cross, length, unit };

export class Camera {
  constructor(zUp) {
    this.up = zUp ? [0, 0, 1] : [0, 1, 0];
    this.target = [0, 0, 0];
    this.eye = zUp ? [0, -1, 0] : [0, 0, 1];
    this.fov = 35;
  }

  /** Looks at a box from the front, a little from the right and above: as `pantaray relight` does. */
  frame(min, max, aspect) {
    const half = (this.fov * Math.PI) / 360;
    const narrow = aspect < 1 ? Math.atan(Math.tan(half) * aspect) : half;
    const radius = Math.max(0.5 * length(sub(max, min)), 1e-6);
    const back = unit(this.up[2] ? [0.45, -1, 0.4] : [0.45, 0.4, 1]);
    this.target = scale(add(min, max), 0.5);
    this.eye = add(this.target, scale(back, radius / Math.sin(narrow)));
    this.radius = radius;
  }

  /** Right, up and back of the view. */
  axes() {
    const back = unit(sub(this.eye, this.target));
    const right = unit(cross(this.up, back));
    return [right, cross(back, right), back];
  }

  distance() {
    return length(sub(this.eye, this.target));
  }

  /** Circles: radians to the left and up, never over the pole. */
  orbit(across, over) {
    const offset = sub(this.eye, this.target);
    const distance = length(offset);
    const height = Math.asin(Math.max(-1, Math.min(1, dot(offset, this.up) / distance)));
    const turned = Math.max(-1.55, Math.min(1.55, height + over));
    let flat = sub(offset, scale(this.up, dot(offset, this.up)));
    flat = unit(length(flat) > 1e-9 ? flat : cross(this.axes()[0], this.up));
    const side = cross(this.up, flat);
    const around = add(scale(flat, Math.cos(-across)), scale(side, Math.sin(-across)));
    this.eye = add(this.target, add(scale(around, distance * Math.cos(turned)), scale(this.up, distance * Math.sin(turned))));
  }

  /** Shifts by shares of the view's height. */
  pan(x, y) {
    const [right, up] = this.axes();
    const size = 2 * this.distance() * Math.tan((this.fov * Math.PI) / 360);
    const by = add(scale(right, -x * size), scale(up, y * size));
    this.eye = add(this.eye, by);
    this.target = add(this.target, by);
  }

  /** Comes nearer by a factor below 1. */
  zoom(factor) {
    const distance = Math.max(this.distance() * factor, 1e-4 * (this.radius ?? 1));
    this.eye = add(this.target, scale(unit(sub(this.eye, this.target)), distance));
  }

  /** Circles about another point. */
  lookAt(point) {
    const by = sub(point, this.target);
    this.eye = add(this.eye, by);
    this.target = point;
  }
}

/** Lets pointer, wheel and keys move a camera; `moved` is called after each change. */
export function steer(canvas, camera, { moved, light, clicked, reset }) {
  const pointers = new Map();
  let travelled = 0;
  const height = () => canvas.clientHeight || 1;
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, event);
    travelled = 0;
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const [x, y] = [event.clientX - before.clientX, event.clientY - before.clientY];
    travelled += Math.abs(x) + Math.abs(y);
    const others = [...pointers.values()].filter((other) => other.pointerId !== event.pointerId);
    pointers.set(event.pointerId, event);
    if (others.length > 0) {
      const apart = (point) => Math.hypot(point.clientX - others[0].clientX, point.clientY - others[0].clientY) || 1;
      camera.zoom(apart(before) / apart(event));
      camera.pan(x / height() / 2, y / height() / 2);
    } else if (event.altKey) light(-x * 0.5);
    else if (event.shiftKey || event.buttons & 2 || event.buttons & 4) camera.pan(x / height(), y / height());
    else camera.orbit((x / height()) * 4, (y / height()) * 3);
    moved();
  });
  const up = (event) => {
    if (pointers.delete(event.pointerId) && event.type === "pointerup" && travelled < 5 && event.button === 0) clicked(event);
  };
  canvas.addEventListener("pointerup", up);
  canvas.addEventListener("pointercancel", up);
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    camera.zoom(Math.exp(Math.max(-300, Math.min(300, event.deltaY)) * 0.0015));
    moved();
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const keys = { ArrowLeft: () => camera.orbit(0.1, 0), ArrowRight: () => camera.orbit(-0.1, 0), ArrowUp: () => camera.orbit(0, 0.1), ArrowDown: () => camera.orbit(0, -0.1), "+": () => camera.zoom(0.9), "=": () => camera.zoom(0.9), "-": () => camera.zoom(1.1), "[": () => light(-10), "]": () => light(10), r: reset, R: reset };
    if (!(event.key in keys) || event.ctrlKey || event.metaKey) return;
    event.preventDefault();
    keys[event.key]();
    moved();
  });
}
