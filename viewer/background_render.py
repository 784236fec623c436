"""Renders of the service as the background of a browser's 3D view.

The browser's own splats have no view-dependent colour and may be a part of the scene's Gaussians; a render of the
service is what the estimators compare photos with. Once the view rests it is rendered at full size, and the splats are
hidden meanwhile. In a browser that has no splats, not yet or because it lacks a GPU, the view is rendered while it
moves, too, in a smaller size.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import viser
import viser.transforms as vt
from jaxtyping import UInt8

from service.client import Client, ServiceError
from service.types import Camera, Intrinsics, Pose
from viewer.comparison_images import decode, with_photo
from viewer.service_values import api_camera

log = logging.getLogger(__name__)

_REST_S = 0.4
"""Time without a movement after which the view rests."""
_LONG_SIDE_PX, _MOVING_LONG_SIDE_PX = 1280, 480


ShowImage = Callable[[UInt8[np.ndarray, "h w 3"] | None], None]


@dataclass(frozen=True, slots=True)
class Overlay:
    """A photo that is shown over renders from its own position."""

    photo: UInt8[np.ndarray, "h w 3"]
    camera: Camera
    """Of the photo, which is undistorted; a pinhole."""

    def fits(self, view: Camera) -> bool:
        """Return whether a view is from the photo's position, and shows what the photo may show."""
        ours, theirs = self.camera.pose, view.pose
        same_place = np.allclose(ours.position_in_world, theirs.position_in_world, rtol=1e-4, atol=1e-4)
        return bool(same_place) and float(ours.axis_in_world @ theirs.axis_in_world) > 0.5


class BackgroundRender:
    """Belongs to one browser. Its thread sleeps until the view has moved; `close` ends it."""

    def __init__(self, client: viser.ClientHandle, service: Client, show: ShowImage) -> None:
        """`show` draws an image instead of the browser's splats; `show(None)` draws the splats again."""
        self._client, self._service, self._show = client, service, show
        self._scene_id: str | None = None
        self._enabled = True
        self._without_splats = True
        self._moves = 0
        """Number of the view's movements so far."""
        self._view: Camera | None = None
        """The browser's camera at the last render."""
        self._showing = False
        self._overlay: Overlay | None = None
        self._opacity = 0.5
        self._rendered: tuple[UInt8[np.ndarray, "h w 3"], Camera] | None = None
        """The last render, without the photo, and its camera."""
        self._closed = False
        self._changed = threading.Condition()

    def start(self) -> None:
        """Start the thread, and watch the browser's camera."""

        async def camera_updated(_: object) -> None:  # async: runs on viser's event loop, not in its pool of threads
            if not _same_view(self._view, self._camera()):  # a browser repeats a view that was set from here
                self.moved()

        self._client.camera.on_update(camera_updated)
        threading.Thread(target=self._run, name=f"background-{self._client.client_id}", daemon=True).start()

    def close(self) -> None:
        """End the thread."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def set_scene(self, scene_id: str) -> None:
        """Render this scene from now on."""
        with self._changed:
            self._scene_id = scene_id
        self.moved()

    @property
    def view(self) -> Camera:
        """The browser's camera."""
        return self._camera()

    def set_overlay(self, overlay: Overlay | None) -> None:
        """Show a photo over the renders from its position; None: no photo."""
        with self._changed:
            before, self._overlay = self._overlay, overlay
        if before is not overlay:
            self.moved()

    def set_opacity(self, opacity: float) -> None:
        """Choose the opacity of the photo, 0..1."""
        with self._changed:
            self._opacity = opacity
            if self._showing and self._rendered is not None:
                self._show(self._with_overlay(*self._rendered))

    def set_enabled(self, enabled: bool) -> None:
        """Render at all, or leave the view to the browser's splats."""
        with self._changed:
            self._enabled = enabled
        self.moved()

    def set_without_splats(self, without: bool) -> None:
        """Render while the view moves, too, since the browser shows no splats."""
        with self._changed:
            self._without_splats = without
        self.moved()

    def moved(self) -> None:
        """Show the browser's splats, where there are any, until the view rests again."""
        with self._changed:
            self._moves += 1
            # Without splats the old render stays until the next one, rather than an empty view.
            if self._showing and not (self._without_splats and self._enabled):
                self._showing = False
                self._show(None)
            self._changed.notify()

    def _run(self) -> None:
        done = 0
        while True:
            with self._changed:
                self._changed.wait_for(lambda done=done: self._closed or self._moves != done)
                if self._closed:
                    return
                move, without_splats = self._moves, self._without_splats
            if without_splats:
                self._render(move, _MOVING_LONG_SIDE_PX)
            if self._rests(move):
                self._render(move, _LONG_SIDE_PX)
                done = move

    def _rests(self, move: int) -> bool:
        with self._changed:
            return not self._changed.wait_for(lambda: self._closed or self._moves != move, _REST_S)

    def _render(self, move: int, long_side_px: int) -> None:
        with self._changed:
            enabled = self._enabled or self._overlay is not None
            scene_id, without_splats = self._scene_id if enabled else None, self._without_splats
        if scene_id is None:
            return
        # At full size whatever the size of this render: only then it compares equal to the browser's next report.
        self._view = self._camera()
        camera = self._camera(long_side_px)
        try:
            image = decode(self._service.render(scene_id, *api_camera(camera)))
        except (ServiceError, ValueError) as error:
            log.warning("no full-quality render: %s", error)
            return
        with self._changed:
            if self._closed or self._scene_id != scene_id:
                return
            # Without splats, a render of a moment ago is better than an empty view.
            if self._moves == move or (without_splats and self._without_splats):
                self._showing, self._rendered = True, (image, camera)
                self._show(self._with_overlay(image, camera))

    def _with_overlay(self, image: UInt8[np.ndarray, "h w 3"], view: Camera) -> UInt8[np.ndarray, "h w 3"]:
        overlay = self._overlay
        if overlay is None or not overlay.fits(view):
            return image
        return with_photo(image, view, overlay.photo, overlay.camera, self._opacity)

    def _camera(self, long_side_px: int = _LONG_SIDE_PX) -> Camera:
        """Return the browser's camera with an image of at most this size."""
        camera = self._client.camera
        # A browser that hasn't reported its size yet has 0.
        factor = min(1.0, long_side_px / max(camera.image_width, camera.image_height, 1))
        width, height = max(1, round(camera.image_width * factor)), max(1, round(camera.image_height * factor))
        focal = 0.5 * height / float(np.tan(0.5 * camera.fov))
        matrix = np.eye(4)
        matrix[:3, :3] = vt.SO3(camera.wxyz).as_matrix()
        matrix[:3, 3] = camera.position
        return Camera(Intrinsics(width, height, focal, focal, 0.5 * width, 0.5 * height), Pose(matrix))


def _same_view(a: Camera | None, b: Camera) -> bool:
    """Return whether two cameras are equal up to the rounding of a round trip to the browser."""
    if a is None or (a.intrinsics.width, a.intrinsics.height) != (b.intrinsics.width, b.intrinsics.height):
        return False
    same_focal = abs(a.intrinsics.fy / b.intrinsics.fy - 1) < 1e-4
    return same_focal and bool(np.allclose(a.pose.world_from_camera, b.pose.world_from_camera, rtol=1e-4, atol=1e-5))
