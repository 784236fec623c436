// The scenes of the start page: choose one, load, unload and delete them, add one by its file.

import { bytes, count, h, say, seconds, sentence } from "./dom.js";
import { service } from "./service.js";

export const ANY = "auto";
const POLL_MS = 1000;
const NAMED = 5;  // of the photos that wait
const BUSY = ["loading", "preparing", "unloading"];
const SCENE_FILE = /\.(ply|ply\.gz|splat|ksplat|spz|sog|glb|gltf|zip|pt|ckpt)$/i;

/** Tell whether a file that is dropped is a scene, by its name. */
export function isScene(file) {
  return SCENE_FILE.test(file.name ?? "");
}

/** Tell whether a scene's view index is still being built. */
function isGrowing({ index }) {
  return index !== null && index.views < index.planned_views;
}

function indexProgress({ name, index: { views, planned_views: planned } }) {
  return [h("span", { class: "quiet" }, `View index: ${count(views)} of ${count(planned)} views`),
    h("progress", { "aria-label": `View index of ${name}`, value: views, max: planned })];
}

/**
 * The list of scenes. `chosen` returns the id of the chosen scene; `onChoose` gets the id that is chosen now, the scenes,
 * and whether the user chose it; `onError` gets what a button or an upload failed with.
 */
export class SceneList {
  constructor({ chosen, onChoose, onError }) {
    Object.assign(this, { chosen, onChoose, onError });
    this.element = h("fieldset", { class: "scenes" }, h("legend", {}, "Scene"), h("p", { class: "quiet" }, "Loading…"));
    this.since = new Map();  // when a scene began to be loaded, as far as this page has seen it
    this.shown = "";
    this.poll();
  }

  stop() {
    this.stopped = true;
    clearTimeout(this.timer);
  }

  async poll() {
    clearTimeout(this.timer);
    let busy = true;
    try {
      const scenes = await service.scenes();
      if (this.stopped) return;
      busy = scenes.some(scene => BUSY.includes(scene.state) || isGrowing(scene));
      this.#draw(scenes);
    } catch (error) {
      if (this.stopped || error.status === 401) return;
      this.shown = "";
      this.element.replaceChildren(h("legend", {}, "Scene"),
        h("p", { class: "trouble", role: "alert" }, `${error.message} Trying again…`));
    }
    if (busy) this.timer = setTimeout(() => this.poll(), POLL_MS);
  }

