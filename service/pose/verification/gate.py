"""The verification gate: one rule that says of any estimator's answer whether to believe it.

Signals of several kinds are measured at the pose: whether the render there has the photo's gradients (fine structure,
whatever the exposure) and its colours, each over most of the photo and over its better half (the other may be hidden),
and whether the colours agree where the gradients do (a row of like things seen one further, and a mirror image, have
the right edges and the wrong colours; see `appearance.py`); how many fresh matches between photo and render agree with
the pose, to the pixel and without any fit, what share that is, and how they are spread; and by how much alignment would
still move the pose. Together they give a probability that the pose is right (within 5 degrees and 1/80 of the
distance), by a logistic model whose weights `splatfix bench gate` fits and tests: each signal is cut off at both ends
and weighs positively. Sums forgive, so each signal has a floor besides, that 249 of 250 right poses stay above: below
it a pose is in doubt, however good the rest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, Float32, Float64

from service.geometry import reprojection_error_px
from service.interfaces import Frame, Tools
from service.pose.absolute_pose.prior_region import inside_prior
from service.pose.features.views import known_at, photo_at, photo_features, rendered_frame, rendered_view
from service.pose.matching.correspondences import Correspondences, correspondences
from service.pose.refinement.uncertainty import PoseUncertainty, pose_uncertainty
from service.pose.verification.appearance import APPEARANCE, MIN_ALPHA, appearance, both_known
from service.results import Reason, Status, Verdict
from service.types import Camera, Intrinsics, Pose, Query

MAX_ERROR_PX = 4.0
"""At RENDER_PX. XFeat's points scatter by 1.5."""
MIN_FEATURES = 30
CELLS = 6
"""Of a photo's side, over which matches are spread."""


@dataclass(frozen=True, slots=True)
class Scale:
    """Maps a signal to 0..1: 0 at `hopeless` and beyond, 1 at `certain` and beyond."""

    hopeless: float
    certain: float
    ratio: bool = False
    """Compare by ratios."""

    def __call__(self, value: Float[np.ndarray, "*n"] | float) -> Float64[np.ndarray, "*n"] | np.float64:
        ends = np.array([self.hopeless, self.certain])
        if self.ratio:
            value, ends = np.log(np.maximum(value, 1e-6)), np.log(ends)
        return np.clip((np.asarray(value) - ends[0]) / (ends[1] - ends[0]), 0.0, 1.0)

    def value_at(self, scaled: float) -> float:
        """Return the signal that is mapped to this."""
        if self.ratio:
            return float(self.hopeless * (self.certain / self.hopeless) ** scaled)
        return self.hopeless + scaled * (self.certain - self.hopeless)


SCALES = {
    "gradients": Scale(0.3, 0.95),
    "gradients_half": Scale(0.5, 0.99),
    "colours": Scale(0.2, 0.97),
    "colours_half": Scale(0.5, 0.99),
    "tints": Scale(0.5, 0.99),
    "drift_px": Scale(20.0, 0.3, ratio=True),
    "inliers": Scale(10.0, 300.0, ratio=True),
    "inlier_share": Scale(0.1, 0.8),
    "inlier_spread": Scale(0.1, 0.9),
}
WITH_MATCHES = {
    "bias": -6.7, "gradients": 0.0, "gradients_half": 2.43, "colours": 0.0, "colours_half": 0.0,
    "tints": 0.0, "drift_px": 4.03, "inliers": 0.0, "inlier_share": 4.67, "inlier_spread": 0.0,
}  # fmt: skip
BY_PIXELS = {
    "bias": -6.69, "gradients": 2.68, "gradients_half": 4.16, "colours": 0.0, "colours_half": 0.0, "tints": 0.0,
    "drift_px": 4.28,
}  # fmt: skip
FLOORS = {
    "gradients": 0.613, "gradients_half": 0.836, "colours": 0.662, "colours_half": 0.863, "tints": 0.935,
    "drift_px": 6.025, "inliers": 106.731, "inlier_share": 0.513, "inlier_spread": 0.437,
}  # fmt: skip
"""In `drift_px` a ceiling. In `tints` between right poses, which have 0.948 and more, and those that mistake a thing
for its like or for its mirror image: nearly all at most 0.93."""
LOCALIZED, UNCERTAIN = 0.8, 0.1
"""Least probabilities."""
DOUBTFUL = 0.5
"""What remains of a good score where a signal or the lens is in doubt, or hardly anything is seen."""
HOPELESS = 0.35
"""Mean of the scaled signals of a kind, below which nothing was recognised: foreign photos have 0.0 to 0.3."""
UNLIKE = 0.3
"""Scaled mean of how photo and render look below which nothing else need be looked at: right poses of photos spoilt
within reason and beyond have 0.76 and more, those of photos of other scenes 0.0 to 0.36."""
NO_MATCHES = {"inliers": 0.0, "inlier_share": 0.0, "inlier_spread": 0.0}
MIN_COVERAGE = 0.04
MAX_SIGMA_SHARE = 0.0085
"""Of the place's standard deviation in what is seen: six in seven such places are within the bound of what is right
(0.0125). Photos of the test scenes have 0.0002 to 0.002, cropped to an eighth 0.01."""
UNDETERMINED = 1.0
"""Of the same: from a picture of nothing alignment has nowhere to go, which speaks for no pose."""
ENOUGH_FOCAL_SIGMA = 0.008
"""Of the logarithm: a focal length 1 % off moves the camera by 1 % of the distance."""
CONTRADICTION = 0.02
"""Of the logarithm, and six standard deviations."""


