"""The values that cross disk, HTTP and module borders: frozen, slotted, arrays really read-only.

Conventions (CONTRIBUTING.md has them all): OpenCV camera axes (+x right, +y down, +z forward); transforms are
named `target_from_source`; the centre of the top-left pixel is (0.5, 0.5); depth is z-depth; lengths are in scene
units; quaternions are wxyz.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from service.accuracy import DEFAULT_ACCURACY, Accuracy
from service.device_readings import DeviceReadings, ScenePriors
from service.distortion import composed
from service.errors import InvalidIntrinsics, InvalidPrior


def frozen(array: np.ndarray, dtype: type | None = None) -> np.ndarray:
    """Return a C-contiguous read-only array; copies only if it must to leave the caller's array writable."""
    result = np.ascontiguousarray(array, dtype=dtype)
    if result is array and array.flags.writeable:
        # The caller may still write to its own array, so a copy is frozen.
        result = array.copy()
    result.flags.writeable = False
    return result


SH_C0 = 0.28209479177387814
"""The constant spherical harmonic, 1 / (2 sqrt(pi))."""


@dataclass(frozen=True, slots=True)
class IntrinsicsCorrection:
    """What turns assumed intrinsics into the camera's own.

    A point at (x, y, 1) in the camera frame is seen at c + f (1 + k1 (x^2 + y^2)) (x, y), where c and f are the
    corrected principal point and focal length: COLMAP's SIMPLE_RADIAL.
    """

    focal_factor: float = 1.0
    shift_x: float = 0.0
    """Of the principal point, as a share of the image's long side: the same at every size."""
    shift_y: float = 0.0
    k1: float = 0.0
    """Radial distortion beside that of the assumed intrinsics."""

    def then(self, other: IntrinsicsCorrection) -> IntrinsicsCorrection:
        """Return this correction followed by another one; the distortion to first order."""
        return IntrinsicsCorrection(
            self.focal_factor * other.focal_factor,
            self.shift_x + other.shift_x,
            self.shift_y + other.shift_y,
            # Of radii in focal lengths, which the other factor rescales.
            self.k1 * other.focal_factor**2 + other.k1,
        )


