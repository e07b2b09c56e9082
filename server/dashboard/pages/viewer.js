// The bake itself: points under a light that the artist turns.

import { get } from "/dashboard/api.js";
import { tell, tellProblem } from "/dashboard/dialog.js";
import { h, put } from "/dashboard/dom.js";
import { ago, count } from "/dashboard/format.js";
import { onEvent } from "/dashboard/live.js";
import { Camera, steer } from "/dashboard/viewer/camera.js";
import { Lights } from "/dashboard/viewer/light.js";
import { account, controls, describe, drawBall } from "/dashboard/viewer/panel.js";
import { Renderer } from "/dashboard/viewer/renderer.js";
import { candidates, open, openOther, sourcesOf } from "/dashboard/viewer/sources.js";
import { readState, writeState } from "/dashboard/viewer/state.js";

const BUDGET = 3_000_000;
const FRAME_MS = 40;

/** The box of a preview, by its root's points. */
function box(layer) {
  const [node] = layer.preview.nodes;
  const min = [Infinity, Infinity, Infinity];
  const max = [-Infinity, -Infinity, -Infinity];
  for (let at = 0; at < node.points; at += 1) layer.point(node, at).place.forEach((value, axis) => { min[axis] = Math.min(min[axis], value); max[axis] = Math.max(max[axis], value); });
  return [min, max];
}

