"""numba, wrapped: how every compiled kernel of ours is declared, and where the machine code is kept.

A kernel runs on one thread with the GIL released. numba's disk cache notices a change in a kernel's own file but
not in an imported one, so the cache directory is named by a hash of all kernel sources.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba


def _cache_dir() -> Path:
    root = Path(__file__).parent
    digest = hashlib.sha256()
    for folder in ("render", "pose", "matchers"):
        for source in sorted((root / folder).rglob("*.py")):
            text = source.read_bytes()
            if b"service.jit" in text or source.name == "simd.py":
                digest.update(text)
    base = Path(os.environ.get("SPLATFIX_CACHE_DIR") or Path.home() / ".cache" / "splatfix")
    return base / f"jit-{digest.hexdigest()[:12]}"


if not os.environ.get("NUMBA_CACHE_DIR"):
    numba.config.CACHE_DIR = str(_cache_dir())  # type: ignore[attr-defined]


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Decorate a compiled function: no GIL, no bounds checks, C division; strict floating point."""
    return numba.njit(nogil=True, cache=True, error_model="numpy", boundscheck=False)(function)


def summing(function: Callable[..., Any]) -> Callable[..., Any]:
    """Decorate a kernel whose sums may be taken in any order, several numbers at a time."""
    freely = {"reassoc", "nsz", "contract"}
    return numba.njit(nogil=True, cache=True, error_model="numpy", boundscheck=False, fastmath=freely)(function)


def inline(function: Callable[..., Any]) -> Callable[..., Any]:
    """Decorate a function that only kernels call: it is compiled into them."""
    return numba.njit(nogil=True, error_model="numpy", boundscheck=False)(function)
