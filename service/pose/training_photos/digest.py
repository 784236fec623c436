"""The digest of a scene's training photos: what of them is kept to localize other photos more exactly.

Trainers may optimize the poses of their photos, and then the scene lies where theirs say, not the camera file's. So
some photos are refined against the scene first: where they move by more than refinement errs, all are, and their points
are triangulated with the refined poses. Else the given ones are more exact.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from service.geometry import se3_log
from service.interfaces import Matcher, Rasterizer, SurfacePoints
from service.photos.images import photo_size, read_query
from service.pose.features.image_sizes import RENDER_PX, sized
from service.pose.features.query_images import QueryImages
from service.pose.features.rendered_views import RenderedView
from service.pose.refinement.photometric import refine_photometric
from service.pose.refinement.uncertainty import refinement_covariance
from service.pose.training_photos.corners import surface_corners
from service.pose.training_photos.effect import distances
from service.pose.training_photos.patch_matching import grey
from service.pose.training_photos.surface_points import PosedPhoto, TriangulatedCorners, triangulated_corners
from service.types import Camera, GaussianScene, NamedCamera, Pose


@dataclass(frozen=True, slots=True)
class DigestConfig:
    """How many photos a digest is made of, and when it is believed."""

    max_photos: int = 300
    """Of more, every second, third... is read: neighbours in a video show the same, and each takes a megabyte here."""
    sample: int = 8
    """Photos that are refined to find out whether the scene lies where their poses say, and what the digest gains."""
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
    effect: tuple[float, float] | None
    """Median distance from a training photo's pose, in scene units, to which refinement leads without the digest and
    with it. None where poses were refined against the scene, so that there are no other ones."""

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
    digest = hashlib.sha256(np.ascontiguousarray(scene.means).data)
    digest.update(np.asarray(scene.info.origin_in_world, np.float64).tobytes())
    return digest.hexdigest()


def digest_of(
    photos: Sequence[TrainingPhoto],
    scene: GaussianScene,
    rasterizer: Rasterizer,
    progress: Callable[[int, int], None] | None = None,
    config: DigestConfig = DIGEST,
) -> PhotoDigest | None:
    """Return the digest of training photos; None where no point is shown by three of them."""
    sample = _Sample.of(photos, rasterizer, config)
    is_off = sample.is_off(photos, config)
    poses = [_aligned(photo, rasterizer) if is_off else photo.camera.pose for photo in photos]
    posed = [
        PosedPhoto(photo.grey, Camera(photo.camera.intrinsics, pose)) for photo, pose in zip(photos, poses, strict=True)
    ]
    found = []
    for number, photo in enumerate(photos):
        known = None if is_off else sample.refined.get(number)
        rendered = known.rendered if known else _rendered(photo, poses[number], rasterizer)
        corners = surface_corners(photo.grey, photo.valid_mask, rendered.frame, rendered.camera)
        found.append(triangulated_corners(number, corners, posed))
        if progress:
            progress(number + 1, len(photos))
    rms = np.concatenate([one.rms_px for one in found]) if found else np.zeros(0)
    if not len(rms):
        return None
    points = _joined(found, poses)
    return PhotoDigest(
        points=points,
        scene_key=scene_key(scene),
        names=tuple(photo.name for photo in photos),
        sha256=tuple(photo.sha256 for photo in photos),
        offsets=np.stack([_offset(photo.camera.pose, pose) for photo, pose in zip(photos, poses, strict=True)]),
        reprojection_px=float(np.median(rms)),
        depth_ratio=float(np.median(np.concatenate([one.depth_ratio for one in found]))),
        effect=None if is_off else sample.effect(posed, points),
    )


def _joined(found: Sequence[TriangulatedCorners], poses: Sequence[Pose]) -> SurfacePoints:
    names = ("points_in_world", "covariances", "tangents", "patches", "photo")
    joined = {name: np.concatenate([getattr(one.points, name) for one in found]) for name in names}
    return SurfacePoints(**joined, photo_positions=np.stack([pose.position_in_world for pose in poses]))


def _offset(given: Pose, used: Pose) -> Float64[np.ndarray, "6"]:
    return np.zeros(6) if given is used else se3_log(used.camera_from_world @ given.world_from_camera)


@dataclass(frozen=True, slots=True)
class _Refined:
    """Where refinement leads from a training photo's pose."""

    rendered: RenderedView
    """From the pose that it began with."""
    pose: Pose
    covariance: Float64[np.ndarray, "6 6"]


@dataclass(slots=True)
class _Sample:
    """Some of the photos, evenly spread, refined against the scene from the given poses."""

    refined: dict[int, _Refined]

    @classmethod
    def of(cls, photos: Sequence[TrainingPhoto], rasterizer: Rasterizer, config: DigestConfig) -> _Sample:
        numbers = range(0, len(photos), max(1, -(-len(photos) // config.sample)))
        tried = {number: _refined(photos[number], photos[number].camera.pose, 2, rasterizer) for number in numbers}
        return cls({number: found for number, found in tried.items() if found is not None})

    def is_off(self, photos: Sequence[TrainingPhoto], config: DigestConfig) -> bool:
        """Return whether the scene doesn't lie where the given poses say."""
        offsets = {number: _offset(photos[number].camera.pose, found.pose) for number, found in self.refined.items()}
        misfits = [offset @ np.linalg.solve(self.refined[i].covariance, offset) for i, offset in offsets.items()]
        return bool(misfits) and float(np.median(misfits)) > config.max_misfit

    def effect(self, posed: Sequence[PosedPhoto], points: SurfacePoints) -> tuple[float, float] | None:
        """Return the median distances of `distances`; None where no photo has them."""
        found = [
            distances(number, posed, points, one.rendered, one.pose, one.covariance)
            for number, one in self.refined.items()
        ]
        both = np.array([one for one in found if one is not None]).reshape(-1, 2)
        return (float(np.median(both[:, 0])), float(np.median(both[:, 1]))) if len(both) else None


def _aligned(photo: TrainingPhoto, rasterizer: Rasterizer) -> Pose:
    """Return the pose to which refinement on two renders leads; the given one where it fails."""
    first = _refined(photo, photo.camera.pose, 2, rasterizer)
    second = first and _refined(photo, first.pose, 1, rasterizer)
    return second.pose if second else photo.camera.pose


def _refined(photo: TrainingPhoto, start: Pose, levels: int, rasterizer: Rasterizer) -> _Refined | None:
    """Refine a photo's pose on a render from there; None: it fails."""
    rendered = _rendered(photo, start, rasterizer)
    camera = rendered.camera
    result = refine_photometric(photo.small, rendered.frame, camera, camera, levels, valid_mask=photo.small_mask)
    covariance = refinement_covariance(result, rendered.frame, camera)
    return None if covariance is None else _Refined(rendered, result.pose, covariance)


def _rendered(photo: TrainingPhoto, pose: Pose, rasterizer: Rasterizer) -> RenderedView:
    camera = Camera(sized(photo.camera.intrinsics, RENDER_PX), pose)
    return RenderedView(rasterizer.render([camera])[0], camera)
