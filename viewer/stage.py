"""The 3D of one browser: scene, training cameras, a job's trajectory and candidates.

Every node has one name and is replaced under it, so that nothing grows however long a browser watches.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Literal

import numpy as np
import viser
import viser.transforms as vt
from jaxtyping import UInt8

from service.types import Camera, Candidates, Intrinsics, IterationRecord, Pose
from viewer import shapes
from viewer.client import JobView
from viewer.draw import score_colours
from viewer.feed import SceneContent
from viewer.playback import answer_colour

Layer = Literal["splats", "training cameras", "trajectory", "candidates"]

_INITIAL, _CURRENT = (150, 150, 150), (255, 140, 0)
_TRAINING = (70, 105, 160)
_WIDTH_PX = 2.0
_FLIGHT_S, _FRAME_S = 0.8, 1 / 30


class Stage:
    """What one browser sees. All methods are called from one thread."""

    def __init__(self, client: viser.ClientHandle) -> None:
        self._client = client
        self._scene: SceneContent | None = None
        self._visible: dict[Layer, bool] = dict.fromkeys(
            ("splats", "training cameras", "trajectory", "candidates"), True
        )
        self._nodes: dict[Layer, dict[str, viser.SceneNodeHandle]] = {layer: {} for layer in self._visible}

    def show_scene(self, content: SceneContent, pose: Pose | None) -> None:
        """Draw a scene; stand behind a camera in it, or at its first view."""
        self._scene = content
        scene, client = content.extent, self._client
        cameras = [named.camera for named in content.view.cameras]
        with client.atomic():
            client.scene.set_up_direction(scene.up)
            # Nearer than this nothing is drawn: the frusta that one stands in would cover what one looks at.
            client.camera.near, client.camera.far = 1.15 * scene.frustum, 500 * scene.radius
            if pose is None:
                self.look(shapes.first_view(scene, cameras))
            else:
                self.look_over(pose)
        client.flush()
        background = np.array([[content.view.background_rgb]])
        client.scene.set_background_image((255 * background).astype(np.uint8), format="png")
        poses = shapes.stacked([c.pose for c in cameras])
        segments = shapes.frusta(poses, [c.intrinsics for c in cameras], 0.6 * scene.frustum)
        self._lines("training cameras", "cameras", segments, _TRAINING, 1.0)
        self._add_splats(content)

    def show_trajectory(self, records: Sequence[IterationRecord], job: JobView) -> None:
        """Draw the way from the first to the last record, in the verdict's colour once there is one."""
        if self._scene is None or not records:
            return
        depth = self._scene.extent.frustum
        poses = shapes.stacked([r.pose for r in records])
        moved = np.flatnonzero(np.abs(np.diff(poses, axis=0)).max((1, 2), initial=0.0) > 0) + 1
        steps = poses[np.concatenate([[0], moved])]
        colour = answer_colour(job.answer)
        self._lines("trajectory", "path", shapes.path(steps[:, :3, 3]), colour, 2.0)
        ghosts = shapes.frusta(steps[1:-1], [job.photo] * len(steps[1:-1]), 0.5 * depth)
        self._lines("trajectory", "steps", ghosts, _INITIAL, 1.0)
        self._frustum("initial", records[0].pose, job.photo, _INITIAL, 0.8 * depth)
        if job.answer is not None:
            self._frustum("final", records[-1].pose, job.photo, colour, 1.1 * depth)

    def show_current(self, pose: Pose, photo: Intrinsics, texture: UInt8[np.ndarray, "h w 3"] | None) -> None:
        """Draw the camera of the record that is looked at, with the photo in it."""
        if self._scene is None:
            return
        node = self._nodes["trajectory"].get("current")
        if node is None or texture is not None:
            self._frustum("current", pose, photo, _CURRENT, self._scene.extent.frustum, texture)
            return
        with self._client.atomic():
            node.wxyz, node.position = _wxyz(pose.world_from_camera), pose.position_in_world

    def show_candidates(self, candidates: Candidates | None, photo: Intrinsics) -> None:
        """Draw poses that were weighed, coloured by score, as one node."""
        poses = candidates.world_from_camera if candidates else np.zeros((0, 4, 4))
        if self._scene is None:
            return
        segments = shapes.frusta(poses, [photo] * len(poses), 0.7 * self._scene.extent.frustum)
        scores = candidates.scores if candidates else np.zeros(0)
        # viser takes one colour as sRGB, but colours by vertex as linear light.
        linear = (255 * (score_colours(scores) / 255) ** 2.2).astype(np.uint8)
        colours = shapes.frustum_colours(linear)
        self._lines("candidates", "candidates", segments, colours, 1.5)

    def clear_job(self) -> None:
        for layer in ("trajectory", "candidates"):
            for name in tuple(self._nodes[layer]):
                self._nodes[layer].pop(name).remove()

    def set_visible(self, layer: Layer, visible: bool) -> None:
        self._visible[layer] = visible
        for node in self._nodes[layer].values():
            node.visible = visible

    def look(self, view: shapes.Viewpoint) -> None:
        camera = self._client.camera
        with self._client.atomic():
            camera.up_direction = view.up
            camera.position = view.position
            camera.look_at = view.look_at
            camera.fov = view.fov_rad

    def look_through(self, camera: Camera) -> None:
        if self._scene is not None:
            self.look(shapes.through(camera, self._scene.extent, self._client.camera.aspect))

    def look_over(self, pose: Pose) -> None:
        """Stand behind a camera, at once."""
        if self._scene is not None:
            self.look(shapes.behind(pose, self._scene.extent, self._scene.splats.centres))

    def fly_to(self, pose: Pose) -> None:
        """Move over the shoulder of a camera within a second; blocks for that long."""
        if self._scene is None:
            return
        camera = self._client.camera
        start = shapes.Viewpoint(camera.position.copy(), camera.look_at.copy(), camera.up_direction.copy(), camera.fov)
        goal = shapes.behind(pose, self._scene.extent, self._scene.splats.centres)
        began = time.monotonic()
        share = 0.0
        while share < 1:
            share = min(1.0, (time.monotonic() - began) / _FLIGHT_S)
            self.look(shapes.between(start, goal, share))
            self._client.flush()
            time.sleep(_FRAME_S)

    def _add_splats(self, content: SceneContent) -> None:
        splats = content.splats
        # viser sends covariances as float16: scaled so that the largest just fits, small ones keep digits.
        largest = float(splats.covariances[:, [0, 3, 5]].max(initial=1e-12))
        k = 200.0 / np.sqrt(largest)
        self._nodes["splats"]["splats"] = self._client.scene.add_gaussian_splats(
            "/splats/splats",
            centers=splats.centres * np.float32(k),
            covariances=shapes.full_covariances(splats.covariances * np.float32(k * k)),
            rgbs=splats.rgba[:, :3],
            opacities=splats.rgba[:, 3:],
            scale=1 / k,
            visible=self._visible["splats"],
        )

    def _lines(
        self,
        layer: Layer,
        name: str,
        segments: np.ndarray,
        colours: np.ndarray | tuple[int, int, int],
        width_px: float,
    ) -> None:
        old = self._nodes[layer].pop(name, None)
        if not len(segments):
            if old is not None:
                old.remove()
            return
        self._nodes[layer][name] = self._client.scene.add_line_segments(
            f"/{layer}/{name}",
            segments,
            colours,
            thickness=width_px,
            thickness_units="screen",
            visible=self._visible[layer],
        )

    def _frustum(
        self,
        name: str,
        pose: Pose,
        photo: Intrinsics,
        colour: tuple[int, int, int],
        depth: float,
        texture: UInt8[np.ndarray, "h w 3"] | None = None,
    ) -> None:
        half_width, half_height = 0.5 * photo.width / photo.fx, 0.5 * photo.height / photo.fy
        self._nodes["trajectory"][name] = self._client.scene.add_camera_frustum(
            f"/trajectory/{name}",
            fov=float(2 * np.arctan(half_height)),
            aspect=half_width / half_height,
            # viser's scale is the cube root of the pyramid's volume (times 3/4), not its depth.
            scale=depth * float(np.cbrt(half_width * half_height / 3)),
            thickness=_WIDTH_PX,
            thickness_units="screen",
            color=colour,
            image=texture,
            jpeg_quality=80,
            wxyz=_wxyz(pose.world_from_camera),
            position=pose.position_in_world,
            visible=self._visible["trajectory"],
            cast_shadow=False,
            receive_shadow=False,
        )


def _wxyz(world_from_camera: np.ndarray) -> np.ndarray:
    return vt.SO3.from_matrix(world_from_camera[:3, :3]).wxyz
