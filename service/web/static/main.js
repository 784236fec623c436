// Which view the address asks for; a photo that is dropped or pasted anywhere.

import { h, say } from "./dom.js";
import * as compare from "./compare.js";
import * as history from "./history.js";
import * as job from "./job.js";
import * as start from "./start.js";

const ROUTES = [
  [/^#\/jobs$/, history.show],
  [/^#\/jobs\/([\w-]+)$/, job.show],
  [/^#\/compare\/([\w-]+)\/([\w-]+)$/, compare.show],
  [/^/, start.show],
];
const main = document.querySelector("#main");
const drophint = document.querySelector("#drophint");
let leave = null;

function route() {
  leave?.();
  const hash = location.hash.split("?")[0];
  const [pattern, show] = ROUTES.find(([pattern]) => pattern.test(hash));
  main.replaceChildren();
  leave = show(main, ...pattern.exec(hash).slice(1)) ?? null;
  for (const link of document.querySelectorAll("header nav a")) {
    const here = link.getAttribute("href") === (hash || "#/");
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

async function submitted(files) {
  try {
    await start.submit(files[0]);
  } catch (error) {
    if (start.told(error)) return;
    main.prepend(h("p", { class: "trouble", role: "alert" }, error.message));
    say(error.message);
  }
}

route();
