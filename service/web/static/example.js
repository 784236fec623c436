// A photo for who has none at hand: the scene itself, seen from a training camera's place, but turned.

import { service } from "./service.js";

const LONG_SIDE = 800;
const TURN = 0.25;  // rad, at most

/** Render a view of a scene that has training cameras. Returns its file, and as fields its intrinsics and its true
 * pose, so that the answer's errors are shown. Raises ServiceError. */
export async function viewOf(id) {
  const { training_cameras: cameras } = await service.scene(id);
  const camera = cameras[Math.floor(Math.random() * cameras.length)];
  const intrinsics = pinhole(camera.intrinsics);
  const pose = { world_from_camera: turned(camera.world_from_camera, TURN * (2 * Math.random() - 1)) };
  const picture = await service.render(id, pose, intrinsics);
  const file = new File([picture], `view-of-${id}.jpg`, { type: "image/jpeg" });
  return { file, fields: { intrinsics: JSON.stringify(intrinsics), truth: JSON.stringify(pose) } };
}

function pinhole({ width, height, fx, fy, cx, cy }) {
  const factor = Math.min(1, LONG_SIDE / Math.max(width, height));
  const [w, h] = [Math.round(width * factor), Math.round(height * factor)];
  return { width: w, height: h, fx: fx * w / width, fy: fy * h / height, cx: cx * w / width, cy: cy * h / height };
}

/** Turn a camera about its own vertical axis. */
function turned(matrix, angle) {
  const [cos, sin] = [Math.cos(angle), Math.sin(angle)];
  return matrix.map(([x, y, z, t]) => [x * cos - z * sin, y, x * sin + z * cos, t]);
}
