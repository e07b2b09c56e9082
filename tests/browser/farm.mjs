// From an empty farm to a bake: sign in, the empty pages, submit, watch to the end, the result, what a viewer may not do.

import { check, keep, open, signIn, url } from "./browser.mjs";

/** Nobody is let in with a wrong token; the pages of an empty farm say what to do. */
export async function emptyFarm(browser, tokens) {
  const page = await open(browser);
  await page.goto(`${url}/workers`);
  await page.waitForSelector("input[name=token]");
  await keep(page, "sign-in");
  await page.fill("input[name=token]", "pantaray_wrong");
  await page.click("button[type=submit]");
  await page.waitForFunction(() => document.querySelector(".problem").textContent.includes("not valid"));
  await signIn(page, tokens.submitter);
  await page.goto(`${url}/jobs`);
  await page.waitForSelector("text=No jobs yet");
  await keep(page, "jobs-empty");
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
  await keep(page, "submit");
  await page.click("button[type=submit]");
  await page.waitForURL(/\/jobs\/[0-9a-z]{26}$/);
  return page.url().split("/").pop();
}

/** A job is watched to its end, live; its page has what there is to know. */
export async function watch(page) {
  await page.waitForSelector(".passes");
  await page.waitForSelector(".bar-row .pill:has-text('Succeeded')", { timeout: 90_000 });
  await page.waitForSelector(".outputs img");
  for (const text of ["Segments along the Hilbert curve", "Throughput", "Bricks", "Download hill.mgs"]) await page.waitForSelector(`text=${text}`);
  await page.locator(".strip canvas").first().focus();
  await page.keyboard.press("ArrowRight");
  await page.waitForSelector("text=/Segment \\d+, batches/");
  await page.click(".scroller button:has-text('Log')");
  await page.waitForSelector("dialog pre.log");
  await page.keyboard.press("Escape");
  await page.evaluate(() => scrollTo(0, 0));
  await keep(page, "job");
  await page.click("text=Report");
  await page.waitForSelector("article.report");
  await page.emulateMedia({ media: "print" });
  await keep(page, "report", true);
  await page.emulateMedia({ media: "screen" });
}

/** Failures are told with their reason, and asked about before they are skipped. */
export async function otherPages(browser, token) {
  const page = await open(browser);
  await signIn(page, token);
  for (const [path, text] of [["workers", "Idle"], ["stuck", "What holds jobs up"], ["limits", "Of the farm now"], ["audit", "submitted a job"], ["tokens", "Whose"]]) {
    await page.goto(`${url}/${path}`);
    await page.waitForSelector(`text=${text}`);
    await keep(page, path);
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
  await page.click(".t-row button:has-text('Lock')");
  await page.click("dialog button[type=submit]");
  await page.waitForSelector(".t-row .pill:has-text('Locked')");
  await page.click(".t-row button:has-text('Unlock')");
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
