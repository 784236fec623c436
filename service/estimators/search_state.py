"""The state of the default estimator's search: what it has found so far, and the verification of what a stage found."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np

from service.estimators.search_config import SearchConfig
from service.interfaces import Answer, Tools
from service.pose.absolute_pose.device_priors import prefers
from service.pose.absolute_pose.pnp import AbsolutePose
from service.pose.features.query_images import QueryImages
from service.pose.features.rendered_views import ViewRenderer
from service.pose.refinement.refine_stage import RefinedPose, refine_stage
from service.pose.refinement.refinement_config import RefinementConfig
from service.pose.retrieval.image_variant import ImageVariant, Retrieval
from service.pose.retrieval.index import ViewIndex
from service.pose.verification.appearance import LOCAL_COLOUR, appearance, colour_edge_correlation
from service.pose.verification.gate import doubted, downgraded, verify
from service.results import IterationRecord, Reason, Status, Verdict
from service.types import IntrinsicsCorrection, Query

Result = TypeVar("Result")
CONCLUSIVE_DOUBTS = (Reason.FOCAL_UNCERTAIN, Reason.POSITION_UNCERTAIN, Reason.INTRINSICS_CONTRADICTED)
"""Doubts about a pose at which photo and render agree: another search would find the same."""


@dataclass(frozen=True, slots=True)
class StageOutcome:
    """What a stage led to."""

    refined: RefinedPose | None
    """None: too few matches agreed, or refinement failed."""
    recognised: bool = False
    """Whether a render at some pose had more matches with the photo than chance: photos of other scenes never do."""
    unmatched: AbsolutePose | None = None
    """The pose of few matches with views that was refined as it was, without a rematch; None: there is none."""


StageResult = Generator[IterationRecord, None, StageOutcome]


@dataclass(frozen=True, slots=True)
class Stage:
    """One stage of a search: its records, and how its outcome is verified."""

    records: StageResult
    variant: ImageVariant
    """Size and rotation in which the photo is compared."""
    from_prior: bool = False
    """Whether the pose is refined from a prior: then the pixels alone may decide."""


@dataclass(frozen=True, slots=True)
class VerifiedPose:
    """A pose that a stage led to, and the gate's verdict on it."""

    refined: RefinedPose
    verdict: Verdict
    variant: ImageVariant
    """Size and rotation in which the photo was compared when the pose was found."""

    @property
    def loss(self) -> float:
        """Mean residual after refinement; infinite where there was none."""
        return np.inf if self.refined.loss is None else self.refined.loss

    def record(self, stage: str) -> IterationRecord:
        """Return a record of this answer."""
        found = self.refined
        return IterationRecord(stage, found.pose, found.correction, found.loss, num_inliers=found.num_inliers)


