"""Exact renders: where the view rests, the service's renderer draws it, view-dependent colours and all.

The browser's own splats have neither view-dependent colour nor all Gaussians; what the estimator sees is what the
service renders. The picture lies behind everything else, and the splats are hidden while it is there.
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
from viewer.client import Service, ServiceTrouble
from viewer.draw import decode

log = logging.getLogger(__name__)

_REST_S = 0.4
_LONG_SIDE_PX = 1280


Show = Callable[[UInt8[np.ndarray, "h w 3"] | None], None]


class ExactView:
    """One browser's. Its thread sleeps until the view has moved; `close` ends it."""

    def __init__(self, client: viser.ClientHandle, service: Service, show: Show) -> None:
        """`show` puts a picture in the place of the browser's splats, and with None the splats back."""
        self._client, self._service, self._show = client, service, show
        self._scene_id: str | None = None
        self._wanted = True
        self._moves = 0
        self._showing = False
        self._closed = False
        self._changed = threading.Condition()

    def start(self) -> None:
        async def moved(_: object) -> None:  # async: runs on viser's own loop, not in its pool of threads
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

    def moved(self) -> None:
        """Give the view back to the browser's splats until it rests again."""
        with self._changed:
            self._moves += 1
            if self._showing:
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
                done = self._moves
                # Resting means that this wait ends without another move.
                if self._changed.wait_for(lambda done=done: self._closed or self._moves != done, _REST_S):
                    done -= 1
                    continue
                scene_id = self._scene_id if self._wanted else None
            if scene_id is not None:
                self._draw(scene_id, done)

    def _draw(self, scene_id: str, move: int) -> None:
        try:
            picture = decode(self._service.picture(scene_id, self._camera()))
        except (ServiceTrouble, ValueError) as error:
            log.warning("no exact render: %s", error)
            return
        with self._changed:
            if not self._closed and self._moves == move:
                self._showing = True
                self._show(picture)

    def _camera(self) -> Camera:
        """The browser's camera, no larger than need be."""
        camera = self._client.camera
        factor = min(1.0, _LONG_SIDE_PX / max(camera.image_width, camera.image_height, 1))
        width, height = max(1, round(camera.image_width * factor)), max(1, round(camera.image_height * factor))
        focal = 0.5 * height / float(np.tan(0.5 * camera.fov))
        matrix = np.eye(4)
        matrix[:3, :3] = vt.SO3(camera.wxyz).as_matrix()
        matrix[:3, 3] = camera.position
        return Camera(Intrinsics(width, height, focal, focal, 0.5 * width, 0.5 * height), Pose(matrix))
