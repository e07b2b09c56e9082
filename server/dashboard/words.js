// The farm's words as people read them: each state with a sign beside its colour, each reason with what to do about it.

import { h } from "/dashboard/dom.js";

const STATES = {
  blocked: ["⋯", "Blocked", "quiet"],
  ready: ["○", "Ready", "ready"],
  running: ["▶", "Running", "running"],
  cancelling: ["⊘", "Being cancelled", "quiet"],
  succeeded: ["✓", "Succeeded", "done"],
  failed: ["✕", "Failed", "failed"],
  cancelled: ["⊘", "Cancelled", "quiet"],
  paused: ["‖", "Paused", "paused"],
  failing: ["!", "Failing", "failed"],
  creating: ["⋯", "Being created", "quiet"],
  waiting: ["⋯", "Waiting", "quiet"],
  open: ["▶", "Running", "running"],
  done: ["✓", "Done", "done"],
  leased: ["▶", "Running", "running"],
  skipped: ["⊘", "Skipped", "quiet"],
  busy: ["▶", "Busy", "running"],
  idle: ["○", "Idle", "ready"],
  draining: ["↧", "Draining", "paused"],
  locked: ["‖", "Locked", "paused"],
  sick: ["✚", "Sick", "failed"],
  lost: ["?", "Lost", "failed"],
};

/** The state of a job as people see it: paused and failing come before the rest. */
export function jobState(job) {
  if (job.paused && !["succeeded", "failed", "cancelled"].includes(job.state)) return "paused";
  if (job.state === "running" && job.batches.failed > 0) return "failing";
  return job.state;
}

/** A state with its sign. */
export function pill(state, text) {
  const [sign, word, tone] = STATES[state] ?? ["·", state, "quiet"];
  return h("span", { class: `pill tone-${tone}` }, h("span", { class: "sign", "aria-hidden": "true" }, sign), text ?? word);
}

/** A state's tone, for bars. */
export const tone = (state) => (STATES[state] ?? STATES.waiting)[2];

const REASONS = {
  flowing: ["Flowing", "Batches are running, or will be within a second."],
  no_worker: ["No worker", "Nobody works on this farm. Start workers, or unlock those that are locked."],
  no_match: ["No match", "No worker has the labels that this job asks for. Start one that does, or submit the job with other labels."],
  capacity: ["Capacity", "Every worker that matches is busy with other jobs. Raise the priority, or wait."],
  limit: ["Job's limit", "As many batches run at once as the job may. Raise its limit."],
  quota: ["Project's limit", "The project runs as many batches at once as it may. An administrator can raise that under Limits."],
  paused: ["Paused", "Nothing more is claimed until somebody resumes the job. If the coordinator paused it, look at the failures first."],
  dependency: ["Dependency", "Another job or pass must end first."],
  backoff: ["Back-off", "Storage or network failed a moment ago. It is tried again by itself."],
  all_workers_blocked: ["All workers blocked", "Every worker that matches has failed at this job too often. See the failures, then retry."],
};

/** A reason in two words. */
export const reason = (waiting) => (REASONS[waiting] ?? [waiting, ""])[0];
/** What to do about a reason. */
export const remedy = (waiting) => (REASONS[waiting] ?? ["", ""])[1];

const CLASSES = {
  input: "Input",
  transient_io: "Storage or network",
  resource_memory: "Out of memory",
  worker_fault: "Worker at fault",
  crash: "Crash",
  lost: "Worker lost",
  timeout: "Took too long",
  verify: "Result damaged",
  interrupted: "Given back",
};
/** A class of failures. */
export const failureClass = (name) => CLASSES[name] ?? name;

/** The parts of a stacked bar, in order, with their signs. */
export const PARTS = [
  ["done", "✓", "done"],
  ["leased", "▶", "running"],
  ["failed", "✕", "failed"],
  ["skipped", "⊘", "skipped"],
  ["ready", "○", "ready"],
];

/** All batches of counts. */
export const total = (counts) => counts.ready + counts.leased + counts.done + counts.failed + counts.skipped;

/** A stacked bar of batches by state, with the counts as its description. */
export function bar(counts) {
  const all = total(counts);
  const text = PARTS.filter(([key]) => counts[key] > 0).map(([key, , word]) => `${counts[key].toLocaleString("en-US")} ${word}`);
  const bar = h("span", { class: "bar", role: "img", "aria-label": text.join(", ") || "no batches yet", title: text.join(" · ") || "no batches yet" });
  for (const [key] of PARTS) {
    if (key === "ready" || counts[key] === 0) continue;
    bar.append(h("i", { class: `part-${key}`, style: { width: `${(100 * counts[key]) / all}%` } }));
  }
  return bar;
}
