"""Where a scene is free, and from how far it was photographed: of planted walls and sizes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from service.pose.retrieval.free_space import SPACE, Space, fibonacci_directions, free_space_of
from service.types import GaussianScene, SceneInfo


def space_of(filled: np.ndarray, cell: float = 0.5, distance: float = 1.0) -> Space:
    points = np.zeros((1, 3))
    up = np.array([0.0, 0.0, 1.0])
    return Space(
        points,
        np.ones(1),
        np.array([1.0, 2.0, 3.0]),
        cell,
        filled,
        np.zeros(3),
        1.0,
        up,
        True,
        distance,
        np.empty((0, 4)),
    )


def scene_of(means: np.ndarray, sizes: np.ndarray, opacity: float | np.ndarray = 0.9, **info: Any) -> GaussianScene:
    count = len(means)
    return GaussianScene(
        means.astype(np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        sizes.astype(np.float32),
        np.broadcast_to(np.float32(opacity), count).copy(),
        np.zeros((count, 1, 3), np.float32),
        SceneInfo("s", "s", "0" * 64, "ply", **info),
    )


def ball(count: int, radius: float = 1.0) -> np.ndarray:
    """Points evenly spread on a sphere."""
    return radius * fibonacci_directions(count)


# ------------------------------------------------------------------ the grid


def test_a_place_is_occupied_in_filled_cells_and_nowhere_outside() -> None:
    filled = np.zeros((3, 4, 5), bool)
    filled[0, 0, 0] = filled[2, 3, 4] = True
    low = np.array([1.0, 2.0, 3.0])
    cells = np.array([[0, 0, 0], [2, 3, 4], [1, 1, 1], [-1, 0, 0], [0, -1, 0], [3, 3, 4], [2, 4, 4], [2, 3, 5]])
    found = space_of(filled).occupied(low + 0.5 * (cells + 0.5))
    assert found.tolist() == [True, True, *[False] * 6]
    # A cell begins at its lower corner.
    edges = space_of(filled).occupied(low + np.array([[0.0, 0.0, 0.0], [-1e-6, 0.0, 0.0], [0.5, 0.0, 0.0]]))
    assert edges.tolist() == [True, False, False]


@pytest.mark.parametrize(("wall", "distance"), [(3, 1.5), (5, 2.5), (9, 4.0), (None, 4.0)])
def test_a_ray_is_free_up_to_a_wall_or_as_far_as_asked(wall: int | None, distance: float) -> None:
    """The wall is so many cells of 0.5 away; the next two may be of the surface that the ray leaves."""
    filled = np.zeros((20, 1, 1), bool)
    filled[:2] = True
    if wall:
        filled[wall] = True
    starts = np.array([[1.0 + 0.01, 2.1, 3.1]])
    found = space_of(filled).free_distance(starts, np.array([[1.0, 0, 0]]), reach=4.0)
    assert found == pytest.approx([distance])
    filled[2] = True  # one cell more is a wall of its own
    assert space_of(filled).free_distance(starts, np.array([[1.0, 0, 0]]), reach=4.0) == pytest.approx([1.0])


def test_an_enclosure_is_the_share_of_directions_that_are_closed() -> None:
    closed = np.ones((21, 21, 21), bool)
    closed[1:-1, 1:-1, 1:-1] = False
    middle = np.array([[1.0, 2.0, 3.0]]) + 0.5 * 10.5
    assert space_of(closed).enclosures(middle) == pytest.approx([1.0])
    roofless = closed.copy()
    roofless[:, :, 11:] = False
    assert space_of(roofless).enclosures(middle)[0] == pytest.approx(0.5, abs=0.1)
    assert space_of(np.zeros_like(closed)).enclosures(middle) == pytest.approx([0.0])
    # To the farthest corner: a long hall is closed at its ends, too.
    hall = np.ones((61, 5, 5), bool)
    hall[1:-1, 1:-1, 1:-1] = False
    assert space_of(hall).enclosures(np.array([[1.0, 2.0, 3.0]]) + 0.5 * np.array([[30.5, 2.5, 2.5]])) == [1.0]


@pytest.mark.parametrize(("cells", "wanted"), [(10, 200.0), (100, 1000.0), (1000, 1200.0)])
def test_good_views_are_as_many_as_the_surfaces_have_area(cells: int, wanted: float) -> None:
    """Forty for each square of the typical distance: of 0.5 a cell, one cell is a quarter of it."""
    filled = np.zeros((1000, 1, 1), bool)
    filled[:cells] = True
    assert space_of(filled).wanted_good_views == wanted
    farther = replace(space_of(filled), distance=2.0)
    assert farther.wanted_good_views == max(200.0, min(1200.0, 40 * 0.25 * cells / 4))


def test_directions_are_evenly_spread() -> None:
    for count in (32, 500):
        found = fibonacci_directions(count)
        assert np.linalg.norm(found, axis=1) == pytest.approx(np.ones(count))
        assert np.abs(found.mean(0)).max() < 0.02
        # Of directions evenly spread over a sphere.
        assert np.allclose(found.T @ found / count, np.eye(3) / 3, atol=0.03)
        nearest = np.sort(found @ found.T, axis=1)[:, -2]
        # Each has a share 4 pi / n of the sphere: no neighbour is nearer than about half a square's side.
        assert np.degrees(np.arccos(nearest)).min() > 0.5 * np.degrees(np.sqrt(4 * np.pi / count))


# ------------------------------------------------------------------ of a scene


@pytest.mark.parametrize(
    ("info", "focal"),
    [
        ({}, 1000.0),
        ({"training_long_side_px": 800}, 800.0),
        ({"training_long_side_px": 800, "training_focal_px": 500.0}, 500.0),
    ],
)
def test_a_gaussian_of_about_a_pixel_tells_its_distance(info: dict[str, Any], focal: float) -> None:
    """Its middle size fills 1.2 px of its photos: seen from z with the focal length f it is 1.2 z / f large."""
    distances = np.linspace(0.9, 1.1, 300)
    sizes = np.stack([1e-4 * np.ones(300), 1.2 * distances / focal, 10 * np.ones(300)], 1)
    found = free_space_of(scene_of(ball(300), sizes, **info))
    inner = slice(30, 270)  # the largest and smallest tenth are taken for background and noise
    assert found.distances[inner] == pytest.approx(distances[inner], rel=0.01)
    assert found.distances.min() == pytest.approx(np.quantile(distances, 0.1), rel=0.01)
    assert found.distances.max() == pytest.approx(np.quantile(distances, 0.9), rel=0.01)
    assert found.distance == pytest.approx(1.0, rel=0.01)
    assert found.radius == pytest.approx(1.0, rel=0.01)


def test_large_gaussians_are_not_taken_for_far_ones() -> None:
    found = free_space_of(scene_of(ball(300), np.full((300, 3), 1.0)))
    assert found.distance == pytest.approx(2 * found.radius)
    assert found.distances.max() == pytest.approx(5 * found.radius)


@pytest.mark.parametrize(("opacity", "count"), [(0.29, 200), (0.31, 500)])
def test_faint_gaussians_are_no_surface(opacity: float, count: int) -> None:
    means = np.concatenate([ball(200), 3 * ball(300)])
    scene = scene_of(means, np.full((500, 3), 0.001), np.r_[np.full(200, 0.9), np.full(300, opacity)])
    assert len(free_space_of(scene).points) == count


def test_a_scene_of_haze_alone_has_its_points_nevertheless() -> None:
    found = free_space_of(scene_of(ball(200), np.full((200, 3), 0.001), 0.1))
    assert len(found.points) == 200
    assert found.up.tolist() == [0, 0, 1]
    turned = free_space_of(scene_of(ball(200), np.full((200, 3), 0.001), up_in_world=(0.0, -1.0, 0.0)))
    assert turned.up.tolist() == [0, -1, 0]


def test_a_room_is_closed_and_its_inside_free() -> None:
    """A box with walls of 40 x 40 points a side, floaters far outside, and single points inside, which are no walls."""
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 40)] * 2), -1).reshape(-1, 2)
    walls = np.concatenate([np.insert(grid, axis, side, axis=1) for axis in range(3) for side in (-1.0, 1.0)])
    floaters = 50 * ball(20)
    dust = np.random.default_rng(0).uniform(-0.8, 0.8, (12, 3))
    means = np.concatenate([walls, floaters, dust])
    found = free_space_of(scene_of(means, np.full((len(means), 3), 0.002)))
    assert found.cell < 0.2  # fine, whatever is far outside
    assert found.occupied(walls).mean() > 0.95
    assert not found.occupied(dust).any()
    assert not found.occupied(np.zeros((1, 3))).any()
    assert found.enclosures(np.zeros((1, 3)))[0] > 0.95
    toward = found.free_distance(np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0]]), reach=5.0)
    assert toward[0] == pytest.approx(1.0, abs=1.5 * found.cell)
    assert found.middle == pytest.approx(np.zeros(3), abs=0.1)


def test_more_points_than_are_kept_are_thinned_evenly(monkeypatch: pytest.MonkeyPatch) -> None:
    from service.pose.retrieval import free_space

    monkeypatch.setattr(free_space, "SPACE", replace(SPACE, max_points=100))
    means = np.stack([np.arange(250.0), np.zeros(250), np.zeros(250)], 1)
    found = free_space_of(scene_of(means, np.full((250, 3), 0.001)))
    assert np.array_equal(found.points[:, 0], np.arange(0, 250, 3))
