"""Reads known places from a file or a folder, by whichever reader recognizes its content."""

from __future__ import annotations

from pathlib import Path

from service.errors import InvalidRequest, SceneError
from service.registration.known_places import ar_session, colmap_places, place_table, record3d, trajectory_places
from service.registration.known_places.known_place import KnownPlaces

_TEXTS = (record3d, ar_session, place_table, trajectory_places)
"""Readers of text files, the most particular first."""
_MAX_BYTES = 256 * 1024 * 1024
_HEAD_CHARACTERS = 100_000


def read_places(path: Path) -> KnownPlaces:
    """Return the known places of a file: a table (CSV, JSON), a TUM trajectory, transforms.json of an AR recorder,
    Record3D's metadata; or of a folder: a COLMAP model. Raises InvalidRequest."""
    try:
        if path.is_dir():
            return colmap_places.read(path)
        if path.stat().st_size > _MAX_BYTES:
            raise InvalidRequest(f"larger than {_MAX_BYTES} bytes.", where=path.name)
        text = path.read_text("utf-8-sig")
    except OSError as error:
        raise InvalidRequest(f"{error.strerror}.", where=str(path)) from None
    except UnicodeDecodeError:
        raise InvalidRequest("not UTF-8 text.", where=path.name, hint=_WHAT) from None
    except SceneError as error:
        raise InvalidRequest(error.message, where=error.where, hint=error.hint) from None
    reader = next((r for r in _TEXTS if r.accepts(text[:_HEAD_CHARACTERS], path.name)), None)
    if reader is None:
        raise InvalidRequest("not a file of known places.", where=path.name, hint=_WHAT)
    return reader.read(text, path.name)


_WHAT = (
    "Give a CSV table with the columns name,x,y,z or name,latitude,longitude,height; transforms.json; Record3D's "
    "metadata; a TUM trajectory; or the folder of a COLMAP model."
)
