// Two answers side by side: renders against the photo under one slider, and what differs between them.

import { service } from "./service.js";
import { blend, blendSlider } from "./blend.js";
import { badge, degrees, h, label, labelled, length, seconds } from "./dom.js";
import { poseDistance } from "./formats.js";
import { photoOf } from "./result.js";

export function show(main, first, second) {
  document.title = "comparison – splatfix";
  main.append(h("h1", {}, "Comparison"));
  Promise.all([first, second].map(id => service.job(id)))
    .then(async jobs => main.append(...compared(jobs, await scenes(jobs))))
    .catch(error => main.append(h("p", { class: "trouble", role: "alert" }, error.message)));
}

function scenes(jobs) {
  return Promise.all(jobs.map(job => service.scene(job.scene).catch(() => null)));
}

function compared(jobs, [sceneA, sceneB]) {
  const pairs = jobs.map(job => blend(photoOf(job), job.links.render, `The scene at the pose that “${label("estimator", job.estimator)}” found`));
  const same = jobs[0].photo.sha256 === jobs[1].photo.sha256;
  return [
    h("p", { class: same ? "lead" : "warning" }, same ? jobs[0].photo.name : "These jobs are of different photos."),
    h("p", { class: "lead" }, apart(jobs, sceneA, sceneB)),
    h("div", { class: "pair" }, jobs.map((job, i) => h("section", {},
      h("h2", {}, h("a", { href: `#/jobs/${job.id}` }, `${"AB"[i]}: `, labelled("estimator", job.estimator)), " ", badge(job.result?.status ?? job.state)),
      job.result ? pairs[i].element : h("p", {}, "No result.")))),
    blendSlider(pairs),
    h("div", { class: "scroll" }, h("table", {}, h("thead", {}, h("tr", {}, h("td", {}),
      jobs.map((_, i) => h("th", { scope: "col" }, "AB"[i])))), h("tbody", {}, differences(jobs, sceneA)))),
    h("p", { class: "buttons" }, jobs.map((job, i) => h("a", { class: "button", href: job.links.viewer }, `${"AB"[i]} in the viewer`))),
  ];
}

function apart([a, b], sceneA, sceneB) {
  if (!a.result || !b.result) return "";
  if (sceneA?.id !== sceneB?.id) return "The poses are in different scenes.";
  const [angle, distance] = poseDistance(a.result.pose, b.result.pose);
  return `The poses are ${degrees(angle)} and ${length(distance, sceneA?.metres_per_unit)} apart.`;
}

/** How far the answer is from the true pose, where that was sent. */
function error({ result, truth }) {
  return result && truth ? poseDistance(result.pose, truth) : [null, null];
}

function differences(jobs, scene) {
  const rows = {
    scene: job => job.scene, estimator: job => label("estimator", job.estimator), options: job => JSON.stringify(job.options), seed: job => job.seed,
    prior: job => (job.prior ? "given" : "none"), intrinsics: job => job.result && label("source", job.result.intrinsics_source),
    reason: job => job.result && label("reason", job.result.reason), score: job => job.result?.score.toFixed(3), inliers: job => job.result?.inliers,
    "gradient correlation": job => job.result?.gradient_correlation.toFixed(3), coverage: job => job.result?.coverage.toFixed(3),
    "rotation error": job => degrees(error(job)[0]), "position error": job => length(error(job)[1], scene?.metres_per_unit),
    "rotation σ": job => degrees(job.result?.covariance?.sigma_deg), steps: job => job.records,
    "wall time": job => seconds(sum(job, "wall_s")), "CPU time": job => seconds(sum(job, "cpu_s")),
  };
  return Object.entries(rows).map(([name, value]) => {
    const cells = jobs.map(job => String(value(job) ?? "–"));
    return h("tr", { class: cells[0] === cells[1] ? "same" : null }, h("th", { scope: "row" }, name), cells.map(cell => h("td", {}, cell)));
  });
}

function sum(job, name) {
  return job.result?.timings.reduce((total, timing) => total + timing[name], 0);
}
