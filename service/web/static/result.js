// The answer of an ended job: photo and render blended, the pose in every convention, why, and what to export.

import { asksForKey, service } from "./service.js";
import { backLine } from "./batches.js";
import { blend, blendSlider } from "./blend.js";
import { badge, copyButton, degrees, facts, h, label, labelled, length, seconds, when, words } from "./dom.js";
import { curlLine, fieldsOf, poseDistance, poseFormats } from "./formats.js";
import { repeat } from "./repeat.js";
import { savingButton } from "./saving.js";
import { recalled } from "./sent.js";
import { told } from "./start.js";
import { colmapModel } from "./tables.js";

/** Return the elements that show an ended job; `scene` is its document, null if it is gone. */
export function result(job, scene) {
  const answer = job.result;
  return [
    backLine(job.id) ?? "",
    h("h1", { class: "verdict" }, badge(answer?.status ?? job.state), " ", h("span", {}, job.photo.name || "photo")),
    ...verdict(job),
    h("div", { class: "columns" },
      h("div", {},
        ...(answer ? pictures(job) : [h("img", { class: "preview", alt: "The photo", src: photoOf(job) })]),
        numbers(job, scene)),
      h("div", {}, ...(answer ? poses(job) : []), taking(job), h("h2", {}, "Next"), again(job))),
  ];
}

function verdict({ result, error, state }) {
  if (!result) return [h("p", { class: "lead" }, error ? `${error.detail} ${error.hint}` : `The job was ${state}.`)];
  const { status, reason, search_summary: summary, hint } = result;
  return [
    status === "localized" ? h("p", { class: "lead" }, "The render at this pose agrees with the photo.")
      : h("p", { class: "lead" }, h("strong", {}, labelled("reason", reason), "."), " ", [summary, hint].filter(Boolean).join(" ")),
    ...(result.advice?.length ? [h("ul", { class: "advice" }, result.advice.map(sentence => h("li", {}, sentence)))] : []),
    ...(result.frames ? [h("p", { class: "lead" }, walk(result.frames))] : []),
    ...(result.alternatives.length ? [alternatives(result)] : []),
    ...result.warnings.map(warning => h("p", { class: "warning" }, warning)),
  ];
}

function walk(frames) {
  const found = frames.filter(frame => frame.status === "localized");
  const last = found.length ? ` Shown here: the last of them, ${found.at(-1).name}.` : "";
  return `${found.length} of ${frames.length} photos were localized.${last}`;
}

function alternatives({ alternatives: others }) {
  const place = ({ pose, probability }) => h("li", {}, `${pose.position.map(x => x.toFixed(3)).join(", ")} (${Math.round(100 * probability)} %)`);
  return h("div", { class: "warning" }, "Other possible positions:", h("ul", {}, ...others.map(place)));
}

/** The photo's address, as the render has it: undistorted. While the job ran, the same address without the number of
 * records may have had another photo of the sequence. */
export function photoOf(job) {
  return `${job.links.photo}?${job.records ? "undistorted=true&" : ""}records=${job.records}`;
}

function pictures(job) {
  const pair = blend(photoOf(job), job.links.render, "The scene rendered at the pose", recalled(job.id)?.file);
  return [
    pair.element, blendSlider([pair]),
    h("p", { class: "buttons" }, h("a", { class: "button primary", href: job.links.viewer }, "Open in viewer"),
      h("a", { class: "button", href: job.links.photo, download: "" }, "Photo"),
      h("a", { class: "button", href: job.links.render, download: "" }, "Render")),
  ];
}

function poses(job) {
  const { status } = job.result;
  return [
    h("h2", {}, "Pose"),
    ...(status !== "localized" ? [h("p", { class: "warning" }, "Best guess only: not verified.")] : []),
    ...poseFormats(job).map(([name, text], index) => {
      const details = h("details", { class: "pose", open: index === 0 && status !== "not_localized" }, h("summary", {}, name), h("pre", { tabIndex: 0 }, text));
      return h("div", { class: "poserow" }, details, copyButton(() => text, name));
    }),
  ];
}

function numbers(job, scene) {
  const { result } = job;
  const took = job.finished && job.started ? (Date.parse(job.finished) - Date.parse(job.started)) / 1000 : null;
  const scale = scene?.metres_per_unit;
  const common = [["Scene", scene?.name ?? job.scene], ["Estimator", labelled("estimator", job.estimator)], ["Created", when(job.created)],
    ["Duration", seconds(took)], ["Steps", String(job.records)]];
  if (!result) return h("section", {}, h("h2", {}, "Job"), facts(common));
  const { covariance, intrinsics } = result;
  const [angle, distance] = job.truth ? poseDistance(result.pose, job.truth) : [null, null];
  return h("section", {}, h("h2", {}, "Evidence"), facts([
    ["Score", result.score.toFixed(2)], ["Right place / precise", parts(result, scale)], ["Inliers", String(result.inliers)],
    ["Gradient correlation", result.gradient_correlation.toFixed(2)], ["Coverage", `${Math.round(100 * result.coverage)} %`],
    ["Rotation σ", covariance && degrees(covariance.sigma_deg)],
    ["Position σ", covariance && length(covariance.sigma_units, scale)],
    ["Rotation error", job.truth && degrees(angle)],
    ["Position error", job.truth && length(distance, scale)],
    ["Focal length", `${intrinsics.fx.toFixed(1)} px of ${intrinsics.width} × ${intrinsics.height}, ${lens(result)}`],
    ...common,
  ]), h("details", {}, h("summary", {}, "Time by stage"), facts(
    result.timings.map(t => [labelled("stage", t.stage), `${seconds(t.wall_s)} (CPU ${seconds(t.cpu_s)})`]))));
}

