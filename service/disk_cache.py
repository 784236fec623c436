"""The folder of what can be had again: view indexes, coverage maps, scenes in mappable form, and those
fetched from an object store. It has a size limit.

Whoever reads or writes an entry marks it as used; what was not used for longest goes first. Compiled kernels, which are
in the same folder, are small and stay.
"""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

_PATTERNS = ("view-index-*", "free-views-*", "coverage-*.json", "scenes/*", "fetched-scenes/*")
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class _Entry:
    path: Path
    size: int
    used: float


def mark_used(entry: Path) -> None:
    """Note that a file or folder of the cache is used now; without effect on a folder that can't be written."""
    with suppress(OSError):
        os.utime(entry)


def cache_bytes(folder: Path) -> int:
    """Return the size of all entries."""
    return sum(entry.size for entry in _entries(folder))


def evict(folder: Path, most_bytes: int) -> int:
    """Delete the entries that were not used for longest until the others take at most so much; return how many.

    Entries that are open stay readable to whoever has them open, or, on Windows, stay.
    """
    # By the modification time, which `mark_used` sets: processes that share the folder need no list in common.
    entries = sorted(_entries(folder), key=lambda entry: entry.used)
    excess, deleted = sum(entry.size for entry in entries) - most_bytes, 0
    for entry in entries:
        if excess <= 0:
            break
        if _delete(entry.path):
            excess, deleted = excess - entry.size, deleted + 1
            _log.info("cache: %s (%.1f MB) is deleted", entry.path.name, entry.size / 1e6)
    return deleted


def _entries(folder: Path) -> Iterator[_Entry]:
    for pattern in _PATTERNS:
        for path in folder.glob(pattern):
            with suppress(OSError):  # another process has deleted it meanwhile
                files = [file for file in path.rglob("*") if file.is_file()] if path.is_dir() else [path]
                yield _Entry(path, sum(file.stat().st_size for file in files), path.stat().st_mtime)


def _delete(path: Path) -> bool:
    try:
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
    except OSError as error:
        _log.warning("cache: %s can't be deleted: %s", path.name, error)
        return False
    return True
