// Submission: a scene dropped on the page, with its files; what it would take; the job.

import { change, get, may, who } from "/dashboard/api.js";
import { tell } from "/dashboard/dialog.js";
import { h, put } from "/dashboard/dom.js";
import { bytes, count, span } from "/dashboard/format.js";
import { about, dropped, match, named, send } from "/dashboard/submit.js";

export async function show(main, context) {
  if (!may("submitter")) {
    main.append(h("section", { class: "empty" }, h("h1", {}, "Not with this token"), h("p", {}, "Submitting needs a token of role ", h("code", {}, "submitter"), ".")));
    return "Submit";
  }
  const projects = (await get("/v1/projects")).filter(({ name }) => !who().project || name === who().project);
  const fields = {
    name: h("input", { required: true, maxlength: 200 }),
    project: h("select", {}, projects.map(({ name }) => h("option", { value: name }, name))),
    priority: h("input", { type: "number", min: 0, max: 100, value: "50" }),
    samples: h("input", { type: "number", min: 16, max: 65536, placeholder: "as the scene says" }),
    points: h("input", { type: "number", min: 1, placeholder: "all" }),
    show: h("input", {}), sequence: h("input", {}), shot: h("input", {}), comment: h("input", {}),
  };
  const found = h("div", { class: "found" });
  const line = h("p", { class: "problem", role: "alert" });
  const doing = h("p", { class: "quiet", role: "status" });
  const check = h("button", { type: "button", disabled: true, onclick: () => run(true) }, "What would it take?");
  const go = h("button", { type: "submit", class: "primary", disabled: true }, "Submit");
  const chooser = h("input", { type: "file", multiple: true, class: "visually-hidden", id: "files", onchange: () => take([...chooser.files].map((file) => [file.name, file])) });
  const zone = h("label", { class: "drop", for: "files", ondragover: (event) => { event.preventDefault(); zone.classList.add("over"); }, ondragleave: () => zone.classList.remove("over"), ondrop: async (event) => {
    event.preventDefault();
    zone.classList.remove("over");
    take(await dropped(event.dataTransfer));
  } }, h("strong", {}, "Drop a scene here"), h("span", {}, "the XML and the files that it names, or their folder; or click to choose them"), chooser);
  let scene = null;
  let files = [];

  const take = async (more) => {
    put(line);
    files = [...files, ...more];
    const xml = more.find(([name]) => name.endsWith(".xml"));
    if (xml) {
      scene = await xml[1].text();
      fields.name.value = xml[0].split("/").pop().replace(/\.xml$/, "");
    }
    draw();
  };
  const draw = () => {
    let ready = false;
    try {
      if (scene === null) throw new Error("none of the files is a scene (.xml)");
      const paths = named(scene);
      const { sets, geometries } = about(scene);
      ready = paths.every((path) => match(path, files)) && sets.length > 0;
      put(found, h("p", {}, h("strong", {}, `${sets.length} bake set${sets.length === 1 ? "" : "s"}`), `: ${sets.join(", ") || "none, so there is nothing to bake"}. ${geometries.length} geometr${geometries.length === 1 ? "y" : "ies"}.`),
        paths.length > 0 && h("ul", {}, paths.map((path) => { const file = match(path, files); return h("li", { class: file ? "tone-done" : "tone-failed" }, file ? `✓ ${path}, ${bytes(file.size)}` : `✕ ${path} is missing: drop it, too`); })));
    } catch (problem) {
      put(line, problem.message);
    }
    check.disabled = go.disabled = !ready;
  };
  const number = (input) => (input.value === "" ? undefined : Number(input.value));
  const run = async (asking) => {
    put(line);
    check.disabled = go.disabled = true;
    try {
      const project = fields.project.value;
      const hashes = await send(named(scene), files, project, (text) => put(doing, text));
      const request = { name: fields.name.value, project, scene, files: hashes, priority: number(fields.priority) ?? 50, show: fields.show.value, sequence: fields.sequence.value, shot: fields.shot.value, comment: fields.comment.value, settings: { samples: number(fields.samples), max_points: number(fields.points) } };
      put(doing, asking ? "Asking …" : "Submitting …");
      if (asking) {
        const estimate = await change("POST", "/v1/jobs/validate", request);
        put(doing, `Reads ${bytes(estimate.input_bytes)}. `, estimate.points !== null && `${count(estimate.points)} points in ${count(estimate.batches)} batches. `, estimate.worker_seconds !== null && `About ${span(1_000 * estimate.worker_seconds)} of one worker.`);
      } else {
        const headers = { "Idempotency-Key": key };
        const submitted = await change("POST", "/v1/jobs", request, { headers });
        tell(`“${request.name}” is submitted.`);
        await context.go(`/jobs/${submitted.jobs[0]}`);
        return;
      }
    } catch (problem) {
      put(doing);
      put(line, problem.message, problem.hint && h("small", {}, ` ${problem.hint}`));
    }
    draw();
  };
  const key = [...crypto.getRandomValues(new Uint8Array(16))].map((byte) => byte.toString(16)).join("");
  const field = (label, name, note) => h("label", { class: "field" }, h("span", {}, label), fields[name], note && h("small", {}, note));
  main.append(h("h1", {}, "Submit"), h("form", { class: "submit", onsubmit: (event) => { event.preventDefault(); run(false); } }, h("div", {}, zone, found),
    h("div", { class: "panel" }, field("Name", "name"), h("div", { class: "pair" }, field("Project", "project"), field("Priority, 0 to 100", "priority")), h("div", { class: "pair" }, field("Rays per point", "samples"), field("Points at most", "points", "Whole batches, evenly spaced: a quick look.")),
      h("div", { class: "pair" }, field("Show", "show"), field("Sequence", "sequence"), field("Shot", "shot")), field("Comment", "comment"), line, doing, h("div", { class: "buttons" }, check, go))));
  return "Submit";
}
