// The frame around the pages: who is signed in, which page the address names, whether what is shown is live.

import { may, resume, signOut, whenSignedOut, who } from "/dashboard/api.js";
import { h, put } from "/dashboard/dom.js";
import { moment, setClock, span } from "/dashboard/format.js";
import * as live from "/dashboard/live.js";

const PAGES = [
  [/^\/(jobs)?$/, () => import("/dashboard/pages/jobs.js")],
  [/^\/jobs\/([^/]+)$/, () => import("/dashboard/pages/job.js")],
  [/^\/jobs\/([^/]+)\/bake$/, () => import("/dashboard/pages/viewer.js")],
  [/^\/jobs\/([^/]+)\/report$/, () => import("/dashboard/pages/report.js")],
  [/^\/submit$/, () => import("/dashboard/pages/submit.js")],
  [/^\/workers$/, () => import("/dashboard/pages/workers.js")],
  [/^\/stuck$/, () => import("/dashboard/pages/stuck.js")],
  [/^\/limits$/, () => import("/dashboard/pages/limits.js")],
  [/^\/audit$/, () => import("/dashboard/pages/audit.js")],
  [/^\/tokens$/, () => import("/dashboard/pages/tokens.js")],
];

const LINKS = [
  ["/jobs", "Jobs", "viewer"],
  ["/workers", "Workers", "viewer"],
  ["/stuck", "Stuck", "viewer"],
  ["/limits", "Limits", "viewer"],
  ["/audit", "Audit", "admin"],
  ["/tokens", "Tokens", "admin"],
];

const app = document.getElementById("app");
const main = h("main", { id: "main", tabindex: "-1" });
const stale = h("div", { class: "stale", role: "alert", hidden: true });
let leave = () => {};
let turn = 0;

/** Goes to a page of the dashboard. */
export function go(path) {
  history.pushState(null, "", path);
  return show();
}

async function show() {
  const own = ++turn;
  leave();
  leave = () => {};
  const { pathname } = location;
  if (!who()) {
    const page = await import("/dashboard/pages/sign-in.js");
    put(app, main);
    document.title = "Sign in · Pantaray";
    page.show(put(main), { signedIn });
    return;
  }
  frame();
  put(main, h("p", { class: "loading" }, "Loading …"));
  const found = PAGES.map(([pattern, load]) => [pathname.match(pattern), load]).find(([match]) => match);
  try {
    const page = found ? await found[1]() : null;
    if (own !== turn) return;
    if (!page) throw new Error(`there is no page ${pathname}`);
    const cleanups = [];
    const context = { id: found[0][1] && decodeURIComponent(found[0][1]), go, while: (end) => cleanups.push(end) };
    leave = () => cleanups.forEach((end) => end());
    const title = await page.show(put(main), context);
    if (own !== turn) {
      cleanups.forEach((end) => end());
      return;
    }
    document.title = `${title} · Pantaray`;
  } catch (problem) {
    if (own !== turn || !who()) return;
    document.title = "Not there · Pantaray";
    put(main, h("section", { class: "empty" }, h("h1", {}, problem.status === 404 ? "Not there" : "This page cannot be shown"), h("p", {}, problem.message), problem.hint && h("p", {}, problem.hint),
      h("p", {}, h("a", { href: "/jobs" }, "All jobs"))));
  }
  main.focus({ preventScroll: true });
  scrollTo(0, 0);
}

function frame() {
  const session = who();
  const here = (href) => location.pathname === href || location.pathname.startsWith(`${href}/`) || (href === "/jobs" && location.pathname === "/");
  const links = LINKS.filter(([, , role]) => may(role)).map(([href, text]) => h("a", { href, "aria-current": here(href) && "page" }, text));
  const leaveNow = async () => {
    live.stop();
    await signOut();
    await go("/");
  };
  put(app, h("a", { class: "skip", href: "#main" }, "Skip to the page"),
    h("header", { class: "top" }, h("a", { class: "brand", href: "/jobs" }, h("img", { src: "/dashboard/icon.svg", alt: "", width: 22, height: 22 }), "Pantaray"),
      h("nav", { "aria-label": "Pages" }, links),
      h("span", { class: "grow" }),
      may("submitter") && h("a", { class: "button primary", href: "/submit" }, "Submit"),
      h("button", { class: "plain", title: "Light or dark", "aria-label": "Light or dark", onclick: turnTheme }, "◐"),
      h("details", { class: "menu" }, h("summary", { "aria-label": `Signed in as ${session.name}` }, session.name), h("div", {}, h("p", {}, session.name, h("small", {}, `${session.role}${session.project ? ` of ${session.project}` : ""}`)),
        session.expires_at && h("p", {}, h("small", {}, `until ${moment(session.expires_at)}`)), h("p", {}, h("small", {}, `Pantaray ${session.version}`)), session.expires_at && h("button", { onclick: leaveNow }, "Sign out")))),
    stale, main);
}

async function signedIn() {
  setClock(who().now);
  live.start();
  await show();
}

function turnTheme() {
  const dark = getComputedStyle(document.documentElement).colorScheme.startsWith("dark") && document.documentElement.dataset.theme !== "light";
  document.documentElement.dataset.theme = dark ? "light" : "dark";
  localStorage.setItem("theme", document.documentElement.dataset.theme);
  dispatchEvent(new Event("theme"));
}

function watchAge() {
  const tick = () => {
    if (stale.hidden) return;
    put(stale, h("strong", {}, "Not live. "), lost ? `What you see may be old: nothing has been heard from the coordinator for ${span(Date.now() - lost)}. ` : "Connecting to the coordinator. ", "Trying again by itself.");
  };
  let lost = 0;
  let timer = 0;
  live.onState(({ connected, since }) => {
    lost = since;
    clearTimeout(timer);
    if (connected) stale.hidden = true;
    else timer = setTimeout(() => { stale.hidden = !who(); tick(); }, 2_500);
  });
  setInterval(tick, 1_000);
}

document.addEventListener("click", (event) => {
  const link = event.target.closest?.("a[href^='/']");
  if (!link || event.defaultPrevented || event.button !== 0 || event.metaKey || event.ctrlKey || event.shiftKey || link.hasAttribute("download") || link.getAttribute("href").startsWith("/v1/")) return;
  event.preventDefault();
  go(link.getAttribute("href"));
});
document.addEventListener("keydown", (event) => {
  if (event.key !== "/" || event.target.closest("input, textarea, select, dialog")) return;
  const search = main.querySelector("input[type=search]");
  if (search) {
    event.preventDefault();
    search.focus();
  }
});
addEventListener("popstate", show);
whenSignedOut(() => { live.stop(); show(); });

const theme = localStorage.getItem("theme");
if (theme) document.documentElement.dataset.theme = theme;
watchAge();
try {
  if (await resume()) await signedIn();
  else await show();
} catch (problem) {
  put(app, h("section", { class: "empty" }, h("h1", {}, "The coordinator does not answer"), h("p", {}, problem.message), h("button", { onclick: () => location.reload() }, "Try again")));
}
