// From an empty farm to a bake: sign in, the empty pages, submit, watch to the end, the result, what a viewer may not do.

import { writeFileSync } from "node:fs";

import { readable } from "./access.mjs";
import { check, fluid, keep, open, signIn, url } from "./browser.mjs";

/** Nobody is let in with a wrong token; the pages of an empty farm say what to do. */
export async function emptyFarm(browser, tokens) {
  const page = await open(browser);
  await page.goto(`${url}/workers`);
  await page.waitForSelector("input[name=token]");
  await readable(page, "sign-in");
  await page.fill("input[name=token]", "pantaray_wrong");
  await page.click("button[type=submit]");
  await page.waitForFunction(() => document.querySelector(".problem").textContent.includes("not valid"));
  await signIn(page, tokens.submitter);
  await page.goto(`${url}/jobs`);
  await page.waitForSelector("text=No jobs yet");
  await readable(page, "jobs-empty");
  await page.goto(`${url}/jobs/nothing`);
  await page.waitForSelector("text=Not there");
  check(await page.evaluate(() => document.cookie === ""), "no script can read the session");
  check((await page.evaluate(() => fetch("/v1/jobs/x/cancel", { method: "POST" }).then((answer) => answer.status))) === 403, "a change without the header is refused");
  return page;
}

/** A scene and its file are dropped, and become a job. */
export async function submit(page, files) {
  await page.goto(`${url}/submit`);
  await page.setInputFiles("#files", files[0]);
  await page.waitForSelector("text=is missing: drop it, too");
  check(await page.isDisabled("button[type=submit]"), "what lacks a file cannot be submitted");
  await page.setInputFiles("#files", files[1]);
  await page.fill("label:has-text('Shot') input", "sh010");
  await page.click("text=What would it take?");
  await page.waitForSelector("text=Reads ");
  await readable(page, "submit");
  await page.click("button[type=submit]");
  await page.waitForURL(/\/jobs\/[0-9a-z]{26}$/);
  return page.url().split("/").pop();
}

/** Batches that the page says are done. */
const done = (page) => page.evaluate(() => Number(document.querySelector(".progress")?.textContent.match(/([\d,]+) of/)?.[1].replace(",", "") ?? 0));

/** A job's worker is killed among its batches: the page says so, live, and what to do about it. */
export async function workerDies(page, victim) {
  await page.waitForSelector(".passes");
  await page.waitForFunction(() => Number(document.querySelector(".progress")?.textContent.match(/([\d,]+) of/)?.[1] ?? 0) >= 2, null, { timeout: 60_000, polling: 50 });
  process.kill(victim, "SIGKILL");
  // Its lease runs out, and its batches can be claimed again
  await page.waitForSelector(".pill:has-text('Worker lost')", { timeout: 40_000 });
  const [so, all] = await page.evaluate(() => document.querySelector(".progress").textContent.match(/([\d,]+) of ([\d,]+)/).slice(1).map((text) => Number(text.replace(",", ""))));
  check(so < all, `the worker died among its batches: ${so} of ${all}`);
  check((await done(page)) === so, "nothing more is done");
  await readable(page, "job-worker-lost");
  await page.goto(`${url}/jobs`);
  await page.waitForSelector(".t-row");
  await readable(page, "jobs-held-up");
}

/** Another worker takes over; the job is watched to its end, live, and its page has what there is to know. */
export async function watch(page, job, relief) {
  await page.goto(`${url}/jobs/${job}`);
  await page.waitForSelector(".passes");
  const before = await done(page);
  // A list of jobs in another window follows by events alone
  const list = await page.context().newPage();
  await list.goto(`${url}/jobs`);
  await list.waitForSelector(".t-row .bar");
  await list.route("**/v1/jobs?*", (route) => route.abort());
  const figure = await list.textContent(".t-row .figure");
  // And one that looks at the bake so far will look at the result
  const viewer = await page.context().newPage();
  await viewer.goto(`${url}/jobs/${job}/bake`);
  await viewer.waitForSelector(".viewer-sofar:has-text('so far')");
  writeFileSync(relief, "");
  await list.waitForFunction((figure) => document.querySelector(".t-row .figure").textContent !== figure, figure, { timeout: 60_000 });
  await list.unroute("**/v1/jobs?*");
  await fluid(page, "a job's page, live", () => end(page, list, viewer, before));
  await look(page);
  await prints(page);
}

/** A job's page until the job has ended, and what it has then. */
async function end(page, list, viewer, before) {
  await page.waitForFunction((before) => Number(document.querySelector(".progress").textContent.match(/([\d,]+) of/)[1].replace(",", "")) > before, before, { timeout: 60_000 });
  await page.waitForSelector(".bar-row .pill:has-text('Succeeded')", { timeout: 120_000 });
  await list.waitForSelector(".t-row .pill:has-text('Succeeded')");
  await list.close();
  await viewer.waitForSelector(".viewer-sofar[hidden]", { state: "attached" });
  await viewer.waitForSelector(".viewer-status:has-text('points drawn')");
  await viewer.close();
  await page.waitForSelector(".outputs img");
  for (const text of ["Segments along the Hilbert curve", "Throughput", "Bricks", "Download hill.mgs", "Cache hits", "Read per ray", "Who baked it"]) await page.waitForSelector(`text=${text}`);
  for (const worker of ["w1", "w2"]) await page.waitForSelector(`section[aria-label='Who baked it'] td:has-text('${worker}')`);
  await page.locator(".strip canvas").first().focus();
  await page.keyboard.press("ArrowRight");
  await page.waitForSelector("text=/Segment \\d+, batches/");
  await page.click(".scroller button:has-text('Log')");
  await page.waitForSelector("dialog pre.log");
  await page.keyboard.press("Escape");
}

