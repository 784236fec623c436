"""Everything that is computed from the photo alone: resized copies, valid masks, local features, corners.

Each is computed once for a size and an in-plane rotation. A job makes one `QueryImages` and passes it to the steps of
its method and to verification. A mirrored photo needs another one. A photo with corrected intrinsics uses the pictures
of the original (`corrected`): none of them depends on focal length or principal point, and where the correction has a
distortion, pictures are resampled and features moved, not extracted again.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float64, UInt8

from service.interfaces import Features, Matcher
from service.photos.intrinsics import undistorted, undistorted_points
from service.pose.features.image_sizes import PHOTO_PX, SIZE_MULTIPLE_PX, sized
from service.pose.features.in_plane_rotation import CORNERS, Corners, detect_corners
from service.types import Intrinsics, IntrinsicsCorrection, Query


@dataclass(frozen=True, slots=True)
class PhotoConfig:
    """What is taken from a photo."""

    max_features: int = 2048
    margin_px: int = 6
    """Least distance of a feature from an invalid pixel: nearer ones describe the mask's edge."""
    min_valid_share: float = 0.99
    """Share of valid photo pixels in a pixel of a resized copy from which on that counts as valid."""


PHOTOS = PhotoConfig()


@dataclass(frozen=True, slots=True)
class QueryImages:
    """A photo, and what was computed from its pixels so far. For one thread."""

    query: Query
    matcher: Matcher
    _photos: dict[tuple[int, int], UInt8[np.ndarray, "_ _ 3"]] = field(default_factory=dict, repr=False)
    _masks: dict[tuple[int, int], Bool[np.ndarray, "_ _"]] = field(default_factory=dict, repr=False)
    _features: dict[tuple[int, int], Features] = field(default_factory=dict, repr=False)

    _distorted: QueryImages | None = field(default=None, repr=False)
    """The same photo with the distortion that these pictures are without; None: it has none."""
    _k1: float = 0.0
    """That distortion."""

    def corrected(self, correction: IntrinsicsCorrection) -> QueryImages:
        """Return the same pictures with corrected intrinsics of the query, and without the correction's distortion."""
        query = self.query.corrected(correction)
        if not correction.k1:
            return replace(self, query=query)
        return QueryImages(query, self.matcher, _distorted=self, _k1=correction.k1)

    def _camera(self, width: int, height: int) -> Intrinsics:
        """Return the camera of the distorted picture of this size."""
        pinhole = self.query.intrinsics.resized(width, height)
        return replace(pinhole, model="OPENCV", distortion=(self._k1, 0.0, 0.0, 0.0))

    def resized(self, size: Intrinsics) -> UInt8[np.ndarray, "h w 3"]:
        """Return the photo resampled to `size.width` x `size.height`: area averages when it shrinks, else bilinear."""
        key = size.width, size.height
        if key not in self._photos and self._distorted:
            self._photos[key] = undistorted(self._distorted.resized(size), self._camera(*key))[0]
        elif key not in self._photos:
            rgb = self.query.rgb
            # Area averages don't alias when the image shrinks.
            mode = cv2.INTER_AREA if size.width * size.height < rgb.shape[0] * rgb.shape[1] else cv2.INTER_LINEAR
            self._photos[key] = np.asarray(cv2.resize(rgb, key, interpolation=mode))
        return self._photos[key]

    def valid_mask(self, size: Intrinsics) -> Bool[np.ndarray, "h w"] | None:
        """Return which pixels of `resized(size)` are of valid photo pixels alone; None: all."""
        key = size.width, size.height
        if self._distorted:
            return self._undistorted_mask(size)
        if self.query.valid_mask is None:
            return None
        if key not in self._masks:
            # Pixels that mix with invalid ones are invalid, too.
            share = cv2.resize(self.query.valid_mask.astype(np.float32), key, interpolation=cv2.INTER_AREA)
            self._masks[key] = np.asarray(share) > PHOTOS.min_valid_share
        return self._masks[key]

    def _undistorted_mask(self, size: Intrinsics) -> Bool[np.ndarray, "h w"] | None:
        assert self._distorted is not None
        key = size.width, size.height
        if key not in self._masks:
            before = self._distorted.valid_mask(size)
            valid = np.ones((size.height, size.width), np.uint8) if before is None else before.astype(np.uint8)
            # Resampling leaves what the photo doesn't show at 0.
            self._masks[key] = undistorted(valid, self._camera(*key))[0] > 0
        return None if self._masks[key].all() else self._masks[key]

    def features(self, long_side: int = PHOTO_PX, roll_steps_45deg: int = 0) -> Features:
        """Return the photo's features, extracted at this size, in pixels of `Query.rgb`.

        Before extraction the photo is rotated counter-clockwise by `roll_steps_45deg` (learned descriptors tolerate
        some 30 degrees of in-plane rotation); the features' places refer to the photo as it is.
        """
        key = long_side, roll_steps_45deg
        if key not in self._features and self._distorted:
            found = self._distorted.features(long_side, roll_steps_45deg)
            camera = self._camera(self.query.intrinsics.width, self.query.intrinsics.height)
            self._features[key] = replace(found, points_px=undistorted_points(found.points_px, camera))
        elif key not in self._features:
            size = sized(self.query.intrinsics, long_side)
            rotated, rotated_from_photo = _rotated(self.resized(size), roll_steps_45deg)
            found = self.matcher.extract(rotated, PHOTOS.max_features)
            # The inverse of a rotation is its transpose: back to the photo's own pixels.
            points = (found.points_px - rotated_from_photo[:, 2]) @ rotated_from_photo[:, :2]
            keep = _away_from_edges(points, self.valid_mask(size), size, bool(roll_steps_45deg % 2))
            # The two sides are rounded to multiples of 32 separately, so their factors differ a little.
            scale = np.array([self.query.rgb.shape[1] / size.width, self.query.rgb.shape[0] / size.height])
            self._features[key] = Features(
                (points[keep] * scale).astype(np.float32), found.scores[keep], found.descriptors[keep]
            )
        return self._features[key]

    def corners(self) -> Corners:
        """Return the photo's corners at PHOTO_PX, for the estimate of its in-plane rotation."""
        size = sized(self.query.intrinsics, PHOTO_PX)
        return detect_corners(self.resized(size), CORNERS.of_photo, self.valid_mask(size))


