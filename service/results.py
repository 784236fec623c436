"""Results: a record of each step of an estimator, the gate's verdict, and the answer with both.

Frozen, slotted, arrays really read-only, as everything in `service/types.py`, which has the conventions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float32, Float64

from service.types import (
    NO_CORRECTION,
    Camera,
    Intrinsics,
    IntrinsicsCorrection,
    IntrinsicsSource,
    Pose,
    SceneFrame,
    frozen,
)


@dataclass(frozen=True, slots=True)
class MatchVectors:
    """Matches between the photo and a render, for display; at most 300."""

    photo_px: Float32[np.ndarray, "m 2"]
    """In pixels of `Query.rgb`."""
    render_px: Float32[np.ndarray, "m 2"]
    """In pixels of `render_camera`."""
    inlier: Bool[np.ndarray, "m"]
    render_camera: Camera

    LIMIT = 300

    @classmethod
    def sample(
        cls,
        photo_px: Float32[np.ndarray, "m 2"],
        render_px: Float32[np.ndarray, "m 2"],
        inlier: Bool[np.ndarray, "m"],
        render_camera: Camera,
    ) -> MatchVectors:
        """Keep an evenly spread choice of at most LIMIT matches, in their order."""
        # Evenly over their order, from the most to the least certain.
        keep = np.unique(np.linspace(0, max(len(inlier) - 1, 0), min(len(inlier), cls.LIMIT)).astype(int))
        return cls(
            frozen(photo_px[keep], np.float32),
            frozen(render_px[keep], np.float32),
            frozen(inlier[keep], np.bool_),
            render_camera,
        )


@dataclass(frozen=True, slots=True)
class Candidates:
    """Poses that a stage compared."""

    world_from_camera: Float64[np.ndarray, "k 4 4"]
    scores: Float64[np.ndarray, "k"]
    """Higher is better; comparable within one record only."""


@dataclass(frozen=True, slots=True)
class IterationRecord:
    """One line of the trace: an estimator's answer after a step. Small, without images."""

    stage: str
    pose: Pose
    """The answer if the estimator is stopped here: the best pose so far."""
    correction: IntrinsicsCorrection = NO_CORRECTION
    """Of the intrinsics, belongs to the pose; other than the default only where they are approximate."""
    loss: float | None = None
    """The stage's own objective; comparable within a stage only."""
    num_matches: int | None = None
    num_inliers: int | None = None
    step_deg: float | None = None
    """By how much the pose rotated in this step."""
    step_units: float | None = None
    matches: MatchVectors | None = None
    candidates: Candidates | None = None
    alternatives: Candidates | None = None
    """Other poses that the gate accepts, too, most probable first; scores are probabilities, the record's own pose has
    the rest."""
    mirrored: bool = False
    """The photo's mirror image fits the scene better."""
    lens: Intrinsics | None = None
    """The whole upright photo's, if it is a fisheye instead of what was assumed; the correction is then without its
    distortion."""
    index: int = 0
    """Number of the record in the trace; stamped by the driver, like the times."""
    elapsed_s: float = 0.0
    """Wall time since the driver started."""
    cpu_s: float = 0.0
    """CPU time of the job's thread since the driver started."""


class Status(StrEnum):
    """Whether a pose may be used; part of the API."""

    LOCALIZED = "localized"
    UNCERTAIN = "uncertain"
    NOT_LOCALIZED = "not_localized"


class Reason(StrEnum):
    """What decided a result's status. The list is part of the API; `HINTS` has advice for each."""

    VERIFIED = "verified"
    FEW_FEATURES = "few_features"
    NO_MATCHING_VIEW = "no_matching_view"
    RENDER_MISMATCH = "render_mismatch"
    FEW_INLIERS = "few_inliers"
    LOW_COVERAGE = "low_coverage"
    FOCAL_UNCERTAIN = "focal_uncertain"
    INTRINSICS_CONTRADICTED = "intrinsics_contradicted"
    LENS_UNMODELLED = "lens_unmodelled"
    POSITION_UNCERTAIN = "position_uncertain"
    OUTSIDE_CAPTURED_VOLUME = "outside_captured_volume"
    OUTSIDE_PRIOR = "outside_prior"
    AMBIGUOUS = "ambiguous"
    MIRRORED = "mirrored"
    BUDGET_EXHAUSTED = "budget_exhausted"


HINTS: dict[Reason, str] = {
    Reason.VERIFIED: "",
    Reason.FEW_FEATURES: "The photo shows almost no texture: take it sharper, brighter or with more of the scene.",
    Reason.NO_MATCHING_VIEW: (
        "No place in the scene was found that fits the photo: check that it shows this scene, or send a prior."
    ),
    Reason.RENDER_MISMATCH: (
        "The scene rendered at the best pose does not look like the photo: check the intrinsics, and whether the "
        "scene has changed since it was captured."
    ),
    Reason.FEW_INLIERS: (
        "Too few matches agree with the best pose: show more of the captured part, or send intrinsics or a prior."
    ),
    Reason.LOW_COVERAGE: "The best pose sees little of the scene: show the captured part, or send a prior.",
    Reason.FOCAL_UNCERTAIN: (
        "The photo fits the scene, but does not determine its focal length, hence its position: send intrinsics."
    ),
    Reason.INTRINSICS_CONTRADICTED: (
        "The photo fits the scene far better with other intrinsics, which the result lists: check focal length, "
        "distortion and cropping, or send the intrinsics as approximate."
    ),
    Reason.LENS_UNMODELLED: (
        "The photo's lens is neither a pinhole with one radial coefficient nor a fisheye that could be estimated: "
        "calibrate it and send the intrinsics with camera model and distortion."
    ),
    Reason.POSITION_UNCERTAIN: (
        "The photo fits the scene, but hardly determines the camera position: show more of the scene, or nearer things."
    ),
    Reason.OUTSIDE_CAPTURED_VOLUME: (
        "The best pose sees the scene from where it was not captured, so that nothing supports it: take the photo from "
        "nearer to where the scene's photos were taken, or have the scene captured from here, too."
    ),
    Reason.OUTSIDE_PRIOR: (
        "The photo fits the scene, but at a place that the prior's Gaussian or box excludes: check it, or send a wider "
        "one."
    ),
    Reason.AMBIGUOUS: (
        "The photo fits several places, which the result lists: show more of the scene, or send a prior with a box or "
        "a Gaussian, or the device's position, heading and gravity."
    ),
    Reason.MIRRORED: (
        "The photo's mirror image fits the scene better: send it as it was taken; front cameras often mirror."
    ),
    Reason.BUDGET_EXHAUSTED: "The budget ended before the evidence was enough: allow more seconds.",
}


