"""Parts of reading and keeping scenes, by values worked out by hand: sizes, origins, checks, normalizations, limits."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from stand_ins import make_scene

from service.errors import CorruptScene, SceneTooLarge
from service.scene_formats import checkpoint, folder, ply, sog
from service.scene_formats.frame_candidates import _TURNS, FLIP
from service.scene_formats.gaussians import (
    MAX_COORDINATE,
    MAX_GAUSSIANS,
    RawGaussians,
    checked,
    cut_sh,
    joined,
    require_count,
    sh_from_channel_major,
    sh_from_rgb,
)
from service.scene_formats.manifest import Manifest
from service.scene_formats.normalizations import (
    _focus,
    _orientation,
    _principal_axes,
    gsplat_normalizations,
    nerfstudio_normalization,
    nerfstudio_normalizations,
    rotation_between,
)
from service.scene_formats.recentring import Extent, extent_of, near_plane_for, origin_for, recentred
from service.scene_formats.size_estimate import estimated_bytes
from service.scene_manager.entry import Entry
from service.scene_manager.memory_limit import MemoryLimit
from service.scene_manager.splat_sample import importance, packed_splats
from service.types import SH_C0, Camera, Intrinsics, NamedCamera, Pose


def raw(count: int = 4, coefficients: int = 1) -> RawGaussians:
    return RawGaussians(
        means=np.arange(3 * count, dtype=np.float32).reshape(count, 3),
        quats=np.tile(np.float32([2, 0, 0, 0]), (count, 1)),
        scales=np.ones((count, 3), np.float32),
        opacities=np.full(count, 0.9, np.float32),
        sh=np.ones((count, coefficients, 3), np.float32),
    )


# ------------------------------------------------------------------ sizes


@pytest.mark.parametrize("rest", [0, 9, 45])
def test_a_scene_takes_two_copies_of_its_numbers(tmp_path, rest):
    """3 + 4 + 3 + 1 numbers of four bytes, and three for each harmonic, by the header alone."""
    names = ["x", "y", "z", *(f"rot_{i}" for i in range(4)), *(f"scale_{i}" for i in range(3)), "opacity"]
    names += [*(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(rest))]
    properties = "".join(f"property float {name}\n" for name in names)
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex 1000\n{properties}end_header\n"
    path = tmp_path / "scene.ply"
    path.write_bytes(head.encode() + bytes(4 * len(names) * 1000))
    assert estimated_bytes(path) == 2 * 1000 * 4 * len(names)
    (tmp_path / "scene.splat").write_bytes(bytes(32 * 7))
    assert estimated_bytes(tmp_path / "scene.splat") == 2 * 7 * 4 * 14


# ------------------------------------------------------------------ origins and near planes


@pytest.mark.parametrize(("away", "moves"), [(199.0, False), (200.0, False), (201.0, True)])
def test_a_scene_beyond_two_hundred_radii_gets_an_origin(away, moves):
    middle = np.array([0.0, 2 * away, 0.0])
    assert origin_for(Extent(middle, 2.0)) == ((0.0, 2 * away, 0.0) if moves else (0.0, 0.0, 0.0))
    assert origin_for(Extent(middle, 0.0)) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("radius", "near"), [(0.01, 0.001), (0.1, 0.01), (5.0, 0.01), (100.0, 0.01), (1000.0, 0.1), (0.0, 0.01)]
)
def test_the_near_plane_goes_with_the_size_of_unusual_scenes(radius, near):
    assert near_plane_for(Extent(np.zeros(3), radius)) == pytest.approx(near)


def test_the_extent_is_that_of_the_opaque_gaussians():
    few = raw(5)
    few = replace(few, means=np.float32([[0, 0, 0], [1, 0, 0], [3, 0, 0], [90, 0, 0], [91, 0, 0]]))
    opaque = replace(few, opacities=np.float32([0.6, 0.51, 0.9, 0.5, 0.1]))
    found = extent_of(opaque)
    assert (found.middle.tolist(), found.radius) == ([1.0, 0.0, 0.0], 1.0)
    haze = extent_of(replace(few, opacities=np.full(5, 0.5, np.float32)))
    assert (haze.middle[0], haze.radius) == (3.0, 3.0)
    far = replace(few, means=few.means.astype(np.float64) + np.array([1e7, 0, 0]))
    assert recentred(far, (1e7, 0.0, 0.0)).means.tolist() == few.means.tolist()


# ------------------------------------------------------------------ checks


def test_a_file_has_some_gaussians_and_not_more_than_any_scene():
    for count in (1, MAX_GAUSSIANS):
        require_count(count, "x")
    for count, says in ((0, "empty"), (MAX_GAUSSIANS + 1, "the limit is 20000000")):
        with pytest.raises(CorruptScene, match=says):
            require_count(count, "x")


def test_lengths_up_to_a_milliard_are_used_and_quaternions_become_unit():
    good = raw()
    good.means[1, 2] = good.scales[2, 0] = MAX_COORDINATE
    good.scales[3] = 0
    good.quats[0] = 3, 0, 4, 0
    found = checked(good, "x")
    assert found.warnings == ()
    assert found.quats[:2].tolist() == [pytest.approx([0.6, 0, 0.8, 0]), [1, 0, 0, 0]]
    for name, value in (("means", 1.01e9), ("means", -1.01e9), ("scales", 1.01e9), ("scales", -1e-9), ("sh", np.inf)):
        bad = raw()
        getattr(bad, name)[2].flat[0] = value
        found = checked(bad, "x")
        assert len(found.means) == len(found.quats) == 3
        assert found.warnings[0].startswith("1 of 4 Gaussians have ")
        assert "the first is number 2" in found.warnings[0]


def test_a_file_of_which_half_is_bad_is_broken():
    for count, broken in ((1, False), (2, True)):
        bad = raw()
        bad.opacities[:count] = np.nan
        if broken:
            with pytest.raises(
                CorruptScene, match="2 of 4 Gaussians have non-finite opacities or the like, the first is number 0"
            ):
                checked(bad, "x")
        else:
            assert len(checked(bad, "x").means) == 3


def test_parts_of_a_file_are_joined_whatever_their_harmonics():
    one, other = raw(2, 4), replace(raw(3, 1), warnings=("a", "b"))
    assert joined([one]) is one
    found = joined([replace(one, warnings=("b",)), other])
    assert found.sh.shape == (5, 4, 3)
    assert found.sh[:, 0].min() == found.sh[:2].min() == 1
    assert np.count_nonzero(found.sh[2:, 1:]) == 0
    assert found.means.tolist() == [*one.means.tolist(), *other.means.tolist()]
    assert len(found.quats) == len(found.scales) == len(found.opacities) == 5
    assert found.warnings == ("b", "a")


def test_harmonics_beyond_degree_3_are_left_out_with_a_warning():
    for count, kept, warnings in ((16, 16, 0), (25, 16, 1), (1, 1, 0)):
        found, told = cut_sh(raw(2, count).sh)
        assert (found.shape[1], len(told)) == (kept, warnings)


def test_colours_and_harmonics_are_laid_out_as_documented():
    assert sh_from_rgb(np.float32([[0.5, 0.5 + SH_C0, 0.5 - SH_C0]])) == pytest.approx(np.float32([[[0, 1, -1]]]))
    rest = sh_from_channel_major(np.float32([[1, 2, 3, 4, 5, 6]]))
    assert rest.tolist() == [[[1, 3, 5], [2, 4, 6]]]


def test_a_checkpoints_numbers_are_activated_and_logits_of_colours_become_coefficients():
    arrays = {
        "means": np.zeros((2, 3), np.float32), "quats": np.ones((2, 4), np.float32),
        "scales": np.log(np.float32([[1, 2, 3], [4, 5, 6]])), "opacities": np.float32([0, np.log(3)]),
        "sh0": np.float32([[[0, np.log(3), -np.log(3)]]] * 2),
    }  # fmt: skip
    found = checkpoint._gaussians(arrays, True, "x")
    assert found.scales == pytest.approx(np.float32([[1, 2, 3], [4, 5, 6]]))
    assert found.opacities == pytest.approx([0.5, 0.75])
    # Colours of 1/2, 3/4 and 1/4.
    assert 0.5 + SH_C0 * found.sh[0, 0] == pytest.approx([0.5, 0.75, 0.25])
    assert np.array_equal(checkpoint._gaussians(arrays, False, "x").sh, arrays["sh0"])
    for shape, fits in (
        ((2, 3, 3), True),
        ((2, 24, 3), True),
        ((2, 4, 3), False),
        ((3, 3, 3), False),
        ((2, 3, 2), False),
    ):
        more = arrays | {"shN": np.zeros(shape, np.float32)}
        if fits:
            assert checkpoint._gaussians(more, False, "x").sh.shape[1] == min(1 + shape[1], 16)
        else:
            with pytest.raises(CorruptScene, match="'shN' has the shape"):
                checkpoint._gaussians(more, False, "x")
    with pytest.raises(CorruptScene, match="'quats' has the shape"):
        checkpoint._gaussians(arrays | {"quats": np.ones((2, 3), np.float32)}, False, "x")


# ------------------------------------------------------------------ headers


@pytest.mark.parametrize(
    ("comment", "up"),
    [
        ("Vertical Axis: z", (0, 0, 1)), ("vertical axis: X", (1, 0, 0)), ("Vertical Axis y", (0, 1, 0)),
        ("Vertical Axis: w", None), ("Vertical: z", None), ("The Vertical Axis: z", None),
    ],
)  # fmt: skip
def test_the_up_axis_is_that_of_nerfstudios_comment(comment, up):
    assert ply._up(("by somebody", comment)) == up


@pytest.mark.parametrize(
    ("comments", "mode"),
    [
        (("SplatRenderMode: mip",), "antialiased"), (("SplatRenderMode: default",), "default"),
        (("SplatRenderMode: 2dgs",), "2dgs"), (("antialiased 1",), "antialiased"), (("antialiased 0",), "default"),
        (("antialiased 7",), None), (("antialiased 1", "antialiased 7"), "antialiased"),
        (("antialiased 1", "SplatRenderMode: default"), "default"), (("antialiased",), None), ((), None),
    ],
)  # fmt: skip
def test_the_last_comment_tells_the_render_mode(comments, mode):
    assert ply._render_mode(comments) == mode


def webp(kind: bytes, rest: bytes) -> bytes:
    return b"RIFF" + bytes(4) + b"WEBP" + kind + bytes(4) + rest


def test_a_lossless_pictures_size_is_read_from_its_header():
    """By the container's specification: less one, in 24 bits each, or in 14 bits each after the signature."""
    extended = webp(b"VP8X", bytes(4) + (640 - 1).to_bytes(3, "little") + (70_000 - 1).to_bytes(3, "little"))
    assert sog._size(extended, "x") == (640, 70_000)
    lossless = webp(b"VP8L", b"\x2f" + struct.pack("<I", (640 - 1) | (480 - 1) << 14 | 1 << 28) + bytes(5))
    assert sog._size(lossless, "x") == (640, 480)
    for broken in (
        lossless[:29],
        b"RIFX" + lossless[4:],
        lossless[:8] + b"WEBQ" + lossless[12:],
        webp(b"VP8 ", bytes(20)),
    ):
        with pytest.raises(CorruptScene, match="not a lossless WebP"):
            sog._size(broken, "x")


