"""A photo whose rows were read one after the other while the camera turned, as the middle row's camera takes it.

The camera of each row is that of the middle row turned about the same centre, by an angle that grows with the row: each
row is resampled by a homography of its own. The camera's own motion, and a turn about the optical axis, are left in.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from service.types import Intrinsics, Query

_ITERATIONS = 2
"""To find the row that saw a point: the first is off by the motion between two rows, the second by its square."""


def without_row_motion(query: Query, camera: Intrinsics, shear: float, stretch: float) -> Query:
    """Return the query with its rows turned back to the middle one; `camera` is its pinhole, as far as it is known.

    `shear` and `stretch` are shifts of a row in normalized units per normalized unit down (positive: right, down), at
    the principal point. Of a photo whose columns are the sensor's rows they are those that remain beside another roll
    and distance: shifts of a column down by the shear, and right by the negative stretch, per unit to the right. Pixels
    that no row saw are invalid.
    """
    height, width = query.rgb.shape[:2]
    row, column = np.mgrid[:height, :width].astype(np.float32) + np.float32(0.5)
    x, y = (column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy
    middle_x, middle_y = (0.5 * width - camera.cx) / camera.fx, (0.5 * height - camera.cy) / camera.fy
    seen_x, seen_y = x, y
    for _ in range(_ITERATIONS):
        # Angles about the vertical and the horizontal axis; a normalized unit is the tangent of an angle.
        if query.rows_are_columns:
            turn, tilt = -stretch * (seen_x - middle_x), shear * (seen_x - middle_x)
        else:
            turn, tilt = shear * (seen_y - middle_y), stretch * (seen_y - middle_y)
        ahead = 1 - turn * x - tilt * y
        seen_x, seen_y = (x + turn) / ahead, (y + tilt) / ahead
    # OpenCV has the centre of the top-left pixel at (0, 0).
    at = seen_x * camera.fx + (camera.cx - 0.5), seen_y * camera.fy + (camera.cy - 0.5)
    at = at[0].astype(np.float32), at[1].astype(np.float32)
    rgb = cv2.remap(query.rgb, *at, cv2.INTER_CUBIC)
    known = np.ones((height, width), np.uint8) if query.valid_mask is None else query.valid_mask.astype(np.uint8)
    inside = cv2.remap(known, *at, cv2.INTER_NEAREST, borderValue=0) > 0
    return replace(query, rgb=np.asarray(rgb), valid_mask=None if inside.all() else inside)
