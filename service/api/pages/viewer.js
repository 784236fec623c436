// Put into the viewer's page, which is viser's own file: the way back, the title, and a reload after an upgrade.

const root = new URL("..", document.currentScript.src);
document.title = "splatfix viewer";

// Links to our own pages; their address depends on where the service is shown.
document.addEventListener("click", event => {
  const link = event.target.closest?.("[data-splatfix]");
  if (!link) return;
  event.preventDefault();
  location.href = new URL(link.dataset.splatfix, root);
});

// viser's page speaks only with the very version that it came from, so an open page must be loaded anew when the
// service comes back with another one. Asked every few seconds while somebody looks.
let known = null;
async function check() {
  if (document.hidden) return;
  const answer = await fetch(new URL("version", root), { cache: "no-store" }).catch(() => null);
  if (!answer?.ok) return;
  const version = await answer.text();
  if (known !== null && version !== known) location.reload();
  known = version;
}
check();
setInterval(check, 3000);
