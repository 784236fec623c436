"""The content of a scene file, and the checks and conversions that all formats share."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float32

from service.errors import CorruptScene
from service.types import SH_C0

MAX_GAUSSIANS = 20_000_000
"""More than any published scene; with SH degree 3 they would fill 5 GB."""
MAX_COORDINATE = 1e9
"""Scene units. Squares of larger numbers exceed the range of float32 renderers."""


@dataclass(frozen=True, slots=True)
class RawGaussians:
    """A file's Gaussians with activated values (scales, not logarithms), in the file's own frame, not checked yet."""

    means: Float32[np.ndarray, "n 3"]
    quats: Float32[np.ndarray, "n 4"]
    """wxyz, of any length."""
    scales: Float32[np.ndarray, "n 3"]
    opacities: Float32[np.ndarray, "n"]
    sh: Float32[np.ndarray, "n k 3"]
    render_mode: str | None = None
    """How the scene was trained, if the file has it: default, antialiased, or a mode that is not supported."""


def require_count(count: int, where: str) -> None:
    """Raise CorruptScene unless a file may hold `count` Gaussians; call it before anything is allocated."""
    if count <= 0:
        raise CorruptScene(f"the scene is empty: it has {count} Gaussians by its header.", where=where)
    if count > MAX_GAUSSIANS:
        raise CorruptScene(f"{count} Gaussians; the limit is {MAX_GAUSSIANS}.", where=where)


def checked(raw: RawGaussians, where: str) -> RawGaussians:
    """Check the Gaussians and normalize their quaternions. Raises CorruptScene with the first bad one.

    Strict on purpose: one NaN makes every pixel that it reaches NaN, and dropping Gaussians silently would hide a
    broken export.
    """
    # NaN first: the comparisons below are False for it.
    for name in ("means", "scales", "opacities", "sh", "quats"):
        values = getattr(raw, name)
        _require_none(~np.isfinite(values.reshape(len(values), -1)).all(1), f"non-finite {name}", where)
    _require_none((np.abs(raw.means) > MAX_COORDINATE).any(1), f"means beyond {MAX_COORDINATE:g} units", where)
    _require_none((raw.scales > MAX_COORDINATE).any(1), f"scales beyond {MAX_COORDINATE:g} units", where)
    _require_none((raw.scales < 0).any(1), "negative scales", where)
    # float64: squares of tiny components would vanish in float32.
    lengths = np.linalg.norm(raw.quats.astype(np.float64), axis=1)
    _require_none(lengths < 1e-12, "quaternions of length zero", where)
    return replace(raw, quats=(raw.quats / lengths[:, None]).astype(np.float32))


def _require_none(bad: Any, what: str, where: str) -> None:
    """Raise CorruptScene if any Gaussian is bad; `bad` has one bool each, which numpy's stubs don't express."""
    count = int(np.count_nonzero(bad))
    if count:
        raise CorruptScene(
            f"{count} of {len(bad)} Gaussians have {what}, the first is number {int(np.argmax(bad))}.",
            where=where,
            hint="Remove them in an editor, or export the scene again.",
        )


def sh_from_rgb(rgb: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 1 3"]:
    """Return the degree-0 coefficients of colours 0..1."""
    return ((rgb - np.float32(0.5)) / np.float32(SH_C0))[:, None, :]


def sh_from_channel_major(rest: Float32[np.ndarray, "n m"]) -> Float32[np.ndarray, "n k 3"]:
    """Return the higher coefficients, stored as all of red, then green, then blue."""
    return rest.reshape(len(rest), 3, -1).transpose(0, 2, 1)
