// A scene's place in the world: the registration in force, and a new one by anchors: their coordinates, lengths between
// them, and those on a level floor.

import { facts, h, say, words } from "./dom.js";
import { service } from "./service.js";

const FRAMES = {
  xyz: ["x, y, z in metres", ["x", "y", "z"]],
  earth: ["latitude, longitude, height", ["latitude", "longitude", "height"]],
};

/** `element` stays the same, so that what is typed outlives a redrawing of what is around it. */
export class RegistrationPart {
  constructor(id) {
    this.path = `scenes/${encodeURIComponent(id)}/registration`;
    this.current = h("div");
    this.fields = h("div");
    const form = h("form", { class: "options" }, this.fields, h("p", { class: "buttons" }, h("button", { class: "primary" }, "Register")));
    form.addEventListener("submit", event => {
      event.preventDefault();
      this.#change(() => this.#register());
    });
    this.trouble = h("p", { class: "trouble", role: "alert", hidden: true });
    this.element = h("section", {}, h("h2", {}, "Registration"), this.current, this.trouble,
      h("details", { "data-needs": "admin" }, h("summary", {}, "Register by anchors"), form));
    this.setAnchors([]);
    this.#change(() => service.ask(this.path).catch(error => { if (error.code !== "registration_not_found") throw error; return null; }));
  }

  setAnchors(anchors) {
    if (JSON.stringify(anchors) === JSON.stringify(this.anchors)) return;
    this.anchors = anchors;
    this.frame = select("Coordinates", Object.entries(FRAMES).map(([value, [text]]) => [value, text]));
    this.rows = anchors.map(anchor => ({
      anchor,
      floor: h("input", { type: "checkbox", "aria-label": `${anchor.name} is on the floor` }),
      place: h("input", { autocomplete: "off", placeholder: "unknown", "aria-label": `Coordinates of ${anchor.name}` }),
    }));
    this.lengths = [];
    const lengths = h("div");
    const another = h("button", { type: "button" }, "Add a length");
    another.addEventListener("click", () => lengths.append(this.#length()));
    this.fields.replaceChildren(...(anchors.length < 2
      ? [h("p", { class: "quiet" }, "Name two points of the scene or more: their distance in metres, their coordinates, or three that lie on a level floor.")]
      : [h("table", {}, h("thead", {}, h("tr", {}, ["Anchor", "On the floor", "Coordinates"].map(name => h("th", { scope: "col" }, name)))),
          h("tbody", {}, this.rows.map(({ anchor, floor, place }) => h("tr", {}, h("th", { scope: "row" }, anchor.name), h("td", {}, floor), h("td", {}, place))))),
        h("label", { class: "field" }, h("span", {}, "Coordinates are"), this.frame), lengths, h("p", { class: "buttons" }, another)]));
  }

  #length() {
    const names = this.anchors.map(({ name }) => [name, name]);
    const [from, to] = [select("From", names), select("To", names)];
    to.selectedIndex = 1;
    const metres = h("input", { type: "number", min: 0, step: "any", "aria-label": "Length in metres", class: "short" });
    this.lengths.push({ from, to, metres });
    return h("p", { class: "joined" }, "From", from, "to", to, "it is", metres, "metres");
  }

  #register() {
    const position = name => this.anchors.find(anchor => anchor.name === name).position;
    const names = FRAMES[this.frame.value][1];
    const points = this.rows.filter(({ place }) => place.value.trim()).map(({ anchor, place }) => {
      const values = place.value.split(/[\s,;]+/).filter(Boolean).map(Number);
      if (values.length !== 3 || !values.every(Number.isFinite)) throw new Error(`The coordinates of ${anchor.name} must be three numbers: ${FRAMES[this.frame.value][0]}.`);
      return { in_world: anchor.position, ...Object.fromEntries(names.map((name, i) => [name, values[i]])) };
    });
    const lengths = this.lengths.filter(({ metres }) => metres.value).map(({ from, to, metres }) => (
      { from_in_world: position(from.value), to_in_world: position(to.value), metres: Number(metres.value) }));
    const floor = this.rows.filter(row => row.floor.checked).map(({ anchor }) => anchor.position);
    return service.ask(this.path, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ points, lengths, floor }) });
  }

  /** Do what returns the registration in force, and show it. */
  async #change(act) {
    this.trouble.hidden = true;
    try {
      this.#show(await act());
    } catch (error) {
      this.trouble.hidden = false;
      this.trouble.textContent = error.message;
      say(error.message);
    }
  }

  #show(found) {
    if (!found) {
      this.current.replaceChildren(h("p", { class: "quiet" }, "Not registered: the scene's place in a local frame, or on Earth, is unknown."));
      return;
    }
    const undo = h("button", { type: "button", "data-needs": "admin" }, "Undo registration");
    undo.addEventListener("click", () => this.#change(async () => {
      const answer = await service.send(this.path, { method: "DELETE" });
      return answer.json().catch(() => null);
    }));
    const { metres_per_unit: scale, metres_per_unit_sigma: sigma, origin, residuals, warnings } = found;
    const used = residuals.filter(residual => residual.used && residual.metres !== null);
    this.current.replaceChildren(facts([
      ["Determined", found.determined.map(words).join(", ")],
      ["Metres per unit", scale && `${Number(scale.toPrecision(4))} ± ${Number((sigma ?? 0).toPrecision(2))}`],
      ["Origin", origin && `${origin.latitude.toFixed(6)}°, ${origin.longitude.toFixed(6)}°, ${origin.height.toFixed(1)} m`],
      ["Largest residual", used.length ? `${Math.max(...used.map(({ metres }) => metres)).toFixed(3)} m` : null],
      ["Outliers", residuals.filter(residual => !residual.used).map(({ name }) => name).join(", ") || null],
    ]), ...[...new Set([found.reason, ...warnings, found.applies ? "" : "The scene has changed since: register again."])].filter(Boolean)
      .map(text => h("p", { class: "quiet" }, text)), h("p", { class: "buttons" }, undo));
    say("The registration is shown");
  }
}

function select(label, pairs) {
  return h("select", { "aria-label": label }, pairs.map(([value, text]) => h("option", { value }, text)));
}
