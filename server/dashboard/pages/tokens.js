// Tokens and tickets: made, shown once, revoked.

import { change, get } from "/dashboard/api.js";
import { ask, present, tell, tellProblem } from "/dashboard/dialog.js";
import { h, put } from "/dashboard/dom.js";
import { ago, moment, now } from "/dashboard/format.js";
import { pill } from "/dashboard/words.js";

const ROLES = { viewer: "reads", submitter: "submits and controls jobs", worker: "works", admin: "everything" };

function showSecret(title, secret) {
  const text = h("input", { readonly: true, value: secret, class: "mono", "aria-label": "The secret", onfocus: () => text.select() });
  const copy = h("button", { class: "primary", onclick: async () => {
    text.select();
    // Without TLS browsers have no clipboard: what is selected can be copied by hand
    await navigator.clipboard?.writeText(secret).then(() => tell("Copied."), () => null);
  } }, "Copy");
  present(title, h("div", {}, h("p", {}, "This is shown once, now. It is not kept."), h("div", { class: "bar-row" }, h("span", { class: "grow" }, text), copy)));
}

async function make(done) {
  const projects = await get("/v1/projects");
  const role = h("select", {}, Object.entries(ROLES).map(([name, does]) => h("option", { value: name }, `${name}: ${does}`)));
  const project = h("select", {}, h("option", { value: "" }, "all projects"), projects.map(({ name }) => h("option", { value: name }, name)));
  const values = await ask({ title: "A new token", action: "Make it", fields: [
    { name: "label", label: "Whose", required: true, note: "The audit names it so." },
    { name: "role", label: "Role", input: role }, { name: "project", label: "For", input: project },
    { name: "days", label: "Days until it expires", type: "number", min: 1, max: 3650, note: "Empty: never." }] });
  if (!values) return;
  try {
    const made = await change("POST", "/v1/tokens", { label: values.label, role: values.role, project: values.project || null, expires_s: values.days ? values.days * 86_400 : null });
    showSecret(`Token of ${values.label}`, made.secret);
  } catch (problem) {
    tellProblem(problem, "No token was made");
  }
  await done();
}

async function ticket() {
  const values = await ask({ title: "A ticket for workers", text: "Each worker trades it for a token of its own.", action: "Make it", fields: [
    { name: "uses", label: "Workers", type: "number", min: 1, max: 100000, required: true, value: "10" },
    { name: "hours", label: "Hours until it expires", type: "number", min: 1, required: true, value: "24" },
    { name: "labels", label: "Labels that they get", note: "Separated by spaces." }] });
  if (!values) return;
  try {
    const made = await change("POST", "/v1/tickets", { uses: Number(values.uses), expires_s: 3_600 * values.hours, labels: values.labels.split(/\s+/).filter(Boolean) });
    showSecret("Ticket", made.secret);
  } catch (problem) {
    tellProblem(problem, "No ticket was made");
  }
}

async function revoke(token, done) {
  if (!(await ask({ title: `Revoke the token of ${token.label}`, text: "It and the sessions signed in with it stop working at once. This cannot be taken back.", action: "Revoke", danger: true }))) return;
  try {
    await change("POST", `/v1/tokens/${token.id}/revoke`, {});
    tell(`The token of ${token.label} is revoked.`);
  } catch (problem) {
    tellProblem(problem, "It was not revoked");
  }
  await done();
}

/** What state a token is in. */
function state(token) {
  if (token.revoked_at) return pill("cancelled", "Revoked");
  if (token.expires_at && token.expires_at <= now()) return pill("cancelled", "Expired");
  return pill("done", "Valid");
}

export async function show(main) {
  const table = h("section", { class: "panel", "aria-label": "Tokens" });
  const refresh = async () => {
    const tokens = await get("/v1/tokens");
    put(table, h("div", { class: "scroller" }, h("table", { class: "plain" }, h("thead", {}, h("tr", {}, ["State", "Whose", "Role", "For", "Made", "Expires", "Last used", ""].map((name) => h("th", { scope: "col" }, name)))),
      h("tbody", {}, tokens.map((token) => h("tr", {}, h("td", {}, state(token)), h("td", {}, h("strong", {}, token.label), h("br"), h("small", { class: "mono quiet" }, token.id)), h("td", {}, token.role), h("td", {}, token.project ?? h("span", { class: "quiet" }, "all projects")),
        h("td", {}, moment(token.created_at)), h("td", {}, token.expires_at ? moment(token.expires_at) : h("span", { class: "quiet" }, "never")), h("td", {}, token.last_used_at ? ago(token.last_used_at) : h("span", { class: "quiet" }, "never")),
        h("td", {}, !token.revoked_at && h("button", { class: "danger", onclick: () => revoke(token, refresh) }, "Revoke"))))))));
  };
  main.append(h("div", { class: "bar-row" }, h("h1", {}, "Tokens"), h("span", { class: "grow" }), h("button", { onclick: ticket }, "Ticket for workers"), h("button", { class: "primary", onclick: () => make(refresh) }, "New token")), table);
  await refresh();
  return "Tokens";
}