@dataclass(slots=True)
class SearchState:
    """The tools and images of one search, and its results so far."""

    tools: Tools[ViewIndex]
    images: QueryImages
    renderer: ViewRenderer
    retrieval: Retrieval
    config: SearchConfig = field(default_factory=SearchConfig)
    best: VerifiedPose | None = None
    """The pose with the highest score so far, which is the answer."""
    finished: bool = False
    """Whether the latest stage ends the search: its pose is accepted, or a further search wouldn't remove the doubt."""
    recognised: bool = False
    """Whether any stage so far recognised something (`StageOutcome`)."""
    unmatched: AbsolutePose | None = None
    """That of the latest stage's outcome: if the gate refuses what it led to, it is matched with a render there."""
    assumed: Query | None = None
    """The photo with the lens that was assumed, where that proved to be a fisheye; None: it is `images.query`'s."""

    @classmethod
    def of(cls, query: Query, tools: Tools[ViewIndex], config: SearchConfig) -> SearchState:
        """Return the state at the start."""
        # A mirrored photo has a state, and so pictures and renders, of its own.
        images = QueryImages(query, tools.matcher)
        retrieval = Retrieval(images, tools.prepared, config.retrieval)
        return cls(tools, images, ViewRenderer(tools.rasterizer), retrieval, config)

    def search_in(self, index: ViewIndex) -> None:
        """Search in this index from now on."""
        self.tools = replace(self.tools, prepared=index)
        self.retrieval = Retrieval(self.images, index, self.config.retrieval)

    def verify(
        self,
        found: RefinedPose,
        pixels_may_decide: bool = False,
        refinement_config: RefinementConfig | None = None,
        is_unique: bool = False,
    ) -> Verdict:
        """Return the gate's verdict on a pose, from the render that refinement ended with if it is near enough.

        `refinement_config`: that of the refinement that led to the pose, if it isn't the usual one. `is_unique`: no
        other place is like this one, though the scene may repeat itself.
        """
        config = self.config.verification
        if refinement_config:
            config = replace(config, refinement=refinement_config)
        images = self.images.corrected(found.correction)
        rendered, refinement = found.view_at_pose(images, self.renderer)
        unique = is_unique or not self.tools.prepared.repeats_itself
        verdict = verify(
            images,
            found.pose,
            rendered,
            refinement,
            pixels_may_decide,
            # A pose refined from a prior has no matches behind it.
            supporting_matches=found.num_inliers or 0,
            light_may_differ=unique,
            config=config,
        )
        if not unique and self._shows_other_colours(found, verdict):
            verdict = doubted(verdict, Reason.RENDER_MISMATCH)
        if found.settled:
            return verdict
        # It still moves, however little one step of it says: with an estimated lens, along with the focal length.
        is_exact = images.query.lens_prior is None
        return downgraded(verdict, Reason.POSITION_UNCERTAIN if is_exact else Reason.FOCAL_UNCERTAIN)

    def _shows_other_colours(self, found: RefinedPose, verdict: Verdict) -> bool:
        """Return whether edges in colour speak against a place that the gate accepts, by less than sure colours."""
        config, is_sure = self.config, verdict.signals[LOCAL_COLOUR] >= self.config.sure_local_colour
        is_place = verdict.place_probability >= config.verification.min_localized
        if is_sure or not is_place or verdict.status is Status.NOT_LOCALIZED:
            return False
        return self.colour_edges_at(found) < self.config.least_colour_edges

    def readings_prefer(self, one: VerifiedPose, other: VerifiedPose) -> bool:
        """Return whether what the device measured decides for the first of two answers."""
        return prefers(
            self.images.query.scene_priors,
            one.refined.pose,
            one.verdict.covariance,
            other.refined.pose,
            other.verdict.covariance,
        )

    def appearance_at(self, found: RefinedPose) -> dict[str, float]:
        """Return how alike photo and render are at a pose, by signal."""
        return self._compared_at(found, appearance)

    def colour_edges_at(self, found: RefinedPose) -> float:
        """Return the correlation of the edges in colour of photo and render at a pose."""
        return self._compared_at(found, colour_edge_correlation)

    def _compared_at(self, found: RefinedPose, compare: Callable[..., Result]) -> Result:
        """Return how a function of photo, render and valid mask compares them at a pose."""
        images = self.images.corrected(found.correction)
        rendered, _ = found.view_at_pose(images, self.renderer)
        size = rendered.camera.intrinsics
        return compare(images.resized(size), rendered.frame, images.valid_mask(size))

    def with_answer(self, record: IterationRecord) -> IterationRecord:
        """Return the record with the best answer so far in place of its own pose."""
        if self.best is None:
            return record
        pose, correction = self.best.refined.pose, self.best.refined.correction
        if self.assumed is None:
            return replace(record, pose=pose, correction=correction)
        lens, assumed = self.images.query.corrected(correction).photo_intrinsics, self.assumed.photo_intrinsics
        correction = IntrinsicsCorrection(
            lens.fx / assumed.fx,
            (lens.cx - assumed.cx) / assumed.long_side,
            (lens.cy - assumed.cy) / assumed.long_side,
        )
        return replace(record, pose=pose, correction=correction, lens=lens)

    def answer(self) -> Answer | None:
        """Return the best answer; None: no stage led to one."""
        if self.best is None:
            return None
        return Answer(self.best.refined.pose, self.best.refined.correction, self.best.verdict)


