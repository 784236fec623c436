"""A trajectory in TUM's format, `time x y z qx qy qz qw` in each line: poses by time, for photos whose time is known.

Rotations are of OpenCV's camera axes. A photo's pose is interpolated between the lines before and after it.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from service.errors import InvalidRequest
from service.geometry import so3_exp, so3_log
from service.registration.known_places.ar_session import ARKIT_DRIFT
from service.registration.known_places.known_place import KnownPlace, KnownPlaces, rotation_of

MAX_GAP_S = 1.0
"""Between two lines: over a longer gap nothing is interpolated."""


def accepts(head: str, name: str) -> bool:
    """Whether a file is a trajectory: its first line that is no comment has eight numbers."""
    lines = (line for line in head.splitlines() if line.strip() and not line.lstrip().startswith("#"))
    words = next(lines, "").replace(",", " ").split()
    try:
        return len(words) == 8 and all(np.isfinite(float(word)) for word in words)
    except ValueError:
        return False


def read(text: str, name: str) -> KnownPlaces:
    """Parse all poses. Raises InvalidRequest with the line."""
    places = []
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        where = f"{name}, line {number}"
        try:
            time, *position, x, y, z, w = (float(word) for word in line.replace(",", " ").split())
        except ValueError:
            raise InvalidRequest("must be eight numbers: time x y z qx qy qz qw.", where=where) from None
        if len(position) != 3 or not np.all(np.isfinite([time, *position])):
            raise InvalidRequest("must be eight numbers: time x y z qx qy qz qw.", where=where)
        if places and time <= places[-1].time_s:
            raise InvalidRequest("times must ascend.", where=where)
        rotation = rotation_of([w, x, y, z], where)
        places.append(KnownPlace("", np.array(position), None, rotation, time_s=time))
    return KnownPlaces("trajectory", tuple(places), drift=ARKIT_DRIFT)


def at_time(known: KnownPlaces, time_s: float, name: str) -> KnownPlace:
    """Return the pose at a time (on the trajectory's clock), interpolated. Raises InvalidRequest where it has a gap."""
    times = np.array([place.time_s for place in known.places], np.float64)
    after = int(np.searchsorted(times, time_s))
    if after < len(times) and times[after] == time_s:
        return _named(known.places[after], name, time_s)
    if after in (0, len(times)) or times[after] - times[after - 1] > MAX_GAP_S:
        raise InvalidRequest(
            f"the trajectory has no pose at {time_s:.3f} s; it has {times[0]:.3f} to {times[-1]:.3f} s.",
            where=name,
            hint="Give the photos' times on the trajectory's clock: --times.",
        )
    before, later = known.places[after - 1], known.places[after]
    share = float((time_s - times[after - 1]) / (times[after] - times[after - 1]))
    position = _known(before.position) * (1 - share) + _known(later.position) * share
    first, second = _known(before.target_from_camera), _known(later.target_from_camera)
    rotation = first @ so3_exp(share * so3_log(first.T @ second))
    return KnownPlace(name, position, None, rotation, time_s=time_s)


def _named(place: KnownPlace, name: str, time_s: float) -> KnownPlace:
    return KnownPlace(name, place.position, None, place.target_from_camera, time_s=time_s)


def _known(value: Float64[np.ndarray, "..."] | None) -> Float64[np.ndarray, "..."]:
    assert value is not None
    return value
