// All jobs: filtered, sorted and paged by the coordinator, acted on in bulk.

import { get, may, query } from "/dashboard/api.js";
import { attention, line } from "/dashboard/attention.js";
import { h, put, say } from "/dashboard/dom.js";
import { ago, count, now, share, short, span } from "/dashboard/format.js";
import { bulk } from "/dashboard/job/actions.js";
import { onEvent } from "/dashboard/live.js";
import { sayCount, Table } from "/dashboard/table.js";
import { bar, jobState, pill, reason, total } from "/dashboard/words.js";

/** Lines of what needs attention. */
const LATE_MAX = 3;
const STATES = ["", "running", "ready", "blocked", "failed", "succeeded", "cancelled"];
const FINAL = ["succeeded", "failed", "cancelled"];

function thumbnail(job) {
  if (job.state !== "succeeded") return h("span", { class: "thumb" });
  const picture = h("img", { src: `/v1/jobs/${job.id}/picture`, alt: "", loading: "lazy", onerror: () => picture.remove() });
  return h("span", { class: "thumb" }, picture);
}

const columns = [
  { name: "State", sort: "state", className: "c-state", render: (job) => pill(jobState(job)) },
  { name: "Job", sort: "name", className: "c-name", render: (job) => [thumbnail(job), h("span", { class: "two" }, h("a", { href: `/jobs/${job.id}` }, job.name), h("small", {}, [job.shot, job.frame !== null && `frame ${job.frame}`, job.comment].filter(Boolean).join(" · ")))] },
  { name: "Project", sort: "project", className: "c-project", render: (job) => job.project },
  { name: "Progress", className: "c-bar", render: (job) => [bar(job.batches), h("span", { class: "figure" }, total(job.batches) ? `${short(job.batches.done)} / ${short(total(job.batches))}` : "–")] },
  { name: "Left", className: "c-number", render: (job) => (job.live?.left_ms ? h("span", { title: "at the present pace" }, span(job.live.left_ms)) : job.ended_at && job.started_at ? h("span", { class: "quiet", title: "took" }, span(job.ended_at - job.started_at)) : "–") },
  { name: "Rate", className: "c-number c-rate", render: (job) => (job.live?.per_minute ? `${short(job.live.per_minute)}/m` : "–") },
  { name: "Running", className: "c-tiny", render: (job) => (job.batches.leased ? count(job.batches.leased) : "–") },
  { name: "Failed", className: "c-tiny", render: (job) => (job.batches.failed ? h("strong", { class: "tone-failed" }, count(job.batches.failed)) : "–") },
  { name: "Waits for", className: "c-reason", render: (job) => (FINAL.includes(job.state) ? h("span", { class: "quiet clip", title: job.reason }, job.reason || "–") : h("span", { class: job.live?.waiting === "flowing" ? "quiet" : "tone-paused", title: job.reason }, job.live ? reason(job.live.waiting) : "–")) },
  { name: "Prio", sort: "priority", className: "c-tiny", render: (job) => job.priority },
  { name: "Owner", sort: "owner", className: "c-owner", render: (job) => job.submitted_by },
  { name: "Age", sort: "created", className: "c-number c-age", render: (job) => h("span", { title: ago(job.created_at) }, span(now() - job.created_at)) },
];

/** What a list is of, as the address says. */
function readFilter() {
  const asked = new URLSearchParams(location.search);
  return { search: asked.get("search") ?? "", state: asked.get("state") ?? "", project: asked.get("project") ?? "", sort: asked.get("sort") ?? "created", order: asked.get("order") ?? "desc" };
}