NO_CORRECTION = IntrinsicsCorrection()
"""The intrinsics are as assumed."""


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """A camera without its pose. Refers to the upright image (EXIF orientation applied)."""

    width: int
    height: int
    fx: float
    """Pixels."""
    fy: float
    cx: float
    """Pixels from the left edge: the centre of an image is at width / 2."""
    cy: float
    model: str = "PINHOLE"
    """COLMAP's name of the camera model; renderers and estimators see PINHOLE only."""
    distortion: tuple[float, ...] = ()
    """COLMAP's parameters after the focal lengths and the principal point."""
    trust: Literal["exact", "approximate"] = "exact"
    """Approximate: focal length, radial distortion and principal point are estimated with the pose from here."""

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            if not 1 <= getattr(self, name) <= 100_000:
                raise InvalidIntrinsics(f"must lie in 1..100000, is {getattr(self, name)}.", where=name)
        for name in ("fx", "fy"):
            value = getattr(self, name)
            if not (np.isfinite(value) and 0 < value < 1e7):
                raise InvalidIntrinsics(f"must be a positive focal length in pixels, is {value}.", where=name)
        if not np.all(np.isfinite([self.cx, self.cy, *self.distortion])):
            raise InvalidIntrinsics("cx, cy and distortion must be finite numbers.", where="cx, cy")
        if self.trust not in ("exact", "approximate"):
            raise InvalidIntrinsics(f"must be exact or approximate, is {str(self.trust)[:40]!r}.", where="trust")

    @property
    def long_side(self) -> int:
        """The larger of width and height, pixels."""
        return max(self.width, self.height)

    def resized(self, width: int, height: int) -> Intrinsics:
        """Return the same camera for the image resampled to another size."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=self.cx * sx,
            cy=self.cy * sy,
        )

    def corrected(self, correction: IntrinsicsCorrection) -> Intrinsics:
        """Return the same camera with corrected focal length and principal point; its distortion is kept as it is.

        Of a pinhole it is the camera of the image from which the correction's distortion was removed.
        """
        if correction == NO_CORRECTION:
            return self
        return replace(
            self,
            fx=self.fx * correction.focal_factor,
            fy=self.fy * correction.focal_factor,
            cx=self.cx + correction.shift_x * self.long_side,
            cy=self.cy + correction.shift_y * self.long_side,
        )

    def distorted(self, correction: IntrinsicsCorrection) -> Intrinsics:
        """Return the camera of the photo as it was taken: corrected, and with the distortion added to this camera's.

        The sum of both distortions is fitted (`composed`).
        """
        camera = self.corrected(correction)
        if self.distortion and (correction.k1 or correction.focal_factor != 1.0):
            x, y = max(self.cx, self.width - self.cx), max(self.cy, self.height - self.cy)
            corner = float(np.hypot(x / camera.fx, y / camera.fy))
            model, distortion = composed(self.model, self.distortion, correction.focal_factor, correction.k1, corner)
            return replace(camera, model=model, distortion=distortion)
        if not correction.k1:
            return camera
        # It has a single focal length.
        if self.fx == self.fy:
            return replace(camera, model="SIMPLE_RADIAL", distortion=(correction.k1,))
        return replace(camera, model="OPENCV", distortion=(correction.k1, 0.0, 0.0, 0.0))

    def with_long_side(self, pixels: int) -> Intrinsics:
        """Return the camera for the image resampled so that its long side has `pixels`, never enlarged."""
        factor = min(1.0, pixels / self.long_side)
        # A narrow strip keeps a pixel.
        return self.resized(max(1, round(self.width * factor)), max(1, round(self.height * factor)))


@dataclass(frozen=True, slots=True)
class Pose:
    """The pose of a camera. World axes are the scene's own; units are scene units."""

    world_from_camera: Float64[np.ndarray, "4 4"]

    def __post_init__(self) -> None:
        matrix = frozen(self.world_from_camera, np.float64)
        if matrix.shape != (4, 4) or not np.all(np.isfinite(matrix)):
            raise InvalidPrior("a pose is a 4x4 matrix of finite numbers.", where="world_from_camera")
        rotation = matrix[:3, :3]
        # 1e-3: poses printed with 3 or 4 digits pass, scaled or sheared ones don't. First the size: squares overflow.
        is_large = np.abs(rotation).max() > 2
        if is_large or np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
            raise InvalidPrior(
                "the upper left 3x3 is not a rotation (orthonormal, determinant +1).",
                where="world_from_camera",
                hint="Remove scale and mirroring; columns are the camera's x, y and z axes in the world.",
            )
        # The last row of a rigid motion is exact in every format, so the tolerance is tight.
        if np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-9:
            raise InvalidPrior("the last row must be 0 0 0 1.", where="world_from_camera")
        object.__setattr__(self, "world_from_camera", matrix)

    @property
    def camera_from_world(self) -> Float64[np.ndarray, "4 4"]:
        """The inverse: the extrinsics of OpenCV and COLMAP."""
        inverse = np.eye(4)
        inverse[:3, :3] = self.world_from_camera[:3, :3].T
        inverse[:3, 3] = -inverse[:3, :3] @ self.world_from_camera[:3, 3]
        return inverse

    @property
    def position_in_world(self) -> Float64[np.ndarray, "3"]:
        """The camera's centre; scene units."""
        return self.world_from_camera[:3, 3]

    @property
    def axis_in_world(self) -> Float64[np.ndarray, "3"]:
        """The viewing direction, unit length."""
        return self.world_from_camera[:3, 2]


@dataclass(frozen=True, slots=True)
class Camera:
    """A camera model at a pose."""

    intrinsics: Intrinsics
    pose: Pose


@dataclass(frozen=True, slots=True)
class RigCamera:
    """One camera of a rig."""

    rig_from_camera: Pose
    """In the rig's frame, which may be any."""
    intrinsics: Intrinsics


@dataclass(frozen=True, slots=True)
class Rig:
    """Cameras whose poses relative to one another are known, in the order of their photos."""

    cameras: tuple[RigCamera, ...]
    metric: bool = False
    """Whether lengths are metres; else scene units."""


@dataclass(frozen=True, slots=True)
class NamedCamera:
    """A camera that the scene was trained with."""

    name: str
    """The photo's file name as the camera file gives it."""
    camera: Camera


