// One job: its progress while it runs, then its answer.

import { ask, ENDED, follow } from "./api.js";
import { h, say, seconds, words } from "./dom.js";
import { result } from "./result.js";
import { recalled } from "./sent.js";

export function show(main, id) {
  document.title = "localizing – splatfix";
  const stops = [];
  let left = false;
  const view = { main, onLeave: stop => (left ? stop() : stops.push(stop)) };
  open(view, id).catch(error => {
    main.replaceChildren(h("h1", {}, "No such job"), h("p", { class: "trouble", role: "alert" }, error.message));
  });
  return () => { left = true; stops.forEach(stop => stop()); };
}

async function open(view, id) {
  const job = await ask(`jobs/${id}`);
  if (ENDED.includes(job.state)) finish(view, job);
  else progress(view, job);
}

async function finish(view, job) {
  const scene = await ask(`scenes/${encodeURIComponent(job.scene)}`).catch(() => null);
  const status = job.result?.status ?? job.state;
  document.title = `${words(status)} – splatfix`;
  const preview = view.main.querySelector("img.preview")?.src;
  view.main.replaceChildren(...result(job, scene));
  if (preview) URL.revokeObjectURL(preview);
  say(`${words(status)}. ${job.result?.hint ?? job.error?.detail ?? ""}`);
}

function progress(view, job) {
  const began = performance.now();
  const bar = h("progress", { max: 1, "aria-label": "Progress" });
  const line = h("p", { class: "line" });
  const stages = h("ol", { class: "stages" });
  const trouble = h("p", { class: "trouble", role: "alert", hidden: true });
  const cancel = h("button", { type: "button" }, "Cancel");
  cancel.addEventListener("click", async () => {
    cancel.disabled = true;
    await ask(job.links.self, { method: "DELETE" }).catch(error => { trouble.hidden = false; trouble.textContent = error.message; });
  });
  view.main.replaceChildren(h("h1", {}, `Localizing ${job.photo.name || "a photo"}`), trouble,
    h("div", { class: "progress" }, preview(job), h("div", {}, bar, line, stages,
      h("p", { class: "buttons" }, h("a", { class: "button primary", href: job.links.viewer }, "Watch it in the viewer"), cancel))));

  const state = { latest: null, usual: null, from: job.started ? Date.parse(job.started) : null };
  usualTime(job).then(usual => { state.usual = usual; });
  const draw = () => {
    const elapsed = (performance.now() - began) / 1000;
    line.textContent = described(state, elapsed);
    if (state.usual && state.latest) bar.value = Math.min(0.97, elapsed / state.usual);
  };
  const timer = setInterval(draw, 100);
  const stop = follow(job, {
    onRecord: record => {
      if (record.stage !== state.latest?.stage) stages.append(h("li", {}, words(record.stage)));
      state.latest = record;
      draw();
    },
    onRestart: () => {
      stages.replaceChildren();
      state.latest = null;
      draw();
    },
    onEnd: ended => { clearInterval(timer); finish(view, ended); },
    onTrouble: gone => {
      trouble.hidden = false;
      trouble.textContent = gone ? "The connection to the job was refused." : "The connection is lost; trying again…";
    },
  });
  view.onLeave(() => { clearInterval(timer); stop(); });
  draw();
}

function described(state, elapsed) {
  const { latest, usual } = state;
  const left = usual && latest ? usual - elapsed : null;
  const eta = left === null ? "" : left > 0 ? `, about ${seconds(left)} left` : ", longer than usual";
  return latest
    ? `${words(latest.stage)}, step ${latest.index + 1}, ${seconds(elapsed)}${eta}`
    : `waiting for its turn, ${seconds(elapsed)}`;
}

/** The median time of the last jobs of this kind, in seconds; null if there are none. */
async function usualTime(job) {
  const { jobs } = await ask(`jobs?scene=${encodeURIComponent(job.scene)}&state=succeeded&limit=50`).catch(() => ({ jobs: [] }));
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
