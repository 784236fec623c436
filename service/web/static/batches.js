// The batches of this browser: photos that were sent together, kept so that the way back to their table is found.

import { h, when } from "./dom.js";

const KEY = "splatfix-batches";
const KEEP = 20;

/** The batches that are known, the newest first: {ids, scene, created, order}. */
export function batches() {
  try {
    return JSON.parse(localStorage.getItem(KEY)) ?? [];
  } catch {
    return [];  // storage may be forbidden
  }
}

function store(kept) {
  try {
    localStorage.setItem(KEY, JSON.stringify(kept.slice(0, KEEP)));
  } catch { /* forbidden: the table's own address still has the jobs */ }
}

/** Keep the batch of these jobs, in place of the one that begins with the same job; `order`, where given, of its table. */
export function keep(jobs, order) {
  if (jobs.length < 2) return;
  const [{ scene, created }] = jobs;
  const ids = jobs.map(job => job.id);
  const old = batches().find(batch => batch.ids[0] === ids[0]);
  store([{ ids, scene, created, order: order ?? old?.order ?? "" }, ...forgotten(ids[0])].sort((a, b) => b.created.localeCompare(a.created)));
}

/** Forget the batch that begins with this job. */
export function forget(first) {
  store(forgotten(first));
}

function forgotten(first) {
  return batches().filter(({ ids }) => ids[0] !== first);
}

/** The address of a batch's table, with the order of its rows. */
export function address(ids, order) {
  return `#/batch/${ids.join(",")}${order ? `?order=${order}` : ""}`;
}

/** The batch that a job belongs to, as {text, page}: words and address of the way back; null: none is known. */
export function backFrom(job) {
  const batch = batches().find(({ ids }) => ids.includes(job));
  return batch ? { text: `← Back to the ${batch.ids.length} photos`, page: address(batch.ids, batch.order) } : null;
}

/** That way as a line, or null. */
export function backLine(job) {
  const back = backFrom(job);
  return back && h("p", { class: "back" }, h("a", { href: back.page }, back.text));
}

/** The newest batches as a list of links, under a heading; null: there are none. */
export function batchList(most) {
  const links = batches().slice(0, most).map(({ ids, scene, created, order }) =>
    h("li", {}, h("a", { href: address(ids, order) }, `${ids.length} photos in ${scene}`), " ", h("span", { class: "quiet" }, when(created))));
  return links.length ? h("section", { class: "batches" }, h("h2", {}, "Photos sent together"), h("ul", {}, links)) : null;
}