# ------------------------------------------------------------------ frames


def test_the_turns_are_the_rotations_of_a_cube_the_usual_ones_first():
    turns = [matrix[:3, :3] for matrix in _TURNS.values()]
    assert len({matrix.tobytes() for matrix in turns}) == 23
    for matrix in turns:
        assert np.linalg.det(matrix) == pytest.approx(1)
        assert np.abs(matrix).sum() == 3
        assert not np.array_equal(matrix, np.eye(3))
    quarter = cv2.Rodrigues(np.array([np.pi / 2, 0, 0]))[0].round()
    usual = (FLIP[:3, :3], quarter, quarter.T)
    assert all(any(np.array_equal(turn, one) for one in usual) for turn in turns[:3])
    assert _TURNS["world axes x, y, z are x, -y, -z"].tolist() == FLIP.tolist()
    assert (_TURNS["world axes x, y, z are y, z, x"] @ [1, 2, 3, 1]).tolist() == [2, 3, 1, 1]


def cameras(*poses: np.ndarray) -> np.ndarray:
    return np.stack(poses)


def camera(right: Any, down: Any, position: Any = (0, 0, 0)) -> np.ndarray:
    """A camera by its x and y axes."""
    matrix = np.eye(4)
    matrix[:3, :4] = np.stack([right, down, np.cross(right, down), position], 1)
    return matrix


