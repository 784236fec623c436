"""Views placed by the scene itself, in scenes whose inside, walls and haze are known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from service.bench.render import ROOM, synthetic_room
from service.geometry import look_at
from service.interfaces import Frame, Tools
from service.matchers import MATCHERS
from service.pose.retrieval.free_space import _steps_in_the_clear, fibonacci_directions, free_space_of
from service.pose.retrieval.index_builder import IndexBuilder
from service.pose.retrieval.lod_proxy import LOD, LodConfig, OccludedRenderer, lod_proxy, occlusion_depths
from service.pose.retrieval.view_placement import (
    PlacementConfig,
    _Views,
    coverage,
    find_views,
    search_camera,
    shows_single_surface,
)
from service.render.cpu import CpuRasterizer
from service.types import Camera, GaussianScene

COUNT = 6000


FEW = PlacementConfig(shell_candidates=12, volume_candidates=60, size_candidates=60, best=20, min_views=16)
"""As many candidates as these small scenes need."""


def test_steps_end_before_what_is_filled_and_nothing_is_outside() -> None:
    """By hand, in a grid of ten cells a side with a wall at x = 7."""
    filled = np.zeros((10, 10, 10), bool)
    filled[7] = True
    starts = np.array([[2.5, 5.5, 5.5]] * 4)
    diagonal = np.array([1.0, 1.0, 0.0]) / np.sqrt(2)
    directions = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 0, 1], diagonal])
    # Two cells away is x = 4.5, three steps on 7.5; on the diagonal the grid ends at y = 10, where x is 7: not met.
    assert _steps_in_the_clear(filled, starts, directions, 2.0, 50).tolist() == [3, 50, 50, 50]
    assert _steps_in_the_clear(filled, starts, directions, 2.0, 2).tolist() == [2, 2, 2, 2]
    assert _steps_in_the_clear(filled, starts, directions, 5.0, 50).tolist() == [0, 50, 50, 50]


def closed_room(count: int = COUNT) -> GaussianScene:
    """Walls and furniture without the bench's loose Gaussians in the air."""
    room = synthetic_room(count)
    names = ("means", "quats", "scales", "sh")
    walls = {n: getattr(room, n)[: count - count // 10] for n in names}
    return replace(room, **walls, opacities=np.full(count - count // 10, 0.95, np.float32))


def joined(*scenes: GaussianScene) -> GaussianScene:
    names = ("means", "quats", "scales", "opacities", "sh")
    return replace(scenes[0], **{n: np.concatenate([getattr(s, n) for s in scenes]) for n in names})


def changed(scene: GaussianScene, scale: float, shift: tuple[float, float, float]) -> GaussianScene:
    means = scene.means * scale + np.array(shift)
    return replace(scene, means=means.astype(np.float32), scales=scene.scales * np.float32(scale))


def blobs(positions: np.ndarray, size: float) -> GaussianScene:
    """Opaque balls."""
    few = synthetic_room(len(positions))
    ones = np.ones(len(positions), np.float32)
    scales = np.full((len(positions), 3), size, np.float32)
    return replace(few, means=positions.astype(np.float32), scales=scales, opacities=0.95 * ones)


def places(scene: GaussianScene, seed: int = 0) -> tuple[np.ndarray, float, bool]:
    found = find_views(scene, CpuRasterizer(scene), np.random.default_rng(seed), FEW)
    positions = np.stack([camera.pose.position_in_world for camera in found.cameras])
    return positions, found.coverage, found.interior


def test_pixels_show_single_opaque_surfaces() -> None:
    ones = np.ones((10, 10), np.float32)
    rgb = np.zeros((10, 10, 3), np.float32)
    assert shows_single_surface(Frame(rgb, ones, 2 * ones, 2 * ones), 0.5).all()
    assert not shows_single_surface(Frame(rgb, ones, 2.5 * ones, 2 * ones), 0.5).any()  # behind a translucent one
    assert not shows_single_surface(Frame(rgb, ones, 0.3 * ones, 0.3 * ones), 0.5).any()  # nose to a floater
    assert not shows_single_surface(Frame(rgb, 0.6 * ones, 2 * ones, 2 * ones), 0.5).any()


@pytest.mark.parametrize(
    ("enclosures", "good", "interior"),
    [
        # Half of the best view's share of solid pixels is enough; a view of nothing is not good where all are such.
        ([0.0] * 5, [0, 1], False),
        # Of solid views alone: the last ones' enclosure says nothing.
        ([0.6, 0.6, 0.9, 0.9, 0.9], [0, 1], False),
        ([1.0, 0.7, 0.9, 0.9, 0.9], [0, 1], True),
        ([1.0, 0.5, 0.9, 0.9, 0.9], [0], True),
        ([0.9, 0.8, 0.0, 0.0, 0.0], [0, 1], True),
        ([0.9, 0.79, 0.0, 0.0, 0.0], [0, 1], False),
        ([0.85, 0.5, 0.0, 0.0, 0.0], [0], True),
        # As open as a bowl: no room, though a view near its bottom is closed.
        ([0.95, 0.6, 0.0, 0.0, 0.0], [0, 1], False),
    ],
)
def test_good_views_by_hand(enclosures: list[float], good: list[int], interior: bool) -> None:
    room = synthetic_room(500)
    config = replace(FEW, score_quantile=1.0, enclosure_quantile=1.0)
    views = _Views(free_space_of(room), CpuRasterizer(room), config)
    views.scores, views._enclosures = [0.8, 0.4, 0.39, 0.1, 0.0], enclosures
    assert views.good().tolist() == good
    assert views.interior is interior
    views.scores = [0.0] * 5
    assert views.good().tolist() == []


@pytest.mark.parametrize(("scale", "shift"), [(1.0, (0, 0, 0)), (0.01, (5, -3, 2)), (300.0, (1e4, 0, 0))])
def test_a_closed_room_is_seen_from_inside_whatever_its_unit(scale, shift) -> None:
    room = closed_room()
    positions, seen, interior = places(changed(room, scale, shift))
    inside = np.abs((positions - shift) / scale) < ROOM / 2
    assert interior
    assert inside.all(1).mean() > 0.9
    assert seen > 0.9


def test_views_without_an_up_direction_are_upright_by_z_and_by_minus_y() -> None:
    """Every place has an image that is level with z up; where -y up rolls it by more than features bear, another."""
    room = closed_room()
    unknown = replace(room, info=replace(room.info, up_in_world=None))
    known = replace(room, info=replace(room.info, up_in_world=(0.0, 0.0, 1.0)))
    found = {
        name: [c.pose.world_from_camera for c in find_views(s, CpuRasterizer(s), np.random.default_rng(0), FEW).cameras]
        for name, s in (("unknown", unknown), ("known", known))
    }
    # An image is level if its x axis is horizontal.
    assert all(abs(pose[2, 0]) < 1e-9 for pose in found["known"])
    by_z = [pose for pose in found["unknown"] if abs(pose[2, 0]) < 1e-9]
    by_y = [pose for pose in found["unknown"] if abs(pose[1, 0]) < 1e-9 and pose[1, 1] > 0]
    assert np.array_equal(by_z, found["known"])
    assert len(by_y) > 0.6 * len(by_z)
    places = {tuple(pose[:3, 3]) for pose in by_z}
    assert all(tuple(pose[:3, 3]) in places for pose in by_y)


def test_two_rooms_get_views_each() -> None:
    room = closed_room()
    positions, seen, _ = places(joined(room, changed(room, 1.0, (9.0, 0, 0))))
    first = (positions[:, 0] < 4.5).mean()
    assert 0.3 < first < 0.7
    assert seen > 0.85


def test_an_object_before_a_far_background_is_looked_at() -> None:
    """A third of the Gaussians are a shell 40 radii away, as trainers make of a sky; the photos had 64 px."""
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    scene = joined(blobs(directions[:2700], 0.04), blobs(40 * directions[2700:], 1.6))
    scene = replace(scene, info=replace(scene.info, training_long_side_px=64))
    found = find_views(scene, CpuRasterizer(scene), np.random.default_rng(0), FEW)
    views = [c.pose for c in found.cameras]
    near = [v for v in views if np.linalg.norm(v.position_in_world) < 8]
    at_it = [v for v in near if -v.position_in_world @ v.axis_in_world > 0.8 * np.linalg.norm(v.position_in_world)]
    assert len(at_it) >= 10
    assert min(np.linalg.norm(v.position_in_world) for v in views) > 1.0  # none in the object


def test_a_hollow_object_is_looked_at_from_outside() -> None:
    """A bowl, three quarters of a sphere: from its middle three quarters of all directions are closed."""
    sphere = fibonacci_directions(COUNT)
    positions, seen, interior = places(blobs(sphere[sphere[:, 2] < 0.5], 0.03))
    assert not interior
    assert seen > 0.9
    # All around, and from as far as photos of the whole are taken; 60 degrees wide, they show it whole from 2 on.
    away = np.linalg.norm(positions, axis=1)
    octants = {tuple(p > 0) for p in positions[away > 1.5]}
    assert len(octants) == 8
    assert (away > 2).any()


def test_best_views_from_afar_by_hand() -> None:
    """Candidates at one and at four radii, of which the far ones show more background."""
    scene = blobs(fibonacci_directions(500), 0.03)
    config = replace(FEW, score_quantile=1.0, enclosure_quantile=1.0)
    views = _Views(free_space_of(scene), CpuRasterizer(scene), config)
    places = [[1.0, 0, 0], [0, 1.0, 0], [4.0, 0, 0], [0, 4.0, 0]]
    views.poses = [look_at(np.array(place), np.zeros(3), np.array([0, 0, 1.0])) for place in places]
    views.scores, views._enclosures = [0.8, 0.39, 0.2, 0.09], [0.0] * 4
    assert views.good().tolist() == [0]
    assert views.good(or_best_from_afar=True).tolist() == [0, 2]


def test_no_view_is_inside_a_cloud_of_floaters() -> None:
    room = closed_room()
    rng = np.random.default_rng(2)
    cloud = blobs(np.array([0.0, -0.5, 0.0]) + rng.uniform(-0.5, 0.5, (1500, 3)), 0.08)
    positions, _, _ = places(joined(room, cloud))
    within = np.all(np.abs(positions - [0.0, -0.5, 0.0]) < 0.5, axis=1)
    assert not within.any()


def test_the_same_seed_finds_the_same() -> None:
    room = synthetic_room(2000)
    assert np.array_equal(places(room, 3)[0], places(room, 3)[0])


def test_coverage_is_the_share_that_is_seen() -> None:
    """A camera before one of two walls, back to back and far apart."""
    rng = np.random.default_rng(0)
    wall = np.concatenate([rng.uniform(-1, 1, (4000, 2)), np.full((4000, 1), 3.0)], 1)
    scene = joined(blobs(wall, 0.06), blobs(wall - [0, 0, 6], 0.06))
    pose = look_at(np.zeros(3), np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0]))
    assert coverage(scene, CpuRasterizer(scene), [Camera(search_camera(64), pose)]) == pytest.approx(0.5, abs=0.03)


def test_a_thinned_scene_is_as_closed_and_as_far() -> None:
    scene = closed_room(40_000)
    whole = CpuRasterizer(scene)
    thin = lod_proxy(scene, whole, np.random.default_rng(0), LodConfig(proxy_gaussians=8000))
    assert isinstance(thin, CpuRasterizer)
    assert thin.scene.count == pytest.approx(8000, rel=0.05)
    up = np.array([0.0, 0.0, 1.0])
    camera = Camera(search_camera(64), look_at(np.array([0.0, -1.0, 0.0]), np.array([3.0, 1.0, -0.5]), up))
    a, b = whole.render([camera])[0], thin.render([camera])[0]
    assert b.alpha.mean() > 0.95 * a.alpha.mean()
    assert np.median(np.abs(a.median_depth - b.median_depth) / a.median_depth) < 0.08


@pytest.mark.parametrize(("count", "simplified"), [(500_000, False), (500_001, True)])
def test_only_scenes_of_more_than_half_a_million_gaussians_are_simplified(count: int, simplified: bool) -> None:
    """As docs/results/scale.md says, by 200,000 of them; a stand-in for the renderer notes what it is given."""
    one = blobs(np.zeros((1, 3)), 0.01)
    names = ("means", "quats", "scales", "opacities", "sh")
    many = {name: np.broadcast_to(getattr(one, name), (count, *getattr(one, name).shape[1:])) for name in names}
    made, rendered = [], []

    class Noting:
        def of(self, scene: GaussianScene) -> Noting:
            made.append(scene.count)
            return self

        def render(self, cameras: list[Camera], **options: object) -> list[Frame]:
            rendered.append((cameras[0].intrinsics.long_side, options.get("occlusion_depths") is not None))
            shape = cameras[0].intrinsics.height, cameras[0].intrinsics.width
            return [Frame(np.zeros((*shape, 3), np.float32), *3 * [np.ones(shape, np.float32)])]

    renderer: Any = Noting()
    scene = replace(one, **many)
    pose = look_at(np.zeros(3), np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0]))
    OccludedRenderer(scene, renderer, np.random.default_rng(0)).render([Camera(search_camera(160), pose)])
    if simplified:
        assert made == [pytest.approx(200_000, rel=0.01)]
        assert rendered == [(64, False), (160, True)]
    else:
        assert made == []
        assert rendered == [(160, False)]


