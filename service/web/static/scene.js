// One scene in plan: where photos are found, its training cameras, the poses of all jobs, anchors, and its registration.

import { service } from "./service.js";
import { degrees, facts, h, length, say, words } from "./dom.js";
import { drawnPoses, drawPlan, level, LEVELS, planAxes } from "./plan.js";
import { PlanGround } from "./plan_ground.js";
import { RegistrationPart } from "./registration.js";

const POLL_MS = 1000;
const LASTS = "about a minute on two cores, longer while photos are localized";
const JOBS = 100;

export function show(main, id, query) {
  const plan = h("div", { class: "planbox" });
  const aside = h("div");
  const state = {
    id: decodeURIComponent(id), plan, aside, jobs: [], anchors: [], coverage: null, ground: null, point: pointOf(query), stopped: false, timer: 0,
    // Parts that are drawn by themselves: a button that was replaced between press and release would not be clicked.
    parts: { anchors: h("div"), coverage: h("div"), legend: h("div") }, drawn: {},
  };
  document.title = "scene – splatfix";
  const title = h("h1", {}, state.id);
  main.append(title, h("div", { class: "columns" }, plan, aside));
  begin(state, title).catch(error => plan.replaceChildren(trouble(error)));
  return () => {
    state.stopped = true;
    clearTimeout(state.timer);
  };
}

async function begin(state, title) {
  const scene = await service.scene(state.id);
  title.textContent = scene.name;
  if (scene.gaussians === null) {
    const where = `The scene is ${scene.state}. Load it on the start page.`;
    state.plan.replaceChildren(h("p", { class: "note" }, where));
    return;
  }
  state.scene = scene;
  state.registration = new RegistrationPart(state.id);
  state.button = h("button", { type: "button", "data-needs": "admin" });
  state.button.addEventListener("click", () => (state.coverage.state === "running" ? cancel : measure)(state));
  state.trouble = h("div");
  const { anchors, coverage, legend } = state.parts;
  state.aside.replaceChildren(anchors, coverage, h("p", { class: "buttons" }, state.button), state.trouble, legend, state.registration.element);
  await refresh(state);
  [state.jobs, state.anchors] = await Promise.all([jobsOf(state.id), service.anchors(state.id)]);
  draw(state);
}

/** The plan's axes: the map's own, where there is one: without cameras the scene's may be turned against it. */
function axesOf({ scene, coverage }) {
  return (coverage?.map ?? coverage?.tried)?.plan_from_world ?? planAxes(scene);
}

/** The photos that a measurement has tried so far, as `drawPlan` takes poses. */
function triedPoses({ tried }) {
  return (tried?.trials ?? []).map(({ position, heading_deg: heading, found, photo }) => {
    const angle = heading * Math.PI / 180, [first, second] = tried.plan_from_world;
    const look = [0, 1, 2].map(i => Math.cos(angle) * first[i] + Math.sin(angle) * second[i]);
    return {
      matrix: position.map((value, i) => [0, 0, look[i], value]), status: found ? "found" : "missed",
      title: `${photo ?? "test render"}: ${found ? "found" : "not found"}`,
    };
  });
}

/** Draw the Gaussians beneath the plan, again when the axes are others. */
async function showGround(state) {
  const axes = axesOf(state), key = String(axes);
  if (state.groundKey === key) return;
  [state.groundKey, state.ground] = [key, null];
  state.ground = await PlanGround.of(service, state.id, axes);
  if (!state.stopped) draw(state);
}

/** The point of `?point=x,y,z`, as the viewer's link has it; null: none. */
function pointOf(query) {
  const point = (new URLSearchParams(query).get("point") ?? "").split(",").map(Number);
  return point.length === 3 && point.every(Number.isFinite) ? point : null;
}

