// The live page: the camera's video with the scene's render over it, where the camera is, and how well it is known.

import { Camera } from "./live_camera.js";
import { Plan } from "./live_plan.js";
import { h, length, say } from "./dom.js";
import { hideForbidden, service } from "./service.js";

const AGAIN = [1006, 1012, 4408, 4500, 4503];  // close codes after which connecting again makes sense
const AGAIN_MS = 2000;
const RENDER_PX = 320, RENDER_MS = 250;  // the render takes from the same cores as tracking
const STATES = {
  localized: "Localized", uncertain: "Uncertain", relocalizing: "Searching", lost: "Lost", waiting: "Connecting", off: "Off",
};
const ADVICE = {
  localized: "The rendered scene is aligned with the video.",
  uncertain: "The position may be wrong: the view may be blocked or blurred.",
  relocalizing: "Looking for this view in the whole scene. Hold the camera still for a moment.",
  lost: "This view was not found so far. Point the camera at a part that was captured.",
  waiting: "Connecting to the service.",
  off: "",
};

const state = { session: null, scene: null, wanted: false, rates: [], dropped: 0, used: 0, drawing: false, drawnAt: 0, url: null };
const video = h("video", { muted: true, playsInline: true, autoplay: true, "aria-label": "The camera's video" });
const above = h("img", { class: "above", alt: "The scene as seen from the camera's position", hidden: true });
const stack = h("div", { class: "stack live" }, video, above);
const badge = h("span", { class: "badge" });
const advice = h("p", { class: "quiet", "aria-live": "polite" });
const trouble = h("p", { class: "trouble", role: "alert", hidden: true });
const facts = { rate: h("dd"), delay: h("dd"), left: h("dd"), position: h("dd"), accuracy: h("dd"), lens: h("dd") };
const slider = h("input", { type: "range", min: 0, max: 100, value: 50, "aria-label": "Opacity of the rendered scene" });
const scenes = h("select", { "aria-label": "Scene" });
const button = h("button", { class: "primary", "data-needs": "localize" }, "Start camera");
const canvas = h("canvas", { class: "plan", width: 480, height: 360, role: "img", "aria-label": "Plan of the scene with the camera's path" });
const plan = new Plan(canvas);
const camera = new Camera(video, frame => state.session?.send(frame.jpeg, frame.timeS));
camera.mayTake = () => state.session !== null && state.session.unanswered < 2;

function build() {
  const fact = (name, value) => h("div", {}, h("dt", {}, name), value);
  document.querySelector("#main").append(
    h("h1", {}, "Live"),
    h("p", { class: "lead" }, "Point a camera at the scene: this page shows where it is, as it moves. The video is not stored."),
    trouble,
    h("p", { class: "buttons" }, h("label", { class: "live-scene" }, "Scene", scenes), button),
    h("div", { class: "columns" },
      h("div", {}, stack,
        h("label", { class: "slide" }, "Video", slider, "Scene"),
        h("p", { class: "verdict" }, badge), advice),
      h("div", {}, h("h2", {}, "Seen from above"), canvas,
        h("p", { class: "quiet" }, "Grey: training cameras. Line: the camera's path."),
        h("dl", { class: "facts" }, fact("Poses per second", facts.rate), fact("Latency", facts.delay),
          fact("Frames dropped", facts.left), fact("Position", facts.position), fact("Standard deviation", facts.accuracy),
          fact("Focal length", facts.lens)))));
  slider.addEventListener("input", () => { above.style.opacity = slider.value / 100; });
  above.style.opacity = slider.value / 100;
  button.addEventListener("click", () => (state.wanted ? stop() : start()));
  scenes.addEventListener("change", () => { showScene().catch(told); if (state.wanted) state.session?.close(); });
  show("off");
}

function show(name) {
  if (badge.dataset.state !== name) say(STATES[name]);
  badge.dataset.state = name;
  badge.className = `badge ${{ lost: "not_localized", relocalizing: "uncertain" }[name] ?? name}`;
  badge.textContent = STATES[name];
  advice.textContent = ADVICE[name];
}

function told(error) {
  trouble.hidden = false;
  trouble.textContent = error.message;
}

