"""`splatfix bench gate`: gather right and wrong poses, fit the verification gate's weights, and test them.

Right poses are the estimator's answers to test photos, as they are and spoilt within reason, that lie within the
bound. Wrong ones are made by stress:

    foreign     photos of the other scenes, localized in this one      garbage   patterns, noise and text, localized
    mirrored    the test photos, left and right exchanged, localized   beyond    spoilt beyond reason, localized
    moved       true poses moved by 0.06 to 1.5 units and up to 8 degrees, as they are (by 0.002 to 0.012 units and up
                to 0.12 degrees they are right: samples of what less exact methods answer: near)
    drifted     the same, aligned from there, where that doesn't lead back
    followed    the same, as the tracker does it: judged by its glance alone, with the weights that are in use

Weights and floors are fitted on all scenes but one and tested on that one, for each in turn; what is printed as a
result is of those tests. Those in `service/pose/verification/gate.py` were fitted on all, from such a run. Floors are
of right poses within reason.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64

from service.bench.bench_photos import BenchPhoto, sent
from service.bench.localize import Subject, subject
from service.bench.pose_metrics import COARSE, errors, nees
from service.estimators.view_index import Options
from service.geometry import moved
from service.interfaces import Tools
from service.localize import Request, localize
from service.photos.images import encode_image, read_query, resized
from service.pose.features.views import photo_at, rendered_frame
from service.pose.matching.search_stages import GOOD_MATCH
from service.pose.refinement.photometric import refine_photometric
from service.pose.verification.gate import BY_PIXELS, DOUBTFUL, LOCALIZED, SCALES, WITH_MATCHES, verify
from service.pose.verification.mirror_images import mirrored
from service.results import Reason, Status, Verdict
from service.tracking import aligned_from, glance
from service.types import Camera, Intrinsics, Pose, Query

WITHIN_REASON: tuple[tuple[str, ...], ...] = (
    (), ("gain=0.7",), ("gain=1.4",), ("gamma=0.6",), ("gamma=1.6",), ("white_balance=1.25",), ("blur=4",),
    ("noise=0.1",), ("jpeg=20",), ("scale=0.5",), ("occlusion=0.2",), ("occlusion=0.35",), ("roll=45",), ("crop=0.5",),
    ("saturation=0",),
)  # fmt: skip
BEYOND: tuple[tuple[str, ...], ...] = (
    ("occlusion=0.6",), ("occlusion=0.75",), ("blur=14",), ("noise=0.4",), ("crop=0.2",), ("crop=0.12",),
)  # fmt: skip
MOVES = 6
"""A photo."""
MOVED, NEAR = ((0.06, 1.5), 8.0), ((0.002, 0.012), 0.12)
"""Units and degrees."""
FOREIGN = 8
"""Photos of each other scene."""
GARBAGE = 8
OCCLUDERS = 2
"""Photos of each other scene that rectangles are cut from."""
PENALTY = 0.02
"""On the squared weights, against certainty that few samples don't give."""
BELOW_FLOOR = 0.003
"""Share of right poses, for each signal: at most 3 % may be refused, and there are nine floors."""
BINS = 10
OTHER_DOUBTS = (
    Reason.FOCAL_UNCERTAIN,
    Reason.INTRINSICS_CONTRADICTED,
    Reason.LITTLE_SCENE_IN_VIEW,
    Reason.PLACE_UNCERTAIN,
    Reason.AMBIGUOUS,
    Reason.MIRRORED,
)


@dataclass(frozen=True, slots=True)
class Sample:
    scene: str
    kind: str
    photo: str
    right: bool
    signals: Mapping[str, float]
    doubted: bool
    """For another reason than the signals: never localized."""
    nees: float | None
    glanced: bool | None = None
    """Whether the tracker's glance takes the pose for right; None: that wasn't asked."""
    matched: bool = False
    """Whether many matches with a view led there: then the pixels alone may decide."""


def run(
    folders: Sequence[Path],
    *,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
    cache_dir: Path | None = None,
) -> dict[str, Any]:
    """Return the object that `--json` writes. Raises SceneError."""
    subjects = [subject(Path(folder), cache_dir=cache_dir) for folder in folders]
    samples: list[Sample] = []
    total = sum(len(one.photos) for one in subjects)
    done = 0
    for one in subjects:
        one.loaded.prepare("view_index")
        rng = np.random.default_rng(seed)
        others = [other for other in subjects if other is not one]
        cut = [_pixels(photo) for other in others for photo in other.photos[:OCCLUDERS]]
        for photo in one.photos:
            samples += _of_photo(one, photo, cut, rng)
            done += 1
            if progress:
                progress(done, total)
        samples += _foreign(one, others)
    return summary(samples) | {"samples": [_line(sample) for sample in samples]}


