"""The covariance of a refined pose, put together: the inverse of pixels and prior, and what is added to it."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service.geometry import moved, se3_exp
from service.interfaces import Frame
from service.pose.absolute_pose import fisheye
from service.pose.absolute_pose.lens_prior import prior_precision
from service.pose.absolute_pose.pnp import AbsolutePose
from service.pose.refinement import uncertainty
from service.pose.refinement.covariance import inverse_spd
from service.pose.refinement.refinement_config import REFINEMENT, LensErrorConfig, UncertaintyConfig
from service.pose.refinement.rolling_shutter import ShutterMotion
from service.pose.refinement.uncertainty import PoseUncertainty, pose_uncertainty
from service.types import NO_CORRECTION, Camera, Intrinsics, IntrinsicsCorrection, LensPrior, Pose

HERE = Pose(np.eye(4))
LENS = Intrinsics(640, 480, 512.0, 512.0, 320.0, 240.0)
PRIOR = LensPrior(0.1, 0.05, 0.003)
OFF = IntrinsicsCorrection(1.3, 0.02, -0.05, 0.07)
KEPT = [*range(6), *range(10, 14)]


def equations() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(5)
    half = rng.standard_normal((16, 50))
    return 40 * half @ half.T, 30 * rng.standard_normal(16)


def with_prior(hessian: np.ndarray, scale: float, prior: LensPrior, correction: IntrinsicsCorrection) -> np.ndarray:
    total = hessian[:14, :14].copy()
    total[range(10, 14), range(10, 14)] += scale * prior_precision(prior, correction)
    return total


def test_an_estimated_lens_covariance_is_that_of_pixels_prior_and_model_errors() -> None:
    hessian, score = equations()
    error = LensErrorConfig(log_focal=0.03, k1=0.002, principal_point=0.005)
    config, scale = replace(REFINEMENT, lens_error=error), 0.6
    found = uncertainty._with_estimated_lens(hessian, score, scale, PRIOR, OFF, 0.8, config)
    assert found is not None
    pixels = scale * np.linalg.inv(with_prior(hessian, scale, PRIOR, OFF))[np.ix_(KEPT, KEPT)]
    # The errors' squares, and no more than the prior leaves.
    room = np.maximum(1 / prior_precision(PRIOR, OFF) - pixels.diagonal()[6:], 0)
    errors = np.minimum(np.array([0.03, 0.002, 0.004, 0.004]) ** 2, room)
    follows = pixels[:, 6:] @ np.linalg.inv(pixels[6:, 6:])
    assert found.covariance == pytest.approx(pixels + follows @ np.diag(errors) @ follows.T)
    assert found.given_lens == pytest.approx(scale * np.linalg.inv(hessian[:10, :10])[:6, :6])
    assert found.if_cropped is None
    assert found.focal_step == pytest.approx(np.linalg.solve(hessian[:12, :12], score[:12])[10])
    flat = hessian.copy()
    flat[1] = flat[:, 1] = 0.0
    assert uncertainty._with_estimated_lens(flat, score, scale, PRIOR, OFF, 0.8, config) is None
    assert uncertainty._with_estimated_lens(hessian, score, np.inf, PRIOR, OFF, 0.8, config) is None


def test_an_exact_lens_covariance_is_of_the_pose_alone_and_told_beside_an_untested_one(monkeypatch) -> None:
    hessian, _ = equations()
    scale, told = 0.6, object()
    asked: list[Any] = []
    monkeypatch.setattr(uncertainty, "fit_lens", lambda *_: told)
    monkeypatch.setattr(uncertainty, "_covariance_of_untested_lens", lambda *given: asked.append(given[3]) or np.eye(6))
    level: Any = SimpleNamespace()
    found = uncertainty._with_exact_lens(level, None, hessian, scale, REFINEMENT)  # type: ignore[arg-type]
    assert found is not None
    assert found.covariance == pytest.approx(scale * np.linalg.inv(hessian[:10, :10])[:6, :6])
    assert found.lens_fit is told
    assert (found.given_lens, found.untested_lens.tolist()) == (None, np.eye(6).tolist())  # type: ignore[union-attr]
    free = with_prior(hessian, scale, REFINEMENT.lens_test.prior, NO_CORRECTION)
    assert asked[0] == pytest.approx(np.linalg.inv(free))


@pytest.mark.parametrize("lens_prior", [None, PRIOR])
def test_what_is_left_of_refinement_and_a_turn_are_told_with_the_pose(
    monkeypatch, lens_prior: LensPrior | None
) -> None:
    hessian, score = equations()
    asked: list[Any] = []
    answer = Camera(LENS, moved(HERE, np.array([0.1, 0.2, -0.1, 1.0, 2, 3])))
    camera = Camera(LENS, moved(answer.pose, np.array([0.02, 0, 0.01, 0, 0.1, 0])))
    left = np.array([0.01, -0.02, 0.03, 0.1, -0.2, 0.3])
    turned = ShutterMotion(0.1, 0.2, np.array([0.1, 0, 0, 0, 0.2, 0]), 3 * np.eye(6))

    def minimize(level, state, settled_px, config):
        # The photo moves: photo_from_render = exp(-left) before.
        state.photo_from_render = se3_exp(-left) @ state.photo_from_render
        return 0.07

    def of_lens(kind: str) -> Any:
        return lambda *given: asked.append((kind, given)) or PoseUncertainty(np.zeros(6), np.eye(6), 2 * np.eye(6))

    monkeypatch.setattr(uncertainty, "linearized_levels", lambda *_: iter([SimpleNamespace()]))
    monkeypatch.setattr(uncertainty, "minimize", minimize)
    monkeypatch.setattr(uncertainty, "_normal_equations", lambda *_: (score, hessian, 0.6))
    monkeypatch.setattr(uncertainty, "_with_exact_lens", of_lens("exact"))
    monkeypatch.setattr(uncertainty, "_with_estimated_lens", of_lens("estimated"))
    shutter: list[Any] = [turned]
    given: list[Any] = []
    monkeypatch.setattr(uncertainty, "shutter_motion", lambda *args: given.append(args) or shutter[0])
    image, ones = np.zeros((480, 640, 3), np.uint8), np.ones((480, 640), np.float32)
    frame = Frame(np.zeros((480, 640, 3), np.float32), ones, ones, ones)
    found = pose_uncertainty(image, frame, camera, answer, lens_prior)
    assert found is not None
    assert found.last_step == pytest.approx(left)
    assert found.loss == 0.07
    motion = REFINEMENT.shutter.uncertainty_factor * turned.motion
    assert found.covariance == pytest.approx(np.eye(6) + 3 * np.eye(6) + np.outer(motion, motion))
    assert found.shutter is turned
    assert asked[0][0] == ("estimated" if lens_prior else "exact")
    information = hessian.copy()
    if lens_prior:
        assert asked[0][1][5] == 0.8  # 512 px of 640
        information[:14, :14] = with_prior(hessian, 0.6, PRIOR, NO_CORRECTION)
    assert given[0][0] == pytest.approx(information)
    assert given[0][3] is (lens_prior is not None)
    shutter[0] = None
    found = pose_uncertainty(image, frame, camera, answer, lens_prior)
    assert found is not None
    assert found.covariance.tolist() == np.eye(6).tolist()
    monkeypatch.setattr(uncertainty, "minimize", lambda *_: np.inf)
    assert pose_uncertainty(image, frame, camera, answer, lens_prior) is None


def test_score_and_hessian_are_the_sums_of_cells_and_their_scale_has_a_bound(monkeypatch) -> None:
    rng = np.random.default_rng(0)
    scores, hessians = rng.standard_normal((4, 16)), rng.standard_normal((4, 16, 16))
    asked: list[Any] = []
    monkeypatch.setattr(uncertainty, "with_shutter_rows", lambda level, jacobian: jacobian)
    monkeypatch.setattr(uncertainty, "scores_by_cell", lambda *given: asked.append(given) or (scores, hessians, None))
    spread = [0.5]
    monkeypatch.setattr(uncertainty, "jackknife_variance_scale", lambda *given: asked.append(given) or spread[0])
    factors = np.arange(1.0, 15)
    level: Any = SimpleNamespace(
        jacobian=np.full((14, 5), 2, np.float32), pixels=None, residuals=lambda state, config: (None, None, 0.1)
    )
    ones = np.ones((30, 40), np.float32)
    frame = Frame(np.zeros((30, 40, 3), np.float32), ones, ones, ones)
    config = replace(REFINEMENT, uncertainty=UncertaintyConfig(min_variance_scale=0.3))
    state: Any = SimpleNamespace(factors=factors)
    for spread[0], expected in ((0.5, 0.5), (0.2, 0.3)):
        score, hessian, scale = uncertainty._normal_equations(level, state, frame, config)
        assert (score.tolist(), hessian.tolist(), scale) == (scores.sum(0).tolist(), hessians.sum(0).tolist(), expected)
    assert asked[0][0].tolist() == np.repeat(2 * factors[:, None], 5, 1).tolist()
    assert asked[0][4] == (28, 38)  # without the border
    assert asked[1][0].tolist() == scores[:, :10].tolist()
    assert asked[1][1].tolist() == hessians[:, :10, :10].tolist()


def test_an_inverse_is_that_of_positive_definite_matrices_whatever_their_scales() -> None:
    half = np.random.default_rng(2).standard_normal((5, 9))
    matrix = half @ half.T
    units = np.array([1e-6, 1.0, 1e5, 3.0, 1e-2])
    found = inverse_spd(matrix * np.outer(units, units))
    assert found is not None
    assert found * np.outer(units, units) == pytest.approx(np.linalg.inv(matrix), rel=1e-9)
    assert (found == found.T).all()
    assert inverse_spd(np.diag([1.0, -1.0])) is None
    assert inverse_spd(np.array([[1.0, 1.0], [1.0, 1.0]]) - 1e-3 * np.eye(2)) is None


# ------------------------------------------------------------------ Levenberg and Marquardt's steps


def test_a_lens_fit_takes_steps_that_lower_the_cost_and_damps_others() -> None:
    """One unknown, the way along x, of a cost x^2 + 1 whose slope is told five times too small or too large."""
    visited: list[float] = []

    def problem(curvature: float) -> Any:
        def linearized(pose: Pose, correction: IntrinsicsCorrection, scale: float) -> Any:
            x = float(pose.position_in_world[0])
            visited.append(x)
            hessian, rhs = np.eye(10), np.zeros(10)
            hessian[3, 3], rhs[3] = curvature, -x
            return SimpleNamespace(pose=pose, correction=correction, cost=x**2 + 1, hessian=hessian, rhs=rhs)

        return SimpleNamespace(linearized=linearized)

    start = AbsolutePose(moved(HERE, np.array([0, 0, 0, 8.0, 0, 0])), np.zeros(0, bool))
    config = replace(fisheye.FISHEYE, cauchy_scales=(2.0,), max_iterations=40)
    found: Any = fisheye._minimized(problem(1.0), start, config)
    # A Newton step, and one that hardly lowers the cost.
    assert abs(found.pose.position_in_world[0]) < 1e-3
    assert len(visited) == 3
    visited.clear()
    # Steps ten times too long are damped until the cost falls: a damping of 1e-4, times ten each time.
    found = fisheye._minimized(problem(0.1), start, replace(config, max_iterations=6))
    assert visited[:3] == pytest.approx([8, 8 - 8 / 0.10001, 8 - 8 / 0.1001], rel=1e-4)
    assert visited[6] == pytest.approx(8 - 8 / (0.1 + 0.1 * 10.0), rel=1e-4)
    assert found.cost == pytest.approx(min(x**2 + 1 for x in visited))
