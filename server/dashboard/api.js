// The coordinator's operations, with what a change by a session has to send.

/** An answer that is a problem: what was wrong, and what to do about it. */
export class Problem extends Error {
  constructor(status, body) {
    super(body?.detail ?? `the coordinator answered ${status}`);
    this.status = status;
    this.code = body?.code ?? "unknown";
    this.hint = body?.hint;
  }
}

let session = null;
let onSignedOut = () => {};

/** Who is signed in; null where nobody is. */
export const who = () => session;

/** What to do when the session turns out to be over. */
export function whenSignedOut(action) {
  onSignedOut = action;
}

/** Whether the one who is signed in may do what a role may. */
export function may(role) {
  const order = ["viewer", "submitter", "admin"];
  return session !== null && order.indexOf(session.role) >= order.indexOf(role);
}

async function send(method, path, options = {}) {
  const headers = new Headers(options.headers);
  if (method !== "GET" && session) headers.set("X-Pantaray-CSRF", session.csrf);
  let body = options.bytes;
  if (options.json !== undefined) {
    headers.set("Content-Type", "application/json");
    body = JSON.stringify(options.json);
  }
  const answer = await fetch(path, { method, headers, body, signal: options.signal, credentials: "same-origin" });
  if (answer.ok) return answer;
  const problem = new Problem(answer.status, await answer.json().catch(() => null));
  if (problem.status === 401 && session && !options.quiet) {
    session = null;
    onSignedOut();
  }
  throw problem;
}

/** GET of JSON. */
export const get = async (path, options) => (await send("GET", path, options)).json();
/** GET of text. */
export const getText = async (path, options) => (await send("GET", path, options)).text();
/** GET of a stream or of bytes. */
export const getRaw = (path, options) => send("GET", path, options);

/** A change; its answer as JSON where there is one. */
export async function change(method, path, json, options = {}) {
  const answer = await send(method, path, { ...options, json });
  return answer.status === 204 ? null : answer.json();
}

/** An upload. */
export const upload = (path, bytes, options) => send("PUT", path, { ...options, bytes });

/** Asks who is signed in. */
export async function resume() {
  try {
    session = await get("/v1/session", { quiet: true });
  } catch (problem) {
    if (problem.status !== 401 && problem.status !== 403) throw problem;
    session = null;
  }
  return session;
}

/** Signs in with a token. */
export async function signIn(token) {
  session = await change("POST", "/v1/session", { token });
  return session;
}

/** Signs out; a session that is over already is signed out, too. */
export async function signOut() {
  await change("DELETE", "/v1/session", undefined, { quiet: true }).catch(() => null);
  session = null;
}

/** A path with the values of a query that are there. */
export function query(path, values) {
  const found = new URLSearchParams();
  for (const [name, value] of Object.entries(values)) {
    if (value !== undefined && value !== null && value !== "") found.set(name, value);
  }
  const text = found.toString();
  return text ? `${path}?${text}` : path;
}
