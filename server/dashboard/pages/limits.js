// Projects: their share of the farm, their limits, and what they use.

import { change, get, may, who } from "/dashboard/api.js";
import { ask, tell, tellProblem } from "/dashboard/dialog.js";
import { h, put } from "/dashboard/dom.js";
import { count, share } from "/dashboard/format.js";

async function edit(project, done) {
  const values = await ask({
    title: project ? `Limits of ${project.name}` : "A new project", action: project ? "Save" : "Make it",
    fields: [
      !project && { name: "name", label: "Name", required: true, note: "Letters, digits, - _ . and =" },
      { name: "share", label: "Share", type: "number", min: 1, max: 1000000, required: true, value: String(project?.share ?? 100), note: "A project of twice the share gets twice the farm, while both have work." },
      { name: "running_max", label: "Batches at once at most", type: "number", min: 0, value: project?.running_max === null || !project ? "" : String(project.running_max), note: "Empty: no limit. 0 stops the project." },
    ].filter(Boolean),
  });
  if (!values) return;
  const name = project?.name ?? values.name;
  try {
    await change("PUT", `/v1/projects/${encodeURIComponent(name)}`, { name, share: Number(values.share), running_max: values.running_max === "" ? null : Number(values.running_max) });
    tell(`The limits of ${name} are changed.`);
  } catch (problem) {
    tellProblem(problem, "The limits were not changed");
  }
  await done();
}

export async function show(main, context) {
  const table = h("section", { class: "panel", "aria-label": "Projects" });
  const mayEdit = may("admin") && !who().project;
  main.append(h("div", { class: "bar-row" }, h("h1", {}, "Limits"), h("span", { class: "grow" }), mayEdit && h("button", { onclick: () => edit(null, refresh) }, "New project")), table);
  const refresh = async () => {
    const { projects } = await get("/v1/farm");
    const shares = projects.filter((project) => project.jobs > 0).reduce((sum, project) => sum + project.share, 0);
    put(table, h("div", { class: "scroller" }, h("table", { class: "plain" }, h("thead", {}, h("tr", {}, ["Project", "Share", "Of the farm now", "Running", "At most", "Ready", "Live jobs", ""].map((name) => h("th", { scope: "col" }, name)))),
      h("tbody", {}, projects.map((project) => h("tr", {},
        h("td", {}, h("a", { href: `/jobs?project=${encodeURIComponent(project.name)}` }, project.name)),
        h("td", {}, count(project.share)), h("td", {}, project.jobs ? share(project.share, shares) : h("span", { class: "quiet" }, "idle")),
        h("td", { class: project.running_max !== null && project.running >= project.running_max && project.ready > 0 ? "tone-paused" : "" }, count(project.running), project.running_max !== null && project.running >= project.running_max && project.ready > 0 && " ‖ at its limit"),
        h("td", {}, project.running_max === null ? h("span", { class: "quiet" }, "no limit") : count(project.running_max)), h("td", {}, count(project.ready)), h("td", {}, count(project.jobs)),
        h("td", {}, mayEdit && h("button", { onclick: () => edit(project, refresh) }, "Change"))))))));
  };
  await refresh();
  const timer = setInterval(() => { if (!document.hidden && !table.contains(document.activeElement)) refresh().catch(() => null); }, 3_000);
  context.while(() => clearInterval(timer));
  return "Limits";
}
