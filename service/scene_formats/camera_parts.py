"""Evidence for the cameras of a large scene, of which a few cameras see next to nothing: part by part.

A part is a camera and those nearest to it, with the points around them. Right cameras see much of what is around them
in every part. Wrong ones may do so in some part of a building, but elsewhere they are outside of it or within walls.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int64

from service.geometry import project, transformed
from service.scene_formats.camera_evidence import Evidence, EvidenceConfig, Photo, Points, evidence
from service.scene_formats.frame_candidates import CameraFile, Candidate, corrected, poses_of
from service.types import NamedCamera


@dataclass(frozen=True, slots=True)
class PartsConfig:
    """How a large scene is divided, and what is asked of its parts."""

    least_cameras: int = 160
    """Of fewer a choice that is spread over the whole scene sees most of it."""
    parts: int = 9
    cameras: int = 40
    """Of a part; as many of them are looked through as would be in the whole scene."""
    reach: float = 2.0
    """Of a part's points, in units of the distance of its outermost camera."""
    points: int = 600_000
    """Of the whole scene, from which the parts' are taken."""
    least_points: int = 300
    sample: int = 6000
    """Points by which it is told how much of the whole scene a camera has in its image."""
    quantile: float = 0.25
    """Over the parts: this one's geometry is returned, and fewer may show nothing at all."""


PARTS = PartsConfig()


class Parts:
    """The points and cameras of a large scene, part by part."""

    def __init__(
        self,
        points: Points,
        file: CameraFile,
        photo_of: Callable[[NamedCamera], Photo | None],
        config: PartsConfig = PARTS,
    ) -> None:
        """Take an even choice of the scene's points; `photo_of` returns a camera's photo, or None."""
        self._points, self._file, self._photo_of, self._config = points, file, photo_of, config

    @property
    def middle(self) -> Float64[np.ndarray, "3"]:
        return self._points.middle

    def evidence(self, candidate: Candidate, config: EvidenceConfig) -> Evidence:
        """Return the geometry of a poor part, and the mean of all parts' correlations."""
        parts = self._config
        tolerated = int(parts.quantile * (parts.parts - 1))
        positions = corrected(poses_of(self._file.cameras), candidate.axes, self._file.stored_from_opencv)[:, :3, 3]
        step = max(1, parts.cameras // config.cameras)
        geometry, correlations = [], []
        middles = [int((number + 0.5) / parts.parts * len(positions)) for number in range(parts.parts)]
        if self._share_in_view(candidate, middles) > config.part:  # an object that is seen from all sides
            return Evidence(0.0, None)
        for middle in positions[middles]:
            nearest = np.argsort(np.linalg.norm(positions - middle, axis=1), kind="stable")[: parts.cameras]
            found = self._of_part(candidate, np.sort(nearest)[::step], config)
            geometry.append(found.geometry)
            if found.correlation is not None:
                correlations.append(found.correlation)
            elif geometry.count(0.0) > tolerated:  # the outcome is known: most wrong candidates end here
                return Evidence(0.0, None)
        poor = float(np.quantile(geometry, parts.quantile))
        # Each camera sees but a part of the scene, which is around it.
        return Evidence(poor, float(np.mean(correlations)) if correlations else None, surrounded=True)

    def _share_in_view(self, candidate: Candidate, chosen: Sequence[int]) -> float:
        """Return the median share of the whole scene that these cameras have in their images, hidden or not."""
        points = self._points.positions[:: max(1, len(self._points.positions) // self._config.sample)]
        shares = []
        for named in candidate.placed([self._file.cameras[i] for i in chosen], self._file):
            size = [named.camera.intrinsics.width, named.camera.intrinsics.height]
            in_camera = transformed(named.camera.pose.camera_from_world, points + self._points.middle)
            px = project(in_camera[in_camera[:, 2] > 0], named.camera.intrinsics)
            shares.append(float(((px > 0) & (px < size)).all(1).sum() / len(points)))
        return float(np.median(shares))

    def _of_part(self, candidate: Candidate, chosen: Int64[np.ndarray, "k"], config: EvidenceConfig) -> Evidence:
        """Return what these cameras see of the points around them."""
        cameras = [self._file.cameras[i] for i in chosen]
        photos = [self._photo_of(named) for named in cameras]
        placed = [named.camera for named in candidate.placed(cameras, self._file)]
        positions = np.stack([camera.pose.position_in_world for camera in placed]) - self._points.middle
        middle = np.median(positions, axis=0)
        reach = self._config.reach * np.linalg.norm(positions - middle, axis=1).max()
        offsets = self._points.positions - middle.astype(np.float32)
        near = np.flatnonzero(np.einsum("ni,ni->n", offsets, offsets) < reach * reach)
        if len(near) < self._config.least_points:
            return Evidence(0.0, 0.0 if any(photo is not None for photo in photos) else None)
        near = near[:: max(1, len(near) // config.points)]
        around = replace(self._points, positions=self._points.positions[near], sizes=self._points.sizes[near],
                         rgb=self._points.rgb[near])  # fmt: skip
        return evidence(around, placed, photos, config)
