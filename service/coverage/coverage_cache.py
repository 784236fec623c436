"""Coverage maps on disk, beside the view indexes: a file's name is a hash of all that a map depends on."""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from service.codec import decode, encode
from service.coverage.coverage_map import CoverageMap
from service.coverage.held_out_photos import HeldOutPhoto
from service.coverage.measurement import COVERAGE, CoverageConfig
from service.disk_cache import mark_used
from service.types import GaussianScene

VERSION = 2
"""Raise it with any change of the code that makes stored maps differ from fresh ones; the key covers the configs."""
_log = logging.getLogger(__name__)


def coverage_file(
    cache_dir: Path,
    searched: GaussianScene,
    rasterizer: str,
    matcher: str,
    held_out: Sequence[HeldOutPhoto] = (),
    config: CoverageConfig = COVERAGE,
) -> Path:
    """Return the file of a scene's map; `searched` is the scene that photos are localized in (`LoadedScene`)."""
    # Floaters are left out by an opacity of 0: the file's hash doesn't show which were.
    visible = int(np.count_nonzero(searched.opacities))
    photos = [(photo.name, *_stamp(photo.path)) for photo in held_out]
    parts = (VERSION, searched.info.sha256, visible, len(searched.cameras), rasterizer, matcher, config, photos)
    return cache_dir / f"coverage-{hashlib.sha256(repr(parts).encode()).hexdigest()[:24]}.json"


def read_coverage(path: Path) -> CoverageMap | None:
    """Return a stored map; None if there is none, or none that can be read."""
    try:
        found = decode(CoverageMap, path.read_text("utf-8"))
        mark_used(path)
        return found
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        _log.warning("the coverage map is measured again: %s can't be read (%s)", path.name, error)
        return None


def write_coverage(found: CoverageMap, path: Path) -> None:
    """Store a map; a disk that refuses is logged, for the map is there without it."""
    # Renamed when it is whole, so that no reader sees half a map; two processes that measure it write two drafts.
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        draft.write_text(encode(found), encoding="utf-8")
        draft.replace(path)
    except OSError as error:
        _log.warning("the coverage map can't be stored: %s", error)
    finally:
        draft.unlink(missing_ok=True)


def _stamp(path: Path) -> tuple[int, int]:
    # Size and time: hashing all photos would take longer than reading the map.
    facts = path.stat()
    return facts.st_size, facts.st_mtime_ns
