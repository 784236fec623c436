// Put into the viewer's page, which is viser's own file, before all else: the way back, the title, a reload after an
// upgrade, and whether there is a GPU.

const root = new URL("..", document.currentScript.src);
document.title = "splatfix viewer";

// Without a GPU a picture of the splats takes seconds. The socket that is opened next takes the word along, and the
// service draws instead.
function drawsInSoftware() {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (!gl) return true;
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  const name = gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software|basic render/i.test(name);
}
const drawn = drawsInSoftware() ? "software" : "gpu";
const where = `path=${new URL("viewer", root).pathname}; SameSite=Strict`;
document.cookie = `splatfix_gl=${drawn}; ${where}`;
// Times are shown as on the other pages: in the browser's zone.
document.cookie = `splatfix_zone=${encodeURIComponent(Intl.DateTimeFormat().resolvedOptions().timeZone)}; ${where}`;

// Links to our own pages; their address depends on where the service is shown.
document.addEventListener("click", event => {
  const link = event.target.closest?.("[data-splatfix]");
  if (!link) return;
  event.preventDefault();
  location.href = new URL(link.dataset.splatfix, root);
});

// The page belongs to one run of the viewer, with which its state ends. After a restart, be it of the service with
// another version of viser's page, it is loaded anew at once, so that it is there when the scenes are; until then a bar
// says why nothing moves. Of several services behind one address any answers: a viewer that was started before the page
// was opened does not replace the page's own.
const CHECK_MS = 1000;
const opened = Date.now(); // not performance.now(), which stands still while a computer sleeps
let ready = false;

async function check() {
  if (!document.hidden) {
    await compare().catch(() => {
      ready = false;
      show("The connection to the service is lost. Reconnecting…");
    });
  }
  setTimeout(check, CHECK_MS);
}

async function compare() {
  const open_s = (Date.now() - opened) / 1000; // before it is asked: the answer takes its time
  const answer = await fetch(new URL("viewer-run", root), { cache: "no-store" });
  if (answer.status === 401) {
    const then = encodeURIComponent(location.pathname.slice(root.pathname.length));
    show("The session has ended.", { text: "Sign in", page: `./#/key?then=${then}` });
    return;
  }
  if (!answer.ok) throw new Error(answer.status);
  if (await answer.json() < open_s) {
    location.reload();
    return;
  }
  if (!ready) {
    const { pending } = await (await fetch(new URL("readyz", root), { cache: "no-store" })).json();
    ready = !pending.length;
    if (!ready) return show(`The service is starting (${pending[0]}).`);
  }
  bar.remove();
}

// viser gives no name to some of its controls and pictures, which a screen reader then can't tell apart, and no keyboard
// reaches what has to be scrolled.
const ICONS = { "list-search": "Commands", adjustments: "Configuration and diagnostics", "arrow-back": "Back to the panel" };
const named = element => document.querySelector(`label[for="${CSS.escape(element.id)}"]`)?.textContent ?? "";
const NAMES = {
  ".mantine-Slider-root": slider => set(slider.querySelector("[role=slider]"), "aria-label", named(slider)),
  ".mantine-Slider-root + * input": input => set(input, "aria-label", named(input.closest(".mantine-Slider-root + *").previousElementSibling)),
  ".mantine-ActionIcon-root:has(svg)": icon => set(icon, "aria-label", Object.entries(ICONS).find(([name]) => icon.querySelector(`.tabler-icon-${name}`))?.[1]),
  ".mantine-Notification-closeButton": button => set(button, "aria-label", "Close"),
  "img:not([alt])": image => set(image, "alt", document.querySelector("[role=tab][aria-selected=true]")?.textContent),
  ".mantine-ScrollArea-viewport:not([tabindex])": region => set(region, "tabindex", "0"),
};

function set(element, attribute, value) {
  if (value && element.getAttribute(attribute) !== value) element.setAttribute(attribute, value);
}

// Until the panel comes, viser shows an empty page with settings of its own.
const cover = document.createElement("div");
cover.setAttribute("role", "status");
cover.textContent = "Loading the viewer…";
cover.style.cssText = "position:fixed;inset:0;z-index:1900;display:grid;place-items:center;background:#1b1d20;" +
  "color:#e6e8ea;font:16px/1.4 system-ui,sans-serif";
document.documentElement.append(cover);

let toName = 0;
new MutationObserver(() => {
  toName ||= requestAnimationFrame(() => {
    toName = 0;
    if (document.querySelector("[data-splatfix]")) cover.remove();
    for (const [selector, name] of Object.entries(NAMES)) document.querySelectorAll(selector).forEach(name);
  });
}).observe(document.documentElement, { childList: true, subtree: true });

// viser's labels have a contrast of 4.0 : 1. On narrow screens its panel, 20em wide, covers a half of the view: there it
// is a sheet along the lower edge, which folds by its handle.
const styles = document.createElement("style");
styles.textContent = `
:root { --mantine-color-dimmed: #c3c6ca !important; --mantine-color-placeholder: #c3c6ca !important; }
@media (max-width: 36em) {
  [style^="width: 20em"], [style*=" width: 20em"] { width: 100vw !important; }
  [style*=" width: 20em"] { max-height: 42dvh !important; border-radius: 14px 14px 0 0 !important; }
  .splatfix-back { inset: .6em .6em auto auto !important; }
}
.splatfix-back { position: fixed; inset: auto auto .6em .6em; z-index: 1000; padding: .4em .8em; border-radius: 8px;
  background: #1f2226; color: #f0953f; font: 15px/1.4 system-ui, sans-serif; }`;
document.head.append(styles);

// A job that was sent with others has a way back to their table.
const [, job] = location.pathname.match(/\/jobs\/([\w-]+)/) ?? [];
if (job) import(new URL("ui/batches.js", root)).then(({ backFrom }) => {
  const back = backFrom(job);
  if (!back) return;
  const link = document.createElement("a");
  link.href = "#";
  link.textContent = back.text;
  link.className = "splatfix-back";
  link.dataset.splatfix = `./${back.page}`;
  document.body.append(link);
});

const bar = document.createElement("div");
bar.setAttribute("role", "alert");
bar.className = "splatfix-lost";
bar.style.cssText = "position:fixed;inset:0 0 auto;z-index:2000;padding:.6em 1em;background:#b3261e;color:#fff;" +
  "font:15px/1.4 system-ui,sans-serif;text-align:center";

function show(message, link) {
  bar.textContent = `${message} `;
  if (link) {
    const anchor = document.createElement("a");
    anchor.textContent = link.text;
    anchor.href = "#";
    anchor.style.color = "#fff";
    anchor.dataset.splatfix = link.page;
    bar.append(anchor);
  }
  if (!bar.isConnected) document.body?.append(bar);
}

check();