/** The parts of the score, and what `precise` is about; null in results of version 0.1.0. */
function parts({ right_place: place, precise, asked }, scale) {
  if (place == null || precise == null || !asked) return null;
  const bounds = `${degrees(asked.deg)} and ${length(asked.units, scale)}`;
  return `${place.toFixed(2)} / ${precise.toFixed(2)} (within ${bounds})`;
}

function lens({ intrinsics, intrinsics_source: source }) {
  const from = label("source", source);
  return intrinsics.trust === "approximate" ? `${from}, then estimated with the pose` : from;
}

function taking(job) {
  const file = (name, href) => h("a", { class: "button", href, download: "" }, name);
  const sent = recalled(job.id);
  const line = keyed => curlLine(sent?.fields ?? fieldsOf(job), sent?.file.name || job.photo.name || "photo.jpg", keyed);
  const curl = h("pre", { class: "curl", tabIndex: 0 }, line(false));
  asksForKey().then(asks => { curl.textContent = line(asks); });
  return h("section", {}, h("h2", {}, "Export"),
    h("p", { class: "buttons" }, file("JSON", job.links.self), file("Trace", job.links.trace),
      ...exports(job, file)),
    sharing(job), h("h3", {}, "Repeat with curl"),
    h("div", { class: "poserow" }, curl, copyButton(() => curl.textContent, "the curl line")));
}

/** A link that shows this job to who has no key. */
function sharing(job) {
  const place = h("div");
  const button = h("button", { type: "button", "data-needs": "localize" }, "Share link");
  button.addEventListener("click", async () => {
    button.disabled = true;
    try {
      const { url: address, expires_in_s: valid } = await service.share(job.id);
      place.replaceChildren(h("p", { class: "quiet" }, `Shows photo and result to whoever has it, for ${Math.round(valid / 86400)} days.`),
        h("div", { class: "poserow" }, h("pre", { class: "curl", tabIndex: 0 }, h("a", { href: address }, address)), copyButton(() => address, "the share link")));
    } catch (error) {
      button.disabled = false;
      place.replaceChildren(h("p", { class: "trouble", role: "alert" }, error.message));
    }
  });
  return h("div", {}, h("p", { class: "buttons" }, button), place);
}

function exports(job, file) {
  const { result, links } = job;
  if (!result || result.status === "not_localized") return [];
  const formats = [["nerfstudio", "nerfstudio"], ["TUM", "tum"], ...(result.geopose ? [["GeoPose", "geopose"]] : [])];
  const colmap = savingButton("colmap.zip", () => colmapModel([job]), "COLMAP");
  return [colmap, ...formats.map(([name, format]) => file(name, `${links.export}/${format}`))];
}

function again(job) {
  const place = h("p", { class: "buttons" });
  if (!job.result?.frames) {
    const button = h("button", { type: "button", "data-needs": "localize" }, "Run again");
    button.addEventListener("click", () => repeat(job.id).catch(told));
    place.append(button);
  }
  place.append(h("a", { class: "button", "data-needs": "localize", href: "#/" }, "Another photo"));
  if (job.result) place.append(h("a", { class: "button", "data-needs": "localize", href: asPrior(job) }, "Another photo with this pose as prior"));
  others(job).then(jobs => {
    if (!jobs.length) return;
    const list = h("select", { "aria-label": "Another job on the same photo" },
      jobs.map(other => h("option", { value: other.id }, `${when(other.created)}, ${label("estimator", other.estimator)}, ${words(other.status ?? other.state)}`)));
    const go = h("button", { type: "button" }, "Compare with");
    go.addEventListener("click", () => { location.hash = `#/compare/${job.id}/${list.value}`; });
    place.append(h("span", { class: "joined" }, go, list));
  });
  return place;
}

function asPrior({ result, scene, photo }) {
  const prior = JSON.stringify({ world_from_camera: result.pose.world_from_camera.matrix });
  return `#/?${new URLSearchParams({ prior, scene, of: photo.name || "a photo" })}`;
}

/** Other jobs that have found a pose for the same photo. */
async function others(job) {
  const { jobs } = await service.jobs({ photo: job.photo.sha256, limit: 50 }).catch(() => ({ jobs: [] }));
  return jobs.filter(other => other.id !== job.id && other.status);
}
