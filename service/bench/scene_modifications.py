"""Modifications of the benches' scenes, `NAME=VALUE`: what other formats, trainers and times make of a scene.

sh_degree  keep this degree of the colours        floaters  a factor: 3000 large faint Gaussians, 300 small opaque ones
splat      1: as a .splat file keeps it           hole      cut out a box that holds this share of the Gaussians
spz        1: as an SPZ file keeps it             warm      a factor of +18 % red, +2 % green, -15 % blue
sog        1: as a SOG file keeps it              dark      colours times this
thin       remove this share, the least important first
soft       underfit: remove this share at random; the others' scales grow by 1.35
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from zlib import crc32

import numpy as np
from jaxtyping import Bool, Float32, Float64

from service.bench.pose_metrics import Units
from service.errors import InvalidOptions, UnknownName
from service.types import SH_C0, GaussianScene

SOFT_SCALE = 1.35
WARM = np.array([0.18, 0.02, -0.15], np.float32)
FAINT, OPAQUE = 3000, 300
"""Floaters."""
CODES = 256
"""Values of a SOG file's codebooks."""
_ARRAYS = ("means", "quats", "scales", "opacities", "sh")
Array = Float32[np.ndarray, "..."]


def modified_scene(scene: GaussianScene, specs: Sequence[str], units: Units, seed: int) -> GaussianScene:
    """Return the scene after modifications 'NAME=VALUE'. Raises UnknownName, InvalidOptions.

    `units` are those of the scene as it was. The digest is another one, so that nothing cached is mixed up.
    """
    info = scene.info
    for spec in specs:
        change, value = _parse(spec)
        scene = change(scene, value, units, np.random.default_rng([seed, crc32(spec.encode())]))
    digest = "-".join([info.sha256, *specs, str(seed)]) if specs else info.sha256
    return replace(scene, info=replace(info, sha256=digest))


def require_scene_modifications(specs: Sequence[str]) -> None:
    """Raise UnknownName or InvalidOptions for the first modification that doesn't exist or has a wrong value."""
    for spec in specs:
        _parse(spec)


def _parse(spec: str) -> tuple[_Change, float]:
    name, _, text = spec.partition("=")
    if name not in SCENE_MODIFICATIONS:
        known = ", ".join(sorted(SCENE_MODIFICATIONS))
        raise UnknownName(f"unknown modification of scenes '{name}'; known: {known}.", where="modify_scene")
    low, high, change = SCENE_MODIFICATIONS[name]
    try:
        value = float(text)
    except ValueError:
        raise InvalidOptions(f"must be NAME=NUMBER, is '{spec}'.", where="modify_scene") from None
    if not low <= value <= high:
        raise InvalidOptions(f"'{name}' takes {low:g} to {high:g}, not {value:g}.", where="modify_scene")
    return change, value


def _kept(scene: GaussianScene, keep: Bool[np.ndarray, "n"]) -> GaussianScene:
    return replace(scene, **{name: getattr(scene, name)[keep] for name in _ARRAYS})


def _sh_degree(scene: GaussianScene, degree: float, units: Units, rng: np.random.Generator) -> GaussianScene:
    return replace(scene, sh=scene.sh[:, : (int(degree) + 1) ** 2])


def _thin(scene: GaussianScene, share: float, units: Units, rng: np.random.Generator) -> GaussianScene:
    """Importance: opacity times the area of the Gaussian's largest section."""
    importance = scene.opacities * np.prod(np.sort(scene.scales, axis=1)[:, 1:], axis=1)
    keep = np.ones(scene.count, bool)
    keep[np.argsort(importance, kind="stable")[: round(share * scene.count)]] = False
    return _kept(scene, keep)


def _soft(scene: GaussianScene, share: float, units: Units, rng: np.random.Generator) -> GaussianScene:
    keep = np.ones(scene.count, bool)
    keep[rng.permutation(scene.count)[: round(share * scene.count)]] = False
    left = _kept(scene, keep)
    return replace(left, scales=left.scales * np.float32(SOFT_SCALE))


