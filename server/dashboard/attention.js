// Which jobs need somebody, why, and what to do: what a newcomer has to be told first.

import { get, query } from "/dashboard/api.js";
import { h } from "/dashboard/dom.js";
import { count, now, span } from "/dashboard/format.js";
import { pill, reason, remedy } from "/dashboard/words.js";

const LIVE = ["running", "ready", "blocked"];
const [LIVE_MAX, FAILED_MAX] = [200, 20];
/** A lease counts as stuck when it lasts as many times as long as its batches should, and this long. */
export const [STUCK_TIMES, STUCK_LEAST_MS] = [8, 10 * 60_000];
/** Names of jobs in one line. */
const NAMES_MAX = 4;
/** A job may wait for its turn this long before somebody is told. */
const TURN_MS = 10 * 60_000;
/** Failed jobs are told of for a day. */
const FAILED_MS = 86_400_000;

/** Milliseconds that a lease should take; 0 where nobody knows. */
export const expected = (lease) => lease.batches * lease.batch_ms;
/** Whether a lease lasts far longer than it should. */
export const isStuck = (lease) => now() - lease.granted_at > Math.max(STUCK_LEAST_MS, STUCK_TIMES * expected(lease));

/** What a live job suffers from, worst first; nothing where it flows. */
function troubles(job, leases) {
  const found = [];
  const stuck = leases.filter((lease) => lease.job === job.id && isStuck(lease));
  for (const lease of stuck) {
    const took = now() - lease.granted_at;
    const times = expected(lease) ? `, ${Math.round(took / expected(lease))} times as long as it should` : "";
    found.push({ weight: 5, state: "failing", word: "Stuck", why: `segment ${lease.segment} has run on ${lease.worker} for ${span(took)}${times}.`, todo: ["Look at ", h("a", { href: `/workers?search=${encodeURIComponent(lease.worker)}` }, lease.worker), "; lock it, and another worker takes over when its lease runs out."] });
  }
  const waiting = job.live?.waiting;
  const waited = now() - job.created_at;
  if (job.batches.failed > 0) found.push({ weight: 4, state: "failing", word: "Failing", why: `${count(job.batches.failed)} of its batches have failed for good.`, todo: ["Read the failures on ", h("a", { href: `/jobs/${job.id}` }, "its page"), ", then retry or skip them."] });
  if (waiting === "paused") {
    // Who paused it knows; what the coordinator paused nobody may have noticed
    if (job.reason) found.push({ weight: 4, state: "paused", word: "Paused", why: `the coordinator paused it: ${job.reason}.`, todo: ["Read the failures on ", h("a", { href: `/jobs/${job.id}` }, "its page"), ", mend the cause, then resume it."] });
  } else if (waiting === "capacity") {
    if (waited > TURN_MS && job.batches.leased === 0) found.push({ weight: 1, state: "waiting", word: "Waits", shared: waiting, why: `it has waited for its turn for ${span(waited)}.`, todo: [remedy(waiting)] });
  } else if (waiting && !["flowing", "dependency"].includes(waiting)) {
    found.push({ weight: 3, state: "paused", word: "Held up", shared: waiting, why: `${reason(waiting).toLowerCase()}, for ${span(waited)}.`, todo: [remedy(waiting)] });
  }
  return found;
}

/** Everything that needs somebody, worst and oldest first: `{job, state, word, why, todo}`. */
export async function attention() {
  const list = (state, limit, order) => get(query("/v1/jobs", { state, limit, sort: "created", order }));
  const [leases, failed, ...pages] = await Promise.all([get("/v1/leases"), list("failed", FAILED_MAX, "desc"), ...LIVE.map((state) => list(state, LIVE_MAX, "asc"))]);
  const live = pages.flatMap((page) => page.jobs.map((job) => ({ ...job, live: page.live?.[job.id] })));
  const found = live.flatMap((job) => troubles(job, leases).map((trouble) => ({ job, ...trouble })));
  const late = failed.jobs.filter((job) => now() - (job.ended_at ?? 0) < FAILED_MS);
  found.push(...late.map((job) => ({ job, weight: 4, state: "failed", word: "Failed", why: `it failed ${span(now() - job.ended_at)} ago: ${job.reason || "see its page"}.`, todo: ["Read the failures on ", h("a", { href: `/jobs/${job.id}` }, "its page"), "; “Retry failed” tries again, “Skip failed” does without."] })));
  found.sort((a, b) => b.weight - a.weight || a.job.created_at - b.job.created_at);
  return { found: together(found), leases, live };
}

/** Jobs that are held up by the same are one line. */
function together(found) {
  const lines = new Map();
  for (const trouble of found) {
    const key = trouble.shared ?? `${trouble.job.id} ${trouble.why}`;
    const line = lines.get(key);
    if (line) line.jobs.push(trouble.job);
    else lines.set(key, { ...trouble, jobs: [trouble.job] });
  }
  return [...lines.values()];
}

/** One line of it. */
export function line({ jobs, state, word, why, todo }) {
  const names = jobs.slice(0, NAMES_MAX).map((job, at) => [at > 0 && ", ", h("a", { href: `/jobs/${job.id}` }, job.name)]);
  return h("li", {}, pill(state, word), h("p", {}, names, jobs.length > NAMES_MAX && ` and ${count(jobs.length - NAMES_MAX)} more`, ": ", why, " ", h("span", { class: "quiet" }, todo)));
}