export async function show(main, context) {
  const { id } = context;
  const job = await get(`/v1/jobs/${id}`);
  const sources = await sourcesOf(job);
  if (sources.length === 0) throw new Error(job.state === "succeeded" ? "this job has no preview: its bake has no spherical harmonics, or is older than previews" : "no batch of this job is done: there is nothing to see yet");
  const sets = sources.map(({ set }) => set);
  const asked = new URLSearchParams(location.search).get("set");
  let source = sources.find(({ set }) => set === asked) ?? sources[0];
  const { set } = source;
  const state = readState();
  const lights = new Lights();
  const canvas = h("canvas", { class: "view", tabindex: "0", role: "img", "aria-label": `The bake ${set} as points. Drag or arrow keys turn it, + and - zoom, [ and ] turn the light, R shows all of it.` });
  const status = h("p", { class: "viewer-status", role: "status" });
  const point = h("div", { class: "viewer-point" });
  const side = h("aside", { class: "viewer-side", "aria-label": "Light and view" });
  const names = h("div", { class: "viewer-names", "aria-hidden": "true" });
  const sofar = h("p", { class: "viewer-sofar", role: "status", hidden: !source.sofar });
  main.classList.add("fill");
  context.while(() => main.classList.remove("fill"));
  main.append(h("div", { class: "bar-row" }, h("p", { class: "crumbs" }, h("a", { href: "/jobs" }, "Jobs"), " / ", h("a", { href: `/jobs/${id}` }, job.name), " / "), h("h1", {}, set),
    sets.length > 1 && h("select", { "aria-label": "Bake set", onchange: (event) => context.go(`/jobs/${id}/bake?set=${encodeURIComponent(event.target.value)}`) }, sets.map((name) => h("option", { value: name, selected: name === set }, name)))),
    h("div", { class: "viewer" }, h("div", { class: "viewer-stage" }, canvas, names, sofar, status), side));

  let dirty = true;
  let running = true;
  let [budget, slow] = [BUDGET, 0];
  const changed = () => { dirty = true; };
  const renderer = new Renderer(canvas, changed);
  const [preview] = await Promise.all([open(source.url), lights.load()]);
  let layer = renderer.add(preview);
  const { header } = preview;
  const camera = new Camera(header.zUp);
  camera.fov = state.fov;
  let matrix = null;
  const relight = () => {
    renderer.layers.forEach((each) => each.light((each.matrixOf = lights.matrix(state, each.preview.header))));
    matrix = layer.matrixOf;
    drawBall(panel.ball, camera, matrix, header.bands);
    dirty = true;
  };
  let [remembering, picked] = [0, null];
  const remember = () => { clearTimeout(remembering); remembering = setTimeout(() => history.replaceState(null, "", writeState(state, camera)), 250); };
  const change = (what) => {
    if (["env", "rotation", "tint"].includes(what)) relight();
    if (picked) describe(point, picked, state, picked.layer.matrixOf);
    nameViews();
    remember();
    dirty = true;
  };
  const reset = () => {
    camera.frame(...box(layer), canvas.clientWidth / canvas.clientHeight);
    moved();
  };
  const moved = () => { dirty = true; remember(); };
  const nameViews = () => put(names, renderer.layers.length > 1 && state.compare === "side" ? [h("span", {}, job.name), h("span", {}, panel.otherName)] : null);
  const compareWith = async (other) => {
    state.other = other;
    renderer.layers.length = 1;
    state.compare = other ? (state.compare === "one" ? "side" : state.compare) : "one";
    if (other) {
      try {
        renderer.add(await openOther(other));
      } catch (problem) {
        tellProblem(problem, "That bake cannot be compared");
        [state.other, state.compare] = ["", "one"];
      }
    }
    panel.otherName = others.find(([value]) => value === state.other)?.[1] ?? "";
    panel.sync();
    relight();
    change("compare");
  };
  const dropHdr = async (file) => {
    try {
      state.env = await lights.drop(file);
      panel.fillLights();
      change("env");
      tell(`${file.name} lights the scene.`);
    } catch (problem) {
      tellProblem(problem, "That is no light");
    }
  };
  const share = async () => {
    history.replaceState(null, "", writeState(state, camera));
    if (navigator.clipboard) await navigator.clipboard.writeText(location.href).then(() => tell("The link is copied: it restores this view."), () => tell("The address of this page restores this view."));
    else tell("The address of this page restores this view.");
  };
  const saySofar = () => put(sofar, h("strong", {}, `${count(source.sofar.done)} of ${count(source.sofar.batches)} batches`), ` so far, as of ${ago(source.sofar.made_at)}`);
  // What there is so far is looked at anew as long as it grows; the result takes its place
  const renew = async () => {
    const now = await get(`/v1/jobs/${id}`);
    if (now.state === "succeeded") {
      context.go(writeState(state, camera));
      return;
    }
    const found = (await sourcesOf(now)).find((other) => other.set === set);
    if (running && found && found.url !== source.url) {
      await renderer.replace(layer, await open(found.url), (next) => next.light(lights.matrix(state, next.preview.header)));
      [layer, source] = [renderer.layers[0], found];
      relight();
    }
    saySofar();
  };
  function follow() {
    const again = () => { if (!document.hidden) renew().catch(() => null); };
    const timers = [setInterval(again, 10_000), setInterval(saySofar, 1_000)];
    const silence = onEvent((event) => { if (event.job === id && event.kind === "job.succeeded") again(); });
    saySofar();
    return () => { timers.forEach(clearInterval); silence(); };
  }
  const others = await candidates(job, set, sets);
  const panel = controls(state, header, lights, others, { change, dropped: dropHdr, reset, share, compareWith });
  side.append(panel.element, point);
  describe(point, null);
  steer(canvas, camera, {
    moved: () => { moved(); drawBallSoon(); }, reset,
    light: (by) => { state.rotation = (((state.rotation + by) % 360) + 360) % 360; panel.sync(); change("rotation"); },
    clicked: (event) => { picked = renderer.pick(event.offsetX, event.offsetY); describe(point, picked, state, picked?.layer.matrixOf); dirty = true; },
  });
  canvas.addEventListener("dblclick", () => { if (picked) { camera.lookAt(picked.place); moved(); } });
  let balling = 0;
  const drawBallSoon = () => { clearTimeout(balling); balling = setTimeout(() => drawBall(panel.ball, camera, matrix, header.bands), 60); };
  main.addEventListener("dragover", (event) => event.preventDefault());
  main.addEventListener("drop", (event) => { event.preventDefault(); if (event.dataTransfer.files[0]) dropHdr(event.dataTransfer.files[0]); });
  const watch = new ResizeObserver(changed);
  watch.observe(canvas);
  context.while(() => { running = false; watch.disconnect(); clearTimeout(remembering); clearTimeout(balling); renderer.end(); });

  // The root first: it says where everything is
  await layer.fetch(preview.nodes[0]);
  if (layer.failed) throw layer.failed;
  if (state.eye && state.at) [camera.eye, camera.target] = [state.eye, state.at];
  else camera.frame(...box(layer), canvas.clientWidth / canvas.clientHeight);
  camera.radius = header.edge;
  relight();
  if (source.sofar) context.while(follow());
  if (state.other) await compareWith(state.other);
  else if (state.compare !== "one") state.compare = "one";
  panel.sync();
  nameViews();
  let before = 0;
  const frame = (now) => {
    if (!running) return;
    requestAnimationFrame(frame);
    if (!dirty) { before = 0; return; }
    // Fewer points while frames take too long, more again when they do not
    if (before && now - before > FRAME_MS) slow += 1;
    else slow = Math.max(0, slow - 1);
    if (slow > 10) [budget, slow] = [Math.max(150_000, budget / 2), 0];
    before = now;
    dirty = false;
    renderer.frame(camera, state, budget);
    account(status, renderer.views(state.compare).map(([each]) => each));
    renderer.layers.forEach((each) => { if (each.failed) { tellProblem(each.failed, "A part of the preview cannot be shown"); each.failed = null; } });
  };
  requestAnimationFrame(frame);
  return `${set} of ${job.name}`;
}
