// The poses of many jobs in one file: CSV, COLMAP's text model, nerfstudio's transforms.json.

import { zip } from "./saving.js";

const DIGITS = 9;  // a micrometre in a kilometre
const POSE = ["x", "y", "z", "qw", "qx", "qy", "qz"];

/**
 * A row for each job; the pose is world_from_camera in OpenCV axes, in scene units, its quaternion's scalar first. It is
 * empty of photos that are not localized, so that nobody takes a best guess for a position.
 */
export function csvTable(jobs) {
  const head = ["photo", "job", "scene", "status", "reason", "score", ...POSE, "inliers"];
  const rows = jobs.map(({ id, photo, scene, result }) => {
    const { translation, quaternion_wxyz } = result.pose.world_from_camera;
    const pose = result.status === "not_localized" ? POSE.map(() => "") : [...translation, ...quaternion_wxyz];
    return [photo.name, id, scene, result.status, result.reason, result.score, ...pose, result.inliers];
  });
  return [head, ...rows].map(cells => `${cells.map(quoted).join(",")}\r\n`).join("");
}

function quoted(value) {
  // A name that begins like a formula would be run by a spreadsheet.
  const text = typeof value === "string" ? value.replace(/^[=+\-@]/, "'$&") : String(Number(value.toPrecision(DIGITS)));
  return /[",\r\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
}

/** COLMAP's model in text, as a ZIP: its readers need all three files, and there are no points. */
export function colmapModel(jobs) {
  const images = jobs.flatMap(colmapImages);
  const points = "# POINT3D_ID X Y Z R G B ERROR TRACK[] as (IMAGE_ID, POINT2D_IDX)\n# Number of points: 0\n";
  return zip({ "cameras.txt": cameraTable(images), "images.txt": imageTable(images), "points3D.txt": points });
}

/** The photos of a job that have a pose, with their intrinsics and `camera_from_world`. */
function colmapImages({ photo, result }) {
  const { intrinsics, frames, pose } = result;
  if (!frames) return [{ name: named(photo), intrinsics, ...pose.camera_from_world }];
  const found = frames.filter(frame => frame.status === "localized");
  return found.map(frame => ({ name: named(frame), intrinsics, ...inverse(frame.world_from_camera) }));
}

function inverse({ matrix, quaternion_wxyz: [w, ...v] }) {
  const translation = [0, 1, 2].map(i => -[0, 1, 2].reduce((sum, k) => sum + matrix[k][i] * matrix[k][3], 0));
  return { quaternion_wxyz: [w, ...v.map(x => -x)], translation };
}

/** images.txt: camera_from_world, the camera of each image under the image's own number. */
function imageTable(images) {
  const lines = images.map(({ name, quaternion_wxyz, translation }, i) =>
    `${[i + 1, ...quaternion_wxyz, ...translation, i + 1, name].join(" ")}\n\n`);
  return `# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then an empty line\n${lines.join("")}`;
}

/** cameras.txt, by the intrinsics of each result. */
function cameraTable(images) {
  const lines = images.map(({ intrinsics: k }, i) => {
    const focal = k.model.startsWith("SIMPLE") || k.model.startsWith("RADIAL") ? [k.fx] : [k.fx, k.fy];
    return `${[i + 1, k.model, k.width, k.height, ...focal, k.cx, k.cy, ...k.distortion].join(" ")}\n`;
  });
  return `# CAMERA_ID MODEL WIDTH HEIGHT PARAMS\n${lines.join("")}`;
}

const NERFSTUDIO = {
  PINHOLE: [], SIMPLE_PINHOLE: [], SIMPLE_RADIAL: ["k1"], RADIAL: ["k1", "k2"], OPENCV: ["k1", "k2", "p1", "p2"],
  OPENCV_FISHEYE: ["k1", "k2", "k3", "k4"],
};

/** nerfstudio's transforms.json, with intrinsics for each frame. */
export function transforms(jobs) {
  const frames = jobs.map(({ photo, result: { intrinsics: k, pose } }) => ({
    file_path: named(photo),
    w: k.width, h: k.height, fl_x: k.fx, fl_y: k.fy, cx: k.cx, cy: k.cy,
    camera_model: k.model === "OPENCV_FISHEYE" ? k.model : "OPENCV",
    ...Object.fromEntries((NERFSTUDIO[k.model] ?? []).map((name, i) => [name, k.distortion[i]])),
    transform_matrix: pose.opengl.world_from_camera.matrix,
  }));
  return `${JSON.stringify({ frames }, null, 1)}\n`;
}

function named(photo) {
  return photo.name.replaceAll(/[^\w./+-]+/g, "_") || "photo.jpg";
}
