"""What a search found of a photo that isn't localized, in a sentence: the numbers are those of its trace."""

from __future__ import annotations

from collections.abc import Sequence

from service.results import IterationRecord, Reason, Status, Verdict


def search_summary(records: Sequence[IterationRecord], verdict: Verdict) -> str:
    """Return how many matches the photo has with the scene, how many agree on a pose, and what came of that pose.

    The numbers are those of the record with the most inliers; of none with inliers, of that with the most matches.
    Empty for a pose that is localized, and where the method matches nothing.
    """
    # A check may match something else than the photo, as its mirror image.
    matched = [r for r in records if r.num_matches is not None and not r.stage.startswith("check_")]
    if verdict.status is Status.LOCALIZED or not matched:
        return ""
    best = max(matched, key=lambda record: (record.num_inliers or 0, record.num_matches or 0))
    if not best.num_matches:
        return "No feature of the photo matches the scene."
    if not best.num_inliers:
        return f"None of {best.num_matches} matches with the scene agree on a camera pose."
    counts = f"At best {best.num_inliers} of {best.num_matches} matches with the scene agree on a camera pose"
    stages = {record.stage for record in records}
    # The default method verifies, while it searches, each pose that enough matches led to.
    if "verify" not in stages and any(stage.startswith("retrieve") for stage in stages):
        return f"{counts}: too few to trust it."
    if verdict.reason in (Reason.NO_MATCHING_VIEW, Reason.RENDER_MISMATCH):
        return f"{counts}, but the scene rendered at the best guess does not look like the photo."
    return f"{counts}."
