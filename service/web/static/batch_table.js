// The table of a batch: a row for each photo, its state in words, and the order of the rows.

import { badge, h, label, seconds } from "./dom.js";
import { ENDED } from "./service.js";

const HEADS = ["Photo", "Outcome", "Score", "3D", "Reason", "Position", "Duration", "Scene"];
const PREPARED = ["loading", "preparing"];

export function done(entry) {
  return entry.ended !== null || (entry.job !== null && ENDED.includes(entry.job.state) && entry.job.result !== undefined);
}

/** Tell whether a photo's record was not read yet, of a table that was opened again. */
export function isLoading(entry) {
  return entry.id !== null && !entry.job && !entry.ended;
}

export function outcome({ job }) {
  return job?.result?.status ?? null;
}

/** Tell whether a job runs, or is queued, while its scene is prepared; `states`: those of the scenes, by id. */
export function isPreparing({ job }, states) {
  return ["queued", "running"].includes(job?.state) && PREPARED.includes(states.get(job.scene));
}

function stateOf(entry, states) {
  if (entry.ended) return entry.ended;
  if (isLoading(entry)) return "loading";
  if (!entry.job) return entry.note ? "sending" : "waiting";
  if (entry.job.state === "running" && isPreparing(entry, states)) return "preparing_the_scene";
  return outcome(entry) ?? entry.job.state;
}

/** The worst first: photos without a result, then by their score. */
export function ordered(entries, order) {
  if (!order) return entries;
  const score = entry => entry.job?.result?.score ?? -1;
  const sorted = entries.toSorted((a, b) => score(a) - score(b));
  return order === "worst" ? sorted : sorted.reverse();
}

/** The table's element, and `draw`, which is given what it shows. */
export function batchTable() {
  const rows = h("tbody");
  const table = h("table", { class: "jobs batch" }, h("thead", {}, h("tr", {}, HEADS.map(name => h("th", { scope: "col" }, name)))), rows);
  const element = h("div", { class: "scroll", tabIndex: 0, role: "region", "aria-label": "Results" }, table);
  return { element, draw: (entries, states) => drawRows(rows, entries, states) };
}

/** Only what has changed: a row that is drawn anew would load its picture again. */
function drawRows(rows, shown, states) {
  while (rows.children.length > shown.length) rows.lastChild.remove();
  shown.forEach((entry, i) => {
    const state = stateOf(entry, states);
    const text = JSON.stringify([entry.name, entry.note, state, entry.job]);
    const old = rows.children[i];
    if (old?.dataset.text === text) return;
    const fresh = row(entry, state);
    fresh.dataset.text = text;
    old ? old.replaceWith(fresh) : rows.append(fresh);
  });
}

function row(entry, state) {
  const { job, name } = entry;
  const result = job?.result;
  const known = job?.links;
  const picture = h("img", { src: known ? `${job.links.photo}?records=${job.records}` : "", alt: "", width: 64, height: 48, class: known ? null : "gone" });
  picture.addEventListener("error", () => picture.classList.add("gone"));
  const title = h("span", { class: "photo", title: name }, picture, h("span", {}, name));
  const took = job?.finished && job.started ? (Date.parse(job.finished) - Date.parse(job.started)) / 1000 : null;
  // A best guess is no position: who copies it from here would take it for one.
  const posed = result && result.status !== "not_localized";
  return h("tr", {},
    h("td", {}, known ? h("a", { href: `#/jobs/${job.id}` }, title) : title),
    h("td", {}, badge(state)),
    h("td", { class: "number" }, result ? result.score.toFixed(2) : "–"),
    h("td", {}, known ? h("a", { href: job.links.viewer, "aria-label": `${name} in the viewer` }, "viewer") : ""),
    h("td", { class: "why" }, why(entry)),
    h("td", { class: "number" }, posed ? result.pose.position.map(x => x.toFixed(3)).join(", ") : "–"),
    h("td", { class: "number" }, seconds(took)),
    h("td", {}, job?.scene ?? ""));
}

/** Why there is no verified pose: its first sentence, the rest under it when that is opened. */
function why({ note, job }) {
  const result = job?.result;
  const told = result && result.status !== "localized" ? [`${label("reason", result.reason)}.`, result.search_summary, result.hint].filter(Boolean).join(" ") : "";
  const [first, rest] = (note || told || job?.error?.detail || "").split(/(?<=\.) (.*)/s);
  if (!rest) return first;
  return h("details", {}, h("summary", { title: `${first} ${rest}` }, first), rest);
}
