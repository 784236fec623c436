"""Warnings of a result: what the photo shows of its camera, and what the search left out."""

from __future__ import annotations

from collections.abc import Sequence

from service.pose.retrieval.index import ViewIndex
from service.results import IterationRecord, Verdict
from service.types import Query


def cautions(query: Query, verdict: Verdict) -> tuple[str, ...]:
    """Return warnings of what the photo shows of its camera."""
    cautions = []
    if query.intrinsics_source == "fisheye":
        cautions.append(
            "the photo's lens is a fisheye, not what was sent or assumed: its intrinsics were estimated with the pose. "
            "Send them with camera model and distortion for an exact pose."
        )
    if verdict.intrinsics_untested:
        cautions.append(
            "the intrinsics could not be verified by the photo: a focal length that is 1 % off moves the camera by "
            "about 1 % of its distance, which the covariance allows for."
        )
    if verdict.shutter_motion:
        shear, stretch = verdict.shutter_motion
        cautions.append(
            f"the camera turned while the photo was read row by row (rolling shutter: shear {shear:+.3f}, stretch "
            f"{stretch:+.3f}); the pose is that of the middle row. Hold the camera still for a more exact one."
        )
    return tuple(cautions)


def of_unfinished_index(prepared: object, records: Sequence[IterationRecord]) -> tuple[str, ...]:
    """Return a warning where an estimator with this view index, and these records, searched only a part of it."""
    if not isinstance(prepared, ViewIndex) or prepared.whole is None or any(r.stage == "await_index" for r in records):
        return ()
    return (
        f"the scene's view index was still being built: {len(prepared.views)} of {prepared.whole.planned_views} views "
        "were searched; places that look like this one may not have been compared. Localize again when it is whole.",
    )
