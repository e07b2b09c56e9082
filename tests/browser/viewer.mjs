// The viewer: the light is turned, and pixels change as `relight` says; numbers, comparison, links.

import { readFileSync } from "node:fs";

import { check, compare, keep, url } from "./browser.mjs";

/** The stage as a picture, when everything has come; its empty parts are magenta. */
async function stage(page, [width, height]) {
  await page.waitForSelector(".viewer-status[data-idle=true]");
  await page.evaluate(([width, height]) => {
    const stage = document.querySelector(".viewer-stage");
    stage.style.width = `${width}px`;
    stage.style.height = `${height}px`;
    // At whole pixels, above everything
    Object.assign(stage.style, { position: "fixed", left: "0", top: "0", zIndex: "99", border: "0" });
    stage.style.background = "#f0f";
    stage.style.borderRadius = "0";
    document.querySelectorAll(".viewer-status, .viewer-names").forEach((element) => { element.style.visibility = "hidden"; });
  }, [width, height]);
  await page.waitForTimeout(700);
  return page.locator(".viewer-stage").screenshot();
}

export async function viewer(page, job, view) {
  const address = (values) => `${url}/jobs/${job}/bake?set=hill#${new URLSearchParams({ eye: view.eye.join(), at: view.at.join(), fov: view.fov, ...values })}`;
  const visit = async (values) => {
    // The same document with another fragment would not be loaded anew
    await page.goto("about:blank");
    await page.goto(address(values));
    await page.waitForSelector(".viewer-status");
  };

  // Each picture against that of `relight` under the same light, and against how far two lights are apart
  const found = [];
  for (const { rotation, env, picture } of view.pictures) {
    await visit({ env, rot: rotation });
    const relit = readFileSync(picture);
    found.push({ env, rotation, relit, seen: await stage(page, view.size) });
  }
  const [one, other] = found;
  const apart = await compare(page, one.relit, other.relit);
  for (const { env, rotation, relit, seen } of found) {
    const { difference, both, one } = await compare(page, seen, relit);
    console.log(`${env} turned by ${rotation}°: ${difference.toFixed(2)} of 255 from relight's picture over ${both} pixels, ${one} covered by one alone; two lights are ${apart.difference.toFixed(2)} apart`);
    check(both > 10_000 && one < both / 5, `both cover the same: ${both} and ${one}`);
    check(difference < apart.difference / 4, "the viewer shows what relight draws");
  }

  // Every view draws something of its own
  await visit({});
  await page.waitForSelector(".viewer-status[data-idle=true]");
  await keep(page, "viewer");
  const shots = new Set();
  for (const show of ["lit", "sky", "bent", "band0", "band1", "band2", "normal"]) {
    await page.selectOption("select[aria-label=Show]", show);
    await page.waitForTimeout(250);
    shots.add((await page.locator(".viewer-stage").screenshot()).toString("base64"));
    if (show === "sky" || show === "bent") await keep(page, `viewer-${show}`);
  }
  check(shots.size === 7, `${shots.size} of 7 views differ`);

  // A point says its numbers, and light that turns changes them
  await page.selectOption("select[aria-label=Show]", "lit");
  await page.locator("canvas.view").click();
  await page.waitForSelector(".numbers");
  const radiance = () => page.locator(".numbers dt:has-text('Radiance') + dd").textContent();
  const before = await radiance();
  await page.locator("canvas.view").focus();
  for (let step = 0; step < 9; step += 1) await page.keyboard.press("]");
  check((await radiance()) !== before, "turned light changes a point's radiance");
  await page.selectOption("select[aria-label=Environment]", "sunset");

  // The address restores the view
  await page.waitForTimeout(600);
  const link = page.url();
  check(link.includes("rot=90") && link.includes("env=sunset"), `the address says the view: ${link}`);

  // Another bake of the same beside it, and the difference, which is nothing
  await page.selectOption("select[aria-label='Compare with']", { index: 1 });
  await page.waitForSelector("button:has-text('Difference')");
  await page.waitForTimeout(800);
  await keep(page, "viewer-side");
  await page.click("button:has-text('Difference')");
  await page.waitForTimeout(800);
  await keep(page, "viewer-difference");

  // What is no map is refused, what is one lights the scene
  await page.setInputFiles("#hdr", { name: "no.hdr", mimeType: "image/vnd.radiance", buffer: Buffer.from("#?RADIANCE\nnothing") });
  await page.waitForSelector(".toast:has-text('no Radiance map')");
  const header = Buffer.from("#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 8 +X 16\n");
  const pixels = Buffer.alloc(4 * 8 * 16, Buffer.from([128, 64, 32, 129]));
  await page.setInputFiles("#hdr", { name: "warm.hdr", mimeType: "image/vnd.radiance", buffer: Buffer.concat([header, pixels]) });
  await page.waitForSelector(".toast:has-text('warm.hdr lights the scene')");
  await page.setViewportSize({ width: 390, height: 844 });
  await page.waitForTimeout(500);
  await keep(page, "viewer-phone");
}
