"""The digest of a scene's training photos: what of them is kept to localize other photos more exactly.

Trainers may optimize the poses of their photos, and then the scene lies where theirs say, not the camera file's. So
some photos are refined against the scene first: where they move by more than refinement errs, all are, and their points
are triangulated with the refined poses. Else the given ones are more exact.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from service.geometry import se3_log
from service.interfaces import Frame, Matcher, Rasterizer, SurfacePoints
from service.photos.images import photo_size, read_query
from service.pose.features.image_sizes import RENDER_PX, sized
from service.pose.features.query_images import QueryImages
from service.pose.refinement.photometric import refine_photometric
from service.pose.refinement.uncertainty import refinement_covariance
from service.pose.training_photos.corners import surface_corners
from service.pose.training_photos.patch_matching import grey
from service.pose.training_photos.surface_points import PosedPhoto, TriangulatedCorners, triangulated_corners
from service.types import Camera, GaussianScene, NamedCamera, Pose


@dataclass(frozen=True, slots=True)
class DigestConfig:
    max_photos: int = 300
    """Of more, every second, third... is read: neighbours in a video show the same, and each takes a megabyte here."""
    aligned_sample: int = 12
    """Photos that are refined to find out whether the scene lies where their poses say."""
    max_misfit: float = 25.0
    """Median of the squared offset in standard deviations of refinement, 6 by chance; scenes whose trainers leave the
    poses alone have 0.7 to 6.4."""


DIGEST = DigestConfig()


@dataclass(frozen=True, slots=True)
class TrainingPhoto:
    """A decoded photo, with its camera by the camera file (relative to the scene's origin)."""

    name: str
    sha256: str
    """Of its file."""
    grey: UInt8[np.ndarray, "h w"]
    valid_mask: Bool[np.ndarray, "h w"] | None
    camera: Camera
    """Of `grey`."""
    small: UInt8[np.ndarray, "h2 w2 3"]
    small_mask: Bool[np.ndarray, "h2 w2"] | None
    """The photo at the size of renders, and its valid pixels."""

    @classmethod
    def read(
        cls, named: NamedCamera, data: bytes, background_rgb: tuple[float, float, float], matcher: Matcher
    ) -> TrainingPhoto | None:
        """Decode a photo's file; None if it has another shape than its camera. Raises InvalidImage."""
        width, height = photo_size(data)
        given = named.camera.intrinsics
        # Photos are often stored smaller than the camera file says.
        if abs(width * given.height - height * given.width) > 0.01 * width * given.height:
            return None
        query = read_query(data, intrinsics=given.resized(width, height), background_rgb=background_rgb)
        images, size = QueryImages(query, matcher), sized(query.intrinsics, RENDER_PX)
        return cls(
            named.name,
            hashlib.sha256(data).hexdigest(),
            grey(query.rgb),
            query.valid_mask,
            Camera(query.intrinsics, named.camera.pose),
            images.resized(size),
            images.valid_mask(size),
        )


@dataclass(frozen=True, slots=True)
class PhotoDigest:
    """What is kept of a scene's training photos."""

    points: SurfacePoints
    scene_key: str
    """`scene_key` of the scene: a digest of other Gaussians is of no use."""
    names: tuple[str, ...]
    sha256: tuple[str, ...]
    offsets: Float64[np.ndarray, "p 6"]
    """Of the poses that points were triangulated with: given pose = that pose @ exp(offset); zeros where the given ones
    were. (Rotation in rad, translation in scene units) in the camera's frame."""
    reprojection_px: float
    """Median of the points' reprojection errors in the photos, in pixels of the decoded photos."""
    depth_ratio: float
    """Median ratio of triangulated and rendered depth."""

    @property
    def nbytes(self) -> int:
        """Bytes of its arrays, which are what its file has."""
        points = self.points
        arrays = (points.points_in_world, points.covariances, points.tangents, points.patches, points.photo)
        return sum(array.nbytes for array in arrays) + points.photo_positions.nbytes + self.offsets.nbytes

    @property
    def is_aligned(self) -> bool:
        """Whether the photos' poses were refined against the scene."""
        return bool(np.any(self.offsets))


def scene_key(scene: GaussianScene) -> str:
    """Return a hash of where the scene's Gaussians are, with the origin that their positions are relative to."""
    told = hashlib.sha256(np.ascontiguousarray(scene.means))
    told.update(np.asarray(scene.info.origin_in_world, np.float64).tobytes())
    return told.hexdigest()


def digest_of(
    photos: Sequence[TrainingPhoto],
    scene: GaussianScene,
    rasterizer: Rasterizer,
    progress: Callable[[int, int], None] | None = None,
    config: DigestConfig = DIGEST,
) -> PhotoDigest | None:
    """Return the digest of training photos; None where no point is shown by three of them."""
    renderer = _Renders(rasterizer)
    poses = _poses(photos, renderer, config)
    posed = [
        PosedPhoto(photo.grey, Camera(photo.camera.intrinsics, pose)) for photo, pose in zip(photos, poses, strict=True)
    ]
    found = []
    for number, photo in enumerate(photos):
        frame, camera = renderer.of(photo, poses[number])
        corners = surface_corners(photo.grey, photo.valid_mask, frame, camera)
        found.append(triangulated_corners(number, corners, posed))
        if progress:
            progress(number + 1, len(photos))
    rms = np.concatenate([one.rms_px for one in found]) if found else np.zeros(0)
    if not len(rms):
        return None
    return PhotoDigest(
        points=_joined(found, poses),
        scene_key=scene_key(scene),
        names=tuple(photo.name for photo in photos),
        sha256=tuple(photo.sha256 for photo in photos),
        offsets=np.stack([_offset(photo.camera.pose, pose) for photo, pose in zip(photos, poses, strict=True)]),
        reprojection_px=float(np.median(rms)),
        depth_ratio=float(np.median(np.concatenate([one.depth_ratio for one in found]))),
    )


def _joined(found: Sequence[TriangulatedCorners], poses: Sequence[Pose]) -> SurfacePoints:
    names = ("points_in_world", "covariances", "tangents", "patches", "photo")
    joined = [np.concatenate([getattr(one.points, name) for one in found]) for name in names]
    return SurfacePoints(*joined, np.stack([pose.position_in_world for pose in poses]))


def _offset(given: Pose, used: Pose) -> Float64[np.ndarray, "6"]:
    return np.zeros(6) if given is used else se3_log(used.camera_from_world @ given.world_from_camera)


@dataclass(slots=True)
class _Renders:
    """Renders at poses of photos; those at given poses are kept until they are used again."""

    rasterizer: Rasterizer
    kept: dict[str, Frame] = field(default_factory=dict)

    def of(self, photo: TrainingPhoto, pose: Pose, keep: bool = False) -> tuple[Frame, Camera]:
        """Return a render at a pose, and its camera; from the given pose it is rendered once."""
        camera = Camera(sized(photo.camera.intrinsics, RENDER_PX), pose)
        if pose is not photo.camera.pose:
            return self.rasterizer.render([camera])[0], camera
        frame = self.kept.pop(photo.name, None) or self.rasterizer.render([camera])[0]
        if keep:
            self.kept[photo.name] = frame
        return frame, camera


def _poses(photos: Sequence[TrainingPhoto], renders: _Renders, config: DigestConfig) -> list[Pose]:
    """Return the given poses or, where the scene doesn't lie where these say, those that refinement leads to."""
    sample = photos[:: max(1, -(-len(photos) // config.aligned_sample))]
    misfits = [misfit for photo in sample if (misfit := _misfit(photo, renders)) is not None]
    if not misfits or np.median(misfits) < config.max_misfit:
        return [photo.camera.pose for photo in photos]
    poses = []
    for photo in photos:
        first = _refined(photo, photo.camera.pose, 2, renders)
        second = first and _refined(photo, first.pose, 1, renders)
        poses.append(second.pose if second else photo.camera.pose)
    return poses


def _misfit(photo: TrainingPhoto, renders: _Renders) -> float | None:
    """Return the square of the offset that refinement finds, in standard deviations; None: it fails."""
    found = _refined(photo, photo.camera.pose, 2, renders)
    if found is None:
        return None
    offset = _offset(photo.camera.pose, found.pose)
    return float(offset @ np.linalg.solve(found.covariance, offset))


@dataclass(frozen=True, slots=True)
class _Refined:
    pose: Pose
    covariance: Float64[np.ndarray, "6 6"]


def _refined(photo: TrainingPhoto, start: Pose, levels: int, renders: _Renders) -> _Refined | None:
    """Refine a photo's pose on a render from there; None: it fails."""
    frame, camera = renders.of(photo, start, keep=True)
    result = refine_photometric(photo.small, frame, camera, camera, levels, valid_mask=photo.small_mask)
    covariance = refinement_covariance(result, frame, camera)
    return None if covariance is None else _Refined(result.pose, covariance)
