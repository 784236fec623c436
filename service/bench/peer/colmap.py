"""COLMAP's parts by pycolmap: SIFT, triangulation with known poses, LO-RANSAC with refinement. One thread each.

pycolmap is BSD-3-Clause; its wheels contain SuiteSparse, of which CHOLMOD's supernodal part and SPQR are
GPL-2.0-or-later. It is a peer to measure with, and nothing that the service imports.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from service.bench.peer.photo_map import Points
from service.bench.peer.photo_matching import PhotoFeatures
from service.errors import BackendMissing
from service.types import Camera, Intrinsics, Pose

try:
    import pycolmap  # pyright: ignore[reportMissingImports]
except ImportError as error:
    raise BackendMissing(
        "pycolmap is not installed.", where="bench peer", hint="Install the extra: pip install 'splatfix[peer]'."
    ) from error

# It prints a line for each photo otherwise.
pycolmap.logging.minloglevel = 2


@dataclass(frozen=True, slots=True)
class Colmap:
    """A `Peer`: COLMAP with these settings of SIFT."""

    sift: dict[str, Any] = field(default_factory=dict)
    """By COLMAP's names; empty: its defaults, at most 8192 features of the photo at twice its size and smaller."""
    max_error_px: float = 6.0
    """Of an inlier of the absolute pose."""

    def features(self, grey: UInt8[np.ndarray, "h w"]) -> PhotoFeatures:
        """Return SIFT's keypoints and L1-root descriptors."""
        sift = pycolmap.SiftExtractionOptions(self.sift)
        options = pycolmap.FeatureExtractionOptions(num_threads=1, use_gpu=False, sift=sift)
        extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
        keypoints, found = extractor.extract_from_uint8_array(np.ascontiguousarray(grey))
        px = np.array([(point.x, point.y) for point in keypoints], np.float64).reshape(-1, 2)
        descriptors = found.data.astype(np.float32)
        return PhotoFeatures(px, descriptors / np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-6))

    def points(
        self,
        cameras: Sequence[Camera],
        px: Sequence[Float64[np.ndarray, "_ 2"]],
        matches: dict[tuple[int, int], Int64[np.ndarray, "_ 2"]],
    ) -> Points:
        """Triangulate tracks over three photos and more; cameras and poses stay as they are."""
        with tempfile.TemporaryDirectory() as folder:
            database, model = Path(folder, "matches.db"), Path(folder, "model")
            model.mkdir()
            reconstruction = _reconstruction(cameras)
            _write_matches(database, reconstruction, px, matches)
            options = pycolmap.IncrementalPipelineOptions(
                num_threads=1, extract_colors=False, ba_refine_focal_length=False, ba_refine_extra_params=False
            )
            options.triangulation.ignore_two_view_tracks = True
            found = pycolmap.triangulate_points(reconstruction, str(database), folder, str(model), True, options, False)
        numbers = {identifier: number for number, identifier in enumerate(found.points3D)}
        in_world = np.array([point.xyz for point in found.points3D.values()], np.float64).reshape(-1, 3)
        of_features = tuple(
            np.array(
                [numbers[p.point3D_id] if p.has_point3D() else -1 for p in found.images[number + 1].points2D], np.int64
            )
            for number in range(len(cameras))
        )
        return Points(in_world, of_features)

    def pose(
        self, px: Float64[np.ndarray, "m 2"], in_world: Float64[np.ndarray, "m 3"], intrinsics: Intrinsics
    ) -> tuple[Pose, int] | None:
        """Return the pose by LO-RANSAC and refinement on its inliers; of a fixed seed."""
        options = pycolmap.AbsolutePoseEstimationOptions()
        options.ransac.max_error = self.max_error_px
        options.ransac.min_inlier_ratio = 0.01
        options.ransac.num_threads = 1
        options.ransac.random_seed = 0
        refinement = pycolmap.AbsolutePoseRefinementOptions()
        found = pycolmap.estimate_and_refine_absolute_pose(px, in_world, _camera(intrinsics), options, refinement)
        if found is None:
            return None
        world_from_camera = np.eye(4)
        world_from_camera[:3] = found["cam_from_world"].inverse().matrix()
        return Pose(world_from_camera), int(found["num_inliers"])


def _camera(intrinsics: Intrinsics, number: int = 1) -> Any:
    params = [intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy]
    size = {"width": intrinsics.width, "height": intrinsics.height}
    return pycolmap.Camera(model="PINHOLE", params=params, camera_id=number, **size)


def _reconstruction(cameras: Sequence[Camera]) -> Any:
    """Return a model of cameras and poses without points; photo n has the number n + 1."""
    model = pycolmap.Reconstruction()
    for number, camera in enumerate(cameras, 1):
        model.add_camera_with_trivial_rig(_camera(camera.intrinsics, number))
        image = pycolmap.Image(name=str(number), keypoints=np.zeros((0, 2)), camera_id=number, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(camera.pose.camera_from_world[:3]))
    return model


def _write_matches(
    path: Path,
    model: Any,
    px: Sequence[Float64[np.ndarray, "_ 2"]],
    matches: dict[tuple[int, int], Int64[np.ndarray, "_ 2"]],
) -> None:
    database = pycolmap.Database.open(str(path))
    for camera in model.cameras.values():
        database.write_camera(camera, use_camera_id=True)
    for rig in model.rigs.values():
        database.write_rig(rig, use_rig_id=True)
    for frame in model.frames.values():
        database.write_frame(frame, use_frame_id=True)
    for image in model.images.values():
        database.write_image(image, use_image_id=True)
    for number, points in enumerate(px, 1):
        database.write_keypoints(number, points.astype(np.float32))
    calibrated = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
    for (i, j), pairs in matches.items():
        numbers = pairs.astype(np.uint32)
        database.write_matches(i + 1, j + 1, numbers)
        geometry = pycolmap.TwoViewGeometry(config=calibrated, inlier_matches=numbers)
        database.write_two_view_geometry(i + 1, j + 1, geometry)
    database.close()