def run_stage(state: SearchState, stage: Stage) -> Generator[IterationRecord, None, None]:
    """Yield a stage's records with the best answer so far, and verify what it led to.

    Where a prior pose, or many matches with a view, led to the answer, the pixels alone may decide.
    """
    outcome = yield from changed(stage.records, state.with_answer)
    state.recognised |= outcome.recognised
    state.unmatched = outcome.unmatched
    found = outcome.refined
    if found is None:
        return
    config, free_lens = state.config, state.images.query.lens_prior is not None
    least = config.photometric_min_inliers_free_lens if free_lens else config.photometric_min_inliers
    pixels_may_decide = stage.from_prior or (found.num_inliers or 0) >= least
    verdict = state.verify(found, pixels_may_decide)
    if _may_be_in_other_light(state, verdict):
        again = yield from refined_in_other_light(state, found)
        if again is not None and again[1].rank > verdict.rank:
            found, verdict = again
    # A later, costlier stage doesn't always lead to a better pose.
    if state.best is None or verdict.rank > state.best.verdict.rank:
        state.best = VerifiedPose(found, verdict, stage.variant)
    # Poses are verified in one size, whatever led to them; refinement from few matches may not have arrived.
    conclusive = verdict.reason in CONCLUSIVE_DOUBTS or only_colours_doubt(state, found, verdict)
    state.finished = verdict.status is Status.LOCALIZED or (conclusive and outcome.unmatched is None)
    loss = 1.0 - state.best.verdict.score
    yield state.with_answer(IterationRecord("verify", found.pose, loss=loss, num_inliers=verdict.inliers))


def only_colours_doubt(state: SearchState, found: RefinedPose, verdict: Verdict) -> bool:
    """Return whether matches, gradients and edges in colour support a refused pose: another search finds the same.

    That is a pose which is accepted where the light may be another; in a scene that repeats itself colours are needed.
    """
    signals, config = verdict.signals, state.config.verification
    if verdict.status is Status.LOCALIZED or verdict.reason is not Reason.RENDER_MISMATCH:
        return False
    if config.model.probability(signals) < config.min_localized:
        return False
    # Without a signal below its floor the edges in colour are what speaks against the pose.
    if config.model.below_floor(signals, light_may_differ=True) or not config.model.below_floor(signals):
        return False
    if signals[LOCAL_COLOUR] >= state.config.min_repeated_colour:
        return True
    return state.colour_edges_at(found) >= state.config.min_colour_edges


def _may_be_in_other_light(state: SearchState, verdict: Verdict) -> bool:
    """Return whether a refused pose shows the photo's edges, so that local light may be why it was refused.

    Not in a scene that repeats itself, where edges agree at wrong poses, too, nor with estimated intrinsics.
    """
    if verdict.status is Status.LOCALIZED or verdict.reason in (Reason.INTRINSICS_CONTRADICTED, Reason.OUTSIDE_PRIOR):
        return False
    if state.tools.prepared.repeats_itself or state.images.query.lens_prior is not None:
        return False
    return verdict.signals["gradients_half"] >= state.config.min_gradients_other_light


def refined_in_other_light(
    state: SearchState, found: RefinedPose, is_unique: bool = False
) -> Generator[IterationRecord, None, tuple[RefinedPose, Verdict] | None]:
    """Refine a pose with local light taken out of photo and renders, and verify the result; None: it diverged.

    `is_unique`: as in `SearchState.verify`.
    """
    config = state.config
    start = AbsolutePose(found.pose, np.ones(found.num_inliers or 0, bool), found.correction)
    stage = refine_stage(
        start, state.images, state.renderer, replace(config.refinement, photometric=config.other_light)
    )
    again = (yield from changed(stage, state.with_answer)).refined
    if again is None:
        return None
    verdict = state.verify(again, refinement_config=config.other_light, is_unique=is_unique)
    # Residuals of evened images don't compare with those of other answers.
    return replace(again, loss=found.loss), verdict


def changed(
    records: Generator[IterationRecord, None, Result], change: Callable[[IterationRecord], IterationRecord]
) -> Generator[IterationRecord, None, Result]:
    """Yield each record as a function changes it; return what the generator returns."""
    while True:
        try:
            record = next(records)
        except StopIteration as end:
            return end.value
        yield change(record)