/** The anchors with a button to delete each, and a form for the point that was picked in the viewer. */
function anchorParts(state) {
  const change = async (name, act, done) => {
    try {
      await act();
      state.anchors = await service.anchors(state.id);
      say(`${name}: ${done}`);
      draw(state);
    } catch (error) {
      state.aside.prepend(trouble(error));
    }
  };
  const rows = state.anchors.map(({ name, position }) => {
    const remove = h("button", { type: "button", class: "plain", "data-needs": "admin", "aria-label": `Delete ${name}` }, "Delete");
    remove.addEventListener("click", () => change(name, () => service.deleteAnchor(state.id, name), "deleted"));
    return h("li", {}, h("span", {}, h("strong", {}, name), " ", h("span", { class: "quiet" }, position.map(x => Number(x.toPrecision(4))).join(", "))), remove);
  });
  const parts = [h("h2", {}, "Anchors"), rows.length
    ? h("ul", { class: "anchors" }, rows)
    : h("p", { class: "quiet" }, "Named points of the scene; each result has their positions as seen from its camera. Tick “name a point” in the viewer and click one.")];
  return state.point ? [...parts, namingForm(state, change)] : parts;
}

function namingForm(state, change) {
  const name = h("input", { id: "anchorname", required: true, maxLength: 64, pattern: "[^/\\\\]+", autocomplete: "off" });
  const form = h("form", { class: "joined", "data-needs": "admin" }, h("label", { for: "anchorname" }, "Name of the picked point"), name, h("button", { class: "primary" }, "Save"));
  form.addEventListener("submit", event => {
    event.preventDefault();
    const { point } = state;
    state.point = null;
    name.blur();
    const named = name.value.trim();
    change(named, () => service.putAnchor(state.id, named, point), "saved");
  });
  return form;
}

/** Ask for the coverage map, again and again while it is measured. */
async function refresh(state) {
  const before = state.coverage?.state;
  state.coverage = await service.coverage(state.id);
  if (state.stopped) return;
  if (before === "running" && state.coverage.state === "ready") say("The coverage map is ready");
  showGround(state).catch(() => {});  // the plan can be read without it
  draw(state);
  clearTimeout(state.timer);  // one poll at a time, whoever asked for this
  if (state.coverage.state !== "running") return;
  state.timer = setTimeout(() => refresh(state).catch(error => state.trouble.replaceChildren(trouble(error))), POLL_MS);
}

/** The newest jobs of a scene whose photos were localized, or uncertain, with their poses. */
async function jobsOf(id) {
  const { jobs } = await service.jobs({ scene: id, limit: JOBS });
  const ended = jobs.filter(job => ["localized", "uncertain"].includes(job.status));
  const whole = await Promise.all(ended.map(job => service.job(job.id).catch(() => null)));
  return whole.filter(Boolean).flatMap(drawnPoses);
}

function draw(state) {
  const { scene, coverage, jobs, ground } = state;
  const map = coverage?.map ?? null;
  const cameras = scene.training_cameras.map(camera => camera.world_from_camera);
  const picture = drawPlan({
    axes: axesOf(state), map, jobs, ground, cameras, tried: triedPoses(coverage ?? {}),
    anchors: state.point ? [...state.anchors, { name: "the picked point", position: state.point }] : state.anchors,
    metresPerUnit: scene.metres_per_unit,
  });
  state.plan.replaceChildren(picture ?? h("p", { class: "note" }, "No cameras, no jobs and no coverage map yet: there is nothing to draw."));
  state.registration.setAnchors(state.anchors);
  redraw(state, "anchors", [state.anchors, state.point], () => anchorParts(state));
  redraw(state, "coverage", coverage, () => coverageParts(state, map));
  redraw(state, "legend", [coverage, jobs.length, state.anchors.length], () => [legend(map, cameras, jobs, state.anchors, coverage)]);
  const running = coverage?.state === "running";
  state.button.textContent = running ? "Cancel" : map ? "Measure again" : "Measure coverage";
}

/** Draw a part anew if what it shows has changed. */
function redraw({ parts, drawn }, name, shown, elements) {
  const key = JSON.stringify(shown);
  if (drawn[name] === key) return;
  drawn[name] = key;
  parts[name].replaceChildren(...elements());
}

