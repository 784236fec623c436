"""Gauges of `/metrics` that are read at each scrape: queue, workers, scenes, readiness, disks."""

from __future__ import annotations

import shutil
from contextlib import suppress
from pathlib import Path

from service.disk_cache import cache_bytes
from service.jobs.engine import Engine
from service.jobs.service import Jobs
from service.web.metrics import Metrics
from service.web.settings import Settings


def add_gauges(metrics: Metrics, settings: Settings, engine: Engine, jobs: Jobs, data_folder: Path) -> None:
    """Add the gauges to the metrics of an app."""
    metrics.gauge("jobs_queued", "Queued jobs", (), lambda: {(): jobs.waiting()})
    metrics.gauge("jobs_running", "Running jobs", (), lambda: {(): jobs.running()})
    metrics.gauge("workers", "Worker threads", (), lambda: {(): settings.jobs_at_once})
    metrics.gauge("workers_stuck", "Stuck workers", (), lambda: {(): jobs.stuck_workers()})
    metrics.gauge("scene_bytes", "Memory of a loaded scene", ("scene",), lambda: _scene_bytes(engine))
    metrics.gauge("ready", "1: photos can be localized now, as /readyz says", (), lambda: {(): _ready(engine, jobs)})
    folders = {"data": data_folder, "cache": settings.cache_dir}
    metrics.gauge("disk_free_bytes", "Free space where a folder is", ("folder",), lambda: _free(folders))
    if cache := settings.cache_dir:
        limit = settings.cache_bytes
        metrics.gauge("cache_bytes", "Size of view indexes, mapped scenes and coverage maps", (), lambda: _size(cache))
        metrics.gauge("cache_limit_bytes", "What the cache may take once a scene is loaded", (), lambda: {(): limit})


def _scene_bytes(engine: Engine) -> dict[tuple[str, ...], float]:
    return {(scene.id,): float(scene.memory_bytes) for scene in engine.scenes() if scene.memory_bytes is not None}


def _ready(engine: Engine, jobs: Jobs) -> float:
    return float(engine.readiness().ready and not jobs.problems())


def _size(cache: Path) -> dict[tuple[str, ...], float]:
    return {(): float(cache_bytes(cache))}


def _free(folders: dict[str, Path | None]) -> dict[tuple[str, ...], float]:
    found: dict[tuple[str, ...], float] = {}
    for name, folder in folders.items():
        with suppress(OSError):  # it isn't there before something is put into it
            if folder is not None:
                found[(name,)] = float(shutil.disk_usage(folder).free)
    return found
