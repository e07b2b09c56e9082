// What tracing took, as people read it: sums of rays, time, bricks and bytes become rates and shares.

import { h } from "/dashboard/dom.js";
import { short } from "/dashboard/format.js";

const NAMES = ["batches", "points", "rays", "trace_us", "brick_requests", "brick_misses", "read_bytes", "device_bytes", "device_us"];

/** The sum of several. */
export function sum(all) {
  return Object.fromEntries(NAMES.map((name) => [name, all.reduce((value, one) => value + one[name], 0)]));
}

/** Rays per second of one worker, such as 12.3 M/s. */
export const raysPerSecond = (traced) => (traced?.trace_us > 0 ? `${short((1e6 * traced.rays) / traced.trace_us)}/s` : null);

/** The share of bricks that were in the arena already. */
export const cacheHits = (traced) => (traced?.brick_requests > 0 ? 1 - traced.brick_misses / traced.brick_requests : null);

/** The same as text: 99.57 %, and never 100 % where something was missed. */
export function cacheHitsText(traced) {
  const hits = cacheHits(traced);
  if (hits === null) return null;
  return hits === 1 ? "100 %" : `${(Math.floor(1e4 * hits) / 100).toFixed(2)} %`;
}

/** Batches after which bricks that are missing are no longer those that nobody had asked for before. */
const WARM = 16;

/** A cell with it: a worker that has not nine of ten bricks in memory reads more than it need. */
export function cacheHitsCell(traced) {
  const text = cacheHitsText(traced);
  if (text === null) return "–";
  return cacheHits(traced) < 0.9 && traced.batches >= WARM ? h("strong", { class: "tone-paused", title: "fewer than nine of ten bricks were in memory: give the worker more memory" }, `! ${text}`) : text;
}

const each = (bytes, rays) => (rays > 0 ? `${(bytes / rays).toFixed(bytes / rays < 10 ? 2 : 0)} B` : null);

/** Bytes that were read for each ray. */
export const bytesPerRay = (traced) => (traced ? each(traced.read_bytes, traced.rays) : null);

/** Bytes that went to devices for each ray. */
export const deviceBytesPerRay = (traced) => (traced?.device_bytes > 0 ? each(traced.device_bytes, traced.rays) : null);

/** The share of the time that the busiest device was at work. */
export const deviceShare = (traced) => (traced?.device_us > 0 && traced.trace_us > 0 ? `${Math.min(100, (100 * traced.device_us) / traced.trace_us).toFixed(0)} %` : null);
