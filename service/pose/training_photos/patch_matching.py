"""Patches of training photos: where a photo with a known pose should show them, and where it does."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float64, UInt8

from service.interfaces import SurfacePoints
from service.pose.training_photos.patch_kernels import match_patches, project_surface
from service.types import Camera, Intrinsics


@dataclass(frozen=True, slots=True)
class PatchConfig:
    """Tuned on fern, fountain, flower, fox and bonsai, by the median translation error of their test photos."""

    side_px: int = 20
    """Of a stored patch, in pixels of the training photo: holds the window at 1.5 times its scale."""
    radius_px: int = 5
    """The window that is matched has 2 * 5 + 1 pixels a side; 6 is no more exact, and a third slower."""
    max_steps: int = 10
    settled_px: float = 0.02
    """Gauss-Newton steps, and the last one's length."""
    min_similarity: float = 0.85
    """Normalized correlation: with 0.8 and 0.9 poses are as exact."""
    min_contrast: float = 2.0
    """Standard deviation of a patch's grey values (0..255)."""
    border_px: float = 9.0
    """Least distance of a predicted place from the photo's border."""
    scale_range: tuple[float, float] = (0.45, 2.2)
    """Size of a patch's pixel in the photo, in each direction: beyond it the two show other detail."""


PATCHES = PatchConfig()


@dataclass(frozen=True, slots=True)
class PredictedPatches:
    """Where a photo should show surface points, by its camera."""

    px: Float64[np.ndarray, "n 2"]
    depth: Float64[np.ndarray, "n"]
    """z-depth; not positive behind the camera."""
    photo_from_patch: Float64[np.ndarray, "n 2 2"]
    magnification: Float64[np.ndarray, "n"]
    """Square root of the area of a patch's pixel in the photo; 0 for a surface that is seen from behind."""
    can_match: Bool[np.ndarray, "n"]
    """Whether the photo shows the place, in a scale that can be matched."""


def grey(rgb: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w"]:
    """Return the luma of a photo."""
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)


def pinhole_vector(intrinsics: Intrinsics) -> Float64[np.ndarray, "4"]:
    """Return fx, fy, cx, cy."""
    return np.array([intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy])


def predicted(points: SurfacePoints, camera: Camera, config: PatchConfig = PATCHES) -> PredictedPatches:
    """Project the points and their patches into a camera."""
    k = camera.intrinsics
    px, depth, jacobian = project_surface(
        points.points_in_world, points.tangents, camera.pose.camera_from_world, pinhole_vector(k)
    )
    # A surface seen from behind turns its patch over, which makes the determinant negative.
    area = jacobian[:, 0, 0] * jacobian[:, 1, 1] - jacobian[:, 0, 1] * jacobian[:, 1, 0]
    squares = (jacobian**2).sum((1, 2))
    # The singular values s, t of a 2x2 matrix: s t is its determinant, s^2 + t^2 the sum of its squares.
    largest = np.sqrt(0.5 * (squares + np.sqrt(np.maximum(squares**2 - 4 * area**2, 0.0))))
    low, high = config.scale_range
    far = np.array([k.width, k.height]) - config.border_px
    with np.errstate(invalid="ignore"):
        shown = (depth > 0) & (px > config.border_px).all(1) & (px < far).all(1)
        can_match = shown & (area > low * largest) & (largest < high)
    return PredictedPatches(px, depth, jacobian, np.sqrt(np.maximum(area, 0.0)), can_match)


def matched(
    photo: UInt8[np.ndarray, "h w"],
    patches: UInt8[np.ndarray, "n side side"],
    where: PredictedPatches,
    max_motion_px: float,
    config: PatchConfig = PATCHES,
) -> Float64[np.ndarray, "n 2"]:
    """Return where a photo shows the patches, within some pixels of where they are predicted; NaN where it doesn't.

    Least-squares matching (Gruen 1985) with the warp that camera and surface give; place, gain and bias are estimated.
    """
    found = np.full((len(patches), 2), np.nan)
    todo = np.flatnonzero(where.can_match)
    warps = np.linalg.inv(where.photo_from_patch[todo])
    px, similarity = match_patches(
        photo, patches[todo], warps, where.px[todo], config.radius_px, config.max_steps,
        config.settled_px, max_motion_px, config.min_contrast,
    )  # fmt: skip
    good = similarity >= config.min_similarity
    found[todo[good]] = px[good]
    return found
