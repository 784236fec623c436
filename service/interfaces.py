"""The protocols behind which renderers, matchers and estimators are exchanged. numpy only."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float32, Float64, Int32, UInt8

from service.results import IterationRecord, Verdict
from service.types import Camera, GaussianScene, IntrinsicsCorrection, Pose, Query


@dataclass(frozen=True, slots=True)
class Frame:
    """One render. float32."""

    rgb: Float32[np.ndarray, "h w 3"]
    """Over the scene's background, sRGB-encoded, 0..1 (a bright scene may exceed 1)."""
    alpha: Float32[np.ndarray, "h w"]
    depth: Float32[np.ndarray, "h w"]
    """Expected z-depth: weighted mean over the ray; 0 where alpha is 0. Averages translucent surfaces."""
    median_depth: Float32[np.ndarray, "h w"]
    """z-depth of the Gaussian at which transmittance falls below one half; 0 where it never does."""
    device_rgb: Any = None
    """`rgb` in 8 bits where the renderer made it: a tensor (h, w, 3) on its `tensor_device`."""


@dataclass(frozen=True, slots=True)
class SceneGradients:
    """d loss / d parameter, for the activated parameters of `GaussianScene`: rows of the Gaussians in view only."""

    index: Int32[np.ndarray, "v"]
    """Which Gaussian of the scene each row belongs to; all others' gradients are 0."""
    means: Float32[np.ndarray, "v 3"]
    quats: Float32[np.ndarray, "v 4"]
    """Through the quaternion's normalization: tangential to the unit sphere."""
    scales: Float32[np.ndarray, "v 3"]
    opacities: Float32[np.ndarray, "v"]
    sh: Float32[np.ndarray, "v k 3"]


@runtime_checkable
class Rasterizer(Protocol):
    """Renders one scene, which it keeps uploaded or packed. Safe to call from several threads."""

    name: str

    @property
    def nbytes(self) -> int:
        """Bytes of memory held."""
        ...

    @property
    def cameras_at_once(self) -> int:
        """Images worth asking for in one call by who needs many. 1: as they are needed, each in its caller's thread."""
        return 1

    @property
    def tensor_device(self) -> str:
        """PyTorch's name of the device on which its images are, too (`Frame.device_rgb`); empty: nowhere but here."""
        return ""

    def of(self, scene: GaussianScene) -> Rasterizer:
        """Return a rasterizer of the same kind for another scene."""
        ...

    def trained_at(self, long_side_px: int) -> Rasterizer:
        """Return a rasterizer of the same Gaussians, in the same memory, as if trained on photos of this size."""
        ...

    def over(self, background_rgb: tuple[float, float, float]) -> Rasterizer:
        """Return a rasterizer of the same Gaussians, in the same memory, over another background (sRGB, 0..1)."""
        ...

    def render(
        self,
        cameras: Sequence[Camera],
        approximate: bool = False,
        occlusion_depths: Sequence[Float32[np.ndarray, "_ _"]] | None = None,
    ) -> list[Frame]:
        """Render several cameras; independent ones may use idle cores.

        An `approximate` image may lack what is behind nearly opaque surfaces, up to 3 % of a pixel's light. Of
        `occlusion_depths`, one coarse image for each camera, every pixel is a z-depth beyond which nothing need be
        rendered.
        """
        ...

    def pose_gradient(
        self,
        camera: Camera,
        d_rgb: Float32[np.ndarray, "h w 3"],
        d_depth: Float32[np.ndarray, "h w"] | None = None,
        d_alpha: Float32[np.ndarray, "h w"] | None = None,
    ) -> Float64[np.ndarray, "6"]:
        """d loss / d twist at 0, where world_from_camera becomes world_from_camera @ exp(twist).

        The twist is (rotation, translation) in the camera frame. `d_rgb` is d loss / d rgb, and so on; `d_depth`
        refers to the expected depth.
        """
        ...

    def pose_gradients(
        self, cameras: Sequence[Camera], d_rgb: Sequence[Float32[np.ndarray, "_ _ 3"]]
    ) -> Float64[np.ndarray, "n 6"]:
        """`pose_gradient` of several cameras, from the colours' gradients; one by one unless a renderer does better."""
        return np.stack([self.pose_gradient(*each) for each in zip(cameras, d_rgb, strict=True)])

    def scene_gradients(
        self,
        camera: Camera,
        d_rgb: Float32[np.ndarray, "h w 3"],
        d_depth: Float32[np.ndarray, "h w"] | None = None,
        d_alpha: Float32[np.ndarray, "h w"] | None = None,
    ) -> SceneGradients:
        """d loss / d every parameter of the scene."""
        ...


