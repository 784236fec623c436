"""Images of misses: the photo beside renders at the estimated and at the true pose, with their residuals.

If the render at the true pose has the larger residual, the error is in the scene or in the data's pose; if it has the
smaller one, the error is the estimator's.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32

from service.bench.localize import BenchScene, Trial
from service.photos.images import encode_image, read_query, resized
from service.results import PoseEstimate
from service.types import Camera

LONG_SIDE_PX = 480
DIFFERENCE_GAIN = 4.0
RGBImage = Float32[np.ndarray, "h w 3"]


def save_miss_images(folder: Path) -> Callable[[BenchScene, Trial, PoseEstimate], dict[str, Any]]:
    """Return a callback for `run` that writes the image of a miss and returns its name and residuals."""
    folder.mkdir(parents=True, exist_ok=True)

    def keep(one: BenchScene, trial: Trial, estimate: PoseEstimate) -> dict[str, Any]:
        image, at_estimate, at_truth = miss_image(one, trial, estimate)
        name = re.sub(r"[^\w.-]+", "_", f"{one.loaded.scene.info.name}-{trial.photo}-{trial.number}") + ".jpg"
        (folder / name).write_bytes(image)
        return {"picture": name, "residual_at_answer": at_estimate, "residual_at_truth": at_truth}

    return keep


def miss_image(one: BenchScene, trial: Trial, estimate: PoseEstimate) -> tuple[bytes, float, float]:
    """Return a JPEG, and the mean absolute residuals (0..1) at the estimated and at the true pose.

    From left to right: photo, render at the estimate, its difference times 4, render at the truth, its difference.
    """
    query = read_query(trial.data, intrinsics=trial.intrinsics, background_rgb=one.background_rgb)
    small = query.intrinsics.with_long_side(min(LONG_SIDE_PX, query.intrinsics.long_side))
    size = small.width, small.height
    photo = resized(query.rgb.astype(np.float32) / 255, *size)
    valid = np.ones(photo.shape[:2], bool)
    if query.valid_mask is not None:
        valid = resized(np.repeat(query.valid_mask[:, :, None], 3, 2).astype(np.float32), *size)[:, :, 0] > 0.99
    # The query is undistorted, so its camera is a pinhole of the same focal length.
    estimated = Camera(replace(estimate.intrinsics.resized(*size), model="PINHOLE", distortion=()), estimate.pose)
    truth = Camera(replace(trial.truth.intrinsics.resized(*size), model="PINHOLE", distortion=()), trial.truth.pose)
    shown, residuals = [photo], []
    for frame in one.loaded.rasterizer.render([estimated, truth]):
        exposed = _match_exposure(frame.rgb, photo, valid)
        difference = np.abs(exposed - photo) * valid[:, :, None]
        residuals.append(float(difference[valid].mean()))
        shown += [exposed, DIFFERENCE_GAIN * difference]
    return encode_image(np.clip(np.concatenate(shown, 1), 0, 1), quality=85), residuals[0], residuals[1]


def _match_exposure(render: RGBImage, photo: RGBImage, valid: Bool[np.ndarray, "h w"]) -> RGBImage:
    """Return the render with gain and bias of each channel fitted to the photo by least squares."""
    matched = np.empty_like(render)
    for channel in range(3):
        x, y = render[valid, channel], photo[valid, channel]
        # The bound keeps a uniform channel finite.
        gain = np.mean((x - x.mean()) * (y - y.mean())) / max(float(x.var()), 1e-9)
        matched[:, :, channel] = gain * (render[:, :, channel] - x.mean()) + y.mean()
    return matched
