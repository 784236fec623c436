"""The device's odometry and the scene: `world_from_odom`, and where a frame is that has no pose of its own.

    frame's odometry -> reset? -> carry the estimate to it -> the frame's fix, if it has one -> fit the window
    -> move what is reported towards the estimate, by a small step a frame

`odometry_fit` has the equations. The window holds one fix for each viewpoint, the newest there. The odometry began anew
where it moves faster than anybody carries a camera or was silent for seconds, where it contradicts two fixes in a row,
or where all fixes of a second contradict those before: the fixes before are forgotten, the scale is kept.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float64

from service.geometry import hat, moved, se3_exp, se3_log
from service.live.live_values import FusedOdometry, OdometryFacts
from service.live.odometry_fit import FIT, FitConfig, Fix, OdometryFit, Priors, differences, drift, fit_odometry, scaled
from service.live.odometry_scale import ScaleMemory
from service.registration.gathering import SCENE_UP_SIGMA
from service.types import Pose, SceneInfo, frozen


@dataclass(frozen=True, slots=True)
class FusionConfig:
    """Lengths in the odometry's units, metres for devices, unless they say otherwise."""

    fit: FitConfig = FIT
    fixes: int = 20
    """Most that are fitted."""
    way: float = 10.0
    """Older fixes are forgotten: odometry drifts."""
    cell_turn_deg: float = 4.0
    cell_way: float = 0.04
    """Fixes nearer than this count as one viewpoint; the second as a share of the distance to what is seen."""
    fit_every_s: float = 0.15
    """Time between two fits while the viewpoint stays."""
    step: float = 0.01
    step_deg: float = 0.2
    """By how much the reported pose of the camera moves at most a frame beside the odometry."""
    most_speed: float = 6.0
    most_turn_deg_s: float = 700.0
    """Beyond which an odometry didn't move but began anew,"""
    most_gap_s: float = 3.0
    """After a longer time without odometry nobody knows what it did meanwhile: devices stop it when they are locked."""
    least_jump: float = 0.3
    least_jump_deg: float = 25.0
    """if it also moved by more than this: times are uneven."""
    break_sigmas: float = 6.0
    """By so many standard deviations odometry and two fixes in a row differ only if it began anew,"""
    break_jump: float = 0.02
    break_jump_deg: float = 1.0
    """and by more than this."""
    against_s: float = 1.0
    """If all fixes for so long contradict the older ones, the older ones are wrong."""
    metric_sigma: float = 0.03
    """Of the logarithm of the scale of a scene in metres: of the registration, and of the device."""
    usual_depth: float = 2.5
    unknown_sigma: float = 0.7
    """Without any knowledge of the scale: what is seen is usually that far away, with this deviation of the
    logarithm."""
    unsure: float = 0.2
    """Standard deviation of the scale's logarithm from which on odometry doesn't predict a way."""
    stale_s: float = 3.0
    """A fix from the same viewpoint replaces one that is older."""
    kept_s: float = 6.0
    """For so long the odometry of frames is remembered: searches answer later."""
    most_turn_deg: float = 4.0
    most_share: float = 0.04
    """Standard deviations of a carried pose, the second as a share of the distance to what is seen, beyond which it
    isn't reported."""


FUSION = FusionConfig()


@dataclass(frozen=True, slots=True)
class _Sample:
    """The odometry at one frame."""

    time_s: float
    pose: Pose
    velocity: Float64[np.ndarray, "6"]
    way: float
    segment: int
    """How often the odometry began anew before."""


@dataclass(frozen=True, slots=True)
class _Reported:
    """What is reported to the client at one sample."""

    sample: _Sample
    pose: Pose
    """Where the similarity puts the odometry's camera: world_from_camera, at the odometry's time."""
    log_scale: float


