// The viewer's controls, and what it says about the point that was picked.

import { h, put } from "/dashboard/dom.js";
import { bytes, count, short } from "/dashboard/format.js";
import { basis, radiance } from "/dashboard/viewer/sh.js";

/** What can be looked at, for what a preview has. */
function shows({ bands, hasError, hasAlbedo }) {
  const all = [["lit", "Lit"], ["sky", "Sky visibility"]];
  if (bands > 1) all.push(["bent", "Bent normal"]);
  for (let band = 0; band < bands; band += 1) all.push([`band${band}`, `Band ${band} alone`]);
  if (hasError) all.push(["error", "Sample error"]);
  return [...all, ["normal", "Normal"], hasAlbedo && ["albedo", "Albedo"]].filter(Boolean);
}

const LEGENDS = {
  sky: "Black: sees nothing of the sky. White: nothing stands before it.",
  bent: "The direction from which most light comes: red is x, green y, blue z; grey is none.",
  band: "What this band says along the normal: orange is more than nothing, blue less.",
  normal: "Red is x, green y, blue z.",
  error: "How far off the coefficients may be, from two halves of the rays: black is exact, white 0.03 and more. Bright parts want more rays; exposure scales it.",
  difference: "White: both are alike. Orange: the first is brighter. Blue: the second is. Dark grey: only one of them has a point there.",
};

/** The controls; `change(what)` is called after each. */
export function controls(state, header, lights, others, { change, dropped, reset, share, compareWith }) {
  const slider = (label, key, min, max, step, unit) => {
    const value = h("output", {}, `${state[key]}${unit}`);
    const input = h("input", { type: "range", min, max, step, value: String(state[key]), "aria-label": label, oninput: () => { state[key] = Number(input.value); value.textContent = `${state[key]}${unit}`; change(key); } });
    return { row: h("label", { class: "slider" }, h("span", {}, label), value, input), set: () => { input.value = String(state[key]); value.textContent = `${Math.round(state[key] * 100) / 100}${unit}`; } };
  };
  const show = h("select", { "aria-label": "Show", onchange: () => { state.show = show.value; change("show"); legend(); } }, shows(header).map(([key, name]) => h("option", { value: key, selected: key === state.show }, name)));
  const env = h("select", { "aria-label": "Environment", onchange: () => { state.env = env.value; change("env"); } });
  const fillLights = () => put(env, [...lights.all].map(([key, { name }]) => h("option", { value: key, selected: key === state.env }, name)));
  fillLights();
  const rotation = slider("Turn the light", "rotation", 0, 360, 1, "°");
  const stops = slider("Exposure", "stops", -6, 6, 0.1, " stops");
  const gain = slider("Difference times", "gain", 1, 50, 1, "");
  const hex = (tint) => `#${tint.map((value) => Math.round(255 * Math.min(1, value)).toString(16).padStart(2, "0")).join("")}`;
  const tint = h("input", { type: "color", value: hex(state.tint), "aria-label": "Tint", oninput: () => { state.tint = [1, 3, 5].map((at) => parseInt(tint.value.slice(at, at + 2), 16) / 255); change("tint"); } });
  const file = h("input", { type: "file", accept: ".hdr", class: "visually-hidden", id: "hdr", onchange: () => file.files[0] && dropped(file.files[0]) });
  const ball = h("canvas", { width: 48, height: 48, class: "ball", "aria-hidden": "true" });
  const legendLine = h("p", { class: "quiet legend-line" });
  const legend = () => put(legendLine, state.compare === "difference" ? LEGENDS.difference : LEGENDS[state.show.startsWith("band") ? "band" : state.show] ?? "");
  const with_ = h("select", { "aria-label": "Compare with", onchange: () => compareWith(with_.value) }, h("option", { value: "" }, "nothing"), others.map(([value, name]) => h("option", { value, selected: value === state.other }, name)));
  const modes = [["side", "Side by side"], ["difference", "Difference"]].map(([mode, name]) => h("button", { type: "button", "aria-pressed": state.compare === mode, onclick: () => { state.compare = mode; sync(); change("compare"); } }, name));
  const compare = h("div", { class: "pair" }, modes);
  const sync = () => {
    compare.hidden = state.compare === "one";
    gain.row.hidden = state.compare !== "difference";
    modes.forEach((button, at) => button.setAttribute("aria-pressed", state.compare === ["side", "difference"][at]));
    rotation.set();
    stops.set();
    legend();
  };
  const element = h("div", { class: "viewer-controls" },
    h("label", { class: "field" }, h("span", {}, "Show"), show), legendLine,
    h("div", { class: "lighting" }, h("label", { class: "field grow" }, h("span", {}, "Environment"), env), ball),
    rotation.row, stops.row,
    h("div", { class: "bar-row" }, h("label", { class: "tint" }, "Tint ", tint), h("span", { class: "grow" }), h("label", { class: "button", for: "hdr" }, "Load .hdr"), file),
    h("label", { class: "field" }, h("span", {}, "Compare with"), with_), compare, gain.row,
    h("div", { class: "bar-row" }, h("button", { type: "button", onclick: reset }, "Whole scene"), h("button", { type: "button", onclick: share }, "Copy link")));
  sync();
  return { element, sync, fillLights, ball };
}

