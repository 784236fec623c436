"""The frames of a moving camera that show different things, with the odometry that relates them."""

from __future__ import annotations

import numpy as np

from service.geometry import pose_distance
from service.live.live_values import LiveFrame
from service.types import Pose

MOST = 3
"""Frames beside the newest one."""
_TURN_DEG, _WAY = 15.0, 0.3
"""From which on two frames show different things; the second in the odometry's unit."""


class RecentViews:
    """Keeps the last frames that differ; for one camera and one thread."""

    def __init__(self) -> None:
        self._kept: list[tuple[LiveFrame, Pose]] = []
        self._segment = 0
        self.newest = Pose(np.eye(4))
        """odom_from_camera of the newest frame."""

    def add(self, frame: LiveFrame, odom_from_camera: Pose, segment: int) -> None:
        """Take a frame; with another `segment` the odometry has begun anew, and relates nothing to what was before."""
        if segment != self._segment:
            self._kept, self._segment = [], segment
        self.newest = odom_from_camera
        # Compared with the last one that was kept, not with the last frame: a slow camera never differs from that.
        if not self._kept or _differ(self._kept[-1][1], odom_from_camera):
            self._kept = [*self._kept, (frame, odom_from_camera)][-MOST - 1 :]

    def before_newest(self) -> list[tuple[LiveFrame, Pose]]:
        """Return the kept frames that differ from the newest one, newest first."""
        # The newest itself is searched for with these: one that shows the same would add nothing.
        return [kept for kept in reversed(self._kept) if _differ(kept[1], self.newest)][:MOST]


def _differ(a: Pose, b: Pose) -> bool:
    turned_deg, way = pose_distance(a, b)
    return turned_deg > _TURN_DEG or way > _WAY
