// Batches per minute over the life of a job, as the coordinator saw them.

import { get } from "/dashboard/api.js";
import { h, put, s } from "/dashboard/dom.js";
import { short, span } from "/dashboard/format.js";

const [WIDTH, HEIGHT] = [320, 96];

/** Batches per minute between neighbouring samples. */
export function rates(samples) {
  return samples.slice(1).map((sample, at) => ({ from: samples[at].at, to: sample.at, rate: Math.max(0, (60_000 * (sample.done - samples[at].done)) / Math.max(1, sample.at - samples[at].at)) }));
}

/** Draws the throughput. */
export async function drawPace(element, job) {
  const samples = await get(`/v1/jobs/${job.id}/pace`).catch(() => []);
  const found = rates(samples);
  if (found.length < 2) {
    put(element, h("h2", {}, "Throughput"), h("p", { class: "quiet" }, "Drawn while batches come in."));
    return;
  }
  const [start, end] = [found[0].from, found.at(-1).to];
  const top = Math.max(...found.map(({ rate }) => rate), 1e-9);
  const x = (at) => ((at - start) / (end - start)) * WIDTH;
  const y = (rate) => HEIGHT - 2 - (rate / top) * (HEIGHT - 14);
  const line = found.map(({ from, to, rate }, at) => `${at === 0 ? "M" : "L"}${x(from).toFixed(1)} ${y(rate).toFixed(1)}L${x(to).toFixed(1)} ${y(rate).toFixed(1)}`).join("");
  const mean = (60_000 * (samples.at(-1).done - samples[0].done)) / Math.max(1, end - start);
  put(element, h("h2", {}, "Throughput"),
    s("svg", { class: "pace", viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-label": `up to ${short(top)} batches per minute, ${short(mean)} on average` },
      s("path", { class: "area", d: `${line}L${WIDTH} ${HEIGHT}L0 ${HEIGHT}Z` }), s("path", { class: "line", d: line })),
    h("p", { class: "quiet" }, `${short(mean)} batches per minute on average, ${short(top)} at best, over ${span(end - start)}`));
}