def verify(query: Query, pose: Pose, tools: Tools) -> Verdict:
    """Judge a pose. Costs a render and its features unless the job has just made them (see pose/features/views.py)."""
    key = _key(query, pose)
    if key not in tools.memo:
        tools.memo[key] = _verdict(query, pose, tools)
    return tools.memo[key]


def glance(query: Query, pose: Pose, tools: Tools, inliers: int = 0) -> Verdict | None:
    """Judge a pose by the pixels alone: matches cost most. None where these don't make it clear.

    For poses that something else speaks for: the camera was expected there, or there are `inliers` with a view, which
    the verdict then names. `verify` says the same after it.
    """
    frame, camera = rendered_frame(pose, query, tools)
    signals, pixels = _seen(query, pose, frame, camera, tools)
    if not clear(signals):
        return None
    verdict = _within_region(replace(judged(signals, pixels, query.focal_sigma), inliers=inliers), query, pose)
    tools.memo[_key(query, pose)] = verdict
    return verdict


def _key(query: Query, pose: Pose) -> tuple[str, bytes, Intrinsics]:
    return "verdict", pose.world_from_camera.tobytes(), query.intrinsics


def _verdict(query: Query, pose: Pose, tools: Tools) -> Verdict:
    frame, camera = rendered_frame(pose, query, tools)
    photo, size = photo_features(query, tools), camera.intrinsics
    signals, pixels = _seen(query, pose, frame, camera, tools)
    if _unlike(signals):
        return judged(signals | NO_MATCHES, pixels, query.focal_sigma, len(photo.scores) < MIN_FEATURES)
    view, _ = rendered_view(pose, query, tools)
    known = known_at(query, tools, size)
    found = correspondences(photo, view, tools.matcher)
    signals |= _match_signals(found, both_known(frame, known), query, size, pose)
    if known is not None:  # as many as a whole photo would have
        signals["inliers"] /= max(float(known.mean()), 0.1)
    verdict = judged(signals, pixels, query.focal_sigma, len(photo.scores) < MIN_FEATURES)
    return _within_region(verdict, query, pose)


def _seen(
    query: Query, pose: Pose, frame: Frame, camera: Camera, tools: Tools
) -> tuple[dict[str, float], PoseUncertainty | None]:
    """Return the signals and the evidence of the pixels; `camera` rendered the frame at the pose or nearby."""
    size = camera.intrinsics
    photo, known = photo_at(query, tools, size), known_at(query, tools, size)
    looks = appearance(photo, frame, known)
    pixels = None
    if not _unlike(looks):
        answer = Camera(query.intrinsics.resized(size.width, size.height), pose)
        pixels = pose_uncertainty(photo, frame, camera, answer, query.focal_sigma, known, tools.memo.get("aligned"))
    return looks | geometry_signals(frame, size, pixels), pixels


def _unlike(signals: Mapping[str, float]) -> bool:
    return bool(np.mean([SCALES[name](signals[name]) for name in APPEARANCE]) < UNLIKE)


def _within_region(verdict: Verdict, query: Query, pose: Pose) -> Verdict:
    return verdict if inside_prior(query.region, pose) else doubted(verdict, Reason.OUTSIDE_PRIOR)


def doubted(verdict: Verdict, reason: Reason, score: float = DOUBTFUL) -> Verdict:
    """Return a verdict that would be `localized`, but for this reason; others have theirs already."""
    if verdict.status is not Status.LOCALIZED:
        return verdict
    return replace(verdict, status=Status.UNCERTAIN, reason=reason, score=min(verdict.score, score))


def geometry_signals(frame: Frame, size: Intrinsics, pixels: PoseUncertainty | None) -> dict[str, float]:
    """Return the signals of what is seen and how well it fixes the pose; `pixels` is the evidence on this frame."""
    depth = frame.median_depth[::4, ::4]
    typical_depth = float(np.median(depth[depth > 0])) if (depth > 0).any() else 1.0
    drift = spread = np.inf
    if pixels is not None:
        spread = float(np.sqrt(np.trace(pixels.covariance[3:6, 3:6]))) / typical_depth
        if spread < UNDETERMINED:
            drift = size.fx * float(
                np.linalg.norm(pixels.last_step[:3]) + np.linalg.norm(pixels.last_step[3:]) / typical_depth
            )
    return {
        "coverage": float((frame.alpha > MIN_ALPHA).mean()),
        "drift_px": min(drift, 1e3),
        "sigma_share": min(spread, 1e3),
    }


