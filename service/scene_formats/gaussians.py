"""The content of a scene file, and the checks and conversions that all formats share."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32, Float64

from service.errors import CorruptScene
from service.types import SH_C0

MAX_GAUSSIANS = 20_000_000
"""More than any published scene; with SH degree 3 they would fill 5 GB."""
MAX_COORDINATE = 1e9
"""Scene units. Squares of larger numbers exceed the range of float32 renderers."""
MAX_BAD_SHARE = 0.5
"""Of a file's Gaussians: trainers leave a few NaN, another layout makes nearly all of them."""
MAX_COEFFICIENTS = 16
"""Of SH degree 3, the highest that the renderers evaluate."""
SH_CUT = "Spherical harmonics of degree 4 are left out; those of degree 0 to 3 are used."
_ARRAYS = ("means", "scales", "opacities", "sh", "quats")


@dataclass(frozen=True, slots=True)
class RawGaussians:
    """A file's Gaussians with activated values (scales, not logarithms), in the file's own frame, not checked yet."""

    means: Float32[np.ndarray, "n 3"] | Float64[np.ndarray, "n 3"]
    """float64 where the file has more digits than float32 holds."""
    quats: Float32[np.ndarray, "n 4"]
    """wxyz, of any length."""
    scales: Float32[np.ndarray, "n 3"]
    opacities: Float32[np.ndarray, "n"]
    sh: Float32[np.ndarray, "n k 3"]
    render_mode: str | None = None
    """How the scene was trained, if the file has it: default, antialiased, or a mode that is not supported."""
    up: tuple[float, float, float] | None = None
    """Unit vector in the file's frame, where its format or its header says so."""
    warnings: tuple[str, ...] = ()
    """What of the file is not in these arrays."""


def require_count(count: int, where: str) -> None:
    """Raise CorruptScene unless a file may hold `count` Gaussians; call it before anything is allocated."""
    if count <= 0:
        raise CorruptScene(f"the scene is empty: it has {count} Gaussians by its header.", where=where)
    if count > MAX_GAUSSIANS:
        raise CorruptScene(f"{count} Gaussians; the limit is {MAX_GAUSSIANS}.", where=where)


def checked(raw: RawGaussians, where: str) -> RawGaussians:
    """Return the usable Gaussians with unit quaternions, and a warning that counts those that were left out.

    Not usable are non-finite values (one NaN makes every pixel that it reaches NaN), quaternions of length zero,
    negative scales, and lengths beyond 1e9. Raises CorruptScene with the first one if they are half or more: a file
    like that is broken, or in another layout than it says.
    """
    lengths = np.linalg.norm(raw.quats.astype(np.float64), axis=1)  # squares of tiny components vanish in float32
    faults = {f"non-finite {name}": _non_finite(getattr(raw, name)) for name in _ARRAYS}
    with np.errstate(invalid="ignore"):
        faults |= {
            f"means beyond {MAX_COORDINATE:g} units": (np.abs(raw.means) > MAX_COORDINATE).any(1),
            f"scales beyond {MAX_COORDINATE:g} units": (raw.scales > MAX_COORDINATE).any(1),
            "negative scales": (raw.scales < 0).any(1),
            "quaternions of length zero": lengths < 1e-12,
        }
    bad = np.logical_or.reduce(list(faults.values()))
    count = int(np.count_nonzero(bad))
    if not count:
        return replace(raw, quats=(raw.quats / lengths[:, None]).astype(np.float32))
    # One fault with its place is more help than the names of all.
    what, first = next((what, int(np.argmax(each))) for what, each in faults.items() if each.any())
    text = f"{count} of {len(bad)} Gaussians have {what} or the like, the first is number {first}"
    if count >= MAX_BAD_SHARE * len(bad):
        raise CorruptScene(f"{text}.", where=where, hint="Remove them in an editor, or export the scene again.")
    good = ~bad
    kept = {name: getattr(raw, name)[good] for name in _ARRAYS}
    kept["quats"] = (kept["quats"] / lengths[good, None]).astype(np.float32)
    return replace(raw, **kept, warnings=(*raw.warnings, f"{text}; they are left out."))


def _non_finite(values: np.ndarray) -> Bool[np.ndarray, "n"]:
    return np.asarray(~np.isfinite(values.reshape(len(values), -1)).all(1))


def cut_sh(sh: Float32[np.ndarray, "n k 3"]) -> tuple[Float32[np.ndarray, "n m 3"], tuple[str, ...]]:
    """Return the coefficients up to degree 3, and a warning if there were more."""
    if sh.shape[1] <= MAX_COEFFICIENTS:
        return sh, ()
    return np.ascontiguousarray(sh[:, :MAX_COEFFICIENTS]), (SH_CUT,)


def joined(parts: list[RawGaussians]) -> RawGaussians:
    """Return the Gaussians of several parts of one file; those of a lower SH degree than others get zeros."""
    if len(parts) == 1:
        return parts[0]
    # Zeros of a higher degree change no colour.
    most = max(part.sh.shape[1] for part in parts)
    sh = [np.pad(part.sh, ((0, 0), (0, most - part.sh.shape[1]), (0, 0))) for part in parts]
    arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _ARRAYS if name != "sh"}
    warnings = tuple(dict.fromkeys(text for part in parts for text in part.warnings))
    return replace(parts[0], **arrays, sh=np.concatenate(sh), warnings=warnings)


def sh_from_rgb(rgb: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 1 3"]:
    """Return the degree-0 coefficients of colours 0..1."""
    return ((rgb - np.float32(0.5)) / np.float32(SH_C0))[:, None, :]


def sh_from_channel_major(rest: Float32[np.ndarray, "n m"]) -> Float32[np.ndarray, "n k 3"]:
    """Return the higher coefficients, stored as all of red, then green, then blue."""
    return rest.reshape(len(rest), 3, -1).transpose(0, 2, 1)
