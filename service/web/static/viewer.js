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
document.cookie = `splatfix_gl=${drawn}; path=${new URL("viewer", root).pathname}; SameSite=Strict`;

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
