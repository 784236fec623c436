"""The coverage maps of a process' scenes: measured one after the other in the background, read from the cache."""

from __future__ import annotations

import logging
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from service.coverage.coverage_cache import coverage_file, read_coverage, write_coverage
from service.coverage.coverage_map import CoverageMap
from service.coverage.held_out_photos import HeldOutPhoto, held_out_photos
from service.coverage.measurement import Measurement, measured_coverage
from service.errors import Failure, SplatfixError
from service.loaded_scene import LoadedScene
from service.localize import Cancelled
from service.scene_manager.manager import Scenes
from service.scene_manager.status import CoverageStatus

_log = logging.getLogger(__name__)


@dataclass(slots=True)
class _Run:
    """A measurement that waits, runs, or has ended."""

    sha256: str
    status: CoverageStatus = field(default_factory=lambda: CoverageStatus("running"))
    cancel: threading.Event = field(default_factory=threading.Event)


class SceneCoverages:
    """Safe to use from several threads."""

    def __init__(self, scenes: Scenes) -> None:
        self._scenes = scenes
        self._runs: dict[str, _Run] = {}
        self._read: dict[Path, CoverageMap | None] = {}
        self._lock = threading.Lock()
        # One thread: a measurement has all cores by itself.
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="coverages")

    def close(self) -> None:
        """End the measurements, between two photos."""
        for run in list(self._runs.values()):
            run.cancel.set()
        self._pool.shutdown(wait=True, cancel_futures=True)

    def of(self, scene_id: str) -> CoverageStatus:
        """Return the map of a scene, or how far it is measured. Raises SceneNotFound."""
        entry = self._scenes.entry(scene_id)
        run, loaded = self._runs.get(scene_id), entry.loaded
        if run is not None and (loaded is None or run.sha256 == loaded.scene.info.sha256):
            return run.status
        if loaded is None or entry.path is None:
            return CoverageStatus("none")
        with suppress(SplatfixError):  # `measure` reports what is wrong with the folder
            found = self._stored(loaded, held_out_photos(entry.path))
            if found is not None:
                return CoverageStatus("ready", found=found)
        return CoverageStatus("none")

    def measure(self, scene_id: str) -> CoverageStatus:
        """Begin to measure a scene's map anew, unless that is under way. Raises SceneError."""
        with self._lock:
            run = self._runs.get(scene_id)
            # One that is being cancelled leaves no map: who asks now wants another.
            if run is not None and run.status.state == "running" and not run.cancel.is_set():
                return run.status
            # Held until it ends, so that it isn't dropped for want of memory.
            (loaded,) = self._scenes.acquire([scene_id]).scenes
            run = self._runs[scene_id] = _Run(loaded.scene.info.sha256)
            self._pool.submit(self._work, scene_id, run, loaded)
            return run.status

    def cancel(self, scene_id: str) -> CoverageStatus:
        """End the measurement of a scene's map, if one waits or runs, between two photos; a map that was stored before
        stays. Raises SceneNotFound."""
        self._scenes.entry(scene_id)
        run = self._runs.get(scene_id)
        if run is not None:
            run.cancel.set()
        return self.of(scene_id)

    def _work(self, scene_id: str, run: _Run, loaded: LoadedScene) -> None:
        began = time.monotonic()

        def progress(done: int, total: int) -> None:
            nonlocal began
            if not done:
                # What came before the trials is done once, and says nothing of those that are left.
                began = time.monotonic()
            remaining_s = (time.monotonic() - began) * (total / done - 1) if done else None
            run.status = replace(run.status, done=done, total=total, remaining_s=remaining_s)

        def partial(tried: CoverageMap) -> None:
            run.status = replace(run.status, partial=tried)

        try:
            if run.cancel.is_set():
                raise Cancelled
            path = self._scenes.entry(scene_id).path
            held_out = held_out_photos(path) if path else []
            found = measured_coverage(loaded, Measurement(held_out, progress, partial, run.cancel))
            file = self._file(loaded, held_out)
            if file:
                write_coverage(found, file)
                self._read[file] = found
            run.status = CoverageStatus("ready", found=found)
        except Cancelled:
            # Without it `of` answers with the stored map, if there is one.
            with self._lock:
                if self._runs[scene_id] is run:
                    del self._runs[scene_id]
        except Exception as error:  # one bad scene must not take the others with it
            unexpected = not isinstance(error, SplatfixError)
            _log.error("no coverage map of scene %s: %s", scene_id, error, exc_info=unexpected)
            run.status = CoverageStatus("failed", failure=Failure.of(error))
        finally:
            self._scenes.release([loaded])

    def _stored(self, loaded: LoadedScene, held_out: list[HeldOutPhoto]) -> CoverageMap | None:
        file = self._file(loaded, held_out)
        if file is None:
            return None
        if self._read.get(file) is None and file.is_file():
            self._read[file] = read_coverage(file)
        return self._read.get(file)

    def _file(self, loaded: LoadedScene, held_out: list[HeldOutPhoto]) -> Path | None:
        names = loaded.rasterizer.name, loaded.matcher.name
        return loaded.cache_dir and coverage_file(loaded.cache_dir, loaded.searched, *names, held_out)
