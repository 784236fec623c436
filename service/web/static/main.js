// Which view the address asks for; photos that are dropped or pasted anywhere.

import * as batch from "./batch.js";
import * as compare from "./compare.js";
import * as history from "./history.js";
import * as job from "./job.js";
import * as key from "./key.js";
import * as keys from "./keys.js";
import * as scene from "./scene.js";
import { hideForbidden } from "./service.js";
import * as start from "./start.js";

const ROUTES = [
  [/^#\/key$/, key.show],
  [/^#\/keys$/, keys.show],
  [/^#\/batch\/([\w,-]*)$/, batch.show],
  [/^#\/jobs$/, history.show],
  [/^#\/jobs\/([\w-]+)$/, job.show],
  [/^#\/scenes\/([^/]+)$/, scene.show],
  [/^#\/compare\/([\w-]+)\/([\w-]+)$/, compare.show],
  [/^/, start.show],
];
// The menu's entry for each of them.
const MENU = [[/^#\/keys?$/, "#/keys"], [/^#\/(batch|jobs|compare)\b/, "#/jobs"], [/^/, "#/"]];
const main = document.querySelector("#main");
const drophint = document.querySelector("#drophint");
let leave = null;

function route() {
  leave?.();
  const [hash, query = ""] = location.hash.split("?");
  const [pattern, show] = ROUTES.find(([pattern]) => pattern.test(hash));
  main.replaceChildren();
  leave = show(main, ...pattern.exec(hash).slice(1), query) ?? null;
  const entry = MENU.find(([pattern]) => pattern.test(hash))[1];
  for (const link of document.querySelectorAll("header nav a")) {
    const here = link.getAttribute("href") === entry;
    here ? link.setAttribute("aria-current", "page") : link.removeAttribute("aria-current");
  }
  window.scrollTo(0, 0);
}

addEventListener("hashchange", () => { route(); main.focus({ preventScroll: true }); });

const hasFiles = event => event.dataTransfer?.types.includes("Files");
addEventListener("dragover", event => {
  if (!hasFiles(event)) return;
  event.preventDefault();
  drophint.hidden = false;
});
addEventListener("dragleave", event => { if (!event.relatedTarget) drophint.hidden = true; });
addEventListener("drop", event => {
  if (!hasFiles(event)) return;
  event.preventDefault();
  drophint.hidden = true;
  submitted(event.dataTransfer.files);
});
addEventListener("paste", event => {
  if (event.clipboardData?.files.length) submitted(event.clipboardData.files);
});

function submitted(files) {
  start.submit([...files]).catch(start.told);
}

hideForbidden().then(own => { document.querySelector("#keys").hidden = own?.name == null || own.role !== "admin"; });
route();
