// The batches of a pass, page by page, and the log of each claim.

import { change, get, getText, may, query } from "/dashboard/api.js";
import { present, tell, tellProblem } from "/dashboard/dialog.js";
import { h, put } from "/dashboard/dom.js";
import { count } from "/dashboard/format.js";
import { pill, total } from "/dashboard/words.js";

const PAGE = 25;
const STATES = ["", "ready", "leased", "done", "failed", "skipped", "cancelled"];

/** The panel of a job's batches. */
export class Batches {
  constructor(job) {
    this.job = job;
    this.passes = [];
    this.pass = h("select", { "aria-label": "Pass", onchange: () => { this.chosen = this.pass.value; this.from([]); } });
    this.state = h("select", { "aria-label": "State", onchange: () => this.from([]) }, STATES.map((state) => h("option", { value: state }, state || "all states")));
    this.body = h("div", { class: "scroller" });
    this.back = h("button", { onclick: () => this.from(this.starts.slice(0, -1)) }, "Earlier");
    this.more = h("button", { onclick: () => this.from([...this.starts, this.next]) }, "Later");
    this.starts = [];
    this.element = h("section", { class: "panel", "aria-label": "Batches" }, h("div", { class: "bar-row" }, h("h2", { class: "grow" }, "Batches"), this.pass, this.state, this.back, this.more), this.body);
  }

  async refresh(job) {
    this.passes = job.passes;
    const names = job.passes.map((pass) => `${pass.id} ${pass.kind}`).join();
    if (this.names !== names) {
      this.names = names;
      put(this.pass, job.passes.map((pass) => h("option", { value: pass.id }, `${pass.kind} ${pass.kind === "build" ? "" : pass.name} (${count(total(pass.batches))})`)));
      const bake = job.passes.find((pass) => pass.kind === "bake") ?? job.passes[0];
      this.pass.value = this.chosen ?? bake?.id ?? "";
    }
    await this.from(this.starts);
  }

  async from(starts) {
    this.starts = starts;
    if (!this.pass.value) {
      put(this.body, h("p", { class: "quiet" }, "None yet."));
      return;
    }
    const page = await get(query(`/v1/jobs/${this.job}/passes/${this.pass.value}/batches`, { state: this.state.value, after: starts.at(-1), limit: PAGE }));
    this.next = page.next;
    this.back.disabled = starts.length === 0;
    this.more.disabled = page.next === undefined;
    const pass = Number(this.pass.value);
    const rows = page.batches.map((batch) => h("tr", {}, h("td", {}, pill(batch.state)), h("td", { class: "number" }, count(batch.batch)), h("td", { class: "number" }, batch.fence), h("td", { class: "number" }, batch.tries), h("td", {}, batch.worker ?? ""), h("td", { class: "mono quiet" }, batch.sha256?.slice(0, 12) ?? ""), h("td", {}, batch.fence > 0 && h("button", { class: "plain link", onclick: () => this.open(pass, batch.batch) }, "Log"))));
    put(this.body, rows.length === 0 ? h("p", { class: "quiet" }, "No batch is in this state.") : h("table", { class: "plain" }, h("thead", {}, h("tr", {}, ["State", "Batch", "Claims", "Tries", "Worker", "SHA-256", ""].map((name) => h("th", { scope: "col" }, name)))), h("tbody", {}, rows)));
  }

  /** Shows a batch: what each claim's worker wrote, and what can be done. */
  async open(pass, number) {
    const path = `/v1/jobs/${this.job}/passes/${pass}/batches`;
    const page = await get(query(path, { after: number - 1, limit: 1 })).catch((problem) => tellProblem(problem, "The batch could not be read"));
    const batch = page?.batches[0];
    if (!batch) return;
    const log = h("pre", { class: "log", tabindex: "0", "aria-label": "Log" });
    const fences = Array.from({ length: batch.fence }, (_, at) => batch.fence - at).slice(0, 50);
    const claim = h("select", { "aria-label": "Claim", onchange: () => read() }, fences.map((fence) => h("option", { value: fence }, `claim ${fence}`)));
    const read = async () => put(log, (await getText(query(`${path}/${number}/log`, { fence: claim.value })).catch((problem) => problem.message)) || "Nothing was written under this claim.");
    const act = (what, past) => h("button", { onclick: async () => {
      try {
        const { batches } = await change("POST", `/v1/jobs/${this.job}/${what}`, { pass, batches: [number] });
        tell(batches ? `Batch ${number} is ${past}.` : `Batch ${number} is in no state for that.`);
        view.close();
      } catch (problem) {
        tellProblem(problem, what);
      }
    } }, what === "retry" ? "Retry" : "Skip");
    const actions = may("submitter") && batch.state === "failed" ? [act("retry", "tried again"), act("skip", "skipped")] : [];
    const view = present(`Batch ${count(number)}`, h("div", {}, h("div", { class: "bar-row" }, pill(batch.state), h("span", { class: "quiet" }, `${batch.fence} claims, ${batch.tries} count against it`), h("span", { class: "grow" }), actions, fences.length > 0 && claim), log));
    await read();
  }
}
