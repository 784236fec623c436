"""The registry of scene formats, and what follows from it: suffixes, and the reader of a file."""

from __future__ import annotations

import logging
from pathlib import Path
from types import ModuleType

from service.plugins import PluginRegistry

SCENE_FORMATS = PluginRegistry("service.scene_formats", "splatfix.scene_formats", ("read", "accepts", "SUFFIXES"))
_UNREAD_SUFFIXES = (".spz", ".ksplat", ".sog")
"""Of scene formats without a reader here: such a file is refused by name, not overlooked."""
log = logging.getLogger(__name__)


def readable_suffixes() -> tuple[str, ...]:
    """Return the suffixes of all formats that can be read here, in lower case, e.g. `.ply`."""
    return tuple(dict.fromkeys(suffix for reader in SCENE_FORMATS.available() for suffix in reader.SUFFIXES))


def is_scene_file(path: Path) -> bool:
    """Whether a file's name has the suffix of a scene format, readable or not; the file itself is not opened."""
    return path.suffix.lower() in (*readable_suffixes(), *_UNREAD_SUFFIXES)


def reader_for(head: bytes, suffix: str) -> ModuleType | None:
    """Return the reader that accepts a file with these first bytes and this suffix; the built-in ones come first."""
    for reader in SCENE_FORMATS.available():
        try:
            if reader.accepts(head, suffix):
                return reader
        except Exception as error:  # an added reader must not keep the others from their files
            log.warning("the scene format %s can't examine a file: %s", reader.__name__, error)
    return None
