// The dashboard in a real browser, on a farm that the Rust side of this test runs (tests/tests/service/browser.rs).

import { readFileSync } from "node:fs";

import { looked } from "./access.mjs";
import { complaints, keep, launch } from "./browser.mjs";
import { again, emptyFarm, otherPages, submit, viewersOnlyLook, watch, workerDies } from "./farm.mjs";
import { manyJobs, millionBatches } from "./many.mjs";
import { sofar, viewer } from "./viewer.mjs";

const plan = JSON.parse(readFileSync(process.env.PANTARAY_PLAN, "utf8"));
const browser = await launch();
let page = null;
const step = async (name, action) => {
  const start = performance.now();
  const result = await action();
  console.log(`${name}: ${((performance.now() - start) / 1000).toFixed(1)} s`);
  return result;
};
try {
  if (plan.many) {
    await step("ten thousand jobs", () => manyJobs(browser, plan.tokens.submitter, plan.many));
    await step("a million batches", () => millionBatches(browser, plan.tokens.submitter));
  } else {
    page = await step("an empty farm", () => emptyFarm(browser, plan.tokens));
    const job = await step("a scene is submitted", () => submit(page, plan.files));
    await step("its worker dies", () => workerDies(page, plan.victim));
    await step("the bake is seen as far as it is", () => sofar(page, job));
    await step("another worker takes over, to the end", () => watch(page, job, plan.relief));
    const twin = await step("the same is submitted again", () => again(page, job));
    await step("the bake is seen and relit", () => viewer(page, job, twin, plan.view));
    await step("the other pages", () => otherPages(browser, plan.tokens.admin));
    await step("viewers only look", () => viewersOnlyLook(browser, plan.tokens.viewer, job));
  }
  console.log(`${looked().pages} pages pass axe-core, with ${looked().pairs} texts of enough contrast`);
  if (complaints.length > 0) throw new Error(complaints.join("\n"));
} catch (error) {
  if (page && !page.isClosed()) await keep(page, "failed").catch(() => null);
  console.error(error.message, ...complaints);
  process.exitCode = 1;
} finally {
  await browser.close();
}
