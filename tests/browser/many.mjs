// Ten thousand jobs: only rows in view are there, and the coordinator filters, sorts and pages.

import { check, keep, open, signIn, url } from "./browser.mjs";

export async function manyJobs(browser, token, count) {
  const page = await open(browser);
  await signIn(page, token);
  await page.goto(`${url}/jobs`);
  await page.waitForSelector(`text=${count.toLocaleString("en-US")} jobs`);
  const rows = () => page.locator(".t-row").count();
  check((await rows()) < 60, `${await rows()} rows are there at once`);
  await page.evaluate(() => {
    window.longest = 0;
    new PerformanceObserver((list) => list.getEntries().forEach((entry) => { window.longest = Math.max(window.longest, entry.duration); })).observe({ type: "longtask" });
  });

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
  await page.waitForFunction(() => document.querySelector(".t-row[aria-rowindex='1'] a")?.textContent === "shot 00000");
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
  const longest = await page.evaluate(() => window.longest);
  console.log(`the longest task over ${count} jobs took ${Math.round(longest)} ms`);

  // The same on a phone
  await page.setViewportSize({ width: 390, height: 844 });
  await page.goto(`${url}/jobs`);
  await page.waitForSelector(".t-row");
  const wide = await page.evaluate(() => document.documentElement.scrollWidth);
  check(wide <= 390, `the page is ${wide} pixels wide on a phone`);
  await keep(page, "jobs-phone");
  await page.context().close();
}