def _floaters(scene: GaussianScene, factor: float, units: Units, rng: np.random.Generator) -> GaussianScene:
    """Add Gaussians anywhere among the cameras and the middle half of the scene, in its colours."""
    places = [np.quantile(scene.means, [0.25, 0.75], axis=0)]
    places += [named.camera.pose.position_in_world[None] for named in scene.cameras]
    low, high = np.concatenate(places).min(0), np.concatenate(places).max(0)
    faint, opaque = round(factor * FAINT), round(factor * OPAQUE)
    count = faint + opaque
    unit = 1 / units.units_per_scene_unit
    sizes = np.concatenate([rng.uniform(0.05, 0.3, (faint, 3)), rng.uniform(0.01, 0.04, (opaque, 3))])
    quats = rng.normal(size=(count, 4))
    added = {
        "means": rng.uniform(low, high, (count, 3)),
        "quats": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "scales": unit * sizes,
        "opacities": np.concatenate([rng.uniform(0.01, 0.06, faint), rng.uniform(0.7, 0.99, opaque)]),
        "sh": scene.sh[rng.integers(0, scene.count, count)],
    }
    return replace(scene, **{n: np.concatenate([getattr(scene, n), added[n].astype(np.float32)]) for n in _ARRAYS})


def _hole(scene: GaussianScene, share: float, units: Units, rng: np.random.Generator) -> GaussianScene:
    """The box has the scene's proportions, and a random opaque Gaussian in its middle."""
    low, high = np.quantile(scene.means, [0.1, 0.9], axis=0)
    inside = (scene.opacities > 0.5) & ((scene.means > low) & (scene.means < high)).all(1)
    centre = scene.means[rng.choice(np.flatnonzero(inside))]
    distance = np.abs((scene.means - centre) / (high - low)).max(1)
    return _kept(scene, distance > np.quantile(distance, share))


def _warm(scene: GaussianScene, strength: float, units: Units, rng: np.random.Generator) -> GaussianScene:
    return _coloured(scene, 1 + np.float32(strength) * WARM)


def _dark(scene: GaussianScene, factor: float, units: Units, rng: np.random.Generator) -> GaussianScene:
    return _coloured(scene, np.full(3, factor, np.float32))


def _coloured(scene: GaussianScene, gain: Float32[np.ndarray, "3"]) -> GaussianScene:
    """Multiply the colours, 0.5 + the sum of the harmonics, by a gain for each channel."""
    sh = scene.sh * gain
    sh[:, 0] += np.float32(0.5 / SH_C0) * (gain - 1)
    return replace(scene, sh=sh)


def _splat(scene: GaussianScene, on: float, units: Units, rng: np.random.Generator) -> GaussianScene:
    """Colours, opacities and rotations of 8 bits, without view dependence."""
    colours = _rounded(np.clip(0.5 + SH_C0 * scene.sh[:, :1], 0, 1), 255)
    quats = np.clip(_rounded(scene.quats, 128), -1, 127 / 128)
    return replace(
        scene,
        sh=(colours - np.float32(0.5)) / np.float32(SH_C0),
        opacities=_rounded(scene.opacities, 255),
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
    )


def _spz(scene: GaussianScene, on: float, units: Units, rng: np.random.Generator) -> GaussianScene:
    """Positions of 1/4096 unit, logarithms of scales of 1/16, rotations of 10 bits, colours of 8, 5 and 4 bits."""
    sh = scene.sh.copy()
    # A byte covers 0.15 of a coefficient per half of its range.
    sh[:, 0] = _rounded(np.clip(sh[:, 0], -0.5 / 0.15, 0.5 / 0.15), 0.15 * 255)
    sh[:, 1:4] = _rounded(np.clip(sh[:, 1:4], -1, 1), 16)
    sh[:, 4:] = _rounded(np.clip(sh[:, 4:], -1, 1), 8)
    return replace(
        scene,
        means=_rounded(scene.means, 4096),
        scales=np.exp(_rounded(np.clip(np.log(scene.scales), -10, 6 - 1 / 16), 16)),
        quats=_three_kept(scene.quats, 511),
        opacities=_rounded(scene.opacities, 255),
        sh=sh,
    )


