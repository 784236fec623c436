// Several photos, each a job of its own: sent one after the other, shown as a table that can be exported.

import { ENDED, service } from "./service.js";
import { badge, h, say, seconds, words } from "./dom.js";
import { drawnPoses, drawPlan, planAxes } from "./plan.js";
import { cameraTable, csvTable, imageTable, transforms } from "./tables.js";
import { sendPhoto } from "./sending.js";

const POLL_MS = 1000;
const HEADS = ["Photo", "Outcome", "Score", "3D", "Reason", "Position", "Duration", "Scene"];
/** The photos that this page is sending or has sent: {file, fields, name, note, job}. */
let sent = [];
let sending = false;

/** Send photos with the same fields, and show their table; while others are being sent, these join them. */
export async function start(files, fields) {
  const fresh = files.map(file => ({ file, fields, name: file.name || "photo", note: "queued", job: null }));
  sent = sending ? [...sent, ...fresh] : fresh;
  location.hash = sent.length === fresh.length ? "#/batch/" : address();
  await sendAll();
}

async function sendAll() {
  if (sending) return;
  sending = true;
  addEventListener("beforeunload", askFirst);
  for (let entry; (entry = sent.find(({ file, job, refused }) => file && !job && !refused));) {
    try {
      entry.job = await sendPhoto(entry.file, entry.fields, text => { entry.note = text; });
      entry.note = "";
    } catch (error) {
      entry.note = error.message;
      entry.refused = true;
    }
    // The jobs stand in the address, so that the table can be opened again.
    if (location.hash.startsWith("#/batch/")) history.replaceState(null, "", address());
  }
  removeEventListener("beforeunload", askFirst);
  sending = false;
}

/** Photos that are not sent yet would be lost with the page. */
function askFirst(event) {
  event.preventDefault();
}

function address() {
  return `#/batch/${sent.filter(entry => entry.job).map(entry => entry.job.id).join(",")}`;
}

export function show(main, list) {
  document.title = "photos – splatfix";
  const ids = list ? list.split(",") : [];
  const isSent = !ids.length || `#/batch/${list}` === address();
  const opened = ids.map(id => ({ name: id, note: "", job: { id, state: "queued" } }));
  const entries = () => (isSent ? sent : opened);
  const rows = h("tbody"), maps = h("div", { class: "maps" });
  const summary = h("p", { class: "lead", role: "status" });
  const filter = h("select", { "aria-label": "Outcome" },
    [["", "any outcome"], ["localized", "localized"], ["uncertain", "uncertain"], ["not_localized", "not localized"],
      ["other", "no result"]].map(([value, text]) => h("option", { value }, text)));
  const order = h("select", { "aria-label": "Order" },
    [["", "as sent"], ["worst", "worst first"], ["best", "best first"]].map(([value, text]) => h("option", { value }, text)));
  const jobs = usable => found(entries(), usable);
  const exports = h("span", { class: "buttons" }, saving("CSV", "poses.csv", () => csvTable(jobs(false))),
    saving("COLMAP images.txt", "images.txt", () => imageTable(jobs(true))),
    saving("COLMAP cameras.txt", "cameras.txt", () => cameraTable(jobs(true))),
    saving("nerfstudio", "transforms.json", () => transforms(jobs(true))));
  main.append(h("h1", {}, "Photos"), summary, h("div", { class: "filters" }, filter, order, exports),
    h("div", { class: "beside" },
      h("div", { class: "scroll", tabIndex: 0, role: "region", "aria-label": "Results" }, h("table", { class: "jobs" },
        h("thead", {}, h("tr", {}, HEADS.map(name => h("th", { scope: "col" }, name)))), rows)),
      maps));
  const map = new Maps(maps);
  const draw = () => {
    drawRows(rows, ordered(entries(), order.value).filter(entry => !filter.value || (outcome(entry) ?? "other") === filter.value));
    summary.textContent = summed(entries());
    map.draw(jobs(true));
  };
  let left = false, timer = null;
  const poll = async () => {
    await refresh(entries());
    if (left) return;
    draw();
    if (entries().some(entry => !done(entry))) timer = setTimeout(poll, POLL_MS);
    else say(summary.textContent);
  };
  for (const control of [filter, order]) control.addEventListener("change", draw);
  draw();
  poll();
  return () => { left = true; clearTimeout(timer); };
}

