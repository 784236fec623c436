"""Where a device's odometry lies in the scene, from fixes: frames whose poses are known in both.

The odometry o and the world w differ by a similarity, x_w = s R x_o + t, which drifts. What is estimated is that
similarity at the present frame n, as the camera's pose T in the world there, the logarithm of the scale, and the time
tau by which the odometry's poses are late. With O_i the odometry's pose at fix i, v_i the velocity of the camera in its
own frame and Z_i the fix, the model predicts

    O_i(tau) = O_i exp(-tau v_i),    P_i = T [O_n(tau)^-1 O_i(tau)]_s,    where [.]_s scales the translation by s,

and the residual is r_i = (R_Zi log(R_Pi^-1 R_Zi), z_i - p_i), in the world's axes. The residuals are correlated, with

    cov(r_i, r_j) = L_i k_ij L_j^T + (q min(a_i, a_j) + g^2 a_i a_j) diag(1, 1, 1, s^2, s^2, s^2)

where L_i L_i^T is the covariance of fix i, k_ij falls from `shared` with the distance and angle of the two viewpoints
(fixes from one place share the errors of the scene there, so more of them don't make the answer surer), and the second
term is the odometry's drift over the way a_i from fix i to now: a random walk, and a steady part. The estimate
minimizes r^T cov^-1 r + priors (generalized least squares by Gauss-Newton: Barfoot, State Estimation for Robotics,
2017, ch. 4; the correlated drift is a random walk that is marginalized; correlated errors as in kriging). Priors are
the scale known from before or from a scene in metres, and gravity, where up is known in both: a direction with its
standard deviation, so that heading, position and scale are left (4 degrees of freedom and the scale); without it all
seven are.

Fixes that contradict the others are left out: each fix alone predicts T, and the one that most others agree with by
their chi-square begins (as in RANSAC, but all are tried); after the fit, those beyond the bound are left out again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from service.geometry import se3_exp
from service.types import Pose


@dataclass(frozen=True, slots=True)
class FitConfig:
    """What is known of odometry and fixes. Ways are in the odometry's units, metres for devices."""

    drift_share: float = 0.01
    """Steady drift of the position, and random one after one unit, as a share of the way: what ARKit and ARCore do."""
    turn_drift: float = 0.002
    """The same of the rotation, rad per unit."""
    shared: float = 0.9
    """Share of a fix's covariance that other fixes from the same place have in common."""
    view_turn: float = 0.17
    """Angle between two cameras, rad, over which that share falls by a factor of 0.6."""
    view_way: float = 0.1
    """Distance between two cameras over which it does, as a share of the distance to what is seen."""
    offset_sigma_s: float = 0.03
    """Standard deviation of `tau` before anything is known of it."""
    chi_square: float = 22.5
    """Of six degrees of freedom, beyond which a fix contradicts: 0.1 % of right ones."""
    up_chi_square: float = 16.0
    """Of gravity against the fixes, two degrees of freedom, beyond which it isn't used: the scene's up is wrong."""
    floor_turn: float = 0.0005
    floor_share: float = 0.0005
    """Least standard deviation of a fix: rad, and share of the distance to what is seen. Scenes have errors, too."""
    iterations: int = 4


FIT = FitConfig()


@dataclass(frozen=True, slots=True)
class Fix:
    """A frame whose pose in the world is known."""

    time_s: float
    pose: Pose
    """world_from_camera."""
    covariance: Float64[np.ndarray, "6 6"]
    """As a verdict's."""
    odom_from_camera: Pose
    velocity: Float64[np.ndarray, "6"]
    """By the odometry since the frame before: twist per second in the camera's frame."""
    velocity_on: Float64[np.ndarray, "6"]
    """To the next frame; while there is none, as before."""
    way: float
    """Along which the odometry came here."""
    depth: float
    """Distance to what is seen, scene units."""
    run: int = 0
    """Fixes of one run were followed from frame to frame."""


@dataclass(frozen=True, slots=True)
class Priors:
    """What is known beside the fixes."""

    log_scale: float
    log_scale_sigma: float
    up_in_world: Float64[np.ndarray, "3"] | None = None
    up_in_odom: Float64[np.ndarray, "3"] | None = None
    up_sigma: float = 0.0
    """Of both together, rad."""


