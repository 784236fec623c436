// Several photos, each a job of its own: sent one after the other, shown as a table that can be exported.

import { ENDED, service } from "./service.js";
import { badge, h, say, seconds, words } from "./dom.js";
import { cameraTable, csvTable, imageTable, transforms } from "./tables.js";
import { sendPhoto } from "./sending.js";

const POLL_MS = 1000;
/** The photos that this page is sending or has sent: {file, name, note, job}. */
let entries = [];

/** Send photos with the same fields, and show their table. */
export async function start(files, fields) {
  entries = files.map(file => ({ file, name: file.name || "photo", note: "queued", job: null }));
  const mine = entries;
  location.hash = "#/batch/";
  for (const entry of mine) {
    try {
      entry.job = await sendPhoto(entry.file, fields, text => { entry.note = text; });
      entry.note = "";
    } catch (error) {
      entry.note = error.message;
      entry.refused = true;
    }
    if (entries !== mine) return;  // another lot was begun meanwhile
    // The jobs stand in the address, so that the table can be opened again.
    if (location.hash.startsWith("#/batch/")) history.replaceState(null, "", address());
  }
}

function address() {
  return `#/batch/${entries.filter(entry => entry.job).map(entry => entry.job.id).join(",")}`;
}

export function show(main, list) {
  document.title = "photos – splatfix";
  const ids = list ? list.split(",") : [];
  if (ids.length && `#/batch/${list}` !== address()) entries = ids.map(id => ({ name: id, note: "", job: { id, state: "queued" } }));
  const rows = h("tbody");
  const summary = h("p", { class: "lead", role: "status" });
  const filter = h("select", { "aria-label": "Outcome" },
    [["", "any outcome"], ["localized", "localized"], ["uncertain", "uncertain"], ["not_localized", "not localized"],
      ["other", "no result"]].map(([value, text]) => h("option", { value }, text)));
  const exports = h("span", { class: "buttons" }, saving("CSV", "poses.csv", () => csvTable(found(false))),
    saving("COLMAP images.txt", "images.txt", () => imageTable(found(true))),
    saving("COLMAP cameras.txt", "cameras.txt", () => cameraTable(found(true))),
    saving("nerfstudio", "transforms.json", () => transforms(found(true))));
  main.append(h("h1", {}, "Photos"), summary, h("div", { class: "filters" }, filter, exports),
    h("div", { class: "scroll", tabIndex: 0, role: "region", "aria-label": "Results" }, h("table", { class: "jobs" },
      h("thead", {}, h("tr", {}, ["Photo", "Outcome", "Reason", "Score", "Scene", "Position", "Duration", "3D"]
        .map(name => h("th", { scope: "col" }, name)))), rows)));
  const draw = () => {
    const shown = entries.filter(entry => !filter.value || (outcome(entry) ?? "other") === filter.value);
    const texts = shown.map(entry => JSON.stringify([entry.note, entry.job]));
    // Only what has changed: a row that is drawn anew would load its picture again.
    while (rows.children.length > shown.length) rows.lastChild.remove();
    shown.forEach((entry, i) => {
      const old = rows.children[i];
      if (old?.dataset.text === texts[i]) return;
      const fresh = row(entry);
      fresh.dataset.text = texts[i];
      old ? old.replaceWith(fresh) : rows.append(fresh);
    });
    summary.textContent = summed();
  };
  let left = false, timer = null;
  const poll = async () => {
    await refresh();
    if (left) return;
    draw();
    if (entries.some(entry => !done(entry))) timer = setTimeout(poll, POLL_MS);
    else say(summary.textContent);
  };
  filter.addEventListener("change", draw);
  draw();
  poll();
  return () => { left = true; clearTimeout(timer); };
}

function done(entry) {
  return entry.refused || (entry.job !== null && ENDED.includes(entry.job.state) && entry.job.result !== undefined);
}

function outcome({ job }) {
  return job?.result?.status ?? null;
}

/** The jobs that have ended with a result; `usable`: those whose pose may be handed on. */
function found(usable) {
  return entries.map(entry => entry.job).filter(job => job?.result && (!usable || job.result.status !== "not_localized"));
}

function summed() {
  const localized = entries.filter(entry => outcome(entry) === "localized").length;
  const open = entries.filter(entry => !done(entry)).length;
  return `${localized} of ${entries.length} photos localized${open ? `, ${open} not finished` : ""}.`;
}

/** Ask how far the jobs are; those that have ended are read as a whole, once. */
async function refresh() {
  await Promise.all(entries.filter(entry => entry.job && !done(entry)).slice(0, 8).map(async entry => {
    try {
      const job = await service.ask(`jobs/${entry.job.id}`);
      entry.job = job;
      entry.name = job.photo.name || entry.name;
    } catch (error) {
      if (error.status !== 404) return;  // the connection may come back
      [entry.note, entry.refused] = [error.message, true];
    }
  }));
}

function row(entry) {
  const { job, note, name } = entry;
  const result = job?.result;
  const known = job?.links;
  const picture = h("img", { src: known ? `${job.links.photo}?records=${job.records}` : "", alt: "", width: 64, height: 48, class: known ? null : "gone" });
  picture.addEventListener("error", () => picture.classList.add("gone"));
  const title = h("span", { class: "photo" }, picture, h("span", {}, name));
  const took = job?.finished && job.started ? (Date.parse(job.finished) - Date.parse(job.started)) / 1000 : null;
  const why = note || (result ? (result.status === "localized" ? "" : `${words(result.reason)}. ${result.hint}`) : job?.error?.detail ?? "");
  return h("tr", {},
    h("td", {}, known ? h("a", { href: `#/jobs/${job.id}` }, title) : title),
    h("td", {}, badge(entry.refused ? "refused" : result?.status ?? job?.state ?? "sending")),
    h("td", { class: "why" }, why),
    h("td", { class: "number" }, result ? result.score.toFixed(2) : "–"),
    h("td", {}, job?.scene ?? ""),
    h("td", { class: "number" }, result ? result.pose.position.map(x => x.toFixed(3)).join(", ") : "–"),
    h("td", { class: "number" }, seconds(took)),
    h("td", {}, known ? h("a", { href: job.links.viewer, "aria-label": `${name} in the viewer` }, "viewer") : ""));
}

function saving(label, name, text) {
  const button = h("button", { type: "button" }, label);
  button.addEventListener("click", () => {
    const link = h("a", { href: URL.createObjectURL(new Blob([text()], { type: "text/plain" })), download: name });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  });
  return button;
}
