// Failures, grouped by class and message: what went wrong once for each reason.

import { get } from "/dashboard/api.js";
import { h, put } from "/dashboard/dom.js";
import { ago, count } from "/dashboard/format.js";
import { failureClass } from "/dashboard/words.js";

/** Messages that differ only in numbers and ids are one. */
const shape = (message) => message.replaceAll(/[0-9a-f]{12,}|\d+/gi, "#");

/** Draws the groups; `open(pass, batch)` shows a batch. */
export async function drawFailures(element, job, open) {
  const failures = await get(`/v1/jobs/${job.id}/failures`);
  element.hidden = failures.length === 0;
  const groups = new Map();
  for (const failure of failures) {
    const key = `${failure.class} ${shape(failure.message)}`;
    const group = groups.get(key) ?? { class: failure.class, message: failure.message, count: 0, workers: new Set(), batches: new Map(), at: 0 };
    group.count += failure.count;
    group.workers.add(failure.worker);
    group.batches.set(`${failure.pass}/${failure.batch}`, failure);
    group.at = Math.max(group.at, failure.at);
    groups.set(key, group);
  }
  const rows = [...groups.values()].sort((a, b) => b.count - a.count).map((group) => h("tr", {},
    h("td", {}, h("span", { class: "pill tone-failed" }, h("span", { class: "sign", "aria-hidden": "true" }, "✕"), failureClass(group.class))),
    h("td", { class: "message" }, group.message || h("span", { class: "quiet" }, "no message"),
      h("small", { class: "quiet" }, "Batches ", [...group.batches.values()].slice(0, 8).map((failure, at) => [at > 0 && ", ", h("button", { class: "plain link", onclick: () => open(failure.pass, failure.batch) }, failure.batch)]), group.batches.size > 8 && ` and ${group.batches.size - 8} more`)),
    h("td", { class: "number" }, `${count(group.count)} ×`),
    h("td", {}, [...group.workers].slice(0, 3).join(", "), group.workers.size > 3 && ` and ${group.workers.size - 3} more`),
    h("td", { class: "number" }, ago(group.at))));
  put(element, h("h2", {}, "Failures"), h("div", { class: "scroller" }, h("table", { class: "plain" }, h("thead", {}, h("tr", {}, ["Class", "Message", "Times", "On", "Last"].map((name) => h("th", { scope: "col" }, name)))), h("tbody", {}, rows))));
}
