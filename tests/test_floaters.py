"""Floaters: planted ones are found and left out of localization; anything else stays, and what users see is whole."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from service.cli.scene_facts import as_lines, inspected_scene
from service.geometry import pose_distance
from service.loaded_scene import LoadedScene
from service.localize import localize
from service.pose.retrieval import floaters as module
from service.pose.retrieval.floaters import FLOATERS, find_floaters, veil, without_floaters
from service.render.cpu import CpuRasterizer
from service.results import Status
from service.scene_formats import load_scene
from service.types import Camera, GaussianScene, Intrinsics, Pose, Query
from tests.small_room import FOCAL, HEIGHT, WIDTH, pose_at, write_room

LENS = Intrinsics(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
NAMES = ("means", "quats", "scales", "opacities", "sh")


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> GaussianScene:
    return load_scene(write_room(tmp_path_factory.mktemp("floaters") / "room"))


def haze(count: int, low, high, size: float, opacity: float) -> dict[str, np.ndarray]:
    """Grey balls, evenly in a box."""
    rng = np.random.default_rng(5)
    return {
        "means": rng.uniform(low, high, (count, 3)),
        "quats": np.tile([1.0, 0, 0, 0], (count, 1)),
        "scales": np.full((count, 3), size),
        "opacities": np.full(count, opacity),
        "sh": rng.uniform(-1, 1, (count, 1, 3)),
    }


def with_more(scene: GaussianScene, *more: dict[str, np.ndarray]) -> GaussianScene:
    arrays = {n: np.concatenate([getattr(scene, n), *(part[n] for part in more)]).astype(np.float32) for n in NAMES}
    return replace(scene, **arrays)


@pytest.fixture(scope="module")
def veiled(room: GaussianScene) -> GaussianScene:
    """800 large faint ones and 80 small opaque ones, in the middle of the room."""
    reach = np.array([1.1, 0.9, 0.6])
    return with_more(room, haze(800, -reach, reach, 0.12, 0.03), haze(80, -reach, reach, 0.02, 0.9))


def test_planted_floaters_are_found_and_hidden_and_walls_are_not(room: GaussianScene, veiled: GaussianScene) -> None:
    found = find_floaters(veiled)
    assert found.left_out
    assert found.found[: room.count].mean() < 1e-3
    assert found.found[room.count :].mean() > 0.95
    hidden = without_floaters(veiled)
    assert np.array_equal(hidden.opacities == 0, found.found)
    assert hidden.means is veiled.means


def test_a_scene_without_a_veil_is_left_as_it_is(room: GaussianScene) -> None:
    assert without_floaters(room) is room
    few = with_more(room, haze(30, -0.6 * np.ones(3), 0.6 * np.ones(3), 0.1, 0.03))
    assert find_floaters(few).found[room.count :].all()
    assert without_floaters(few) is few


def test_a_thin_sky_is_no_floater_and_a_scene_without_cameras_is_not_examined(
    room: GaussianScene, veiled: GaussianScene
) -> None:
    rng = np.random.default_rng(0)
    sky = haze(200, -np.ones(3), np.ones(3), 2.0, 0.05)
    directions = rng.normal(size=(200, 3))
    sky["means"] = 60 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    assert not find_floaters(with_more(room, sky)).found.any()
    assert not find_floaters(replace(veiled, cameras=())).found.any()


def test_gaussians_larger_than_the_content_are_floaters_if_cameras_stand_in_them_and_they_hide_it(
    room: GaussianScene,
) -> None:
    """Whatever is in a cube as large as they are would support them; a sky of such is behind the content."""
    inside = haze(20, -0.5 * np.ones(3), 0.5 * np.ones(3), 20.0, 0.02)
    sky = haze(20, (900, -9, -9), (910, 9, 9), 600.0, 0.9)
    thin = haze(20, (-9, -9, 20), (9, 9, 21), 20.0, 0.5)
    thin["scales"][:, 2] = 0.5  # reaches over the room, but no camera stood in it
    found = find_floaters(with_more(room, inside, sky, thin))
    assert found.found[room.count :].tolist() == [True] * 20 + [False] * 40
    assert not found.found[: room.count].any()
    assert found.left_out


def test_the_veil_is_the_optical_depth_in_front_of_the_content(room: GaussianScene) -> None:
    """In a long box: density x opacity x 2 pi size^2 x length, the length that counts being 0.02 to 0.7 of 10 units."""
    wall = haze(4000, (-9, -9, 9.999), (9, 9, 10.001), 0.1, 0.95)
    count, box = 40_000, np.array([18.0, 18.0, 10.0])
    parts = [wall, haze(count, (-9, -9, 0), (9, 9, 10), 0.02, 0.1)]
    arrays = {name: np.concatenate([part[name] for part in parts]).astype(np.float32) for name in NAMES}
    scene = replace(room, **arrays)
    expected = count / box.prod() * 0.1 * 2 * np.pi * 0.02**2 * (FLOATERS.front_share - FLOATERS.near_share) * 10
    measured = veil(scene, np.arange(scene.count) >= 4000, [Camera(LENS, Pose(np.eye(4)))])
    assert measured == pytest.approx(expected, rel=0.1)  # seen: 0.03; chance: 1 / sqrt of a few thousand in view


def test_gaussians_at_one_place_are_examined(room: GaussianScene) -> None:
    one = replace(room, **{name: getattr(room, name)[[0, 0]] for name in NAMES})
    assert find_floaters(one).left_out is False


def test_cubes_are_of_the_gaussians_own_size_and_smaller_ones_up_to_the_usual_cell(monkeypatch) -> None:
    """Cells are a fortieth of the typical distance, 40, hence 1: a cube's side is 3, times a power of two."""
    asked: list[tuple[float, list[int]]] = []

    def around(means, areas, largest, side, who):
        asked.append((side / 3, who.tolist()))
        return np.where(who == 4, FLOATERS.min_support * side**2, 0.0)

    monkeypatch.setattr(module, "_area_around", around)
    middle = [2.0**-9, 0.3, 1.5, 9.0, 0.3, 200.0]
    scene = SimpleNamespace(
        means=np.zeros((6, 3), np.float32),
        scales=np.array([[1e-6, size, 2 * size] for size in middle], np.float32),
        opacities=np.full(6, 0.5, np.float32),
    )
    space = SimpleNamespace(distance=40.0, middle=np.zeros(3))
    found = module._supports(scene, space, np.arange(6), FLOATERS)  # type: ignore[arg-type]
    # From a 64th to 32 cells; the fifth is supported at the first level and asked no more.
    assert asked == [(1, [0, 1, 2, 4]), (8, [3]), (32, [5]), (0.5, [0, 1]), (0.25, [0, 1]), (0.125, [0])] + [
        (2.0**level, [0]) for level in (-4, -5, -6)
    ]
    assert found == pytest.approx([0, 0, 0, 0, FLOATERS.min_support, 0])


