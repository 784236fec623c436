"""A rolling shutter: rows turned back, shear and stretch by the normal equations, and when the check believes them."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_bench import estimate
from test_search_thresholds import drained

from service.estimators import shutter_check
from service.estimators.search_state import VerifiedPose
from service.estimators.shutter_check import check_shutter
from service.geometry import moved
from service.pose.features.row_motion import without_row_motion
from service.pose.refinement.refinement_config import ShutterConfig
from service.pose.refinement.rolling_shutter import shutter_motion, with_shutter_rows
from service.pose.retrieval.image_variant import ImageVariant
from service.results import Status
from service.types import Intrinsics, Pose, Query

LENS = Intrinsics(60, 48, 110.0, 90.0, 33.0, 21.0)


def read_in_rows(as_columns: bool = False, valid: np.ndarray | None = None) -> Query:
    """A photo whose red tells its column and whose green tells its row, four levels a pixel."""
    row, column = np.mgrid[: LENS.height, : LENS.width]
    rgb = np.stack([4 * column, 4 * row, 0 * row], 2).astype(np.uint8)
    return Query(rgb, LENS, "given", LENS, valid_mask=valid, rows_are_columns=as_columns)


def seen_at(x: float, y: float, shear: float, stretch: float, as_columns: bool) -> tuple[float, float]:
    """Where a rolling shutter saw what the middle row's camera has at (x, y) px, by rotations and repetition."""
    ray = np.array([(x - LENS.cx) / LENS.fx, (y - LENS.cy) / LENS.fy, 1.0])
    seen = ray.copy()
    for _ in range(30):
        # The time since the middle of the photo, in normalized units along the direction in which it was read.
        if as_columns:
            late = seen[0] - (LENS.width / 2 - LENS.cx) / LENS.fx
            right, down = -stretch * late, shear * late
        else:
            late = seen[1] - (LENS.height / 2 - LENS.cy) / LENS.fy
            right, down = shear * late, stretch * late
        yaw, pitch = np.arctan(right), np.arctan(down)
        about_y = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
        about_x = np.array([[1, 0, 0], [0, np.cos(pitch), np.sin(pitch)], [0, -np.sin(pitch), np.cos(pitch)]])
        turned = about_y @ about_x @ ray
        seen = turned / turned[2]
    return seen[0] * LENS.fx + LENS.cx, seen[1] * LENS.fy + LENS.cy


@pytest.mark.parametrize("as_columns", [False, True])
@pytest.mark.parametrize(("shear", "stretch"), [(0.15, 0.0), (0.0, 0.12), (-0.11, 0.07)])
def test_rows_are_turned_back_to_the_middle_ones_camera(shear: float, stretch: float, as_columns: bool) -> None:
    found = without_row_motion(read_in_rows(as_columns), LENS, shear, stretch)
    most = 0.0
    for column, row in [(12, 9), (50, 9), (12, 38), (50, 38), (30, 24), (44, 14)]:
        x, y = seen_at(column + 0.5, row + 0.5, shear, stretch, as_columns)
        # The colours count from the first pixel's centre.
        assert found.rgb[row, column, :2] / 4 == pytest.approx([x - 0.5, y - 0.5], abs=0.2)
        most = max(most, abs(x - column - 0.5), abs(y - row - 0.5))
    assert most > 1.2


def test_what_no_row_saw_is_invalid_and_holes_move_along() -> None:
    assert without_row_motion(read_in_rows(), LENS, 0.0, 0.0).valid_mask is None
    shear = 0.3  # of the last row by 7.6 pixels to the left, which leaves its right end unseen
    mask = np.asarray(without_row_motion(read_in_rows(), LENS, shear, 0.0).valid_mask)
    for column, row in [(2, 47), (48, 47), (57, 47), (1, 1), (12, 1), (30, 24)]:
        x, y = seen_at(column + 0.5, row + 0.5, shear, 0.0, False)
        assert mask[row, column] == (0 < x < LENS.width and 0 < y < LENS.height)
    valid = np.ones((48, 60), bool)
    valid[40:, 30:34] = False
    mask = np.asarray(without_row_motion(read_in_rows(valid=valid), LENS, shear, 0.0).valid_mask)
    for column in range(20, 45):
        x, y = seen_at(column + 0.5, 44.5, shear, 0.0, False)
        if min(abs(x - 30), abs(x - 34)) > 0.3:
            assert mask[44, column] == (not 30 < x < 34)


def test_shear_and_stretch_are_the_principal_points_rows_times_the_height() -> None:
    level: Any = SimpleNamespace(
        photo_intrinsics=replace(LENS, fx=48.0), points=np.float32([[1, 1, 1], [3, -2, 0.5], [4, 5, 2.5]])
    )
    jacobian = np.arange(14 * 3, dtype=np.float32).reshape(14, 3) - 7
    rows = with_shutter_rows(level, jacobian)
    assert (rows[:14] == jacobian).all()
    # Shifts are in long sides: 60 px of a focal length of 48.
    height = np.array([0.75, -0.4, 0.2]) * 48 / 60
    assert rows[14] == pytest.approx(jacobian[12] * height)
    assert rows[15] == pytest.approx(jacobian[13] * height)


