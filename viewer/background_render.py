"""Exact renders: where the view rests, the service's renderer draws it, view-dependent colours and all.

The browser's own splats have neither view-dependent colour nor all Gaussians; what the estimator sees is what the
service renders. The picture lies behind everything else, and the splats are hidden while it is there. In a browser
that has no splats, not yet or because it has no GPU, the service draws the view while it moves too, smaller.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

import numpy as np
import viser
import viser.transforms as vt
from jaxtyping import UInt8

from service.types import Camera, Intrinsics, Pose
from viewer.comparison_images import decode
from viewer.service_client import ServiceClient, ServiceError

log = logging.getLogger(__name__)

_REST_S = 0.4
_LONG_SIDE_PX, _MOVING_PX = 1280, 480


Show = Callable[[UInt8[np.ndarray, "h w 3"] | None], None]


class BackgroundRender:
    """One browser's. Its thread sleeps until the view has moved; `close` ends it."""

    def __init__(self, client: viser.ClientHandle, service: ServiceClient, show: Show) -> None:
        """`show` puts a picture in the place of the browser's splats, and with None the splats back."""
        self._client, self._service, self._show = client, service, show
        self._scene_id: str | None = None
        self._wanted = True
        self._alone = True
        self._moves = 0
        self._view: Camera | None = None
        """Where the browser was last seen."""
        self._showing = False
        self._closed = False
        self._changed = threading.Condition()

    def start(self) -> None:
        async def moved(_: object) -> None:  # async: runs on viser's own loop, not in its pool of threads
            if not _alike(self._view, self._camera()):  # not the echo of a view that was set from here
                self.moved()

        self._client.camera.on_update(moved)
        threading.Thread(target=self._run, name=f"exact-{self._client.client_id}", daemon=True).start()

    def close(self) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify()

    def use(self, scene_id: str) -> None:
        """Draw this scene from now on."""
        with self._changed:
            self._scene_id = scene_id
        self.moved()

    def want(self, wanted: bool) -> None:
        with self._changed:
            self._wanted = wanted
        self.moved()

    def stand_alone(self, alone: bool) -> None:
        """Whether there are no splats to see while the view moves."""
        with self._changed:
            self._alone = alone
        self.moved()

    def moved(self) -> None:
        """Give the view back to the browser's splats until it rests again."""
        with self._changed:
            self._moves += 1
            if self._showing and not (self._alone and self._wanted):
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
                move, alone = self._moves, self._alone
            if alone:
                self._draw(move, _MOVING_PX)
            if self._rests(move):
                self._draw(move, _LONG_SIDE_PX)
                done = move

    def _rests(self, move: int) -> bool:
        with self._changed:
            return not self._changed.wait_for(lambda: self._closed or self._moves != move, _REST_S)

    def _draw(self, move: int, long_side_px: int) -> None:
        with self._changed:
            scene_id, alone = self._scene_id if self._wanted else None, self._alone
        if scene_id is None:
            return
        self._view = self._camera()
        try:
            picture = decode(self._service.picture(scene_id, self._camera(long_side_px)))
        except (ServiceError, ValueError) as error:
            log.warning("no exact render: %s", error)
            return
        with self._changed:
            # While it moves, a picture that is a moment old is better than none.
            if not self._closed and self._scene_id == scene_id and (self._moves == move or (alone and self._alone)):
                self._showing = True
                self._show(picture)

    def _camera(self, long_side_px: int = _LONG_SIDE_PX) -> Camera:
        """The browser's camera, no larger than need be."""
        camera = self._client.camera
        factor = min(1.0, long_side_px / max(camera.image_width, camera.image_height, 1))
        width, height = max(1, round(camera.image_width * factor)), max(1, round(camera.image_height * factor))
        focal = 0.5 * height / float(np.tan(0.5 * camera.fov))
        matrix = np.eye(4)
        matrix[:3, :3] = vt.SO3(camera.wxyz).as_matrix()
        matrix[:3, 3] = camera.position
        return Camera(Intrinsics(width, height, focal, focal, 0.5 * width, 0.5 * height), Pose(matrix))


def _alike(a: Camera | None, b: Camera) -> bool:
    """Whether two cameras show the same, but for the digits that are lost on the way to a browser and back."""
    if a is None or (a.intrinsics.width, a.intrinsics.height) != (b.intrinsics.width, b.intrinsics.height):
        return False
    same_lens = abs(a.intrinsics.fy / b.intrinsics.fy - 1) < 1e-4
    return same_lens and bool(np.allclose(a.pose.world_from_camera, b.pose.world_from_camera, rtol=1e-4, atol=1e-5))
