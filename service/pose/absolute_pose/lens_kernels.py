"""The compiled inner loop of refining a pose with its intrinsics on correspondences."""

from __future__ import annotations

import numpy as np

from service.jit import kernel


@kernel
def linearize_projection(photo_px, rotation, translation, points_in_world, camera):
    """Return d projected pixel / d (twist, correction_vector), (m, 2, 10), the residuals photo - projected, (m, 2), and
    which points are ahead, (m); the others have zeros.

    `rotation` and `translation` are camera_from_world's; `camera` is fx, fy, cx, cy, k1, long side.
    """
    fx, fy, cx, cy, k1, side = camera[0], camera[1], camera[2], camera[3], camera[4], camera[5]
    count = len(points_in_world)
    jacobian, residual, ahead = np.zeros((count, 2, 10)), np.zeros((count, 2)), np.zeros(count, np.bool_)
    for i in range(count):
        point = points_in_world[i]
        x = rotation[0, 0] * point[0] + rotation[0, 1] * point[1] + rotation[0, 2] * point[2] + translation[0]
        y = rotation[1, 0] * point[0] + rotation[1, 1] * point[1] + rotation[1, 2] * point[2] + translation[1]
        z = rotation[2, 0] * point[0] + rotation[2, 1] * point[1] + rotation[2, 2] * point[2] + translation[2]
        # Points behind the camera would project as if they were ahead, and pull on the pose.
        ahead[i] = z > 1e-9
        if not ahead[i]:
            continue
        u, v = x / z, y / z
        square = u * u + v * v
        radial = 1.0 + k1 * square
        residual[i, 0] = photo_px[i, 0] - fx * u * radial - cx
        residual[i, 1] = photo_px[i, 1] - fy * v * radial - cy
        # d distorted (u, v) / d (u, v) is symmetric.
        uu, uv, vv = radial + 2 * k1 * u * u, 2 * k1 * u * v, radial + 2 * k1 * v * v
        by_twist = ((u * v, 1 + v * v), (-(1 + u * u), -u * v), (v, -u), (-1 / z, 0.0), (0.0, -1 / z), (u / z, v / z))
        for j in range(6):
            du, dv = by_twist[j]
            jacobian[i, 0, j] = fx * (uu * du + uv * dv)
            jacobian[i, 1, j] = fy * (uv * du + vv * dv)
        jacobian[i, 0, 6], jacobian[i, 1, 6] = fx * u * radial, fy * v * radial
        jacobian[i, 0, 7], jacobian[i, 1, 7] = fx * u * square, fy * v * square
        jacobian[i, 0, 8] = jacobian[i, 1, 9] = side
    return jacobian, residual, ahead
