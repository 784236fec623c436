"""What one browser shows of a whole scene: plan view, coverage map, the cameras of all jobs, and anchors."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence

from service.client import Client, ServiceError
from viewer.background_render import BackgroundRender
from viewer.controls import Controls
from viewer.layers.layer import LayerName
from viewer.panel_html import anchor_link_html, coverage_html
from viewer.scene_3d import Scene3D
from viewer.scene_display import SceneDisplay
from viewer.service_values import FoundCamera, coverage_of, found_cameras

log = logging.getLogger(__name__)

_JOBS_SHOWN = 200
_POLL_S = 1.0
_IN_PLAN: dict[LayerName, bool] = {"splats": False, "floor plan": True, "training cameras": True}
"""Layers that the plan view shows or hides."""


class PlanDisplay:
    """All methods are called from the session's thread; they raise ServiceError or ValueError."""

    def __init__(
        self,
        controls: Controls,
        scene: Scene3D,
        background: BackgroundRender,
        scene_display: SceneDisplay,
        client: Client,
    ) -> None:
        self._controls, self._scene, self._background = controls, scene, background
        self._scene_display, self._client = scene_display, client
        self._measuring, self._asked = False, 0.0
        """Whether the coverage map was being measured when it was asked for last, and when that was."""
        self._shown: str | None = None
        """Scene of the layers."""
        self._cameras: dict[str, tuple[FoundCamera, ...]] = {}
        """Of jobs that have ended, by id."""
        self._before: dict[LayerName, bool] = {}
        """Which layers were shown before the plan view."""

    @property
    def due_in_s(self) -> float | None:
        """Time until the coverage map is asked for again, while it is measured and its layer is shown; None: not."""
        if not self._measuring or not self._scene.is_visible("coverage"):
            return None
        return max(0.0, self._asked + _POLL_S - time.monotonic())

    def set_plan_view(self, shown: bool) -> None:
        """Look at the scene from above, cut open, or as before again."""
        if shown:
            self._before = {name: self._controls.layers[name].value for name in _IN_PLAN}
        for name, visible in (_IN_PLAN if shown else self._before).items():
            self._controls.layers[name].value = visible
            self._scene_display.set_layer_visible(name, visible)
        # A render would show the ceiling.
        self._background.set_enabled(not shown and self._controls.exact.value)
        if shown:
            self.set_layer_visible("poses of all jobs", True)
            self._controls.layers["poses of all jobs"].value = True
            self._scene.look_from_above()
        else:
            self._scene.look_at_first()

    def set_layer_visible(self, name: LayerName, visible: bool) -> None:
        """Show or hide a layer; what it shows is requested when it is first needed."""
        self._scene_display.set_layer_visible(name, visible)
        if name in ("coverage", "poses of all jobs", "anchors"):
            self.refresh()

    def pick_point(self, origin: Sequence[float], direction: Sequence[float]) -> None:
        """Offer to name the point that a click's ray hits, on the page of its scene."""
        point, scene_id = self._scene.surface(origin, direction), self._scene_display.scene_id
        if point is not None and scene_id is not None:
            self._scene.anchors.pick(point)
            self._controls.anchor.content = anchor_link_html(scene_id, point.tolist())

    def follow_scene(self) -> None:
        """Show the layers of another scene if there is one now."""
        if self._scene_display.scene_id != self._shown:
            self.refresh()

    def refresh(self) -> None:
        """Request what the visible layers show of the scene that is shown now."""
        scene_id = self._shown = self._scene_display.scene_id
        if scene_id is None:
            return
        if self._scene.is_visible("anchors"):
            self._scene.anchors.show(self._client.anchors(scene_id))
        if self._scene.is_visible("poses of all jobs"):
            self._scene.job_poses.show(self._all_cameras(scene_id))
        if self._scene.is_visible("coverage"):
            answer = coverage_of(self._client.coverage(scene_id))
            self._measuring, self._asked = answer.state == "running", time.monotonic()
            self._scene.coverage.show(answer.found)
            self._controls.coverage.content = coverage_html(answer)
        self._controls.coverage.visible = self._controls.layers["coverage"].value

    def _all_cameras(self, scene_id: str) -> list[FoundCamera]:
        """Return the cameras of the newest jobs of a scene; each job that has ended is requested once."""
        jobs = [job for job in self._client.jobs(limit=_JOBS_SHOWN, scene=scene_id) if job.raw["status"]]
        for job in jobs:
            if job.id not in self._cameras:
                try:
                    self._cameras[job.id] = found_cameras(self._client.job(job.id))
                except ServiceError as error:  # deleted meanwhile
                    log.info("job %s: %s", job.id, error)
        return [camera for job in jobs for camera in self._cameras.get(job.id, ())]
