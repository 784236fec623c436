"""The parts of `splatfix bench gpu` that compare: images, gradients and poses by either renderer.

Both compute in float32, so neither is the truth; the bounds are those of the renderers' tests, which compare each with
a reference in float64.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float32, Float64, Int32

from service.bench.gpu_runner import Row
from service.bench.gpu_shared import Shared, every, finite
from service.bench.large_scenes import keep_most_contributing
from service.bench.modifications import Photo, modify
from service.bench.pose_metrics import errors
from service.geometry import moved
from service.interfaces import Frame, Rasterizer
from service.loaded_scene import LoadedScene
from service.localize import localize
from service.photos.images import encode_image, read_query
from service.results import Status
from service.types import Camera, GaussianScene

MEAN_BOUND, QUANTILE, QUANTILE_BOUND = 1e-6, 0.999, 1e-4
"""Of |difference| over an image; a quantile, not the maximum, since where alpha is 1/255 a rounding decides."""
DEPTH_SCALE = 2.0
"""Differences of depths are divided by it, scene units."""
GRADIENT_BOUND = 1e-4
"""Of |difference| / |gradient|, both Euclidean norms over all parameters of a kind."""
POSE_BOUND = (0.02, 0.001)
"""Degrees and normalized units between the poses found with either renderer."""
GRADIENT_PX = 200
DEGRADED_BY = (
    ("blur=1.5", "noise=0.03"), ("gain=0.7", "jpeg=40"), ("white_balance=1.2", "gamma=1.3"), ("roll=12",),
    ("crop=0.6", "saturation=0.5"), ("scale=0.5", "jpeg=60"),
)  # fmt: skip
"""In turn."""
_AWAY = np.array([0.15, 0.15, 0.15, 0.1, 0.1, 0.1])
"""Standard deviations of rendered photos' poses from training cameras': rad, and normalized units."""


def pictures(shared: Shared) -> Iterator[Row]:
    """Yield for each camera and size how the tested renderer's image differs from the CPU's."""
    scene, tested, reference = _compared(shared)
    for width in shared.work.widths:
        for named in scene.cameras:
            camera = _resized(named.camera, width)
            (ours,), (theirs,) = tested.render([camera]), reference.render([camera])
            differences = image_differences(ours, theirs)
            within = all(
                mean is not None and mean < MEAN_BOUND and quantile is not None and quantile < QUANTILE_BOUND
                for mean, quantile in differences.values()
            )
            shown = finite(theirs.alpha.mean())  # of nothing, two images are equal whatever the renderers do
            yield {"camera": named.name, "width": width, "within": within, "alpha": shown, "differences": differences}


def image_differences(ours: Frame, theirs: Frame) -> dict[str, tuple[float | None, float | None]]:
    """Return mean and 99.9 % quantile of the absolute difference, for each image of a frame; depths scaled."""
    found = {}
    for name, scale in (("rgb", 1.0), ("alpha", 1.0), ("depth", DEPTH_SCALE), ("median_depth", DEPTH_SCALE)):
        error = np.abs(getattr(ours, name).astype(np.float64) - getattr(theirs, name)) / scale
        found[name] = finite(error.mean()), finite(np.quantile(error, QUANTILE))
    return found


def gradients(shared: Shared) -> Iterator[Row]:
    """Yield for each camera the relative difference of the gradients by pose and scene, of a random linear loss."""
    scene, tested, reference = _compared(shared)
    for number, named in enumerate(scene.cameras):
        camera = _resized(named.camera, min(GRADIENT_PX, max(shared.work.widths)))
        rng = np.random.default_rng(number)
        k = camera.intrinsics
        d_rgb = rng.normal(size=(k.height, k.width, 3)).astype(np.float32)
        d_depth, d_alpha = rng.normal(size=(2, k.height, k.width)).astype(np.float32)
        by_pose = [r.pose_gradient(camera, d_rgb, d_depth, d_alpha) for r in (tested, reference)]
        found = {"pose": _relative(*by_pose)}
        ours, theirs = (r.scene_gradients(camera, d_rgb, d_depth, d_alpha) for r in (tested, reference))
        for name in ("means", "quats", "scales", "opacities", "sh"):
            full = [_scattered(g.index, getattr(g, name), scene.count) for g in (ours, theirs)]
            found[name] = _relative(*full)
        within = all(value is not None and value < GRADIENT_BOUND for value in found.values())
        seen = len(theirs.index)
        yield {"camera": named.name, "width": k.width, "within": within, "gaussians": seen, "differences": found}


def poses(shared: Shared) -> Iterator[Row]:
    """Yield for each photo, the scene's own and rendered ones, what is found with either renderer.

    Its own photos are sent as they are; rendered ones are taken near training cameras and degraded, in turn, by
    `DEGRADED_BY`.
    """
    background = shared.scene.info.background_rgb
    for name, data, truth in _photos(shared):
        query = read_query(data, intrinsics=truth.intrinsics, background_rgb=background)
        ours, theirs = (localize(query, loaded) for _, loaded in shared.both)
        rotation_deg, translation_units = errors(ours.pose, theirs.pose, shared.units)
        statuses = [estimate.verdict.status for estimate in (ours, theirs)]
        # Two poses that were both refused have nothing to agree about.
        near = Status.LOCALIZED not in statuses or (
            rotation_deg <= POSE_BOUND[0] and translation_units <= POSE_BOUND[1]
        )
        yield {
            "photo": name,
            "status": str(statuses[0]),
            "cpu_status": str(statuses[1]),
            "rotation_deg": finite(rotation_deg),
            "translation_units": finite(translation_units),
            "within": statuses[0] == statuses[1] and near,
            "truth_deg_units": [finite(e) for e in errors(ours.pose, truth.pose, shared.units)],
            "cpu_truth_deg_units": [finite(e) for e in errors(theirs.pose, truth.pose, shared.units)],
        }


def _photos(shared: Shared) -> Iterator[tuple[str, bytes, Camera]]:
    """Yield name, file and true camera, whose intrinsics are sent with it."""
    for photo in shared.photos:
        yield photo.name, photo.path.read_bytes(), photo.camera
    work = shared.work
    yield from degraded_renders(shared.reference, work.degraded, work.degraded_px, shared.units.units_per_scene_unit)


def degraded_renders(
    loaded: LoadedScene, count: int, long_side_px: int, units_per_scene_unit: float
) -> Iterator[tuple[str, bytes, Camera]]:
    """Yield photos rendered near training cameras and degraded, the same every time: name, PNG file, true camera."""
    rng = np.random.default_rng(0)
    per_unit = np.array([1.0] * 3 + [1 / units_per_scene_unit] * 3)
    cameras = loaded.scene.cameras
    for number in range(count):
        named = cameras[int(rng.integers(len(cameras)))]
        pose = moved(named.camera.pose, rng.normal(size=6) * _AWAY * per_unit)
        camera = Camera(named.camera.intrinsics.with_long_side(long_side_px), pose)
        (frame,) = loaded.rasterizer.render([camera])
        specs = DEGRADED_BY[number % len(DEGRADED_BY)]
        photo = modify(Photo(np.clip(frame.rgb, 0, 1), camera.intrinsics, pose), specs, rng)
        name = f"{number:02} {named.name} {' '.join(specs)}"
        yield name, encode_image(photo.pixels(), "png"), Camera(photo.intrinsics, photo.pose)


def _compared(shared: Shared) -> tuple[GaussianScene, Rasterizer, Rasterizer]:
    """Return the scene with the cameras that images are compared of, and the tested and the CPU's renderer of it."""
    tested, reference, count = shared.tested.rasterizer, shared.reference.rasterizer, shared.work.compared
    scene = replace(shared.scene, cameras=tuple(every(shared.scene.cameras, shared.work.views)))
    if count is None:
        return scene, tested, reference
    scene = keep_most_contributing(scene, count, reference)
    return scene, tested.of(scene), reference.of(scene)


def _resized(camera: Camera, width: int) -> Camera:
    return Camera(camera.intrinsics.with_long_side(width), camera.pose)


def _scattered(
    index: Int32[np.ndarray, "v"], rows: Float32[np.ndarray, "v *k"], count: int
) -> Float64[np.ndarray, "n *k"]:
    full = np.zeros((count, *rows.shape[1:]))
    full[index] = rows
    return full


def _relative(ours: Float64[np.ndarray, "*k"], theirs: Float64[np.ndarray, "*k"]) -> float | None:
    return finite(float(np.linalg.norm(ours - theirs)) / max(float(np.linalg.norm(theirs)), 1e-30))