@dataclass(frozen=True, slots=True)
class OdometryFit:
    """The estimate at the last fix."""

    pose: Pose
    """world_from_camera there."""
    log_scale: float
    """Of scene units per unit of the odometry."""
    offset_s: float
    """By how much the odometry's poses are late."""
    covariance: Float64[np.ndarray, "8 8"]
    """Of (rotation rad, translation units) in the camera's frame, logarithm of the scale, offset: true pose =
    pose @ exp(twist)."""
    agree: Bool[np.ndarray, "n"]
    """Of the fixes: those that were used."""
    up_used: bool


def fit_odometry(fixes: Sequence[Fix], priors: Priors, config: FitConfig = FIT) -> OdometryFit:
    """Fit the fixes, oldest first; the last one's time is now, whether it agrees or not."""
    stack = _Stack.of(fixes, config)
    start, agree = _consensus(stack, priors, config)
    state = _State(start, priors.log_scale, 0.0)
    state, covariance = _solved(stack, agree, state, priors, False, config)
    up_used = _up_agrees(state, stack, priors, covariance, config)
    if agree.sum() > 1:
        agree = _within(stack, state, covariance, config)
    state, covariance = _solved(stack, agree, state, priors, up_used, config)
    return OdometryFit(Pose(state.pose), state.log_scale, state.offset_s, covariance, agree, up_used)


def drift(way: float, scale: float, config: FitConfig = FIT) -> Float64[np.ndarray, "6 6"]:
    """Return the covariance that the odometry's drift over a way adds to a pose: rotation rad^2, translation in scene
    units squared; `scale` in scene units per unit of the odometry.
    """
    grown = way + way**2
    return np.diag([grown * config.turn_drift**2] * 3 + [grown * (config.drift_share * scale) ** 2] * 3)


def scaled(motion: Float64[np.ndarray, "*n 4 4"], scale: float) -> Float64[np.ndarray, "*n 4 4"]:
    """Return a rigid motion with its translation in other units."""
    result = motion.copy()
    result[..., :3, 3] *= scale
    return result


# ------------------------------------------------------------------ the model


@dataclass(frozen=True, slots=True)
class _State:
    pose: Float64[np.ndarray, "4 4"]
    log_scale: float
    offset_s: float

    def stepped(self, step: Float64[np.ndarray, "8"]) -> _State:
        return _State(self.pose @ se3_exp(step[:6]), self.log_scale + float(step[6]), self.offset_s + float(step[7]))


@dataclass(frozen=True, slots=True)
class _Stack:
    """The fixes as arrays."""

    world: Float64[np.ndarray, "n 4 4"]
    odom: Float64[np.ndarray, "n 4 4"]
    velocity: Float64[np.ndarray, "n 6"]
    velocity_on: Float64[np.ndarray, "n 6"]
    way: Float64[np.ndarray, "n"]
    """From each fix to the last one."""
    root: Float64[np.ndarray, "n 6 6"]
    """Cholesky factors of their covariances in the world's axes."""
    kernel: Float64[np.ndarray, "n n"]

    @classmethod
    def of(cls, fixes: Sequence[Fix], config: FitConfig) -> _Stack:
        world = np.stack([fix.pose.world_from_camera for fix in fixes])
        way = np.array([fix.way for fix in fixes])
        roots = []
        for fix in fixes:
            floor = [config.floor_turn**2] * 3 + [(config.floor_share * fix.depth) ** 2] * 3
            axes = np.kron(np.eye(2), fix.pose.world_from_camera[:3, :3])
            roots.append(np.linalg.cholesky(axes @ (fix.covariance + np.diag(floor)) @ axes.T))
        # Gaussians of Euclidean distances, here of the matrices' numbers, are covariances.
        turn = np.linalg.norm(world[:, None, :3, :3] - world[None, :, :3, :3], axis=(2, 3)) / np.sqrt(2)
        way_between = np.linalg.norm(world[:, None, :3, 3] - world[None, :, :3, 3], axis=2)
        near = (turn / config.view_turn) ** 2 + (way_between / (config.view_way * fixes[-1].depth)) ** 2
        kernel = config.shared * np.exp(-0.5 * near) + (1 - config.shared) * np.eye(len(fixes))
        return cls(
            world,
            np.stack([fix.odom_from_camera.world_from_camera for fix in fixes]),
            np.stack([fix.velocity for fix in fixes]),
            np.stack([fix.velocity_on for fix in fixes]),
            way[-1] - way,
            np.stack(roots),
            kernel,
        )

    def covariance(self, scale: float, config: FitConfig) -> Float64[np.ndarray, "n n 6 6"]:
        """Return the residuals' covariance, as blocks."""
        fixes = np.einsum("iab,jcb,ij->ijac", self.root, self.root, self.kernel)
        walk = np.minimum(self.way[:, None], self.way[None]) + self.way[:, None] * self.way[None]
        per_way = np.array([config.turn_drift**2] * 3 + [(config.drift_share * scale) ** 2] * 3)
        return fixes + walk[:, :, None, None] * np.diag(per_way)

    def corrected(self, offset_s: float) -> Float64[np.ndarray, "n 4 4"]:
        """Return the odometry's poses at the fixes' own times."""
        twists = -offset_s * (self.velocity if offset_s > 0 else self.velocity_on)
        generators = np.zeros((len(self.odom), 4, 4))
        generators[:, [2, 0, 1], [1, 2, 0]] = twists[:, :3]
        generators[:, [1, 2, 0], [2, 0, 1]] = -twists[:, :3]
        generators[:, :3, 3] = twists[:, 3:]
        # The exponential series of small motions.
        motions = term = np.broadcast_to(np.eye(4), generators.shape)
        for order in range(1, 7):
            term = term @ generators / order
            motions = motions + term
        return self.odom @ motions

    def since(self, offset_s: float) -> Float64[np.ndarray, "n 4 4"]:
        """Return the motions from now to the fixes, by the odometry."""
        odom = self.corrected(offset_s)
        return np.linalg.inv(odom[-1]) @ odom

    def residuals(self, state: _State, since: Float64[np.ndarray, "n 4 4"]) -> Float64[np.ndarray, "n 6"]:
        return differences(state.pose @ scaled(since, float(np.exp(state.log_scale))), self.world)


