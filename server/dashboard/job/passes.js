// The passes of a job as bars in time: what each took, and what waits for what.

import { h, put } from "/dashboard/dom.js";
import { count, now, span } from "/dashboard/format.js";
import { bar, pill, total } from "/dashboard/words.js";

const NAMES = { import: "Import", build: "Build the brick map", plan: "Plan batches", bake: "Bake", merge: "Merge" };
const AFTER = { import: "", build: "after import", plan: "after import", bake: "after plan and build", merge: "after bake" };

/** Draws the passes. */
export function drawPasses(element, job) {
  const { passes } = job;
  if (passes.length === 0) {
    put(element, h("h2", {}, "Passes"), h("p", { class: "quiet" }, "None yet: the first is made when the job may start."));
    return;
  }
  const start = job.created_at;
  const end = Math.max(job.ended_at ?? now(), start + 1);
  const place = (at) => `${(100 * (at - start)) / (end - start)}%`;
  const rows = passes.map((pass) => {
    const began = pass.created_at;
    // Open is what may run: whether anything of it does is another matter
    const state = pass.state === "open" && pass.batches.leased === 0 ? "ready" : pass.state;
    const until = pass.ended_at ?? (["done", "failed", "cancelled"].includes(pass.state) ? began : end);
    const label = pass.reused ? "another job's work" : `${span(until - began)}`;
    const block = h("i", { class: `span span-${state}`, style: { left: place(began), width: `max(3px, calc(${place(until)} - ${place(began)}))` } });
    const many = total(pass.batches) > 1;
    return h("tr", {},
      h("td", {}, pill(state)),
      h("td", { class: "pass-name" }, h("strong", {}, NAMES[pass.kind] ?? pass.kind), h("small", { class: "quiet clip", title: pass.name }, pass.kind === "build" ? pass.name.slice(0, 12) : pass.name)),
      h("td", { class: "lane", title: AFTER[pass.kind] }, block),
      h("td", { class: "number" }, label),
      h("td", { class: "pass-bar" }, many ? [bar(pass.batches), h("small", { class: "quiet" }, `${count(pass.batches.done)} / ${count(total(pass.batches))}`)] : null));
  });
  put(element, h("h2", {}, "Passes"), h("div", { class: "scroller" }, h("table", { class: "plain passes" }, h("thead", {}, h("tr", {}, ["State", "Pass", `In time (${span(end - start)} since it was submitted)`, "Took", "Batches"].map((name) => h("th", { scope: "col" }, name)))), h("tbody", {}, rows))));
}
