// Elements, numbers in words, and the clipboard: what every view needs. No innerHTML anywhere.

import { LABELS } from "./labels.js";

/** Make an element. Properties are set as such, `class` and names with a dash as attributes; null is left out. */
export function h(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (value === null || value === undefined || value === false) continue;
    if (name === "class" || name === "role" || name === "for" || name === "capture" || name.includes("-")) element.setAttribute(name, value);
    else element[name] = value;
  }
  element.append(...children.flat().filter(child => child !== null && child !== undefined && child !== ""));
  return element;
}

/** Tell a screen reader. */
export function say(text) {
  document.querySelector("#said").textContent = text;
}

export function words(name) {
  return (name ?? "").replaceAll("_", " ");
}

/** The words for a name of the API; of an unknown one, as of a plug-in, its own. `kind`: stage, estimator, reason, source. */
export function label(kind, name) {
  return LABELS[kind][name] ?? words(name);
}

/** The words for a name, with the name as their tooltip. */
export function labelled(kind, name) {
  return h("span", { title: name }, label(kind, name));
}

/** The words of a name, as a sentence begins. */
export function sentence(name) {
  return words(name).replace(/^./, letter => letter.toUpperCase());
}

export function count(number) {
  return number === null || number === undefined ? "–" : number.toLocaleString("en");
}

export function bytes(number) {
  if (number === null || number === undefined) return "–";
  const units = ["B", "kB", "MB", "GB"];
  let power = 0;
  while (number >= 1000 && power < units.length - 1) [number, power] = [number / 1000, power + 1];
  return `${number < 10 && power ? number.toFixed(1) : Math.round(number)}\u00a0${units[power]}`;
}

export function seconds(value) {
  if (value === null || value === undefined || Number.isNaN(value)) return "–";
  if (value < 1) return `${Math.round(1000 * value)} ms`;
  return value < 60 ? `${value.toFixed(1)} s` : `${Math.floor(value / 60)} min ${Math.round(value % 60)} s`;
}

export function degrees(value) {
  return value === null || value === undefined ? "–" : `${Number(value.toPrecision(3))}°`;
}

/** A length of the scene, in metres where the scene has a scale. */
export function length(value, metresPerUnit) {
  if (value === null || value === undefined) return "–";
  const shown = Number((value * (metresPerUnit ?? 1)).toPrecision(3));
  return `${shown} ${metresPerUnit ? "m" : shown === 1 ? "unit" : "units"}`;
}

export function when(iso) {
  const date = new Date(iso);
  const today = date.toDateString() === new Date().toDateString();
  return today ? date.toLocaleTimeString() : date.toLocaleString();
}

/** A button that copies what `text` returns at that time. */
export function copyButton(text, label) {
  const button = h("button", { type: "button", class: "copy", "aria-label": `Copy ${label}` }, "Copy");
  button.addEventListener("click", async () => {
    const done = await copied(text());
    button.textContent = done ? "Copied" : "Select and copy by hand";
    say(done ? `${label} copied` : "Copying was refused by the browser");
    setTimeout(() => { button.textContent = "Copy"; }, 1500);
  });
  return button;
}

async function copied(text) {
  if (navigator.clipboard) return navigator.clipboard.writeText(text).then(() => true, () => false);
  // A plain-http page that isn't on this machine has no clipboard object.
  const area = h("textarea", { value: text, class: "sr", "aria-hidden": "true" });
  document.body.append(area);
  area.select();
  const done = document.execCommand("copy");
  area.remove();
  return done;
}

/** Name and value pairs as a definition list. */
export function facts(pairs) {
  return h("dl", { class: "facts" },
    pairs.filter(([, value]) => value !== null && value !== undefined)
      .map(([name, value]) => h("div", {}, h("dt", {}, name), h("dd", {}, value))));
}

export function badge(word) {
  return h("span", { class: `badge ${word}` }, words(word));
}
