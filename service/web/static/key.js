// The API key: sent once, for a session's cookie. It never stands in an address.

import { service, ServiceError } from "./service.js";
import { h } from "./dom.js";

const AFTER = /^(viewer\/[\w/-]*|live)$/;

/** `query` is what follows `?` in the address: `then`, a page of the service, or `back`, a view of
 * this one, to go on with; `refused`, if a key was wrong. */
export function show(main, query) {
  document.title = "API key – splatfix";
  const given = new URLSearchParams(query);
  const trouble = h("p", { class: "trouble", role: "alert", hidden: !given.has("refused") }, "The key is not valid.");
  const key = h("input", { type: "password", required: true, autocomplete: "current-password", "aria-label": "API key" });
  const form = h("form", {},
    h("p", {}, "This service needs an API key."),
    h("p", { class: "buttons" }, key, h("button", { class: "primary" }, "Sign in")), trouble);
  form.addEventListener("submit", event => {
    event.preventDefault();
    enter(key.value.trim(), given.get("then") ?? "", given.get("back") ?? "").catch(error => {
      trouble.hidden = false;
      trouble.textContent = error.status === 401 ? "The key is not valid." : error.message;
      key.select();
    });
  });
  main.append(h("h1", {}, "API key"), form);
  key.focus();
}

async function enter(key, then, back) {
  if (!/^[\x21-\x7e]+$/.test(key)) throw new ServiceError({ detail: "The key is not valid." }, 401);
  const answer = await service.send("tokens", { method: "POST", headers: { Authorization: `Bearer ${key}` } });
  // A token of some minutes: the page that it opens leaves the cookie, and takes it out of the address.
  const { token } = await answer.json();
  location.href = `./${AFTER.test(then) ? then : ""}?token=${encodeURIComponent(token)}${back.startsWith("#/") ? back : ""}`;
}
