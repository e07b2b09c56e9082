// What can be done to jobs: asked first where it destroys, and told what came of it.

import { change } from "/dashboard/api.js";
import { ask, tell, tellProblem } from "/dashboard/dialog.js";
import { h } from "/dashboard/dom.js";

const FINAL = ["succeeded", "failed", "cancelled"];
const open = (job) => !FINAL.includes(job.state);

const ACTIONS = [
  { name: "Pause", past: "paused", fits: (job) => open(job) && !job.paused, run: (job) => change("POST", `/v1/jobs/${job.id}/pause`) },
  { name: "Resume", past: "resumed", fits: (job) => open(job) && job.paused, run: (job) => change("POST", `/v1/jobs/${job.id}/resume`) },
  { name: "Retry failed", past: "retried", fits: (job) => job.state !== "succeeded" && job.state !== "cancelled" && (job.batches.failed > 0 || job.state === "failed"), run: (job) => change("POST", `/v1/jobs/${job.id}/retry`, {}) },
  { name: "Skip failed", past: "made to do without", danger: true, question: "Batches that failed are skipped. What is published will be marked as incomplete.", fits: (job) => job.batches.failed > 0 && job.state !== "cancelled", run: (job) => change("POST", `/v1/jobs/${job.id}/skip`, {}) },
  { name: "Priority", past: "given another priority", fits: open, fields: (jobs) => [{ name: "priority", label: "Priority, 0 to 100", type: "number", min: 0, max: 100, required: true, value: String(jobs[0].priority), note: "A job of twice the priority gets twice the chance." }], run: (job, { priority }) => change("PATCH", `/v1/jobs/${job.id}`, { priority: Number(priority) }) },
  { name: "Comment", past: "given a comment", single: true, fits: () => true, fields: ([job]) => [{ name: "comment", label: "Comment", value: job.comment }], run: (job, { comment }) => change("PATCH", `/v1/jobs/${job.id}`, { comment }) },
  { name: "Batches at once", past: "given another limit", single: true, fits: open, fields: () => [{ name: "max", label: "Batches that run at once at most", type: "number", min: 1, required: true, value: "8" }], run: (job, { max }) => change("PATCH", `/v1/jobs/${job.id}`, { running_max: Number(max) }) },
  { name: "Submit again", past: "submitted again", fits: (job) => !open(job), run: (job) => change("POST", `/v1/jobs/${job.id}/resubmit`, {}) },
  { name: "Cancel", past: "cancelled", danger: true, question: "Nothing more of it is baked, and what has been baked is not published. This cannot be taken back.", fits: open, run: (job) => change("POST", `/v1/jobs/${job.id}/cancel`) },
];

async function act(action, jobs, done) {
  const what = jobs.length === 1 ? `“${jobs[0].name}”` : `${jobs.length} jobs`;
  const fields = action.fields?.(jobs) ?? [];
  let values = {};
  if (action.danger || fields.length > 0 || jobs.length > 1) {
    values = await ask({ title: `${action.name}: ${what}`, text: action.question, action: action.danger ? `${action.name} ${jobs.length > 1 ? jobs.length : ""}`.trim() : action.name, danger: action.danger, fields });
    if (values === null) return;
  }
  const failures = [];
  for (const job of jobs) {
    try {
      await action.run(job, values);
    } catch (problem) {
      failures.push(problem);
    }
  }
  const worked = jobs.length - failures.length;
  if (worked > 0) tell(jobs.length === 1 ? `${what} was ${action.past}.` : `${worked} of ${jobs.length} jobs were ${action.past}.`);
  if (failures.length > 0) tellProblem(failures[0], failures.length === 1 ? action.name : `${action.name} failed ${failures.length} times`);
  await done();
}

/** Buttons for one job: those that fit what it is. */
export function buttons(job, done) {
  return ACTIONS.filter((action) => action.fits(job)).map((action) => h("button", { class: action.danger ? "danger" : "", onclick: () => act(action, [job], done) }, action.name));
}

/** Buttons for the jobs that are selected: each acts on those that it fits. */
export function bulk(jobs, done) {
  return ACTIONS.filter((action) => !action.single).map((action) => h("button", { class: action.danger ? "danger" : "", onclick: () => {
    const fitting = jobs().filter(action.fits);
    if (fitting.length === 0) tell(`${action.name} fits none of the selected jobs.`, "failed");
    else act(action, fitting, done);
  } }, action.name));
}