  #draw(scenes) {
    for (const { id, state } of scenes) {
      if (!BUSY.includes(state)) this.since.delete(id);
      else if (!this.since.has(id)) this.since.set(id, performance.now());
    }
    const several = scenes.length > 1;
    let id = this.chosen();
    if (!scenes.some(scene => scene.id === id) && !(several && id === ANY)) id = null;
    id ??= (scenes.find(scene => scene.state === "ready") ?? scenes[0])?.id ?? null;
    this.onChoose(id, scenes, false);
    const text = JSON.stringify([scenes, id]);
    if (text === this.shown) {  // a list that is drawn anew would lose the keyboard's place
      for (const line of this.element.querySelectorAll("[data-busy]")) line.textContent = this.#busy(line.dataset.busy, line.dataset.state);
      return;
    }
    this.shown = text;
    const choose = chosen => this.onChoose(chosen, scenes, true);
    this.element.replaceChildren(h("legend", {}, "Scene"), ...(scenes.length ? [] : [h("p", {}, "No scenes yet.")]),
      h("div", { class: "cards" }, several ? anyCard(id, choose) : null,
        scenes.map(scene => this.#card(scene, id, choose)), this.#adding()));
  }

  #card(scene, chosen, choose) {
    const radio = h("input", { type: "radio", name: "scene", value: scene.id, checked: scene.id === chosen });
    radio.addEventListener("change", () => choose(scene.id));
    const loaded = scene.gaussians !== null;
    const picture = loaded
      // Without cameras there is a better picture once the scene is prepared.
      ? h("img", { src: scene.cameras ? scene.links.thumbnail : `${scene.links.thumbnail}?${scene.state}`, alt: "", width: 320, height: 240, loading: "lazy" })
      : h("span", { class: "nopicture" });
    const facts = loaded ? `${count(scene.gaussians)} Gaussians · ${count(scene.cameras)}\u00a0cameras · ${bytes(scene.memory_bytes)} in memory` : "";
    const busy = BUSY.includes(scene.state);
    return h("div", { class: "card" },
      h("label", {}, radio, picture, h("span", { class: "name" }, scene.name),
        scene.state === "ready" ? null : h("span", { "data-busy": busy ? scene.id : null, "data-state": scene.state }, busy ? this.#busy(scene.id, scene.state) : sentence(scene.state)),
        h("span", { class: "quiet" }, scene.error ? `${scene.error.detail} ${scene.error.hint}` : facts)),
      busy ? h("progress", { "aria-label": `${scene.name} is ${scene.state}` }) : null,
      ...(isGrowing(scene) ? indexProgress(scene) : []),
      h("p", { class: "actions" }, this.#actions(scene)));
  }

  #busy(id, state) {
    return `${sentence(state)}, ${seconds(Math.round((performance.now() - (this.since.get(id) ?? performance.now())) / 1000))}`;
  }

  #actions({ id, name, state, uploaded, gaussians }) {
    const loaded = gaussians !== null;
    const button = (label, act, question = "") => {
      const element = h("button", { type: "button", class: "plain", "data-needs": "admin", "aria-label": `${label} ${name}` }, label);
      element.addEventListener("click", async () => {
        if (question && !confirm(question)) return;
        element.disabled = true;
        await act(id).then(() => say(`${label}: ${name}`), this.onError);
        element.disabled = false;
        this.poll();
      });
      return element;
    };
    const plan = h("a", { href: `#/scenes/${encodeURIComponent(id)}`, "aria-label": `Plan and coverage of ${name}` }, "Plan and coverage");
    return [
      loaded ? plan : null,
      ["unloaded", "failed"].includes(state) ? button("Load", id => service.loadScene(id)) : null,
      ["ready", "preparing"].includes(state) ? button("Unload", id => service.unloadScene(id)) : null,
      uploaded ? button("Delete", id => service.deleteScene(id), `Delete the scene ${name} and its files?`) : null,
    ].filter(Boolean);
  }

  #adding() {
    const pick = h("input", { type: "file", id: "scenefile", class: "sr" });
    pick.addEventListener("change", () => {
      const [file] = pick.files;
      pick.value = "";
      if (file) this.upload(file);
    });
    return h("div", { class: "card adding", "data-needs": "admin" }, pick, h("label", { for: "scenefile", class: "button" }, "Add a scene"),
      h("span", { class: "quiet" }, "A scene file, or a ZIP of a scene folder. You can also drop it on this page."));
  }

  /** Upload a scene under its file's name, and choose it; tell whether it came. `waiting`: photos that are sent then. */
  async upload(file, waiting = []) {
    const id = file.name.replace(/(\.compressed)?\.(ply\.gz|[^.]*)$/i, "").replaceAll(/[^\w-]+/g, "_").replace(/^[_-]+/, "").slice(0, 64) || "scene";
    const abort = new AbortController();
    const bar = h("progress", { max: 1, "aria-label": "Upload" });
    const line = h("span", {}, "Uploading…");
    const cancel = h("button", { type: "button" }, "Cancel");
    cancel.addEventListener("click", () => abort.abort());
    const box = h("section", { class: "sendbox", "aria-label": "Upload of a scene" },
      h("p", {}, h("strong", {}, file.name), " ", line), bar, waitingLine(waiting), h("p", { class: "buttons" }, cancel));
    this.element.before(box);
    const onProgress = share => {
      line.textContent = share < 1 ? `Uploading, ${Math.round(100 * share)} % of ${bytes(file.size)}` : "Checking the file…";
      share < 1 ? bar.value = share : bar.removeAttribute("value");
    };
    try {
      const scene = await service.uploadScene(id, file, { onProgress, signal: abort.signal });
      this.onChoose(scene.id, [scene], true);
      say(`${scene.name} was uploaded`);
      return true;
    } catch (error) {
      if (error.name !== "AbortError") this.onError(error);
      return false;
    } finally {
      box.remove();
      this.poll();
    }
  }
}

/** The photos that are sent once their scene is there. */
function waitingLine(photos) {
  if (!photos.length) return null;
  const names = photos.slice(0, NAMED).map(photo => photo.name || "photo").join(", ");
  const more = photos.length > NAMED ? ` and ${photos.length - NAMED} more` : "";
  return h("p", { class: "quiet" }, `${photos.length === 1 ? "A photo waits" : `${photos.length} photos wait`} for this scene: ${names}${more}`);
}

function anyCard(chosen, choose) {
  const radio = h("input", { type: "radio", name: "scene", value: ANY, checked: chosen === ANY });
  radio.addEventListener("change", () => choose(ANY));
  return h("div", { class: "card any" }, h("label", {}, radio, h("span", { class: "name" }, "Any scene"),
    h("span", { class: "quiet" }, "Search all loaded scenes; single photos only.")));
}
