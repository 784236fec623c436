// The first view: scenes, the photo, and what may be sent beside it.

import { ask } from "./api.js";
import * as batch from "./batch.js";
import { bytes, count, h, say, sentence } from "./dom.js";
import { viewOf } from "./example.js";
import { OptionsForm } from "./options.js";
import { sendingBox, sendPhoto } from "./sending.js";

const ANY = "auto";
const SCENE_KEY = "splatfix-scene";
// Kept while other views are shown, so that the next photo goes the same way; the scene also over a reload.
const chosen = { scene: stored(), form: null };
let alertLine = null;

export function show(main) {
  document.title = "splatfix";
  alertLine = h("p", { class: "trouble", role: "alert", hidden: true });
  const scenes = h("fieldset", { class: "scenes" }, h("legend", {}, "Scene"), h("p", { class: "quiet" }, "Loading…"));
  const example = exampleButton();
  main.append(
    h("h1", {}, "Where was this photo taken?"),
    h("p", { class: "lead" }, "splatfix finds the camera's pose of a photo inside a 3D Gaussian Splatting scene."),
    alertLine, picker(example), scenes, more(),
  );
  const timer = { id: null };
  listScenes(scenes, timer, example);
  return () => { clearTimeout(timer.id); alertLine = null; };
}

/** Send photos with what is chosen, and show their job or table; `known` are fields that go before those. */
export async function submit(files, known = {}) {
  if (!files.length) return;
  if (alertLine) alertLine.hidden = true;
  const fields = { ...(chosen.form ? chosen.form.fields() : {}), ...known };
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

function choose(id) {
  chosen.scene = id;
  try {
    localStorage.setItem(SCENE_KEY, id);
  } catch { /* forbidden: the choice holds as long as this page */ }
}

async function onlyScene() {
  const { scenes } = await ask("scenes");
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
  return h("div", { class: "drop" },
    h("p", {}, h("strong", {}, "Drop photos or a video here"), ", paste, or"),
    h("div", { class: "buttons" },
      pick, h("label", { for: "photo", class: "button primary" }, "Choose photos"),
      ...(hasCamera ? [shoot, h("label", { for: "shoot", class: "button" }, "Take a photo")] : []), example));
}

function more() {
  const details = h("details", { class: "more" }, h("summary", {}, "Intrinsics, prior, estimator and options"));
  if (chosen.form) {
    details.append(chosen.form.element);
    details.open = chosen.form.used();
  }
  details.addEventListener("toggle", async () => {
    if (!details.open || chosen.form) return;
    try {
      chosen.form = new OptionsForm(await ask("capabilities"));
      details.append(chosen.form.element);
    } catch (error) {
      told(error);
    }
  });
  return details;
}

async function listScenes(place, timer, example) {
  let scenes;
  try {
    ({ scenes } = await ask("scenes"));
  } catch (error) {
    if (error.status === 401) return;
    place.replaceChildren(h("legend", {}, "Scene"), h("p", { class: "trouble", role: "alert" }, `${error.message} Trying again…`));
    timer.id = setTimeout(() => listScenes(place, timer, example), 1000);
    return;
  }
  const several = scenes.length > 1;
  if (!scenes.some(scene => scene.id === chosen.scene) && !(several && chosen.scene === ANY)) chosen.scene = null;
  chosen.scene ??= (scenes.find(scene => scene.state === "ready") ?? scenes[0])?.id ?? null;
  const offer = () => {
    example.hidden = !scenes.some(scene => scene.id === chosen.scene && scene.state === "ready" && scene.cameras);
  };
  const changed = id => { choose(id); offer(); };
  offer();
  const cards = scenes.map(scene => card(scene, changed));
  place.replaceChildren(h("legend", {}, "Scene"),
    scenes.length ? h("div", { class: "cards" }, several ? anyCard(changed) : null, cards) : h("p", {}, "No scenes yet."));
  if (scenes.some(scene => ["loading", "preparing", "unloading"].includes(scene.state))) {
    timer.id = setTimeout(() => listScenes(place, timer, example), 1000);
  }
}

function anyCard(changed) {
  const radio = h("input", { type: "radio", name: "scene", value: ANY, checked: chosen.scene === ANY });
  radio.addEventListener("change", () => changed(ANY));
  return h("label", { class: "card any" }, radio, h("span", { class: "name" }, "Any scene"),
    h("span", { class: "quiet" }, "Search all loaded scenes; single photos only."));
}

function card(scene, changed) {
  const radio = h("input", { type: "radio", name: "scene", value: scene.id, checked: scene.id === chosen.scene });
  radio.addEventListener("change", () => changed(scene.id));
  const ready = scene.gaussians !== null;
  const picture = ready
    ? h("img", { src: scene.links.thumbnail, alt: "", width: 320, height: 240, loading: "lazy" })
    : h("span", { class: "nopicture" });
  const size = ready
    ? `${count(scene.gaussians)} Gaussians · ${count(scene.cameras)}\u00a0cameras · ${bytes(scene.memory_bytes)}`
    : scene.error?.detail ?? "";
  return h("label", { class: "card" }, radio, picture,
    h("span", { class: "name" }, scene.name),
    h("span", { class: "quiet" }, scene.state === "ready" ? size : `${sentence(scene.state)}${size ? `: ${size}` : "…"}`));
}
