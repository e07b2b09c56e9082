// The segments of the bake passes along the Hilbert curve, coloured by state; a pattern goes with every colour.

import { get, query } from "/dashboard/api.js";
import { h, put } from "/dashboard/dom.js";
import { count, share } from "/dashboard/format.js";
import { total } from "/dashboard/words.js";

const PAGE = 1_000;
const SEGMENTS_MAX = 20_000;
const HEIGHT = 44;

/** The state that a segment shows: the one that matters most. */
function stateOf(counts) {
  if (counts.failed > 0) return "failed";
  if (counts.leased > 0) return "running";
  if (counts.done + counts.skipped === total(counts)) return counts.skipped > 0 ? "skipped" : "done";
  return counts.done > 0 ? "begun" : "ready";
}

/** All strips of a job. */
export class Strips {
  constructor(job) {
    this.job = job;
    this.element = h("section", { class: "panel", "aria-label": "Segments", hidden: true });
    this.strips = new Map();
    this.redraw = () => this.strips.forEach((strip) => strip.draw());
    this.recolor = () => this.strips.forEach((strip) => { strip.colors = null; strip.draw(); });
    addEventListener("theme", this.recolor);
    this.system = matchMedia("(prefers-color-scheme: dark)");
    this.system.addEventListener("change", this.recolor);
    this.resize = new ResizeObserver(this.redraw);
    this.resize.observe(this.element);
  }

  end() {
    removeEventListener("theme", this.recolor);
    this.system.removeEventListener("change", this.recolor);
    this.resize.disconnect();
  }

  async refresh(job) {
    const bakes = job.passes.filter((pass) => pass.kind === "bake" && total(pass.batches) > 0);
    this.element.hidden = bakes.length === 0;
    if (this.element.hidden) return;
    if (this.strips.size !== bakes.length) {
      this.strips = new Map(bakes.map((pass) => [pass.id, new Strip(pass)]));
      const keys = [["done", "done"], ["running", "running"], ["failed", "has failures"], ["begun", "begun"], ["skipped", "skipped"], ["ready", "ready"]];
      put(this.element, h("h2", {}, "Segments along the Hilbert curve"), [...this.strips.values()].map((strip) => strip.element),
        h("p", { class: "legend" }, keys.map(([state, word]) => h("span", {}, h("i", { class: `key key-${state}` }), word))));
    }
    await Promise.all(bakes.map(async (pass) => {
      const strip = this.strips.get(pass.id);
      const signature = JSON.stringify(pass.batches);
      if (strip.signature === signature) return;
      strip.signature = signature;
      strip.segments = await this.segments(pass);
      strip.draw();
    }));
  }

  async segments(pass) {
    const all = [];
    for (let after; all.length < SEGMENTS_MAX; after = all.at(-1).segment) {
      const page = await get(query(`/v1/jobs/${this.job}/passes/${pass.id}/segments`, { after, limit: PAGE }));
      all.push(...page);
      if (page.length < PAGE) break;
    }
    return all;
  }
}

class Strip {
  constructor(pass) {
    this.pass = pass;
    this.segments = [];
    this.at = 0;
    this.canvas = h("canvas", { height: HEIGHT, tabindex: "0", role: "img", "aria-label": `Segments of ${pass.name}; arrow keys go from one to the next`,
      onpointermove: (event) => this.point(this.find(event.offsetX)), onpointerleave: () => this.point(null),
      onkeydown: (event) => {
        const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
        if (!step) return;
        event.preventDefault();
        this.at = Math.max(0, Math.min(this.segments.length - 1, this.at + step));
        this.point(this.at);
      } });
    this.note = h("p", { class: "strip-note", role: "status" });
    this.element = h("div", { class: "strip" }, h("p", {}, h("strong", {}, pass.name)), this.canvas, this.note);
    this.point(null);
  }

  find(x) {
    const batches = this.segments.at(-1)?.end ?? 0;
    const batch = (x / this.canvas.clientWidth) * batches;
    const found = this.segments.findIndex((segment) => batch < segment.end);
    return found < 0 ? null : found;
  }

