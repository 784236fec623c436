"""Synthetic layouts of photos with a planted registration, for tests/test_registration.py and tests/register_run.py."""

from __future__ import annotations

from dataclasses import replace

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


def evidence(kind: str, what: str, count: int, rng) -> tuple[Evidence, Evidence, Similarity]:
    """Return evidence with noise, the same without its outlier, and the truth (target from world)."""
    truth = planted(rng)
    places = layout(kind, count, rng)
    inverse = np.linalg.inv(truth.matrix)
    spread = float(np.sqrt(((places - places.mean(0)) ** 2).sum(1).mean())) or 1.0
    drift = 0.0
    noise = rng.normal(size=(count, 3)) * 0.01 * spread / np.sqrt(3)
    if what == "gps":
        noise = rng.normal(size=(count, 3)) * 5.0 / np.sqrt(3)
    if what == "drift":
        drift = 0.01
        step = np.linalg.norm(np.diff(places, axis=0, prepend=places[:1]), axis=1)
        noise = np.cumsum(rng.normal(size=(count, 3)) * np.sqrt(step * step.sum())[:, None] * drift, 0)
        noise += rng.normal(size=(count, 3)) * 0.002 * spread
    seen = []
    for i in range(count):
        in_target = so3_exp(_axis(rng) * rng.uniform(0, np.pi))
        place = (inverse @ [*places[i], 1.0])[:3]
        one = Observation(f"photo_{i:02d}", place, places[i] + noise[i])
        if what in ("poses", "drift"):
            told = so3_exp(rng.normal(size=3) * np.radians(0.5)) @ in_target
            one = replace(one, world_from_camera=truth.rotation.T @ in_target, target_from_camera=told)
        if what == "gps":
            one = replace(one, position_covariance=np.eye(3) * 25 / 3)
        seen.append(one)
    good = Evidence(seen, up=(0.0, 0.0, 1.0), drift=drift)
    if what == "gps":
        tilted = so3_exp(rng.normal(size=3) * np.radians(1.0)) @ UP
        good = replace(good, directions=[Direction(truth.rotation.T @ UP, tilted, np.radians(1.0))])
    bad = list(seen)
    worst = int(rng.integers(count))
    far = 8.0 if what == "gps" else 1.0  # a gross outlier: far outside of the noise
    bad[worst] = replace(bad[worst], position=bad[worst].position + _axis(rng) * far * spread)
    without = replace(good, observations=seen[:worst] + seen[worst + 1 :])
    return replace(good, observations=bad), without, truth
