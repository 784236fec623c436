"""Planes behind which nobody photographed a scene: of a planted street, and of none that is small."""

from __future__ import annotations

import numpy as np
import pytest
from test_free_space import ball, scene_of

from service.geometry import rotation_from_quat
from service.pose.retrieval.free_space import free_space_of
from service.pose.retrieval.outer_planes import before_planes, ground_normal, outer_planes

TURN = rotation_from_quat(np.array([0.9, 0.3, -0.5, 0.2]))


def rectangle(rng: np.random.Generator, count: int, low: list[float], high: list[float]) -> np.ndarray:
    return rng.uniform(low, high, (count, 3)) + 0.01 * rng.standard_normal((count, 3))


def street(rng: np.random.Generator) -> np.ndarray:
    """A road of 60 x 6 at z = 0, facades of height 4 at y = -3 and 3, and what stands and floats between them."""
    return np.concatenate(
        [
            rectangle(rng, 4000, [0, -3, 0], [60, 3, 0]),
            rectangle(rng, 2500, [0, -3, 0], [60, -3, 4]),
            rectangle(rng, 2500, [0, 3, 0], [60, 3, 4]),
            rng.uniform([0, -3, 0], [60, 3, 4], (1000, 3)),
        ]
    )


@pytest.mark.parametrize("distance", [2.5, 6.0, 15.0])
def test_a_streets_ground_and_facades_are_outer_planes_wherever_it_lies(distance: float) -> None:
    """However wrong the typical distance is."""
    rng = np.random.default_rng(1)
    points = street(rng) @ TURN.T + [500.0, -20.0, 7.0]
    planes = outer_planes(points, distance)
    expected = np.array([[0, 0, 1.0], [0, 1.0, 0], [0, -1.0, 0]]) @ TURN.T
    assert len(planes) == 3
    assert sorted(np.argmax(planes[:, :3] @ expected.T, axis=1)) == [0, 1, 2]
    assert (planes[:, :3] @ expected.T).max(1).min() > 0.999
    up = ground_normal(planes)
    assert up is not None
    assert up @ expected[0] > 0.999

    def inside(at: list[float]) -> bool:
        return bool(before_planes(np.array([at]) @ TURN.T + [500.0, -20.0, 7.0], planes)[0])

    assert inside([30, 0, 0.5])
    assert inside([30, -2.5, 9.0])  # above the roofs, as a drone is
    assert inside([-9, 0, 0.5])
    assert not inside([30, 0, -0.5])
    assert not inside([30, 3.5, 2])
    assert not inside([30, -3.5, 2])


@pytest.mark.parametrize(
    ("normals", "up"),
    [
        ([[0, 0, 1], [0, 1, 0], [0, -1, 0]], [0, 0, 1]),  # a street
        ([[0, 1, 0], [0, 0, -1], [0, -1, 0]], [0, 0, -1]),
        ([[0, 0, 1], [0, 0, -1], [0, 1, 0], [0, -1, 0]], None),  # a corridor with its ceiling
        ([[0, 0, 1], [0, 1, 0]], None),  # one row of houses: either may be the ground
        ([[0, 0, 1], [0, 1, 0], [0, -1, 0], [1, 0, 0]], None),  # a yard that is open at one side
        ([[0, 0, 1]], None),
        ([], None),
    ],
)
def test_the_ground_is_the_one_plane_without_another_opposite(normals: list, up: list | None) -> None:
    found = ground_normal(np.array([[*normal, 1.0] for normal in normals]).reshape(-1, 4))
    assert (found is None) == (up is None)
    assert found is None or np.array_equal(found, up)


@pytest.mark.parametrize("distance", [2.0, 4.0])
def test_the_faces_of_a_cube_and_the_walls_of_a_room_are_none(distance: float) -> None:
    """An object is photographed from outside of its faces; the walls of a room are no longer than it is wide."""
    rng = np.random.default_rng(2)
    cube = rng.uniform(-1, 1, (9000, 3))
    cube[np.arange(9000), np.arange(9000) % 3] = np.sign(rng.standard_normal(9000))
    assert len(outer_planes(cube, distance)) == 0


def test_a_wall_between_two_halls_is_none() -> None:
    rng = np.random.default_rng(3)
    halls = rng.uniform([0, -9, 0], [90, 9, 4], (6000, 3))
    wall = rectangle(rng, 4000, [0, 0, 0], [90, 0, 4])
    planes = outer_planes(np.concatenate([halls, wall]), 6.0)
    assert before_planes(np.array([[45.0, -4, 2], [45.0, 4, 2]]), planes).all()


def test_few_points_or_all_at_one_place_have_none() -> None:
    assert outer_planes(np.zeros((3, 3)), 1.0).shape == (0, 4)
    assert outer_planes(np.zeros((500, 3)), 1.0).shape == (0, 4)
    assert outer_planes(np.empty((0, 3)), 1.0).shape == (0, 4)


def test_a_shell_of_sky_has_no_part_in_the_grid() -> None:
    """A fortieth of all points, at ten times the length: the grid would be one of the sky."""
    rng = np.random.default_rng(4)
    points = street(rng)
    sizes = np.full((len(points), 3), 0.006)  # as seen from 5 away
    alone = free_space_of(scene_of(points, sizes))
    sky = np.concatenate([points, 600.0 * ball(250) + [30.0, 0, 0]])
    under = free_space_of(scene_of(sky, np.concatenate([sizes, np.full((250, 3), 20.0)])))
    assert under.cell == pytest.approx(alone.cell, rel=0.05)
    assert np.allclose(under.low, alone.low, atol=0.2)
    assert len(under.planes) == len(alone.planes) == 3
    assert under.is_up_known
    assert under.up @ [0, 0, 1] > 0.999
    assert not free_space_of(scene_of(ball(500), np.full((500, 3), 0.006))).is_up_known
