"""Named points of scenes, kept with them: `anchors.json` beside a scene, or in the data folder."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64

from service.codec import decode, encode
from service.errors import AnchorNotFound, BadInput, CorruptScene, InvalidRequest
from service.scene_formats.side_file import SideFile
from service.scene_manager.status import StoredScene
from service.types import frozen

FILE = "anchors.json"
MAX_ANCHORS = 1000


@dataclass(frozen=True, slots=True)
class Anchor:
    """A point with a name."""

    name: str
    position_in_world: Float64[np.ndarray, "3"]
    """Scene units."""

    def __post_init__(self) -> None:
        position = frozen(np.asarray(self.position_in_world, np.float64))
        if position.shape != (3,) or not np.all(np.isfinite(position)):
            raise InvalidRequest("must be three finite numbers.", where="position", hint="E.g. [1.5, 0, 2].")
        object.__setattr__(self, "position_in_world", position)


@runtime_checkable
class AnchorStore(Protocol):
    """The anchors of all scenes. Safe to call from several threads."""

    def anchors(self, scene_id: str) -> tuple[Anchor, ...]:
        """Return a scene's anchors by name; none of a scene that isn't known. Raises CorruptScene."""
        ...

    def put(self, scene_id: str, anchor: Anchor) -> None:
        """Add an anchor, or move the one of that name.

        Raises BadInput for a scene without a file, and for too many anchors; CorruptScene, StorageFailed.
        """
        ...

    def delete(self, scene_id: str, name: str) -> None:
        """Delete an anchor. Raises AnchorNotFound, CorruptScene, StorageFailed."""
        ...


@dataclass(frozen=True, slots=True)
class _Anchors:
    anchors: tuple[Anchor, ...] = ()


class FileAnchorStore:
    """Implements `AnchorStore`."""

    def __init__(self, find: Callable[[str], StoredScene | None], data_folder: Path | None) -> None:
        """`find` returns where a scene lies, as `SceneStore.find`."""
        self._find, self._data_folder = find, data_folder
        self._lock = threading.Lock()

    def anchors(self, scene_id: str) -> tuple[Anchor, ...]:
        file = self._file(scene_id)
        return () if file is None else _read(file)

    def put(self, scene_id: str, anchor: Anchor) -> None:
        file = self._file(scene_id)
        if file is None:
            raise BadInput("the scene has no file to keep anchors with.", where="scene")
        with self._lock:
            file.forget_copy()
            others = tuple(other for other in _read(file) if other.name != anchor.name)
            if len(others) >= MAX_ANCHORS:
                raise BadInput(f"a scene has at most {MAX_ANCHORS} anchors.", where="name", hint="Delete some first.")
            file.write(encode(_Anchors(tuple(sorted((*others, anchor), key=lambda one: one.name)))))

    def delete(self, scene_id: str, name: str) -> None:
        file = self._file(scene_id)
        with self._lock:
            if file is not None:
                file.forget_copy()
            before = () if file is None else _read(file)
            after = tuple(anchor for anchor in before if anchor.name != name)
            if file is None or len(after) == len(before):
                raise AnchorNotFound(f"anchor '{name[:64]}' not found.", where="name")
            file.write(encode(_Anchors(after)))

    def _file(self, scene_id: str) -> SideFile | None:
        scene = self._find(scene_id)
        return None if scene is None else SideFile(scene.path, FILE, self._data_folder, scene.remote)


def _read(file: SideFile) -> tuple[Anchor, ...]:
    try:
        return decode(_Anchors, file.path.read_text("utf-8")).anchors
    except (FileNotFoundError, NotADirectoryError):
        return ()
    except (OSError, ValueError, KeyError, TypeError, AttributeError, InvalidRequest) as error:
        raise CorruptScene(
            f"no anchors can be read: {str(error)[:200]}.", where=file.path.name, hint="Correct or delete it."
        ) from None
