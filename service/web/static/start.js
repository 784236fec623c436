// The first view: scenes, the photo, and what may be sent beside it.

import { service } from "./service.js";
import * as batch from "./batch.js";
import { batchList } from "./batches.js";
import { h, say } from "./dom.js";
import { viewOf } from "./example.js";
import { OptionsForm } from "./options.js";
import { isScene, SceneList } from "./scenes.js";
import { sendingBox, sendPhoto } from "./sending.js";

const SCENE_KEY = "splatfix-scene";
// Kept while other views are shown, so that the next photo goes the same way; the scene also over a reload.
const chosen = { scene: stored(), form: null, prior: null };
let alertLine = null, list = null;

/** `query` may have a `prior` in JSON for the next photo, its `scene`, and `of`, what it is the pose of. */
export function show(main, query) {
  document.title = "splatfix";
  takePrior(new URLSearchParams(query));
  alertLine = h("p", { class: "trouble", role: "alert", hidden: true });
  const example = exampleButton();
  const choose = (id, scenes, byUser) => {
    byUser ? remember(id) : chosen.scene = id;
    example.hidden = !scenes.some(scene => scene.id === id && scene.state === "ready" && scene.cameras);
  };
  list = new SceneList({ chosen: () => chosen.scene, onChoose: choose, onError: told });
  main.append(
    h("h1", {}, "Where was this photo taken?"),
    h("p", { class: "lead" }, "splatfix finds the camera's pose of a photo inside a 3D Gaussian Splatting scene."),
    alertLine, priorLine(), picker(example), batchList(1) ?? "",
    h("p", { class: "note readers" }, "Your key shows results. To localize photos, sign in with a key of the role “localize”."),
    list.element, more(),
  );
  return () => { list.stop(); list = alertLine = null; };
}

function takePrior(query) {
  if (!query.has("prior")) return;
  chosen.prior = { value: query.get("prior"), of: query.get("of") ?? "a view" };
  if (query.get("scene")) remember(query.get("scene"));
  history.replaceState(null, "", "#/");  // taken once: a reload begins without it
}

function priorLine() {
  const line = h("p", { class: "note", hidden: !chosen.prior });
  const remove = h("button", { type: "button" }, "Remove");
  remove.addEventListener("click", () => { chosen.prior = null; line.hidden = true; });
  line.append(h("span", {}, `Photos are sent with a prior: the pose of ${chosen.prior?.of}.`), " ", remove);
  return line;
}

/** Send photos with what is chosen, and show their job or table; `known` are fields that go before those. */
export async function submit(files, known = {}) {
  if (!files.length) return;
  if (alertLine) alertLine.hidden = true;
  const scenes = files.filter(isScene);
  if (scenes.length) {
    files = files.filter(file => !isScene(file));
    if (!await addScenes(scenes, files) || !files.length) return;  // photos go to the scene that came with them, or nowhere
  }
  const fields = { ...(chosen.prior && { prior: chosen.prior.value }), ...(chosen.form ? chosen.form.fields() : {}), ...known };
  const scene = chosen.scene ?? await onlyScene();
  if (scene) fields.scene = scene;
  if (files.length > 1) return batch.start([...files], fields);
  const box = sendingBox(files[0].name || "photo");
  const main = document.querySelector("#main");
  main.querySelector(".sendbox")?.remove();
  main.prepend(box.element);
  try {
    const job = await sendPhoto(files[0], fields, box.told, box.signal);
    location.hash = `#/jobs/${job.id}`;
  } catch (error) {
    if (error.name !== "AbortError") told(error);
  } finally {
    box.element.remove();
  }
}

/** Upload scenes one after the other, which the first view shows, and choose the last; tell whether all came. */
async function addScenes(files, waiting) {
  if (!list) {
    location.hash = "#/";
    await new Promise(resolve => addEventListener("hashchange", resolve, { once: true }));  // after which it is shown
  }
  for (const file of files) if (!await list?.upload(file, waiting)) return false;
  return true;
}

/** Show an error: at its place in this view, above any other. */
export function told(error) {
  if (error.status === 401) return;  // a form for the key is shown
  const line = alertLine ?? h("p", { class: "trouble", role: "alert" });
  if (!alertLine) document.querySelector("#main").prepend(line);
  line.textContent = error.message;
  line.hidden = false;
  say(error.message);
}

function stored() {
  try {
    return localStorage.getItem(SCENE_KEY);
  } catch {
    return null;  // storage may be forbidden
  }
}

function remember(id) {
  chosen.scene = id;
  try {
    localStorage.setItem(SCENE_KEY, id);
  } catch { /* forbidden: the choice holds as long as this page */ }
}

async function onlyScene() {
  const scenes = await service.scenes();
  return scenes.find(scene => scene.state === "ready")?.id ?? null;
}

/** For who has no photo of the scene; hidden where the scene has no cameras to look from. */
function exampleButton() {
  const button = h("button", { type: "button", hidden: true }, "Try a view of the scene");
  button.addEventListener("click", async () => {
    button.disabled = true;
    try {
      const { file, fields } = await viewOf(chosen.scene);
      await submit([file], fields);
    } catch (error) {
      told(error);
    }
    button.disabled = false;
  });
  return button;
}

function picker(example) {
  const hasCamera = navigator.maxTouchPoints > 0;  // a phone or tablet
  const pick = h("input", { type: "file", accept: "image/*,video/*,.heic,.heif,.mkv", id: "photo", class: "sr", multiple: true });
  const shoot = h("input", { type: "file", accept: "image/*", id: "shoot", class: "sr", capture: "environment" });
  for (const input of [pick, shoot]) {
    input.addEventListener("change", async () => {
      const files = [...input.files];
      input.value = "";
      await submit(files).catch(told);
    });
  }
  return h("div", { class: "drop", "data-needs": "localize" },
    h("p", {}, h("strong", {}, "Drop photos", h("span", { "data-needs": "admin" }, ", a scene file"), " or a video here"), ", paste, or"),
    h("div", { class: "buttons" },
      pick, h("label", { for: "photo", class: "button primary" }, "Choose photos"),
      ...(hasCamera ? [shoot, h("label", { for: "shoot", class: "button" }, "Take a photo")] : []), example),
    h("p", { class: "quiet formats" }, "Photos: JPEG, PNG, WebP, HEIC. Video: MP4, MOV, WebM, Matroska, AVI.", h("span", { "data-needs": "admin" },
      " Scene: PLY, SPZ, SOG, SPLAT, KSPLAT, GLB, a checkpoint (PT, CKPT), a ZIP of a scene folder; alone, or together with photos of it.")));
}

function more() {
  const details = h("details", { class: "more", "data-needs": "localize" }, h("summary", {}, "Intrinsics, prior, estimator and options"));
  if (chosen.form) {
    details.append(chosen.form.element);
    details.open = chosen.form.used();
  }
  details.addEventListener("toggle", async () => {
    if (!details.open || chosen.form) return;
    try {
      chosen.form = new OptionsForm(await service.ask("capabilities"));
      details.append(chosen.form.element);
    } catch (error) {
      told(error);
    }
  });
  return details;
}
