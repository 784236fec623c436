"""Pictures of misses: the photo, the render at the answer and the one at the truth, and which of them fits better.

Where the render at the truth fits the photo worse than the one at the answer, the scene itself shows the photo from the
answer: the model's fault or the data's pose. Where it fits better, the fault is the estimator's.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32

from service.bench.localize import Subject, Trial
from service.photos.images import encode_image, read_query, resized
from service.results import PoseEstimate
from service.types import Camera

LONG_SIDE = 480
DIFFERENCE_GAIN = 4.0
Picture = Float32[np.ndarray, "h w 3"]


def save_miss_images(folder: Path) -> Callable[[Subject, Trial, PoseEstimate], dict[str, Any]]:
    """Return what `run` calls for a miss: it writes the picture, and tells its name and the residuals."""
    folder.mkdir(parents=True, exist_ok=True)

    def keep(one: Subject, trial: Trial, estimate: PoseEstimate) -> dict[str, Any]:
        picture, at_answer, at_truth = drawn(one, trial, estimate)
        name = re.sub(r"[^\w.-]+", "_", f"{one.loaded.scene.info.name}-{trial.photo}-{trial.number}") + ".jpg"
        (folder / name).write_bytes(picture)
        return {"picture": name, "residual_at_answer": at_answer, "residual_at_truth": at_truth}

    return keep


def drawn(one: Subject, trial: Trial, estimate: PoseEstimate) -> tuple[bytes, float, float]:
    """Return a JPEG, and the residuals (0..1) at the answer and at the truth.

    From left to right: photo, render at the answer, its difference fourfold, render at the truth, its difference.
    """
    query = read_query(trial.data, intrinsics=trial.told, background_rgb=one.background_rgb)
    lens = query.intrinsics.with_long_side(min(LONG_SIDE, query.intrinsics.long_side))
    size = lens.width, lens.height
    photo = resized(query.rgb.astype(np.float32) / 255, *size)
    known = np.ones(photo.shape[:2], bool)
    if query.valid_mask is not None:
        known = resized(np.repeat(query.valid_mask[:, :, None], 3, 2).astype(np.float32), *size)[:, :, 0] > 0.99
    # Undistorted, the photo is a pinhole's of the same focal length.
    answer = Camera(replace(estimate.intrinsics.resized(*size), model="PINHOLE", distortion=()), estimate.pose)
    truth = Camera(replace(trial.truth.intrinsics.resized(*size), model="PINHOLE", distortion=()), trial.truth.pose)
    shown, residuals = [photo], []
    for frame in one.loaded.rasterizer.render([answer, truth]):
        exposed = _exposed(frame.rgb, photo, known)
        difference = np.abs(exposed - photo) * known[:, :, None]
        residuals.append(float(difference[known].mean()))
        shown += [exposed, DIFFERENCE_GAIN * difference]
    return encode_image(np.clip(np.concatenate(shown, 1), 0, 1), quality=85), residuals[0], residuals[1]


def _exposed(render: Picture, photo: Picture, known: Bool[np.ndarray, "h w"]) -> Picture:
    """Return the render with the photo's exposure: gain and bias of each channel."""
    matched = np.empty_like(render)
    for channel in range(3):
        x, y = render[known, channel], photo[known, channel]
        gain = np.mean((x - x.mean()) * (y - y.mean())) / max(float(x.var()), 1e-9)
        matched[:, :, channel] = gain * (render[:, :, channel] - x.mean()) + y.mean()
    return matched