/** The page of a job that has ended, for everybody, on a phone and on paper. */
async function look(page) {
  await page.evaluate(() => scrollTo(0, 0));
  await readable(page, "job");
  await keep(page, "job-whole", true);
  await page.setViewportSize({ width: 390, height: 844 });
  await keep(page, "job-phone", true);
  check((await page.evaluate(() => document.documentElement.scrollWidth)) <= 390, "a job's page fits a phone");
  await page.setViewportSize({ width: 1280, height: 800 });
}

/** The report fits on paper: nothing to press, nothing dark, pages that are not cut through. */
async function prints(page) {
  await page.click("text=Report");
  await page.waitForSelector("article.report img");
  await readable(page, "report");
  await page.emulateMedia({ media: "print", colorScheme: "dark" });
  await keep(page, "report-print", true);
  const seen = await page.evaluate(() => ({ ground: getComputedStyle(document.body).backgroundColor, text: getComputedStyle(document.querySelector(".report h1")).color, buttons: [...document.querySelectorAll("button, header.top")].filter((element) => element.offsetParent !== null).length }));
  check(seen.ground === "rgb(255, 255, 255)" && /rgb\((\d|[1-5]\d), /.test(seen.text) && seen.buttons === 0, `dark on white, without buttons: ${JSON.stringify(seen)}`);
  const paper = await page.pdf({ format: "A4", margin: { top: "15mm", bottom: "15mm", left: "15mm", right: "15mm" } });
  const sheets = paper.toString("latin1").match(/\/Type\s*\/Page[^s]/g)?.length ?? 0;
  check(sheets >= 1 && sheets <= 3, `a small job's report has ${sheets} sheets of paper`);
  await page.emulateMedia({ media: "screen", colorScheme: "dark" });
}

/** The same job again: it reuses what there is, and ends. */
export async function again(page, job) {
  await page.goto(`${url}/jobs/${job}`);
  await page.click("button:has-text('Submit again')");
  await page.waitForSelector(".toast:has-text('submitted again')");
  await page.goto(`${url}/jobs`);
  await page.waitForFunction(() => document.querySelectorAll(".t-row").length === 2);
  await page.waitForFunction(() => [...document.querySelectorAll(".t-row .pill")].every((pill) => pill.textContent.includes("Succeeded")), null, { timeout: 120_000 });
  await page.waitForFunction(() => [...document.querySelectorAll(".t-row img")].every((image) => image.complete && image.naturalWidth > 0));
  await readable(page, "jobs");
  const ids = await page.evaluate(() => [...document.querySelectorAll(".t-row .c-name a")].map((link) => link.getAttribute("href").split("/").pop()));
  return ids.find((id) => id !== job);
}

/** The pages beside jobs; a token is made and revoked, a worker is locked and unlocked. */
export async function otherPages(browser, token) {
  const page = await open(browser);
  await signIn(page, token);
  for (const [path, text] of [["workers", "Idle"], ["stuck", "What holds jobs up"], ["limits", "Of the farm now"], ["audit", "submitted a job"], ["tokens", "Whose"]]) {
    await page.goto(`${url}/${path}`);
    await page.waitForSelector(`text=${text}`);
    await page.waitForTimeout(200);
    await readable(page, path);
    await page.setViewportSize({ width: 390, height: 844 });
    const wide = await page.evaluate(() => document.documentElement.scrollWidth);
    await keep(page, `${path}-phone`);
    check(wide <= 390, `/${path} is ${wide} pixels wide on a phone`);
    await page.setViewportSize({ width: 1280, height: 800 });
  }
  await page.click("text=New token");
  await page.fill("dialog input[name=label]", "for the test");
  await page.click("dialog button[type=submit]");
  await page.waitForSelector("dialog input[aria-label='The secret']");
  check((await page.inputValue("dialog input[aria-label='The secret']")).startsWith("pantaray_"), "the secret is shown");
  await page.click("dialog button[aria-label=Close]");
  await page.click("tr:has-text('for the test') button:has-text('Revoke')");
  await page.click("dialog button.danger");
  await page.waitForSelector("tr:has-text('for the test') .pill:has-text('Revoked')");
  await page.goto(`${url}/workers`);
  await page.click(".t-row:has-text('w2') button:has-text('Lock')");
  await page.click("dialog button[type=submit]");
  await page.waitForSelector(".t-row .pill:has-text('Locked')");
  await page.click(".t-row:has-text('w2') button:has-text('Unlock')");
  await page.waitForSelector(".toast:has-text('may work again')");
  await page.context().close();
}

/** Whoever may only read sees nothing that changes anything. */
export async function viewersOnlyLook(browser, token, job) {
  const page = await open(browser, { light: true });
  await signIn(page, token);
  for (const path of ["jobs", `jobs/${job}`, "workers", "limits"]) {
    await page.goto(`${url}/${path}`);
    await page.waitForSelector(path === "workers" ? ".t-row" : "h1");
    await page.waitForTimeout(500);
    const found = await page.locator("main button.danger, main button:has-text('Cancel'), main button:has-text('Lock'), main button:has-text('Drain'), main button:has-text('Pause'), main button:has-text('Change'), main input[type=checkbox], header a:has-text('Submit')").count();
    check(found === 0, `a viewer sees ${found} ways to change something at /${path}`);
  }
  await page.goto(`${url}/jobs`);
  await page.waitForSelector(".t-row");
  await keep(page, "jobs-light");
  await page.goto(`${url}/audit`);
  await page.waitForSelector("text=This page cannot be shown");
  await page.click("summary");
  await page.click("text=Sign out");
  await page.waitForSelector("input[name=token]");
  check((await page.evaluate(() => fetch("/v1/jobs").then((answer) => answer.status))) === 401, "signed out is signed out");
  await page.context().close();
}
