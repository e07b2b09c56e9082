// Who changed what: every change by anybody, from anywhere, latest first.

import { get, query } from "/dashboard/api.js";
import { h, put } from "/dashboard/dom.js";
import { ago, moment } from "/dashboard/format.js";

const PAGE = 200;

/** A request as a person would say it. */
function said(action) {
  const [method, path] = action.split(" ");
  const parts = path.split("/").slice(2);
  const [noun, name, verb] = parts;
  if (noun === "jobs" && !name) return ["submitted a job"];
  if (noun === "jobs" && name === "validate") return ["asked what a scene would take"];
  if (noun === "jobs") return [`${{ cancel: "cancelled", pause: "paused", resume: "resumed", retry: "retried", skip: "skipped batches of", resubmit: "submitted again" }[verb] ?? "changed"} job `, h("a", { href: `/jobs/${name}` }, h("code", {}, name))];
  if (noun === "workers") return [`${{ lock: "locked", unlock: "unlocked", drain: "drained" }[verb] ?? verb} worker `, h("a", { href: `/workers?search=${name}` }, name)];
  if (noun === "tokens") return verb === "revoke" ? ["revoked token ", h("code", {}, name)] : ["made a token"];
  if (noun === "tickets") return ["made a ticket"];
  if (noun === "projects") return ["changed the limits of ", h("strong", {}, name)];
  if (noun === "assets") return [name === "missing" ? "asked which files are missing" : "uploaded a file"];
  if (noun === "session") return [method === "DELETE" ? "signed out" : "signed in"];
  return [action];
}

export async function show(main) {
  const body = h("tbody", {});
  const search = h("input", { type: "search", "aria-label": "Search what is shown", placeholder: "Search what is shown  ( / )", oninput: () => draw() });
  const more = h("button", { onclick: () => load() }, "Earlier");
  let entries = [];
  let next;
  const draw = () => {
    const wanted = search.value.trim().toLowerCase();
    const rows = entries.filter((entry) => `${entry.actor} ${entry.action} ${entry.address}`.toLowerCase().includes(wanted));
    put(body, rows.map((entry) => h("tr", {},
      h("td", { title: ago(entry.at) }, moment(entry.at)), h("td", {}, h("strong", {}, entry.actor)), h("td", {}, said(entry.action)),
      h("td", {}, entry.status < 400 ? h("span", { class: "tone-done" }, `✓ ${entry.status}`) : h("span", { class: "tone-failed" }, `✕ ${entry.status}`)),
      h("td", { class: "mono quiet" }, entry.address))), rows.length === 0 && h("tr", {}, h("td", { colspan: 5, class: "quiet" }, "Nothing.")));
    more.hidden = !next;
  };
  const load = async () => {
    const page = await get(query("/v1/audit", { after: next, limit: PAGE }));
    entries = [...entries, ...page.entries];
    next = page.next;
    draw();
  };
  main.append(h("div", { class: "bar-row" }, h("h1", {}, "Audit"), h("span", { class: "grow" }), search), h("section", { class: "panel", "aria-label": "Changes" }, h("div", { class: "scroller" }, h("table", { class: "plain" }, h("thead", {}, h("tr", {}, ["When", "Who", "Did what", "Outcome", "From"].map((name) => h("th", { scope: "col" }, name)))), body)), more));
  await load();
  return "Audit";
}
