"""The stage of a search that refines: render at the pose, refine photometrically on that render, and render again.

`refine_stage` repeats this until another render would look the same; `rematch_and_refine` matches with a render first.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, replace

import numpy as np

from service.geometry import pose_distance
from service.pose.absolute_pose.pnp import AbsolutePose
from service.pose.features.image_sizes import RENDER_PX
from service.pose.features.query_images import QueryImages
from service.pose.features.rendered_views import VIEWS, RenderedView, ViewRenderer, camera_of
from service.pose.matching.match_stages import MATCHING, MatchingConfig, render_and_rematch
from service.pose.refinement.photometric import RefinementResult, refine_photometric
from service.pose.refinement.refinement_config import REFINEMENT, RefinementConfig
from service.results import IterationRecord
from service.types import Camera, IntrinsicsCorrection, Pose


@dataclass(frozen=True, slots=True)
class RefineStageConfig:
    """How rendering and photometric refinement alternate."""

    photometric: RefinementConfig = REFINEMENT
    max_renders: int = 4
    """Renders that are refined on, one after the other; 0: the pose of the matches is the answer."""
    max_renders_free_lens: int = 10
    """As many, at least, with approximate intrinsics after matching with a render at the pose: there is nothing left to
    do but to go on where distance and focal length still move along together, by a few percent a render."""
    first_render_px: int | None = 256
    """Long side of the first render: a small one brings the pose near as well. None: as large as the others."""
    max_first_motion_px: float = 4.0
    max_first_loss: float = 0.03
    """With approximate intrinsics, image motion and mean residual of the first refinement from which on matches are
    better: pose and intrinsics are then so far off that renders would follow one another without an end. With exact
    ones the residual of a pose that has not settled, likewise."""
    settled_px: float = 0.3
    """Where refinement moved the image by less, another render would be the same."""
    levels: int = 2
    """Levels of the image pyramid."""
    later_levels: int = 1
    """Levels after the first render, where many matches led to the pose and the intrinsics are exact: less than a pixel
    is left to refine."""
    first_levels: int = 4
    """Levels on the first render if the pose has fewer than `trusted_inliers`, since it may be far off."""
    trusted_inliers: int = MATCHING.sufficient_inliers
    """Inliers from which on the pose of the matches is the answer where refinement diverges from it."""
    max_divergence_deg: float = 10.0
    """Rotation away from a pose with that many inliers beyond which refinement diverges."""

    def levels_of(self, round_number: int, trusted: bool, free_lens: bool) -> int:
        """Return how many levels of the pyramid a render is refined on, of which 0 is the first: from nearby the coarse
        ones change nothing. `trusted`: many matches led to the pose; `free_lens`: the intrinsics are estimated, too."""
        if round_number == 0:
            return self.levels if trusted else self.first_levels
        return self.later_levels if trusted and not free_lens else self.levels


REFINE_STAGE = RefineStageConfig()


@dataclass(frozen=True, slots=True)
class RefinedPose:
    """A pose for verification, with what refinement has computed for that."""

    pose: Pose
    correction: IntrinsicsCorrection
    """Estimated correction of the query's intrinsics."""
    loss: float | None
    """Mean absolute residual (0..1); None: refinement diverged, and this is the pose of the matches."""
    num_inliers: int | None
    """Matches that agreed with the pose that refinement began with; None: there were none."""
    rendered: RenderedView | None
    """The latest render, at the pose or nearby; None: there is none yet."""
    photometric: RefinementResult | None
    """The refinement on that render that led to the pose; None: the pose was not refined on it."""
    settled: bool = True
    """Whether another render would be the same; False: refinement ended while the pose was still moving."""

    def view_at_pose(self, images: QueryImages, renderer: ViewRenderer) -> tuple[RenderedView, RefinementResult | None]:
        """Return a render within a pixel of the pose, and the refinement on it: both at hand, or a new render."""
        camera = camera_of(images.query, self.pose)
        # The gate measures at this size, and a smaller render of the first round is none.
        if self.rendered is not None and self.rendered.shows_the_same_as(camera, VIEWS.max_motion_px):
            return self.rendered, self.photometric
        return renderer.render(camera), None


@dataclass(frozen=True, slots=True)
class RematchedPose:
    """What `rematch_and_refine` led to."""

    refined: RefinedPose | None
    rounds: int
    """Renders with which enough matches agreed."""


@dataclass(frozen=True, slots=True)
class RefineOutcome:
    """Where `refine_stage` ended."""

    refined: RefinedPose | None
    """None: not even the first render could be refined on."""
    restart: AbsolutePose | None = None
    """Where to match again: the pose did not settle, or refinement diverged from a trusted one; None: nowhere."""
    diverged: bool = False
    """Whether refinement diverged. `restart` is then the pose that it began with, if that was a trusted one."""