def test_areas_around_are_those_of_a_sum_over_all_pairs() -> None:
    rng = np.random.default_rng(1)
    means, areas, largest = rng.normal(size=(400, 3)), rng.uniform(size=400), rng.uniform(0, 2, 400)
    side, asked = 0.9, np.arange(0, 400, 7)
    got = module._area_around(means, areas, largest, side, asked)
    cells = np.floor(means / (side / 3))
    near = np.abs(cells[asked, None] - cells[None]).max(2) <= 1
    near[np.arange(len(asked)), asked] = False
    assert got == pytest.approx((near & (largest < side)) @ areas, abs=1e-9)


def test_a_veiled_scene_localizes_a_photo_and_is_shown_with_its_floaters(
    room: GaussianScene, veiled: GaussianScene
) -> None:
    """The photo is of the clean room, from between the training cameras.

    The answer is 0.014 units off (0.013 in the clean room), and 0.077 units and 1.6 degrees where floaters are left in.
    """
    truth = pose_at(0.4, 0.1)
    camera = Camera(LENS, truth)
    (frame,) = CpuRasterizer(room).render([camera])
    photo = np.rint(np.clip(frame.rgb, 0, 1) * 255).astype(np.uint8)
    loaded = LoadedScene.of(veiled)
    found = localize(Query(photo, LENS, "given", LENS), loaded)
    degrees, units = pose_distance(found.pose, truth)
    assert found.verdict.status is Status.LOCALIZED
    assert (degrees < 0.2, units < 0.03) == (True, True)
    searched, shown = (r.render([camera])[0].rgb for r in (loaded.rasterizer, loaded.for_display()))
    assert loaded.scene is veiled
    assert np.array_equal(shown, CpuRasterizer(veiled).render([camera])[0].rgb)
    assert np.abs(searched - frame.rgb).mean() < 0.2 * np.abs(shown - frame.rgb).mean()
    assert loaded.for_display() is loaded.for_display()


def test_inspection_tells_what_is_left_out(tmp_path, veiled: GaussianScene, monkeypatch) -> None:
    folder = write_room(tmp_path / "room")
    monkeypatch.setattr("service.cli.scene_facts.load_scene", lambda path: veiled)
    facts = inspected_scene(folder).facts
    assert facts["floaters"]["left_out"]
    assert facts["floaters"]["found"] == int(find_floaters(veiled).found.sum())
    assert "left out when photos are localized" in as_lines(facts)["floaters"]
