// The bake itself: points under a light that the artist turns.

import { get, query } from "/dashboard/api.js";
import { tell, tellProblem } from "/dashboard/dialog.js";
import { h, put } from "/dashboard/dom.js";
import { Camera, steer } from "/dashboard/viewer/camera.js";
import { Lights } from "/dashboard/viewer/light.js";
import { account, controls, describe, drawBall } from "/dashboard/viewer/panel.js";
import { Preview } from "/dashboard/viewer/preview.js";
import { Renderer } from "/dashboard/viewer/renderer.js";

const BUDGET = 3_000_000;
const FRAME_MS = 40;

/** What the address says about a view: everything that a link restores. */
function readState() {
  const asked = new URLSearchParams(location.hash.slice(1));
  const vector = (name) => {
    const values = (asked.get(name) ?? "").split(",").map(Number);
    return values.length === 3 && values.every(Number.isFinite) ? values : null;
  };
  const number = (name, otherwise) => (asked.has(name) && Number.isFinite(Number(asked.get(name))) ? Number(asked.get(name)) : otherwise);
  return { show: asked.get("show") ?? "lit", env: asked.get("env") ?? "sky", rotation: number("rot", 0), stops: number("stops", 0), tint: vector("tint") ?? [1, 1, 1], compare: asked.get("compare") ?? "one", other: asked.get("with") ?? "", gain: number("gain", 4), eye: vector("eye"), at: vector("at"), fov: number("fov", 35) };
}

/** The address of a view. */
function writeState(state, camera) {
  const values = (list) => list.map((value) => Number(value.toPrecision(9))).join(",");
  const said = new URLSearchParams({ show: state.show, env: state.env, rot: state.rotation, stops: state.stops, eye: values(camera.eye), at: values(camera.target), fov: camera.fov });
  if (state.tint.some((value) => value !== 1)) said.set("tint", values(state.tint));
  if (state.other) said.set("with", state.other), said.set("compare", state.compare), said.set("gain", state.gain);
  return `${location.pathname}${location.search}#${said}`;
}

/** The outputs that can be looked at: those of a job. */
async function outputsOf(job) {
  const { outputs } = await get(`/v1/jobs/${job}/manifest`);
  return outputs.filter((output) => output.preview);
}

/** The preview of a job's bake set. */
async function load(job, set) {
  const preview = new Preview(`/v1/jobs/${job}/outputs/${encodeURIComponent(`${set}.mgs`)}/preview`);
  await preview.open();
  return preview;
}

/** Other bakes that this one can be compared with: its own job's other sets, and late jobs of the same project. */
async function candidates(job, set, outputs) {
  const own = outputs.map((output) => output.name.replace(/\.mgs$/, "")).filter((name) => name !== set).map((name) => [`${job.id}/${name}`, `${name}, of this job`]);
  const page = await get(query("/v1/jobs", { project: job.project, state: "succeeded", limit: 30 }));
  const others = page.jobs.filter((other) => other.id !== job.id).map((other) => [`${other.id}/${set}`, `${other.name}, ${new Date(other.created_at).toLocaleString("en-GB", { day: "numeric", month: "short", hour: "2-digit", minute: "2-digit" })}`]);
  return [...own, ...others];
}

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
  const [job, outputs] = await Promise.all([get(`/v1/jobs/${id}`), outputsOf(id)]);
  if (outputs.length === 0) throw new Error("this job has no preview: its bake has no spherical harmonics, or is older than previews");
  const sets = outputs.map((output) => output.name.replace(/\.mgs$/, ""));
  const asked = new URLSearchParams(location.search).get("set");
  const set = sets.includes(asked) ? asked : sets[0];
  const state = readState();
  const lights = new Lights();
  const canvas = h("canvas", { class: "view", tabindex: "0", role: "img", "aria-label": `The bake ${set} as points. Drag or arrow keys turn it, + and - zoom, [ and ] turn the light, R shows all of it.` });
  const status = h("p", { class: "viewer-status", role: "status" });
  const point = h("div", { class: "viewer-point" });
  const side = h("aside", { class: "viewer-side", "aria-label": "Light and view" });
  const names = h("div", { class: "viewer-names", "aria-hidden": "true" });
  main.classList.add("fill");
  context.while(() => main.classList.remove("fill"));
  main.append(h("div", { class: "bar-row" }, h("p", { class: "crumbs" }, h("a", { href: "/jobs" }, "Jobs"), " / ", h("a", { href: `/jobs/${id}` }, job.name), " / "), h("h1", {}, set),
    sets.length > 1 && h("select", { "aria-label": "Bake set", onchange: (event) => context.go(`/jobs/${id}/bake?set=${encodeURIComponent(event.target.value)}`) }, sets.map((name) => h("option", { value: name, selected: name === set }, name)))),
    h("div", { class: "viewer" }, h("div", { class: "viewer-stage" }, canvas, names, status), side));

  let dirty = true;
  let running = true;
  let [budget, slow] = [BUDGET, 0];
  const changed = () => { dirty = true; };
  const renderer = new Renderer(canvas, changed);
  const [preview] = await Promise.all([load(id, set), lights.load()]);
  const layer = renderer.add(preview);
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
      const [otherJob, otherSet] = other.split("/");
      try {
        renderer.add(await load(otherJob, otherSet));
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
  const others = await candidates(job, set, outputs);
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
