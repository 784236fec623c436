"""The queries of `splatfix bench field`: file and intrinsics that are sent for a row, and what comes of them."""

from __future__ import annotations

import time
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float32

from service.bench.bench_photos import BenchPhoto
from service.bench.field_rows import Row, Told
from service.bench.localize import BenchScene
from service.bench.modifications import modify
from service.bench.modified_photo import Photo
from service.bench.pose_metrics import COARSE, Outcome, errors, nees
from service.localize import Request, localize, rasterizer_for
from service.photos.images import encode_image, read_query, with_focal_35mm
from service.pose.absolute_pose.pnp import AbsolutePose
from service.pose.features.query_images import QueryImages
from service.pose.features.rendered_views import ViewRenderer
from service.pose.refinement.refine_stage import RefineOutcome, refine_stage
from service.pose.verification.gate_model import SHIPPED_MODEL
from service.results import PoseEstimate, Status
from service.types import Camera, Intrinsics

LONG_SIDE = 1000
"""Of the photos that are sent, at most: estimators use no more."""
JPEG_QUALITY = 95
MM_OF_LONG_SIDE = 36.0
"""EXIF's 35 mm equivalent is that of a film frame of this length."""


@dataclass(frozen=True, slots=True)
class FieldQuery:
    """One query: a row and a photo."""

    row: Row
    photo: BenchPhoto
    number: int = 0
    """Of the random combination; 0 in a written row."""

    @property
    def key(self) -> tuple[str, str, int]:
        """What tells this query from all others of a run."""
        return self.row.name, self.photo.name, self.number


@dataclass(frozen=True, slots=True)
class Sent:
    """What is sent, and the truth that isn't."""

    data: bytes
    intrinsics: Intrinsics | None
    truth: Camera
    """With the true lens."""


def decoded(
    photo: BenchPhoto,
    background_rgb: tuple[float, float, float],
    occluders: Sequence[Float32[np.ndarray, "_ _ 3"]] = (),
) -> Photo:
    """Decode a test photo, with its distortion if it has any, and reduce it to at most LONG_SIDE."""
    lens = photo.camera.intrinsics
    # As if it were a pinhole's, so that nothing is undistorted.
    pinhole = replace(lens, model="PINHOLE", distortion=())
    query = read_query(
        photo.path.read_bytes(), intrinsics=pinhole, background_rgb=background_rgb, long_side=lens.long_side
    )
    whole = Photo(query.rgb.astype(np.float32) / 255, lens, photo.camera.pose, occluders=tuple(occluders))
    size = lens.with_long_side(LONG_SIDE)
    return whole if lens.long_side <= LONG_SIDE else whole.resized(size.width, size.height)


def send(photo: Photo, query: FieldQuery, seed: int) -> Sent:
    """Return what is sent of a decoded photo for a query: a JPEG of quality 95, or a PNG where parts are transparent.

    The randomness depends on seed, photo and number only: the rows of a photo have the same noise.
    """
    # A checksum instead of `hash`, which differs from process to process.
    rng = np.random.default_rng([seed, zlib.crc32(query.photo.name.encode()), query.number])
    modified, told = modify(photo, query.row.modify, rng), query.row.told
    # JPEG has no transparency.
    if modified.mask is not None:
        data = encode_image(modified.pixels(), "png")
    else:
        data = encode_image(modified.rgb, quality=JPEG_QUALITY)
        if told == "exif":
            focal = modified.sent_focal_factor * modified.focal_of_whole
            # EXIF has whole millimetres, as cameras write them.
            data = with_focal_35mm(data, max(1, round(MM_OF_LONG_SIDE * focal)))
    return Sent(data, _sent_intrinsics(modified, told), Camera(modified.intrinsics, modified.pose))


def _sent_intrinsics(photo: Photo, told: Told) -> Intrinsics | None:
    lens, factor = photo.intrinsics, photo.sent_focal_factor
    if told in ("exif", "withheld"):
        return None
    lens = replace(lens, fx=lens.fx * factor, fy=lens.fy * factor)
    if told == "approximate":
        return replace(lens, trust="approximate")
    if told == "pinhole":
        return replace(lens, model="PINHOLE", distortion=())
    if told == "centred":
        return replace(lens, cx=lens.width / 2, cy=lens.height / 2)
    return lens


