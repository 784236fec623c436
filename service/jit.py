"""Decorators of the compiled kernels (numba), and the directory of their machine code.

A kernel runs on one thread with the GIL released. numba's disk cache notices a change in a kernel's own file but not in
an imported one, so the cache directory is named by a hash of all kernel sources.
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
            # By its text, not by its imports: this must be known before the first kernel is imported.
            text = source.read_bytes()
            if b"service.jit" in text or source.name == "simd.py":
                digest.update(text)
    base = Path(os.environ.get("SPLATFIX_CACHE_DIR") or Path.home() / ".cache" / "splatfix")
    return base / f"jit-{digest.hexdigest()[:12]}"


# Set before any kernel is declared: numba looks up the directory when it decorates.
if not os.environ.get("NUMBA_CACHE_DIR"):
    numba.config.CACHE_DIR = str(_cache_dir())  # type: ignore[attr-defined]


_REORDERED = {"reassoc", "nsz", "contract"}


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function: without the GIL, bounds checks or Python's division by zero; with strict floating point."""
    return numba.njit(nogil=True, cache=True, error_model="numpy", boundscheck=False)(function)


def kernel_reordered_sums(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a kernel whose sums may be reordered, so that LLVM vectorizes them; NaN and infinity stay exact."""
    return numba.njit(nogil=True, cache=True, error_model="numpy", boundscheck=False, fastmath=_REORDERED)(function)


def inline(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function that only kernels call; it has no cache of its own, since it is compiled into them."""
    return numba.njit(nogil=True, error_model="numpy", boundscheck=False)(function)


def inline_reordered_sums(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function that only kernels call, whose sums may be reordered as `kernel_reordered_sums` says."""
    return numba.njit(nogil=True, error_model="numpy", boundscheck=False, fastmath=_REORDERED)(function)
