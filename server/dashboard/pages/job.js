// One job: how far it is, why it waits, what failed, what it made.

import { get } from "/dashboard/api.js";
import { h, put } from "/dashboard/dom.js";
import { ago, bytes, count, fileName, moment, now, share, short, span } from "/dashboard/format.js";
import { buttons } from "/dashboard/job/actions.js";
import { may } from "/dashboard/api.js";
import { Batches } from "/dashboard/job/batches.js";
import { drawFailures } from "/dashboard/job/failures.js";
import { drawPace } from "/dashboard/job/pace.js";
import { drawPasses } from "/dashboard/job/passes.js";
import { Strips } from "/dashboard/job/strip.js";
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
  const batches = new Batches(id);
  main.append(head, outputs, h("div", { class: "columns" }, h("div", {}, passes, strips.element, failures, batches.element), h("div", {}, pace, figures)));

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
    await Promise.all([strips.refresh(job), drawPace(pace, job), text !== last && drawFailures(failures, job, (pass, batch) => batches.open(pass, batch)), text !== last && batches.refresh(job)]);
    if (job.state === "succeeded" && (outputs.hidden || text !== last)) await drawOutputs(outputs, job);
    last = text;
  };
  await refresh();
  const again = () => refresh().catch(() => null);
  let pending = 0;
  context.while(onEvent((event) => {
    if (event.job !== id) return;
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
      job.state === "succeeded" && h("a", { class: "button primary", href: `/jobs/${job.id}/bake` }, "See the bake"),
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

function drawFigures(element, job) {
  const result = (kind) => job.passes.filter((pass) => pass.kind === kind && pass.result).map((pass) => pass.result);
  const sum = (kind, key) => result(kind).reduce((all, one) => all + one[key], 0);
  const bakes = job.passes.filter((pass) => pass.kind === "bake");
  const mean = bakes.filter((pass) => pass.batch_ms > 0);
  const bricks = sum("build", "bricks");
  const micropolygons = sum("build", "micropolygons");
  const rows = [
    ["Points", sum("plan", "points") && count(sum("plan", "points"))],
    ["Baked", sum("merge", "points") && `${count(sum("merge", "baked"))} (${share(sum("merge", "baked"), sum("merge", "points"))})`],
    ["Batch, mean", mean.length && span(mean.reduce((all, pass) => all + pass.batch_ms, 0) / mean.length)],
    ["Bricks", bricks && count(bricks)],
    ["Brick maps", bricks && bytes(sum("build", "bytes"))],
    ["Micropolygons", micropolygons && `${short(micropolygons)}, ${(sum("build", "bytes") / micropolygons).toFixed(1)} B each`],
    ["Maps of other jobs used", job.passes.filter((pass) => pass.reused).length || null],
    ["Result", sum("merge", "bytes") && bytes(sum("merge", "bytes"))],
  ].filter(([, value]) => value);
  const { settings } = job;
  const asked = Object.entries({ "Rays per point": settings.samples, "Points at most": settings.max_points, "Level of detail": settings.lod, "Far field": settings.far_field, Seed: settings.seed || null, Frame: settings.frame }).filter(([, value]) => value !== undefined && value !== null);
  put(element, h("h2", {}, "Figures"), rows.length === 0 ? h("p", { class: "quiet" }, "None yet.") : list(rows), asked.length > 0 && [h("h2", { class: "later" }, "Asked for"), list(asked)],
    job.resubmit_of && h("p", { class: "quiet" }, "Submitted again from ", h("a", { href: `/jobs/${job.resubmit_of}` }, job.resubmit_of)));
}

const list = (rows) => h("dl", {}, rows.map(([name, value]) => [h("dt", {}, name), h("dd", {}, value)]));

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