C, S = np.cos(0.3), np.sin(0.3)
LEVEL = cameras(
    camera([1, 0, 0], [0, -S, -C]),
    camera([0, 1, 0], [0, 0, -1]),
    camera([-1, 0, 0], [0, 0, -1]),
    camera([0, -1, 0], [S, 0, -C]),
)
"""Held level, z up; two of them look down."""


def test_level_cameras_tell_up_by_their_x_axes():
    mean_up = -LEVEL[:, :3, 1].mean(0)
    assert (_orientation(LEVEL, "up") @ mean_up / np.linalg.norm(mean_up)) == pytest.approx([0, 0, 1])
    assert _orientation(LEVEL, "vertical") == pytest.approx(np.eye(3), abs=1e-9)
    assert _orientation(LEVEL, "none").tolist() == np.eye(3).tolist()
    # Upside down they tell the other way.
    below = np.diag([1.0, -1.0, -1.0, 1.0]) @ LEVEL
    assert _orientation(below, "vertical") @ [0, 0, -1] == pytest.approx([0, 0, 1])


def test_of_parallel_cameras_up_is_level_to_their_common_axis():
    """All x axes are (0.6, 0, 0.8): up is the mean up without its part along them."""
    right, other = np.array([0.6, 0, 0.8]), np.array([-0.8, 0, 0.6])
    y = np.array([0.0, 1.0, 0.0])
    poses = cameras(*(camera(right, -(np.cos(a) * y + np.sin(a) * other)) for a in (0.0, 0.2, 0.4)))
    tilted = poses.copy()
    tilted[:, :3, 1] += 0.5 * right  # axes that aren't quite square
    up = np.cos(0.2) * y + np.sin(0.2) * other
    assert _orientation(tilted, "vertical") @ up == pytest.approx([0, 0, 1])


