// A browser for the tests: how it is started, what it must not say, how pictures are taken and compared.

import { mkdirSync } from "node:fs";
import { createRequire } from "node:module";

const require = createRequire(`${process.env.PANTARAY_BROWSER_MODULES}/`);
const { chromium } = require("playwright-core");

export const url = process.env.PANTARAY_URL;
export const pictures = process.env.PANTARAY_PICTURES;
mkdirSync(pictures, { recursive: true });

/** What went wrong in a page: nothing may. */
export const complaints = [];

/** A page of its own session, 1280 by 800 unless said otherwise. */
export async function open(browser, { width = 1280, height = 800, light = false } = {}) {
  const context = await browser.newContext({ viewport: { width, height }, colorScheme: light ? "light" : "dark" });
  // Who works on the dashboard has its files from the folder, and builds nothing for a change
  const folder = process.env.PANTARAY_DASHBOARD;
  if (folder) await context.route(/\/dashboard\//, (route) => route.fulfill({ path: `${folder}${new URL(route.request().url()).pathname.slice("/dashboard".length)}` }));
  const page = await context.newPage();
  page.setDefaultTimeout(30_000);
  page.on("pageerror", (error) => complaints.push(`an error in the page: ${error.message}`));
  page.on("console", (message) => {
    // Answers that are refused on purpose are told in the console, too
    if (message.type() === "error" && !message.text().startsWith("Failed to load resource")) complaints.push(`the console says: ${message.text()}`);
  });
  return page;
}

/** Chromium, drawing on the CPU. */
export const launch = () => chromium.launch({ executablePath: process.env.PANTARAY_CHROMIUM, args: ["--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking", "--enable-unsafe-swiftshader", "--use-angle=swiftshader"] });

/** Signs in. */
export async function signIn(page, token) {
  await page.goto(`${url}/`);
  await page.fill("input[name=token]", token);
  await page.click("button[type=submit]");
  await page.waitForSelector("header.top");
}

/** Keeps a picture of the page as an artefact. */
export async function keep(page, name, whole = false) {
  await page.screenshot({ path: `${pictures}/${name}.png`, fullPage: whole });
}

/** Milliseconds of the page's thread that no task may take. */
const TASK_MS_MAX = 50;

/**
 * Does something in a page, and stops the test where a task of its thread takes longer than people bear. Its own time is
 * measured, not the clock's, in which the rest of the machine has its share.
 */
export async function fluid(page, what, action) {
  const session = await page.context().newCDPSession(page);
  await session.send("Tracing.start", { categories: "devtools.timeline,disabled-by-default-devtools.timeline", transferMode: "ReturnAsStream" });
  const result = await action();
  const complete = new Promise((done) => session.once("Tracing.tracingComplete", done));
  await session.send("Tracing.end");
  const { stream } = await complete;
  let text = "";
  for (let end = false; !end; ) {
    const piece = await session.send("IO.read", { handle: stream });
    text += piece.data;
    end = piece.eof;
  }
  await session.detach();
  const events = JSON.parse(text).traceEvents;
  const threads = new Set(events.filter((event) => event.name === "thread_name" && event.args.name === "CrRendererMain").map((event) => `${event.pid}/${event.tid}`));
  const tasks = events.filter((event) => event.name === "RunTask" && threads.has(`${event.pid}/${event.tid}`));
  check(tasks.length > 0, "tasks are traced");
  const [longest] = tasks.sort((a, b) => (b.tdur ?? 0) - (a.tdur ?? 0));
  const within = events.filter((event) => event.pid === longest.pid && event.tid === longest.tid && event !== longest && event.ts >= longest.ts && event.ts + (event.dur ?? 0) <= longest.ts + longest.dur && event.tdur > 1_000);
  const parts = within.sort((a, b) => b.tdur - a.tdur).slice(0, 4).map((event) => `${event.name} ${Math.round(event.tdur / 1_000)}`).join(", ");
  console.log(`the longest task of ${what}: ${Math.round(longest.tdur / 1_000)} ms (${parts})`);
  check(longest.tdur / 1_000 < TASK_MS_MAX, `no task of ${what} takes ${TASK_MS_MAX} ms`);
  return result;
}

/** Stops the test where something is not so. */
export function check(is, what) {
  if (!is) throw new Error(`not so: ${what}`);
}

/**
 * How far two pictures are apart: mean difference of bytes, over pixels that both of them cover. The first is of a stage
 * whose empty parts are magenta, the second has alpha.
 */
export async function compare(page, first, second) {
  return page.evaluate(async ([a, b]) => {
    const read = async (text) => {
      const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
      const bitmap = await createImageBitmap(new Blob([bytes], { type: "image/png" }), { premultiplyAlpha: "none" });
      const canvas = new OffscreenCanvas(bitmap.width, bitmap.height);
      const context = canvas.getContext("2d");
      context.drawImage(bitmap, 0, 0);
      return context.getImageData(0, 0, bitmap.width, bitmap.height);
    };
    const [x, y] = [await read(a), await read(b)];
    if (x.width !== y.width || x.height !== y.height) throw new Error(`pictures of ${x.width} × ${x.height} and ${y.width} × ${y.height}`);
    const empty = (image, at) => image.data[at + 3] < 255 || (image.data[at] > 250 && image.data[at + 1] < 5 && image.data[at + 2] > 250);
    let [sum, both, one] = [0, 0, 0];
    for (let at = 0; at < x.data.length; at += 4) {
      const [gone, lacking] = [empty(x, at), empty(y, at)];
      if (gone !== lacking) one += 1;
      if (gone || lacking) continue;
      both += 1;
      for (let channel = 0; channel < 3; channel += 1) sum += Math.abs(x.data[at + channel] - y.data[at + channel]) / 3;
    }
    return { difference: sum / both, both, one };
  }, [first.toString("base64"), second.toString("base64")]);
}
