"""The base of all layers: named nodes of viser's scene, which are updated in place."""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import Any, ClassVar, Literal, Protocol

import numpy as np
import viser
import viser.transforms as vt
from jaxtyping import Float64, UInt8

from service.types import Camera
from viewer.camera_views import SceneExtent
from viewer.colours import RGB
from viewer.frusta import viser_frustum

LayerName = Literal[
    "splats", "training cameras", "trajectory", "candidates", "match vectors", "axes and scale", "measured distance",
    "poses of all jobs", "coverage", "floor plan", "anchors",
]  # fmt: skip

_WIDTH_PX = 2.0
"""Of the trajectory's and of single frusta's lines."""


class Canvas(Protocol):
    """What is drawn on: a browser's viser client, or a recording."""

    scene: viser.SceneApi
    camera: Any

    def atomic(self) -> AbstractContextManager[None]:
        """Return a context whose changes the browser draws at once."""
        ...

    def flush(self) -> None:
        """Send what was drawn so far."""
        ...


class Layer:
    """Nodes of the scene by name. A node is replaced under its name, so that their number stays bounded.

    Subclasses draw nothing before `extent` is set. All methods are called from one thread.
    """

    name: ClassVar[LayerName]

    def __init__(self, canvas: Canvas, *, visible: bool = True) -> None:
        self.extent: SceneExtent | None = None
        """Of the scene that is drawn."""
        self.visible = visible
        """Whether the user shows the layer."""
        self._canvas = canvas
        self._nodes: dict[str, viser.SceneNodeHandle] = {}

    def set_visible(self, visible: bool) -> None:
        """Show or hide the layer's nodes, those drawn later included."""
        self.visible = visible
        self._apply_visibility()

    def clear(self) -> None:
        """Remove all nodes."""
        for name in tuple(self._nodes):
            self._remove(name)

    @property
    def _nodes_visible(self) -> bool:
        return self.visible

    def _apply_visibility(self) -> None:
        for node in self._nodes.values():
            node.visible = self._nodes_visible

    def _remove(self, name: str) -> None:
        node = self._nodes.pop(name, None)
        if node is not None:
            node.remove()

    def _path(self, name: str) -> str:
        return f"/{self.name}/{name}"

    def _draw_lines(self, name: str, segments: np.ndarray, colours: np.ndarray | RGB, width_px: float) -> None:
        if not len(segments):
            self._remove(name)
            return
        old = self._nodes.get(name)
        # An update in place sends only what changed, and the page doesn't flicker.
        if isinstance(old, viser.LineSegmentsHandle):
            with self._canvas.atomic():
                old.points, old.colors = segments, np.asarray(colours, np.uint8)
            return
        self._nodes[name] = self._canvas.scene.add_line_segments(
            self._path(name),
            segments,
            colours,
            thickness=width_px,
            thickness_units="screen",
            visible=self._nodes_visible,
        )

    def _draw_spline(self, name: str, points: Float64[np.ndarray, "k 3"], colour: RGB) -> None:
        apart = np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-9
        points = points[np.concatenate([[True], apart])]  # viser's spline fails at repeated points
        if len(points) < 2:
            self._remove(name)
            return
        self._nodes[name] = self._canvas.scene.add_spline_catmull_rom(
            self._path(name),
            points,
            thickness=_WIDTH_PX,
            thickness_units="screen",
            color=colour,
            visible=self._nodes_visible,
        )

    def _draw_points(self, name: str, points: np.ndarray, colours: UInt8[np.ndarray, "k 3"], size: float) -> None:
        if not len(points):
            self._remove(name)
            return
        points = points.astype(np.float32)
        old = self._nodes.get(name)
        if isinstance(old, viser.PointCloudHandle) and old.point_size == size:
            with self._canvas.atomic():
                old.points, old.colors = points, colours
            return
        self._nodes[name] = self._canvas.scene.add_point_cloud(
            self._path(name),
            points,
            colours,
            point_size=size,
            point_shape="circle",
            precision="float32",
            visible=self._nodes_visible,
        )

    def _draw_label(self, name: str, text: str, position: Float64[np.ndarray, "3"]) -> None:
        self._nodes[name] = self._canvas.scene.add_label(
            self._path(name), text, position=position, visible=self._nodes_visible
        )

    def _draw_frustum(
        self, name: str, camera: Camera, colour: RGB, depth: float, image: UInt8[np.ndarray, "h w 3"] | None = None
    ) -> None:
        fov, aspect, scale = viser_frustum(camera.intrinsics, depth)
        self._nodes[name] = self._canvas.scene.add_camera_frustum(
            self._path(name),
            fov=fov,
            aspect=aspect,
            scale=scale,
            thickness=_WIDTH_PX,
            thickness_units="screen",
            color=colour,
            image=image,
            jpeg_quality=80,
            wxyz=quaternion_wxyz(camera.pose.world_from_camera),
            position=camera.pose.position_in_world,
            visible=self._nodes_visible,
            # With shadows a frustum would look like a part of the scene.
            cast_shadow=False,
            receive_shadow=False,
        )


def quaternion_wxyz(world_from_camera: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "4"]:
    """Return a pose's rotation as a unit quaternion, scalar first."""
    return vt.SO3.from_matrix(world_from_camera[:3, :3]).wxyz


def linear_colours(colours: UInt8[np.ndarray, "k 3"]) -> UInt8[np.ndarray, "k 3"]:
    """Return sRGB colours as linear light, which viser expects for lines with a colour per vertex, and only there."""
    return (255 * (colours / 255) ** 2.2).astype(np.uint8)
