"""The 3D of one browser: scene, training cameras, a job's trajectory and candidates.

Every node has one name and is replaced under it, so that nothing grows however long a browser watches.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import Any, Literal, Protocol, get_args

import numpy as np
import viser
import viser.transforms as vt
from jaxtyping import Float64, UInt8

from service.results import Candidates, IterationRecord
from service.types import Camera, Intrinsics, Pose
from viewer import frusta
from viewer.comparison_images import score_colours
from viewer.job_stream import SceneContent
from viewer.match_geometry import MatchView
from viewer.playback import CURRENT_COLOUR, INITIAL_COLOUR, TRAINING_COLOUR, TRUTH_COLOUR, answer_colour
from viewer.service_client import JobView

Layer = Literal["splats", "training cameras", "trajectory", "candidates", "match vectors"]

_WIDTH_PX = 2.0
_FRUSTA = 24
"""Candidates that are drawn as frusta, the best; all are points."""
_FLIGHT_S, _FRAME_S = 0.8, 1 / 30


class Canvas(Protocol):
    """What is drawn on: a browser, or a recording."""

    scene: viser.SceneApi
    camera: Any

    def atomic(self) -> AbstractContextManager[None]: ...
    def flush(self) -> None: ...


class Scene3D:
    """What one browser sees. All methods are called from one thread."""

    def __init__(self, client: Canvas, *, splats: bool = True) -> None:
        self._client = client
        self._scene: SceneContent | None = None
        self._visible: dict[Layer, bool] = dict.fromkeys(get_args(Layer), True)
        self._visible["splats"] = splats
        self._splats_wanted = True
        self._ground = np.zeros((1, 1, 3), np.uint8)
        self._steps: tuple[list[int], Float64[np.ndarray, "k 4 4"]] = [], np.zeros((0, 4, 4))
        """Records at which the pose changed, and their poses."""
        self._nodes: dict[Layer, dict[str, viser.SceneNodeHandle]] = {layer: {} for layer in self._visible}

    def show_scene(self, content: SceneContent, pose: Pose | None) -> None:
        """Draw a scene but for its splats; stand behind a camera in it, or at its first view."""
        self._remove("splats", "splats")
        self._scene = content
        self._ground = (255 * np.array([[content.view.background_rgb]])).astype(np.uint8)
        scene, client = content.extent, self._client
        cameras = [named.camera for named in content.view.cameras]
        with client.atomic():
            client.scene.set_up_direction(scene.up)
            # Nearer than this nothing is drawn: the frusta that one stands in would cover what one looks at.
            client.camera.near, client.camera.far = 1.15 * scene.frustum, 500 * scene.radius
            if pose is None:
                self.look(frusta.first_view(scene, cameras))
            else:
                self.look_over(pose)
        self.show_exact(None)
        client.flush()
        poses = frusta.stacked([c.pose for c in cameras])
        segments = frusta.frusta(poses, [c.intrinsics for c in cameras], 0.6 * scene.frustum)
        self._lines("training cameras", "cameras", segments, TRAINING_COLOUR, 1.0)

    def show_trajectory(self, records: Sequence[IterationRecord], job: JobView) -> None:
        """Draw the way from the first to the last record, in the verdict's colour once there is one."""
        if self._scene is None or not records:
            return
        depth = self._scene.extent.frustum
        poses = frusta.stacked([r.pose for r in records])
        moved = np.flatnonzero(np.abs(np.diff(poses, axis=0)).max((1, 2), initial=0.0) > 0) + 1
        kept = [0, *moved.tolist()]
        steps = poses[kept]
        self._steps = [records[i].index for i in kept], steps
        colour = answer_colour(job.answer)
        self._spline(steps[:, :3, 3], colour)
        lenses = [job.camera(records[i]).intrinsics for i in kept[1:-1]]
        ghosts = frusta.frusta(steps[1:-1], lenses, 0.5 * depth)
        self._lines("trajectory", "steps", ghosts, INITIAL_COLOUR, 1.0)
        self._frustum("initial", job.camera(records[0]), INITIAL_COLOUR, 0.8 * depth)
        if job.answer is not None:
            self._frustum("final", job.camera(records[-1]), colour, 1.1 * depth)
        if job.truth is not None:
            self._frustum("truth", Camera(job.photo, job.truth), TRUTH_COLOUR, 1.15 * depth)

    def show_current(self, camera: Camera, texture: UInt8[np.ndarray, "h w 3"] | None) -> None:
        """Draw the camera of the record that is looked at, with the photo in it; None: the last photo."""
        if self._scene is None:
            return
        depth, node = self._scene.extent.frustum, self._nodes["trajectory"].get("current")
        if texture is not None or not isinstance(node, viser.CameraFrustumHandle):
            self._frustum("current", camera, CURRENT_COLOUR, depth, texture)
            return
        with self._client.atomic():
            node.wxyz, node.position = _wxyz(camera.pose.world_from_camera), camera.pose.position_in_world
            node.fov, node.aspect, node.scale = frusta.frustum_form(camera.intrinsics, depth)

    def label(self, pose: Pose, text: str) -> None:
        """Write above the picture in a camera."""
        if self._scene is not None:
            depth = self._scene.extent.frustum
            place = pose.position_in_world + depth * pose.axis_in_world + 0.6 * depth * self._scene.extent.up
            self._nodes["trajectory"]["label"] = self._client.scene.add_label("/trajectory/label", text, position=place)

    def show_candidates(self, candidates: Candidates | None, photo: Intrinsics) -> None:
        """Draw poses that were weighed, coloured by score, as one node."""
        poses = candidates.world_from_camera if candidates else np.zeros((0, 4, 4))
        if self._scene is None:
            return
        scores = candidates.scores if candidates else np.zeros(0)
        colours = score_colours(scores)
        depth = self._scene.extent.frustum
        best = np.argsort(-scores, kind="stable")[:_FRUSTA]
        segments = frusta.frusta(poses[best], [photo] * len(best), 0.7 * depth)
        self._lines("candidates", "candidates", segments, frusta.frustum_colours(_linear(colours[best])), 1.5)
        # All of them as one cloud: hundreds of frusta would be a thicket.
        self._points("candidates", "cloud", poses[:, :3, 3], colours, 0.07 * depth)

    def show_matches(self, view: MatchView | None, colours: UInt8[np.ndarray, "m 3"] | None) -> None:
        """Draw the matched points of the scene, each with a line to the ray of its photo's point."""
        if self._scene is None:
            return
        segments, drawn = np.zeros((0, 2, 3), np.float32), np.zeros((0, 3), np.uint8)
        if view is not None and colours is not None:
            segments, drawn = view.segments, colours[view.drawn]
        self._lines("match vectors", "vectors", segments, np.repeat(_linear(drawn)[:, None], 2, 1), 2.0)
        self._points("match vectors", "points", segments[:, 0], drawn, 0.05 * self._scene.extent.frustum)

    def clear_job(self) -> None:
        self._steps = [], np.zeros((0, 4, 4))
        for layer in ("trajectory", "candidates", "match vectors"):
            for name in tuple(self._nodes[layer]):
                self._remove(layer, name)

    def set_visible(self, layer: Layer, visible: bool) -> None:
        self._visible[layer] = visible
        for node in self._nodes[layer].values():
            node.visible = visible and (layer != "splats" or self._splats_wanted)

    def show_exact(self, picture: UInt8[np.ndarray, "h w 3"] | None) -> None:
        """Put a picture behind everything, in the place of the splats; None: the splats again."""
        self._splats_wanted = picture is None
        with self._client.atomic():
            self.set_visible("splats", self._visible["splats"])
            if picture is None:
                self._client.scene.set_background_image(self._ground, format="png")
            else:
                self._client.scene.set_background_image(picture, format="jpeg", jpeg_quality=92)

    def clicked(self, origin: Sequence[float], direction: Sequence[float]) -> int | Camera | None:
        """Return what a click's ray meets: the index of a step, or a training camera."""
        if self._scene is None:
            return None
        ray, depth = (np.array(origin, np.float64), np.array(direction, np.float64)), self._scene.extent.frustum
        indices, poses = self._steps
        if self._visible["trajectory"] and (hit := frusta.nearest_to_ray(*ray, poses, depth)) is not None:
            return indices[hit]
        cameras = [named.camera for named in self._scene.view.cameras]
        training = frusta.stacked([camera.pose for camera in cameras])
        hit = frusta.nearest_to_ray(*ray, training, 0.6 * depth) if self._visible["training cameras"] else None
        return None if hit is None else cameras[hit]

    def look(self, view: frusta.Viewpoint) -> None:
        camera = self._client.camera
        with self._client.atomic():
            camera.up_direction = view.up
            camera.position = view.position
            camera.look_at = view.look_at
            camera.fov = view.fov_rad

    def look_through(self, camera: Camera) -> None:
        if self._scene is not None:
            self.look(frusta.through(camera, self._scene.extent, self._client.camera.aspect))

    def look_over(self, pose: Pose) -> None:
        """Stand behind a camera, at once."""
        if self._scene is not None:
            self.look(frusta.behind(pose, self._scene.extent, self._scene.splats.centres))

    def fly_to(self, pose: Pose) -> None:
        """Move over the shoulder of a camera within a second; blocks for that long."""
        if self._scene is None:
            return
        camera = self._client.camera
        start = frusta.Viewpoint(camera.position.copy(), camera.look_at.copy(), camera.up_direction.copy(), camera.fov)
        goal = frusta.behind(pose, self._scene.extent, self._scene.splats.centres)
        began = time.monotonic()
        share = 0.0
        while share < 1:
            share = min(1.0, (time.monotonic() - began) / _FLIGHT_S)
            self.look(frusta.between(start, goal, share))
            self._client.flush()
            time.sleep(_FRAME_S)

    @property
    def lacks_splats(self) -> bool:
        """They are to be seen, and have not been sent yet."""
        return self._scene is not None and self._visible["splats"] and not self._nodes["splats"]

    def add_splats(self) -> None:
        """Send the scene's splats: megabytes, which nothing else should have to wait for."""
        if self._scene is None:
            return
        splats = self._scene.splats
        # viser sends covariances as float16: scaled so that the largest just fits, small ones keep digits.
        largest = float(splats.covariances[:, [0, 3, 5]].max(initial=1e-12))
        k = 200.0 / np.sqrt(largest)
        self._nodes["splats"]["splats"] = self._client.scene.add_gaussian_splats(
            "/splats/splats",
            centers=splats.centres * np.float32(k),
            covariances=frusta.full_covariances(splats.covariances * np.float32(k * k)),
            rgbs=splats.rgba[:, :3],
            opacities=splats.rgba[:, 3:],
            scale=1 / k,
            visible=self._visible["splats"] and self._splats_wanted,
        )

    def _lines(
        self,
        layer: Layer,
        name: str,
        segments: np.ndarray,
        colours: np.ndarray | tuple[int, int, int],
        width_px: float,
    ) -> None:
        if not len(segments):
            self._remove(layer, name)
            return
        old = self._nodes[layer].get(name)
        if isinstance(old, viser.LineSegmentsHandle):
            with self._client.atomic():
                old.points, old.colors = segments, np.asarray(colours, np.uint8)
            return
        self._nodes[layer][name] = self._client.scene.add_line_segments(
            f"/{layer}/{name}",
            segments,
            colours,
            thickness=width_px,
            thickness_units="screen",
            visible=self._visible[layer],
        )

    def _spline(self, points: Float64[np.ndarray, "k 3"], colour: tuple[int, int, int]) -> None:
        """The way of the camera's centre."""
        apart = np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-9
        points = points[np.concatenate([[True], apart])]
        if len(points) < 2:
            self._remove("trajectory", "path")
            return
        self._nodes["trajectory"]["path"] = self._client.scene.add_spline_catmull_rom(
            "/trajectory/path",
            points,
            thickness=_WIDTH_PX,
            thickness_units="screen",
            color=colour,
            visible=self._visible["trajectory"],
        )

    def _points(
        self, layer: Layer, name: str, points: np.ndarray, colours: UInt8[np.ndarray, "k 3"], size: float
    ) -> None:
        if not len(points):
            self._remove(layer, name)
            return
        points = points.astype(np.float32)
        old = self._nodes[layer].get(name)
        if isinstance(old, viser.PointCloudHandle) and old.point_size == size:
            with self._client.atomic():
                old.points, old.colors = points, colours
            return
        self._nodes[layer][name] = self._client.scene.add_point_cloud(
            f"/{layer}/{name}",
            points,
            colours,
            point_size=size,
            point_shape="circle",
            precision="float32",
            visible=self._visible[layer],
        )

    def _remove(self, layer: Layer, name: str) -> None:
        node = self._nodes[layer].pop(name, None)
        if node is not None:
            node.remove()

    def _frustum(
        self,
        name: str,
        camera: Camera,
        colour: tuple[int, int, int],
        depth: float,
        texture: UInt8[np.ndarray, "h w 3"] | None = None,
    ) -> None:
        fov, aspect, scale = frusta.frustum_form(camera.intrinsics, depth)
        self._nodes["trajectory"][name] = self._client.scene.add_camera_frustum(
            f"/trajectory/{name}",
            fov=fov,
            aspect=aspect,
            scale=scale,
            thickness=_WIDTH_PX,
            thickness_units="screen",
            color=colour,
            image=texture,
            jpeg_quality=80,
            wxyz=_wxyz(camera.pose.world_from_camera),
            position=camera.pose.position_in_world,
            visible=self._visible["trajectory"],
            cast_shadow=False,
            receive_shadow=False,
        )


def _linear(colours: UInt8[np.ndarray, "k 3"]) -> UInt8[np.ndarray, "k 3"]:
    """viser takes one colour as sRGB, but lines' colours by vertex as linear light."""
    return (255 * (colours / 255) ** 2.2).astype(np.uint8)


def _wxyz(world_from_camera: np.ndarray) -> np.ndarray:
    return vt.SO3.from_matrix(world_from_camera[:3, :3]).wxyz
