// A scene's plan as an SVG: seen from above, up out of the picture, the plan's first axis to the right.

import { length, words } from "./dom.js";

const SVG = "http://www.w3.org/2000/svg";
const SIZE = 640;
const MARGIN = 24;

/** Least probability, class, words; as the drawing of `splatfix scenes coverage` has them. */
export const LEVELS = [
  [0.9, "sure", "found: 90 % and more"],
  [0.7, "usual", "usually found: 70 to 90 %"],
  [0.4, "some", "sometimes found: 40 to 70 %"],
  [0, "rare", "rarely found: below 40 %"],
];

export function svg(tag, properties = {}, ...children) {
  const element = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(properties)) if (value !== null && value !== undefined) element.setAttribute(name, value);
  element.append(...children.flat(Infinity).filter(Boolean));
  return element;
}

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

function unit(v) {
  const size = Math.hypot(...v);
  return size > 1e-9 ? v.map(x => x / size) : [0, 0, 1];
}

/** The rotation from the world to the plan, as the service's coverage maps have it (`plan_axes`). */
export function planAxes(scene) {
  const ups = scene.training_cameras.map(camera => camera.world_from_camera.map(row => -row[1]));
  const up = unit(scene.up_in_world ?? [0, 1, 2].map(i => ups.reduce((sum, u) => sum + u[i], 0)));
  const flattest = [0, 1, 2].reduce((best, i) => (Math.abs(up[i]) < Math.abs(up[best]) ? i : best), 0);
  const axis = [0, 1, 2].map(i => (i === flattest ? 1 : 0) - up[flattest] * up[i]);
  const first = unit(axis);
  return [first, cross(up, first), up];
}

/** A camera's position and viewing direction in the plan, from its 4x4 matrix. */
export function inPlan(axes, matrix) {
  const at = matrix.map(row => row[3]), look = matrix.map(row => row[2]);
  return { x: dot(axes[0], at), y: dot(axes[1], at), dx: dot(axes[0], look), dy: dot(axes[1], look) };
}

export function pointInPlan(axes, point) {
  return { x: dot(axes[0], point), y: dot(axes[1], point) };
}

/** The poses of an ended job, of a sequence all that were found, as `drawPlan` takes them. */
export function drawnPoses(job) {
  return (job.result.frames ?? [job.result])
    .filter(answer => answer.status !== "not_localized")
    .map(answer => ({
      matrix: (answer.pose?.world_from_camera ?? answer.world_from_camera).matrix, status: answer.status,
      href: `#/jobs/${job.id}`, title: `${answer.name ?? job.photo.name}: ${words(answer.status)}`,
    }));
}

/**
 * Draw a plan. `map`: a coverage map or null; `cameras`, `jobs` (each with `matrix`, `title`, `href`, `status`) and
 * `anchors` (each with `position`, `name`); `tried`: photos of a measurement, as jobs without a page; `ground`: a PlanGround to draw beneath, or null; `size`: of the longer side
 * in pixels, as it is shown: texts are drawn for it.
 */
