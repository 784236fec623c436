// The same pose as other programs spell it, and the request as a curl line.

// A tenth of a micrometre in a kilometre: more digits would only hide the number.
const number = value => String(Number(value.toFixed(9)));
const line = values => values.map(number).join(" ");

function matrix(rows) {
  const cells = rows.map(row => row.map(value => value.toFixed(9)));
  const wide = Math.max(...cells.flat().map(cell => cell.length));
  return cells.map(row => row.map(cell => cell.padStart(wide)).join(" ")).join("\n");
}

/** Return [name, text] of every spelling of the pose in a job's result. */
export function poseFormats({ result: { pose, geopose }, photo, created }) {
  const { world_from_camera: there, camera_from_world: back, opengl } = pose;
  const [w, x, y, z] = there.quaternion_wxyz;
  const photoName = photo.name.replaceAll(/[^\w./+-]+/g, "_") || "photo.jpg";
  const formats = [
    ["World from camera, OpenCV axes", matrix(there.matrix)],
    ["Camera from world, OpenCV axes", matrix(back.matrix)],
    ["Position and quaternion wxyz", `${line(pose.position)}\n${line(there.quaternion_wxyz)}`],
    ["World from camera, OpenGL axes (Blender)", matrix(opengl.world_from_camera.matrix)],
    ["COLMAP, a line of images.txt", `1 ${line([...back.quaternion_wxyz, ...back.translation])} 1 ${photoName}`],
    ["nerfstudio, a frame of transforms.json",
      JSON.stringify({ file_path: photoName, transform_matrix: opengl.world_from_camera.matrix })],
    ["TUM, position and quaternion xyzw", 
      `${(Date.parse(created) / 1000).toFixed(6)} ${line([...pose.position, x, y, z, w])}`],
  ];
  if (geopose) formats.push(["OGC GeoPose", JSON.stringify(geopose, null, 2)]);
  return formats;
}

const quoted = text => `'${text.replaceAll("'", "'\\''")}'`;

/** Return the curl line that sends these fields with this photo; with a key, where the service asks for one. */
export function curlLine(fields, photoName, keyed) {
  const parts = keyed ? ['-H "Authorization: Bearer $SPLATFIX_KEY"'] : [];
  parts.push(...Object.entries(fields).map(([name, value]) => `-F ${quoted(`${name}=${value}`)}`));
  parts.push(`-F ${quoted(`photo=@${photoName}`)}`);
  return `curl -H 'Prefer: wait=30' \\\n  ${parts.join(" \\\n  ")} \\\n  ${new URL("localize", document.baseURI).href}`;
}

/** Return the fields that a job was sent with, from what the service tells of it. */
export function fieldsOf(job) {
  const fields = { scene: job.scene, estimator: job.estimator };
  if (Object.keys(job.options).length) fields.options = JSON.stringify(job.options);
  if (job.seed) fields.seed = String(job.seed);
  if (job.budget_s) fields.budget_s = String(job.budget_s);
  if (job.prior) fields.prior = JSON.stringify({ world_from_camera: job.prior.world_from_camera.matrix });
  if (job.truth) fields.truth = JSON.stringify({ world_from_camera: job.truth.world_from_camera.matrix });
  if (job.camera_id) fields.camera_id = job.camera_id;
  const { result } = job;
  if (result?.intrinsics_source === "given") fields.intrinsics = JSON.stringify(result.intrinsics);
  return fields;
}

/** Return how far two poses are apart: [degrees, scene units]. */
export function poseDistance(a, b) {
  const [p, q] = [a.world_from_camera.quaternion_wxyz, b.world_from_camera.quaternion_wxyz];
  // The vector part of p* q: exact for small angles, where acos of the dot product is not.
  const [w, ...v] = [
    p[0] * q[0] + p[1] * q[1] + p[2] * q[2] + p[3] * q[3],
    p[0] * q[1] - p[1] * q[0] - p[2] * q[3] + p[3] * q[2],
    p[0] * q[2] - p[2] * q[0] - p[3] * q[1] + p[1] * q[3],
    p[0] * q[3] - p[3] * q[0] - p[1] * q[2] + p[2] * q[1],
  ];
  const angle = 2 * Math.atan2(Math.hypot(...v), Math.abs(w));
  return [angle * 180 / Math.PI, Math.hypot(...a.position.map((value, i) => value - b.position[i]))];
}
