// Several photos, each a job of its own: sent one after the other, shown as a table that can be exported.

import { service } from "./service.js";
import { h, say } from "./dom.js";
import { batchTable, done, isLoading, isPreparing, ordered, outcome } from "./batch_table.js";
import { address, forget, keep } from "./batches.js";
import { drawnPoses, drawPlan, planAxes } from "./plan.js";
import { savingButton } from "./saving.js";
import { colmapModel, csvTable, transforms } from "./tables.js";
import { sendPhoto } from "./sending.js";

const POLL_MS = 1000;
const READ_AT_ONCE = 24;
const ASKED_AT_ONCE = 8;  // jobs end in their order, about: those at the end of the queue need not be asked
const MAP_SIZE = 320;
/**
 * The photos that this page is sending or has sent: {file, fields, id, name, note, job, ended}. `id`: the job's, `job`:
 * its document as it was read last; `ended`: why there will be none.
 */
let sent = [];
let sending = false, stopped = new AbortController();

/** Send photos with the same fields, and show their table; while others are being sent, these join them. */
export async function start(files, fields) {
  const fresh = files.map(file => ({ file, fields, id: null, name: file.name || "photo", note: "", job: null, ended: null }));
  sent = sending ? [...sent, ...fresh] : fresh;
  const hash = address(idsOf(sent), "");
  if (location.hash === hash) dispatchEvent(new HashChangeEvent("hashchange"));
  location.hash = hash;
  await sendAll();
}

const isUnsent = entry => entry.file && !entry.job && !entry.ended;

async function sendAll() {
  if (sending) return;
  sending = true;
  addEventListener("beforeunload", askFirst);
  for (let next; (next = sent.find(isUnsent));) {
    const { file, fields } = next;
    try {
      next.job = await sendPhoto(file, fields, text => { next.note = text; }, stopped.signal);
      [next.id, next.note] = [next.job.id, ""];
      keepShown(sent);
    } catch (error) {
      [next.note, next.ended] = error.name === "AbortError" ? ["", "cancelled"] : [error.message, "refused"];
    }
  }
  removeEventListener("beforeunload", askFirst);
  sending = false;
}

/** Photos that are not sent yet would be lost with the page. */
function askFirst(event) {
  event.preventDefault();
}

function idsOf(entries) {
  return entries.filter(entry => entry.id).map(entry => entry.id);
}

/** The way back to the table: in the list of batches, and in the address where it is the one that is shown. */
function keepShown(entries) {
  const ids = idsOf(entries);
  const [hash, query] = location.hash.split("?");
  const isShown = hash === "#/batch/" || hash.startsWith(`#/batch/${ids[0]}`);
  const order = isShown ? new URLSearchParams(query).get("order") ?? "" : undefined;
  if (isShown) history.replaceState(null, "", address(ids, order));
  keep(entries.map(entry => entry.job).filter(Boolean), order);
}

async function cancelRest(entries) {
  if (entries === sent) {
    for (const entry of entries.filter(isUnsent)) entry.ended = "cancelled";
    stopped.abort();
    stopped = new AbortController();
  }
  const open = entries.filter(entry => entry.id && !done(entry));
  await Promise.all(open.map(entry => service.cancel(entry.id).catch(() => {})));  // ended meanwhile; else it can be tried again
}

export function show(main, list, query) {
  document.title = "photos – splatfix";
  const ids = list ? list.split(",") : [];
  const isSent = !ids.length || ids[0] === idsOf(sent)[0];
  const opened = ids.map(id => ({ file: null, fields: null, id, name: "…", note: "", job: null, ended: null }));
  const entries = () => (isSent ? sent : opened);
  const states = new Map();
  const table = batchTable(), head = new Head(entries, states, new URLSearchParams(query).get("order"));
  const maps = h("div", { class: "maps" }), map = new Maps(maps);
  main.append(h("div", { class: "batchpage" }, head.element, maps, table.element));
  let left = false, timer = null;
  const draw = () => {
    if (left) return;
    head.draw();
    table.draw(head.chosen(), states);
    map.draw(found(entries(), true));
  };
  const poll = async () => {
    await refresh(entries(), states, draw);
    if (left) return;
    draw();
    if (entries().some(entry => !done(entry))) timer = setTimeout(poll, POLL_MS);
    else say(head.summary.textContent);
  };
  head.element.addEventListener("change", () => { keepShown(entries()); draw(); });
  draw();
  poll().then(() => (idsOf(entries()).length && entries().every(entry => entry.ended) ? forget(ids[0]) : keepShown(entries())));
  return () => { left = true; clearTimeout(timer); };
}

/** Ask how far the jobs and their scenes are; those that have ended are read as a whole, once. */
async function refresh(entries, states, draw) {
  const open = entries.filter(entry => entry.id && !done(entry));
  const unread = open.filter(isLoading);
  if (open.length > unread.length) {
    const scenes = await service.scenes().catch(() => []);
    for (const { id, state } of scenes) states.set(id, state);
  }
  const due = unread.length ? unread : open.slice(0, ASKED_AT_ONCE);
  for (let i = 0; i < due.length; i += READ_AT_ONCE) {
    await Promise.all(due.slice(i, i + READ_AT_ONCE).map(read));
    draw();
  }
}