def test_the_principal_axes_of_cameras_have_the_longest_first_and_up_above():
    positions = np.array([[5, 0, 0], [-5, 0, 0], [0, 2, 0], [0, -2, 0], [0, 0, 1], [0, 0, -1.0]])
    poses = cameras(*(camera([1, 0, 0], [0, 0, -1], p) for p in positions))
    turned = _orientation(poses, "pca")
    assert np.linalg.det(turned) == pytest.approx(1)
    assert np.abs(turned) == pytest.approx(np.eye(3))
    assert (turned @ [0, 0, 1])[2] > 0


@pytest.mark.parametrize(("centre", "away"), [("poses", (4, 0, 0)), ("focus", (3, 0, 2)), ("none", (0, 0, 0))])
def test_nerfstudio_centres_and_scales_as_it_documents(centre, away):
    """Two cameras look at (3, 0, 2), a third away from it."""
    poses = cameras(
        camera([0, 1, 0], [0, 0, -1], (1, 0, 2)),
        camera([0, 0, 1], [0, -1, 0], (3, 0, 2 - 9)),
        camera([0, 1, 0], [0, 0, -1], (8, 0, 5)),
    )
    poses[0, :3, :3] = np.stack([[0, -1, 0], [0, 0, -1], [1, 0, 0]], 1)
    poses[1, :3, :3] = np.stack([[1, 0, 0], [0, 1, 0], [0, 0, 1]], 1)
    poses[2, :3, :3] = np.stack([[0, -1, 0], [0, 0, -1], [1, 0, 0]], 1)
    found = nerfstudio_normalization(poses, "none", centre, False)
    assert found[:3, :3].tolist() == np.eye(3).tolist()
    assert -found[:3, 3] == pytest.approx(away)
    scaled = nerfstudio_normalization(poses, "none", centre, True)
    moved = poses[:, :3, 3] @ scaled[:3, :3].T + scaled[:3, 3]
    assert np.abs(moved).max() == pytest.approx(1)