def refine_stage(
    found: AbsolutePose,
    images: QueryImages,
    renderer: ViewRenderer,
    config: RefineStageConfig = REFINE_STAGE,
    max_loss: float = np.inf,
    is_rematched: bool = False,
) -> Generator[IterationRecord, None, RefineOutcome]:
    """Render, refine photometrically, render at the result, refine again, until a new render would be the same.

    Ends early where the loss exceeds `max_loss`. Where the pose has not settled, or moves far with estimated
    intrinsics, the outcome says where to match again.
    """
    if config.max_renders == 0:
        return RefineOutcome((yield from _as_matched(found, renderer)))
    # Many agreeing matches outweigh a refinement that leads far away from them.
    trusted, free_lens = found.num_inliers >= config.trusted_inliers, images.query.lens_prior is not None
    small_px = config.first_render_px
    now, refined, rendered = found, None, None
    max_renders = max(config.max_renders, config.max_renders_free_lens if free_lens and is_rematched else 0)
    for round_number in range(max_renders):
        following = _next_render(rendered, now, images, renderer, config, small_px)
        if following is None:
            return RefineOutcome(refined)
        rendered = following
        levels = config.levels_of(round_number, trusted, free_lens)
        result = _refined_on(rendered, now, images, levels, bool(small_px), config)
        diverged = trusted and pose_distance(found.pose, result.pose)[0] > config.max_divergence_deg
        if diverged or result.loss > max_loss or not np.isfinite(result.loss):
            # The last good pose was refined on an earlier render than the latest one.
            refined = refined and replace(refined, rendered=rendered, photometric=None, settled=False)
            is_astray = diverged or not np.isfinite(result.loss)
            return RefineOutcome(refined, found if trusted and is_astray else None, is_astray)
        refined = RefinedPose(result.pose, result.correction, result.loss, found.num_inliers or None, rendered, result)
        yield _record_of(refined, now.pose)
        is_first = free_lens and not round_number and not is_rematched
        if is_first and result.loss > config.max_first_loss and _moved_far(rendered, refined, images, config):
            return RefineOutcome(replace(refined, photometric=None, settled=False), restart=found)
        now, small_px = replace(found, pose=result.pose, correction=result.correction), None
    # Exact intrinsics: where photo and render agree, repeated texture may let refinement alternate between two poses.
    if refined is None or (not free_lens and (refined.loss or 0.0) <= config.max_first_loss):
        return RefineOutcome(refined)
    following = _next_render(rendered, now, images, renderer, config, None)
    if following is None:
        return RefineOutcome(refined)
    # The pose began too far off, or distance and focal length still move along together: fresh matches bring it near.
    return RefineOutcome(replace(refined, rendered=following, photometric=None, settled=False), restart=now)


def _next_render(
    last: RenderedView | None,
    now: AbsolutePose,
    images: QueryImages,
    renderer: ViewRenderer,
    config: RefineStageConfig,
    long_side: int | None,
) -> RenderedView | None:
    """Return a render at the pose; None if the last one shows the same, so that refinement has settled."""
    query = images.query.corrected(now.correction)
    camera = camera_of(query, now.pose, long_side)
    if last is None:
        return renderer.near(camera)
    return None if last.shows_the_same_as(camera, config.settled_px) else renderer.render(camera)


def _moved_far(rendered: RenderedView, refined: RefinedPose, images: QueryImages, config: RefineStageConfig) -> bool:
    """Return whether a refinement moved the image further than refinement is trusted to."""
    size = rendered.camera.intrinsics
    camera = camera_of(images.query.corrected(refined.correction), refined.pose, size.long_side)
    tolerance_px = config.max_first_motion_px * size.long_side / RENDER_PX
    return not rendered.shows_the_same_as(camera, tolerance_px)


def _record_of(refined: RefinedPose, before: Pose) -> IterationRecord:
    step_deg, step_units = pose_distance(before, refined.pose)
    return IterationRecord(
        "refine",
        refined.pose,
        refined.correction,
        refined.loss,
        num_inliers=refined.num_inliers,
        step_deg=step_deg,
        step_units=step_units,
    )


def _refined_on(
    rendered: RenderedView,
    now: AbsolutePose,
    images: QueryImages,
    levels: int,
    coarse: bool,
    config: RefineStageConfig,
) -> RefinementResult:
    """Refine the pose and, where they are approximate, the intrinsics on one render."""
    size = rendered.camera.intrinsics
    start = Camera(images.query.intrinsics.resized(size.width, size.height), now.pose)
    return refine_photometric(
        images.resized(size),
        rendered.frame,
        rendered.camera,
        start,
        levels,
        now.correction,
        images.query.lens_prior,
        images.valid_mask(size),
        coarse,
        config.photometric,
    )


def rematch_and_refine(
    found: AbsolutePose,
    images: QueryImages,
    renderer: ViewRenderer,
    matching: MatchingConfig = MATCHING,
    config: RefineStageConfig = REFINE_STAGE,
    before: RefinedPose | None = None,
) -> Generator[IterationRecord, None, RematchedPose]:
    """Match with renders at the pose, then refine; where refinement diverges the pose of the matches is the answer.

    `before` is what an earlier refinement led to: the answer if no match with a render succeeds.
    """
    rematch = yield from render_and_rematch(found, images, renderer, matching)
    if rematch.found is None:
        # A pose that loses its matches after it had some is wrong.
        return RematchedPose(before if rematch.rounds == 0 else None, rematch.rounds)
    outcome = yield from refine_stage(rematch.found, images, renderer, config, is_rematched=True)
    if not outcome.diverged or outcome.restart is None:
        return RematchedPose(outcome.refined, rematch.rounds)
    return RematchedPose((yield from _as_matched(outcome.restart, renderer)), rematch.rounds)


def _as_matched(found: AbsolutePose, renderer: ViewRenderer) -> Generator[IterationRecord, None, RefinedPose]:
    """Take the pose of the matches for the answer."""
    yield IterationRecord("refine", found.pose, found.correction, num_inliers=found.num_inliers)
    return RefinedPose(found.pose, found.correction, None, found.num_inliers, renderer.latest, None)