def differences(
    predicted: Float64[np.ndarray, "*n 4 4"], measured: Float64[np.ndarray, "*n 4 4"]
) -> Float64[np.ndarray, "*n 6"]:
    """Return (rotation vectors, translations) from the predicted to the measured poses, in the world's axes."""
    between = measured[..., :3, :3] @ np.swapaxes(predicted[..., :3, :3], -1, -2)
    return np.concatenate([_rotation_vectors(between), measured[..., :3, 3] - predicted[..., :3, 3]], -1)


def _rotation_vectors(rotation: Float64[np.ndarray, "*n 3 3"]) -> Float64[np.ndarray, "*n 3"]:
    """Return the vectors of rotations that are at most nearly half a turn; beyond, only their length counts here."""
    axis = np.stack(
        [
            rotation[..., 2, 1] - rotation[..., 1, 2],
            rotation[..., 0, 2] - rotation[..., 2, 0],
            rotation[..., 1, 0] - rotation[..., 0, 1],
        ],
        -1,
    )
    sine = np.linalg.norm(axis, axis=-1, keepdims=True) / 2
    cosine = (np.trace(rotation, axis1=-2, axis2=-1)[..., None] - 1) / 2
    angle = np.arctan2(sine, cosine)
    return axis / 2 * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 1.0)


def _up_residual(state: _State, stack: _Stack, priors: Priors) -> Float64[np.ndarray, "3"]:
    """Return the rotation vector in the world's axes that takes up by gravity to the scene's up."""
    assert priors.up_in_world is not None
    assert priors.up_in_odom is not None
    odom = stack.corrected(state.offset_s)[-1]
    up = state.pose[:3, :3] @ odom[:3, :3].T @ priors.up_in_odom
    axis = np.cross(up, priors.up_in_world)
    sine = max(float(np.linalg.norm(axis)), 1e-12)
    return axis * np.arctan2(sine, up @ priors.up_in_world) / sine


def _up_agrees(
    state: _State, stack: _Stack, priors: Priors, covariance: Float64[np.ndarray, "8 8"], config: FitConfig
) -> bool:
    """Return whether gravity is known and, as far as the fixes can tell, right."""
    if priors.up_in_world is None or priors.up_in_odom is None:
        return False
    gap = _up_residual(state, stack, priors)
    turned = state.pose[:3, :3] @ covariance[:3, :3] @ state.pose[:3, :3].T
    spread = turned + priors.up_sigma**2 * np.eye(3)
    return float(gap @ np.linalg.solve(spread, gap)) < config.up_chi_square


# ------------------------------------------------------------------ the solver