def test_a_horizon_lies_behind_what_hides_and_nowhere_where_one_sees_through() -> None:
    """A wall at 3 with a gap and a pane at 2 before it, half of a nearer board beside them; by hand."""
    alpha, depth = np.ones((8, 16), np.float32), np.full((8, 16), 3.0, np.float32)
    depth[:, :4] = 2.0
    alpha[:, 10] = 0.5
    median = depth.copy()
    depth[:, 14], median[:, 14] = 2.4, 2.0  # two fifths of the light come through the pane
    found = occlusion_depths(Frame(np.zeros((8, 16, 3), np.float32), alpha, depth, median))
    assert np.allclose(found[:, :3], 2 * LOD.behind_factor)
    assert np.allclose(found[:, [*range(3, 9), 12]], 3 * LOD.behind_factor)  # column 3 looks past the board's edge
    assert np.all(np.isinf(found[:, 9:12]))
    assert np.all(found[:, 13:] > 3 * LOD.behind_factor)


class Watched(CpuRasterizer):
    """Keeps what it drew with occlusion depths, and of how many Gaussians."""

    def __init__(self, scene: GaussianScene) -> None:
        super().__init__(scene)
        self.drawn: list[tuple[np.ndarray, int]] = []

    def of(self, scene: GaussianScene) -> CpuRasterizer:
        return CpuRasterizer(scene)

    def render(self, cameras, approximate=False, occlusion_depths=None):
        frames = super().render(cameras, approximate, occlusion_depths)
        if occlusion_depths:
            self.drawn.append((frames[0].rgb, self._scratch().visible))
        return frames


def test_views_of_a_large_scene_show_all_that_is_seen_but_not_what_walls_hide() -> None:
    """A room with a second one behind its wall, of whose Gaussians not one has to be drawn."""
    room = closed_room(30_000)
    scene = joined(room, changed(room, 1.0, (2.2 * ROOM[0], 0.0, 0.0)))
    eye, up = np.array([-0.5, 0.2, 0.0]), np.array([0.0, 0.0, 1.0])
    camera = Camera(search_camera(160), look_at(eye, eye + np.array([1.0, 0.1, -0.1]), up))
    watched, alone = Watched(scene), CpuRasterizer(room)
    tools = Tools(scene, watched, MATCHERS.load("sift").create(), np.random.default_rng(0), None)
    IndexBuilder([camera], tools, LodConfig(proxy_gaussians=20_000, min_gaussians=30_000)).whole()
    ((rgb, drawn),) = watched.drawn
    truth = alone.render([camera])[0].rgb
    visible = alone._scratch().visible
    watched.render([camera])
    assert watched._scratch().visible > 1.3 * visible
    assert drawn <= visible
    assert np.abs(rgb - truth).mean() < 0.01
