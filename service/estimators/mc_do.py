"""The supplement's method: Monte Carlo initialization, decoupled optimization (DO), L1 refinement.

    hypotheses around the prior, or over the whole scene -> rendered on the pruned level, matched with the photo,
    scored -> resampled around the best -> DO: 10 times render, match, solve -> descent of the L1 loss

From the supplement: the three stages and their order; matches as the score; 10 iterations; rotation by the angles
between match vectors, translation by their lengths; L1 as the loss. Ours, because it is silent: the hypotheses'
number, range and resampling, which goes on from what the best ones' matches are solved to; the score (the weight of
the matches that one turn about the scene's centre and one shift explain: where it is high, DO can go on); the
second-order solver (`service.pose.absolute_pose.decoupled` has both); XFeat where the paper most likely had LoFTR;
small renders.

Deviations: DO's matches are of rendered points with a depth, and stay fixed while a solver works on them; best so
far, not last, is the answer of MC and DO.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np

from service.errors import InvalidOptions
from service.geometry import pose_distance
from service.interfaces import Rasterizer, Tools
from service.pose.absolute_pose.decoupled import DECOUPLED, DecoupledSolution, MatchedPoints, least_squares_solve
from service.pose.descent.contribution_pruning import contributions, pruned
from service.pose.descent.decoupled_gradient import gradient_solve
from service.pose.descent.gradient_descent import refine, require_within
from service.pose.descent.hypotheses import around
from service.pose.descent.losses import loss_against, require_loss
from service.pose.features.image_sizes import RENDER_PX, sized
from service.pose.features.query_images import QueryImages
from service.pose.features.rendered_views import View
from service.pose.matching.correspondences import Correspondences
from service.pose.matching.render_and_match import match_record, render_and_match
from service.pose.retrieval.scene_focus import Focus, focus_of_scene
from service.pose.retrieval.viewpoints import index_cameras
from service.render import RASTERIZERS
from service.render.counted import Counted
from service.results import Candidates, IterationRecord
from service.types import Camera, Pose, Query

MATCHES_IMAGES = True
"""It works with matchers that have no features of one image."""
SCENE_JITTER_DEG, SCENE_JITTER_SHARE = 10.0, 0.05
"""About each of the scene's viewpoints, where there is no prior."""
LEVEL_VIEWS, LEVEL_PX = 24, 384
PARENTS, SHRINK = 8, 0.3
"""Each resampling round looks at what the best PARENTS were solved to, and around, in SHRINK times the last range."""
ENOUGH = 60.0
"""Support that ends the search: no wrong hypothesis had more than 30."""
RATE, END_RATE = 2e-3, 1e-5
"""Of the descent: rad, and shares of the distance to the centre."""


@dataclass(frozen=True, slots=True)
class Options:
    hypotheses: int = 64
    """Poses of the Monte Carlo stage's first round; 0 leaves the stage out."""
    around: Literal["prior", "scene"] = "prior"
    """What the first round is drawn around; without a prior it is the scene's viewpoints anyway."""
    range_deg: float = 60.0
    """Of the hypotheses around the prior: per axis, about the scene's centre."""
    range_share: float = 0.25
    """Of their shifts: per axis, a share of the distance to the scene's centre."""
    rounds: int = 2
    """Resampling rounds after the first, each with an eighth of its hypotheses and the best ones' solutions."""
    hypothesis_px: int = 256
    """Long side of their renders."""
    render_px: int = RENDER_PX
    """Long side of the renders of the later stages."""
    iterations: int = 10
    """Of the decoupled optimization; 0 leaves the stage out."""
    solver: Literal["least_squares", "gradient"] = "least_squares"
    """Of the decoupled optimization."""
    refinement_steps: int = 60
    """Of the photometric descent; 0 leaves the stage out."""
    loss: str = "l1"
    """Of the descent: l1, l2, relative, feature, corner or blur."""

    __pydantic_config__: ClassVar = {"extra": "forbid", "use_attribute_docstrings": True}

    def __post_init__(self) -> None:
        limits = {
            "hypotheses": (0, 4096),
            "range_deg": (0, 180),
            "range_share": (0, 10),
            "rounds": (0, 10),
            "hypothesis_px": (64, 1024),
            "render_px": (64, 2048),
            "iterations": (0, 1000),
            "refinement_steps": (0, 10_000),
        }
        require_within(self, limits)
        for what, value, known in (("solver", self.solver, SOLVERS), ("around", self.around, AROUND)):
            if value not in known:
                raise InvalidOptions(f"there is no {what} '{value}'; known: {', '.join(known)}.", where=what)
        require_loss(self.loss)


SOLVERS = ("least_squares", "gradient")
AROUND = ("prior", "scene")


@dataclass(frozen=True, slots=True)
class Prepared:
    focus: Focus
    level: Rasterizer
    """Of the pruned scene."""
    viewpoints: tuple[Pose, ...]