def _rotated(
    rgb: UInt8[np.ndarray, "h w 3"], steps_45deg: int
) -> tuple[UInt8[np.ndarray, "_ _ 3"], Float64[np.ndarray, "2 3"]]:
    """Return the image rotated about its middle on a canvas that holds it, and the map of its pixels to that."""
    height, width = rgb.shape[:2]
    if steps_45deg % 8 == 0:
        return rgb, np.eye(2, 3)
    cosine, sine = np.cos(steps_45deg * np.pi / 4), np.sin(steps_45deg * np.pi / 4)
    rotation = np.array([[cosine, sine], [-sine, cosine]])
    # The canvas holds the whole rotated image.
    extent = np.abs(rotation) @ [width, height]
    canvas = (np.ceil(extent / SIZE_MULTIPLE_PX - 1e-6) * SIZE_MULTIPLE_PX).astype(int)
    shift = canvas / 2 - rotation @ [width / 2, height / 2]
    # OpenCV counts from the centre of the first pixel.
    shift_cv = shift - 0.5 + rotation @ [0.5, 0.5]
    matrix = np.concatenate([rotation, shift_cv[:, None]], 1)
    rotated = cv2.warpAffine(rgb, matrix, (int(canvas[0]), int(canvas[1])), flags=cv2.INTER_LINEAR)
    return np.asarray(rotated), np.concatenate([rotation, shift[:, None]], 1)


def _away_from_edges(
    points: Float64[np.ndarray, "n 2"], valid: Bool[np.ndarray, "h w"] | None, size: Intrinsics, oblique: bool
) -> Bool[np.ndarray, "n"]:
    """Return which points keep the margin from invalid pixels and, after an oblique rotation, from the borders."""
    keep, margin = np.ones(len(points), bool), PHOTOS.margin_px
    if oblique:  # the borders became lines in the canvas
        keep &= ((points > margin) & (points < np.array([size.width, size.height]) - margin)).all(1)
    if valid is not None:
        # Erosion with a square of this side moves the mask's edge inwards by the margin.
        around = np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)
        safe = cv2.erode(valid.astype(np.uint8), around, borderType=cv2.BORDER_REPLICATE) > 0
        column, row = np.clip(points.astype(int), 0, [size.width - 1, size.height - 1]).T
        keep &= safe[row, column]
    return keep