def _match_signals(
    found: Correspondences, alpha: Float32[np.ndarray, "h w"], query: Query, size: Intrinsics, pose: Pose
) -> dict[str, float]:
    scale = size.long_side / query.intrinsics.long_side
    error = scale * reprojection_error_px(found.photo_px, found.points_in_world, query.intrinsics, pose)
    inlier = error < MAX_ERROR_PX
    opaque = cv2.resize(alpha, (CELLS, CELLS), interpolation=cv2.INTER_AREA) > 0.5 * MIN_ALPHA
    cell = (found.photo_px[inlier] * (CELLS / np.array([query.intrinsics.width, query.intrinsics.height]))).astype(int)
    held = np.zeros((CELLS, CELLS), bool)
    held[tuple(np.clip(cell[:, ::-1], 0, CELLS - 1).T)] = True
    return {
        "inliers": float(inlier.sum()),
        "inlier_share": float(inlier.mean()) if len(inlier) else 0.0,
        "inlier_spread": float((held & opaque).sum() / max(opaque.sum(), 1)),
    }


def probability(signals: Mapping[str, float]) -> float:
    """Return how probably a pose with these signals is right, 0..1; without signals of matches by the others."""
    weights = WITH_MATCHES if "inliers" in signals else BY_PIXELS
    logit = weights["bias"] + sum(weights[name] * SCALES[name](signals[name]) for name in weights if name != "bias")
    return float(1.0 / (1.0 + np.exp(-logit)))


def clear(signals: Mapping[str, float]) -> bool:
    """Tell whether the signals of the pixels are enough to take a pose for right."""
    return probability(signals) >= LOCALIZED and not in_doubt(signals)


def in_doubt(signals: Mapping[str, float]) -> list[str]:
    """Return the signals that are below their floors."""
    scaled = {
        name: (SCALES[name](value), SCALES[name](FLOORS[name])) for name, value in signals.items() if name in FLOORS
    }
    return [name for name, (value, floor) in scaled.items() if value < floor]


def judged(
    signals: Mapping[str, float], pixels: PoseUncertainty | None, focal_sigma: float, few_features: bool = False
) -> Verdict:
    """Return the verdict on a pose; `focal_sigma` is what was known of the lens."""
    score = min(probability(signals), DOUBTFUL if in_doubt(signals) else 1.0)
    doubt, covariance, sigma = _of_lens(pixels, focal_sigma)
    little = signals["coverage"] < MIN_COVERAGE
    if little:
        doubt = Reason.LITTLE_SCENE_IN_VIEW
    elif doubt is None and signals["sigma_share"] > MAX_SIGMA_SHARE:
        doubt = Reason.PLACE_UNCERTAIN
    if score < LOCALIZED:
        reason = Reason.FEW_FEATURES if few_features else _weakest(signals)
        if little and reason in (Reason.FEW_INLIERS, Reason.RENDER_DISAGREES):
            reason = Reason.LITTLE_SCENE_IN_VIEW  # of which the others are consequences
    elif doubt:
        score, reason = DOUBTFUL, doubt
    else:
        reason = Reason.AGREES
    status = (
        Status.LOCALIZED if score >= LOCALIZED else Status.UNCERTAIN if score >= UNCERTAIN else Status.NOT_LOCALIZED
    )
    inliers, agreement = int(signals.get("inliers", 0)), signals["gradients"]
    return Verdict(status, reason, score, inliers, agreement, signals["coverage"], covariance, sigma, signals)


def _weakest(signals: Mapping[str, float]) -> Reason:
    """Return why the pose is not believed."""
    scaled = {name: float(SCALES[name](value)) for name, value in signals.items() if name in SCALES}
    scaled = {name: scaled[name] for name in in_doubt(signals)} or scaled
    matches = np.mean([value for name, value in scaled.items() if name.startswith("inlier")] or [1.0])
    pixels = np.mean([value for name, value in scaled.items() if not name.startswith("inlier")] or [1.0])
    if max(matches, pixels) < HOPELESS:
        return Reason.NO_MATCHING_VIEW
    return Reason.FEW_INLIERS if matches < pixels else Reason.RENDER_DISAGREES


def _of_lens(
    pixels: PoseUncertainty | None, known_sigma: float
) -> tuple[Reason | None, Float64[np.ndarray, "6 6"] | None, float]:
    """Return a doubt about the lens, the pose's covariance, and that of the focal length's logarithm."""
    if pixels is None:
        return None, None, known_sigma
    covariance = pixels.covariance[:6, :6] + np.outer(pixels.last_step, pixels.last_step)
    if known_sigma:
        sigma = max(float(np.sqrt(pixels.covariance[6, 6])), abs(pixels.focal_step))  # a method may not estimate it
        return (Reason.FOCAL_UNCERTAIN if sigma > ENOUGH_FOCAL_SIGMA else None), covariance, sigma
    off = abs(pixels.focal_step)
    contradicted = off > CONTRADICTION and off > 3 * pixels.focal_sigma
    return (Reason.INTRINSICS_CONTRADICTED if contradicted else None), covariance, 0.0
