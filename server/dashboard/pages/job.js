// One job: how far it is, why it waits, what failed, what it made.

import { get, may } from "/dashboard/api.js";
import { h, put } from "/dashboard/dom.js";
import { bytes, count, fileName, moment, now, share, short, span } from "/dashboard/format.js";
import { buttons } from "/dashboard/job/actions.js";
import { Batches } from "/dashboard/job/batches.js";
import { drawFailures } from "/dashboard/job/failures.js";
import { drawFigures } from "/dashboard/job/figures.js";
import { drawPace } from "/dashboard/job/pace.js";
import { drawPasses } from "/dashboard/job/passes.js";
import { Strips } from "/dashboard/job/strip.js";
import { drawWork } from "/dashboard/job/work.js";
import { onEvent } from "/dashboard/live.js";
import { bar, jobState, pill, reason, remedy, total } from "/dashboard/words.js";

const FINAL = ["succeeded", "failed", "cancelled"];

export async function show(main, context) {
  const { id } = context;
  const head = h("div", {});
  const passes = h("section", { class: "panel", "aria-label": "Passes" });
  const strips = new Strips(id);
  const pace = h("section", { class: "panel", "aria-label": "Throughput" });
  const figures = h("section", { class: "panel", "aria-label": "Figures" });
  const failures = h("section", { class: "panel", "aria-label": "Failures", hidden: true });
  const outputs = h("section", { class: "panel", "aria-label": "Results", hidden: true });
  const work = h("section", { class: "panel", "aria-label": "Who baked it", hidden: true });
  const batches = new Batches(id);
  main.append(head, outputs, h("div", { class: "columns" }, h("div", {}, failures, passes, strips.element, work, batches.element), h("div", {}, pace, figures)));

  let last = "";
  let job = null;
  const refresh = async () => {
    job = await get(`/v1/jobs/${id}`);
    const text = JSON.stringify(job);
    drawHead(head, job, refresh);
    if (text !== last) {
      drawPasses(passes, job);
      drawFigures(figures, job);
    }
    await Promise.all([strips.refresh(job), drawPace(pace, job), text !== last && drawFailures(failures, job, (pass, batch) => batches.open(pass, batch)), text !== last && drawWork(work, job), text !== last && batches.refresh(job)]);
    if (job.state === "succeeded" && (outputs.hidden || text !== last)) await drawOutputs(outputs, job);
    last = text;
  };
  await refresh();
  const again = () => refresh().catch(() => null);
  let pending = 0;
  context.while(onEvent((event) => {
    if (event.job !== id) return;
    if (event.kind === "progress") {
      job = { ...job, batches: event.batches, waiting: event.now.waiting, left_ms: event.now.left_ms };
      drawHead(head, job, refresh);
      return;
    }
    clearTimeout(pending);
    pending = setTimeout(again, 200);
  }));
  const timer = setInterval(() => { if (!document.hidden && !FINAL.includes(job.state)) again(); }, 2_000);
  context.while(() => { clearInterval(timer); clearTimeout(pending); strips.end(); });
  return job.name;
}

function drawHead(element, job, refresh) {
  // Buttons that somebody has the keyboard on stay as they are
  if (element.contains(document.activeElement) && element.dataset.version === String(job.version)) return;
  element.dataset.version = job.version;
  const final = FINAL.includes(job.state);
  const facts = [job.project, job.shot, job.frame !== null && `frame ${job.frame}`, `by ${job.submitted_by}`, `submitted ${moment(job.created_at)}`,
    job.ended_at ? `ended ${moment(job.ended_at)}, after ${span(job.ended_at - (job.started_at ?? job.created_at))}` : job.started_at ? `running for ${span(now() - job.started_at)}` : `waiting for ${span(now() - job.created_at)}`,
    `priority ${job.priority}`].filter(Boolean);
  const all = total(job.batches);
  put(element,
    h("p", { class: "crumbs" }, h("a", { href: "/jobs" }, "Jobs"), " / ", h("span", { class: "mono" }, job.id)),
    h("div", { class: "bar-row" }, h("h1", {}, job.name), pill(jobState(job)), h("span", { class: "grow" }),
      h("a", { class: "button", href: `/jobs/${job.id}/report` }, "Report"),
      job.batches.done > 0 && h("a", { class: job.state === "succeeded" ? "button primary" : "button", href: `/jobs/${job.id}/bake` }, job.state === "succeeded" ? "See the bake" : "See it so far"),
      may("submitter") && buttons(job, refresh)),
    h("p", { class: "facts" }, facts.map((fact) => h("span", {}, fact))),
    job.comment && h("p", { class: "comment" }, job.comment),
    all > 0 && h("div", { class: "progress" }, bar(job.batches), h("span", {}, h("strong", {}, share(job.batches.done, all)), ` ${count(job.batches.done)} of ${count(all)} batches`),
      job.left_ms !== null && !final && h("span", {}, "about ", h("strong", {}, span(job.left_ms)), " left")),
    notice(job, final));
}

/** Why nothing more of it runs, and what to do. */
function notice(job, final) {
  if (job.state === "failed") return h("div", { class: "notice failed", role: "note" }, h("span", { class: "tone-failed" }, "✕"), h("p", {}, h("strong", {}, "Failed. "), job.reason, ". The failures below say why; “Retry failed” tries again, “Skip failed” does without."));
  if (final || job.waiting === "flowing") return job.reason && !final ? h("div", { class: "notice" }, h("p", {}, job.reason)) : null;
  return h("div", { class: "notice", role: "note" }, h("span", { class: "tone-paused", "aria-hidden": "true" }, "‖"), h("p", {}, h("strong", {}, `Waits: ${reason(job.waiting).toLowerCase()}. `), remedy(job.waiting), job.reason && h("small", { class: "quiet" }, ` (${job.reason})`),
    job.requires.length > 0 && h("small", {}, ` Asks for: ${job.requires.join(", ")}.`), job.depends_on.length > 0 && job.state === "blocked" && h("small", {}, " After: ", job.depends_on.map((other) => h("a", { href: `/jobs/${other}` }, other)), ".")));
}

async function drawOutputs(element, job) {
  const manifest = await get(`/v1/jobs/${job.id}/manifest`);
  element.hidden = false;
  put(element, h("h2", {}, "Results ", manifest.incomplete && h("span", { class: "tone-paused" }, "‖ incomplete: points lack a result")),
    h("div", { class: "outputs" }, manifest.outputs.map((output) => {
      const set = output.name.replace(/\.mgs$/, "");
      const view = `/jobs/${job.id}/bake?set=${encodeURIComponent(set)}`;
      const picture = output.picture && h("a", { href: view }, h("img", { src: `/v1/jobs/${job.id}/outputs/${encodeURIComponent(output.name)}/picture`, alt: `${set} under a clear sky` }));
      return h("figure", {}, picture, h("figcaption", {}, h("strong", {}, set), h("small", { class: "quiet" }, `${short(output.baked)} points · ${bytes(output.bytes)}`),
        h("span", {}, output.preview && h("a", { href: view }, "View"), output.preview && " · ", h("a", { href: `/v1/jobs/${job.id}/outputs/${encodeURIComponent(output.name)}`, download: output.name }, `Download ${fileName(output.name)}`))));
    })));
}
