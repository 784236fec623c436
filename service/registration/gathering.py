"""Evidence from localized photos, picked points, and what is known of the scene and the target frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from service.errors import InvalidRequest
from service.registration.known_places.known_place import KnownPlace, KnownPlaces, in_metres, observation_of
from service.registration.known_places.scene_points import ScenePoints, floor_evidence
from service.registration.observations import Direction, Evidence, Height, Observation
from service.registration.registration import Origin
from service.types import Pose, SceneInfo

SCENE_UP_SIGMA = float(np.radians(2.0))
"""rad: of the up axis that a scene's files state."""
_Z = (0.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class LocalizedPhoto:
    """A photo whose place is known, and where it was found in the scene."""

    name: str
    place: KnownPlace
    pose: Pose
    """Of the upright photo."""
    covariance: Float64[np.ndarray, "6 6"] | None
    orientation: int = 1
    """EXIF's, by which the photo was turned upright."""


@dataclass(frozen=True, slots=True)
class GatherOptions:
    """What the user states beside the places."""

    up: tuple[float, float, float] | None = None
    """What is up in the target frame; None: what the file's kind implies."""
    metres_per_unit: float | None = None
    drift: float | None = None
    """As `Evidence.drift`; None: what the file's kind implies."""


def gathered(
    known: KnownPlaces,
    photos: Sequence[LocalizedPhoto],
    points: ScenePoints | None,
    info: SceneInfo,
    above_in_world: Float64[np.ndarray, "3"],
    options: GatherOptions,
) -> tuple[Evidence, Origin | None]:
    """Return the evidence, and the origin of its frame if that is East-North-Up.

    `known` describes the file that the photos' places are from; `above_in_world` is any point above the floor, such as
    the mean of the cameras. Raises InvalidRequest.
    """
    given = tuple(photo.place for photo in photos)
    everything, origin = in_metres(_together(replace(known, places=given), points))
    observations = [
        observation_of(place, p.name, p.pose, p.covariance, p.orientation)
        for place, p in zip(everything.places, photos, strict=False)
    ]
    if points:
        rest = zip(everything.places[len(photos) :], points.in_world, strict=True)
        observations += [_of_point(place, at) for place, at in rest]
    up = options.up or everything.up
    directions: list[Direction] = []
    heights: list[Height] = []
    # The frame is made here where nothing else says what its axes are.
    if points and len(points.floor):
        up = up or _Z
        floor, heights = floor_evidence(points.floor, above_in_world, up)
        directions.append(floor)
    elif not observations:
        up = up or _Z
    if up is not None and info.up_in_world is not None:
        directions.append(Direction(np.array(info.up_in_world), np.array(up), SCENE_UP_SIGMA))
    evidence = Evidence(
        observations=observations,
        directions=directions,
        lengths=points.lengths if points else (),
        # A floor's height says nothing where coordinates have an origin of their own.
        heights=heights if not observations else (),
        up=up,
        metres_per_unit=options.metres_per_unit,
        # A drift is of places in order of time, which picked points aren't.
        drift=(known.drift if options.drift is None else options.drift) if not points else 0.0,
        may_be_turned=known.may_be_turned,
    )
    return evidence, origin


def _together(known: KnownPlaces, points: ScenePoints | None) -> KnownPlaces:
    if points is None or not points.known.places:
        return known
    kinds = {k.is_geographic for k in (known, points.known) if any(p.position is not None for p in k.places)}
    if len(kinds) > 1:
        raise InvalidRequest("photos and points must both be on Earth, or both in one frame in metres.", where="points")
    return replace(known, places=(*known.places, *points.known.places), is_geographic=kinds == {True})


def _of_point(place: KnownPlace, in_world: Float64[np.ndarray, "3"]) -> Observation:
    return Observation(place.name, in_world, place.position, place.covariance)