function coverageParts(state, map) {
  const { coverage, scene } = state;
  const running = coverage.state === "running";
  const parts = [h("h2", {}, "Where photos are found")];
  if (map) {
    parts.push(h("p", {}, h("strong", {}, map.title)), facts([
      ["found on average", percent(map.found)],
      ["places found with 90 % or more", percent(map.sure_share)],
      ["median rotation error", degrees(map.median_rotation_deg)],
      ["median position error", length(map.median_position_units, scene.metres_per_unit)],
      ["Brier score", map.brier === null ? null : map.brier.toFixed(3)],
    ]), ...reading(map));
  } else if (!running) {
    parts.push(h("p", {}, `Not measured yet. The service tries test renders, degraded as photos are, all over the scene: ${LASTS}.`));
  }
  if (running) {
    const total = coverage.total || null;
    if (total) parts.push(h("p", { class: "quiet" }, "The plan shows what was tried so far; the map of the whole scene is drawn when all is done."));
    parts.push(h("p", { role: "status" }, total ? `${coverage.done} of ${total} test renders and held-out photos tried${left(coverage.remaining_s)}` : `Preparing; then ${LASTS}`),
      h("progress", { "aria-label": "Measuring coverage", max: total ?? 1, ...(total ? { value: coverage.done } : {}) }));
  }
  if (coverage.error) parts.push(trouble({ message: `${coverage.error.detail} ${coverage.error.hint}` }));
  return parts;
}

/** How a map is read. */
function reading(map) {
  const evenly = "The average counts places and headings that are spread evenly through the scene, also those where nobody takes photos.";
  if (map.calibration_photos) return [h("p", { class: "quiet" }, evenly)];
  const how = [
    "Upper bound: test renders show the scene exactly as it is stored, so fewer real photos are found. To calibrate it, put at least four photos that the scene was not trained on into its folder, with their cameras: listed in ",
    h("code", {}, "test_filenames"), " of transforms.json, or in ", h("code", {}, "truth.json"), ". Then measure again.",
  ];
  return [h("p", { class: "quiet" }, evenly), h("p", { class: "quiet" }, how)];
}

function left(seconds) {
  return seconds === null ? "" : `; about ${Math.max(1, Math.round(seconds))} s left`;
}

async function cancel(state) {
  await pressed(state, async () => {
    await service.cancelCoverage(state.id);
    say("The measurement is cancelled");
  });
}

async function measure(state) {
  await pressed(state, () => service.coverage(state.id, { measure: true }));
}

/** Do what the button is for, and show what came of it. */
async function pressed(state, act) {
  state.button.disabled = true;
  state.trouble.replaceChildren();
  try {
    await act();
    await refresh(state);
  } catch (error) {
    state.trouble.replaceChildren(trouble(error));
  }
  state.button.disabled = false;
}

/** What the plan draws, and nothing else. */
function legend(map, cameras, jobs, anchors, coverage) {
  const drawn = new Set(map?.cells.flatMap(cell => cell.probabilities.map(level)));
  const row = (kind, text) => h("li", {}, h("span", { class: `swatch ${kind}`, "aria-hidden": "true" }), text);
  const statuses = ["localized", "uncertain"].filter(status => jobs.some(job => job.status === status));
  return h("ul", { class: "legend", "aria-label": "Legend" },
    LEVELS.filter(([, kind]) => drawn.has(kind)).map(([, kind, text]) => row(kind, text)),
    drawn.has("blind") ? row("blind", "nothing of the scene in view") : [],
    coverage?.tried ? [row("tried found", "tried: found"), row("tried missed", "tried: not found")] : [],
    cameras.length ? row("camera", "training camera") : [], anchors.length ? row("anchor", "anchor") : [], statuses.map(status => row(`job ${status}`, `job, ${words(status)}`)),
    h("li", { class: "quiet" }, `Seen from above; each ${map ? "wedge and line" : "line"} points where its camera looks.`));
}

function percent(share) {
  return `${Math.round(100 * share)} %`;
}

function trouble(error) {
  return h("p", { class: "trouble", role: "alert" }, error.message);
}
