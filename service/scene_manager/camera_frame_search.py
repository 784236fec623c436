"""Looks for the camera frames of loaded scenes in the background, one scene at a time."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from pathlib import Path

from service.errors import SplatfixError
from service.scene_manager.camera_frame import found_camera_frame, is_sought
from service.scene_manager.entry import Entry

_log = logging.getLogger(__name__)
_GRACE_S = 2.0


class CameraFrameSearch:
    """A thread that localizes training photos of scenes whose cameras were left out; each scene once a process."""

    def __init__(self, found: Callable[[Entry], None]) -> None:
        """`found` is called on the thread when a scene's file of its camera frame was written."""
        self._found = found
        self._considered: set[Path] = set()
        self._queue: list[Entry] = []
        self._wake = threading.Condition()
        self._stopped = False
        self._thread: threading.Thread | None = None

    def consider(self, entry: Entry) -> None:
        """Look for a loaded scene's camera frame, if it has cameras that fit nowhere and their photos."""
        loaded, path = entry.loaded, entry.path
        if loaded is None or path is None or path in self._considered:
            return
        self._considered.add(path)
        try:
            sought = is_sought(loaded, path)
        except SplatfixError as error:  # the scene is in use all the same
            _log.warning("scene %s: its camera file can't be read again (%s)", entry.id, error)
            return
        if not sought:
            return
        with self._wake:
            self._queue.append(entry)
            self._wake.notify()
            if self._thread is None:
                self._thread = threading.Thread(target=self._work, name="camera frames", daemon=True)
                self._thread.start()

    def close(self) -> None:
        """Stop between two photos; return then, or soon anyway."""
        with self._wake:
            self._stopped = True
            self._wake.notify()
        if self._thread is not None:
            self._thread.join(_GRACE_S)

    def _work(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._queue or self._stopped)
                if self._stopped:
                    return
                entry = self._queue.pop(0)
            try:
                self._search(entry)
            except Exception as error:  # the next scene may be found
                unexpected = not isinstance(error, SplatfixError)
                _log.error("scene %s: its camera frame can't be looked for: %s", entry.id, error, exc_info=unexpected)

    def _search(self, entry: Entry) -> None:
        loaded, path = entry.loaded, entry.path
        if loaded is None or path is None:
            return
        found = found_camera_frame(loaded, path, go_on=lambda: not self._stopped and entry.loaded is loaded)
        if found is None:
            _log.info("scene %s: the camera frame could not be determined by its photos", entry.id)
            return
        found.write(path)
        _log.info("scene %s: the camera frame was found by %d photos", entry.id, found.agreeing)
        self._found(entry)
