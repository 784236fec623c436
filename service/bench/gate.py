"""`splatfix bench gate`: gather right and wrong poses, fit the verification gate's model, and test it.

Right poses are the estimator's answers to test photos, as they are and degraded within reason, that lie within the
bound. Wrong ones are made by stress:

    foreign     photos of the other scenes, localized in this one      garbage   patterns and noise, localized
    mirrored    the test photos, left and right exchanged, localized   beyond    degraded beyond reason, localized
    moved       true poses moved by 0.06 to 1.5 units and up to 8 degrees, as they are (by 0.002 to 0.012 units and up
                to 0.12 degrees they are right: samples of what less exact methods answer: near)
    drifted     the same, aligned from there, where that doesn't lead back
    tracked     the same, as the tracker does it: verified by the pixels alone, with the weights that are in use

With a single scene there are no foreign photos, and what occludes is noise and rectangles. `service/bench/gate_fit.py`
fits and tests.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from service.bench.bench_photos import BenchPhoto, prepare_photo
from service.bench.gate_fit import Sample, fit_model, summary
from service.bench.localize import BenchScene, load_bench_scene
from service.bench.pose_metrics import COARSE, errors, nees
from service.estimators.search_config import SEARCH
from service.estimators.view_index import Options
from service.geometry import moved
from service.localize import Request, localize, render_and_verify
from service.photos.images import encode_image, read_query, resized
from service.pose.features.mirrored_query import mirrored_query
from service.pose.features.query_images import QueryImages
from service.pose.features.rendered_views import ViewRenderer
from service.pose.refinement.photometric import refine_photometric
from service.pose.verification.gate import verify
from service.pose.verification.gate_model import SHIPPED_MODEL, model_to_json
from service.results import Reason, Status, Verdict
from service.tracking import refine_from, verify_tracked
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
PATTERNED = (1, 6)
"""Of these, noise and rectangles occlude where there is no other scene."""
OCCLUDERS = 2
"""Photos of each other scene that rectangles are cut from."""
OTHER_DOUBTS = (
    Reason.FOCAL_UNCERTAIN,
    Reason.INTRINSICS_CONTRADICTED,
    Reason.LOW_COVERAGE,
    Reason.POSITION_UNCERTAIN,
    Reason.AMBIGUOUS,
    Reason.MIRRORED,
)


def run(
    folders: Sequence[Path],
    *,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
    cache_dir: Path | None = None,
) -> dict[str, Any]:
    """Return the object that `--json` writes; its `model` is what `model.json` holds. Raises SceneError."""
    subjects = [load_bench_scene(Path(folder), cache_dir=cache_dir) for folder in folders]
    samples: list[Sample] = []
    total = sum(len(one.photos) for one in subjects)
    done = 0
    for one in subjects:
        one.loaded.prepare("view_index")
        # A generator for each scene: its samples don't depend on the scenes before it.
        rng = np.random.default_rng(seed)
        others = [other for other in subjects if other is not one]
        cut = [_pixels(photo) for other in others for photo in other.photos[:OCCLUDERS]]
        # A single scene has no other photos to cut from.
        cut = cut or [unrelated_image(number) for number in PATTERNED]
        for photo in one.photos:
            samples += _of_photo(one, photo, cut, rng)
            done += 1
            if progress:
                progress(done, total)
        samples += _foreign(one, others)
    data = {"scenes": [_scene_line(one) for one in subjects], "seed": seed}
    model = fit_model(samples, SHIPPED_MODEL, data)
    return summary(samples, SHIPPED_MODEL) | {
        "model": model_to_json(model),
        "samples": [_line(sample) for sample in samples],
    }


def _scene_line(one: BenchScene) -> dict[str, Any]:
    info = one.loaded.scene.info
    return {"name": info.name, "sha256": info.sha256, "photos": len(one.photos)}


def _line(sample: Sample) -> dict[str, Any]:
    names = ("scene", "kind", "photo", "right", "doubted", "nees", "tracked", "matched")
    return {name: getattr(sample, name) for name in names} | {"signals": dict(sample.signals)}


def _pixels(photo: BenchPhoto) -> Float32[np.ndarray, "h w 3"]:
    return read_query(photo.path.read_bytes()).rgb.astype(np.float32) / 255


def _of_photo(
    one: BenchScene, photo: BenchPhoto, occluders: Sequence[Float32[np.ndarray, "_ _ 3"]], rng: np.random.Generator
) -> Iterator[Sample]:
    """Yield the samples of one test photo."""
    for modify in (*WITHIN_REASON, *BEYOND):
        file = prepare_photo(photo, modify, one.background_rgb, int(rng.integers(1 << 30)), occluders)
        query = read_query(file.data, intrinsics=file.intrinsics, background_rgb=one.background_rgb)
        kind = ("beyond " if modify in BEYOND else "") + ("clean" if not modify else modify[0])
        yield _localized(one, kind, photo.name, query, file.truth.pose)
    data = photo.path.read_bytes()
    query = read_query(data, intrinsics=photo.camera.intrinsics, background_rgb=one.background_rgb)
    # No truth: no pose in the scene is right for the mirror image.
    yield _localized(one, "mirrored", photo.name, mirrored_query(query), None)
    images = QueryImages(query, one.loaded.matcher)
    for _ in range(MOVES):
        yield from _of_moved_pose(one, photo, images, rng)


def _of_moved_pose(
    one: BenchScene, photo: BenchPhoto, images: QueryImages, rng: np.random.Generator
) -> Iterator[Sample]:
    """Yield samples of poses moved from the truth: near, moved, tracked from there, and refined from there."""
    truth, rasterizer = photo.camera.pose, one.loaded.rasterizer
    pose = _moved(truth, one, *NEAR, rng)
    yield _sample(one, "near", photo.name, truth, pose, render_and_verify(images, pose, rasterizer))
    pose = _moved(truth, one, *MOVED, rng)
    rendered = ViewRenderer(rasterizer).at(images.query, pose)
    yield _sample(one, "moved", photo.name, truth, pose, verify(images, pose, rendered))
    yield from _tracked(one, photo, images, pose)
    size = rendered.camera.intrinsics
    start = Camera(images.query.intrinsics.resized(size.width, size.height), pose)
    found = refine_photometric(images.resized(size), rendered.frame, rendered.camera, start, 2)
    # Not finite: the pose sees too little of the scene to be refined.
    if np.isfinite(found.loss):
        verdict = render_and_verify(images, found.pose, rasterizer)
        yield _sample(one, "drifted", photo.name, truth, found.pose, verdict)


def _tracked(one: BenchScene, photo: BenchPhoto, images: QueryImages, expected: Pose) -> Iterator[Sample]:
    """Yield what the tracker makes of a camera that isn't where it is expected."""
    found = refine_from(images, expected, None, one.loaded.rasterizer)
    if found is None:
        return
    by_pixels = verify_tracked(images, found)
    verdict = by_pixels or render_and_verify(images, found.pose, one.loaded.rasterizer)
    sample = _sample(one, "tracked", photo.name, photo.camera.pose, found.pose, verdict)
    yield replace(sample, tracked=by_pixels is not None and by_pixels.status is Status.LOCALIZED)


