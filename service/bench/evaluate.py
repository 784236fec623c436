"""Anybody's poses of photos against anybody's truth: medians, and recall within the bounds of the benchmarks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from service.bench.pose_files import PhotoPose, read_names, read_pose_file
from service.bench.pose_metrics import COARSE, FINE
from service.errors import InvalidRequest
from service.geometry import pose_distance
from service.types import Pose

BOUNDS = ((0.01, 1.0), (0.02, 2.0), (0.03, 3.0), (0.05, 5.0), (0.25, 2.0), (0.5, 5.0), (5.0, 10.0))
"""Metres and degrees: those that hloc prints, among them 5 cm / 5 deg of 7-Scenes and 25 cm / 2 deg of Aachen."""
LISTS = ("list_test.txt", "list_query.txt")
"""Names of the test photos beside a model, as hloc ships 7-Scenes and Cambridge."""
MAX_TIME_DIFFERENCE_S = 0.02
"""Between the entries of two trajectories that are one photo (as TUM's tools)."""


@dataclass(frozen=True, slots=True)
class PhotoError:
    """One photo's errors; infinite translation and 180 degrees where there is no answer, as hloc counts."""

    name: str
    translation: float
    """In the truth's unit."""
    rotation_deg: float
    answered: bool


def evaluated(
    poses: Path,
    truth: Path,
    names: Path | None = None,
    *,
    metres_per_unit: float = 1.0,
    units_per_unit: float | None = None,
) -> dict[str, Any]:
    """Return medians, recalls and each photo's errors.

    `names`: a list of the photos that count; default: the list beside the truth, if one is there, else all of its
    photos. `metres_per_unit`: of the truth. `units_per_unit`: normalized units of a scene in one unit of the truth;
    with it our own bounds are told, too. Raises InvalidRequest, CorruptScene.
    """
    answers, known = read_pose_file(poses), read_pose_file(truth)
    chosen = names or next((truth / name for name in LISTS if truth.is_dir() and (truth / name).is_file()), None)
    errors = photo_errors(answers, known, read_names(chosen) if chosen else None)
    return {
        "poses": poses.name,
        "truth": truth.name,
        "photos_of": chosen.name if chosen else truth.name,
        "metres_per_unit": metres_per_unit,
        **summary(errors, metres_per_unit, units_per_unit),
        "per_photo": [
            {
                "photo": e.name,
                "answered": e.answered,
                "translation_m": e.translation * metres_per_unit if e.answered else None,
                "rotation_deg": e.rotation_deg if e.answered else None,
            }
            for e in errors
        ],
    }


def summary(errors: Sequence[PhotoError], metres_per_unit: float, units_per_unit: float | None) -> dict[str, Any]:
    """Return the figures over all photos. A photo counts as within bounds if both errors are smaller."""
    translations, rotations = np.array([[e.translation, e.rotation_deg] for e in errors]).T
    metres = metres_per_unit * translations
    bounds = [("m", bound, degrees, metres) for bound, degrees in BOUNDS]
    if units_per_unit is not None:
        bounds += [("units", bound, degrees, units_per_unit * translations) for degrees, bound in (FINE, COARSE)]
    within = [np.mean((values < bound) & (rotations < degrees)) for _, bound, degrees, values in bounds]
    recall = [
        {unit: bound, "deg": degrees, "share": float(share)}
        for (unit, bound, degrees, _), share in zip(bounds, within, strict=True)
    ]
    median = float(np.median(metres))
    return {
        "photos": len(errors),
        "answered": sum(e.answered for e in errors),
        # JSON has no infinity: None where more than half have no answer.
        "median_translation_m": median if np.isfinite(median) else None,
        "median_rotation_deg": float(np.median(rotations)),
        "recall": recall,
    }


def photo_errors(
    answers: Sequence[PhotoPose], known: Sequence[PhotoPose], names: Sequence[str] | None = None
) -> list[PhotoError]:
    """Return the errors of the photos in the truth: of those in `names`, if given. Raises InvalidRequest."""
    if (answers[0].time_s is None) != (known[0].time_s is None):
        raise InvalidRequest(
            "one of the files has names and the other one times.",
            where="--truth",
            hint="Give both as trajectories, or both with the photos' names.",
        )
    if answers[0].time_s is not None:
        return _of_times(answers, known)
    truths = _Names([one.name for one in known])
    wanted = range(len(known)) if names is None else [_in_truth(truths, name) for name in names]
    found: dict[int, Pose] = {}
    for answer in answers:
        index = truths.find(answer.name)
        if index is None:
            continue  # a photo of another part of the data set
        if index in found:
            raise InvalidRequest(f"'{known[index].name}' has two poses.", where="--poses")
        found[index] = answer.pose
    if not found.keys() & set(wanted):
        raise InvalidRequest(
            f"no photo of the truth has a pose; names are like '{answers[0].name}' and like '{known[0].name}'.",
            where="--poses",
        )
    return [_error(known[i], known[i].name, found.get(i)) for i in wanted]


def _in_truth(truths: _Names, name: str) -> int:
    index = truths.find(name)
    if index is None:
        raise InvalidRequest(f"the truth has no photo '{name}'.", where="--names")
    return index


def _of_times(answers: Sequence[PhotoPose], known: Sequence[PhotoPose]) -> list[PhotoError]:
    """Return the errors of a trajectory at the times of another one."""
    times = np.array([answer.time_s for answer in answers], np.float64)
    errors = []
    for one in known:
        assert one.time_s is not None
        i = int(np.argmin(np.abs(times - one.time_s)))
        near = abs(times[i] - one.time_s) <= MAX_TIME_DIFFERENCE_S
        errors.append(_error(one, f"{one.time_s:.6f}", answers[i].pose if near else None))
    if not any(e.answered for e in errors):
        raise InvalidRequest(
            f"no two times are within {MAX_TIME_DIFFERENCE_S} s; the files begin at {answers[0].time_s:.3f} and "
            f"{known[0].time_s:.3f} s.",
            where="--poses",
        )
    return errors


def _error(known: PhotoPose, name: str, answer: Pose | None) -> PhotoError:
    if answer is None:
        return PhotoError(name, np.inf, 180.0, answered=False)
    degrees, distance = pose_distance(answer, known.pose)
    return PhotoError(name, distance, degrees, answered=True)


class _Names:
    """Names of photos, found by a name with fewer or more folders, or without its suffix, if only one fits."""

    def __init__(self, names: Sequence[str]) -> None:
        self._by_key: dict[str, list[int]] = {}
        for index, name in enumerate(names):
            for key in dict.fromkeys(self._keys(name)):
                self._by_key.setdefault(key, []).append(index)
        self._exact = {self._plain(name): index for index, name in enumerate(names)}
        self._names = names

    def find(self, name: str) -> int | None:
        """Return the number of the one photo that a name means. Raises InvalidRequest if it may be several."""
        if (exact := self._exact.get(self._plain(name))) is not None:
            return exact
        for key in self._keys(name):
            found = self._by_key.get(key, [])
            if len(found) > 1:
                raise InvalidRequest(
                    f"'{name}' may be '{self._names[found[0]]}' and '{self._names[found[1]]}'.",
                    where="--poses",
                    hint="Give names with the folders that tell them apart.",
                )
            if found:
                return found[0]
        return None

    @staticmethod
    def _plain(name: str) -> str:
        return name.replace("\\", "/").removeprefix("./")

    @classmethod
    def _keys(cls, name: str) -> list[str]:
        """Return the ends of a path, the longest first, each with its suffix and without."""
        parts = PurePosixPath(cls._plain(name)).parts
        ends = ["/".join(parts[i:]) for i in range(len(parts))]
        return [key for end in ends for key in (end, str(PurePosixPath(end).with_suffix("")))]
