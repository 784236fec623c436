"""The trajectory of a sequence without its jitter: a Rauch-Tung-Striebel smoother on SE(3).

The state is the pose and its twist per second; the twist changes by white noise, so that a camera keeps its motion
unless poses say otherwise (Barfoot, State Estimation for Robotics, 2017: the Kalman filter with errors in the tangent
space, and white noise on acceleration). Each pose counts by its own covariance. How strongly the motion changes, and by
which factor the covariances are too small or too large, follows from the poses themselves: the values under which the
filter's predictions are most probable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float64

from service.geometry import adjoint, moved, se3_log
from service.types import Pose, frozen


@dataclass(frozen=True, slots=True)
class SmoothingConfig:
    """What divides a trajectory, and which accelerations are tried."""

    max_gap_s: float = 1.0
    """A longer time without a pose divides the trajectory: nothing is known of the motion in it."""
    noise_steps: int = 13
    noise_range: float = 1e6
    """The accelerations that are tried: this far around what the poses show, in so many logarithmic steps. Ratios of
    variances, hence a factor of 1000 in the acceleration."""


SMOOTHING = SmoothingConfig()


@dataclass(frozen=True, slots=True)
class TimedPose:
    """A photo of a sequence: when it was taken, and where, if it was localized."""

    time_s: float
    pose: Pose | None
    covariance: Float64[np.ndarray, "6 6"] | None = None
    """As a verdict's."""


@dataclass(frozen=True, slots=True)
class SmoothedPose:
    """The pose of one photo given all photos."""

    pose: Pose
    covariance: Float64[np.ndarray, "6 6"]
    interpolated: bool
    """Whether the photo itself was not localized: the pose follows from those before and after."""


@dataclass(frozen=True, slots=True)
class MotionState:
    """A camera's pose and velocity at one time, with their covariance."""

    pose: Pose
    velocity: Float64[np.ndarray, "6"]
    """Twist per second in the camera's frame."""
    covariance: Float64[np.ndarray, "12 12"]
    """Of the errors of both: true pose = pose @ exp(error)."""


@dataclass(frozen=True, slots=True)
class MotionNoise:
    """White noise on the acceleration: how strongly a camera changes its motion."""

    rotation: float
    """Spectral density of the angular acceleration, rad^2/s^3."""
    translation: float
    """The same in units^2/s^3."""

    def over(self, dt: float) -> Float64[np.ndarray, "12 12"]:
        """Return the covariance that it adds to pose and velocity within `dt` seconds."""
        density = np.diag([self.rotation] * 3 + [self.translation] * 3)
        return np.block([[density * dt**3 / 3, density * dt**2 / 2], [density * dt**2 / 2, density * dt]])


def smoothed(photos: Sequence[TimedPose], config: SmoothingConfig = SMOOTHING) -> list[SmoothedPose | None]:
    """Return a smoothed pose for each photo; None outside of what was localized, and in gaps that are too long.

    Times ascend. A photo that was localized without a covariance gets the median of the others'. A trajectory with
    fewer than three poses in a row, which show no jitter, is returned as it is.
    """
    answers: list[SmoothedPose | None] = [None] * len(photos)
    known = [p.covariance for p in photos if p.pose is not None and p.covariance is not None]
    # Of all-unknown covariances only the ratio to the motion matters, which is estimated.
    usual = np.median(known, axis=0) if known else np.eye(6) * 1e-6
    filled = [replace(p, covariance=usual) if p.pose is not None and p.covariance is None else p for p in photos]
    for begin, end in _stretches(filled, config.max_gap_s):
        answers[begin:end] = _smoothed_stretch(filled[begin:end], config)
    return answers


def _stretches(photos: Sequence[TimedPose], max_gap_s: float) -> list[tuple[int, int]]:
    """Return the ranges of photos, each from a localized one to a localized one, without too long a gap."""
    ranges: list[tuple[int, int]] = []
    for i, photo in enumerate(photos):
        if photo.pose is None:
            continue
        if ranges and photo.time_s - photos[ranges[-1][1] - 1].time_s <= max_gap_s:
            ranges[-1] = ranges[-1][0], i + 1
        else:
            ranges.append((i, i + 1))
    return ranges


def _smoothed_stretch(photos: Sequence[TimedPose], config: SmoothingConfig) -> list[SmoothedPose]:
    known = [p for p in photos if p.pose is not None]
    # Two poses have one velocity, so jitter can't be distinguished from motion.
    if len(known) < 3:
        return _joined(photos, known)
    noise, scale = _most_probable_noise(photos, config)
    states = smoothed_states(photos, noise)
    return [
        SmoothedPose(state.pose, frozen(scale * state.covariance[:6, :6], np.float64), photo.pose is None)
        for state, photo in zip(states, photos, strict=True)
    ]


def _joined(photos: Sequence[TimedPose], known: Sequence[TimedPose]) -> list[SmoothedPose]:
    """Return the one or two poses as they are, and those between two on the screw motion from one to the other."""
    first, last = known[0], known[-1]
    assert first.pose is not None
    assert last.pose is not None
    assert first.covariance is not None
    # Two photos may have the same time.
    speed = _step(first.pose, last.pose) / max(last.time_s - first.time_s, 1e-6)
    joined = []
    for photo in photos:
        pose = photo.pose or moved(first.pose, speed * (photo.time_s - first.time_s))
        covariance = first.covariance if photo.covariance is None else photo.covariance
        joined.append(SmoothedPose(pose, frozen(covariance, np.float64), photo.pose is None))
    return joined


