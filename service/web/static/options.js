// What may be sent beside the photo: intrinsics, prior, estimator and its options from the service's own schema.
// Only what differs from the default is sent, so that the request stays as short as it can be.

import { h, label, words } from "./dom.js";

const NUMBERS = ["width", "height", "fx", "fy", "cx", "cy"];

export class OptionsForm {
  constructor(capabilities) {
    this.estimators = capabilities.estimators.filter(estimator => estimator.available);
    this.estimator = select(this.estimators.map(e => [e.name, label("estimator", e.name) + (e.default ? " (default)" : e.needs_prior ? " (needs a prior pose)" : "")]),
      this.estimators.find(e => e.default)?.name);
    this.estimator.addEventListener("change", () => this.#listOptions());
    this.seed = input({ type: "number", min: 0, step: 1, placeholder: "0" });
    this.budget = input({ type: "number", min: 0, step: "any", placeholder: "none" });
    this.keep = h("input", { type: "checkbox" });
    this.numbers = Object.fromEntries(NUMBERS.map(name => [name, input({ type: "number", step: "any" })]));
    this.camera = input({ placeholder: "none" });
    this.approximate = h("input", { type: "checkbox" });
    this.model = input({ placeholder: "PINHOLE" });
    this.distortion = input({ placeholder: "k1, k2, …" });
    this.poses = { prior: new PoseField(), truth: new PoseField() };
    this.options = h("div", { class: "grid" });
    this.#listOptions();
    this.element = h("div", { class: "options" },
      group("Estimator", h("div", { class: "grid" }, field("Estimator", this.estimator), field("Seed", this.seed),
        field("Time budget, seconds", this.budget),
        field("Keep the photo", this.keep, "Keep it as long as the job; by default it is deleted shortly after it.")), this.options),
      group("Intrinsics of the upright photo, in pixels",
        h("div", { class: "grid narrow" }, NUMBERS.map(name => field(name, this.numbers[name]))),
        h("div", { class: "grid" }, field("Camera model, by COLMAP's name", this.model), field("Distortion", this.distortion),
          field("Approximate", this.approximate, "The focal length is only a starting value."),
          field("Camera name", this.camera, "Without intrinsics: uses those of the camera's earlier photos.")),
        h("p", { class: "quiet" }, "Left empty: taken from the photo's EXIF data or guessed, then estimated with the pose.")),
      group("Prior: approximate pose to start from", this.poses.prior.element),
      group("True pose, to measure errors; not used by the search", this.poses.truth.element));
  }

  used() {
    return Object.keys(this.fields()).length > 0;
  }

  /** Return the form's fields as text, by name; what was left alone is left out. */
  fields() {
    const fields = {};
    const chosen = this.estimators.find(e => e.name === this.estimator.value);
    if (chosen && !chosen.default) fields.estimator = chosen.name;
    const options = Object.fromEntries(this.readers.map(read => read()).filter(Boolean));
    if (Object.keys(options).length) fields.options = JSON.stringify(options);
    if (this.camera.value.trim()) fields.camera_id = this.camera.value.trim();
    if (this.seed.value) fields.seed = this.seed.value;
    if (this.budget.value) fields.budget_s = this.budget.value;
    if (this.keep.checked) fields.keep_photo = "true";
    const intrinsics = Object.fromEntries(
      NUMBERS.filter(name => this.numbers[name].value).map(name => [name, Number(this.numbers[name].value)]));
    if (this.model.value.trim()) intrinsics.model = this.model.value.trim();
    if (this.approximate.checked) intrinsics.trust = "approximate";
    if (this.distortion.value.trim()) intrinsics.distortion = numbersIn(this.distortion.value);
    if (Object.keys(intrinsics).length) fields.intrinsics = JSON.stringify(intrinsics);
    for (const [name, pose] of Object.entries(this.poses)) {
      if (pose.matrix.value.trim()) fields[name] = JSON.stringify(pose.value());
    }
    return fields;
  }

  #listOptions() {
    const schema = this.estimators.find(e => e.name === this.estimator.value)?.options_schema;
    this.readers = [];
    this.options.replaceChildren(...Object.entries(schema?.properties ?? {}).map(([name, property]) => {
      const [element, read] = control(property);
      this.readers.push(() => {
        const value = read();
        return value === undefined || value === property.default ? null : [name, value];
      });
      return field(words(name), element, property.description);
    }));
  }
}

class PoseField {
  constructor() {
    this.matrix = h("textarea", { rows: 4, spellcheck: false, placeholder: "16 numbers of a 4x4 matrix, row by row" });
    this.kind = select([
      ["world_from_camera opencv", "world from camera, OpenCV axes"],
      ["world_from_camera opengl", "world from camera, OpenGL axes (Blender, nerfstudio)"],
      ["camera_from_world opencv", "camera from world, OpenCV axes (COLMAP)"],
    ]);
    this.element = h("div", {}, field("Given as", this.kind), field("Matrix", this.matrix));
  }

  value() {
    const [name, convention] = this.kind.value.split(" ");
    const numbers = numbersIn(this.matrix.value);
    const rows = [];
    while (numbers.length) rows.push(numbers.splice(0, 4));
    return { [name]: rows, ...(convention === "opengl" ? { convention } : {}) };
  }
}

function control(property) {
  if (property.enum) {
    const element = select(property.enum.map(value => [value, words(value)]), property.default);
    return [element, () => element.value];
  }
  if (property.type === "boolean") {
    const element = h("input", { type: "checkbox", checked: property.default });
    return [element, () => element.checked];
  }
  if (["integer", "number"].includes(property.type)) {
    const element = input({ type: "number", step: property.type === "integer" ? 1 : "any", value: property.default ?? "" });
    return [element, () => (element.value === "" ? undefined : Number(element.value))];
  }
  const element = input({ value: property.type === "string" ? property.default ?? "" : JSON.stringify(property.default) });
  return [element, () => (property.type === "string" ? element.value : parsed(element.value))];
}

function parsed(text) {
  try {
    return JSON.parse(text);
  } catch {
    return text;  // the service tells what is wrong with it
  }
}

function numbersIn(text) {
  return (text.match(/[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?/gi) ?? []).map(Number);
}

function input(properties) {
  return h("input", { autocomplete: "off", ...properties });
}

function select(pairs, value) {
  const element = h("select", {}, pairs.map(([value, label]) => h("option", { value }, label)));
  if (value !== undefined && value !== null) element.value = value;
  return element;
}

function field(label, element, description) {
  return h("label", { class: "field" }, h("span", {}, label), element,
    description ? h("span", { class: "quiet" }, description) : null);
}

function group(legend, ...children) {
  return h("fieldset", {}, h("legend", {}, legend), ...children);
}
