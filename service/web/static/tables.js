// The poses of many jobs in one file: CSV, COLMAP's text model, nerfstudio's transforms.json.

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

/** COLMAP's images.txt: camera_from_world, the camera of each image under the image's own number. */
export function imageTable(jobs) {
  const lines = jobs.map(({ photo, result }, i) => {
    const { quaternion_wxyz, translation } = result.pose.camera_from_world;
    return `${[i + 1, ...quaternion_wxyz, ...translation, i + 1, named(photo)].join(" ")}\n\n`;
  });
  return `# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then an empty line\n${lines.join("")}`;
}

/** COLMAP's cameras.txt, by the intrinsics of each result. */
export function cameraTable(jobs) {
  const lines = jobs.map(({ result: { intrinsics: k } }, i) => {
    const focal = k.model.startsWith("SIMPLE") || k.model === "RADIAL" ? [k.fx] : [k.fx, k.fy];
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