@dataclass(frozen=True, slots=True)
class Features:
    """Local features of one image."""

    points_px: Float32[np.ndarray, "n 2"]
    """Centre of the top-left pixel = (0.5, 0.5)."""
    scores: Float32[np.ndarray, "n"]
    """Descending."""
    descriptors: Float32[np.ndarray, "n d"]
    """Unit length: the dot product is the similarity."""


@runtime_checkable
class Matcher(Protocol):
    """Finds local features and pairs them. Safe to call from several threads."""

    name: str

    def extract(self, rgb: UInt8[np.ndarray, "h w 3"], limit: int) -> Features:
        """Return the `limit` strongest features; fewer, or none, if the image has no more."""
        ...

    def match(self, a: Features, b: Features) -> Int32[np.ndarray, "m 2"]:
        """Return pairs of indices into `a` and `b`, the surest first; each index at most once."""
        ...


@runtime_checkable
class RenderMatcher(Protocol):
    """A `Matcher` that also finds the features of renders on the renderer's own device."""

    def extract_rendered(self, frames: Sequence[Frame], limit: int) -> list[Features]:
        """Return `extract` of each render in 8 bits, all of one size, from its `device_rgb`."""
        ...


@dataclass(frozen=True, slots=True)
class ImagePairs:
    """Points of two images that show the same."""

    a_px: Float32[np.ndarray, "m 2"]
    """Centre of the top-left pixel = (0.5, 0.5)."""
    b_px: Float32[np.ndarray, "m 2"]
    confidence: Float32[np.ndarray, "m"]


@runtime_checkable
class ImageMatcher(Protocol):
    """Pairs two images without features of each (detector-free networks). Safe to call from several threads."""

    name: str

    def match_images(self, a: UInt8[np.ndarray, "h w 3"], b: UInt8[np.ndarray, "h2 w2 3"]) -> ImagePairs:
        """Return pairs of pixels that show the same point, with confidences; each in its image's pixels."""
        ...


@dataclass(frozen=True, slots=True)
class SurfacePoints:
    """Points on the scene's surface that training photos show, each with a patch of one of these photos.

    `service/pose/training_photos` finds them.
    """

    points_in_world: Float64[np.ndarray, "n 3"]
    """Relative to the scene's origin, like its Gaussians."""
    covariances: Float32[np.ndarray, "n 3 3"]
    """Of the points, in the world."""
    tangents: Float32[np.ndarray, "n 3 2"]
    """By how much the point moves on its surface for one pixel of the patch to the right, and down."""
    patches: UInt8[np.ndarray, "n side side"]
    """Luma; the point is in the middle, at the corner of four pixels."""
    photo: Int32[np.ndarray, "n"]
    """Number of the photo that the patch is of."""
    photo_positions: Float64[np.ndarray, "p 3"]
    """Where the photos were taken; like the points."""


@dataclass(slots=True)
class RenderTally:
    """Counts a job's renders, and a gradient as one more."""

    count: int = 0


# Covariant: tools with a view index are tools with anything prepared.
Prepared = TypeVar("Prepared", covariant=True)


@dataclass(frozen=True, slots=True)
class Tools(Generic[Prepared]):
    """What an estimator works with, for one scene and one job. `Prepared` is what its `prepare` returns."""

    scene: GaussianScene
    rasterizer: Rasterizer
    matcher: Matcher
    rng: np.random.Generator
    """Seeded by the job's seed: the only source of randomness."""
    prepared: Prepared
    """What the estimator's own `prepare` made for this scene, shared by all jobs; None if it has none, and while it
    prepares."""
    image_matcher: ImageMatcher | None = None
    """In the place of `matcher` for methods that match renders with the photo; those that need features refuse."""
    tally: RenderTally = field(default_factory=RenderTally)
    """Of `rasterizer`; an estimator that renders with another one wraps it with `counted`, too."""
    surface_points: SurfacePoints | None = None
    """Of the training photos; None: the scene has no digest of them."""


@dataclass(frozen=True, slots=True)
class Answer:
    """What an estimator returns when it has come to an end by itself."""

    pose: Pose
    correction: IntrinsicsCorrection
    """Of the query's intrinsics."""
    verdict: Verdict
    """The verification gate's on this pose and these intrinsics."""


@runtime_checkable
class Estimator(Protocol):
    """A plain generator function satisfies it: it yields records, and the last record's pose is the answer.

    It yields at least one record; long stages yield per hypothesis, so that budget and cancel take effect. An estimator
    that has verified its answer returns it with the verdict; of others, and of those cut short, the driver renders and
    verifies the last record's pose. It never prints, never sees the truth, and cleans up in `finally`.
    """

    def __call__(
        self, query: Query, tools: Tools[Any], options: Any
    ) -> Generator[IterationRecord, None, Answer | None]: ...
