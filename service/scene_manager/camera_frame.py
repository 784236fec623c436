"""The frame of a camera file that fits the scene in no known way: a similarity, found by localizing training photos.

Somebody has turned, moved or scaled the scene after training, as editors of splats do. The scene is used without its
cameras meanwhile; some of the photos are localized in it, and the similarity between their poses there and those of the
camera file is a registration: robust, least squares, with residuals. It is stored beside the scene, and counts from the
next reading on if the photos then fit the scene as well as any other frame (`service/scene_formats/camera_fit.py`).
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from service.errors import InvalidImage, RegistrationFailed, SplatfixError, StorageFailed
from service.loaded_scene import LoadedScene
from service.localize import Request, localize
from service.photos.images import photo_size, read_query
from service.registration.observations import Evidence, Observation
from service.registration.register import register
from service.registration.registration import Registration
from service.results import PoseEstimate, Status
from service.scene_formats.frame_candidates import FLIP
from service.scene_formats.manifest import read_manifest
from service.scene_formats.training_files import CAMERA_FRAME, read_training, training_photo_path
from service.types import NamedCamera

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class CameraFrameConfig:
    """How many photos are localized, and what is enough."""

    tried: int = 40
    """Photos at most, evenly spread over the camera file."""
    enough: int = 12
    """Localized photos, after which no more are tried."""
    least: int = 4
    """Localized photos that agree: three determine a similarity."""
    least_share: float = 0.6
    """Of the localized photos, that agree."""
    largest_deg: float = 3.0
    """Median rotation error of those that agree: with the wrong camera axes all positions fit and no rotation does."""


CAMERA_FRAME_CONFIG = CameraFrameConfig()


@dataclass(frozen=True, slots=True)
class FoundFrame:
    """Where a camera file's frame is."""

    file_from_cameras: Float64[np.ndarray, "4 4"]
    """A similarity into the scene file's frame."""
    agreeing: int
    localized: int
    tried: int
    median_error: float
    """Of the positions of those that agree, in units of the camera file."""
    median_deg: float

    def write(self, folder: Path) -> None:
        """Store it beside the scene; readers see all of it or nothing. Raises StorageFailed."""
        facts = {
            "file_from_cameras": self.file_from_cameras.tolist(),
            "photos": {"agreeing": self.agreeing, "localized": self.localized, "tried": self.tried},
            "median_error": {"position": self.median_error, "deg": self.median_deg},
        }
        path = folder / CAMERA_FRAME
        draft = path.with_name(f".{path.name}.{os.getpid()}")
        try:
            draft.write_text(json.dumps(facts, indent=1), "utf-8")
            draft.replace(path)
        except OSError as error:
            draft.unlink(missing_ok=True)
            raise StorageFailed(
                f"{path.name} can't be written beside the scene: {error.strerror}.",
                hint="Make the scene's folder writable, or run `splatfix scenes align` on a copy and add the file.",
            ) from error


def is_sought(loaded: LoadedScene, folder: Path) -> bool:
    """Whether a scene has a camera file, whose cameras were left out, and enough of its photos."""
    if loaded.scene.cameras or not folder.is_dir():
        return False
    least = CAMERA_FRAME_CONFIG.least
    return sum(1 for _, (_, path) in zip(range(least), _photos_of(folder), strict=False) if path) >= least


def found_camera_frame(
    loaded: LoadedScene,
    folder: Path,
    *,
    go_on: Callable[[], bool] = lambda: True,
    progress: Callable[[int, int], None] | None = None,
    config: CameraFrameConfig = CAMERA_FRAME_CONFIG,
) -> FoundFrame | None:
    """Localize training photos and return the similarity that they agree on; None where they don't.

    `loaded` is the scene without cameras; `go_on` is asked before each photo. Raises SceneError.
    """
    with_photos = list(_photos_of(folder))
    chosen = with_photos[:: max(1, -(-len(with_photos) // config.tried))]
    localized: list[tuple[NamedCamera, PoseEstimate]] = []
    tried = 0
    for named, path in chosen:
        if not go_on():
            return None
        tried += 1
        estimate = _localized(named, path, loaded)
        if estimate is not None:
            localized.append((named, estimate))
        if progress:
            progress(tried, len(chosen))
        if len(localized) >= config.enough:
            break
    _log.info("scene %s: %d of %d training photos localized", loaded.scene.info.id, len(localized), tried)
    fits = [fit for axes in (np.eye(4), FLIP) if (fit := _registration(localized, axes, config)) is not None]
    if not fits:
        return None
    best = min(fits, key=_median_deg)
    world_from_scene = read_manifest(folder).world_from_scene
    file_from_world = np.eye(4) if world_from_scene is None else np.linalg.inv(world_from_scene)
    used = [residual for residual in best.residuals if residual.used]
    return FoundFrame(
        file_from_world @ np.linalg.inv(best.target_from_world),
        len(used),
        len(localized),
        tried,
        float(np.median([residual.metres or 0.0 for residual in used])),
        _median_deg(best),
    )


def _photos_of(folder: Path) -> Iterator[tuple[NamedCamera, Path]]:
    for named in read_training(folder, read_manifest(folder)).file.cameras:
        path = training_photo_path(folder, named.name)
        if path is not None:
            yield named, path


def _localized(named: NamedCamera, path: Path, loaded: LoadedScene) -> PoseEstimate | None:
    """Return the estimate of a training photo, None where it isn't localized or no photo of this camera."""
    try:
        data, given = path.read_bytes(), named.camera.intrinsics
        width, height = photo_size(data)
        if abs(width * given.height - height * given.width) > 0.01 * width * given.height:
            return None
        intrinsics = given.resized(width, height)
        query = read_query(data, intrinsics=intrinsics, background_rgb=loaded.scene.info.background_rgb)
        estimate = localize(query, loaded, Request())
    except (InvalidImage, OSError) as error:
        _log.warning("the training photo %s can't be read (%s)", named.name, error)
        return None
    except SplatfixError as error:  # one photo that can't be localized is no reason to give up
        _log.info("the training photo %s isn't localized (%s)", named.name, error)
        return None
    return estimate if estimate.verdict.status is Status.LOCALIZED else None


def _registration(
    localized: Sequence[tuple[NamedCamera, PoseEstimate]], axes: Float64[np.ndarray, "4 4"], config: CameraFrameConfig
) -> Registration | None:
    """Return the registration in the camera file's frame, if enough photos agree on all of it."""
    observations = [
        Observation(
            named.name,
            estimate.pose.position_in_world,
            position=named.camera.pose.position_in_world,
            world_from_camera=estimate.pose.world_from_camera[:3, :3],
            target_from_camera=(named.camera.pose.world_from_camera @ axes)[:3, :3],
            localization_covariance=estimate.verdict.covariance,
        )
        for named, estimate in localized
    ]
    if len(observations) < config.least:
        return None
    try:
        found = register(Evidence(observations), np.random.default_rng(0))
    except RegistrationFailed:
        return None
    agreeing = sum(residual.used for residual in found.residuals)
    enough = agreeing >= max(config.least, config.least_share * len(observations))
    return found if enough and found.is_complete and _median_deg(found) <= config.largest_deg else None


def _median_deg(found: Registration) -> float:
    return float(np.median([residual.degrees or 0.0 for residual in found.residuals if residual.used]))
