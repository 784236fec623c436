"""The registry of scene formats, and what follows from it: suffixes, and the reader of a file."""

from __future__ import annotations

import logging
from pathlib import Path
from types import ModuleType

from service.plugins import PluginRegistry
from service.scene_formats.unread import UNREAD_SUFFIXES

SCENE_FORMATS = PluginRegistry("service.scene_formats", "splatfix.scene_formats", ("read", "accepts", "SUFFIXES"))
log = logging.getLogger(__name__)


def readable_suffixes() -> tuple[str, ...]:
    """Return the suffixes of all formats that can be read here, in lower case, e.g. `.ply`."""
    return tuple(dict.fromkeys(suffix for reader in SCENE_FORMATS.available() for suffix in reader.SUFFIXES))


def readable_names() -> tuple[str, ...]:
    """Return the file names that formats of several files have for the one that is opened, e.g. `meta.json`."""
    return tuple(name for reader in SCENE_FORMATS.available() for name in getattr(reader, "NAMES", ()))


def is_scene_file(path: Path) -> bool:
    """Whether a file's name is that of a scene, readable or known to be not; the file itself is not opened.

    Names that begin with a dot are none: macOS writes `._scene.ply` beside `scene.ply`.
    """
    return not path.name.startswith(".") and (suffix_of(path) in all_kinds() or path.name in readable_names())


def all_kinds() -> tuple[str, ...]:
    """Return the suffixes of scene files, readable or not."""
    return (*readable_suffixes(), *UNREAD_SUFFIXES)


def suffix_of(path: Path) -> str:
    """Return what a file's format is told by: a format's own name or suffix (`.ply.gz`), else the last suffix."""
    name = path.name.lower()
    if name in readable_names():
        return name
    return next((suffix for suffix in all_kinds() if name.endswith(suffix)), path.suffix.lower())


def reader_for(head: bytes, suffix: str) -> ModuleType | None:
    """Return the reader that accepts a file with these first bytes and this suffix; the built-in ones come first."""
    for reader in SCENE_FORMATS.available():
        try:
            if reader.accepts(head, suffix):
                return reader
        except Exception as error:  # an added reader must not keep the others from their files
            log.warning("the scene format %s can't examine a file: %s", reader.__name__, error)
    return None
