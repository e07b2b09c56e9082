// A job on paper: what was asked, what it took, what came out.

import { get } from "/dashboard/api.js";
import { h } from "/dashboard/dom.js";
import { bytes, count, moment, now, share, span } from "/dashboard/format.js";
import { list, tracedOf, tracedRows } from "/dashboard/job/figures.js";
import { bar, failureClass, jobState, pill, total } from "/dashboard/words.js";

const row = (name, value) => [h("dt", {}, name), h("dd", {}, value)];

export async function show(main, { id }) {
  const [job, failures] = await Promise.all([get(`/v1/jobs/${id}`), get(`/v1/jobs/${id}/failures`)]);
  const manifest = job.state === "succeeded" ? await get(`/v1/jobs/${id}/manifest`) : null;
  const took = (pass) => (pass.ended_at ? span(pass.ended_at - pass.created_at) : "–");
  const classes = new Map();
  failures.forEach((failure) => classes.set(failure.class, (classes.get(failure.class) ?? 0) + failure.count));
  main.append(h("article", { class: "report" },
    h("div", { class: "bar-row no-print" }, h("a", { href: `/jobs/${id}` }, "← Job"), h("span", { class: "grow" }), h("button", { class: "primary", onclick: () => print() }, "Print")),
    h("h1", {}, job.name), h("p", {}, pill(jobState(job)), job.reason && ` ${job.reason}`),
    h("p", { class: "quiet" }, `Report of job ${job.id}, as of ${moment(now())}`),
    h("div", { class: "report-pictures" }, manifest?.outputs.filter((output) => output.picture).map((output) => h("figure", {}, h("img", { src: `/v1/jobs/${id}/outputs/${encodeURIComponent(output.name)}/picture`, alt: output.name }), h("figcaption", {}, output.name)))),
    h("h2", {}, "Asked"), h("dl", {}, row("Project", job.project), job.shot && row("Shot", job.shot), job.frame !== null && row("Frame", job.frame), row("Submitted", `${moment(job.created_at)} by ${job.submitted_by}`), row("Priority", job.priority), row("Seed", job.settings.seed), job.settings.samples && row("Rays per point", job.settings.samples), job.comment && row("Comment", job.comment)),
    h("h2", {}, "Took"), h("dl", {}, row("From submission to end", span((job.ended_at ?? now()) - job.created_at)), job.started_at && row("Of that waiting", span(job.started_at - job.created_at)), row("Batches", [h("span", { class: "report-bar" }, bar(job.batches)), ` ${count(job.batches.done)} of ${count(total(job.batches))} (${share(job.batches.done, total(job.batches))})`])),
    tracedOf(job) && list(tracedRows(tracedOf(job))),
    h("table", { class: "plain" }, h("thead", {}, h("tr", {}, ["Pass", "About", "State", "Batches", "Took"].map((name) => h("th", { scope: "col" }, name)))), h("tbody", {}, job.passes.map((pass) => h("tr", {}, h("td", {}, pass.kind), h("td", { class: "mono" }, pass.name.slice(0, 24)), h("td", {}, pill(pass.state)), h("td", {}, count(total(pass.batches))), h("td", {}, pass.reused ? "reused" : took(pass)))))),
    h("h2", {}, "Failed on the way"), classes.size === 0 ? h("p", {}, "Nothing.") : h("ul", {}, [...classes].map(([name, times]) => h("li", {}, `${failureClass(name)}: ${count(times)} times`))),
    manifest && [h("h2", {}, "Came out"), manifest.incomplete && h("p", { class: "tone-paused" }, "‖ Incomplete: some points have no result."), h("table", { class: "plain" }, h("thead", {}, h("tr", {}, ["File", "Points", "With a result", "Size", "SHA-256"].map((name) => h("th", { scope: "col" }, name)))), h("tbody", {}, manifest.outputs.map((output) => h("tr", {}, h("td", {}, output.name), h("td", {}, count(output.points)), h("td", {}, count(output.baked)), h("td", {}, bytes(output.bytes)), h("td", { class: "mono sha" }, output.sha256)))))]));
  return `Report: ${job.name}`;
}