def _sog(scene: GaussianScene, on: float, units: Units, rng: np.random.Generator) -> GaussianScene:
    """Logarithms of positions of 16 bits, 256 codes of scales and of colours, rotations and opacities of 8 bits.

    The palette of view-dependent colours, of 65,536 entries, is as good as none: scenes are about as large.
    """
    logs = np.sign(scene.means) * np.log1p(np.abs(scene.means.astype(np.float64)))
    low, high = logs.min(0), logs.max(0)
    steps = np.rint((logs - low) / (high - low) * 65535) / 65535 * (high - low) + low
    sh = scene.sh.copy()
    sh[:, 0] = _coded(sh[:, 0])
    if sh.shape[1] > 1:
        sh[:, 1:] = _coded(sh[:, 1:])
    return replace(
        scene,
        means=(np.sign(steps) * np.expm1(np.abs(steps))).astype(np.float32),
        scales=np.exp(_coded(np.log(scene.scales))),
        quats=_three_kept(scene.quats, 127.5),
        opacities=_rounded(scene.opacities, 255),
        sh=sh,
    )


def _three_kept(quats: Float32[np.ndarray, "n 4"], per_unit: float) -> Float32[np.ndarray, "n 4"]:
    """Round the three smaller components, which lie within 1 / sqrt(2); the largest follows, since the length is 1."""
    largest = np.abs(quats).argmax(1)[:, None]
    # A quaternion and its opposite mean the same rotation.
    positive = quats * np.sign(np.take_along_axis(quats, largest, 1))
    rounded = _rounded(positive * np.float32(np.sqrt(2)), per_unit) / np.float32(np.sqrt(2))
    np.put_along_axis(rounded, largest, 0, 1)
    rest = np.sqrt(np.maximum(0, 1 - (rounded**2).sum(1, keepdims=True)))
    np.put_along_axis(rounded, largest, rest, 1)
    return rounded


def _rounded(values: Array, per_unit: float) -> Array:
    """Round to multiples of 1 / per_unit."""
    return (np.rint(values * np.float32(per_unit)) / np.float32(per_unit)).astype(np.float32)


def _coded(values: Array) -> Array:
    """Replace each value by the nearest of CODES: k-means of all values in one dimension, begun at their quantiles."""
    flat = np.sort(values, axis=None).astype(np.float64)
    total = np.concatenate([[0.0], np.cumsum(flat)])
    codes = np.quantile(flat, (np.arange(CODES) + 0.5) / CODES)
    for _ in range(10):
        edges = np.concatenate([[0], np.searchsorted(flat, (codes[1:] + codes[:-1]) / 2), [len(flat)]])
        sizes = np.diff(edges)
        means: Float64[np.ndarray, "_"] = np.diff(total[edges]) / np.maximum(sizes, 1)
        codes = np.sort(np.where(sizes > 0, means, codes))
    nearest = np.searchsorted((codes[1:] + codes[:-1]) / 2, values)
    return codes[nearest].astype(np.float32)


_Change = Callable[[GaussianScene, float, Units, np.random.Generator], GaussianScene]
SCENE_MODIFICATIONS: dict[str, tuple[float, float, _Change]] = {
    "sh_degree": (0, 3, _sh_degree),
    "splat": (1, 1, _splat),
    "spz": (1, 1, _spz),
    "sog": (1, 1, _sog),
    "thin": (0, 0.95, _thin),
    "soft": (0, 0.95, _soft),
    "floaters": (0, 10, _floaters),
    "hole": (0, 0.9, _hole),
    "warm": (-2, 2, _warm),
    "dark": (0.05, 5, _dark),
}
"""Name -> smallest value, largest value, function."""
