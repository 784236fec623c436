// Poses of splatfix in three.js and WebXR: right-handed, a camera looks along -z. The scene keeps its own axes.

/** Move a THREE.PerspectiveCamera to a result's pose; its picture has the photo's frame, principal point included. */
export function placeCamera(camera, { pose, intrinsics: k }) {
  camera.matrixAutoUpdate = false;
  camera.matrix.fromArray(columns(pose.opengl.world_from_camera.matrix));
  camera.matrix.decompose(camera.position, camera.quaternion, camera.scale);
  camera.updateMatrixWorld(true);
  camera.projectionMatrix.fromArray(columns(projection(k, camera.near, camera.far)));
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
}

/** OpenGL's projection of a camera without distortion, row by row. */
export function projection({ width, height, fx, fy, cx, cy }, near, far) {
  return [
    [2 * fx / width, 0, 1 - 2 * cx / width, 0],
    [0, 2 * fy / height, 2 * cy / height - 1, 0],
    [0, 0, (near + far) / (near - far), 2 * near * far / (near - far)],
    [0, 0, -1, 0],
  ];
}

/**
 * WebXR: where the session has the scene's content, as the `matrix` of a THREE.Group, column by column.
 * @param {Float32Array} viewMatrix  `XRView.transform.matrix` of the frame whose camera image was localized
 * @param {object} pose  `result.pose`
 * @param {number} metresPerUnit  of the scene
 */
export function sessionFromScene(viewMatrix, pose, metresPerUnit = 1) {
  const session = rows(viewMatrix), back = pose.opengl.camera_from_world.matrix;
  // The camera's frame in metres, then the scene's in that.
  return columns(product(session, back.map((row, i) => (i < 3 ? row.map(value => value * metresPerUnit) : row))));
}

const columns = matrix => [0, 1, 2, 3].flatMap(column => matrix.map(row => row[column]));
const rows = flat => [0, 1, 2, 3].map(row => [0, 1, 2, 3].map(column => flat[4 * column + row]));
const product = (a, b) => a.map(row => [0, 1, 2, 3].map(j => row.reduce((sum, value, k) => sum + value * b[k][j], 0)));
