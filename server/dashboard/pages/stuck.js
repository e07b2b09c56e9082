// What does not move: leases that last far longer than their like, and jobs that wait, with why and what to do.

import { STUCK_LEAST_MS, STUCK_TIMES, attention, expected, isStuck, line } from "/dashboard/attention.js";
import { h, put } from "/dashboard/dom.js";
import { count, now, span } from "/dashboard/format.js";
import { pill, reason, remedy } from "/dashboard/words.js";

const headings = (...names) => h("thead", {}, h("tr", {}, names.map((name) => h("th", { scope: "col" }, name))));

function drawLeases(element, leases) {
  const rows = leases.map((lease) => ({ lease, took: now() - lease.granted_at, share: expected(lease) ? (now() - lease.granted_at) / expected(lease) : null })).sort((a, b) => Number(isStuck(b.lease)) - Number(isStuck(a.lease)) || (b.share ?? 0) - (a.share ?? 0) || b.took - a.took);
  const stuck = rows.filter(({ lease }) => isStuck(lease)).length;
  put(element, h("h2", {}, "Running batches, slowest first ", stuck > 0 ? h("span", { class: "tone-failed" }, `! ${stuck} stuck`) : h("span", { class: "tone-done" }, "✓ none stuck")),
    rows.length === 0 ? h("p", { class: "quiet" }, "Nothing runs.") : h("div", { class: "scroller" }, h("table", { class: "plain" }, headings("", "Job", "Step", "Worker", "Batches", "For", "Expected", "Of expected"),
      h("tbody", {}, rows.slice(0, 100).map(({ lease, took, share }) => h("tr", {},
        h("td", {}, isStuck(lease) ? pill("failing", "Stuck") : pill("running")),
        h("td", {}, h("a", { href: `/jobs/${lease.job}` }, lease.job_name)),
        h("td", {}, `${lease.kind} ${lease.kind === "build" ? "" : lease.name}, segment ${lease.segment}`),
        h("td", {}, h("a", { href: `/workers?search=${encodeURIComponent(lease.worker)}` }, lease.worker)),
        h("td", { class: "number" }, count(lease.batches)), h("td", { class: "number" }, span(took)),
        h("td", { class: "number" }, expected(lease) ? span(expected(lease)) : "not known yet"),
        h("td", { class: "number" }, share === null ? "–" : `${Math.round(100 * share)} %`)))))),
    h("p", { class: "quiet" }, `Stuck means: longer than ${span(STUCK_LEAST_MS)}, and than ${STUCK_TIMES} times what its batches should take. Look at the worker first; locking it lets others take over when its lease runs out.`));
}

function drawJobs(element, jobs) {
  const groups = new Map();
  for (const job of jobs) {
    const why = job.live?.waiting;
    if (!why || why === "flowing") continue;
    groups.set(why, [...(groups.get(why) ?? []), job]);
  }
  const sorted = [...groups].sort((a, b) => b[1].length - a[1].length);
  put(element, h("h2", {}, "What holds jobs up"), sorted.length === 0 ? h("p", {}, h("span", { class: "tone-done" }, "✓ "), "Every live job flows.") : sorted.map(([why, held]) => h("div", { class: "held" },
    h("h3", {}, `${reason(why)} `, h("span", { class: "quiet" }, count(held.length))), h("p", { class: "quiet" }, remedy(why)),
    h("ul", {}, held.slice(0, 20).map((job) => h("li", {}, h("a", { href: `/jobs/${job.id}` }, job.name), h("small", { class: "quiet" }, ` ${job.project} · ${job.submitted_by} · for ${span(now() - job.created_at)}${job.reason ? ` · ${job.reason}` : ""}`))), held.length > 20 && h("li", { class: "quiet" }, `and ${count(held.length - 20)} more`)))));
}

export async function show(main, context) {
  const late = h("section", { class: "attention", "aria-label": "Needs attention", hidden: true });
  const leases = h("section", { class: "panel", "aria-label": "Running batches" });
  const held = h("section", { class: "panel", "aria-label": "Jobs that wait" });
  main.append(h("div", { class: "bar-row" }, h("h1", {}, "Stuck")), late, held, leases);
  const refresh = async () => {
    const { found, leases: running, live } = await attention();
    // Those that wait stand below, by reason
    const others = found.filter((trouble) => !trouble.shared);
    late.hidden = others.length === 0;
    put(late, h("h2", {}, "Needs attention ", h("span", { class: "quiet" }, count(others.length))), h("ul", {}, others.map(line)));
    drawLeases(leases, running);
    drawJobs(held, live);
  };
  await refresh();
  const timer = setInterval(() => { if (!document.hidden) refresh().catch(() => null); }, 3_000);
  context.while(() => clearInterval(timer));
  return "Stuck";
}
