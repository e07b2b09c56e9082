// Ten thousand jobs: only rows in view are there, and the coordinator filters, sorts and pages.

import { readable } from "./access.mjs";
import { check, fluid, keep, open, signIn, url } from "./browser.mjs";

export async function manyJobs(browser, token, count) {
  const page = await open(browser);
  await signIn(page, token);
  await fluid(page, `a list of ${count} jobs`, () => browse(page, count));

  // The same on a phone
  await page.setViewportSize({ width: 390, height: 844 });
  await page.goto(`${url}/jobs`);
  await page.waitForSelector(".t-row");
  const wide = await page.evaluate(() => document.documentElement.scrollWidth);
  check(wide <= 390, `the page is ${wide} pixels wide on a phone`);
  await keep(page, "jobs-phone");
  await page.context().close();
}

/** Through the list: anywhere in it, sorted, searched, by the keyboard, and from it to a job. */
async function browse(page, count) {
  await page.goto(`${url}/jobs`);
  await page.waitForSelector(`text=${count.toLocaleString("en-US")} jobs`);
  const rows = () => page.locator(".t-row").count();
  check((await rows()) < 60, `${await rows()} rows are there at once`);

  // Anywhere in the list, and at its end
  const scroll = page.locator(".t-scroll");
  for (const share of [0.3, 0.7, 1]) {
    await scroll.evaluate((element, share) => { element.scrollTop = share * element.scrollHeight; }, share);
    await page.waitForFunction((least) => [...document.querySelectorAll(".t-row")].some((row) => Number(row.ariaRowIndex) > least), Math.floor(share * count) - 40);
  }
  await page.waitForFunction((last) => document.querySelector(`.t-row[aria-rowindex="${last}"]`), count);
  check((await rows()) < 60, "rows that are out of view are gone");
  await keep(page, "jobs-many");

  // Sorted and searched by the coordinator
  await page.click("button.sorter:has-text('Job')");
  await page.waitForFunction(() => document.querySelector(".t-row[aria-rowindex='2'] a")?.textContent === "shot 00000");
  await page.fill("input[type=search]", "shot 0123");
  await page.waitForSelector("text=/^10 jobs$/");
  await page.selectOption("select[aria-label=State]", "failed");
  await page.waitForSelector("text=/^1 job$/");
  await page.fill("input[type=search]", "no such job");
  await page.waitForSelector("text=No job matches");
  await page.fill("input[type=search]", "");
  await page.selectOption("select[aria-label=State]", "");

  // By the keyboard alone
  await page.waitForSelector(`text=${count.toLocaleString("en-US")} jobs`);
  await page.waitForSelector(".t-row[aria-rowindex='1']");
  await scroll.focus();
  for (const key of ["ArrowDown", "ArrowDown", " ", "ArrowDown", " "]) await page.keyboard.press(key);
  await page.waitForSelector("text=2 selected");
  await page.keyboard.press("End");
  await page.waitForFunction((last) => document.querySelector(`.t-row.cursor[aria-rowindex="${last}"]`), count);
  await page.keyboard.press("Enter");
  await page.waitForURL(/\/jobs\/m\d+/);
}

/** A job of a million batches: its segments in one strip, its batches page by page, each answer within a moment. */
export async function millionBatches(browser, token) {
  const page = await open(browser);
  await signIn(page, token);
  const times = [];
  page.on("requestfinished", (request) => { if (request.url().includes("/v1/jobs/million")) times.push([request.timing().responseEnd - request.timing().requestStart, new URL(request.url()).pathname]); });
  await fluid(page, "a job of a million batches", () => walk(page));
  await page.evaluate(() => scrollTo(0, 0));
  await readable(page, "job-million");
  times.sort((a, b) => b[0] - a[0]);
  console.log(`its slowest answers: ${times.slice(0, 3).map(([ms, path]) => `${path} ${Math.round(ms)} ms`).join(", ")}`);
  await page.context().close();
}

/** Along its strip, and to the batches that failed. */
async function walk(page) {
  await page.goto(`${url}/jobs/million`);
  await page.waitForSelector("text=/659,720 of 1,000,000 batches|[0-9,]+ of 1,000,000 batches/");
  const strip = page.locator(".strip canvas");
  await strip.waitFor();
  const box = await strip.boundingBox();
  // Segment 300 has failures, 670 runs, 900 is ready
  for (const [share, text] of [[0.3005, "5 failed"], [0.6705, "64 running"], [0.9005, "1,000 ready"]]) {
    await strip.hover({ position: { x: share * box.width, y: 10 } });
    await page.waitForSelector(`.strip-note:has-text('${text}')`);
  }
  await strip.hover({ position: { x: 0.6705 * box.width, y: 10 } });
  await page.selectOption("select[aria-label='State'] >> nth=0", "failed");
  await page.waitForSelector("td:has-text('300,999')");
  check((await page.locator("section[aria-label=Batches] tbody tr").count()) === 5, "five batches have failed");
}