def answer(one: BenchScene, photo: Photo, query: FieldQuery, seed: int, request: Request) -> dict[str, Any]:
    """Localize a query; return its line of the result file."""
    sent = send(photo, query, seed)
    # Decoding counts: whoever sends a photo waits for it.
    wall, cpu = time.perf_counter(), time.process_time()
    read = read_query(sent.data, intrinsics=sent.intrinsics, background_rgb=one.background_rgb)
    estimate = localize(read, one.loaded, request)
    spent = 1e3 * (time.perf_counter() - wall), 1e3 * (time.process_time() - cpu)
    outcome = Outcome(estimate.verdict.status, *errors(estimate.pose, sent.truth.pose, one.units), *spent)
    row = query.row
    line: dict[str, Any] = {"row": row.name, "pool": row.pool, "group": row.group, "told": row.told}
    line |= {"modify": list(row.modify), "modify_scene": list(row.modify_scene)}
    line |= {"photo": query.photo.name, "number": query.number}
    line |= _measured(estimate, outcome, sent.truth, one.units.units_per_scene_unit)
    if not outcome.success(COARSE):
        # Of a lens that was told as it is nothing need be estimated.
        line["home"] = home(one, sent, exact=sent.intrinsics == sent.truth.intrinsics)
    return line


def _measured(estimate: PoseEstimate, outcome: Outcome, truth: Camera, units_per_scene_unit: float) -> dict[str, Any]:
    verdict, found, true = estimate.verdict, estimate.intrinsics, truth.intrinsics
    sigma = None if verdict.covariance is None else np.sqrt(np.diag(verdict.covariance))
    true_k1, found_k1 = k1_of(true), k1_of(found)
    return {
        "status": str(verdict.status),
        "reason": str(verdict.reason),
        "below_floor": SHIPPED_MODEL.below_floor(verdict.signals),
        "score": verdict.score,
        "localized": verdict.status is Status.LOCALIZED,
        "right": outcome.within(COARSE),
        "rotation_deg": outcome.rotation_deg,
        "translation_units": outcome.translation_units,
        "nees": nees(estimate, truth.pose),
        "sigma_deg": None if sigma is None else float(np.degrees(np.linalg.norm(sigma[:3]))),
        "sigma_units": None if sigma is None else float(np.linalg.norm(sigma[3:]) * units_per_scene_unit),
        "intrinsics_source": estimate.intrinsics_source,
        "focal_error": found.fx / true.fx - 1.0,
        "focal_sigma": verdict.focal_sigma,
        "model": found.model,
        "true_k1": true_k1,
        "k1_error": None if true_k1 is None or found_k1 is None else found_k1 - true_k1,
        "inliers": verdict.inliers,
        "signals": {name: round(float(value), 5) for name, value in verdict.signals.items()},
        "renders": estimate.renders,
        "latency_ms": outcome.latency_ms,
        "cpu_ms": outcome.cpu_ms,
        "world_from_camera": estimate.pose.world_from_camera.tolist(),
    }


def k1_of(lens: Intrinsics) -> float | None:
    """Return the first radial coefficient; 0 of a pinhole; None of a fisheye, whose coefficients are others."""
    if "FISHEYE" in lens.model:
        return None
    return lens.distortion[0] if lens.distortion else 0.0


def home(one: BenchScene, sent: Sent, exact: bool) -> dict[str, Any]:
    """Refine from the truth, with the true lens as a start; return where that leads.

    A photo for which it doesn't stay near can't be answered by a better search. `exact`: the lens is no unknown.
    """
    lens = replace(sent.truth.intrinsics, trust="exact" if exact else "approximate")
    query = read_query(sent.data, intrinsics=lens, background_rgb=one.background_rgb)
    images = QueryImages(query, one.loaded.matcher)
    renderer = ViewRenderer(rasterizer_for(query, one.loaded))
    outcome = _refined_from(AbsolutePose(sent.truth.pose, np.zeros(0, bool)), images, renderer)
    if outcome.refined is None:
        return {"stays": False, "rotation_deg": None, "translation_units": None}
    error = errors(outcome.refined.pose, sent.truth.pose, one.units)
    stays = error[0] <= COARSE[0] and error[1] <= COARSE[1]
    return {"stays": stays, "rotation_deg": error[0], "translation_units": error[1]}


def _refined_from(start: AbsolutePose, images: QueryImages, renderer: ViewRenderer) -> RefineOutcome:
    """Run the stage of refinement to its end."""
    records = refine_stage(start, images, renderer)
    while True:
        try:
            next(records)
        except StopIteration as end:
            return end.value