/** A ball under the light, so that it is seen where it comes from. */
export function drawBall(canvas, camera, matrix, bands) {
  const context = canvas.getContext("2d");
  const { width } = canvas;
  const image = context.createImageData(width, width);
  const [right, up, back] = camera.axes();
  // A white ball that nothing hides: half a sphere about each normal
  for (let py = 0; py < width; py += 1) {
    for (let px = 0; px < width; px += 1) {
      const [x, y] = [(px + 0.5) / width * 2 - 1, 1 - (py + 0.5) / width * 2];
      const square = x * x + y * y;
      if (square > 1) continue;
      const z = Math.sqrt(1 - square);
      const normal = [0, 1, 2].map((axis) => x * right[axis] + y * up[axis] + z * back[axis]);
      const color = radiance(matrix, bands, normal, openSky(normal, bands));
      const at = 4 * (py * width + px);
      color.forEach((value, channel) => { image.data[at + channel] = 255 * srgb(0.7 * Math.max(0, value)); });
      image.data[at + 3] = 255;
    }
  }
  context.putImageData(image, 0, 0);
}

const srgb = (value) => Math.min(1, value <= 0.0031308 ? 12.92 * value : 1.055 * value ** (1 / 2.4) - 0.055);
/** The open hemisphere about z, band by band. */
const OPEN = [1.7724539, 1.5349901, 0, -0.5854, 0, 0.3664];
function openSky(normal, bands) {
  const y = basis(bands, ...normal);
  const out = [];
  for (let l = 0; l < bands; l += 1) for (let m = 0; m < 2 * l + 1; m += 1) out.push(OPEN[l] * Math.sqrt((4 * Math.PI) / (2 * l + 1)) * y[l * l + m]);
  return out;
}

/** What is known of a point. */
export function describe(element, found, state, matrix) {
  if (!found) {
    put(element, h("p", { class: "quiet" }, "Click on a point to see its numbers; double-click to look at it."));
    return;
  }
  const { header } = found.layer.preview;
  const number = (value) => (Math.abs(value) >= 1e5 ? value.toExponential(3) : value.toFixed(4));
  const lit = radiance(matrix, header.bands, found.normal, found.visibility).map((value, at) => Math.max(0, value) * found.albedo[at]);
  const row = (name, values) => [h("dt", {}, name), h("dd", { class: "mono" }, values)];
  const bands = Array.from({ length: header.bands }, (_, l) => [`Band ${l}`, found.visibility.slice(l * l, (l + 1) ** 2).map(number).join(" ")]);
  put(element, h("h2", {}, "Point"), h("dl", { class: "numbers" },
    row("Position", found.place.map(number).join(" ")), row("Normal", found.normal ? found.normal.map(number).join(" ") : "none"), row("Albedo", found.albedo.map(number).join(" ")),
    row("Sky visibility", `${(100 * found.visibility[0] / found.layer.open).toFixed(1)} %`), found.error !== null && row("Sample error", number(found.error)), row("Radiance", lit.map(number).join(" ")), bands.map(([name, values]) => row(name, values))));
}

/** What is drawn, and what came over the wire. */
export function account(element, layers) {
  const sum = (key) => layers.reduce((all, layer) => all + layer[key], 0);
  const drawn = layers.reduce((all, layer) => all + layer.drawn.reduce((points, node) => points + node.points, 0), 0);
  const received = layers.reduce((all, layer) => all + layer.preview.received, 0);
  const coming = sum("missing");
  const whole = layers.map((layer) => `${short(layer.preview.header.points)}${layer.preview.header.points < layer.preview.header.baked ? ` of ${short(layer.preview.header.baked)}` : ""}`).join(" and ");
  const text = `${count(drawn)} points drawn · preview of ${whole} · ${bytes(received)} loaded${coming ? ` · ${coming} nodes to come` : ""}`;
  if (element.textContent !== text) element.textContent = text;
  element.dataset.idle = coming === 0 && layers.every((layer) => layer.fetching === 0);
}