@dataclass(frozen=True, slots=True)
class Verdict:
    """The verification gate's decision on a pose."""

    status: Status
    reason: Reason
    score: float
    """Probability, 0..1, that the pose is as accurate as was asked for: the product of `right_place` and `precise`."""
    inliers: int
    """Matches between the photo and the render at the pose that agree with it; 0 where none were made, as for a
    photo of a sequence that its alignment alone makes clear."""
    gradient_correlation: float
    """Normalized cross-correlation of the gradients of photo and render, -1..1, where they agree best: a quarter
    of the photo may be hidden."""
    coverage: float
    """Share of the photo in which the scene is rendered opaque."""
    covariance: Float64[np.ndarray, "6 6"] | None
    """Of the right perturbation (rotation in rad, translation in units) in the camera frame:
    true = world_from_camera @ exp(twist). None if the evidence does not determine it."""
    correction_sigma: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Standard deviations of the estimated intrinsics, prior included: logarithm of the focal length, k1, principal
    point (x, y) in long sides. 0 where they were given as exact."""
    covariance_given_lens: Float64[np.ndarray, "6 6"] | None = None
    """The covariance if the estimated intrinsics were the true ones; None where they were given as exact."""
    intrinsics_untested: bool = False
    """Whether exact intrinsics can't be confirmed by the photo: its covariance then allows for some error of them."""
    shutter_motion: tuple[float, float] | None = None
    """Of a photo taken while the camera turned, row by row: shear (sideways) and stretch (up or down), in normalized
    units per normalized unit down; the pose is that of the middle row. None: it shows none."""
    fitting_correction: IntrinsicsCorrection | None = None
    """Of exact intrinsics that the photo contradicts: what would make them fit it."""
    signals: Mapping[str, float] = field(default_factory=dict)
    """All signals that the gate measured, by name; `service/pose/verification/gate.py` describes them."""
    right_place: float | None = None
    """Probability, 0..1, that the pose is right as far as its place is concerned, if right and wrong poses were equally
    frequent: within 5 degrees and 1/80 of the training cameras' median distance from the scene's focus. The same model
    for every estimator. None: version 0.1.0 had but the score."""
    precise: float | None = None
    """Probability, 0..1, that a pose in the right place is within the bounds asked for, by its covariance without what
    another step of refinement would change, which counts in `right_place`; at most 0.5 where the intrinsics are in
    doubt. None as `right_place`."""
    asked: tuple[float, float] | None = None
    """The bounds asked for at this pose: degrees, and scene units. None as `right_place`."""

    @property
    def place_probability(self) -> float:
        """`right_place`; of results of version 0.1.0 their score."""
        return self.score if self.right_place is None else self.right_place

    @property
    def rank(self) -> tuple[bool, float]:
        """What the better of two answers to a photo has more of: acceptance, then a surer place."""
        return self.status is Status.LOCALIZED, self.place_probability

    @property
    def focal_sigma(self) -> float:
        """Standard deviation of the logarithm of the estimated focal length; 0 where it was given as exact."""
        return self.correction_sigma[0]


@dataclass(frozen=True, slots=True)
class StageTiming:
    """The time that a stage of the estimator took, seconds."""

    stage: str
    wall_s: float
    cpu_s: float


@dataclass(frozen=True, slots=True)
class PoseEstimate:
    """A finished localization: the answer, the evidence for it, and its trace."""

    pose: Pose
    verdict: Verdict
    intrinsics: Intrinsics
    """Used for the whole upright photo."""
    intrinsics_source: IntrinsicsSource
    scene_id: str
    scene_sha256: str
    estimator: str
    rasterizer: str
    matcher: str
    seed: int
    budget_exhausted: bool
    renders: int
    """Renders of the estimator, a gradient counted as one more; those of a verification after it are not counted."""
    timings: tuple[StageTiming, ...]
    warnings: tuple[str, ...]
    records: tuple[IterationRecord, ...]
    frames: tuple[SceneFrame, ...] = ()
    """Of the scene: other frames than the pose's."""
    scene_ranking: tuple[tuple[str, int], ...] = ()
    """Where several scenes were searched: each one's id, and how many matches agreed, best first."""
    search_summary: str = ""
    """What the search found of a photo that isn't localized, in a sentence; empty where it matched nothing, of a
    localized one, and in results of version 0.1.0."""
    advice: tuple[str, ...] = ()
    """What would help, by what was seen, the most helpful first; nothing for a pose that is localized."""

    @property
    def alternatives(self) -> tuple[tuple[Pose, float], ...]:
        """Other poses that explain the photo, too, and how probable each is, most probable first."""
        others = self.records[-1].alternatives if self.records else None
        if others is None:
            return ()
        return tuple(zip(map(Pose, others.world_from_camera), map(float, others.scores), strict=True))
