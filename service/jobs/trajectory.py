"""The answer to several photos, or a video: a frame for each, and one result for the whole."""

from __future__ import annotations

from dataclasses import replace

from service.jobs.model import JobRecord, JobResult, SequenceFrame
from service.localize import Clock
from service.results import PoseEstimate, StageTiming, Status
from service.tracking import SequencePose
from service.types import GeoAnchor
from service.versions import versions


class Trajectory:
    """Collects the poses of a sequence's photos."""

    def __init__(self) -> None:
        self._clock = Clock()
        self._frames: list[SequenceFrame] = []
        self._spent: dict[str, StageTiming] = {}
        self._warnings: dict[str, None] = {}
        self._renders = 0
        self._exhausted = False
        self.shown: PoseEstimate | None = None
        """The last that was localized; before there is one, the last."""

    def add(self, found: SequencePose) -> JobRecord:
        """Take a photo's answer; return its record, whose pose is the last that was localized."""
        estimate = found.estimate
        last = estimate.records[-1]
        # A later frame that is not localized does not replace one that is.
        if not _localized(self.shown) or _localized(estimate):
            self.shown = estimate
        assert self.shown
        shown = self.shown.records[-1]
        frame = _frame(len(self._frames), found)
        self._frames.append(frame)
        for timing in estimate.timings:
            before = self._spent.get(timing.stage, StageTiming(timing.stage, 0.0, 0.0))
            wall_s, cpu_s = before.wall_s + timing.wall_s, before.cpu_s + timing.cpu_s
            self._spent[timing.stage] = StageTiming(timing.stage, wall_s, cpu_s)
        self._warnings |= dict.fromkeys(estimate.warnings)
        self._renders += estimate.renders
        self._exhausted |= found.exhausted
        step = replace(
            last,
            stage="track" if frame.tracked else "localize",
            pose=shown.pose,
            correction=shown.correction,
            lens=shown.lens,
            index=frame.index,
            elapsed_s=self._clock.wall_s,
            cpu_s=self._clock.cpu_s,
        )
        return JobRecord(step, frame)

    def result(self, anchor: GeoAnchor | None) -> JobResult:
        """Return the shown photo's result with all frames, and the time that all took.

        Needs one photo. Time that no stage took is the reading of the photos.
        """
        assert self.shown
        spent = self._spent.values()
        wall_s = self._clock.wall_s - sum(timing.wall_s for timing in spent)
        cpu_s = self._clock.cpu_s - sum(timing.cpu_s for timing in spent)
        # Warnings are for people: a single pose does not show how many others are missing.
        missed = sum(frame.status is not Status.LOCALIZED for frame in self._frames)
        warnings = [
            *self._warnings,
            *([f"{missed} of {len(self._frames)} photos were not localized."] if missed else []),
        ]
        if self._exhausted:
            warnings.append(f"The budget ended after {len(self._frames)} photos.")
        estimate = replace(
            self.shown,
            timings=tuple(spent),
            warnings=tuple(warnings),
            budget_exhausted=self._exhausted,
            renders=self._renders,
        )
        decode = StageTiming("decode", wall_s, cpu_s)
        return JobResult(estimate, decode, anchor, versions(), tuple(self._frames))


def _localized(estimate: PoseEstimate | None) -> bool:
    return estimate is not None and estimate.verdict.status is Status.LOCALIZED


def _frame(index: int, found: SequencePose) -> SequenceFrame:
    estimate, verdict = found.estimate, found.estimate.verdict
    return SequenceFrame(
        index=index,
        name=found.photo.name,
        time_s=found.photo.time_s,
        status=verdict.status,
        reason=verdict.reason,
        score=verdict.score,
        tracked=estimate.records[-1].stage == "track",
        pose=estimate.pose,
        covariance=verdict.covariance,
        right_place=verdict.right_place,
        precise=verdict.precise,
    )