def _foreign(one: BenchScene, others: Sequence[BenchScene]) -> Iterator[Sample]:
    """Yield what becomes of photos that don't show the scene."""
    for other in others:
        for photo in other.photos[:FOREIGN]:
            lens, data = photo.camera.intrinsics, photo.path.read_bytes()
            query = read_query(data, intrinsics=lens, background_rgb=one.background_rgb)
            yield _localized(one, "foreign", photo.name, query, None)
    for number in range(GARBAGE):
        picture = unrelated_image(number)
        height, width = picture.shape[:2]
        lens = Intrinsics(width, height, 0.8 * width, 0.8 * width, width / 2, height / 2)
        query = read_query(encode_image(picture, "png"), intrinsics=lens, background_rgb=one.background_rgb)
        yield _localized(one, "garbage", str(number), query, None)


def unrelated_image(number: int) -> np.ndarray:
    """Return a picture of nothing: grey, noise, ramp, blotches, diagonal stripes, bars, rectangles, or soft noise."""
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


def _moved(
    pose: Pose, one: BenchScene, between: tuple[float, float], most_deg: float, rng: np.random.Generator
) -> Pose:
    """Return the pose turned and shifted in a random direction, by a distance even on a logarithmic scale."""
    turn, shift = rng.standard_normal((2, 3))
    turn *= np.radians(rng.uniform(0, most_deg)) / np.linalg.norm(turn)
    # Small and large errors are equally interesting, so the scale is logarithmic.
    units = np.exp(rng.uniform(*np.log(between)))
    shift *= units / one.units.units_per_scene_unit / np.linalg.norm(shift)
    return moved(pose, np.concatenate([turn, shift]))


def _localized(one: BenchScene, kind: str, photo: str, query: Query, truth: Pose | None) -> Sample:
    estimate = localize(query, one.loaded, Request(options=Options(effort="fast")))
    weighed = nees(estimate, truth) if truth else None
    images = QueryImages(query, one.loaded.matcher)
    # The search may have verified by the pixels alone; the fit needs the signals of matches, too.
    signals = render_and_verify(images, estimate.pose, one.loaded.rasterizer).signals
    verdict = replace(estimate.verdict, signals=signals)
    sufficient = SEARCH.photometric_min_inliers
    matched = any(r.stage == "refine" and (r.num_inliers or 0) >= sufficient for r in estimate.records)
    return replace(_sample(one, kind, photo, truth, estimate.pose, verdict, weighed), matched=matched)


def _sample(
    one: BenchScene,
    kind: str,
    photo: str,
    truth: Pose | None,
    pose: Pose,
    verdict: Verdict,
    weighed: float | None = None,
) -> Sample:
    right = False
    if truth is not None:
        degrees, units = errors(pose, truth, one.units)
        right = degrees <= COARSE[0] and units <= COARSE[1]
    doubted = verdict.reason in OTHER_DOUBTS
    return Sample(one.loaded.scene.info.name, kind, photo, right, verdict.signals, doubted, weighed)
