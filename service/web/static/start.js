// The first view: scenes, the photo, and what may be sent beside it.

import { ask } from "./api.js";
import { bytes, count, h, words } from "./dom.js";
import { viewOf } from "./example.js";
import { OptionsForm } from "./options.js";
import { remember } from "./sent.js";

// Kept while other views are shown, so that the next photo goes the same way.
const chosen = { scene: null, form: null };
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

/** Send a photo with what is chosen, and go to its job; `known` are fields that go before those. Raises Problem. */
export async function submit(file, known = {}) {
  if (!file) return;
  if (alertLine) alertLine.hidden = true;
  const fields = { ...(chosen.form ? chosen.form.fields() : {}), ...known };
  const scene = chosen.scene ?? await onlyScene();
  if (scene) fields.scene = scene;
  const body = new FormData();
  for (const [name, value] of Object.entries(fields)) body.append(name, value);
  body.append("photo", file, file.name || "photo");
  document.body.classList.add("sending");
  try {
    const job = await ask("localize", { method: "POST", body });
    remember(job.id, file, fields);
    location.hash = `#/jobs/${job.id}`;
  } finally {
    document.body.classList.remove("sending");
  }
}

/** Show an error where this view has its place for it; false if another view is shown. */
export function told(error) {
  if (!alertLine) return false;
  alertLine.textContent = error.message;
  alertLine.hidden = false;
  return true;
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
      await submit(file, fields);
    } catch (error) {
      told(error);
    }
    button.disabled = false;
  });
  return button;
}

function picker(example) {
  const hasCamera = navigator.maxTouchPoints > 0;  // a phone or tablet
  const pick = h("input", { type: "file", accept: "image/*,.heic,.heif", id: "photo", class: "sr" });
  const shoot = h("input", { type: "file", accept: "image/*", id: "shoot", class: "sr", capture: "environment" });
  for (const input of [pick, shoot]) {
    input.addEventListener("change", async () => {
      const file = input.files[0];
      input.value = "";
      await submit(file).catch(told);
    });
  }
  return h("div", { class: "drop" },
    h("p", {}, h("strong", {}, "Drop a photo here"), ", paste it, or"),
    h("div", { class: "buttons" },
      pick, h("label", { for: "photo", class: "button primary" }, "Choose a photo"),
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
    if (error.status === 401) place.replaceChildren(h("legend", {}, "Key"), keyForm());
    else told(error);
    return;
  }
  if (!scenes.some(scene => scene.id === chosen.scene)) chosen.scene = null;
  chosen.scene ??= (scenes.find(scene => scene.state === "ready") ?? scenes[0])?.id ?? null;
  const choose = id => {
    chosen.scene = id;
    example.hidden = !scenes.some(scene => scene.id === id && scene.state === "ready" && scene.cameras);
  };
  choose(chosen.scene);
  place.replaceChildren(h("legend", {}, "Scene"),
    scenes.length ? h("div", { class: "cards" }, scenes.map(scene => card(scene, choose))) : h("p", {}, "No scene is loaded."));
  if (scenes.some(scene => ["loading", "preparing"].includes(scene.state))) {
    timer.id = setTimeout(() => listScenes(place, timer, example), 1000);
  }
}

/** The key goes to the service once, which leaves a cookie for it and takes it out of the address. */
function keyForm() {
  return h("form", { action: "./", method: "get" },
    h("p", {}, "This service asks for an API key."),
    h("p", { class: "buttons" },
      h("input", { type: "password", name: "key", required: true, autocomplete: "current-password", "aria-label": "API key" }),
      h("button", {}, "Enter")));
}

function card(scene, choose) {
  const radio = h("input", { type: "radio", name: "scene", value: scene.id, checked: scene.id === chosen.scene });
  radio.addEventListener("change", () => choose(scene.id));
  const ready = scene.gaussians !== null;
  const picture = ready
    ? h("img", { src: scene.links.thumbnail, alt: "", width: 320, height: 240, loading: "lazy" })
    : h("span", { class: "nopicture" });
  const size = ready
    ? `${count(scene.gaussians)} Gaussians · ${count(scene.cameras)}\u00a0cameras · ${bytes(scene.memory_bytes)}`
    : scene.error?.detail ?? "";
  return h("label", { class: "card" }, radio, picture,
    h("span", { class: "name" }, scene.name),
    h("span", { class: "quiet" }, scene.state === "ready" ? size : `${words(scene.state)} ${size}`));
}