def _consensus(
    stack: _Stack, priors: Priors, config: FitConfig
) -> tuple[Float64[np.ndarray, "4 4"], Bool[np.ndarray, "n"]]:
    """Return the present pose by the fix that most agree with, the newest of several, and which agree with it."""
    scale = float(np.exp(priors.log_scale))
    between = np.linalg.inv(stack.odom)[:, None] @ stack.odom[None]  # from each fix to each other one
    predicted = stack.world[:, None] @ scaled(between, scale)
    gap = differences(predicted, np.broadcast_to(stack.world[None], predicted.shape))
    own = np.einsum("iab,icb->iac", stack.root, stack.root)
    way = np.abs(stack.way[:, None] - stack.way[None])
    grown = np.stack([way + way**2] * 6, -1)
    grown[..., :3] *= config.turn_drift**2
    # A rotation's error moves what is far from the fix; an unknown scale does, too.
    reach = scale * np.linalg.norm(between[..., :3, 3], axis=2)
    tilt = np.trace(own[:, :3, :3], axis1=1, axis2=2)[:, None]
    grown[..., 3:] *= (config.drift_share * scale) ** 2
    grown[..., 3:] += (reach**2 * (priors.log_scale_sigma**2 + tilt))[..., None]
    spread = own[:, None] + own[None] + grown[..., None] * np.eye(6)
    agree = np.einsum("ija,ija->ij", gap, np.linalg.solve(spread, gap[..., None])[..., 0]) < config.chi_square
    best = int(np.flatnonzero(agree.sum(1) == agree.sum(1).max())[-1])
    return predicted[best, -1], agree[best]


def _solved(
    stack: _Stack, agree: Bool[np.ndarray, "n"], state: _State, priors: Priors, use_up: bool, config: FitConfig
) -> tuple[_State, Float64[np.ndarray, "8 8"]]:
    """Return the state that explains the fixes that agree, and its covariance."""
    count = int(agree.sum())
    blocks = stack.covariance(float(np.exp(state.log_scale)), config)[agree][:, agree]
    whitener = np.linalg.inv(np.linalg.cholesky(blocks.transpose(0, 2, 1, 3).reshape(6 * count, 6 * count)))
    known = np.zeros((8, 8))
    known[6, 6], known[7, 7] = priors.log_scale_sigma**-2, config.offset_sigma_s**-2
    covariance = known
    for _ in range(config.iterations):
        since = stack.since(state.offset_s)
        whole = _whitened(state, since, stack, agree, whitener, priors, use_up)
        columns = []
        for step in 1e-5 * np.eye(8):
            moved = state.stepped(step)
            if step[7]:
                since = stack.since(moved.offset_s)
            columns.append((_whitened(moved, since, stack, agree, whitener, priors, use_up) - whole) / 1e-5)
        jacobian = np.stack(columns, 1)
        covariance = np.linalg.inv(jacobian.T @ jacobian + known)
        gradient = jacobian.T @ whole + known @ np.array(
            [0.0] * 6 + [state.log_scale - priors.log_scale, state.offset_s]
        )
        step = -covariance @ gradient
        state = state.stepped(step)
        if float(step @ np.linalg.solve(covariance, step)) < 1e-4:
            break
    return state, covariance


def _whitened(
    state: _State, since: Float64[np.ndarray, "n 4 4"], stack: _Stack, agree: Bool[np.ndarray, "n"],
    whitener: Float64[np.ndarray, "m m"], priors: Priors, use_up: bool,
) -> Float64[np.ndarray, "k"]:  # fmt: skip
    whole = whitener @ stack.residuals(state, since)[agree].ravel()
    return np.concatenate([whole, _up_residual(state, stack, priors) / priors.up_sigma]) if use_up else whole


def _within(
    stack: _Stack, state: _State, covariance: Float64[np.ndarray, "8 8"], config: FitConfig
) -> Bool[np.ndarray, "n"]:
    """Return which fixes are explained by the state, given how sure it is."""
    gap = stack.residuals(state, stack.since(state.offset_s))
    spread = np.einsum("iiab->iab", stack.covariance(float(np.exp(state.log_scale)), config)).copy()
    axes = np.kron(np.eye(2), state.pose[:3, :3])
    turned = axes @ covariance[:6, :6] @ axes.T
    reach = stack.world[:, :3, 3] - state.pose[:3, 3]
    for i, lever in enumerate(reach):
        # How the state's errors move what is at a distance.
        carried = np.eye(6)
        carried[3:, :3] = -np.cross(np.eye(3), lever)
        spread[i] += carried @ turned @ carried.T
        spread[i, 3:, 3:] += covariance[6, 6] * np.outer(lever, lever)
    distance = np.einsum("ia,ia->i", gap, np.linalg.solve(spread, gap[..., None])[..., 0])
    found = distance < config.chi_square
    return found if found.any() else np.eye(len(gap), dtype=bool)[int(distance.argmin())]
