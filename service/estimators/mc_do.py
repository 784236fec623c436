"""The supplement's method: Monte Carlo initialization (MC), decoupled optimization (DO), L1 refinement.

    hypotheses around the prior, or over the whole scene -> rendered from the pruned scene, matched with the photo,
    scored -> resampled around the best -> DO: 10 times render, match, solve -> gradient descent on the L1 loss

From the supplement: the three stages and their order; matches as the score; 10 iterations; rotation by the angles
between match vectors, translation by their lengths; L1 as the loss. Ours, because it is silent: the hypotheses'
number, range and resampling, which continues from the poses that the best ones' matches are solved to; the score (the
weight of the matches that one rotation about the scene's centre and one translation explain: from where it is high,
DO converges); the second-order solver (`service.pose.absolute_pose.decoupled`; the first-order one is
`service.pose.descent.decoupled_gradient`); XFeat where the paper most likely had LoFTR; small renders.

Deviations: DO's matches are of rendered points with a depth, and stay fixed while a solver works on them; the answer of
MC and DO is the best pose so far, not the last.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np

from service.errors import InvalidOptions
from service.geometry import pose_distance
from service.interfaces import Rasterizer, Tools
from service.pose.absolute_pose.decoupled import DECOUPLED, DecoupledSolution, MatchedPoints, least_squares_solve
from service.pose.descent.contribution_pruning import PRUNING, contributions, prune
from service.pose.descent.decoupled_gradient import gradient_solve
from service.pose.descent.gradient_descent import descend, require_within
from service.pose.descent.hypotheses import around
from service.pose.descent.losses import loss_against, require_loss
from service.pose.features.image_sizes import RENDER_PX, sized
from service.pose.features.query_images import QueryImages
from service.pose.features.rendered_views import View
from service.pose.features.scene_focus import Focus, focus_of_scene
from service.pose.matching.correspondences import Correspondences
from service.pose.matching.render_and_match import match_record, render_and_match
from service.pose.retrieval.viewpoints import index_cameras
from service.render import RASTERIZERS
from service.render.render_counter import Counted
from service.results import Candidates, IterationRecord
from service.types import Camera, Pose, Query

MATCHES_IMAGES = True
"""The method also works with matchers that match images in pairs, without features of one image."""


@dataclass(frozen=True, slots=True)
class MonteCarloConfig:
    """The Monte Carlo stage; all values are ours."""

    scene_range_deg: float = 10.0
    """Range per axis around each of the scene's viewpoints, where there is no prior."""
    scene_range_share: float = 0.05
    """Of translations there: a share of the distance to the scene's centre."""
    kept_hypotheses: int = 8
    """Best hypotheses that a resampling round draws around, at the poses that their matches are solved to."""
    resampled_share: float = 0.125
    """Hypotheses of a resampling round, as a share of the first one's; at least `kept_hypotheses`."""
    shrink: float = 0.3
    """Factor of the range from one round to the next."""
    enough_support: float = 60.0
    """Support that ends the search: no wrong hypothesis had more than 30."""
    shown: int = 64
    """Best hypotheses that a round's record lists."""


MONTE_CARLO = MonteCarloConfig()


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
                raise InvalidOptions(f"unknown {what} '{value}'; known: {', '.join(known)}.", where=what)
        require_loss(self.loss)


SOLVERS = ("least_squares", "gradient")
AROUND = ("prior", "scene")


@dataclass(frozen=True, slots=True)
class Prepared:
    """What is computed once for a scene."""

    focus: Focus
    pruned: Rasterizer
    """Of the pruned scene, for the hypotheses."""
    viewpoints: tuple[Pose, ...]


