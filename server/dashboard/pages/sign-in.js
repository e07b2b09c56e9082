// Signing in: a token becomes a session.

import { signIn } from "/dashboard/api.js";
import { h, put } from "/dashboard/dom.js";

export function show(main, { signedIn }) {
  const token = h("input", { type: "password", name: "token", required: true, autocomplete: "current-password", spellcheck: "false", placeholder: "pantaray_…" });
  const problemLine = h("p", { class: "problem", role: "alert" });
  const button = h("button", { class: "primary", type: "submit" }, "Sign in");
  const submit = async (event) => {
    event.preventDefault();
    button.disabled = true;
    put(problemLine);
    try {
      await signIn(token.value);
      await signedIn();
    } catch (problem) {
      put(problemLine, problem.status ? `That did not work: ${problem.message}. ` : "The coordinator does not answer. ", problem.hint);
      token.select();
    }
    button.disabled = false;
  };
  main.append(h("form", { class: "sign-in", onsubmit: submit },
    h("img", { src: "/dashboard/icon.svg", alt: "", width: 56, height: 56 }),
    h("h1", {}, "Pantaray"),
    h("label", { class: "field" }, h("span", {}, "Token"), token),
    problemLine, button,
    h("p", { class: "quiet" }, "An administrator makes tokens: ", h("code", {}, "pantaray token create"), ". The first one lies beside the coordinator's database, in ", h("code", {}, "admin.token"), ".")));
  token.focus();
}
