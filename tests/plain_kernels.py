"""The kernels as plain Python on numpy arrays: what they compute, without the compiler.

`plain` copies the functions of a kernel module with their own source. What `service.render.simd` gives them are the
functions below: a vector is a numpy array of 16 values.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from types import FunctionType, SimpleNamespace
from typing import Any

import numpy as np
from numba.core.dispatcher import Dispatcher

LANES = 16


@cache
def plain(name: str) -> Any:
    """Return a module's kernels, and the constants beside them, under their names."""
    found = dict(vars(import_module(name)))
    for key, value in list(found.items()):
        if key in VECTORS and getattr(value, "__module__", "").startswith(("numba", "service.render.simd")):
            found[key] = VECTORS[key]
        elif isinstance(value, Dispatcher):
            function = value.py_func
            own = function.__module__ == name
            found[key] = FunctionType(function.__code__, found) if own else getattr(plain(function.__module__), key)
    return SimpleNamespace(**found)


class _Integers(np.ndarray):
    """A right shift fills with zeros, as that of `simd` does; numpy's keeps the sign."""

    def __rshift__(self, places: Any) -> np.ndarray:
        return (np.asarray(self).view(np.uint32) >> np.asarray(places, np.uint32)).view(np.int32)


def _floats(value: Any) -> np.ndarray:
    return np.broadcast_to(np.asarray(value, np.float32), LANES)


def _select(mask: np.ndarray, a: Any, b: Any) -> np.ndarray:
    whole = any(isinstance(x, np.ndarray) and x.dtype == np.int32 for x in (a, b))
    return np.where(mask, a, b).astype(np.int32 if whole else np.float32)


def _compress(vector: np.ndarray, mask: np.ndarray) -> np.ndarray:
    return np.concatenate([vector[mask], vector[~mask]])


def _store(array: np.ndarray, offset: int, vector: np.ndarray) -> None:
    array[offset : offset + LANES] = vector


def _store_quarter(array: np.ndarray, offset: int, vector: np.ndarray, quarter: int) -> None:
    array[offset : offset + 4] = vector[4 * quarter : 4 * quarter + 4]


def _store_rgb_rows(array: np.ndarray, offset: int, stride: int, *planes: np.ndarray) -> None:
    for row in range(4):
        values = np.stack([plane[4 * row : 4 * row + 4] for plane in planes], 1)
        array[offset + row * stride : offset + row * stride + 12] = values.ravel()


def _transpose16(source: np.ndarray, at: int, stride: int, target: np.ndarray, to: int, to_stride: int) -> None:
    rows = np.stack([source[at + i * stride :][:LANES] for i in range(LANES)]).T.copy()
    for i in range(LANES):
        target[to + i * to_stride :][:LANES] = rows[i]


VECTORS: dict[str, Any] = {
    "as_float": lambda a: np.asarray(a).view(np.float32),
    "as_int": lambda a: np.asarray(a).view(np.int32).view(_Integers),
    "at": lambda array, offset: int(array[offset]),
    "bits": lambda mask: np.uint32(sum(1 << i for i in range(LANES) if mask[i])),
    "broadcast": lambda array, offset: np.full(LANES, array[offset]),
    "compress": _compress,
    "floor": np.floor,
    "fma": lambda a, b, c: _floats(np.float64(a) * b + c),
    "gather": lambda array, index: array[index],
    "iload": lambda array, offset: array[offset : offset + LANES].copy(),
    "iota": lambda: np.arange(LANES, dtype=np.int32),
    "isplat": lambda x: np.full(LANES, x, np.int32),
    "load": lambda array, offset: array[offset : offset + LANES].copy(),
    "popcount": lambda x: int(x).bit_count(),
    "select": _select,
    "splat": lambda x: np.full(LANES, x, np.float32),
    "sqrt": np.sqrt,
    "store": _store,
    "store_quarter": _store_quarter,
    "store_rgb_rows": _store_rgb_rows,
    "sum16": lambda a: a.sum(dtype=np.float32),
    "to_float": lambda a: a.astype(np.float32),
    "to_int": lambda a: a.astype(np.int32),
    "transpose16": _transpose16,
    "vmax": lambda a, b: np.where(np.greater(a, b), a, b).astype(np.float32),
    "vmin": lambda a, b: np.where(np.less(a, b), a, b).astype(np.float32),
}