def prepare(tools: Tools[None], cache_dir: Path | None) -> Prepared:
    """Return the scene's focus and viewpoints, and a renderer of the pruned scene: takes a second, once a scene."""
    cameras = index_cameras(tools.scene, tools.rasterizer, tools.rng)
    # Evenly spread: neighbouring viewpoints see the same Gaussians.
    few = cameras[:: max(1, len(cameras) // PRUNING.num_views)]
    views = [Camera(sized(camera.intrinsics, PRUNING.long_side_px), camera.pose) for camera in few]
    scene = prune(tools.scene, contributions(tools.scene, tools.rasterizer, views))
    renderer = RASTERIZERS.load(tools.rasterizer.name).create(scene)
    return Prepared(focus_of_scene(tools.scene, tools.rasterizer), renderer, tuple(c.pose for c in cameras))


def run(
    query: Query, tools: Tools[Prepared], options: Options, config: MonteCarloConfig = MONTE_CARLO
) -> Generator[IterationRecord, None, None]:
    """Run the stages that the options leave in; see the module. A record's pose is the best one so far."""
    # Without a prior the records before the first hypothesis need some pose.
    pose = query.prior or tools.prepared.viewpoints[0]
    images = QueryImages(query, tools.matcher)
    yield IterationRecord("start", pose)
    if options.hypotheses:
        pose = yield from _sample(pose, images, tools, options, config)
    if options.iterations:
        pose = yield from _optimize_decoupled(pose, images, tools, options)
    if options.refinement_steps:
        yield from _descend(pose, images, tools, options)


@dataclass(frozen=True, slots=True)
class _Hypothesis:
    pose: Pose
    solved: DecoupledSolution | None

    @property
    def support(self) -> float:
        return self.solved.support if self.solved else 0.0


def _sample(
    start: Pose, images: QueryImages, tools: Tools[Prepared], options: Options, config: MonteCarloConfig
) -> Generator[IterationRecord, None, Pose]:
    """Draw hypotheses, score them, resample around the best; return the best."""
    focus = tools.prepared.focus
    degrees, share, count = options.range_deg, options.range_share, options.hypotheses
    parents = [start]
    from_prior = images.query.prior is not None and options.around == "prior"
    if not from_prior:
        parents = list(tools.prepared.viewpoints)
        degrees, share = config.scene_range_deg, config.scene_range_share
    scored: list[_Hypothesis] = []
    for number in range(1 + options.rounds):
        poses = around(parents, focus, degrees, share, count, tools.rng)
        if number == 0 and from_prior:
            poses[0] = start  # the prior itself is the first hypothesis
        # What the best ones' matches were solved to is scored, too, with a render of its own.
        if number:
            poses = [*parents, *poses]
        for record in _scores(poses, images, tools, options, scored):
            yield record
            # From this support on DO converges: further hypotheses would cost renders for nothing.
            if scored[-1].support > config.enough_support:
                break
        # Of all rounds: an early hypothesis may stay the best one.
        scored.sort(key=lambda h: -h.support)
        best = scored[: config.shown]
        yield IterationRecord("sample_poses", best[0].pose, candidates=_candidates(best))
        parents = [h.solved.pose for h in best[: config.kept_hypotheses] if h.solved]
        if best[0].support > config.enough_support or not parents:
            break
        degrees, share = config.shrink * degrees, config.shrink * share
        count = max(config.kept_hypotheses, int(config.resampled_share * options.hypotheses))
    return scored[0].pose


def _scores(
    poses: Sequence[Pose], images: QueryImages, tools: Tools[Prepared], options: Options, scored: list[_Hypothesis]
) -> Iterator[IterationRecord]:
    """Render hypotheses from the pruned scene; match and solve one after the other, and append each to those scored."""
    size = sized(images.query.intrinsics, options.hypothesis_px)
    renderer = Counted(tools.prepared.pruned, tools.tally)
    found = render_and_match([Camera(size, pose) for pose in poses], renderer, images, tools.image_matcher)
    for pose, (matches, view) in zip(poses, found, strict=True):
        solved = _solve(matches, pose, images.query, tools, None)
        scored.append(_Hypothesis(pose, solved))
        best = max(scored, key=lambda h: h.support)
        yield _record("hypothesis", best.pose, matches, solved, view)


def _optimize_decoupled(
    start: Pose, images: QueryImages, tools: Tools[Prepared], options: Options
) -> Generator[IterationRecord, None, Pose]:
    """Render, match and solve, `iterations` times; return the solution with the most support."""
    pose, best, most = start, start, -1.0
    for iteration in range(options.iterations):
        camera = Camera(sized(images.query.intrinsics, options.render_px), pose)
        matches, view = next(render_and_match([camera], tools.rasterizer, images, tools.image_matcher))
        solved = _solve(matches, pose, images.query, tools, iteration if options.solver == "gradient" else None)
        # Without enough matches the next render would be the same.
        if solved is None:
            yield _record("decouple", best, matches, None, view)
            break
        # A later iteration may be worse, as its matches are others.
        if solved.support > most:
            best, most = solved.pose, solved.support
        step_deg, step_units = pose_distance(pose, solved.pose)
        pose = solved.pose
        yield replace(_record("decouple", best, matches, solved, view), step_deg=step_deg, step_units=step_units)
    return best


def _descend(start: Pose, images: QueryImages, tools: Tools[Prepared], options: Options) -> Iterator[IterationRecord]:
    """Descend the photometric loss from `start`; each record has the pose of the least loss so far."""
    intrinsics = sized(images.query.intrinsics, options.render_px)
    loss = loss_against(options.loss, images.resized(intrinsics), images.valid_mask(intrinsics))
    focus = tools.prepared.focus
    # The loss doesn't fall in every step, so the last pose need not be the best.
    best, least = start, np.inf
    for step in descend(tools.rasterizer, intrinsics, start, loss, focus, options.refinement_steps):
        if step.loss < least:
            best, least = step.pose, step.loss
        yield IterationRecord("refine", best, loss=step.loss)


def _solve(
    matches: Correspondences, pose: Pose, query: Query, tools: Tools[Prepared], gradient_round: int | None
) -> DecoupledSolution | None:
    """Solve one render's matches for the pose; None where they are too few.

    `gradient_round` counts the renders before this one for the gradient solver; None: by least squares.
    """
    if len(matches.photo_px) < DECOUPLED.min_points:
        return None
    # Matchers return float32, too coarse for the normal equations.
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