async function listScenes() {
  const found = (await service.scenes()).filter(scene => scene.state !== "failed");
  if (!found.length) throw new Error("The service has no scene.");
  scenes.replaceChildren(...found.map(scene => h("option", { value: scene.id }, scene.name || scene.id)));
  await showScene();
}

async function showScene() {
  state.scene = await service.scene(scenes.value);
  plan.show(state.scene);
}

async function start() {
  trouble.hidden = true;
  try {
    await camera.start();
  } catch (error) {
    return told(error);
  }
  state.wanted = true;
  button.textContent = "Stop";
  await connect();
}

function stop() {
  state.wanted = false;
  button.textContent = "Start camera";
  camera.stop();
  state.session?.close();
  state.session = null;
  above.hidden = true;
  show("off");
}

async function connect() {
  show("waiting");
  Object.assign(state, { rates: [], dropped: 0, used: 0 });
  try {
    state.session = await service.live(scenes.value, { onAnswer: answered, onHint: hint => camera.advise(hint), onClose: closed });
    trouble.hidden = true;
  } catch (error) {
    if (state.wanted) told(error);
  }
}

function closed(code) {
  state.session = null;
  above.hidden = true;
  if (!state.wanted) return;
  // 1000: another scene was chosen.
  if (code === 1000) return void connect();
  if (!AGAIN.includes(code)) return stop();
  show("waiting");
  setTimeout(() => { if (state.wanted && !state.session) connect(); }, AGAIN_MS);
}

function answered(answer) {
  const now = performance.now() / 1000;
  state.rates.push(now);
  state.rates = state.rates.filter(time => now - time < 2);
  state.used += 1;
  state.dropped += answer.dropped.length;
  show(answer.mode === "tracking" ? answer.status : answer.mode);
  facts.rate.textContent = (state.rates.length / 2).toFixed(0);
  facts.delay.textContent = `${Math.round(1000 * (now - answer.time_s))} ms`;
  facts.left.textContent = `${Math.round(100 * state.dropped / (state.dropped + state.used))} %`;
  if (answer.mode !== "tracking") {
    above.hidden = true;
    return plan.lose();
  }
  const matrix = answer.world_from_camera, position = matrix.slice(0, 3).map(row => row[3]);
  plan.move(matrix, answer.status);
  facts.position.textContent = position.map(value => value.toFixed(2)).join(", ");
  facts.accuracy.textContent = spread(answer.covariance);
  facts.lens.textContent = `${Math.round(answer.intrinsics.fx)} px of ${answer.intrinsics.width}`;
  draw(answer);
}

function spread(covariance) {
  if (!covariance) return "–";
  const sigma = first => Math.sqrt([0, 1, 2].reduce((sum, i) => sum + covariance[first + i][first + i], 0));
  return `${(sigma(0) * 180 / Math.PI).toFixed(2)}°, ${length(sigma(3), state.scene?.metres_per_unit)}`;
}

/** Render the scene at an answer's pose, if the last render is done and some time has passed. */
async function draw(answer) {
  const now = performance.now();
  if (state.drawing || now - state.drawnAt < RENDER_MS || Number(slider.value) === 0) return;
  Object.assign(state, { drawing: true, drawnAt: now });
  const { width, height, fx, fy, cx, cy } = answer.intrinsics, scale = RENDER_PX / Math.max(width, height);
  const size = { width: Math.round(width * scale), height: Math.round(height * scale) };
  const lens = { fx: fx * scale, fy: fy * scale, cx: cx * scale, cy: cy * scale };
  try {
    const picture = await service.render(scenes.value, { world_from_camera: answer.world_from_camera }, { ...size, ...lens });
    const old = state.url;
    state.url = above.src = URL.createObjectURL(picture);
    if (old) URL.revokeObjectURL(old);
    above.hidden = badge.dataset.state !== "localized" && badge.dataset.state !== "uncertain";
  } catch (error) {
    told(error);
  }
  state.drawing = false;
}

// A page that isn't seen sends nothing; the service ends its session after a while.
document.addEventListener("visibilitychange", () => { if (state.wanted) document.hidden ? camera.pause() : camera.resume(); });
addEventListener("pagehide", () => state.session?.close());

build();
hideForbidden();
listScenes().catch(told);
