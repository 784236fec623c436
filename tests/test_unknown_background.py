"""Backgrounds that no file tells: planted ones are found out by the photo, and only where they show."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service.bench.render import synthetic_room
from service.geometry import look_at, pose_distance
from service.loaded_scene import WHITE_ASSUMED, LoadedScene
from service.localize import localize
from service.pose.features.unknown_background import WHITE, has_white_border, shows_background
from service.render.cpu import CpuRasterizer
from service.results import Status
from service.types import Camera, GaussianScene, Intrinsics, NamedCamera, Query

LENS = Intrinsics(320, 240, 300.0, 300.0, 160.0, 120.0)
BLACK = (0.0, 0.0, 0.0)
PLACE = np.array([2.0, -2.2, 1.1])
"""Of the photo."""


@pytest.mark.parametrize(("white_columns", "expected"), [(100, True), (60, True), (30, False), (0, False)])
def test_half_of_the_border_decides(white_columns: int, expected: bool) -> None:
    """Columns of 100 that are white; a grey rest."""
    rgb = np.full((100, 100, 3), 120, np.uint8)
    rgb[:, :white_columns] = 252
    assert has_white_border(rgb) is expected


def test_the_middle_and_invalid_pixels_decide_nothing() -> None:
    rgb = np.full((100, 100, 3), 120, np.uint8)
    rgb[5:-5, 5:-5] = 255
    assert not has_white_border(rgb)
    padded = np.full((100, 100, 3), 255, np.uint8)
    assert not has_white_border(padded, np.zeros((100, 100), bool))


@pytest.mark.parametrize(("level", "expected"), [(250, True), (249, False)])
def test_white_begins_at_250_in_each_channel(level: int, expected: bool) -> None:
    rgb = np.full((100, 100, 3), 255, np.uint8)
    rgb[..., 1] = level
    assert has_white_border(rgb) is expected


@pytest.mark.parametrize(("grey", "expected"), [(392, True), (393, False)])
def test_the_border_is_a_fiftieth_of_the_long_side_and_half_of_it_is_white(grey: int, expected: bool) -> None:
    """Of 100 x 100 pixels two on each side: 784."""
    rgb = np.full((100, 100, 3), 255, np.uint8)
    row, column = np.nonzero(np.minimum.reduce(np.broadcast_arrays(*_from_border(100))) < 2)
    assert len(row) == 784
    rgb[row[:grey], column[:grey]] = 0
    rgb[2:-2, 2:-2] = 0
    assert has_white_border(rgb) is expected


def _from_border(side: int) -> tuple[np.ndarray, ...]:
    near = np.minimum(np.arange(side), np.arange(side)[::-1])
    return near[:, None], near[None, :]


@pytest.mark.parametrize(
    ("uncovered", "alpha", "expected"), [(0.05, 0.49, True), (0.049, 0.49, False), (0.05, 0.5, False), (1.0, 0.0, True)]
)
def test_a_twentieth_less_than_half_opaque_shows_background(uncovered: float, alpha: float, expected: bool) -> None:
    """In the median of eight views or so, at 64 pixels."""
    sizes: list[int] = []

    def render(cameras: list[Camera], approximate: bool) -> list[SimpleNamespace]:
        sizes.extend(camera.intrinsics.long_side for camera in cameras)
        shown = np.ones(1000)
        shown[: round(1000 * uncovered)] = alpha
        # A third of the views shows none, or nothing else.
        odd = np.ones(1000) if expected else np.zeros(1000)
        return [SimpleNamespace(alpha=odd if n % 3 == 1 else shown) for n in range(len(cameras))]

    cameras = [Camera(LENS, look_at(PLACE, np.zeros(3), np.array([0.0, 0, 1])))] * 17
    rasterizer: Any = SimpleNamespace(render=render)
    assert shows_background(rasterizer, cameras) is expected
    assert sizes == [64] * 9
    assert not shows_background(rasterizer, [])


def ball(count: int = 4000) -> GaussianScene:
    """A ball with spots of many colours, photographed from one side; no file tells its background."""
    rng = np.random.default_rng(0)
    places = rng.normal(size=(count, 3))
    places /= np.linalg.norm(places, axis=1, keepdims=True)
    spots = rng.normal(size=(150, 3))
    spots /= np.linalg.norm(spots, axis=1, keepdims=True)
    colours = rng.uniform(-1.5, 1.5, (150, 3))[np.argmax(places @ spots.T, axis=1)]
    few = synthetic_room(count)
    around = PLACE + 0.8 * rng.normal(size=(10, 3))
    eyes = [look_at(3.5 * d / np.linalg.norm(d), np.zeros(3), np.array([0.0, 0, 1])) for d in around]
    return replace(
        few,
        means=places.astype(np.float32),
        scales=np.full((count, 3), 0.025, np.float32),
        opacities=np.full(count, 0.97, np.float32),
        sh=colours[:, None].astype(np.float32),
        info=replace(few.info, background_rgb=BLACK, background_is_known=False, training_focal_px=300.0),
        cameras=tuple(NamedCamera(str(i), Camera(LENS, pose)) for i, pose in enumerate(eyes)),
    )


@pytest.fixture(scope="module")
def loaded() -> LoadedScene:
    return LoadedScene.of(ball(), rasterizer="cpu")


@pytest.mark.parametrize("background", [WHITE, BLACK])
def test_a_photo_over_either_background_is_localized(loaded: LoadedScene, background: tuple) -> None:
    """The photo is a render over the planted background, from between the cameras; the answer says what is assumed."""
    truth = look_at(PLACE, np.array([0.1, 0, 0]), np.array([0.0, 0, 1]))
    (frame,) = loaded.rasterizer.over(background).render([Camera(LENS, truth)])
    rgb = np.rint(np.clip(frame.rgb, 0, 1) * 255).astype(np.uint8)
    found = localize(Query(rgb, LENS, "given", LENS), loaded)
    degrees, units = pose_distance(found.pose, truth)
    assert found.verdict.status is Status.LOCALIZED
    assert degrees < 0.2  # seen: 0.02 degrees, 0.002 units
    assert units < 0.02
    assert (WHITE_ASSUMED in found.warnings) is (background == WHITE)


def test_what_a_file_says_is_not_doubted_and_a_room_has_no_background() -> None:
    white = Query(np.full((240, 320, 3), 255, np.uint8), LENS, "given", LENS)
    told = ball(500)
    told = LoadedScene.of(replace(told, info=replace(told.info, background_is_known=True)), rasterizer="cpu")
    assert told.as_seen_by(white) is told
    room = synthetic_room(4000)
    eye = Camera(LENS, look_at(np.zeros(3), np.array([1.0, 0.2, 0]), np.array([0.0, 0, 1])))
    info = replace(room.info, background_is_known=False)
    full = LoadedScene.of(replace(room, info=info, cameras=(NamedCamera("0", eye),)), rasterizer="cpu")
    assert full.as_seen_by(white) is full


def test_another_background_costs_no_memory_and_shows_where_nothing_is() -> None:
    scene = ball(500)
    black = CpuRasterizer(scene)
    white = black.over(WHITE)
    camera = scene.cameras[0].camera
    (over_black,), (over_white,) = black.render([camera]), white.render([camera])
    assert white.packed is black.packed
    assert np.allclose(over_white.rgb, over_black.rgb + (1 - over_black.alpha[..., None]), atol=1e-5)