async function read(entry) {
  try {
    entry.job = await service.job(entry.id);
    entry.name = entry.job.photo.name || entry.name;
  } catch (error) {
    if (error.status !== 404) return;  // the connection may come back
    [entry.note, entry.ended] = [error.message, "not_found"];
  }
}

/** What stands above the table: how far it is, what is shown of it, and what it is exported as. */
class Head {
  constructor(entries, states, order) {
    Object.assign(this, { entries, states });
    this.summary = h("p", { class: "lead", role: "status" });
    this.bar = h("progress", { "aria-label": "Finished photos", max: 1, value: 0 });
    this.cancel = h("button", { type: "button", "data-needs": "localize" }, "Cancel the rest");
    this.cancel.addEventListener("click", async () => {
      this.cancel.disabled = true;
      await cancelRest(entries());
      this.cancel.disabled = false;
    });
    this.running = h("div", { class: "advance" }, this.bar, this.cancel);
    this.filter = chooser("Outcome", [["", "any outcome"], ["localized", "localized"], ["uncertain", "uncertain"],
      ["not_localized", "not localized"], ["other", "no result"]]);
    this.order = chooser("Order", [["", "as sent"], ["worst", "worst first"], ["best", "best first"]]);
    this.order.value = order ?? "";
    this.order.addEventListener("change", () => {
      const [hash] = location.hash.split("?");
      history.replaceState(null, "", this.order.value ? `${hash}?order=${this.order.value}` : hash);
    });
    const all = () => found(entries(), false), usable = () => found(entries(), true);
    this.exports = [["CSV", "poses.csv", all, csvTable], ["COLMAP", "colmap.zip", usable, colmapModel],
      ["nerfstudio", "transforms.json", usable, transforms],
    ].map(([label, file, jobs, made]) => ({ label, jobs, button: savingButton(file, () => made(jobs())) }));
    this.plans = h("p", { class: "plans" });
    this.element = h("div", { class: "head" }, h("h1", {}, "Photos"), this.summary, this.running,
      h("div", { class: "filters" }, this.filter, this.order, this.exports.map(({ button }) => button)), this.plans);
  }

  /** The photos that are shown, in their order. */
  chosen() {
    const wanted = this.filter.value;
    return ordered(this.entries(), this.order.value).filter(entry => !wanted || (outcome(entry) ?? "other") === wanted);
  }

  draw() {
    const entries = this.entries(), loading = entries.some(isLoading);
    const text = summed(entries, this.states);
    if (this.summary.textContent !== text) this.summary.textContent = text;
    const finished = entries.filter(done).length;
    [this.bar.max, this.bar.value] = [entries.length || 1, finished];
    this.running.hidden = finished === entries.length;
    this.cancel.hidden = loading;
    for (const { label, jobs, button } of this.exports) {
      button.textContent = `${label}: ${held(jobs(), label === "CSV")}`;
      button.disabled = loading || !jobs().length;
    }
    const scenes = [...new Set(entries.map(entry => entry.job?.scene).filter(Boolean))].filter(scene => scene !== "auto");
    if (this.plans.childElementCount === scenes.length) return;
    this.plans.replaceChildren(...scenes.map(id => h("a", { href: `#/scenes/${encodeURIComponent(id)}` }, `Plan and coverage of ${id}`)));
  }
}

function summed(entries, states) {
  if (entries.some(isLoading)) return `Loading ${entries.length} photos…`;
  const localized = entries.filter(entry => outcome(entry) === "localized").length;
  const open = entries.filter(entry => !done(entry)).length;
  const preparing = entries.some(entry => isPreparing(entry, states)) ? " Preparing the scene…" : "";
  return `${localized} of ${entries.length} photos localized${open ? `, ${open} not finished` : ""}.${preparing}`;
}

/** How many photos an export holds, in words. */
function held(jobs, all) {
  if (all) return `${jobs.length} ${jobs.length === 1 ? "photo" : "photos"}`;
  const uncertain = jobs.filter(job => job.result.status === "uncertain").length;
  return `${jobs.length - uncertain} localized${uncertain ? `, ${uncertain} uncertain` : ""}`;
}

/** The jobs that have ended with a result; `usable`: those whose pose may be handed on. */
function found(entries, usable) {
  return entries.map(entry => entry.job).filter(job => job?.result && (!usable || job.result.status !== "not_localized"));
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
      axes: planAxes(scene), map: null, cameras, anchors: [], metresPerUnit: scene.metres_per_unit, jobs: jobs.flatMap(drawnPoses), size: MAP_SIZE,
    });
    return h("figure", {}, h("figcaption", {}, `Poses in ${scene.name}, from above`), h("div", { class: "planbox" }, plan));
  }
}

function chooser(label, pairs) {
  return h("select", { "aria-label": label }, pairs.map(([value, text]) => h("option", { value }, text)));
}
