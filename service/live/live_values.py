"""What goes into a live session and comes out of it, as plain values that can be pickled."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64

from service.accuracy import DEFAULT_ACCURACY, Accuracy
from service.results import Verdict
from service.types import Intrinsics, Pose, PriorRegion

Mode = Literal["tracking", "carried", "relocalizing", "lost"]
"""`tracking`: the frame has a pose of its own. `carried`: it has none, but one by odometry since frames that had one.
`relocalizing`: it has none, and the first search since then is under way. `lost`: searches have ended without an
answer; they go on."""


@dataclass(frozen=True, slots=True)
class OdometryFacts:
    """What holds for the odometry of a session's frames."""

    metric: bool = True
    """Its unit is the metre; else one that nobody knows."""
    up_in_odom: tuple[float, float, float] | None = None
    """Up by gravity; of any length."""
    up_sigma_deg: float = 1.0
    """Standard deviation of that, and of the frames' own up."""
    smooth: bool = True
    """Whether what is reported follows the estimate by small steps."""


@dataclass(frozen=True, slots=True)
class FusedOdometry:
    """Where the odometry lies in the scene, at one frame."""

    world_from_odom: Float64[np.ndarray, "4 4"]
    """A similarity: its scale is `scale`."""
    scale: float
    """Scene units per unit of the odometry."""
    covariance: Float64[np.ndarray, "7 7"]
    """Of the twist (rotation rad, translation units) in the frame's camera, and of the scale's logarithm: the true
    camera is where world_from_odom has it, moved by exp(twist)."""
    offset_s: float
    """By how much the odometry's poses are late: its pose at `time_s` is that of the camera `offset_s` later."""
    resets: int
    """How often it began anew so far."""


@dataclass(frozen=True, slots=True)
class LiveTask:
    """A session: the scene, and what holds for all of its frames."""

    held: str
    """The token of the scene to look in."""
    estimator: str
    """That searches where tracking is lost."""
    seed: int = 0
    intrinsics: Intrinsics | None = None
    """Of frames that bring none; resized for frames of another size. None: EXIF's or a guess, estimated once."""
    prior: Pose | None = None
    """Where the first search begins."""
    region: PriorRegion | None = None
    """Poses outside are refused."""
    accuracy: Accuracy = DEFAULT_ACCURACY
    odometry: OdometryFacts = OdometryFacts()
    """Of frames that bring some."""


@dataclass(frozen=True, slots=True)
class LiveFrame:
    """One picture of the camera."""

    id: int
    """Ascending within a session."""
    time_s: float
    """When it was taken, by the client's clock; not descending."""
    data: bytes
    """JPEG."""
    intrinsics: Intrinsics | None = None
    """Of this frame, instead of the session's."""
    odom_from_camera: Pose | None = None
    """By the device's odometry at this time."""
    up_in_camera: tuple[float, float, float] | None = None
    """By gravity; of any length."""


@dataclass(frozen=True, slots=True)
class LiveAnswer:
    """What was found out about one frame."""

    id: int
    time_s: float
    """As the frame's."""
    mode: Mode
    size: tuple[int, int]
    """Width and height of the frame, pixels."""
    pose: Pose | None = None
    """In the world; None unless the mode is `tracking` or `carried`."""
    verdict: Verdict | None = None
    """The gate's decision on a frame's own pose: `localized` or `uncertain`."""
    intrinsics: Intrinsics | None = None
    """That the pose belongs to."""
    covariance: Float64[np.ndarray, "6 6"] | None = None
    """Of a carried pose, as a verdict's."""
    odometry: FusedOdometry | None = None
    """None: without odometry, or while no frame has had a pose since it began anew."""
    used_s: float = 0.0
    """Time from the frame's bytes to this answer."""
