"""The photo's camera over the steps of a job: path, frusta, and the one that is shown."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import viser
from jaxtyping import Float64, UInt8

from service.results import IterationRecord
from service.types import Camera, Pose
from viewer.colours import CURRENT_COLOUR, INITIAL_COLOUR, TRUTH_COLOUR, outcome_colour
from viewer.frusta import frustum_edges, hit_frustum, stack_poses, viser_frustum
from viewer.layers.layer import Canvas, Layer, quaternion_wxyz
from viewer.service_values import Job


class TrajectoryLayer(Layer):
    """The camera's path and its frusta: initial, intermediate, current, final and, where known, true."""

    name = "trajectory"

    def __init__(self, canvas: Canvas, *, visible: bool = True) -> None:
        super().__init__(canvas, visible=visible)
        self._steps: tuple[list[int], Float64[np.ndarray, "k 4 4"]] = [], np.zeros((0, 4, 4))
        """Indices of the records at which the pose changed, and their poses."""

    def show(self, records: Sequence[IterationRecord], job: Job) -> None:
        """Draw the path from the first to the last record, in the colour of the job's status."""
        if self.extent is None or not records:
            return
        depth = self.extent.frustum_depth
        poses = stack_poses([r.pose for r in records])
        # Records that leave the pose unchanged would draw the same frustum again.
        moved = np.flatnonzero(np.abs(np.diff(poses, axis=0)).max((1, 2), initial=0.0) > 0) + 1
        kept = [0, *moved.tolist()]
        steps = poses[kept]
        self._steps = [records[i].index for i in kept], steps
        colour = outcome_colour(job.outcome)
        self._draw_spline("path", steps[:, :3, 3], colour)
        intrinsics = [job.camera(records[i]).intrinsics for i in kept[1:-1]]
        self._draw_lines("steps", frustum_edges(steps[1:-1], intrinsics, 0.5 * depth), INITIAL_COLOUR, 1.0)
        self._draw_frustum("initial", job.camera(records[0]), INITIAL_COLOUR, 0.8 * depth)
        # Final and true frusta are a little deeper than the current one, which would hide them where they coincide.
        if job.outcome is not None:
            self._draw_frustum("final", job.camera(records[-1]), colour, 1.1 * depth)
        if job.truth is not None:
            self._draw_frustum("truth", Camera(job.photo, job.truth), TRUTH_COLOUR, 1.15 * depth)

    def show_current(self, camera: Camera, image: UInt8[np.ndarray, "h w 3"] | None) -> None:
        """Draw the camera of the record that is shown, with an image in it; None: keep the image drawn before."""
        if self.extent is None:
            return
        depth, node = self.extent.frustum_depth, self._nodes.get("current")
        if image is not None or not isinstance(node, viser.CameraFrustumHandle):
            self._draw_frustum("current", camera, CURRENT_COLOUR, depth, image)
            return
        with self._canvas.atomic():
            node.wxyz, node.position = quaternion_wxyz(camera.pose.world_from_camera), camera.pose.position_in_world
            node.fov, node.aspect, node.scale = viser_frustum(camera.intrinsics, depth)

    def show_label(self, pose: Pose, text: str) -> None:
        """Write a text above the image plane of a camera."""
        if self.extent is None:
            return
        depth = self.extent.frustum_depth
        position = pose.position_in_world + depth * pose.axis_in_world + 0.6 * depth * self.extent.up
        self._draw_label("label", text, position)

    def clear(self) -> None:
        """Remove all nodes."""
        self._steps = [], np.zeros((0, 4, 4))
        super().clear()

    def hit(self, origin: Float64[np.ndarray, "3"], direction: Float64[np.ndarray, "3"]) -> int | None:
        """Return the index of the record whose frustum a ray hits, if the layer is visible."""
        if self.extent is None or not self.visible:
            return None
        indices, poses = self._steps
        step = hit_frustum(origin, direction, poses, self.extent.frustum_depth)
        return None if step is None else indices[step]
