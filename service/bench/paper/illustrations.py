"""Runs and renders the content of the figures: match vectors with and without decoupling, and methods' answers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import UInt8

from service.bench.localize import BenchScene, Trial, make_trials
from service.bench.paper import figures
from service.bench.paper.plan import MAIN
from service.bench.paper.tables import Line
from service.estimators import ESTIMATORS
from service.geometry import pose_distance, so3_exp
from service.localize import Request, localize
from service.photos.images import read_query, resized
from service.results import IterationRecord, PoseEstimate
from service.types import Camera, Pose, Query

METHODS = ("inerf", "inerf_dagger", "icomma", "mc_do", "view_index")


@dataclass(frozen=True, slots=True)
class FigureConfig:
    """Poses that the figures show."""

    rotation_deg: float = 20.0
    """Figure 1 (a): about the scene's centre..."""
    translation_units: float = 0.35
    """...or sidewards, in normalized units."""
    start_deg: tuple[float, float, float] = (18.0, -14.0, 22.0)
    """Figure 1 (b): the start's rotation about the world's axes..."""
    start_units: tuple[float, float, float] = (0.3, -0.2, 0.25)
    """...and its translation along them."""
    shown_steps: int = 4
    """Of the optimization, in Figure 1 (b)."""
    picture_px: int = 240
    """Long side of the pictures of Figures 2 and 3."""


FIGURES = FigureConfig()


def figure_1(one: BenchScene, config: FigureConfig = FIGURES) -> bytes:
    """Return Figure 1 as PNG: DO and, without decoupling, iComMa from the same start on the first test photo."""
    trial = next(make_trials(one, "none", 1, 0))
    truth = trial.truth.pose
    turned = _moved(one, truth, np.radians([0.0, config.rotation_deg, 0.0]), np.zeros(3))
    sidewards = config.translation_units * truth.world_from_camera[:3, 0]
    shifted = _moved(one, truth, np.zeros(3), sidewards)
    both = _moved(one, truth, np.radians(config.start_deg), np.array(config.start_units))
    # One iteration of DO shows the vectors of the start, before anything is solved.
    first = {"hypotheses": 0, "iterations": 1, "refinement_steps": 0}
    causes = [
        _shown(f"(a) {name}", trial, one, _run(one, trial, start, "mc_do", first).records, 1)[0]
        for name, start in (
            (f"turned about the centre, {config.rotation_deg:g} deg", turned),
            (f"shifted, {config.translation_units:g} units", shifted),
        )
    ]
    decoupled = _run(one, trial, both, "mc_do", {"hypotheses": 0, "iterations": 10, "refinement_steps": 0})
    joint = _run(one, trial, both, "icomma", {"rematch_every": 10, "long_side_px": 256})
    rows = [
        causes,
        _shown("(b) not decoupled", trial, one, joint.records, config.shown_steps),
        _shown("(b) decoupled", trial, one, decoupled.records, config.shown_steps),
    ]
    paths = [
        _path("not decoupled (icomma)", joint, truth, one),
        _path("decoupled (mc_do's DO)", decoupled, truth, one),
    ]
    return figures.vectors_and_paths(rows, paths, truth.position_in_world * one.units.units_per_scene_unit)


def _moved(one: BenchScene, pose: Pose, angles: np.ndarray, shift: np.ndarray) -> Pose:
    """Rotate the camera about the focus by angles (rad) per axis, then translate it (normalized units); world axes."""
    rotation = np.eye(3)
    for axis in range(3):
        # About the x axis first, as the start poses are rotated.
        rotation = so3_exp(angles[axis] * np.eye(3)[axis]) @ rotation
    matrix = pose.world_from_camera.copy()
    matrix[:3, :3] = rotation @ matrix[:3, :3]
    arm = pose.position_in_world - one.units.focus_in_world
    matrix[:3, 3] = one.units.focus_in_world + rotation @ arm + shift / one.units.units_per_scene_unit
    return Pose(matrix)


def _run(one: BenchScene, trial: Trial, start: Pose, estimator: str, changed: Mapping[str, Any]) -> PoseEstimate:
    options = ESTIMATORS.load(estimator).Options(**changed)
    return localize(replace(_query(one, trial), prior=start), one.loaded, Request(estimator, options))


def _query(one: BenchScene, trial: Trial) -> Query:
    return read_query(trial.data, intrinsics=trial.intrinsics, background_rgb=one.background_rgb)


def _shown(
    title: str, trial: Trial, one: BenchScene, records: Sequence[IterationRecord], count: int
) -> list[figures.Vectors]:
    """Return the match vectors of `count` steps, geometrically spread: most changes in the first ones."""
    photo = _query(one, trial).rgb
    matched = [(number, record.matches) for number, record in enumerate(records) if record.matches is not None]
    picked = np.unique(np.geomspace(1, len(matched), count).round().astype(int)) - 1 if matched else []
    found = []
    for index in picked:
        number, matches = matched[index]
        # Rendered pixels are scaled to the photo's, over which both ends are drawn.
        size = matches.render_camera.intrinsics
        scale = np.array([photo.shape[1] / size.width, photo.shape[0] / size.height])
        # Where no matches agree all of them are drawn.
        keep = matches.inlier if matches.inlier.any() else np.ones(len(matches.inlier), bool)
        vectors = matches.render_px[keep] * scale, matches.photo_px[keep]
        label = title if count == 1 else f"{title}, step {number}"
        found.append(figures.Vectors(label, photo, *vectors))
    return found


