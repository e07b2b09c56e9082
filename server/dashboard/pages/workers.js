// Who works: what each does, how well, and what an administrator can do about it.

import { change, get, may } from "/dashboard/api.js";
import { ask, tell, tellProblem } from "/dashboard/dialog.js";
import { h, put } from "/dashboard/dom.js";
import { ago, bytes, count, now, span } from "/dashboard/format.js";
import { Table, sayCount } from "/dashboard/table.js";
import { bytesPerRay, cacheHitsCell, raysPerSecond } from "/dashboard/traced.js";
import { pill } from "/dashboard/words.js";

const ORDER = ["sick", "lost", "locked", "draining", "busy", "idle"];
const ACTIONS = {
  drain: { name: "Drain", text: "It finishes the batches that it has, and claims nothing more.", past: "is draining", fits: (worker) => ["busy", "idle"].includes(worker.state) },
  lock: { name: "Lock", text: "It claims nothing more until it is unlocked. What it has goes on.", past: "is locked", fits: (worker) => !["locked", "lost"].includes(worker.state) },
  unlock: { name: "Unlock", past: "may work again; its errors are forgiven", fits: (worker) => ["locked", "sick", "draining"].includes(worker.state) },
};

async function act(action, worker, done) {
  const { name, text, past } = ACTIONS[action];
  if (text && !(await ask({ title: `${name}: ${worker.name}`, text, action: name, danger: action !== "unlock" }))) return;
  try {
    await change("POST", `/v1/workers/${encodeURIComponent(worker.name)}/${action}`, {});
    tell(`${worker.name} ${past}.`);
  } catch (problem) {
    tellProblem(problem, name);
  }
  await done();
}

export async function show(main, context) {
  const asked = new URLSearchParams(location.search).get("search") ?? "";
  const counter = h("span", { class: "quiet", role: "status" });
  const search = h("input", { type: "search", "aria-label": "Search workers", placeholder: "Name, label, state …  ( / )", value: asked, oninput: () => table.reset() });
  let workers = [];
  const columns = [
    { name: "State", className: "c-state", render: (worker) => pill(worker.state) },
    { name: "Worker", className: "c-name", render: (worker) => h("span", { class: "two" }, h("strong", {}, worker.name), h("small", {}, [worker.version && `version ${worker.version}`, ...worker.labels].filter(Boolean).join(" · ") || "no labels")) },
    { name: "Now", className: "c-now", render: (worker) => (worker.lease ? h("span", { class: "two" }, h("a", { href: `/jobs/${worker.lease.job}` }, worker.lease.job_name), h("small", {}, `${worker.lease.kind} ${worker.lease.kind === "build" ? "" : worker.lease.name}, segment ${worker.lease.segment}`)) : h("span", { class: "quiet", title: worker.reason ?? "" }, worker.reason || "–")) },
    { name: "For", className: "c-number", render: (worker) => (worker.lease ? h("span", { title: `${count(worker.leased)} batches` }, span(now() - worker.lease.granted_at)) : "–") },
    { name: "Device", className: "c-device", render: (worker) => h("span", { class: "two", title: worker.device }, h("span", {}, worker.device || "not known yet"), h("small", {}, worker.memory_bytes ? `${bytes(worker.memory_bytes)} of memory` : "")) },
    { name: "Rays", className: "c-number", render: (worker) => raysPerSecond(worker.traced) ?? "–" },
    { name: "Cache hits", className: "c-number", render: (worker) => cacheHitsCell(worker.traced) },
    { name: "Per ray", className: "c-number c-rate", render: (worker) => h("span", { title: "bytes that it reads for each ray" }, bytesPerRay(worker.traced) ?? "–") },
    { name: "Errors", className: "c-number", render: (worker) => (worker.errors ? h("strong", { class: "tone-failed", title: "batches of which it was to blame lately; at five it rests for half an hour" }, `${count(worker.errors)} of 5`) : "–") },
    { name: "Heard", className: "c-age", render: (worker) => ago(worker.last_seen) },
    may("admin") && { name: "", className: "c-actions", render: (worker) => Object.entries(ACTIONS).filter(([, action]) => action.fits(worker)).map(([key, action]) => h("button", { onclick: () => act(key, worker, refresh) }, action.name)) },
  ].filter(Boolean);
  const table = new Table({
    columns, label: "Workers", id: (worker) => worker.name, open: (worker) => worker.lease && context.go(`/jobs/${worker.lease.job}`),
    fetch: async (offset, limit) => {
      const wanted = search.value.trim().toLowerCase();
      const rows = workers.filter((worker) => `${worker.name} ${worker.state} ${worker.labels.join(" ")}`.toLowerCase().includes(wanted));
      return { rows: rows.slice(offset, offset + limit), total: rows.length };
    },
    empty: () => h("div", { class: "empty" }, h("h2", {}, workers.length ? "No worker matches" : "No workers yet"), workers.length ? null : h("p", {}, "Start one with ", h("code", {}, "pantaray worker --token-file worker.token"), ".")),
  });
  table.element.classList.add("tall");
  const refresh = async () => {
    const [all, leases] = await Promise.all([get("/v1/workers"), get("/v1/leases")]);
    const by = new Map(leases.map((lease) => [lease.worker, lease]));
    workers = all.map((worker) => ({ ...worker, lease: by.get(worker.name) }));
    workers.sort((a, b) => ORDER.indexOf(a.state) - ORDER.indexOf(b.state) || a.name.localeCompare(b.name));
    await table.refresh();
    if (table.total === 0) await table.reset();
    sayCount(counter, table, "worker");
  };
  main.classList.add("fill");
  context.while(() => main.classList.remove("fill"));
  main.append(h("div", { class: "bar-row" }, h("h1", {}, "Workers"), counter, h("span", { class: "grow" }), search), table.element);
  const timer = setInterval(() => { if (!document.hidden) refresh().catch(() => null); }, 3_000);
  context.while(() => { clearInterval(timer); table.end(); });
  await refresh();
  await table.reset();
  sayCount(counter, table, "worker");
  return "Workers";
}
