"""Tells an engine of the scenes that other fronts add to a catalogue in an object store, and of those they delete."""

from __future__ import annotations

import logging
import threading
from contextlib import suppress

from service.errors import SceneInUse, SceneNotFound, SplatfixError
from service.jobs.engine import Engine
from service.scene_manager.object_scene_store import ObjectSceneStore

_log = logging.getLogger(__name__)
_LOOK_S = 2.0


class CatalogueWatch:
    """Looks every two seconds, on a thread of its own, and whenever it is asked to."""

    def __init__(self, store: ObjectSceneStore, engine: Engine) -> None:
        self._store, self._engine = store, engine
        self._going: set[str] = set()
        """Deleted scenes that jobs still use here."""
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="catalogue of scenes", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        """Stop looking."""
        self._closing.set()
        self._thread.join(2 * _LOOK_S)

    def look(self) -> None:
        """Look once. Raises StorageFailed."""
        with self._lock:  # what one has seen changed, the next one takes for known
            self._look()

    def _look(self) -> None:
        found, gone = self._store.refresh()
        self._going |= set(gone)
        for scene in found:
            self._going.discard(scene.id)
            self._engine.add(scene)
            # As the front does that took the upload: who waits until the scene is ready may be answered by this one.
            with suppress(SceneNotFound):  # deleted meanwhile
                self._engine.load(scene.id)
            _log.info("scene %s is there now: another front has it", scene.id)
        for scene_id in tuple(self._going):
            try:
                self._engine.remove(scene_id)
                _log.info("scene %s is no more: another front has deleted it", scene_id)
            except SceneInUse:  # it goes with its last job
                continue
            except SceneNotFound:
                pass
            self._going.discard(scene_id)

    def _run(self) -> None:
        while not self._closing.wait(_LOOK_S):
            try:
                self.look()
            except SplatfixError as error:
                _log.warning("the catalogue of scenes can't be looked at: %s", error)
            except Exception:  # a bug must not end the thread
                _log.exception("the catalogue of scenes can't be looked at")
