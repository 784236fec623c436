"""Scenes as the viewer draws them, shared by all browsers."""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass

from service.client import Client
from viewer.camera_views import SceneExtent, scene_extent
from viewer.service_values import SceneDescription, Splats, description_of, parse_splats

MAX_SPLATS = 400_000
"""Splats drawn of a scene: 13 MB for each browser, fluent on an integrated GPU."""
_SCENES_KEPT = 2


@dataclass(frozen=True, slots=True)
class SceneContent:
    """What is drawn of a scene."""

    description: SceneDescription
    splats: Splats
    extent: SceneExtent


class SceneCache:
    """The scenes that were shown last. Safe to use from several threads."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._scenes: OrderedDict[str, SceneContent] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, scene_id: str) -> SceneContent:
        """Return a scene from the cache or the service. Raises ServiceError, ValueError."""
        with self._lock:
            if scene_id in self._scenes:
                self._scenes.move_to_end(scene_id)
                return self._scenes[scene_id]
        # Outside the lock, as the requests may take seconds.
        description = description_of(self._client.scene(scene_id))
        splats = parse_splats(self._client.splats(scene_id, MAX_SPLATS))
        cameras = [named.camera for named in description.cameras]
        content = SceneContent(description, splats, scene_extent(splats.centres, cameras, description.up_in_world))
        with self._lock:
            self._scenes[scene_id] = content
            if len(self._scenes) > _SCENES_KEPT:
                self._scenes.popitem(last=False)
        return content