export function drawPlan({ axes, map, cameras, jobs, anchors, metresPerUnit, tried = [], ground = null, size = SIZE }) {
  const cells = (map?.cells ?? []).map(cell => ({ ...pointInPlan(axes, cell.position), cell }));
  const views = cameras.map(matrix => inPlan(axes, matrix));
  const found = jobs.map(job => ({ ...inPlan(axes, job.matrix), job }));
  const points = anchors.map(anchor => ({ ...pointInPlan(axes, anchor.position), anchor }));
  const trials = tried.map(trial => ({ ...inPlan(axes, trial.matrix), trial }));
  let all = [...cells, ...views, ...found, ...points, ...trials];
  if (!cells.length && !views.length && ground) all = [...all, ...ground.corners];
  if (!all.length) return null;
  const reach = (map?.cell ?? 0) * 0.75;
  const bounds = ["x", "y"].map(k => [Math.min(...all.map(p => p[k])) - reach, Math.max(...all.map(p => p[k])) + reach]);
  const extent = Math.max(...bounds.map(([low, high]) => high - low), 1e-6);
  const scale = (size - 2 * MARGIN) / extent;
  const width = (bounds[0][1] - bounds[0][0]) * scale + 2 * MARGIN;
  const shown = (bounds[1][1] - bounds[1][0]) * scale + 2 * MARGIN, height = shown + 30;
  const eye = median([...(map?.cells ?? []).map(cell => dot(axes[2], cell.position)), ...cameras.map(m => dot(axes[2], m.map(row => row[3])))]);
  const framed = bounds.map(([low, high]) => [low - MARGIN / scale, high + MARGIN / scale]);
  const px = p => [MARGIN + (p.x - bounds[0][0]) * scale, MARGIN + (bounds[1][1] - p.y) * scale];
  const ray = 0.03 * (size - 2 * MARGIN);
  return svg("svg", { viewBox: `0 0 ${Math.max(width, 260).toFixed(1)} ${height.toFixed(1)}`, class: "plan", role: found.length ? "group" : "img", "aria-label": "Plan of the scene" },
    ground ? svg("image", { class: "ground", width, height: shown, href: ground.picture(framed, width, eye) }) : null,
    svg("g", { class: "cells" }, cells.map(c => star(px(c), 0.46 * map.cell * scale, map.headings_deg, c.cell.probabilities))),
    svg("g", { class: "cameras" }, views.map(v => arrow(px(v), v, 0.7 * ray))),
    svg("g", { class: "trials" }, trials.map(t => svg("g", {}, svg("title", {}, t.trial.title),
      arrow(px(t), t, ray, `tried ${t.trial.status}`), disc(px(t), 4, `tried ${t.trial.status}`)))),
    svg("g", { class: "jobs" }, found.map(f => svg("a", { href: f.job.href },
      svg("title", {}, f.job.title), arrow(px(f), f, 1.4 * ray, `job ${f.job.status}`), disc(px(f), 5, `job ${f.job.status}`)))),
    svg("g", { class: "anchors" }, points.map(p => [disc(px(p), 4, "anchor"), label(px(p), p.anchor.name)])),
    scaleBar(scale, height - 14, metresPerUnit));
}

function median(values) {
  return values.length ? values.toSorted((a, b) => a - b)[Math.floor(values.length / 2)] : null;
}

function star([x, y], radius, headings, probabilities) {
  const half = Math.PI / headings.length;
  return headings.map((heading, i) => {
    const p = probabilities[i];
    const at = angle => `${(x + radius * Math.cos(angle)).toFixed(1)},${(y - radius * Math.sin(angle)).toFixed(1)}`;
    const middle = heading * Math.PI / 180;
    const text = p === null ? "nothing of the scene in view" : `${Math.round(100 * p)} % of photos are found`;
    return svg("path", { d: `M${x.toFixed(1)},${y.toFixed(1)}L${at(middle - 0.9 * half)}L${at(middle + 0.9 * half)}Z`, class: `cell ${level(p)}` },
      svg("title", {}, `${text}, looking to ${Math.round(heading)}°`));
  });
}

export function level(probability) {
  return probability === null ? "blind" : LEVELS.find(([least]) => probability >= least)[1];
}

function arrow([x, y], { dx, dy }, size, kind = "camera") {
  return svg("line", { x1: x, y1: y, x2: x + size * dx, y2: y - size * dy, class: kind });
}

function disc([cx, cy], r, kind) {
  return svg("circle", { cx, cy, r, class: kind });
}

function label([x, y], text) {
  return svg("text", { x: x + 7, y: y + 4 }, text);
}

function scaleBar(scale, y, metresPerUnit) {
  const limit = 100 / scale * (metresPerUnit ?? 1);
  const power = 10 ** Math.floor(Math.log10(limit));
  const shown = power * Math.max(...[1, 2, 5].filter(step => step * power <= limit * (1 + 1e-9)));
  const units = shown / (metresPerUnit ?? 1);
  return svg("g", { class: "scale" },
    svg("line", { x1: MARGIN, y1: y, x2: MARGIN + units * scale, y2: y }),
    svg("text", { x: MARGIN + units * scale + 8, y: y + 4 }, length(units, metresPerUnit)));
}