def test_cameras_that_look_away_or_are_parallel_have_no_part_in_the_focus():
    ahead = np.stack([[0, -1, 0], [0, 0, -1], [1, 0, 0]], 1)
    parallel = np.tile(np.eye(4), (2, 1, 1))
    parallel[:, :3, :3] = ahead
    assert _focus(parallel, np.array([7.0, 7, 7])).tolist() == [7, 7, 7]


def test_every_combination_of_nerfstudios_options_is_tried_but_for_the_identity():
    names = [name for name, _ in nerfstudio_normalizations(LEVEL)]
    # With pca each of the four sets of signs that right-handed eigenvectors may have.
    assert len(names) == len(set(names)) == 2 * (3 + 4) * 3 - 1
    assert names[0] == "nerfstudio's normalization (orientation up, centre poses, scaled)"


def test_gsplats_principal_axes_are_those_of_the_points():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(4000, 3)) * [1.0, 5.0, 0.2] + [3, 4, 5]
    axes = _principal_axes(points)
    assert np.linalg.det(axes[:3, :3]) == pytest.approx(1)
    moved = points @ axes[:3, :3].T + axes[:3, 3]
    assert moved.std(0) == pytest.approx([5, 1, 0.2], rel=0.05)
    assert np.abs(axes[:3, :3] @ np.median(points, 0) + axes[:3, 3]).max() < 1e-9
    poses = LEVEL.copy()
    poses[:, :3, 3] = [[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -2, 0]]
    assert len(list(gsplat_normalizations(poses, None))) == len(list(gsplat_normalizations(poses, points[:3]))) == 4
    found = dict(gsplat_normalizations(poses, points))
    assert len(found) == 4 + 4 * 4
    by_cameras = found["gsplat's normalization (centre focus)"]
    turned = found["gsplat's normalization (centre focus, principal axes)"]
    seen = points @ turned[:3, :3].T + turned[:3, 3]
    assert np.median(seen, 0) == pytest.approx(np.zeros(3), abs=0.05)
    scale = np.cbrt(np.linalg.det(by_cameras[:3, :3]))
    assert seen.std(0) == pytest.approx(scale * np.array([5, 1, 0.2]), rel=0.05)
    upside_down = found["gsplat's normalization (centre focus, principal axes, upside down)"]
    assert upside_down == pytest.approx(np.diag([1, -1, -1, 1]) @ turned)


@pytest.mark.parametrize("target", [(0, 0, 1), (0, 0, -1), (0.6, 0, -0.8), (0, 1, 0)])
def test_the_least_rotation_takes_one_direction_to_another(target):
    source, target = np.array([0.0, 0.0, 1.0]), np.array(target, np.float64)
    found = rotation_between(source, target)
    assert found @ source == pytest.approx(target)
    assert found @ found.T == pytest.approx(np.eye(3))
    assert np.linalg.det(found) == pytest.approx(1)
    angle = np.arccos(np.clip(source @ target, -1, 1))
    assert np.linalg.norm(cv2.Rodrigues(found)[0]) == pytest.approx(angle)
    assert rotation_between(source, -source, FLIP[:3, :3]) is not None


# ------------------------------------------------------------------ a folder's cameras


