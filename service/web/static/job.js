// One job: its progress while it runs, then its answer.

import { ENDED, service } from "./service.js";
import { backLine } from "./batches.js";
import { h, label, labelled, say, seconds, words } from "./dom.js";
import { result } from "./result.js";
import { recalled } from "./sent.js";

export function show(main, id) {
  document.title = "localizing – splatfix";
  const stops = [];
  let left = false;
  const view = { main, onLeave: stop => (left ? stop() : stops.push(stop)) };
  open(view, id).catch(error => refused(view, error));
  return () => { left = true; stops.forEach(stop => stop()); };
}

function refused({ main }, error) {
  if (error.status === 401) return;  // a form for the key is shown
  const title = error.status === 404 ? "Job not found" : "The job can't be shown";
  main.replaceChildren(h("h1", {}, title), h("p", { class: "trouble", role: "alert" }, error.message));
}

async function open(view, id) {
  const job = await service.job(id);
  if (ENDED.includes(job.state)) finish(view, job);
  else progress(view, job);
}

async function finish(view, job) {
  const scene = await service.scene(job.scene).catch(() => null);
  const status = job.result?.status ?? job.state;
  document.title = `${words(status)} – splatfix`;
  const preview = view.main.querySelector("img.preview")?.src;
  view.main.replaceChildren(...result(job, scene));
  if (preview) URL.revokeObjectURL(preview);
  say(`${words(status)}. ${[job.result?.search_summary, job.result?.hint].filter(Boolean).join(" ") || job.error?.detail || ""}`);
}

function progress(view, job) {
  const bar = h("progress", { max: 1, "aria-label": "Progress" });
  const line = h("p", { class: "line" });
  const stages = h("ol", { class: "stages" });
  const trouble = h("p", { class: "trouble", role: "alert", hidden: true });
  const cancel = h("button", { type: "button", "data-needs": "localize" }, "Cancel");
  cancel.addEventListener("click", async () => {
    cancel.disabled = true;
    await service.cancel(job.id).catch(error => { trouble.hidden = false; trouble.textContent = error.message; });
  });
  view.main.replaceChildren(backLine(job.id) ?? "", h("h1", {}, `Localizing ${job.photo.name || "a photo"}`), trouble,
    h("div", { class: "progress" }, preview(job), h("div", {}, bar, line, stages,
      h("p", { class: "buttons" }, h("a", { class: "button primary", href: job.links.viewer }, "Watch in viewer"), cancel))));

  const state = { latest: null, latestAt: 0, usual: null, job, scene: null };
  usualTime(job).then(usual => { state.usual = usual; });
  const draw = () => {
    line.textContent = described(state);
    if (state.usual && state.latest) bar.value = Math.min(0.97, elapsed(state) / state.usual);
  };
  const timers = [setInterval(draw, 100), setInterval(() => state.latest || refresh(state), 1000)];
  refresh(state);
  const stop = new AbortController();
  const ended = service.follow(job.id, {
    signal: stop.signal,
    onRecord: record => {
      if (record.stage !== state.latest?.stage) stages.append(h("li", {}, labelled("stage", record.stage)));
      [state.latest, state.latestAt] = [record, performance.now()];
      draw();
    },
    onRestart: () => {
      stages.replaceChildren();
      state.latest = null;
      draw();
    },
    onLost: () => {
      trouble.hidden = false;
      trouble.textContent = "The connection to the service is lost. Reconnecting…";
    },
    onResumed: () => {
      trouble.hidden = true;
      say("Connected again");
    },
  });
  ended.finally(() => timers.forEach(clearInterval))
    .then(done => finish(view, done))
    .catch(error => { if (error.name !== "AbortError") refused(view, error); });
  view.onLeave(() => stop.abort());
  draw();
}

/** While there is no record, ask in which state the job and its scene are. */
async function refresh(state) {
  const [job, scene] = await Promise.all([
    service.job(state.job.id).catch(() => null), service.scene(state.job.scene).catch(() => null)]);
  if (job) state.job = job;
  state.scene = scene;
}

/** The job's time by the service's clock, so that it is right whenever this page was opened. */
function elapsed({ latest, latestAt }) {
  return latest.elapsed_s + (performance.now() - latestAt) / 1000;
}

function described(state) {
  const { latest, usual, job, scene } = state;
  if (latest) {
    const left = usual ? usual - elapsed(state) : null;
    const eta = left === null ? "" : left > 0 ? `, about ${seconds(left)} left` : ", longer than usual";
    return `${label("stage", latest.stage)}, step ${latest.index + 1}, ${seconds(elapsed(state))}${eta}`;
  }
  if (scene && ["loading", "unloaded"].includes(scene.state)) return `Queued: the scene is ${scene.state}`;
  if (scene?.state === "preparing") return "Preparing the scene";
  return job.state === "running" ? "Running" : "Queued";
}

/** The median time of the last jobs of this kind, in seconds; null if there are none. */
async function usualTime(job) {
  const { jobs } = await service.jobs({ scene: job.scene, state: "succeeded", limit: 50 }).catch(() => ({ jobs: [] }));
  const times = jobs
    .filter(other => other.estimator === job.estimator && other.finished && other.started)
    .map(other => (Date.parse(other.finished) - Date.parse(other.started)) / 1000)
    .sort((a, b) => a - b);
  return times.length ? times[times.length >> 1] : null;
}

function preview(job) {
  const file = recalled(job.id)?.file;
  // What this page has sent is at hand; a browser that can't decode it (HEIC) shows what the service made of it.
  const image = h("img", { class: "preview", alt: "The photo", src: file ? URL.createObjectURL(file) : job.links.photo });
  image.addEventListener("error", () => { image.src = job.links.photo; }, { once: true });
  return image;
}