class Fusion:
    """Fuses one session's odometry. Positions are relative to the scene's origin. For one thread."""

    def __init__(self, facts: OdometryFacts, info: SceneInfo, config: FusionConfig = FUSION) -> None:
        self._facts, self._config = facts, config
        up = info.up_in_world
        self._up_in_world = None if up is None else np.array(up, np.float64) / np.linalg.norm(up)
        self._samples: deque[_Sample] = deque()
        self._fixes: list[Fix] = []
        """One for each viewpoint, oldest first."""
        self._last: deque[Fix] = deque(maxlen=4)
        """The newest ones, whatever their viewpoint."""
        self._metric = info.metres_per_unit if facts.metric else None
        self._scale: ScaleMemory | None = None
        """None before the first fix."""
        self._fit: OdometryFit | None = None
        """At the newest fix that was fitted; None since the odometry began anew."""
        self._fitted: Fix | None = None
        self._against: list[Fix] = []
        """The newest fixes, all of which contradict the estimate."""
        self._reported: _Reported | None = None
        self._up_in_odom: Float64[np.ndarray, "3"] | None = None
        if facts.up_in_odom is not None:
            self._up_in_odom = np.array(facts.up_in_odom) / np.linalg.norm(facts.up_in_odom)
        self.resets = 0

    @property
    def scale(self) -> tuple[float, float] | None:
        """Scene units per unit of the odometry, and the standard deviation of its logarithm; None: nothing is known."""
        if self._scale is not None:
            return float(np.exp(self._scale.log_scale)), self._scale.sigma
        return None if self._metric is None else (1 / self._metric, self._config.metric_sigma)

    # ------------------------------------------------------------------ what comes in

    def move(self, time_s: float, odom_from_camera: Pose, up_in_camera: Sequence[float] | None = None) -> None:
        """Take a frame's odometry; times don't descend."""
        last = self._samples[-1] if self._samples else None
        # A frame of the same time has no velocity to divide by.
        if last is not None and time_s <= last.time_s:
            return
        if up_in_camera is not None:
            up = odom_from_camera.world_from_camera[:3, :3] @ np.array(up_in_camera)
            self._up_in_odom = up / np.linalg.norm(up)
        velocity, way = np.zeros(6), 0.0
        if last is not None:
            dt = time_s - last.time_s
            step = se3_log(last.pose.camera_from_world @ odom_from_camera.world_from_camera)
            turn, shift = float(np.linalg.norm(step[:3])), float(np.linalg.norm(step[3:]))
            if self._is_jump(dt, turn, shift):
                self._begin_anew(time_s)
                way = last.way
            else:
                velocity = step / dt
                if self._fixes and self._fixes[-1].time_s == last.time_s:
                    self._fixes[-1] = replace(self._fixes[-1], velocity_on=velocity)
                # Turning and waiting make it drift, too.
                way = last.way + shift + 0.2 * turn + 0.01 * dt
        self._samples.append(_Sample(time_s, odom_from_camera, velocity, way, self.resets))
        while self._samples[0].time_s < time_s - self._config.kept_s:
            self._samples.popleft()
        self._update_reported()

    def fix(
        self, time_s: float, pose: Pose, covariance: Float64[np.ndarray, "6 6"], depth: float, run: int = 0
    ) -> None:
        """Take the pose of the frame of that time, which may be one of the past, newer than the last fix.

        Fixes of one run were followed from frame to frame. `depth` is the distance to what is seen, scene units.
        """
        sample = next((s for s in reversed(self._samples) if s.time_s == time_s), None)
        # An answer to a frame from before the odometry began anew relates to none of the samples since.
        if sample is None or sample.segment != self.resets:
            return
        fix = Fix(time_s, pose, covariance, sample.pose, sample.velocity, sample.velocity, sample.way, depth, run)
        if self._scale is None:
            self._scale = (
                ScaleMemory(float(np.log(depth / self._config.usual_depth)), self._config.unknown_sigma)
                if self._metric is None
                else ScaleMemory(-float(np.log(self._metric)), self._config.metric_sigma)
            )
        self._last.append(fix)
        if self._has_broken():
            since = self._last[-2]
            self._begin_anew(since.time_s)
            self._fixes = [since]
            self._last.extend((since, fix))
        if self._keep(fix) or self._fitted is None or time_s - self._fitted.time_s >= self._config.fit_every_s:
            self._refit(fix)

    # ------------------------------------------------------------------ what comes out

    def predicted(self, since_s: float, since: Pose, time_s: float, otherwise: Pose) -> Pose:
        """Return the camera at a sample's time, given where it was at another's; `otherwise` without odometry between.

        While the scale is uncertain only the turn is the odometry's.
        """
        found = {s.time_s: s for s in self._samples if s.time_s in (since_s, time_s)}
        before, now = found.get(since_s), found.get(time_s)
        if before is None or now is None or before.segment != now.segment or self._scale is None:
            return otherwise
        step = before.pose.camera_from_world @ now.pose.world_from_camera
        pose = since.world_from_camera @ scaled(step, float(np.exp(self._scale.log_scale)))
        if self._scale.sigma > self._config.unsure:
            pose[:3, 3] = otherwise.position_in_world
        return moved(Pose(pose), np.zeros(6))

    def carried(self) -> tuple[Pose, Float64[np.ndarray, "6 6"]] | None:
        """Return the newest sample's camera in the world, and its covariance; None where that isn't known."""
        estimate = self._carried(late=False)
        if estimate is None or self._fitted is None:
            return None
        pose, covariance = estimate
        turn, shift = np.sqrt(np.trace(covariance[:3, :3]) / 3), np.sqrt(np.trace(covariance[3:6, 3:6]) / 3)
        if turn > np.radians(self._config.most_turn_deg) or shift > self._config.most_share * self._fitted.depth:
            return None
        return pose, covariance[:6, :6]

    def reported(self) -> FusedOdometry | None:
        """Return the similarity for the newest sample as it is reported; what it lacks to the estimate is part of its
        covariance."""
        estimate, reported = self._carried(late=True), self._reported
        if estimate is None or reported is None or self._fit is None:
            return None
        left = se3_log(reported.pose.camera_from_world @ estimate[0].world_from_camera)
        left = np.append(left, self._fit.log_scale - reported.log_scale)
        # True = reported moved by what is left, and by the error of the estimate.
        covariance = estimate[1] + np.outer(left, left)
        scale = float(np.exp(reported.log_scale))
        world_from_odom = similarity(reported.pose, reported.sample.pose, scale)
        return FusedOdometry(world_from_odom, scale, frozen(covariance), self._fit.offset_s, self.resets)

    # ------------------------------------------------------------------ the parts

    def _is_jump(self, dt: float, turn: float, shift: float) -> bool:
        config = self._config
        if dt > config.most_gap_s:
            return True
        turned = np.degrees(turn)
        # Capture times of phones jitter by some milliseconds.
        dt = max(dt, 1 / 60)
        return (shift > config.least_jump and shift / dt > config.most_speed) or (
            turned > config.least_jump_deg and turned / dt > config.most_turn_deg_s
        )

    def _has_broken(self) -> bool:
        """Return whether of four fixes in a row the odometry contradicts the second step alone: both before and after
        it agrees, so no fix is wrong."""
        if len(self._last) < 4 or len({fix.run for fix in self._last}) > 1:
            return False
        if self._last[-1].time_s - self._last[0].time_s > self._config.against_s:
            return False
        return [self._breaks(a, b) for a, b in pairwise(self._last)] == [False, True, False]

    def _breaks(self, before: Fix, fix: Fix) -> bool:
        """Return whether the odometry contradicts what two fixes say of the way between them."""
        if self._scale is None:
            return False
        scale, sigma = float(np.exp(self._scale.log_scale)), self._scale.sigma
        step = before.odom_from_camera.camera_from_world @ fix.odom_from_camera.world_from_camera
        predicted = before.pose.world_from_camera @ scaled(step, scale)
        gap = differences(predicted, fix.pose.world_from_camera)
        turned, shifted = float(np.linalg.norm(gap[:3])), float(np.linalg.norm(gap[3:]))
        spread = before.covariance + fix.covariance + drift(abs(fix.way - before.way), scale, self._config.fit)
        # An unknown time offset counts as well.
        late = self._config.fit.offset_sigma_s * (fix.velocity - before.velocity)
        turn_sigma = np.sqrt(np.trace(spread[:3, :3]) + late[:3] @ late[:3])
        shift_sigma = np.sqrt(
            np.trace(spread[3:, 3:])
            + scale**2 * (late[3:] @ late[3:])
            + (sigma * scale * np.linalg.norm(step[:3, 3])) ** 2
        )
        config = self._config
        return bool(
            turned > max(np.radians(config.break_jump_deg), config.break_sigmas * turn_sigma)
            or shifted > max(config.break_jump * scale, config.break_sigmas * shift_sigma)
        )

    def _begin_anew(self, time_s: float) -> None:
        """Forget where the odometry was before this time; the scale is the device's, and stays."""
        self.resets += 1
        if self._scale is not None:
            self._scale.begin_anew()
        self._samples = deque(replace(s, segment=self.resets) if s.time_s >= time_s else s for s in self._samples)
        self._fixes, self._against = [], []
        self._last.clear()
        self._fit = self._fitted = self._reported = None

    def _keep(self, fix: Fix) -> bool:
        """Take a fix into the window; return whether it is the first from its viewpoint."""
        config = self._config
        # The last one stays only where it is the first from its viewpoint, or the older one there is out of date.
        if len(self._fixes) > 1 and self._is_near(self._fixes[-1], self._fixes[:-1]):
            del self._fixes[-1]
        kept = [one for one in self._fixes if fix.way - one.way < config.way]
        new = not self._is_near(fix, kept)
        kept = [one for one in kept if fix.time_s - one.time_s < config.stale_s or not self._is_near(fix, [one])]
        self._fixes = [*kept[-config.fixes + 1 :], fix]
        return new

    def _is_near(self, fix: Fix, others: Sequence[Fix]) -> bool:
        """Return whether a fix is from the viewpoint of another one."""
        for other in others:
            way = float(np.linalg.norm(fix.pose.position_in_world - other.pose.position_in_world))
            cosine = (np.sum(fix.pose.world_from_camera[:3, :3] * other.pose.world_from_camera[:3, :3]) - 1) / 2
            if way < self._config.cell_way * fix.depth and cosine > np.cos(np.radians(self._config.cell_turn_deg)):
                return True
        return False

    def _refit(self, fix: Fix) -> None:
        if self._scale is None:
            return
        fit = fit_odometry(self._fixes, self._priors(self._scale), self._config.fit)
        # Both forget what contradicts the newest fixes, which the fit was still drawn to.
        if self._turned_against(fit, fix):
            fit = fit_odometry(self._fixes, self._priors(self._scale), self._config.fit)
        if not self._scale.learn(fit.log_scale, float(np.sqrt(fit.covariance[6, 6]))):
            fit = fit_odometry(self._fixes, self._priors(self._scale), self._config.fit)
        self._fit, self._fitted = fit, self._fixes[-1]
        self._update_reported()

    def _priors(self, scale: ScaleMemory) -> Priors:
        up_sigma = float(np.hypot(np.radians(self._facts.up_sigma_deg), SCENE_UP_SIGMA))
        return Priors(*scale.prior(), self._up_in_world, self._up_in_odom, up_sigma)

    def _turned_against(self, fit: OdometryFit, fix: Fix) -> bool:
        """Return whether all fixes since a while contradict the others, which are then left out."""
        if self._fixes[-1] is not fix or fit.agree[-1]:
            self._against = []
            return False
        self._against.append(fix)
        since = self._against[0].time_s
        if fix.time_s - since < self._config.against_s:
            return False
        kept = [one for one in self._fixes if one.time_s >= since]
        self._begin_anew(since)
        self._fixes = kept
        return True

    def _carried(self, *, late: bool) -> tuple[Pose, Float64[np.ndarray, "7 7"]] | None:
        """Return the newest sample's camera in the world, at the frame's time or, `late`, at the odometry's, and the
        covariance of that and of the scale's logarithm."""
        if self._fit is None or self._fitted is None or not self._samples:
            return None
        sample, fit, scale = self._samples[-1], self._fit, float(np.exp(self._fit.log_scale))
        units = np.array([1.0] * 3 + [scale] * 3)
        start, now = units * self._fitted.velocity, units * sample.velocity
        offset = fit.offset_s
        between = scaled(self._fitted.odom_from_camera.camera_from_world @ sample.pose.world_from_camera, scale)
        step = se3_exp(offset * start) @ between @ (np.eye(4) if late else se3_exp(-offset * now))
        pose = moved(Pose(fit.pose.world_from_camera @ step), np.zeros(6))
        back = np.linalg.inv(step)
        change = np.zeros((7, 8))
        change[:3, :3] = change[3:6, 3:6] = back[:3, :3]
        change[6, 6] = 1.0
        # What a turn at the start, the scale and the delay change at the step's end.
        change[3:6, :3] = -back[:3, :3] @ hat(step[:3, 3])
        change[3:6, 6] = back[:3, :3] @ step[:3, 3]
        change[:6, 7] = change[:6, :6] @ start - (0.0 if late else now)
        covariance = change @ fit.covariance @ change.T
        covariance[:6, :6] += drift(max(0.0, sample.way - self._fitted.way), scale, self._config.fit)
        return pose, covariance

    def _update_reported(self) -> None:
        """Carry the reported pose to the newest sample, and a step towards the estimate."""
        estimate = self._carried(late=True)
        if estimate is None or self._fit is None:
            self._reported = None
            return
        aim, sample, before, config = estimate[0], self._samples[-1], self._reported, self._config
        if before is None or not self._facts.smooth:
            self._reported = _Reported(sample, aim, self._fit.log_scale)
            return
        if sample is before.sample:
            return
        scale = float(np.exp(before.log_scale))
        step = before.sample.pose.camera_from_world @ sample.pose.world_from_camera
        carried = moved(Pose(before.pose.world_from_camera @ scaled(step, scale)), np.zeros(6))
        left = se3_log(carried.camera_from_world @ aim.world_from_camera)
        share = min(
            1.0,
            np.radians(config.step_deg) / max(float(np.linalg.norm(left[:3])), 1e-12),
            scale * config.step / max(float(np.linalg.norm(left[3:])), 1e-12),
        )
        log_scale = before.log_scale + share * (self._fit.log_scale - before.log_scale)
        self._reported = _Reported(sample, moved(carried, share * left), log_scale)


def similarity(world_from_camera: Pose, odom_from_camera: Pose, scale: float) -> Float64[np.ndarray, "4 4"]:
    """Return the similarity world_from_odom under which a camera is here in the world, and there in the odometry."""
    result = np.eye(4)
    rotation = world_from_camera.world_from_camera[:3, :3] @ odom_from_camera.world_from_camera[:3, :3].T
    result[:3, :3] = scale * rotation
    result[:3, 3] = world_from_camera.position_in_world - scale * rotation @ odom_from_camera.position_in_world
    return result
