"""The 3D view of one browser: its layers and its camera."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from service.types import Camera, Pose
from viewer.browser_camera import BrowserCamera
from viewer.camera_views import initial_view, view_from_above, view_from_behind, view_through
from viewer.layers.anchor_layer import AnchorLayer
from viewer.layers.axes_layer import AxesLayer
from viewer.layers.candidate_layer import CandidateLayer
from viewer.layers.coverage_layer import CoverageLayer
from viewer.layers.floor_plan_layer import FloorPlanLayer, below_the_cut
from viewer.layers.job_poses_layer import JobPosesLayer
from viewer.layers.layer import Canvas, Layer, LayerName
from viewer.layers.match_layer import MatchLayer
from viewer.layers.measure_layer import MeasureLayer
from viewer.layers.splat_layer import SplatLayer
from viewer.layers.training_camera_layer import TrainingCameraLayer
from viewer.layers.trajectory_layer import TrajectoryLayer
from viewer.picking import first_surface
from viewer.scene_cache import SceneContent


class Scene3D:
    """One scene with the layers that are drawn in it. All methods are called from one thread."""

    def __init__(self, canvas: Canvas, *, splats: bool = True) -> None:
        """`splats`: whether the layer of splats is shown at first."""
        self.splats = SplatLayer(canvas, visible=splats)
        self.training_cameras = TrainingCameraLayer(canvas)
        self.trajectory = TrajectoryLayer(canvas)
        self.candidates = CandidateLayer(canvas)
        self.matches = MatchLayer(canvas)
        self.axes = AxesLayer(canvas, visible=False)
        self.measured = MeasureLayer(canvas)
        self.job_poses = JobPosesLayer(canvas, visible=False)
        self.coverage = CoverageLayer(canvas, visible=False)
        self._floor_plan = FloorPlanLayer(canvas, visible=False)
        self.anchors = AnchorLayer(canvas)
        layers = self.splats, self.training_cameras, self.trajectory, self.candidates, self.matches
        layers += self.axes, self.measured, self.job_poses, self.coverage, self._floor_plan, self.anchors
        self._layers: dict[LayerName, Layer] = {layer.name: layer for layer in layers}
        self._canvas = canvas
        self._camera = BrowserCamera(canvas)
        self._content: SceneContent | None = None

    @property
    def metres_per_unit(self) -> float | None:
        """Of the scene that is drawn; None: unknown."""
        return self._content.description.metres_per_unit if self._content else None

    def show_scene(self, content: SceneContent, pose: Pose | None) -> None:
        """Draw a scene but for its splats, seen from behind the camera `pose`, or from the scene's initial view."""
        self._content = content
        extent = content.extent
        cameras = [named.camera for named in content.description.cameras]
        for layer in self._layers.values():
            layer.extent = extent
        self.splats.show(content)
        with self._canvas.atomic():
            self._canvas.scene.set_up_direction(extent.up)
            # The near plane cuts away the frusta of a camera that one looks through: they would cover its view.
            self._camera.set_clipping(1.15 * extent.frustum_depth, 500 * extent.radius)
            if pose is None:
                self._camera.set_view(initial_view(extent, cameras))
            else:
                self.look_from_behind(pose)
        self.splats.show_background(None)
        self._canvas.flush()
        self.training_cameras.show(cameras)
        self.axes.show(self.metres_per_unit)
        for layer in (self.measured, self.job_poses, self.coverage, self._floor_plan, self.anchors):
            layer.clear()
        if self._floor_plan.visible:
            self._floor_plan.show(content)

    def clear_job(self) -> None:
        """Remove everything that belongs to a job."""
        for layer in (self.trajectory, self.candidates, self.matches):
            layer.clear()

    def set_visible(self, name: LayerName, visible: bool) -> None:
        """Show or hide a layer."""
        self._layers[name].set_visible(visible)
        # Megabytes that most browsers never need.
        if name == "floor plan" and visible and self._content is not None:
            self._floor_plan.show(self._content)

    def is_visible(self, name: LayerName) -> bool:
        """Return whether the user shows a layer."""
        return self._layers[name].visible

    def hit(self, origin: Sequence[float], direction: Sequence[float]) -> int | Camera | None:
        """Return what a click's ray hits: the index of a record, or a training camera."""
        ray = np.array(origin, np.float64), np.array(direction, np.float64)
        # A step first: its frusta often stand among training cameras.
        step = self.trajectory.hit(*ray)
        return self.training_cameras.hit(*ray) if step is None else step

    def surface(self, origin: Sequence[float], direction: Sequence[float]) -> Float64[np.ndarray, "3"] | None:
        """Return the point of the scene that a click's ray hits; None: it passes."""
        if self._content is None:
            return None
        return first_surface(np.array(origin, np.float64), np.array(direction, np.float64), self._content.splats)

    def measure(self, origin: Sequence[float], direction: Sequence[float]) -> None:
        """Take what a click's ray hits as a point of the measured distance."""
        point = self.surface(origin, direction)
        if point is not None:
            self.measured.add(point, self.metres_per_unit)

    def look_through(self, camera: Camera) -> None:
        """Take the view of a camera."""
        if self._content is not None:
            self._camera.set_view(view_through(camera, self._content.extent, self._camera.aspect))

    def look_from_above(self) -> None:
        """Take the plan view: all of the scene's surroundings, straight from above."""
        if self._content is not None:
            points = self._content.splats.centres[below_the_cut(self._content)]
            cameras = [named.camera for named in self._content.description.cameras]
            self._camera.set_view(view_from_above(self._content.extent, cameras, points, self._camera.aspect))

    def look_at_first(self) -> None:
        """Take the view of a scene before any job."""
        if self._content is not None:
            cameras = [named.camera for named in self._content.description.cameras]
            self._camera.set_view(initial_view(self._content.extent, cameras))

    def look_from_behind(self, pose: Pose) -> None:
        """Take a view from behind a camera, at once."""
        if self._content is not None:
            self._camera.set_view(view_from_behind(pose, self._content.extent, self._content.splats.centres))

    def fly_to(self, pose: Pose) -> None:
        """Move to a view from behind a camera; blocks for 0.8 s."""
        if self._content is not None:
            self._camera.fly_to(view_from_behind(pose, self._content.extent, self._content.splats.centres))
