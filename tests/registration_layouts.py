"""Synthetic layouts of photos with a planted registration, for tests/test_registration.py and tests/register_run.py."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from service.geometry import so3_exp
from service.registration.observations import Direction, Evidence, Observation
from service.registration.similarity_fit import Similarity

UP = np.array([0.0, 0.0, 1.0])


def planted(rng) -> Similarity:
    """Any rotation, a scale between 0.1 and 10, a shift of some metres."""
    rotation = so3_exp(_axis(rng) * rng.uniform(0, np.pi))
    return Similarity(rotation, float(np.exp(rng.uniform(-2.3, 2.3))), rng.normal(size=3) * 5, np.zeros(3))


def _axis(rng):
    axis = rng.normal(size=3)
    return axis / np.linalg.norm(axis)


def layout(kind: str, count: int, rng) -> np.ndarray:
    """Positions of photos in metres, before they are moved to the scene."""
    if kind == "around":
        angle = np.linspace(0, 1.5 * np.pi, count) + rng.normal(size=count) * 0.1
        return np.stack([2 * np.cos(angle), 2 * np.sin(angle), rng.uniform(0.8, 2.2, count)], 1)
    if kind == "planar":
        return np.concatenate([rng.uniform(-2, 2, (count, 2)), np.zeros((count, 1))], 1)
    if kind == "short":
        return rng.normal(size=(count, 3)) * [0.3, 0.1, 0.06]
    if kind == "walk":  # 40 m with two corners
        along = np.linspace(0, 40, count)
        x, y = np.interp(along, [0, 15, 28, 40], [0, 15, 18, 8]), np.interp(along, [0, 15, 28, 40], [0, 0, 12.6, 19])
        return np.stack([x, y, 1.5 + rng.normal(size=count) * 0.05], 1)
    if kind == "line":
        return np.outer(np.linspace(-2, 2, count), [0.6, 0.8, 0.0])
    assert kind == "place"
    return np.tile(rng.normal(size=3), (count, 1))


@dataclass(frozen=True)
class Photos:
    """Poses of photos in a scene: as they are, and as they are found."""

    true: list[np.ndarray]
    """world_from_camera, 4x4."""
    found: list[np.ndarray]
    covariances: list[np.ndarray] | None = None
    """Of those that are found, as a verdict's."""


def evidence(kind: str, what: str, count: int, rng) -> tuple[Evidence, Evidence, Similarity]:
    """Return evidence with noise, the same without its outlier, and the truth (target from world)."""
    truth = planted(rng)
    places = layout(kind, count, rng)
    inverse = np.linalg.inv(truth.matrix)
    poses = []
    for place in places:
        pose = np.eye(4)
        pose[:3, :3] = truth.rotation.T @ so3_exp(_axis(rng) * rng.uniform(0, np.pi))
        pose[:3, 3] = (inverse @ [*place, 1.0])[:3]
        poses.append(pose)
    return *evidence_of(Photos(poses, poses), what, truth, rng), truth


def evidence_of(photos: Photos, what: str, truth: Similarity, rng) -> tuple[Evidence, Evidence]:
    """Return evidence of photos with noise and an outlier in their places, and the same without the outlier."""
    count = len(photos.true)
    places = np.array([(truth.matrix @ pose[:, 3])[:3] for pose in photos.true])
    spread = float(np.sqrt(((places - places.mean(0)) ** 2).sum(1).mean())) or 1.0
    if spread < 1e-9:
        spread = 1.0
    noise = rng.normal(size=(count, 3)) * 0.01 * spread / np.sqrt(3)
    if what == "gps":
        noise = rng.normal(size=(count, 3)) * 5.0 / np.sqrt(3)
    if what == "drift":
        step = np.linalg.norm(np.diff(places, axis=0, prepend=places[:1]), axis=1)
        noise = np.cumsum(rng.normal(size=(count, 3)) * np.sqrt(step * step.sum())[:, None] * 0.01, 0)
        noise += rng.normal(size=(count, 3)) * 0.002 * spread
    seen = []
    for i, (true, found) in enumerate(zip(photos.true, photos.found, strict=True)):
        covariance = photos.covariances[i] if photos.covariances else None
        one = Observation(f"photo_{i:02d}", found[:3, 3], places[i] + noise[i], localization_covariance=covariance)
        if what in ("poses", "drift"):
            told = so3_exp(rng.normal(size=3) * np.radians(0.5)) @ truth.rotation @ true[:3, :3]
            one = replace(one, target_from_camera=told)
        if what == "gps":
            one = replace(one, position_covariance=np.eye(3) * 25 / 3)
        seen.append(replace(one, world_from_camera=found[:3, :3]))
    good = Evidence(seen, up=(0.0, 0.0, 1.0), drift=0.01 if what == "drift" else 0.0)
    if what == "gps":
        tilted = so3_exp(rng.normal(size=3) * np.radians(1.0)) @ UP
        good = replace(good, directions=[Direction(truth.rotation.T @ UP, tilted, np.radians(1.0))])
    bad = list(seen)
    worst = int(rng.integers(count))
    far = 8.0 if what == "gps" else 1.0  # a gross outlier: far outside of the noise
    bad[worst] = replace(bad[worst], position=bad[worst].position + _axis(rng) * far * spread)
    return replace(good, observations=bad), replace(good, observations=seen[:worst] + seen[worst + 1 :])
