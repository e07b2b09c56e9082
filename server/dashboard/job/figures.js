// What is known of a job in numbers: its maps, its points, what tracing took, what was asked for.

import { h, put } from "/dashboard/dom.js";
import { bytes, count, share, short, span } from "/dashboard/format.js";
import { bytesPerRay, cacheHitsText, deviceBytesPerRay, deviceShare, raysPerSecond, sum } from "/dashboard/traced.js";

/** A list of names and values. */
export const list = (rows) => h("dl", {}, rows.map(([name, value, title]) => [h("dt", { title }, name), h("dd", {}, value)]));

/** What tracing a job's batches took; null where nothing was traced. */
export function tracedOf(job) {
  const traced = job.passes.map((pass) => pass.traced).filter(Boolean);
  return traced.length > 0 ? sum(traced) : null;
}

/** The rows of what tracing took. */
export function tracedRows(traced) {
  if (!traced) return [];
  return [
    ["Rays", `${short(traced.rays)}, ${short(traced.rays / Math.max(1, traced.points))} a point`],
    ["Rays of a worker", raysPerSecond(traced), "while it traces: waiting for work does not count"],
    ["Cache hits", cacheHitsText(traced), "bricks that were in a worker's memory when a batch asked for them"],
    ["Read per ray", bytesPerRay(traced), "bytes of bricks that went from disk or storage to memory"],
    ["Sent to devices per ray", deviceBytesPerRay(traced)],
    ["Devices at work", deviceShare(traced), "share of the tracing time"],
  ].filter(([, value]) => value);
}

/** Draws the figures. */
export function drawFigures(element, job) {
  const result = (kind) => job.passes.filter((pass) => pass.kind === kind && pass.result).map((pass) => pass.result);
  const all = (kind, key) => result(kind).reduce((sum, one) => sum + one[key], 0);
  const mean = job.passes.filter((pass) => pass.kind === "bake" && pass.batch_ms > 0);
  const [bricks, micropolygons] = [all("build", "bricks"), all("build", "micropolygons")];
  const rows = [
    ["Points", all("plan", "points") && count(all("plan", "points"))],
    ["Baked", all("merge", "points") && `${count(all("merge", "baked"))} (${share(all("merge", "baked"), all("merge", "points"))})`],
    ["Batch, mean", mean.length && span(mean.reduce((sum, pass) => sum + pass.batch_ms, 0) / mean.length)],
    ...tracedRows(tracedOf(job)),
    ["Bricks", bricks && `${count(bricks)}, ${bytes(all("build", "bytes"))}`],
    ["Micropolygons", micropolygons && `${short(micropolygons)}, ${(all("build", "bytes") / micropolygons).toFixed(1)} B each`],
    ["Maps of other jobs used", job.passes.filter((pass) => pass.reused).length || null],
    ["Result", all("merge", "bytes") && bytes(all("merge", "bytes"))],
  ].filter(([, value]) => value);
  const { settings } = job;
  const asked = Object.entries({ "Rays per point": settings.samples, "Points at most": settings.max_points, "Level of detail": settings.lod, "Far field": settings.far_field, Seed: settings.seed || null, Frame: settings.frame }).filter(([, value]) => value !== undefined && value !== null);
  put(element, h("h2", {}, "Figures"), rows.length === 0 ? h("p", { class: "quiet" }, "None yet.") : list(rows), asked.length > 0 && [h("h2", { class: "later" }, "Asked for"), list(asked)],
    job.resubmit_of && h("p", { class: "quiet" }, "Submitted again from ", h("a", { href: `/jobs/${job.resubmit_of}` }, job.resubmit_of)));
}
