"""The scenes of a fleet: which there are, which may be used, and which of them a request names."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

from service.jobs.placement import Placement
from service.scene_manager.scene_errors import (
    nothing_to_search,
    scene_unloaded,
    too_large,
    unknown_scene,
    unnamed_scene,
)
from service.scene_manager.status import AUTO, MAX_RETRY_S, RETRY_S, StoredScene


@dataclass(slots=True)
class FleetScene:
    """One scene, wherever its copies are."""

    stored: StoredScene | None
    """None: it was set up in each replica."""
    required: bool = False
    awaited: bool = False
    """Required, and neither loaded nor failed yet."""
    wanted: bool = True
    """May be loaded; False after it was unloaded by request."""
    error: Exception | None = None
    """Why it failed to load last."""
    retry_at: float = 0.0
    """When a request has it loaded again after it failed, on the monotonic clock."""
    failures: int = 0
    """Since it was loaded last."""
    background_rgb: tuple[float, float, float] | None = None
    """As a replica said when the scene was held last; None before."""

    def loaded(self) -> None:
        """Note that a replica has loaded it."""
        self.error, self.failures = None, 0

    def failed(self, error: Exception) -> None:
        """Note that loading failed, and from when on it is tried again."""
        self.error, self.retry_at = error, time.monotonic() + min(RETRY_S * 2**self.failures, MAX_RETRY_S)
        self.failures += 1

    @property
    def recent_error(self) -> Exception | None:
        """Why it can't be used now; None: it is tried again, or did not fail."""
        return self.error if time.monotonic() < self.retry_at else None


class FleetScenes(dict[str, FleetScene]):
    """The scenes by their ids, in the order in which they were added."""

    def __init__(self, placement: Placement, budget_bytes: int | None) -> None:
        """`placement` knows where copies are and how large; `budget_bytes` is that of each replica."""
        super().__init__()
        self._placement, self._budget_bytes = placement, budget_bytes

    def named(self, scene_id: str | None) -> FleetScene:
        """Return a scene; None: the only one. Raises SceneNotFound."""
        if scene_id is None and len(self) == 1:
            return next(iter(self.values()))
        if scene_id is None:
            raise unnamed_scene()
        if scene_id not in self:
            raise unknown_scene(scene_id)
        return self[scene_id]

    def require_usable(self, scene_id: str) -> None:
        """Raise why a scene can't be used: it failed to load a short while ago, or was unloaded by request."""
        scene = self.named(scene_id)
        if error := scene.recent_error:
            raise error
        if not scene.wanted:
            raise scene_unloaded(scene_id)

    def chosen(self, asked: str | Sequence[str] | None) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return the scenes that a request names, and those that `auto` leaves out. Raises SceneError."""
        if asked == AUTO:
            return self._chosen_of_all()
        names = [asked] if asked is None or isinstance(asked, str) else asked
        found = [self.named(name) for name in names]
        # By identity: None names the only one, and a scene that is named twice is searched once.
        ids = tuple(name for name, scene in self.items() if any(scene is one for one in found))
        ids = tuple(sorted(ids, key=lambda name: names.index(name) if name in names else 0))
        if not self._placement.could_hold(ids):
            size = sum(map(self._placement.size, ids))
            raise too_large(f"scene '{ids[0]}' takes", size, self._budget_bytes or 0, "serve a smaller scene")
        return ids, ()

    def _chosen_of_all(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        candidates = [name for name, scene in self.items() if scene.wanted and scene.recent_error is None]
        # Those in memory first.
        candidates.sort(key=lambda name: not self._placement.copies(name))
        ids: tuple[str, ...] = ()
        for name in candidates:
            if self._placement.could_hold((*ids, name)):
                ids = (*ids, name)
        if not ids:
            raise nothing_to_search()
        return ids, tuple(name for name, scene in self.items() if scene.wanted and name not in ids)
