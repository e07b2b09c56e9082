// Events as they happen, over one stream that comes back by itself with the number of the last event it has.
// Whoever shows something is told how old it is: a silent stream counts as broken.

import { getRaw } from "/dashboard/api.js";

/** Milliseconds of silence after which the stream counts as broken: comments come every 15 s. */
const SILENCE_MS = 40_000;
const RETRY_MS = [500, 1_000, 2_000, 5_000, 10_000];

const listeners = new Set();
const watchers = new Set();
let last = null;
let heard = 0;
let connected = false;
let controller = null;

/** Calls back for each event until the answer is called; `progress` says how far a live job is, twice a second at most. */
export function onEvent(listener) {
  listeners.add(listener);
  return () => listeners.delete(listener);
}

/** Calls back with `{connected, since}` when that changes. */
export function onState(watcher) {
  watchers.add(watcher);
  watcher(state());
  return () => watchers.delete(watcher);
}

const state = () => ({ connected, since: heard });

function become(now) {
  if (connected === now) return;
  connected = now;
  for (const watcher of watchers) watcher(state());
}

/** One message of the stream, as its fields say. */
function take(message) {
  const fields = { event: "message", data: "" };
  for (const line of message.split("\n")) {
    const at = line.indexOf(":");
    if (at > 0) fields[line.slice(0, at)] = line.slice(at + 1).trimStart();
  }
  if (fields.id) last = fields.id;
  if (!fields.data) return;
  let detail = null;
  try {
    detail = JSON.parse(fields.data);
  } catch {
    return;
  }
  for (const listener of listeners) listener({ kind: fields.event, ...detail });
}

async function listen(signal) {
  const headers = last === null ? {} : { "Last-Event-ID": last };
  const answer = await getRaw("/v1/events?progress=true", { headers, signal });
  heard = Date.now();
  become(true);
  const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return;
    heard = Date.now();
    rest += value.replaceAll("\r", "");
    const messages = rest.split("\n\n");
    rest = messages.pop();
    messages.forEach(take);
  }
}

/** Listens until stopped. */
export async function start() {
  stop();
  const own = (controller = new AbortController());
  const guard = setInterval(() => {
    if (connected && Date.now() - heard > SILENCE_MS) become(false);
  }, 1_000);
  for (let failures = 0; !own.signal.aborted; ) {
    try {
      await listen(own.signal);
      failures = 0;
    } catch (problem) {
      if (problem.status === 401) break;
      failures += 1;
    }
    become(false);
    if (own.signal.aborted) break;
    await new Promise((done) => setTimeout(done, RETRY_MS[Math.min(failures, RETRY_MS.length - 1)]));
  }
  clearInterval(guard);
}

/** Listens no more. */
export function stop() {
  controller?.abort();
  controller = null;
  become(false);
}
