// All jobs, newest first, with filters; two of them can be compared.

import { ENDED, service } from "./service.js";
import { batchList } from "./batches.js";
import { badge, h, label, labelled, say, seconds, when } from "./dom.js";
import { repeat } from "./repeat.js";

const PAGE = 30;
const BATCHES = 5;
const FILTERS = {
  outcome: [["", "any outcome"], ["status=localized", "localized"], ["status=uncertain", "uncertain"],
    ["status=not_localized", "not localized"], ["state=failed", "failed"], ["state=cancelled", "cancelled"],
    ["state=interrupted", "interrupted"], ["state=running", "running"], ["state=queued", "queued"]],
};

export function show(main) {
  document.title = "history – splatfix";
  const outcome = select("Outcome", FILTERS.outcome);
  const scene = select("Scene", [["", "any scene"]]);
  const estimator = select("Estimator", [["", "any estimator"]]);
  const rows = h("tbody");
  const note = h("p", { class: "quiet", role: "status" });
  const more = h("button", { type: "button", hidden: true }, "Show older jobs");
  const compare = h("button", { type: "button", disabled: true }, "Compare two");
  const marked = new Set();
  let next = null;

  const load = async path => {
    try {
      const page = await service.ask(path);
      rows.append(...page.jobs.map(job => row(job, marked, compare, note)));
      next = page.next;
      more.hidden = !next;
      note.textContent = rows.children.length ? "" : "No jobs match.";
    } catch (error) {
      note.textContent = error.message;
    }
  };
  const reload = () => {
    rows.replaceChildren();
    marked.clear();
    compare.disabled = true;
    const query = [outcome.value, scene.value && `scene=${encodeURIComponent(scene.value)}`,
      estimator.value && `estimator=${encodeURIComponent(estimator.value)}`, `limit=${PAGE}`].filter(Boolean);
    return load(`jobs?${query.join("&")}`);
  };
  for (const filter of [outcome, scene, estimator]) filter.addEventListener("change", reload);
  more.addEventListener("click", () => load(next));
  compare.addEventListener("click", () => { location.hash = `#/compare/${[...marked].join("/")}`; });
  service.scenes().then(scenes => scene.append(...scenes.map(s => h("option", { value: s.id }, s.name))), () => {});
  service.ask("capabilities").then(({ estimators }) => estimator.append(
    ...estimators.filter(e => e.available).map(e => h("option", { value: e.name }, label("estimator", e.name)))), () => {});

  main.append(h("h1", {}, "History"), batchList(BATCHES) ?? "",
    h("div", { class: "filters" }, outcome, scene, estimator, compare),
    h("div", { class: "scroll", tabIndex: 0, role: "region", "aria-label": "Jobs" }, h("table", { class: "jobs" },
      h("thead", {}, h("tr", {}, ["", "Photo", "Outcome", "Score", "Scene", "Estimator", "Duration", "Created", "3D", "Actions"]
        .map((name, i) => h("th", { scope: "col" }, i ? name : h("span", { class: "sr" }, "Mark"))))), rows)),
    note, more);
  reload();
}

function row(job, marked, compare, note) {
  const name = job.photo.name || "photo";
  const mark = h("input", { type: "checkbox", disabled: !job.status, "aria-label": `Mark ${name} of ${when(job.created)}` });
  mark.addEventListener("change", () => {
    mark.checked ? marked.add(job.id) : marked.delete(job.id);
    compare.disabled = marked.size !== 2;
  });
  const picture = h("img", { src: job.links.photo, alt: "", loading: "lazy", width: 64, height: 48 });
  picture.addEventListener("error", () => picture.classList.add("gone"));
  const took = job.finished && job.started ? (Date.parse(job.finished) - Date.parse(job.started)) / 1000 : null;
  return h("tr", {},
    h("td", {}, mark),
    h("td", {}, h("a", { href: `#/jobs/${job.id}`, class: "photo" }, picture, h("span", {}, name))),
    h("td", {}, badge(job.status ?? job.state)),
    h("td", { class: "number" }, job.score === null ? "–" : job.score.toFixed(2)),
    h("td", {}, job.scene), h("td", {}, labelled("estimator", job.estimator)),
    h("td", { class: "number" }, seconds(took)), h("td", {}, when(job.created)),
    h("td", {}, h("a", { href: job.links.viewer, "aria-label": `${name} in the viewer` }, "viewer")),
    h("td", {}, h("span", { class: "actions" }, actions(job, name, marked, compare, note))));
}

function actions(job, name, marked, compare, note) {
  if (!ENDED.includes(job.state)) return [];
  const button = (label, act) => {
    const element = h("button", { type: "button", class: "plain", "data-needs": "localize", "aria-label": `${label} ${name} of ${when(job.created)}` }, label);
    element.addEventListener("click", async () => {
      element.disabled = true;
      await act(element).catch(error => { note.textContent = error.message; say(error.message); });
      element.disabled = false;
    });
    return element;
  };
  return [
    button("Run again", () => repeat(job.id)),
    button("Delete", async element => {
      if (!confirm(`Delete the job of ${name}, with its result and photo?`)) return;
      await service.deleteJob(job.id);
      marked.delete(job.id);
      compare.disabled = marked.size !== 2;
      element.closest("tr").remove();
      say(`${name} was deleted`);
    }),
  ];
}

function select(label, pairs) {
  return h("select", { "aria-label": label }, pairs.map(([value, text]) => h("option", { value }, text)));
}
