// From a photo's file to its job: the upload with its progress, and waiting until the scene is loaded.

import { service } from "./service.js";
import { h, seconds, words } from "./dom.js";
import { remember } from "./sent.js";

const POLL_MS = 1000;

/**
 * Send a photo with its fields, and return the job. While the scene is being loaded, or there is no free place, it
 * waits and sends again; `told` gets a text, and the sent share where that is known. Raises ServiceError, AbortError.
 */
export async function sendPhoto(file, fields, told, signal) {
  const onProgress = share => told(share < 1 ? `Uploading, ${Math.round(100 * share)} %` : "Reading the photo…", share);
  for (;;) {
    await untilLoaded(fields.scene, told, signal);
    try {
      const job = await service.submit(file, fields, { onProgress, signal });
      remember(job.id, file, fields);
      return job;
    } catch (error) {
      await mayPass(error, fields.scene, told, signal);
    }
  }
}

async function untilLoaded(scene, told, signal) {
  if (!scene || scene === "auto") return;
  for (;;) {
    const { state, gaussians } = await service.scene(scene);
    if (gaussians !== null || !["loading", "preparing"].includes(state)) return;
    told(`Waiting: the scene is ${words(state)}…`);
    await pause(POLL_MS, signal);
  }
}

/** Wait for what may pass by itself, and load a scene that isn't in memory; raise any other error. */
async function mayPass(error, scene, told, signal) {
  const { code } = error;
  if (code === "scene_unloaded") {
    const load = service.loadScene(scene);
    await load.catch(refused => { throw refused.status === 403 ? error : refused; });  // what an admin has to do
  }
  else if (!["queue_full", "rate_limited"].includes(code)) throw error;
  told(`Waiting: ${code === "scene_unloaded" ? "the scene is loading" : "the service is busy"}…`);
  await pause(POLL_MS, signal);
}

function pause(milliseconds, signal) {
  return new Promise((resolve, reject) => {
    signal?.throwIfAborted();
    const timer = setTimeout(resolve, milliseconds);
    signal?.addEventListener("abort", () => {
      clearTimeout(timer);
      reject(new DOMException("It was cancelled.", "AbortError"));
    }, { once: true });
  });
}

/** A box that shows an upload: its `told` is for `sendPhoto`, `signal` is aborted by its button. */
export function sendingBox(name) {
  const began = performance.now();
  const abort = new AbortController();
  const bar = h("progress", { max: 1, "aria-label": "Upload" });
  const text = h("span", {}, "Sending…");
  const cancel = h("button", { type: "button" }, "Cancel");
  cancel.addEventListener("click", () => abort.abort());
  const line = h("p", {}, h("strong", {}, name), " ", text);
  const element = h("section", { class: "sendbox", "aria-label": "Upload" }, line, bar, h("p", { class: "buttons" }, cancel));
  const told = (message, share) => {
    const spent = (performance.now() - began) / 1000;
    text.textContent = spent > 2 ? `${message} (${seconds(spent)})` : message;
    share === undefined || share === 1 ? bar.removeAttribute("value") : bar.value = share;
  };
  return { element, told, signal: abort.signal };
}