/** Only what has changed: a row that is drawn anew would load its picture again. */
function drawRows(rows, shown) {
  while (rows.children.length > shown.length) rows.lastChild.remove();
  shown.forEach((entry, i) => {
    const text = JSON.stringify([entry.name, entry.note, entry.job]);
    const old = rows.children[i];
    if (old?.dataset.text === text) return;
    const fresh = row(entry);
    fresh.dataset.text = text;
    old ? old.replaceWith(fresh) : rows.append(fresh);
  });
}

/** The poses of all photos seen from above, a plan for each scene. */
class Maps {
  constructor(place) {
    this.place = place;
    this.scenes = new Map();  // by id; null: asked for
    this.text = "";
  }

  draw(jobs) {
    const byScene = Map.groupBy(jobs, job => job.scene);
    for (const id of byScene.keys()) if (!this.scenes.has(id)) this.#ask(id, jobs);
    const text = JSON.stringify([[...byScene].map(([id, jobs]) => [id, jobs.length]), [...this.scenes.values()].map(Boolean)]);
    if (text === this.text) return;
    this.text = text;
    this.place.replaceChildren(...[...byScene].filter(([id]) => this.scenes.get(id)).map(([id, jobs]) => this.#plan(this.scenes.get(id), jobs)));
  }

  #ask(id, jobs) {
    this.scenes.set(id, null);
    service.scene(id).then(scene => { this.scenes.set(id, scene); this.draw(jobs); }, () => {});  // deleted meanwhile
  }

  #plan(scene, jobs) {
    const cameras = scene.training_cameras.map(camera => camera.world_from_camera);
    const plan = drawPlan({
      axes: planAxes(scene), map: null, cameras, anchors: [], metresPerUnit: scene.metres_per_unit, jobs: jobs.flatMap(drawnPoses),
    });
    return h("figure", {}, h("figcaption", {}, `Poses in ${scene.name}, from above`), h("div", { class: "planbox" }, plan));
  }
}

function done(entry) {
  return entry.refused || (entry.job !== null && ENDED.includes(entry.job.state) && entry.job.result !== undefined);
}

function outcome({ job }) {
  return job?.result?.status ?? null;
}

/** The worst first: photos without a result, then by their score. */
function ordered(entries, order) {
  if (!order) return entries;
  const score = entry => entry.job?.result?.score ?? -1;
  const sorted = entries.toSorted((a, b) => score(a) - score(b));
  return order === "worst" ? sorted : sorted.reverse();
}

/** The jobs that have ended with a result; `usable`: those whose pose may be handed on. */
function found(entries, usable) {
  return entries.map(entry => entry.job).filter(job => job?.result && (!usable || job.result.status !== "not_localized"));
}

function summed(entries) {
  const localized = entries.filter(entry => outcome(entry) === "localized").length;
  const open = entries.filter(entry => !done(entry)).length;
  return `${localized} of ${entries.length} photos localized${open ? `, ${open} not finished` : ""}.`;
}

/** Ask how far the jobs are; those that have ended are read as a whole, once. */
async function refresh(entries) {
  await Promise.all(entries.filter(entry => entry.job && !done(entry)).slice(0, 8).map(async entry => {
    try {
      const job = await service.job(entry.job.id);
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
    h("td", { class: "number" }, result ? result.score.toFixed(2) : "–"),
    h("td", {}, known ? h("a", { href: job.links.viewer, "aria-label": `${name} in the viewer` }, "viewer") : ""),
    h("td", { class: "why" }, why),
    h("td", { class: "number" }, result ? result.pose.position.map(x => x.toFixed(3)).join(", ") : "–"),
    h("td", { class: "number" }, seconds(took)),
    h("td", {}, job?.scene ?? ""));
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
