// What there is to look at: bakes that are published, what there is so far of one that is under way, others to compare with.

import { get, query } from "/dashboard/api.js";
import { moment } from "/dashboard/format.js";
import { Preview } from "/dashboard/viewer/preview.js";

const path = (job, set) => `/v1/jobs/${job}/outputs/${encodeURIComponent(`${set}.mgs`)}/preview`;

/** The bake sets of a job that can be seen: `{set, url}`, and how far a bake is that is under way as `sofar`. */
export async function sourcesOf(job) {
  if (job.state === "succeeded") {
    const { outputs } = await get(`/v1/jobs/${job.id}/manifest`);
    return outputs.filter((output) => output.preview).map(({ name }) => name.replace(/\.mgs$/, "")).map((set) => ({ set, url: path(job.id, set) }));
  }
  const found = await get(`/v1/jobs/${job.id}/provisional`);
  return found.map((sofar) => {
    const set = sofar.name.replace(/\.mgs$/, "");
    return { set, url: query(path(job.id, set), { pass: sofar.pass, made: sofar.made_at }), sofar };
  });
}

/** Opens a preview. */
export async function open(url) {
  const preview = new Preview(url);
  await preview.open();
  return preview;
}

/** Opens what a link calls `job/set`: a bake that is published. */
export function openOther(other) {
  const [job, set] = other.split("/");
  return open(path(job, set));
}

/** Other bakes that this one can be compared with: its own job's other sets, and late jobs of the same project. */
export async function candidates(job, set, sets) {
  const own = job.state === "succeeded" ? sets.filter((name) => name !== set).map((name) => [`${job.id}/${name}`, `${name}, of this job`]) : [];
  const page = await get(query("/v1/jobs", { project: job.project, state: "succeeded", limit: 30 }));
  const others = page.jobs.filter((other) => other.id !== job.id).map((other) => [`${other.id}/${set}`, `${other.name}, ${moment(other.created_at)}`]);
  return [...own, ...others];
}