@dataclass(frozen=True, slots=True)
class GeoAnchor:
    """Where on Earth a scene is: its world frame in the local East-North-Up frame of a point on WGS84."""

    latitude_deg: float
    longitude_deg: float
    height_m: float
    """Above the ellipsoid."""
    enu_from_world: Float64[np.ndarray, "4 4"]
    """A similarity: turns, shifts and scales the world frame to metres east, north and up of the point."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "enu_from_world", frozen(self.enu_from_world, np.float64))


@dataclass(frozen=True, slots=True)
class SceneFrame:
    """A frame that a scene's user knows, beside the world."""

    name: str
    """`file`: the scene file's. `cameras`: that of the camera file."""
    frame_from_world: Float64[np.ndarray, "4 4"]
    """A similarity."""
    decided_by: str
    """In words: what the transform follows from."""
    verified: bool
    """Photos or geometry exclude other transforms."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "frame_from_world", frozen(self.frame_from_world, np.float64))


@dataclass(frozen=True, slots=True)
class SceneInfo:
    """What is known of a scene besides its Gaussians."""

    id: str
    name: str
    sha256: str
    """Of the scene file's bytes, the manifest and the training cameras: the key of anything cached."""
    format: str
    """The reader's name: ply, compressed_ply, ply_gz, splat, ksplat, spz, sog, gltf, checkpoint."""
    background_rgb: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Seen where alpha is 0; sRGB, 0..1."""
    background_is_known: bool = True
    """Whether a file says so; if not, black is assumed unless a photo shows white."""
    up_in_world: tuple[float, float, float] | None = None
    metres_per_unit: float | None = None
    render_mode: Literal["default", "antialiased"] = "default"
    training_focal_px: float | None = None
    """Median focal length of the training photos; the renderer scales its dilation by it."""
    training_long_side_px: int | None = None
    """Long side of the training photos, where the focal length is unknown."""
    geo_anchor: GeoAnchor | None = None
    warnings: tuple[str, ...] = ()
    origin_in_world: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """What positions inside of the scene are relative to; see `service/scene_origin.py`."""
    near_plane: float = 0.01
    """Units: nothing nearer to a camera is drawn."""
    frames: tuple[SceneFrame, ...] = ()
    """Other frames that poses are given in."""
    cameras_doubtful: bool = False
    """Too little evidence says that the training cameras are in this frame: views don't rely on them alone."""


@dataclass(frozen=True, slots=True)
class GaussianScene:
    """Gaussians with activated values: no exp or sigmoid left to do. In memory, read-only."""

    means: Float32[np.ndarray, "n 3"]
    """World frame, less `info.origin_in_world`; so are the cameras."""
    quats: Float32[np.ndarray, "n 4"]
    """Unit, wxyz, world_from_gaussian."""
    scales: Float32[np.ndarray, "n 3"]
    """Standard deviations along the Gaussian's own axes."""
    opacities: Float32[np.ndarray, "n"]
    """0..1."""
    sh: Float32[np.ndarray, "n k 3"]
    """k = (degree + 1)^2 coefficients; colour = 0.5 + sum of basis times coefficient, clamped at 0, sRGB."""
    info: SceneInfo
    cameras: tuple[NamedCamera, ...] = ()

    def __post_init__(self) -> None:
        for name in ("means", "quats", "scales", "opacities", "sh"):
            object.__setattr__(self, name, frozen(getattr(self, name), np.float32))

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return int(np.sqrt(self.sh.shape[1])) - 1

    @property
    def nbytes(self) -> int:
        """Memory of the arrays, bytes."""
        return sum(getattr(self, n).nbytes for n in ("means", "quats", "scales", "opacities", "sh"))


@dataclass(frozen=True, slots=True)
class BoxPrior:
    """The camera's centre lies in a box along the world's axes. Raises InvalidPrior."""

    lower_in_world: Float64[np.ndarray, "3"]
    upper_in_world: Float64[np.ndarray, "3"]

    def __post_init__(self) -> None:
        corners = np.array([self.lower_in_world, self.upper_in_world], np.float64)
        if not np.all(np.isfinite(corners)) or not np.all(corners[0] < corners[1]):
            raise InvalidPrior(
                "must be two corners of finite numbers, each of the first less than the second's.", where="box"
            )
        object.__setattr__(self, "lower_in_world", frozen(corners[0], np.float64))
        object.__setattr__(self, "upper_in_world", frozen(corners[1], np.float64))