export async function show(main, context) {
  const filter = readFilter();
  const counter = h("span", { class: "quiet", role: "status" });
  const search = h("input", { type: "search", "aria-label": "Search jobs", placeholder: "Name, owner, shot …  ( / )", value: filter.search });
  const state = h("select", { "aria-label": "State" }, STATES.map((word) => h("option", { value: word, selected: word === filter.state }, word ? word[0].toUpperCase() + word.slice(1) : "All states")));
  const project = h("select", { "aria-label": "Project" }, h("option", { value: "" }, "All projects"));
  const actions = h("div", { class: "bulk", hidden: true });
  const summary = h("div", { class: "cards" });
  const late = h("section", { class: "attention", "aria-label": "Needs attention", hidden: true });
  const table = new Table({
    columns, label: "Jobs", id: (job) => job.id, open: (job) => context.go(`/jobs/${job.id}`),
    fetch: async (offset, limit) => {
      const page = await get(query("/v1/jobs", { ...filter, offset, limit }));
      const rows = page.jobs.map((job) => ({ ...job, live: page.live?.[job.id] }));
      return { rows, total: page.total };
    },
    onSort: (sort) => {
      const first = ["name", "owner", "project", "state"].includes(sort) ? "asc" : "desc";
      filter.order = filter.sort === sort ? (filter.order === "asc" ? "desc" : "asc") : first;
      filter.sort = sort;
      apply();
    },
    onSelect: may("submitter") ? (selection) => drawActions(selection) : null,
    empty: () => (filter.search || filter.state || filter.project
      ? h("div", { class: "empty" }, h("h2", {}, "No job matches"), h("p", {}, "Change the filter, or ", h("a", { href: "/jobs" }, "see all jobs"), "."))
      : h("div", { class: "empty" }, h("h2", {}, "No jobs yet"), may("submitter") ? h("p", {}, "Drop a scene on ", h("a", { href: "/submit" }, "Submit"), ", or run ", h("code", {}, "pantaray submit scene.xml"), ".") : h("p", {}, "Someone with a submitter's token can submit one."))),
  });
  const drawActions = (selection) => {
    actions.hidden = selection.size === 0;
    const jobs = () => [...table.pages.values()].flat().filter((job) => selection.has(job.id));
    put(actions, h("strong", {}, `${count(selection.size)} selected`), bulk(jobs, () => table.refresh()), h("button", { class: "plain", onclick: () => table.selectAll(false) }, "Clear"));
  };
  let typing = 0;
  const apply = async () => {
    history.replaceState(null, "", query("/jobs", { search: filter.search, state: filter.state, project: filter.project, sort: filter.sort === "created" ? "" : filter.sort, order: filter.order === "desc" ? "" : filter.order }));
    table.drawHead(filter.sort, filter.order);
    await table.reset();
    sayCount(counter, table, "job");
  };
  const changed = () => {
    clearTimeout(typing);
    Object.assign(filter, { search: search.value.trim(), state: state.value, project: project.value });
    apply();
  };
  search.addEventListener("input", () => { clearTimeout(typing); typing = setTimeout(changed, 200); });
  state.addEventListener("change", changed);
  project.addEventListener("change", changed);
  main.classList.add("fill");
  context.while(() => main.classList.remove("fill"));
  main.append(h("div", { class: "bar-row" }, h("h1", {}, "Jobs"), counter, h("span", { class: "grow" }), search, state, project), summary, late, actions, table.element);

  const refresh = async () => {
    const [farm] = await Promise.all([get("/v1/farm"), table.refresh(), drawLate(late)]).catch(() => [null]);
    sayCount(counter, table, "job");
    if (farm) drawFarm(summary, farm);
  };
  let pending = 0;
  const soon = () => { clearTimeout(pending); pending = setTimeout(refresh, 300); };
  // How far a job is comes by itself; the rest is asked for
  context.while(onEvent((event) => {
    if (event.kind === "progress") table.patch(event.job, (job) => ({ ...job, batches: event.batches, live: event.now }));
    else soon();
  }));
  const timer = setInterval(() => { if (!document.hidden) refresh(); }, 4_000);
  context.while(() => { clearInterval(timer); clearTimeout(pending); clearTimeout(typing); table.end(); });
  table.drawHead(filter.sort, filter.order);
  const [projects] = await Promise.all([get("/v1/projects"), table.reset(), get("/v1/farm").then((farm) => drawFarm(summary, farm)), drawLate(late)]);
  projects.forEach(({ name }) => project.append(h("option", { value: name, selected: name === filter.project }, name)));
  sayCount(counter, table, "job");
  return "Jobs";
}

/** The jobs that need somebody most, with why and what to do. */
async function drawLate(element) {
  const { found } = await attention();
  element.hidden = found.length === 0;
  put(element, h("h2", {}, "Needs attention ", h("span", { class: "quiet" }, count(found.length))), h("ul", {}, found.slice(0, LATE_MAX).map(line)),
    found.length > LATE_MAX && h("p", {}, h("a", { href: "/stuck" }, `and ${count(found.length - LATE_MAX)} more`)));
}

/** The farm at a glance: who works, what could run, and what every job that waits waits for. */
function drawFarm(element, farm) {
  const waiting = Object.entries(farm.waiting).filter(([word]) => word !== "flowing");
  const card = (name, value, note, href) => h(href ? "a" : "div", { class: "card", href }, h("small", {}, name), h("strong", {}, value), h("small", { class: "quiet" }, note));
  const workers = farm.workers;
  put(element,
    card("Workers", `${count(workers.busy ?? 0)} busy`, Object.entries(workers).filter(([word]) => word !== "busy").map(([word, number]) => `${number} ${word}`).join(", ") || "none besides", "/workers"),
    card("Batches", `${short(farm.running)} running`, `${short(farm.ready)} ready`),
    card("Live jobs", count(farm.jobs), `${count(farm.waiting.flowing ?? 0)} flowing`),
    card("Held up", count(waiting.reduce((sum, [, number]) => sum + number, 0)), waiting.map(([word, number]) => `${number} ${reason(word).toLowerCase()}`).join(", ") || "nothing waits", "/stuck"));
}
