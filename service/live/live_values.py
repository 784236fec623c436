"""What goes into a live session and comes out of it, as plain values that can be pickled."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from service.accuracy import DEFAULT_ACCURACY, Accuracy
from service.results import Verdict
from service.types import Intrinsics, Pose, PriorRegion

Mode = Literal["tracking", "relocalizing", "lost"]
"""`tracking`: the frame has a pose. `relocalizing`: it has none, and the first search since then is under way. `lost`:
searches have ended without an answer; they go on."""


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
    """In the world; None unless the mode is `tracking`."""
    verdict: Verdict | None = None
    """The gate's decision on that pose: `localized` or `uncertain`."""
    intrinsics: Intrinsics | None = None
    """That the pose belongs to."""
    used_s: float = 0.0
    """Time from the frame's bytes to this answer."""