def _line(sample: Sample) -> dict[str, Any]:
    names = ("scene", "kind", "photo", "right", "doubted", "nees", "glanced", "matched")
    return {name: getattr(sample, name) for name in names} | {"signals": dict(sample.signals)}


def _pixels(photo: BenchPhoto) -> Float32[np.ndarray, "h w 3"]:
    return read_query(photo.path.read_bytes()).rgb.astype(np.float32) / 255


def _of_photo(
    one: Subject, photo: BenchPhoto, occluders: Sequence[Float32[np.ndarray, "_ _ 3"]], rng: np.random.Generator
) -> Iterator[Sample]:
    """Yield the samples of one test photo."""
    for modify in (*WITHIN_REASON, *BEYOND):
        file = sent(photo, modify, one.background_rgb, int(rng.integers(1 << 30)), occluders)
        query = read_query(file.data, intrinsics=file.told, background_rgb=one.background_rgb)
        kind = ("beyond " if modify in BEYOND else "") + ("clean" if not modify else modify[0])
        yield _localized(one, kind, photo.name, query, file.truth.pose)
    data = photo.path.read_bytes()
    query = read_query(data, intrinsics=photo.camera.intrinsics, background_rgb=one.background_rgb)
    yield _localized(one, "mirrored", photo.name, mirrored(query), None)
    for _ in range(MOVES):
        pose = _moved(photo.camera.pose, one, *NEAR, rng)
        yield _sample(one, "near", photo.name, photo.camera.pose, pose, verify(query, pose, _tools(one)))
        pose = _moved(photo.camera.pose, one, *MOVED, rng)
        tools = _tools(one)
        yield _sample(one, "moved", photo.name, photo.camera.pose, pose, verify(query, pose, tools))
        yield from _followed(one, photo, query, pose)
        frame, camera = rendered_frame(pose, query, tools)
        size = camera.intrinsics
        start = Camera(query.intrinsics.resized(size.width, size.height), pose)
        found = refine_photometric(photo_at(query, tools, size), frame, camera, start, 2)
        if np.isfinite(found.loss):
            verdict = verify(query, found.pose, _tools(one))
            yield _sample(one, "drifted", photo.name, photo.camera.pose, found.pose, verdict)


def _followed(one: Subject, photo: BenchPhoto, query: Query, expected: Pose) -> Iterator[Sample]:
    """Yield what the tracker makes of a camera that isn't where it is expected."""
    tools = _tools(one)
    found = aligned_from(query, expected, None, tools)
    if found is None:
        return
    seen = glance(query, found, tools)
    verdict = seen or verify(query, found.pose, tools)
    sample = _sample(one, "followed", photo.name, photo.camera.pose, found.pose, verdict)
    yield replace(sample, glanced=seen is not None and seen.status is Status.LOCALIZED)


def _foreign(one: Subject, others: Sequence[Subject]) -> Iterator[Sample]:
    """Yield what becomes of photos that don't show the scene."""
    for other in others:
        for photo in other.photos[:FOREIGN]:
            lens, data = photo.camera.intrinsics, photo.path.read_bytes()
            query = read_query(data, intrinsics=lens, background_rgb=one.background_rgb)
            yield _localized(one, "foreign", photo.name, query, None)
    for number in range(GARBAGE):
        picture = garbage(number)
        height, width = picture.shape[:2]
        lens = Intrinsics(width, height, 0.8 * width, 0.8 * width, width / 2, height / 2)
        query = read_query(encode_image(picture, "png"), intrinsics=lens, background_rgb=one.background_rgb)
        yield _localized(one, "garbage", str(number), query, None)