  point(index) {
    const segment = index === null ? null : this.segments[index];
    if (!segment) {
      put(this.note, h("span", { class: "quiet" }, "Each piece is a run of batches that lie close together. Point at one, or use the arrow keys."));
      this.draw();
      return;
    }
    this.at = index;
    const { batches } = segment;
    const counts = [["done", batches.done], ["running", batches.leased], ["ready", batches.ready], ["failed", batches.failed], ["skipped", batches.skipped]].filter(([, value]) => value > 0);
    put(this.note, h("strong", {}, `Segment ${segment.segment}`), `, batches ${count(segment.first)} to ${count(segment.end - 1)}: `, counts.map(([word, value]) => `${count(value)} ${word}`).join(", "), ` (${share(batches.done, total(batches))})`, segment.owner && [" · walked by ", h("a", { href: `/workers?search=${segment.owner}` }, segment.owner)]);
    this.draw(index);
  }

  /** The theme's colours: a canvas knows no variables. */
  readColors() {
    const read = (name) => {
      this.element.style.setProperty("color", `var(${name})`);
      return getComputedStyle(this.element).color;
    };
    const names = { done: "--done", running: "--running", failed: "--failed", skipped: "--skipped", ready: "--line", text: "--text", ground: "--raised" };
    const colors = Object.fromEntries(Object.entries(names).map(([key, name]) => [key, read(name)]));
    this.element.style.removeProperty("color");
    return colors;
  }

  /** What is drawn where: segments, or, where they are finer than the screen, what lies under each two pixels. */
  pieces(width) {
    const batches = this.segments.at(-1).end;
    const place = (batch) => (batch / batches) * width;
    if (width / this.segments.length >= 2) {
      const gap = width / this.segments.length > 4 ? 1 : 0;
      return this.segments.map((segment, at) => ({ x: place(segment.first), w: Math.max(place(segment.end) - place(segment.first) - gap, 1), batches: segment.batches, first: at, last: at }));
    }
    const columns = new Map();
    this.segments.forEach((segment, at) => {
      const x = 2 * Math.floor(place(segment.first) / 2);
      const column = columns.get(x) ?? { x, w: 2, batches: { ready: 0, leased: 0, done: 0, failed: 0, skipped: 0 }, first: at, last: at };
      for (const key of Object.keys(column.batches)) column.batches[key] += segment.batches[key];
      column.last = at;
      columns.set(x, column);
    });
    return [...columns.values()];
  }

  draw(marked = null) {
    const { canvas } = this;
    const width = canvas.clientWidth;
    if (!width || this.segments.length === 0) return;
    const scale = devicePixelRatio;
    canvas.width = width * scale;
    canvas.height = HEIGHT * scale;
    const context = canvas.getContext("2d");
    context.scale(scale, scale);
    const colors = (this.colors ??= this.readColors());
    this.pieces(width).forEach(({ x, w, batches, first, last }) => {
      const state = stateOf(batches);
      context.fillStyle = colors.ready;
      context.fillRect(x, 0, w, HEIGHT - 8);
      const done = (batches.done + batches.skipped) / total(batches);
      context.fillStyle = colors[state === "skipped" ? "skipped" : "done"];
      const high = (HEIGHT - 8) * done;
      context.fillRect(x, HEIGHT - 8 - high, w, high);
      if (state === "running") {
        context.fillStyle = colors.running;
        const leased = Math.max(4, ((HEIGHT - 8) * batches.leased) / total(batches));
        context.fillRect(x, Math.max(0, HEIGHT - 8 - high - leased), w, leased);
      }
      if (state === "failed") {
        context.fillStyle = colors.failed;
        context.fillRect(x, 0, w, 10);
        context.fillStyle = colors.ground;
        if (w > 5) context.fillRect(x + w / 2 - 1, 2, 2, 4), context.fillRect(x + w / 2 - 1, 7, 2, 2);
      }
      if (marked !== null && marked >= first && marked <= last) {
        context.fillStyle = colors.text;
        context.fillRect(x, HEIGHT - 6, Math.max(w, 3), 4);
      }
    });
  }
}
