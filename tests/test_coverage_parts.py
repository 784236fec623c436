"""The parts of the coverage map: its drawing pixel by pixel, and its calibration beside a search by brute force."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from io import BytesIO
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from service.coverage import scene_drawing
from service.coverage.calibration import (
    MIN_PHOTOS,
    Calibration,
    CalibrationPrior,
    brier_score,
    calibrated,
    fitted_line,
    left_out,
)
from service.coverage.plan_drawing import LEVELS, drawn_plan, level_colour, round_length
from service.coverage.scene_drawing import drawn_scene
from service.geometry import look_at
from service.interfaces import Frame
from service.types import Camera, GaussianScene, Intrinsics, NamedCamera, SceneInfo

RED, GREY, WHITE, INK = [190, 40, 40], [205, 205, 205], [255, 255, 255], [30, 30, 30]
TURNED = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1.0]])
"""plan_from_world: the world's y is the plan's x."""
CELLS = np.array([[0.0, 0, 1], [2.0, 0, 1], [2.0, 1, 1]])
"""In the plan; cells are 1 apart."""


@cache
def drawn(metres: float | None = None) -> np.ndarray:
    return drawn_with(metres, np.zeros((0, 3)))


def drawn_with(metres: float | None, surfaces: np.ndarray) -> np.ndarray:
    """Three cells with four headings each: found, usually, sometimes and rarely; the last cell sees nothing."""
    found: Any = SimpleNamespace(
        plan_from_world=TURNED, positions_in_world=CELLS @ TURNED, cell=1.0,
        headings_rad=np.arange(4) * np.pi / 2, probabilities=np.array([[0.95, 0.75, 0.5, 0.1]] * 3),
        sees_scene=np.array([[True] * 4, [True] * 4, [False] * 4]), title="Coverage of a test", trials=(1, 2, 3),
    )  # fmt: skip
    cameras = np.array([[0.0, 1.0, 1.0]]) @ TURNED
    return np.asarray(Image.open(BytesIO(drawn_plan(found, surfaces @ TURNED, cameras, metres)))).astype(int)


SCALE = (900 - 2 * 40) / (2 + 2 * 1.5)
"""Pixels of a unit: the plan is as wide as the cells with one and a half cells around them."""
HEIGHT = int(SCALE * 4) + 80


def at(x: float, y: float) -> tuple[int, int]:
    """Row and column of a place of the plan."""
    return round(HEIGHT - 40 - (y + 1.5) * SCALE), round(40 + (x + 1.5) * SCALE)


def test_wedges_lie_around_their_cells_in_their_heading() -> None:
    image = drawn()
    assert image.shape == (HEIGHT + 200, 900, 3)
    colours = [list(colour) for _, colour, _ in LEVELS]
    for cell, seen in zip(CELLS[:, :2], (True, True, False), strict=True):
        for heading, colour in zip(np.arange(4) * np.pi / 2, colours, strict=True):
            direction = np.array([np.cos(heading), np.sin(heading)])
            aside = np.array([-direction[1], direction[0]])
            # A wedge is 0.9 of its angle of 90 degrees wide, from 0.25 to all of a radius of 0.46.
            for away, turn, inside in (
                (0.20, 0, True), (0.43, 0, True), (0.49, 0, False), (0.07, 0, False), (0.3, 0.67, True),
                (0.3, -0.67, True), (0.3, 0.76, False), (0.3, -0.76, False),
            ):  # fmt: skip
                place = cell + away * (np.cos(turn) * direction + np.sin(turn) * aside)
                expected = (colour if seen else GREY) if inside else WHITE
                assert image[at(*place)].tolist() == expected, (cell, heading, away, turn)
    assert image[at(0.0, 1.0)].tolist() == RED
    assert image[at(0.0, 1.0 + 2 / SCALE)].tolist() == RED
    assert image[at(0.0, 1.0 + 6 / SCALE)].tolist() == WHITE


def test_surfaces_are_shaded_relative_to_the_dense_ones() -> None:
    """The darkest loses 35 %; what lies outside of the image is left out."""
    rng = np.random.default_rng(0)
    dense = np.c_[rng.uniform([-1.3, 1.5], [-0.7, 2.1], (30_000, 2)), np.zeros(30_000)]
    far = np.array([[1e3, 0, 0], [-1e3, 0, 0], [0, 1e3, 0], [0, -1e3, 0.0]])
    image = drawn_with(None, np.concatenate([dense, far]))
    row, column = at(-1.0, 1.8)
    assert image[row - 5 : row + 5, column - 5 : column + 5].mean() == pytest.approx(0.65 * 255, rel=0.06)
    assert image[at(-1.0, 0.0)].tolist() == WHITE
    assert np.array_equal(image[HEIGHT:], drawn()[HEIGHT:])


def ink(part: np.ndarray) -> int:
    return int((part.sum(2) < 300).sum())


@pytest.mark.parametrize(("metres", "units"), [(None, 0.5), (0.1, 0.5)])
def test_the_legend_tells_colours_cameras_and_a_length(metres: float | None, units: float) -> None:
    legend = drawn(metres)[HEIGHT:]
    boxes = [*(list(colour) for _, colour, _ in LEVELS), GREY]
    for number, colour in enumerate(boxes):
        x, y = 40 + 430 * (number % 2), 52 + 26 * (number // 2)
        assert np.all(legend[y - 13 : y + 4, x : x + 19] == colour)
        assert legend[y - 15, x + 9].tolist() == WHITE
        assert ink(legend[y - 14 : y + 6, x + 28 : x + 28 + 150]) > 100
        assert ink(legend[y - 14 : y + 6, x + 19 : x + 27]) == 0
    assert ink(legend[5:30, 40:300]) > 150
    assert ink(legend[90:110, 498:640]) > 100  # training camera
    assert legend[99, 479].tolist() == RED
    assert ink(legend[160:182, 40:400]) > 200  # how many renders
    # A length of at most 100 px: 1, 2 or 5 times a power of ten, in metres or units.
    in_unit = SCALE / (metres or 1.0)
    length = {None: 0.5, 0.1: 0.05}[metres]
    assert length * in_unit <= 100 < 2.5 * length * in_unit
    dark = legend[140, 39:300].sum(1) < 300
    bar = 39 + np.flatnonzero(dark)[: 1 + np.argmin(dark[1:])]
    assert (bar.min(), bar.max()) == pytest.approx((40, 40 + length * in_unit), abs=2)
    end = 40 + round(length * in_unit)
    assert ink(legend[132:152, end + 12 : end + 200]) > 150


def test_units_are_metres_where_these_are_known() -> None:
    with_metres, without = drawn(1.0)[HEIGHT:], drawn()[HEIGHT:]
    assert np.array_equal(with_metres[:120], without[:120])
    assert not np.array_equal(with_metres[120:150], without[120:150])


@pytest.mark.parametrize(
    ("about", "length"),
    [(1.0, 1.0), (1.99, 1.0), (2.0, 2.0), (4.99, 2.0), (5.0, 5.0), (9.99, 5.0), (0.07, 0.05), (730, 500)],
)
def test_lengths_are_round(about: float, length: float) -> None:
    assert round_length(about) == pytest.approx(length)


@pytest.mark.parametrize(
    ("probability", "level"), [(1.0, 0), (0.9, 0), (0.899, 1), (0.7, 1), (0.699, 2), (0.4, 2), (0.399, 3), (0.0, 3)]
)
def test_a_probability_has_the_colour_of_its_level(probability: float, level: int) -> None:
    assert level_colour(probability) == LEVELS[level][1]


# ------------------------------------------------------------------ calibration

SHARES = np.array([0.9, 0.8, 0.3, 0.95, 0.6, 1.0, 0.2, 0.0])
FOUND = np.array([True, True, False, True, False, True, True, False])


def by_search(shares: np.ndarray, found: np.ndarray) -> tuple[float, float]:
    """The most probable offset and slope, on ever finer grids: offset 0 with sigma 1.5, slope 1 with sigma 0.3."""
    clipped = np.clip(shares, 0.01, 0.99)
    logit = np.log(clipped / (1 - clipped))
    middle, width = np.array([0.0, 1.0]), np.array([6.0, 2.0])
    for _ in range(14):
        offset, slope = np.meshgrid(*(m + w * np.linspace(-1, 1, 21) for m, w in zip(middle, width, strict=True)))
        z = offset[..., None] + slope[..., None] * logit
        cost = (
            np.log1p(np.exp(np.where(found, -z, z))).sum(-1)
            + 0.5 * (offset / 1.5) ** 2
            + 0.5 * ((slope - 1) / 0.3) ** 2
        )
        best = np.unravel_index(cost.argmin(), cost.shape)
        middle, width = np.array([offset[best], slope[best]]), width / 4
    return float(middle[0]), float(middle[1])


def probability(shares: np.ndarray, offset: float, slope: float) -> np.ndarray:
    clipped = np.clip(shares, 0.01, 0.99)
    return 1 / (1 + np.exp(-offset - slope * np.log(clipped / (1 - clipped))))


def test_the_calibration_is_the_most_probable_one() -> None:
    for found in (FOUND, np.ones(8, bool), np.zeros(8, bool)):
        fitted = calibrated(SHARES, found)
        offset, slope = by_search(SHARES, found)
        assert (fitted.offset, fitted.slope) == pytest.approx((offset, slope), abs=1e-4)
        assert fitted.photos == 8
        assert np.allclose(fitted.applied(SHARES), probability(SHARES, offset, slope), atol=1e-4)
    assert CalibrationPrior() == CalibrationPrior(0.0, 1.0, 1.5, 0.3)


def test_each_photo_is_predicted_by_the_others() -> None:
    found = left_out(SHARES, FOUND)
    for i in (0, 3, 6):
        others = np.arange(8) != i
        assert found[i] == pytest.approx(probability(SHARES, *by_search(SHARES[others], FOUND[others]))[i], abs=1e-4)
    assert calibrated(SHARES, FOUND).brier == pytest.approx(np.mean((found - FOUND) ** 2))
    assert brier_score(np.array([0.5, 1.0]), np.array([True, False])) == pytest.approx(0.625)


def test_fewer_than_four_photos_calibrate_nothing() -> None:
    assert MIN_PHOTOS == 4
    assert calibrated(SHARES[:3], FOUND[:3]) == Calibration()
    assert calibrated(SHARES[:4], FOUND[:4]).photos == 4
    nothing = Calibration()
    assert (nothing.photos, nothing.brier) == (0, None)
    assert np.array_equal(nothing.applied(SHARES), SHARES)
    assert np.allclose(Calibration(photos=1).applied(SHARES), np.clip(SHARES, 0.01, 0.99))


def test_a_line_is_fitted_to_an_outcome_and_stays_finite() -> None:
    x = np.linspace(-2, 2, 400)
    found = np.random.default_rng(0).random(400) < 1 / (1 + np.exp(-0.5 - 1.5 * x))
    line = fitted_line(x, found)(np.array([-1.0, 0.0, 1.0]))
    assert np.allclose(np.log(line / (1 - line)), [-1.0, 0.5, 2.0], atol=0.35)
    always = fitted_line(x, np.ones(400, bool))(np.array([0.0]))
    assert 0.99 < always[0] < 1.0


class Coloured:
    """A rasterizer whose renders have one colour each, by the camera's direction."""

    def render(self, cameras: Sequence[Camera]) -> list[Frame]:
        frames = []
        for camera in cameras:
            shape = (camera.intrinsics.height, camera.intrinsics.width)
            rgb = np.tile(np.float32((1 + camera.pose.axis_in_world) / 2), (*shape, 1))
            frames.append(Frame(rgb, *(np.zeros(shape, np.float32) for _ in range(3))))
        return frames