def named(width: int, fx: float, position: Any = (0, 0, 0)) -> NamedCamera:
    pose = np.eye(4)
    pose[:3, 3] = position
    return NamedCamera(f"{width}", Camera(Intrinsics(width, width // 2, fx, fx, width / 2, width / 4), Pose(pose)))


def test_up_is_turned_with_the_manifest_and_stays_a_unit_vector():
    turned = np.eye(4)
    turned[:3, :3] = 2 * np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    moved = replace(Manifest(), world_from_scene=turned)
    assert folder._up((0.0, 0.0, 1.0), moved) == (1.0, 0.0, 0.0)
    assert folder._up((0.0, 0.0, 1.0), Manifest()) == (0.0, 0.0, 1.0)
    assert folder._up(None, moved) is None


def test_sizes_and_focal_lengths_are_those_of_most_photos():
    each = (named(800, 700.0), named(400, 300.0), named(800, 900.0))
    assert folder._median_size(each) == (800, 400)
    assert folder._median_size(()) is None
    assert folder._training_focal_px(each, None) == 700.0
    # At 400 pixels: 350, 300 and 450.
    assert folder._training_focal_px(each, (400, 200)) == 350.0
    assert folder._training_focal_px((), (400, 200)) is None


# ------------------------------------------------------------------ what is kept in memory


class Loaded:
    nbytes = 10


def entry(name: str, state: Any, used: float = 0.0, **changes: Any) -> Entry:
    made = Entry(name, Path("x"), state, used=used)
    if state == "ready":
        made.loaded = Loaded()  # type: ignore[assignment]
    made.measured_bytes = 10
    for key, value in changes.items():
        setattr(made, key, value)
    return made


def test_those_that_fit_are_what_is_there_then_the_most_recently_used():
    there, old, new = entry("there", "ready"), entry("old", "unloaded", 1.0), entry("new", "unloaded", 2.0)
    gone = entry("gone", "unloaded", 9.0, wanted=False)
    failed, coming = entry("failed", "failed", 8.0), entry("coming", "loading", 0.5)
    everything = [there, old, new, gone, failed, coming]
    for most, expected in (
        (10, ["there"]),
        (19, ["there"]),
        (20, ["there", "new"]),
        (40, ["there", "new", "old", "coming"]),
    ):
        assert [e.id for e in MemoryLimit(most).that_fit(everything)] == expected
    # What jobs use stays beside them.
    busy = entry("busy", "ready", jobs=1)
    busy.state = "unloading"  # type: ignore[assignment]
    assert [e.id for e in MemoryLimit(20).that_fit([there, busy, new])] == ["there"]
    assert [e.id for e in MemoryLimit(30).that_fit([there, busy, new])] == ["there", "new"]
    none = MemoryLimit(None)
    assert [e.id for e in none.that_fit(everything)] == ["there"]
    assert [e.id for e in none.that_fit([old, coming])] == ["coming"]
    assert [e.id for e in none.that_fit([old, failed, gone])] == ["old"]


def test_scenes_that_are_searched_together_fit_together():
    first, second = entry("a", "unloaded"), entry("b", "unloaded")
    MemoryLimit(20).require_together([first, second])
    MemoryLimit(None).require_together([first, second])
    with pytest.raises(SceneTooLarge, match=r"the 2 scenes take 0\.0 MB"):
        MemoryLimit(19).require_together([first, second])
    with pytest.raises(SceneTooLarge, match="scene 'a' takes"):
        MemoryLimit(9).require_together([first, second])
    MemoryLimit(9).require_together([entry("a", "ready"), entry("b", "ready")])  # they are there


# ------------------------------------------------------------------ the most important Gaussians


def test_importance_is_opacity_times_surface_over_the_median_squared_distance():
    scene = make_scene()
    scene = getattr(scene, "scene", scene)
    two = replace(
        scene, means=np.float32([[0, 0, 0], [0, 0, 10]]), scales=np.float32([[1, 2, 3], [1, 2, 3]]),
        quats=np.tile(np.float32([1, 0, 0, 0]), (2, 1)), opacities=np.float32([0.5, 1.0]),
        sh=np.zeros((2, 1, 3), np.float32), cameras=(),
    )  # fmt: skip
    assert importance(two).tolist() == [5.5, 11.0]
    at = tuple(named(64, 50.0, (0, 0, z)) for z in (1.0, 2.0, 3.0))
    # Squared distances 1, 4, 9 and 81, 64, 49.
    assert importance(replace(two, cameras=at)) == pytest.approx([5.5 / 4, 11 / 64])
    # Of 32 cameras every second one.
    many = tuple(named(64, 50.0, (0, 0, 1.0 if k % 2 == 0 else 100.0)) for k in range(32))
    assert importance(replace(two, cameras=many)) == pytest.approx([5.5, 11 / 81])
    data = packed_splats(replace(two, cameras=at), 1)
    (length,) = struct.unpack_from("<I", data)
    header = json.loads(data[4 : 4 + length])
    assert length % 4 == 0
    assert (header["count"], header["total"]) == (1, 2)
    numbers = np.frombuffer(data, "<f4", 9, 4 + length)
    assert numbers.tolist() == [0, 0, 0, 1, 0, 0, 4, 0, 9]
    assert list(data[4 + length + 36 :]) == [128, 128, 128, 128]
