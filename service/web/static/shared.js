// One job, read-only, for who has its link: photo and render, pose, evidence, and the steps of the search.

import { Client } from "../client.js";
import { blend, blendSlider } from "./blend.js";
import { badge, copyButton, degrees, facts, h, labelled, length, seconds, when } from "./dom.js";
import { poseFormats } from "./formats.js";

const main = document.querySelector("#main");
const token = location.pathname.split("/").filter(Boolean).at(-1);
const link = new Client(new URL(`${token}/`, location.href));

async function show() {
  const { job, metres_per_unit: scale } = await link.ask("job");
  const { result } = job;
  const title = job.photo.name || "A photo";
  document.title = `${title} – splatfix`;
  const head = h("h1", {}, `${title} in ${job.scene} `, badge(result?.status ?? job.state));
  if (!result) {
    main.append(head, h("p", { class: "lead" }, job.error?.detail ?? `The job is ${job.state}.`));
    return;
  }
  const pair = blend(`${job.links.photo}?undistorted=true`, job.links.render, "The scene rendered at the pose");
  main.append(head, h("p", { class: "lead" }, result.status === "localized" ? "The render at this pose agrees with the photo." : [result.search_summary, result.hint].filter(Boolean).join(" ")),
    h("div", { class: "columns" },
      h("div", {}, pair.element, blendSlider([pair]), evidence(job, scale)),
      h("div", {}, h("h2", {}, "Pose"), poses(job), anchors(result, scale), await steps(job))));
}

function evidence(job, scale) {
  const { result } = job, { covariance, intrinsics } = result;
  return h("section", {}, h("h2", {}, "Evidence"), facts([
    ["Reason", labelled("reason", result.reason)], ["Score", result.score.toFixed(2)], ["Inliers", String(result.inliers)],
    ["Rotation σ", covariance && degrees(covariance.sigma_deg)], ["Position σ", covariance && length(covariance.sigma_units, scale)],
    ["Focal length", `${intrinsics.fx.toFixed(1)} px of ${intrinsics.width} × ${intrinsics.height}`],
    ["Estimator", labelled("estimator", job.estimator)], ["Created", when(job.created)]]));
}

function poses(job) {
  return h("div", {}, poseFormats(job).map(([name, text], index) => h("div", { class: "poserow" },
    h("details", { class: "pose", open: index === 0 }, h("summary", {}, name), h("pre", { tabIndex: 0 }, text)), copyButton(() => text, name))));
}

function anchors({ anchors: seen }, scale) {
  if (!seen.length) return null;
  const row = anchor => h("tr", {}, h("th", { scope: "row" }, anchor.name),
    h("td", {}, length(Math.hypot(...anchor.in_camera), scale)),
    h("td", {}, anchor.pixel ? anchor.pixel.map(x => x.toFixed(1)).join(", ") : "not in the photo"));
  return h("section", {}, h("h2", {}, "Anchors"), h("div", { class: "scroll", tabIndex: 0, role: "region", "aria-label": "Anchors" }, h("table", {},
    h("thead", {}, h("tr", {}, ["Name", "Distance", "Pixel"].map(name => h("th", { scope: "col" }, name)))), h("tbody", {}, seen.map(row)))));
}

/** The steps of the search, one at a time: what the viewer shows, without 3D. */
async function steps(job) {
  const { records } = await link.ask("trace").catch(() => ({ records: [] }));
  if (!records.length) return null;
  const picture = h("img", { class: "preview", alt: "The scene rendered at this step" });
  const line = h("div");
  const slider = h("input", { type: "range", min: 0, max: records.length - 1, value: records.length - 1, "aria-label": "Step" });
  const move = () => {
    const record = records[slider.value];
    slider.setAttribute("aria-valuetext", `step ${record.index}`);
    picture.src = `${token}/iterations/${record.index}/render.jpg`;
    line.replaceChildren(facts([["Step", `${record.index + 1} of ${records.length}`], ["Stage", labelled("stage", record.stage)],
      ["Elapsed", seconds(record.elapsed_s)], ["Inliers", record.num_inliers === null ? null : String(record.num_inliers)]]));
  };
  slider.addEventListener("change", move);  // a render each: not while it is dragged
  move();
  return h("section", {}, h("h2", {}, "How it was found"), picture, h("div", { class: "slide" }, slider), line);
}

show().catch(error => main.append(h("h1", {}, "Shared result"), h("p", { class: "trouble", role: "alert" }, error.message)));