def garbage(number: int) -> np.ndarray:
    """Return a picture of nothing: one colour, noise, ramp, blotches, chequers, stripes, rectangles, soft noise."""
    rng = np.random.default_rng(number)
    height, width = 480, 640
    picture = np.full((height, width, 3), 0.5, np.float32)
    match number % GARBAGE:
        case 1:
            picture = rng.uniform(size=picture.shape)
        case 2:
            picture[:] = np.linspace(0, 1, width)[None, :, None]
        case 3:
            picture = resized(rng.uniform(size=(12, 16, 3)).astype(np.float32), width, height)
        case 4:
            picture[:] = (np.indices((height, width)).sum(0) // 20 % 2)[..., None]
        case 5:
            picture[:] = rng.integers(0, 2, width // 4).repeat(4)[None, :, None]
        case 6:
            for _ in range(200):
                (left, right), (top, bottom) = rng.integers(0, width, 2), rng.integers(0, height, 2)
                picture[min(top, bottom) : max(top, bottom), min(left, right) : max(left, right)] = rng.uniform(size=3)
        case 7:
            picture = resized(rng.uniform(size=(120, 160, 3)).astype(np.float32), width, height)
    return np.clip(picture, 0, 1).astype(np.float32)


def _moved(pose: Pose, one: Subject, between: tuple[float, float], most_deg: float, rng: np.random.Generator) -> Pose:
    """Return the pose turned and shifted in a random direction, by a distance even on a logarithmic scale."""
    turn, shift = rng.standard_normal((2, 3))
    turn *= np.radians(rng.uniform(0, most_deg)) / np.linalg.norm(turn)
    units = np.exp(rng.uniform(*np.log(between)))
    shift *= units / one.units.units_per_scene_unit / np.linalg.norm(shift)
    return moved(pose, np.concatenate([turn, shift]))


def _tools(one: Subject) -> Tools:
    loaded = one.loaded
    rng = np.random.default_rng(0)
    return Tools(loaded.scene, loaded.rasterizer, loaded.matcher, rng, loaded.prepare("view_index"))


def _localized(one: Subject, kind: str, photo: str, query: Query, truth: Pose | None) -> Sample:
    estimate = localize(query, one.loaded, Request(options=Options(effort="fast")))
    weighed = nees(estimate, truth) if truth else None
    verdict = replace(estimate.verdict, signals=verify(query, estimate.pose, _tools(one)).signals)
    matched = any(r.stage == "refine" and (r.num_inliers or 0) >= GOOD_MATCH for r in estimate.records)
    return replace(_sample(one, kind, photo, truth, estimate.pose, verdict, weighed), matched=matched)


def _sample(
    one: Subject, kind: str, photo: str, truth: Pose | None, pose: Pose, verdict: Verdict, weighed: float | None = None
) -> Sample:
    right = False
    if truth is not None:
        degrees, units = errors(pose, truth, one.units)
        right = degrees <= COARSE[0] and units <= COARSE[1]
    doubted = verdict.reason in OTHER_DOUBTS
    return Sample(one.loaded.scene.info.name, kind, photo, right, verdict.signals, doubted, weighed)


def summary(samples: Sequence[Sample]) -> dict[str, Any]:
    """Return weights fitted on all samples, and what such weights say of scenes that they were not fitted on."""
    glanced = [sample for sample in samples if sample.glanced is not None]
    samples = [sample for sample in samples if sample.glanced is None]
    right = np.array([sample.right for sample in samples])
    scenes = np.array([sample.scene for sample in samples])
    kinds = np.array([sample.kind for sample in samples])
    doubted = np.array([sample.doubted for sample in samples])
    usual = right & ~np.char.startswith(kinds, "beyond")
    matched = np.array([sample.matched for sample in samples])
    result: dict[str, Any] = {"glance": _glances(glanced)}
    by_pixels = np.zeros(len(samples))
    for name, model in (("by_pixels", BY_PIXELS), ("with_matches", WITH_MATCHES)):
        features = scaled(samples, model)
        tested = np.zeros(len(samples))
        for scene in np.unique(scenes):
            here = scenes == scene
            elsewhere = ~here & ~doubted  # what is refused for another reason is not for the signals to tell
            weights, floor = fitted(features[elsewhere], right[elsewhere]), floors(features[~here & usual])
            doubtful = (features[here] < floor).any(1)
            tested[here] = probabilities(features[here], weights)
            tested[here] = np.minimum(tested[here], np.where(doubtful, DOUBTFUL, 1.0))
        if name == "by_pixels":
            by_pixels = tested
        else:  # as the estimator asks: matches only where the pixels don't make it clear
            tested = np.where(matched & (by_pixels >= LOCALIZED), np.maximum(by_pixels, tested), tested)
        ends = [SCALES[n].value_at(f) for n, f in zip(list(model)[1:], floors(features[usual])[1:], strict=True)]
        result[name] = {
            "weights": dict(zip(model, np.round(fitted(features[~doubted], right[~doubted]), 2).tolist(), strict=True)),
            "floors": dict(zip(list(model)[1:], np.round(ends, 3).tolist(), strict=True)),
            **_counts(tested, right, kinds, doubted),
            "reliability": _reliability(tested, right),
        }
    return result


def _glances(samples: Sequence[Sample]) -> dict[str, int]:
    """Return how many right and wrong poses the tracker's glance takes for right."""
    right, wrong = [s for s in samples if s.right], [s for s in samples if not s.right]
    return {
        "right": len(right),
        "right_localized": sum(bool(s.glanced) for s in right),
        "wrong": len(wrong),
        "wrong_localized": sum(bool(s.glanced) for s in wrong),
    }


def scaled(samples: Sequence[Sample], model: Mapping[str, float]) -> Float64[np.ndarray, "n k"]:
    """Return the samples' scaled signals in the model's order; the bias comes first and is 1."""
    columns = [np.ones(len(samples))]
    columns += [SCALES[name](np.array([s.signals[name] for s in samples])) for name in model if name != "bias"]
    return np.stack(columns, 1)


def probabilities(features: Float64[np.ndarray, "n k"], weights: Float64[np.ndarray, "k"]) -> Float64[np.ndarray, "n"]:
    """Return the logistic model's values."""
    return 1.0 / (1.0 + np.exp(-np.clip(features @ weights, -50, 50)))


def fitted(features: Float64[np.ndarray, "n k"], right: Bool[np.ndarray, "n"]) -> Float64[np.ndarray, "k"]:
    """Return the weights, none negative but the bias', that the samples make likeliest; both classes weigh alike.

    Newton's steps on the free weights; one that would turn negative is fixed at 0.
    """
    weights = np.zeros(features.shape[1])
    each = np.where(right, 0.5 / max(right.sum(), 1), 0.5 / max((~right).sum(), 1)) * len(right)
    penalty = PENALTY * np.r_[0.0, np.ones(features.shape[1] - 1)] * len(right) / 100
    free = np.ones(len(weights), bool)
    for _ in range(100):
        p = probabilities(features, weights)
        gradient = features.T @ (each * (right - p)) - penalty * weights
        hessian = (features * (each * p * (1 - p))[:, None]).T @ features + np.diag(penalty + 1e-9)
        step = np.zeros_like(weights)
        step[free] = np.linalg.solve(hessian[np.ix_(free, free)], gradient[free])
        weights = weights + step * min(1.0, 5.0 / max(np.abs(step).max(), 1e-9))
        below = np.r_[False, weights[1:] < 0]
        weights[below], free[below] = 0.0, False
        if np.abs(step).max() < 1e-6:
            break
    return weights


def floors(features: Float64[np.ndarray, "n k"]) -> Float64[np.ndarray, "k"]:
    """Return what nearly all of these right poses' scaled signals stay above."""
    return np.quantile(features, BELOW_FLOOR, axis=0)


def _counts(
    tested: Float64[np.ndarray, "n"],
    right: Bool[np.ndarray, "n"],
    kinds: np.ndarray,
    doubted: Bool[np.ndarray, "n"],
) -> dict[str, Any]:
    """Return how many of each kind are called localized, apart from those that are in doubt for other reasons."""
    called = (tested >= LOCALIZED) & ~doubted
    nothing = np.isin(kinds, ["foreign", "garbage"])
    wrong = ~right & ~nothing
    return {
        "foreign_or_garbage": int(nothing.sum()),
        "foreign_or_garbage_localized": int((called & nothing).sum()),
        "wrong": int(wrong.sum()),
        "wrong_localized": int((called & wrong).sum()),
        "right": int(right.sum()),
        "right_localized": int((called & right).sum()),
        "by_kind": {
            str(kind): {
                "right": int((right & (kinds == kind)).sum()),
                "right_localized": int((called & right & (kinds == kind)).sum()),
                "wrong": int((~right & (kinds == kind)).sum()),
                "wrong_localized": int((called & ~right & (kinds == kind)).sum()),
            }
            for kind in np.unique(kinds)
        },
    }


def _reliability(tested: Float64[np.ndarray, "n"], right: Bool[np.ndarray, "n"]) -> list[dict[str, float]]:
    """Return, for equal intervals of the probability, what was said and what came true."""
    bins = np.minimum((tested * BINS).astype(int), BINS - 1)
    return [
        {
            "from": k / BINS,
            "to": (k + 1) / BINS,
            "count": int((bins == k).sum()),
            "said": float(tested[bins == k].mean()),
            "true": float(right[bins == k].mean()),
        }
        for k in range(BINS)
        if (bins == k).any()
    ]
