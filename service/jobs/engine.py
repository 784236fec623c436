"""What works on scenes in memory, as a protocol: jobs and routes reach scenes through it only.

Arguments and results are plain values that can be pickled, so an engine may be threads of this process
(`embedded_engine`), another process, or another machine. Records come through a callback while `localize` blocks its
caller. In a live session frames and poses go both ways: `live` blocks its caller, asks for each frame by one callback,
and gives its answer to another.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from service.accuracy import DEFAULT_ACCURACY, Accuracy
from service.errors import SplatfixError
from service.jobs.model import JobRecord, JobResult
from service.live.live_values import LiveAnswer, LiveFrame, LiveTask
from service.photos.sequence import SequenceOptions
from service.results import StageTiming
from service.rig import RigPhoto
from service.scene_manager.status import (
    CoverageStatus,
    PictureSpec,
    SceneContents,
    SceneReadiness,
    SceneStatus,
    StoredScene,
)
from service.types import Query, SceneInfo


class EngineLost(Exception):
    """The engine's process ended during the attempt, with its scenes; the attempt is lost."""


@dataclass(frozen=True, slots=True)
class HeldScenes:
    """Scenes that stay in memory until they are released."""

    token: str
    """Names them to `localize` and `release`."""
    ids: tuple[str, ...]
    background_rgb: tuple[float, float, float]
    """Of the first one."""
    left_out: tuple[str, ...] = ()
    """Scenes that AUTO does not look in: there is no memory for them, or they failed to load."""


@dataclass(frozen=True, slots=True)
class SequenceSource:
    """Several photos, or a video, and how they are read."""

    data: bytes
    options: SequenceOptions


@dataclass(frozen=True, slots=True)
class RigSource:
    """The photos of a rig, which are one query."""

    photos: tuple[RigPhoto, ...]
    metric: bool


@dataclass(frozen=True, slots=True)
class LocalizeTask:
    """One attempt to localize a photo, a sequence or a rig."""

    id: str
    """Names the attempt to `cancel`."""
    held: str
    """The token of the scenes to look in."""
    estimator: str
    options: Mapping[str, Any]
    """For the estimator's `Options`."""
    seed: int
    budget_s: float | None
    source: Query | SequenceSource | RigSource
    decode: StageTiming
    """What reading the photo took: a part of the result."""
    accuracy: Accuracy = DEFAULT_ACCURACY


@dataclass(frozen=True, slots=True)
class EngineAnswer:
    """What `localize` found."""

    result: JobResult
    scene: str | None
    """The scene that the photo shows, by the name under which it is served; None if it was removed meanwhile."""


OnRecord = Callable[[JobRecord, Query | None], None]
"""Takes a record; of a sequence with the photo that the result would show if it ended here, if that is another now."""

NextFrame = Callable[[], LiveFrame | None]
"""Waits for the frame to use next and returns it; None: the session has ended."""
OnAnswer = Callable[[LiveAnswer], None]
"""Takes the answer to the frame that was asked for last."""


@runtime_checkable
class Engine(Protocol):
    """Scenes in memory and all that works on them. Safe to call from several threads.

    Methods raise errors of `service.errors`, and EngineLost where that is said.
    """

    def start(self) -> None:
        """Begin to load the scenes that are required."""
        ...

    def close(self) -> None:
        """Stop loading and give the scenes' memory back."""
        ...

    def add(self, scene: StoredScene, *, required: bool = False) -> None:
        """Make a scene known without loading it; the engine isn't ready before those that are required are."""
        ...

    def remove(self, scene_id: str) -> None:
        """Forget a scene. Raises SceneNotFound, SceneInUse."""
        ...

    def scenes(self) -> list[SceneStatus]:
        """Return all scenes, how far they have come, and what they take of memory."""
        ...

    def scene(self, scene_id: str | None) -> SceneStatus:
        """Return a scene; None: the only one. Raises SceneNotFound."""
        ...

    def contents(self, scene_id: str) -> SceneContents | None:
        """Summarize a scene; None while it isn't in memory. Raises SceneNotFound."""
        ...

    def require(self, scene_id: str) -> SceneInfo:
        """Return what is known of a scene in memory. Raises SceneError, and has it loaded if it may be."""
        ...

    def readiness(self) -> SceneReadiness:
        """Return whether the scenes that are required are loaded and prepared."""
        ...

    def load(self, scene_id: str) -> SceneStatus:
        """Begin to load and prepare a scene; `scene` says how far that has come. Raises SceneNotFound."""
        ...

    def unload(self, scene_id: str) -> SceneStatus:
        """Drop a scene from memory as soon as no job uses it. Raises SceneNotFound, BadInput."""
        ...

    def hold(self, asked: str | Sequence[str] | None) -> HeldScenes:
        """Keep scenes in memory: one, the only one (None), several, or all that there is memory for (AUTO).

        Raises SceneError; SceneNotReady where one isn't in memory (yet), which has it loaded.
        """
        ...

    def hold_later(
        self, asked: str | Sequence[str] | None, take: Callable[[HeldScenes | SplatfixError], object]
    ) -> None:
        """Call `take` once: with the scenes, held, as soon as all are in memory, or with why they won't be."""
        ...

    def release(self, token: str) -> None:
        """Let go of scenes that were held; without effect on a token that isn't known (any more).

        On other machines that takes effect a moment later.
        """
        ...

    def localize(self, task: LocalizeTask, on_record: OnRecord) -> EngineAnswer:
        """Localize; return when the answer is verified.

        Raises `service.localize.Cancelled` between two records after `cancel`, EngineLost, what `on_record` raises
        (the attempt ends then), and what the estimator raises.
        """
        ...

    def cancel(self, task_id: str) -> None:
        """End an attempt at its next record; without effect if it doesn't run."""
        ...

    def live(self, task: LiveTask, next_frame: NextFrame, on_answer: OnAnswer) -> None:
        """Follow a camera: ask for a frame, answer it, and so on; return once there is none any more.

        Both callbacks are called by turns, on the calling thread. Raises SceneNotReady for a token that isn't known,
        InvalidImage, InvalidIntrinsics for a frame that can't be used, InvalidAccuracy, EngineLost, and what the
        callbacks raise; the session is over then.
        """
        ...

    def render(self, scene_id: str, picture: PictureSpec) -> bytes:
        """Render a scene to a file. Raises SceneError, InvalidIntrinsics."""
        ...

    def thumbnail(self, scene_id: str) -> bytes:
        """Return a small JPEG of a scene. Raises SceneError."""
        ...

    def splats(self, scene_id: str, limit: int) -> bytes:
        """Return a scene's most important Gaussians in the form of `splat_sample`. Raises SceneError."""
        ...

    def coverage(self, scene_id: str) -> CoverageStatus:
        """Return a scene's coverage map, or how far it is measured. Raises SceneNotFound."""
        ...

    def measure_coverage(self, scene_id: str) -> CoverageStatus:
        """Begin to measure a scene's coverage map, unless that is under way. Raises SceneError."""
        ...

    def cancel_coverage(self, scene_id: str) -> CoverageStatus:
        """End the measurement of a scene's coverage map, if there is one. Raises SceneNotFound."""
        ...
