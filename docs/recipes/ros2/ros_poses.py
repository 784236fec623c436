"""Conversions between splatfix and ROS 2, for a scene whose world has z up; pure NumPy."""

import numpy as np


def intrinsics_of(width, height, k, model, distortion):
    """Return the field `intrinsics` from a CameraInfo. ROS has the centre of the first pixel at (0, 0)."""
    fields = {"width": width, "height": height, "fx": k[0], "fy": k[4], "cx": k[2] + 0.5, "cy": k[5] + 0.5}
    d = [float(value) for value in distortion]
    if not any(d):
        return fields
    if model == "equidistant":
        return {**fields, "model": "OPENCV_FISHEYE", "distortion": d[:4]}
    # plumb_bob has k1 k2 p1 p2 k3, rational_polynomial k4 k5 k6 after these: the order of COLMAP's FULL_OPENCV.
    return {**fields, "model": "FULL_OPENCV", "distortion": (d + [0.0] * 8)[:8]}


def map_from_odom(world_from_camera, odom_from_camera, metres_per_unit=1.0):
    """Return the 4x4 of `map -> odom` from a result's pose and the camera's optical frame in `odom` at its stamp."""
    map_from_camera = np.array(world_from_camera, float)
    map_from_camera[:3, 3] *= metres_per_unit
    return map_from_camera @ np.linalg.inv(odom_from_camera)


def pose_of(matrix):
    """Return translation and rotation (x, y, z, w) of a 4x4."""
    m = np.asarray(matrix, float)
    r = m[:3, :3]
    # The quaternion's largest component first: no division by almost nothing.
    trace = np.trace(r)
    squares = 1 + np.array([*(2 * np.diag(r) - trace), trace])  # of x, y, z, w, four times
    i = int(np.argmax(squares))
    x, y, z = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    table = [
        [squares[0], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], x],
        [r[0, 1] + r[1, 0], squares[1], r[1, 2] + r[2, 1], y],
        [r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], squares[2], z],
        [x, y, z, squares[3]],
    ]
    quaternion = np.array(table[i]) / (2 * np.sqrt(squares[i]))
    return m[:3, 3].tolist(), (quaternion if quaternion[3] >= 0 else -quaternion).tolist()


def covariance_of(world_from_camera, covariance, metres_per_unit=1.0):
    """Return PoseWithCovariance's 36 numbers: (x, y, z, rotation about x, y, z), along the axes of `map`.

    splatfix has (rotation, translation) along the axes of the camera.
    """
    rotation = np.array(world_from_camera, float)[:3, :3]
    to_map = np.zeros((6, 6))
    to_map[:3, 3:] = metres_per_unit * rotation
    to_map[3:, :3] = rotation
    return (to_map @ np.array(covariance, float) @ to_map.T).ravel().tolist()
