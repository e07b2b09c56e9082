// Who baked how much of a job, how fast, and how well its memory served.

import { get } from "/dashboard/api.js";
import { h, put } from "/dashboard/dom.js";
import { ago, count } from "/dashboard/format.js";
import { bytesPerRay, cacheHitsCell, raysPerSecond } from "/dashboard/traced.js";

/** Draws the workers of a job. */
export async function drawWork(element, job) {
  const work = await get(`/v1/jobs/${job.id}/work`);
  element.hidden = work.length === 0;
  const sets = new Set(work.map(({ name }) => name)).size;
  const rows = work.map((one) => h("tr", {},
    h("td", {}, h("a", { href: `/workers?search=${encodeURIComponent(one.worker)}` }, one.worker)),
    h("td", {}, one.device), sets > 1 && h("td", {}, one.name),
    h("td", { class: "number" }, count(one.traced.batches)), h("td", { class: "number" }, raysPerSecond(one.traced) ?? "–"),
    h("td", { class: "number" }, cacheHitsCell(one.traced)), h("td", { class: "number" }, bytesPerRay(one.traced) ?? "–"), h("td", { class: "number" }, ago(one.at))));
  const names = ["Worker", "Device", sets > 1 && "Bake set", "Batches", "Rays", "Cache hits", "Read per ray", "Last result"].filter(Boolean);
  put(element, h("h2", {}, "Who baked it"), h("div", { class: "scroller" }, h("table", { class: "plain" }, h("thead", {}, h("tr", {}, names.map((name) => h("th", { scope: "col" }, name)))), h("tbody", {}, rows))));
}