def equations() -> tuple[np.ndarray, np.ndarray]:
    """The information of 16 unknowns, and a score that moves the last two by (0.05, -0.03)."""
    rng = np.random.default_rng(3)
    half = rng.standard_normal((16, 40))
    return half @ half.T + 3 * np.eye(16), rng.standard_normal(16)


@pytest.mark.parametrize(("estimates_lens", "known"), [(True, 14), (False, 10)])
def test_the_step_of_shear_and_stretch_with_pose_and_lens(estimates_lens: bool, known: int) -> None:
    information, score = equations()
    kept = [*range(known), 14, 15]
    inverse = np.linalg.inv(information[np.ix_(kept, kept)])
    step, sigma = inverse @ score[kept], np.sqrt(0.7 * np.diag(inverse)[-2:])

    def found(min_motion: float, min_sigmas: float):
        return shutter_motion(information, score, 0.7, estimates_lens, ShutterConfig(min_motion, min_sigmas))

    motion = found(0.0, 0.0)
    assert motion is not None
    assert (motion.shear, motion.stretch) == pytest.approx(tuple(step[-2:]))
    assert motion.motion == pytest.approx(step[:6])
    without = np.linalg.inv(information[:known, :known])
    assert motion.covariance == pytest.approx(0.7 * (inverse - np.pad(without, (0, 2)))[:6, :6])
    # Significant is what exceeds both thresholds; one of the two is enough.
    largest, sigmas = np.abs(step[-2:]), np.abs(step[-2:]) / sigma
    assert found(0.999 * largest.max(), 0.0) is not None
    assert found(1.001 * largest.max(), 0.0) is None
    assert found(0.0, 0.999 * sigmas.max()) is not None
    assert found(0.0, 1.001 * sigmas.max()) is None
    if largest.argmax() == sigmas.argmax():
        assert found(1.001 * largest.min(), 1.001 * sigmas.min()) is not None


def test_what_is_not_determined_shows_no_motion() -> None:
    information, score = equations()
    for unknown in (3, 15):
        flat = information.copy()
        flat[unknown] = flat[:, unknown] = 0.0
        assert shutter_motion(flat, score, 0.7, True, ShutterConfig(0.0, 0.0)) is None


# ------------------------------------------------------------------ when the check believes it


def answer(loss: float, motion: tuple[float, float] | None, status: str = "localized", turn: float = 0.0) -> Any:
    verdict = replace(estimate(Pose(np.eye(4)), Status(status)).verdict, shutter_motion=motion, covariance=np.eye(6))
    pose = moved(Pose(np.eye(4)), np.array([0.0, turn, 0, 0, 0, 0]))
    refined: Any = SimpleNamespace(loss=loss, pose=pose, correction=None, num_inliers=9)
    return VerifiedPose(refined, verdict, ImageVariant(416))


def checked(monkeypatch: pytest.MonkeyPatch, best: Any, *rounds: Any) -> tuple[Any, Any, list]:
    """Check an answer whose refinements lead to these; return the state before and after, and the motions asked for."""
    left, asked = iter(rounds), []

    def turned_back(state, now, motion):
        asked.append(tuple(np.round(motion, 6)))
        return SimpleNamespace(best=None, finished=False)

    def refined(state, other, now):
        yield from ()
        return next(left)

    monkeypatch.setattr(shutter_check, "_turned_back", turned_back)
    monkeypatch.setattr(shutter_check, "_refined", refined)
    state: Any = SimpleNamespace(best=best, finished=False)
    return state, drained(check_shutter(state))[1], asked


def test_the_rows_are_turned_back_until_hardly_any_motion_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    first = answer(0.1, (0.02, -0.01))
    state, after, asked = checked(
        monkeypatch, first, answer(0.09, (0.004, -0.006)), answer(0.08, (0.0003, -0.00049), turn=0.2)
    )
    assert asked == [(0.02, -0.01), (0.024, -0.016)]
    assert after is not state
    assert after.finished
    assert after.best.verdict.shutter_motion == pytest.approx((0.0243, -0.01649))
    # A tenth of the way from the first answer is added to the covariance.
    expected = np.eye(6)
    expected[1, 1] += 0.02**2
    assert after.best.verdict.covariance == pytest.approx(expected)
    assert after.best.verdict.covariance_given_lens is None
    # Five refinements at most; none left is settled.
    _, after, asked = checked(monkeypatch, first, *[answer(0.09, (0.0, 0.0005), "uncertain")] * 6)
    assert (len(asked), after.finished) == (5, False)
    assert len(checked(monkeypatch, first, answer(0.09, None))[2]) == 1


@pytest.mark.parametrize("loss", [0.095, 0.096, 0.097])
def test_the_residual_must_fall_below_96_hundredths(monkeypatch: pytest.MonkeyPatch, loss: float) -> None:
    best = answer(0.1, (0.02, 0.0))
    state, after, _ = checked(monkeypatch, best, answer(loss, None))
    assert (after is state) is (loss >= 0.96 * best.loss)


def test_a_photo_without_motion_or_answer_is_left_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    for best in (None, answer(0.1, None), answer(0.1, (0.02, 0.0), "not_localized")):
        state, after, asked = checked(monkeypatch, best)
        assert (after is state, asked) == (True, [])
    state, after, _ = checked(monkeypatch, answer(0.1, (0.02, 0.0)), None)
    assert after is state
