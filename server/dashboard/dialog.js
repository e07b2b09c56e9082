// Questions before what destroys, and results after everything.

import { h } from "/dashboard/dom.js";

let region = null;

/** A line that says what came of something; failures stay until they are closed. */
export function tell(text, kind = "done", hint) {
  region ??= document.body.appendChild(h("div", { class: "toasts", role: "status", "aria-live": "polite" }));
  const sign = kind === "failed" ? "✕" : "✓";
  const toast = h("div", { class: `toast tone-${kind}` }, h("span", { class: "sign", "aria-hidden": "true" }, sign),
    h("span", { class: "grow" }, text, hint && h("small", {}, hint)),
    h("button", { class: "plain", "aria-label": "Close", onclick: () => toast.remove() }, "×"));
  region.append(toast);
  while (region.children.length > 5) region.firstChild.remove();
  if (kind !== "failed") setTimeout(() => toast.remove(), 6_000);
}

/** Says what a problem was. */
export const tellProblem = (problem, doing) => tell(`${doing}: ${problem.message}`, "failed", problem.hint);

/** Asks; the answer is what `fields` hold, or null. `danger` marks what cannot be taken back. */
export function ask({ title, text, action, danger = false, fields = [] }) {
  return new Promise((answer) => {
    const inputs = fields.map((field) => field.input ?? h("input", { name: field.name, type: field.type ?? "text", value: field.value ?? "", min: field.min, max: field.max, required: field.required, autocomplete: "off" }));
    const rows = fields.map((field, at) => h("label", { class: "field" }, h("span", {}, field.label), inputs[at], field.note && h("small", {}, field.note)));
    const done = (value) => {
      dialog.close();
      dialog.remove();
      answer(value);
    };
    const form = h("form", { method: "dialog", onsubmit: (event) => {
      event.preventDefault();
      done(Object.fromEntries(fields.map((field, at) => [field.name, inputs[at].value])));
    } }, h("h2", {}, title), text && h("p", {}, text), rows,
      h("div", { class: "buttons" },
        h("button", { type: "button", onclick: () => done(null) }, "Back"),
        h("button", { type: "submit", class: danger ? "danger" : "primary" }, action)));
    const dialog = h("dialog", { "aria-label": title, oncancel: (event) => { event.preventDefault(); done(null); } }, form);
    document.body.append(dialog);
    dialog.showModal();
    (inputs[0] ?? form.querySelector("button")).focus();
  });
}

/** Shows something until it is closed. */
export function present(title, content) {
  const close = () => { dialog.close(); dialog.remove(); };
  const dialog = h("dialog", { class: "wide", "aria-label": title, oncancel: close }, h("header", {}, h("h2", {}, title), h("button", { class: "plain", "aria-label": "Close", onclick: close }, "×")), content);
  document.body.append(dialog);
  dialog.showModal();
  return { dialog, close };
}