def _most_probable_noise(photos: Sequence[TimedPose], config: SmoothingConfig) -> tuple[MotionNoise, float]:
    """Return the noise, relative to the covariances, that makes the poses most probable, and the factor of both."""
    known = [(p.time_s, p.pose) for p in photos if p.pose is not None]
    times = np.array([time_s for time_s, _ in known])
    steps = [_step(a, b) for (_, a), (_, b) in pairwise(known)]
    gaps = np.maximum(np.diff(times), 1e-6)
    # A first guess: the noise that makes the changes of velocity that were seen.
    changes = np.diff(np.array(steps) / gaps[:, None], axis=0)
    shown = np.mean(changes**2, axis=0) / np.mean(gaps) + 1e-18
    noise = MotionNoise(float(shown[:3].mean()), float(shown[3:].mean()))
    factors = config.noise_range ** np.linspace(-1, 1, config.noise_steps)
    # One after the other: rotation and translation hardly depend on one another.
    for name in ("rotation", "translation"):
        tried = [replace(noise, **{name: getattr(noise, name) * factor}) for factor in factors]
        noise = max(tried, key=lambda n: _filtered(photos, n)[2])
    return noise, _filtered(photos, noise)[3]


def smoothed_states(photos: Sequence[TimedPose], noise: MotionNoise) -> list[MotionState]:
    """Return the states of all photos given all poses: the filter forwards, then the smoother's pass back."""
    states, predictions, _, _ = _filtered(photos, noise)
    for i in range(len(states) - 2, -1, -1):
        here, (predicted, transition), later = states[i], predictions[i + 1], states[i + 1]
        # Rauch, Tung and Striebel's gain; solved instead of inverted, as covariances may be nearly singular.
        gain = np.linalg.solve(predicted.covariance, transition @ here.covariance).T
        difference = np.concatenate(
            [
                se3_log(predicted.pose.camera_from_world @ later.pose.world_from_camera),
                later.velocity - predicted.velocity,
            ]
        )
        covariance = here.covariance + gain @ (later.covariance - predicted.covariance) @ gain.T
        states[i] = _corrected(here, gain @ difference, covariance)
    return states


def _filtered(
    photos: Sequence[TimedPose], noise: MotionNoise
) -> tuple[list[MotionState], list[tuple[MotionState, Float64[np.ndarray, "12 12"]]], float, float]:
    """Return the filter's states, its predictions with their transitions, the logarithm of the poses' probability with
    the best factor of all covariances, and that factor."""
    first = photos[0]
    assert first.pose is not None
    assert first.covariance is not None
    span = max(photos[-1].time_s - first.time_s, 1e-6)
    # Wide enough for any motion: a turn and the length of the trajectory in the time between two photos.
    reach = max([1.0, *(float(np.linalg.norm(_step(first.pose, p.pose)[3:])) for p in photos if p.pose is not None)])
    fastest = np.array([np.pi] * 3 + [reach] * 3) * len(photos) / span
    start = np.zeros((12, 12))
    start[:6, :6], start[6:, 6:] = first.covariance, np.diag(fastest**2)
    states = [MotionState(first.pose, np.zeros(6), start)]
    predictions = [(states[0], np.eye(12))]
    fit, volume, count = 0.0, 0.0, 0
    for before, photo in pairwise(photos):
        predicted, transition = _predicted(states[-1], max(photo.time_s - before.time_s, 1e-6), noise)
        predictions.append((predicted, transition))
        if photo.pose is None or photo.covariance is None:
            states.append(predicted)
            continue
        seen = _step(predicted.pose, photo.pose)
        spread = predicted.covariance[:6, :6] + photo.covariance
        gain = np.linalg.solve(spread, predicted.covariance[:6]).T
        covariance = predicted.covariance - gain @ predicted.covariance[:6]
        # Rounding makes the difference of two covariances asymmetric, which adds up over a long sequence.
        states.append(_corrected(predicted, gain @ seen, 0.5 * (covariance + covariance.T)))
        # The first step determines the velocity, whose prior is vague: no evidence of the noise.
        if count or len(states) > 2:
            fit += float(seen @ np.linalg.solve(spread, seen))
            volume += float(np.linalg.slogdet(spread)[1])
            count += 6
    scale = max(fit / max(count, 1), 1e-12)
    return states, predictions, -0.5 * (count * np.log(scale) + volume), scale


def _step(a: Pose, b: Pose) -> Float64[np.ndarray, "6"]:
    return se3_log(a.camera_from_world @ b.world_from_camera)


def _predicted(state: MotionState, dt: float, noise: MotionNoise) -> tuple[MotionState, Float64[np.ndarray, "12 12"]]:
    """Return the state after dt, and the matrix that carries its error there."""
    step = moved(Pose(np.eye(4)), state.velocity * dt)
    transition = np.eye(12)
    transition[:6, :6] = adjoint(step.camera_from_world)
    transition[:6, 6:] = dt * np.eye(6)
    covariance = transition @ state.covariance @ transition.T + noise.over(dt)
    return MotionState(moved(state.pose, state.velocity * dt), state.velocity, covariance), transition


def _corrected(
    state: MotionState, error: Float64[np.ndarray, "12"], covariance: Float64[np.ndarray, "12 12"]
) -> MotionState:
    return MotionState(moved(state.pose, error[:6]), state.velocity + error[6:], covariance)