COLOURED: Any = Coloured()


def scene_at(means: np.ndarray, cameras: Sequence[NamedCamera] = ()) -> GaussianScene:
    count = len(means)
    return GaussianScene(
        means=means.astype(np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        scales=np.full((count, 3), 0.01, np.float32),
        opacities=np.ones(count, np.float32),
        sh=np.zeros((count, 1, 3), np.float32),
        cameras=tuple(cameras),
        info=replace(SceneInfo("a", "A", "", "ply"), up_in_world=(0.0, 0.0, 1.0)),
    )


def looking(at: tuple[float, float, float], towards: tuple[float, float, float]) -> Camera:
    eye = np.array(at, float)
    return Camera(Intrinsics(300, 200, 250, 250, 150, 100), look_at(eye, eye + towards, np.array([0.0, 0.0, 1.0])))


def test_a_scene_is_drawn_with_its_cameras_to_scale_and_two_opposite_renders() -> None:
    corners = np.array([[x, y, 0.0] for x in (0, 10) for y in (0, 4)])
    cameras = [looking((2, 1, 1), (1, 0, 0)), looking((6, 1, 1), (0, 1, 0)), looking((2, 3, 1), (0, -1, 0))]
    scene = scene_at(corners, [NamedCamera(f"{i}.jpg", camera) for i, camera in enumerate(cameras)])
    image = np.asarray(Image.open(BytesIO(drawn_scene(scene, COLOURED, cameras[:1], scene.info)))).astype(int)
    is_red = (image[:, :600] == RED).all(2)
    rows, columns = np.nonzero(is_red)
    # The plan is 540 pixels for 10 units, its lower left corner 30 from the left; the legend's dot is further down.
    shown = [
        np.hypot(columns - (30 + 54 * x), rows - (26 + 30 + 54 * (4 - y))).min() for x, y in ((2, 1), (6, 1), (2, 3))
    ]
    assert max(shown) < 3
    assert not is_red[56 : 56 + 216, 30 + 54 * 8 :].any()
    # The middle of the list looks along y; the other render is by the camera that looks along -y.
    first, second = image[26 + 10, 600 + 290], image[26 + 200 + 6 + 10, 600 + 290]
    assert first == pytest.approx([127.5, 255, 127.5], abs=1)
    assert second == pytest.approx([127.5, 0, 127.5], abs=1)


def test_a_plan_leaves_out_haze_unless_all_is_haze(monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[np.ndarray] = []
    plan = scene_drawing._plan

    def noted(surfaces: np.ndarray, *rest: Any) -> np.ndarray:
        shown.append(surfaces)
        return plan(surfaces, *rest)

    monkeypatch.setattr(scene_drawing, "_plan", noted)
    corners = np.array([[x, y, 0.0] for x in (0, 10) for y in (0, 4)])
    for opacities, kept in (([0.3, 0.31, 0.2, 0.9], [1, 3]), ([0.3] * 4, range(4))):
        scene = replace(scene_at(corners), opacities=np.array(opacities, np.float32))
        drawn_scene(scene, COLOURED, (), scene.info)
        assert np.array_equal(shown.pop(), corners[list(kept)])


def test_a_scene_without_views_or_extent_is_drawn_without_renders() -> None:
    scene = scene_at(np.zeros((1, 3)))
    image = np.asarray(Image.open(BytesIO(drawn_scene(scene, COLOURED, (), scene.info))))
    assert image.shape[1] == 600
