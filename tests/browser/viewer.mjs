// The viewer: the light is turned, and pixels change as `relight` says; numbers, comparison, links.

import { readFileSync } from "node:fs";

import { readable } from "./access.mjs";
import { check, compare, fluid, keep, url } from "./browser.mjs";

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

/** How many pixels of a stage hold something, and how far from grey those are at the most. */
async function drawn(page) {
  const shot = (await page.locator("canvas.view").screenshot()).toString("base64");
  return page.evaluate(async (shot) => {
    const bitmap = await createImageBitmap(new Blob([Uint8Array.from(atob(shot), (c) => c.charCodeAt(0))], { type: "image/png" }));
    const context = new OffscreenCanvas(bitmap.width, bitmap.height).getContext("2d");
    context.drawImage(bitmap, 0, 0);
    const { data } = context.getImageData(0, 0, bitmap.width, bitmap.height);
    let [bright, coloured] = [0, 0];
    for (let at = 0; at < data.length; at += 4) {
      // The ground is darker than what is drawn of a difference, and bluish
      if (data[at] < 120) continue;
      bright += 1;
      if (Math.abs(data[at] - data[at + 2]) > 12) coloured += 1;
    }
    return { bright, coloured };
  }, shot);
}

/** A bake that is under way is seen as far as it is, and says that it is not all. */
export async function sofar(page, job) {
  await page.goto(`${url}/jobs/${job}`);
  await page.click("text=See it so far");
  await page.waitForSelector(".viewer-sofar:has-text('so far')");
  await page.waitForSelector(".viewer-status[data-idle=true]");
  const points = await page.evaluate(() => Number(document.querySelector(".viewer-status").textContent.match(/^[\d,]+/)[0].replaceAll(",", "")));
  check(points > 1_000, `${points} points of finished batches are drawn`);
  await readable(page, "viewer-sofar");
}

export async function viewer(page, job, twin, view) {
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
  // The same under a map that is dropped on the page
  await visit({ rot: view.dropped.rotation });
  await page.waitForSelector(".viewer-status[data-idle=true]");
  const transfer = await page.evaluateHandle((bytes) => {
    const transfer = new DataTransfer();
    transfer.items.add(new File([Uint8Array.from(atob(bytes), (c) => c.charCodeAt(0))], "glow.hdr"));
    return transfer;
  }, readFileSync(view.dropped.map).toString("base64"));
  await page.dispatchEvent("canvas.view", "drop", { dataTransfer: transfer });
  await page.waitForSelector(".toast:has-text('glow.hdr lights the scene')");
  await page.click(".toast button");
  await keep(page, "viewer-dropped");
  found.push({ env: "a dropped map", rotation: view.dropped.rotation, relit: readFileSync(view.dropped.picture), seen: await stage(page, view.size) });
  const [one, other] = found;
  const apart = await compare(page, one.relit, other.relit);
  for (const { env, rotation, relit, seen } of found) {
    const { difference, both, one } = await compare(page, seen, relit);
    console.log(`${env} turned by ${rotation}°: ${difference.toFixed(2)} of 255 from relight's picture over ${both} pixels, ${one} covered by one alone; two lights are ${apart.difference.toFixed(2)} apart`);
    check(both > 10_000 && one < both / 5, `both cover the same: ${both} and ${one}`);
    check(difference < apart.difference / 4, "the viewer shows what relight draws");
  }

  // Every view draws something of its own
  await fluid(page, "the viewer", async () => {
    await visit({});
    await page.waitForSelector(".viewer-status[data-idle=true]");
    await page.locator("canvas.view").focus();
    for (const key of ["ArrowLeft", "ArrowUp", "+", "]", "]", "-", "ArrowDown", "ArrowRight", "[", "["]) await page.keyboard.press(key);
    await page.waitForTimeout(500);
  });
  await readable(page, "viewer");
  const shots = new Set();
  for (const show of ["lit", "sky", "bent", "band0", "band1", "band2", "normal", "error"]) {
    await page.selectOption("select[aria-label=Show]", show);
    await page.waitForTimeout(250);
    shots.add((await page.locator(".viewer-stage").screenshot()).toString("base64"));
    if (["sky", "bent", "error"].includes(show)) await keep(page, `viewer-${show}`);
  }
  check(shots.size === 8, `${shots.size} of 8 views differ`);

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
  await page.waitForFunction(() => location.hash.includes("rot=90") && location.hash.includes("env=sunset"));

  // The same bake of another job beside it: both halves are alike, the difference is nothing; another light is no difference
  await page.selectOption("select[aria-label='Compare with']", `${twin}/hill`);
  await page.waitForSelector("button:has-text('Difference')");
  await page.waitForSelector(".viewer-status[data-idle=true]");
  await page.waitForTimeout(800);
  await keep(page, "viewer-side");
  await page.click("button:has-text('Difference')");
  await page.waitForTimeout(800);
  await readable(page, "viewer-difference");
  const nothing = await drawn(page);
  check(nothing.bright > 10_000 && nothing.coloured < nothing.bright / 200, `two bakes of the same do not differ: ${JSON.stringify(nothing)}`);

  // A link that somebody is sent restores all of it
  await page.waitForFunction(() => location.hash.includes("compare=difference"));
  const sent = page.url();
  await page.goto("about:blank");
  await page.goto(sent);
  await page.waitForSelector("button[aria-pressed=true]:has-text('Difference')");
  check((await page.inputValue("select[aria-label='Environment']")) === "sunset" && (await page.inputValue("input[aria-label='Turn the light']")) === "90", "a link restores light and comparison");
  // The tent is another thing: that is a difference
  await page.selectOption("select[aria-label='Compare with']", `${job}/tent`);
  await page.waitForTimeout(1_200);
  await page.selectOption("select[aria-label='Compare with']", "");

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