@dataclass(frozen=True, slots=True)
class GaussianPosePrior:
    """The camera's pose is normally distributed. Raises InvalidPrior."""

    pose: Pose
    covariance: Float64[np.ndarray, "6 6"]
    """Of the right perturbation in the camera's frame, like a verdict's: truth = pose @ exp(twist)."""

    def __post_init__(self) -> None:
        matrix = frozen(self.covariance, np.float64)
        shaped = matrix.shape == (6, 6) and bool(np.all(np.isfinite(matrix)))
        scale = np.sqrt(np.maximum(np.diag(matrix), 0.0)) if shaped else np.zeros(6)
        # Scaled, for rad and scene units differ by orders of magnitude.
        if (
            not (scale > 0).all()
            or np.abs(correlation := matrix / np.outer(scale, scale)).max() > 1 + 1e-6
            or (np.abs(correlation - correlation.T).max() > 1e-6 or np.linalg.eigvalsh(correlation).min() < 1e-9)
        ):
            raise InvalidPrior(
                "must be a 6x6 symmetric positive definite matrix.",
                where="covariance",
                hint="Of (rotation in rad, translation in scene units) in the camera's frame, like a result's.",
            )
        object.__setattr__(self, "covariance", matrix)


PriorRegion = BoxPrior | GaussianPosePrior
"""Where the photo was taken for certain; poses outside are refused."""


@dataclass(frozen=True, slots=True)
class LensPrior:
    """What is known of approximate intrinsics before the photo is localized: independent priors, centred on them.

    Focal length and principal point have heavy tails (Cauchy's distribution): most photos are as their source says,
    and some were cropped, or have an EXIF tag that was edited. The distortion's prior is normal.
    """

    log_focal_scale: float
    """Of the logarithm of the focal length."""
    k1_sigma: float = 0.05
    principal_point_scale: float = 0.007
    """In long sides of the image: phones and calibrated test cameras have 0.001 to 0.03."""


UNKNOWN_PRINCIPAL_POINT = LensPrior(1.0).principal_point_scale
"""Scale of a principal point of which nothing is known but that it is usually near the centre."""
IntrinsicsSource = Literal["given", "exif", "guessed", "memory", "fisheye"]
"""Where a photo's assumed intrinsics are from: the request, its EXIF, a default, earlier photos of the camera, or a
fisheye that the photo's matches showed instead of these."""
LENS_PRIORS: dict[IntrinsicsSource, LensPrior] = {
    "given": LensPrior(0.15),
    "exif": LensPrior(0.06),
    "guessed": LensPrior(0.5, k1_sigma=0.1),
    "fisheye": LensPrior(0.05, k1_sigma=0.03),
}
"""By the source of approximate intrinsics; of EXIF where nothing more is known of the tag."""


@dataclass(frozen=True, slots=True)
class Query:
    """A photo to localize: upright, undistorted, with a pinhole camera."""

    rgb: UInt8[np.ndarray, "h w 3"]
    """sRGB; decoded no larger than estimators use."""
    intrinsics: Intrinsics
    """Of `rgb`."""
    intrinsics_source: IntrinsicsSource
    photo_intrinsics: Intrinsics
    """Of the whole upright photo in its own resolution, with its distortion: what results report."""
    prior: Pose | None = None
    """A guess, which may be wrong: one more pose to search from."""
    warnings: tuple[str, ...] = ()
    valid_mask: Bool[np.ndarray, "h w"] | None = None
    """False where a pixel shows nothing: transparent, or outside a distorted photo's edge. None: valid everywhere."""
    lens_prior: LensPrior | None = None
    """Of approximate intrinsics, by default that of their source; None of exact ones: nothing of them is estimated."""
    region: PriorRegion | None = None
    """Poses outside are refused."""
    accuracy: Accuracy = DEFAULT_ACCURACY
    """What a pose must be certain within; without metres."""
    readings: DeviceReadings | None = None
    """What the device measured beside the photo, which may be wrong."""
    scene_priors: ScenePriors | None = None
    """The readings in the scene that is searched, as `asked_of` in `service/localize.py` puts them there."""
    rows_are_columns: bool = False
    """Whether EXIF turned the photo by 90 degrees: what the sensor read row by row are its columns."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "rgb", frozen(self.rgb, np.uint8))
        # Always there: estimators decide by the prior alone what of the intrinsics is estimated.
        if self.lens_prior is None and self.intrinsics.trust == "approximate":
            object.__setattr__(self, "lens_prior", LENS_PRIORS[self.intrinsics_source])
        if self.valid_mask is not None:
            object.__setattr__(self, "valid_mask", frozen(self.valid_mask, np.bool_))

    def corrected(self, correction: IntrinsicsCorrection) -> Query:
        """Return the query with corrected focal length and principal point.

        The distortion is that of `photo_intrinsics` only: `rgb` is left as it is, `QueryImages` undistorts it.
        """
        if correction == NO_CORRECTION:
            return self
        return replace(
            self,
            intrinsics=self.intrinsics.corrected(correction),
            photo_intrinsics=self.photo_intrinsics.distorted(correction),
        )