def prepare(tools: Tools, cache_dir: Path | None) -> Prepared:
    """Find the scene's centre and viewpoints, and prune it: a second, once."""
    cameras = index_cameras(tools.scene, tools.rasterizer, tools.rng)
    few = cameras[:: max(1, len(cameras) // LEVEL_VIEWS)]
    views = [Camera(sized(camera.intrinsics, LEVEL_PX), camera.pose) for camera in few]
    scene = pruned(tools.scene, contributions(tools.scene, tools.rasterizer, views))
    level = RASTERIZERS.load(tools.rasterizer.name).create(scene)
    return Prepared(focus_of_scene(tools.scene, tools.rasterizer), level, tuple(c.pose for c in cameras))


def run(query: Query, tools: Tools, options: Options) -> Iterator[IterationRecord]:
    """Run the stages that are switched on; see the module."""
    prepared: Prepared = tools.prepared
    pose = query.prior or prepared.viewpoints[0]
    images = QueryImages(query, tools.matcher)
    yield IterationRecord("start", pose)
    if options.hypotheses:
        pose = yield from _sampled(pose, images, tools, options)
    if options.iterations:
        pose = yield from _decoupled(pose, images, tools, options)
    if options.refinement_steps:
        yield from _descended(pose, images, tools, options)


@dataclass(frozen=True, slots=True)
class _Hypothesis:
    pose: Pose
    solved: DecoupledSolution | None

    @property
    def support(self) -> float:
        return self.solved.support if self.solved else 0.0


def _sampled(
    start: Pose, images: QueryImages, tools: Tools, options: Options
) -> Generator[IterationRecord, None, Pose]:
    """Draw, score, resample around the best."""
    focus = tools.prepared.focus
    degrees, share, count = options.range_deg, options.range_share, options.hypotheses
    parents = [start]
    from_prior = images.query.prior is not None and options.around == "prior"
    if not from_prior:
        parents = list(tools.prepared.viewpoints)
        degrees, share = SCENE_JITTER_DEG, SCENE_JITTER_SHARE
    scored: list[_Hypothesis] = []
    for number in range(1 + options.rounds):
        poses = around(parents, focus, degrees, share, count, tools.rng)
        if number == 0 and from_prior:
            poses[0] = start  # the prior itself is the first hypothesis
        if number:
            poses = [*parents, *poses]
        for pose in poses:
            yield _scored(pose, images, tools, options, scored)
            if scored[-1].support > ENOUGH:
                break
        scored.sort(key=lambda h: -h.support)
        best = scored[: 8 * PARENTS]
        yield IterationRecord("sample_poses", best[0].pose, candidates=_candidates(best))
        parents = [h.solved.pose for h in best[:PARENTS] if h.solved]
        if best[0].support > ENOUGH or not parents:
            break
        degrees, share, count = SHRINK * degrees, SHRINK * share, max(PARENTS, options.hypotheses // 8)
    return scored[0].pose


def _scored(
    pose: Pose, images: QueryImages, tools: Tools, options: Options, scored: list[_Hypothesis]
) -> IterationRecord:
    """Render a hypothesis on the pruned level, match, and add it to those scored."""
    camera = Camera(sized(images.query.intrinsics, options.hypothesis_px), pose)
    level = Counted(tools.prepared.level, tools.tally)
    matches, view = render_and_match(camera, level, images, tools.image_matcher)
    solved = _solved(matches, pose, images.query, tools, None)
    scored.append(_Hypothesis(pose, solved))
    best = max(scored, key=lambda h: h.support)
    return _record("hypothesis", best.pose, matches, solved, view)


def _decoupled(
    start: Pose, images: QueryImages, tools: Tools, options: Options
) -> Generator[IterationRecord, None, Pose]:
    """Render, match, solve; the pose whose own render had the most support is the answer."""
    pose, best, most = start, start, -1.0
    for iteration in range(options.iterations):
        camera = Camera(sized(images.query.intrinsics, options.render_px), pose)
        matches, view = render_and_match(camera, tools.rasterizer, images, tools.image_matcher)
        solved = _solved(matches, pose, images.query, tools, iteration if options.solver == "gradient" else None)
        if solved is None:
            yield _record("decouple", best, matches, None, view)
            break
        if solved.support > most:
            best, most = solved.pose, solved.support
        step_deg, step_units = pose_distance(pose, solved.pose)
        pose = solved.pose
        yield replace(_record("decouple", best, matches, solved, view), step_deg=step_deg, step_units=step_units)
    return best


def _descended(start: Pose, images: QueryImages, tools: Tools, options: Options) -> Iterator[IterationRecord]:
    intrinsics = sized(images.query.intrinsics, options.render_px)
    loss = loss_against(options.loss, images.resized(intrinsics), images.valid_mask(intrinsics))
    focus = tools.prepared.focus
    best, least = start, np.inf
    steps = refine(tools.rasterizer, intrinsics, start, loss, focus, options.refinement_steps, RATE, END_RATE)
    for step in steps:
        if step.loss < least:
            best, least = step.pose, step.loss
        yield IterationRecord("refine", best, loss=step.loss)


def _solved(
    matches: Correspondences, pose: Pose, query: Query, tools: Tools, gradient_round: int | None
) -> DecoupledSolution | None:
    """Solve one render's matches; None where they are too few."""
    if len(matches.photo_px) < DECOUPLED.min_points:
        return None
    matched = MatchedPoints(
        matches.photo_px.astype(np.float64),
        matches.points_in_world.astype(np.float64),
        query.intrinsics,
        tools.prepared.focus.point_in_world,
    )
    if gradient_round is None:
        return least_squares_solve(matched, pose)
    return gradient_solve(matched, pose, gradient_round)


def _record(
    stage: str, pose: Pose, matches: Correspondences, solved: DecoupledSolution | None, view: View
) -> IterationRecord:
    inlier = solved.inlier if solved else np.zeros(len(matches.photo_px), bool)
    loss = -solved.support if solved else None
    return match_record(stage, pose, matches, inlier, view.camera, loss)


def _candidates(best: list[_Hypothesis]) -> Candidates:
    poses = np.stack([h.pose.world_from_camera for h in best])
    return Candidates(poses, np.array([h.support for h in best]))