def _path(name: str, estimate: PoseEstimate, truth: Pose, one: BenchScene) -> figures.Path3D:
    poses = [record.pose for record in estimate.records]
    positions = np.stack([pose.position_in_world for pose in poses]) * one.units.units_per_scene_unit
    # The errors are drawn on a logarithmic scale, which has no zero.
    return figures.Path3D(name, positions, np.array([max(pose_distance(p, truth)[0], 1e-3) for p in poses]))


def figures_2_and_3(
    subjects: Mapping[str, BenchScene], lines: Sequence[Line], config: FigureConfig = FIGURES
) -> tuple[bytes, bytes] | None:
    """Return two PNGs: each method's answer to one query of each scene, blended with the photo, and as it is."""
    blended, plain, names = [], [], []
    for scene, one in subjects.items():
        of_query = _most_answered([line for line in lines if line["scene"] == scene and line["protocol"] == "hard"])
        if not of_query:
            continue
        trial = next(
            t for t in make_trials(one, "none", len(one.photos), 0) if t.photo == next(iter(of_query.values()))["photo"]
        )
        photo, camera = _photo_and_camera(one, trial, config.picture_px)
        start = next(iter(of_query.values()))["start_world_from_camera"]
        matrices = [start, *(of_query[m]["world_from_camera"] if m in of_query else None for m in METHODS)]
        renders = [None if m is None else _rendered(one, camera, np.array(m)) for m in matrices]
        blended.append([*(None if r is None else (r // 2 + photo // 2) for r in renders), photo])
        plain.append([*renders, photo])
        names.append(scene)
    if not names:
        return None
    # As in the tables: a star for the two-core profile.
    starred = {m.name: f"{m.name}*" if m.profile else m.name for m in MAIN}
    columns = ["start", *(starred[m] for m in METHODS), "photo"]
    return figures.pictures(blended, columns, names), figures.pictures(plain, columns, names)


def _most_answered(lines: Sequence[Line]) -> dict[str, Line]:
    """Return the lines, by method, of the query that most methods answered; the first of several."""
    queries: dict[tuple[str, int], dict[str, Line]] = {}
    for line in lines:
        if line["study"] == "table2" and line["method"] in METHODS:
            queries.setdefault((line["photo"], line["trial"]), {})[line["method"]] = line
    return max(queries.values(), key=len, default={})


def _photo_and_camera(one: BenchScene, trial: Trial, long_side_px: int) -> tuple[UInt8[np.ndarray, "h w 3"], Camera]:
    query = _query(one, trial)
    intrinsics = query.intrinsics.with_long_side(long_side_px)
    # In the size of the renders, with which it is blended.
    photo = resized(query.rgb.astype(np.float32), intrinsics.width, intrinsics.height)
    return np.rint(photo).astype(np.uint8), Camera(intrinsics, trial.truth.pose)


def _rendered(one: BenchScene, camera: Camera, world_from_camera: np.ndarray) -> UInt8[np.ndarray, "h w 3"]:
    (frame,) = one.loaded.rasterizer.render([replace(camera, pose=Pose(world_from_camera))])
    return np.rint(255 * np.clip(frame.rgb, 0, 1)).astype(np.uint8)


def figure_4(lines: Sequence[Line]) -> bytes | None:
    """Return Figure 4 as PNG: the share of queries within 5 deg and 0.05 units after each step."""
    panels: dict[str, dict[str, tuple[Sequence[float], Sequence[float], int]]] = {}
    for protocol in ("easy", "hard"):
        chosen = [line for line in lines if line["protocol"] == protocol and line.get("curve")]
        for method in METHODS:
            curves = [line["curve"] for line in chosen if line["method"] == method]
            if curves:
                panels.setdefault(f"start '{protocol}'", {})[method] = (*_share_curve(curves), len(curves))
    return figures.shares_by_step(panels) if panels else None


def _share_curve(curves: Sequence[Sequence[Sequence[float]]]) -> tuple[list[float], list[float]]:
    """Return steps, and the share of queries within the bounds at each; an ended query keeps its last errors."""
    steps = sorted({point[0] for curve in curves for point in curve})
    good = np.zeros(len(steps))
    for curve in curves:
        numbers, degrees, units = np.array(curve).T
        # The bound of Table 2.
        within = (degrees <= 5) & (units <= 0.05)
        good += within[np.searchsorted(numbers, steps, side="right") - 1]
    return [float(s) for s in steps], (good / len(curves)).tolist()
