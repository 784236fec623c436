"""Which scene one browser shows, and who draws it: the browser by its splats, or the service."""

from __future__ import annotations

from collections.abc import Sequence

from service.types import Pose
from viewer.background_render import BackgroundRender, Overlay
from viewer.controls import Controls
from viewer.layers.layer import LayerName
from viewer.panel_html import prior_link_html, scene_html
from viewer.scene_3d import Scene3D
from viewer.scene_cache import SceneCache


class SceneDisplay:
    """All methods are called from the session's thread."""

    def __init__(self, controls: Controls, scene: Scene3D, background: BackgroundRender, cache: SceneCache) -> None:
        self.scene_id: str | None = None
        """Of the scene that is shown; None before the first."""
        self._controls, self._scene, self._background, self._cache = controls, scene, background, cache

    def show(self, scene_id: str | None, pose: Pose | None) -> bool:
        """Show a scene from behind a camera or, without one, from its initial view; return whether it changed.

        The splats follow with `send_splats`. Raises ServiceError, ValueError.
        """
        if scene_id is None or scene_id == self.scene_id:
            return False
        self._scene.show_scene(self._cache.get(scene_id), pose)
        self.scene_id = self._controls.scenes.value = scene_id
        # The splats are sent only after everything else.
        self._background.set_without_splats(True)
        self._background.set_scene(scene_id)
        self._describe()
        return True

    def send_splats(self) -> None:
        """Send the splats to the browser, which from now on draws the scene while the view moves."""
        self._scene.splats.send()
        self._background.set_without_splats(False)

    def show_photo(self, overlay: Overlay | None) -> None:
        """Show a photo over the view from its position; None: no photo."""
        self._controls.photo_opacity.visible = overlay is not None
        self._background.set_overlay(overlay)

    def measure(self, origin: Sequence[float], direction: Sequence[float]) -> None:
        """Take what a click's ray hits as a point of the measured distance."""
        self._scene.measure(origin, direction)

    def offer_prior(self) -> None:
        """Show a link to the start page, with the view of this moment as the next photo's prior."""
        if self.scene_id is not None:
            prior = {"world_from_camera": self._background.view.pose.world_from_camera.tolist()}
            self._controls.prior.content = prior_link_html(self.scene_id, prior)

    def set_layer_visible(self, name: LayerName, visible: bool) -> None:
        """Show or hide a layer. Raises ServiceError, ValueError."""
        self._scene.set_visible(name, visible)
        if name == "splats" and self.scene_id is not None:
            self._background.set_without_splats(not visible or self._scene.splats.pending)
            self._describe()

    def _describe(self) -> None:
        if self.scene_id is None:
            return
        content = self._cache.get(self.scene_id)
        drawn = len(content.splats.rgba) if self._controls.layers["splats"].value else 0
        name, cameras = content.description.name, len(content.description.cameras)
        self._controls.scene.content = scene_html(name, drawn, content.splats.total, cameras)
