"""Named arrays as a folder of memory-mapped `.npy` files, written whole or not at all.

They are written by `numpy.save` and opened as plain numbers, no objects. The folder belongs to a cache: what can't be
opened is made again by who asked for it.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Literal

import numpy as np


def write_arrays(folder: Path, arrays: Mapping[str, np.ndarray], texts: Mapping[str, str] | None = None) -> None:
    """Write NAME.npy for each array, and the texts as files of their names. Raises OSError and leaves nothing then."""
    # Written beside its place and renamed: another process sees all of it or nothing.
    draft = folder.with_name(f"{folder.name}.{os.getpid()}")
    shutil.rmtree(draft, ignore_errors=True)
    draft.mkdir(parents=True)
    try:
        for name, array in arrays.items():
            np.save(draft / f"{name}.npy", array, allow_pickle=False)
        for name, text in (texts or {}).items():
            (draft / name).write_text(text, "utf-8")
        draft.replace(folder)
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def open_arrays(folder: Path, names: Iterable[str], mode: Literal["r", "c"] = "r") -> dict[str, np.ndarray]:
    """Map the arrays of a folder: read-only, or with `c` as if writable, where nothing gets into the file.

    Raises FileNotFoundError where one isn't there, ValueError or another OSError where one is damaged.
    """
    try:
        return {name: np.load(folder / f"{name}.npy", mmap_mode=mode, allow_pickle=False) for name in names}
    except EOFError as error:  # numpy's for a file without a header
        raise ValueError(str(error)) from error
