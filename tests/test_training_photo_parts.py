"""The parts of training photos' digests: corners, triangulation, patches and their pose, at thresholds and by hand."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from service.estimators import patch_stage
from service.geometry import look_at, moved, project, transformed
from service.interfaces import Frame, SurfacePoints
from service.pose.refinement.refinement_config import REFINEMENT
from service.pose.training_photos import digest as digest_module
from service.pose.training_photos import effect, patch_matching, patch_pose
from service.pose.training_photos.corners import (
    CORNERS,
    SurfaceCorners,
    _corners,
    cells_of,
    surface_corners,
    take_in_turns,
)
from service.pose.training_photos.digest import DIGEST, PhotoDigest, TrainingPhoto, _Refined, _Sample
from service.pose.training_photos.digest_file import read_digest, write_digest
from service.pose.training_photos.patch_matching import matched, predicted
from service.pose.training_photos.patch_pose import PATCH_POSE, PatchPose, _chosen, _combined, _solved, _weights
from service.pose.training_photos.surface_points import (
    TRIANGULATION,
    PosedPhoto,
    _neighbours,
    _on_surface,
    _triangulate,
)
from service.results import Reason, Status, Verdict
from service.types import Camera, Intrinsics, NamedCamera, Pose

LENS = Intrinsics(640, 480, 500.0, 480.0, 320.0, 240.0)
HERE = Pose(np.eye(4))
POSE = moved(HERE, np.array([0.1, -0.2, 0.15, 0.3, -0.2, 0.1]))


def points_at(
    positions: np.ndarray, tangents: np.ndarray | None = None, photo_position: tuple[float, ...] = (0.0, 0.0, 0.0)
) -> SurfacePoints:
    count = len(positions)
    tangents = np.zeros((count, 3, 2)) if tangents is None else tangents
    return SurfacePoints(
        np.asarray(positions, np.float64), np.zeros((count, 3, 3), np.float32), tangents.astype(np.float32),
        np.zeros((count, 20, 20), np.uint8), np.zeros(count, np.int32), np.array([photo_position], np.float64),
    )  # fmt: skip


# ------------------------------------------------------------------ corners


def test_cells_are_squares_and_elements_are_taken_in_turns() -> None:
    px = np.array([[0.0, 0.0], [9.99, 0.0], [10.0, 0.0], [25.0, 31.0]])
    assert cells_of(px, 80, 8).tolist() == [0, 0, 1, 26]
    groups = np.array([5, 5, 5, 1, 1, 9])
    assert take_in_turns(groups, 3).tolist() == [0, 3, 5]
    assert take_in_turns(groups, 5).tolist() == [0, 1, 3, 4, 5]
    assert take_in_turns(groups, 9).tolist() == [0, 1, 2, 3, 4, 5]


def dots(places: list[tuple[int, int]], values: list[int], size: tuple[int, int] = (80, 100)) -> np.ndarray:
    photo = np.zeros(size, np.uint8)
    for (column, row), value in zip(places, values, strict=True):
        photo[row - 1 : row + 2, column - 1 : column + 2] = value
    return photo


def test_corners_are_the_strongest_within_eight_pixels_and_no_weak_ones() -> None:
    places = [(30, 40), (50, 40), (70, 40)]
    strength = cv2.cornerMinEigenVal(dots(places, [100] * 3), 5, ksize=3)[40, 30]
    # Eigenvalues grow with the contrast squared: 3e-5 lies between these.
    faint, visible = (int(100 * np.sqrt(bound / strength)) for bound in (2.6e-5, 3.4e-5))
    found = _corners(dots(places, [faint, visible + 1, 200]), None, CORNERS)
    assert found.tolist() == [[70.0, 40.0], [50.0, 40.0]]
    near, apart = (_corners(dots([(30, 40), (30 + d, 40)], [255, 150]), None, CORNERS) for d in (6, 14))
    assert near.tolist() == [[30.0, 40.0]]
    assert apart.tolist() == [[30.0, 40.0], [44.0, 40.0]]


def test_patches_lie_within_the_photo_and_what_is_valid() -> None:
    """Ten pixels and one more on each side."""
    for place, found in (((11, 40), 1), ((10, 40), 0), ((88, 40), 1), ((89, 40), 0), ((50, 11), 1), ((50, 10), 0),
                         ((50, 68), 1), ((50, 69), 0)):  # fmt: skip
        assert len(_corners(dots([place], [255]), None, CORNERS)) == found, place
    for spoilt, found in (((50, 29), 0), ((50, 28), 1), ((50, 51), 0), ((50, 52), 1), ((39, 40), 0), ((38, 40), 1)):
        valid = np.ones((80, 100), bool)
        valid[spoilt[1], spoilt[0]] = False
        assert len(_corners(dots([(50, 40)], [255]), valid, CORNERS)) == found, spoilt


def corners_of(depth: np.ndarray, alpha: float = 1.0) -> SurfaceCorners:
    """Of a photo with a dot at (60, 60), twice as large as its render."""
    frame = Frame(np.zeros((*depth.shape, 3), np.float32), np.full(depth.shape, alpha, np.float32),
                  depth.astype(np.float32), depth.astype(np.float32))  # fmt: skip
    half = Intrinsics(60, 50, 50.0, 50.0, 30.0, 25.0)
    return surface_corners(dots([(60, 60)], [255], (100, 120)), None, frame, Camera(half, HERE))


def test_a_corner_has_the_depth_and_the_slope_of_the_render() -> None:
    """The inverse depth of a plane is linear in the image."""
    row, column = np.mgrid[:50, :60]
    found = corners_of(1 / (0.5 + 0.002 * column - 0.001 * row))
    assert found.px.tolist() == [[60.0, 60.0]]
    assert found.depth == pytest.approx([1 / (0.5 + 0.002 * 30 - 0.001 * 30)], rel=1e-5)
    assert np.allclose(found.slope, [[0.001, -0.0005]], atol=1e-6)
    assert found.patches.shape == (1, 20, 20)
    assert np.all(found.patches[0, 9:12, 9:12] == 255)
    assert found.patches[0].sum() == 9 * 255


@pytest.mark.parametrize(("jump", "count"), [(1.11, 1), (1.13, 0)])
def test_a_corner_at_a_depth_edge_is_left_out(jump: float, count: int) -> None:
    for edge in (29, 31):
        depth = np.full((50, 60), 2.0)
        depth[:, edge:] = 2.0 * jump
        assert len(corners_of(depth).px) == count
    assert len(corners_of(np.where(np.arange(60) < 28, 4.0, 2.0) * np.ones((50, 1))).px) == 1


def test_a_corner_needs_opaque_surface() -> None:
    assert len(corners_of(np.full((50, 60), 2.0), 0.51).px) == 1
    assert len(corners_of(np.full((50, 60), 2.0), 0.5).px) == 0
    empty = corners_of(np.zeros((50, 60)))
    assert len(empty.px) == 0
    assert empty.patches.shape == (0, 20, 20)


# ------------------------------------------------------------------ triangulation


def test_a_patchs_pixels_are_steps_on_the_surface() -> None:
    px, depth, slope = np.array([[100.0, 300.0], [400.0, 50.0]]), np.array([2.0, 3.0]), np.array([[1e-3, -2e-3]] * 2)
    corners = SurfaceCorners(px, depth, slope, np.zeros((2, 20, 20), np.uint8))
    found = _on_surface(3, corners, depth, Camera(LENS, POSE))

    def place(offset: np.ndarray) -> np.ndarray:
        z = 1 / (1 / depth + slope @ offset)
        at = px + offset
        local = np.stack([(at[:, 0] - LENS.cx) / LENS.fx * z, (at[:, 1] - LENS.cy) / LENS.fy * z, z], 1)
        return transformed(POSE.world_from_camera, local)

    assert np.allclose(found.points_in_world, place(np.zeros(2)))
    for axis, step in enumerate(1e-3 * np.eye(2)):
        assert np.allclose(found.tangents[:, :, axis], (place(step) - place(-step)) / 2e-3, rtol=1e-4, atol=1e-6)
    assert found.photo.tolist() == [3, 3]
    assert np.allclose(found.photo_positions, [POSE.position_in_world])


CENTRE = np.array([0.0, 0.0, 4.0])


def turned(angle_deg: float, distance: float = 4.0) -> Camera:
    """A camera that looks at CENTRE, from another direction."""
    angle = np.radians(angle_deg)
    position = CENTRE - distance * np.array([np.sin(angle), 0.0, np.cos(angle)])
    return Camera(LENS, look_at(position, CENTRE, np.array([0.0, -1.0, 0.0])))


def triangulated(offsets_px: np.ndarray, missing: tuple[int, ...] = ()):
    """A point that five cameras see, the first at offsets_px[0] from the right place, and so on."""
    cameras, points = [turned(5.0 * n) for n in range(5)], CENTRE[None] + 0.1
    seen = (
        np.stack([project(transformed(c.pose.camera_from_world, points), LENS) for c in cameras]) + offsets_px[:, None]
    )
    seen[list(missing)] = np.nan
    return points[0], cameras, _triangulate(points + np.array([0.05, -0.03, 0.2]), seen, cameras, TRIANGULATION)


def test_a_point_is_triangulated_with_its_covariance() -> None:
    point, cameras, found = triangulated(np.zeros((5, 2)))
    assert np.allclose(found.points[0], point, atol=1e-4)
    assert found.rms_px[0] < 0.02
    information = np.zeros((3, 3))
    for camera in cameras:
        ends = [project(transformed(camera.pose.camera_from_world, point + s * np.eye(3)), LENS) for s in (1e-5, -1e-5)]
        jacobian = (ends[0] - ends[1]).T / 2e-5
        information += jacobian.T @ jacobian
    assert np.allclose(found.covariances[0], 0.3**2 * np.linalg.inv(information), rtol=1e-2)


@pytest.mark.parametrize(
    ("wrong", "missing", "supported"),
    [
        ({}, (1, 2), True),  # three see it
        ({}, (1, 2, 3), False),
        ({4: 30.0}, (), True),
        ({4: 30.0, 3: 30.0}, (), True),
        ({4: 30.0, 3: -30.0, 2: 60.0}, (), False),
        ({0: 30.0}, (), False),  # not its own photo
    ],
)
def test_a_point_needs_three_photos_and_its_own(wrong: dict[int, float], missing: tuple[int, ...], supported) -> None:
    offsets = np.zeros((5, 2))
    for view, off in wrong.items():
        offsets[view, 1] = off
    assert triangulated(offsets, missing)[2].is_supported[0] == supported


def test_errors_count_up_to_a_pixel_and_seven_tenths_in_the_mean() -> None:
    """Two photos are 0.9 px below, two above, one in between: with the point in the middle, 0.9 * sqrt(4 / 5) = 0.8."""
    pattern = np.zeros((5, 2))
    pattern[1:, 1] = [1.0, -1.0, -1.0, 1.0]
    for off, supported in ((0.75, True), (0.82, False)):  # 0.67 and 0.73
        found = triangulated(off * pattern)[2]
        assert found.rms_px[0] == pytest.approx(off * np.sqrt(0.8), abs=0.02)
        assert found.is_supported[0] == supported
    lone = np.zeros((5, 2))
    lone[4, 1] = 1.6  # alone it is outvoted, and then left out of the mean
    assert triangulated(lone)[2].rms_px[0] < 0.4


def test_neighbours_show_the_points_at_useful_angles_small_ones_first() -> None:
    rng = np.random.default_rng(0)
    points = CENTRE + rng.uniform(-0.3, 0.3, (40, 3))
    angles = [0.0, 1.0, 30.0, 3.0, 10.0, 60.0, 6.0, -15.0, -22.0, 25.0]
    photos = [PosedPhoto(np.zeros((480, 640), np.uint8), turned(angle)) for angle in angles]
    aside = Camera(LENS, moved(turned(8.0).pose, np.array([0, 1.5, 0, 0, 0, 0])))
    behind = Camera(LENS, moved(turned(8.0).pose, np.array([0, np.pi, 0, 0, 0, 0])))
    photos += [PosedPhoto(np.zeros((480, 640), np.uint8), camera) for camera in (aside, behind)]
    assert _neighbours(0, points, photos, TRIANGULATION) == [3, 6, 4, 7, 8, 9]
    assert _neighbours(0, points, photos[:6], TRIANGULATION) == [3, 4, 2]
    assert _neighbours(0, points[:0], photos, TRIANGULATION) == []
    # Of 100 points a camera shows 8, or 9.
    for shown, found in ((8, []), (9, [1])):
        scattered = np.tile(CENTRE, (100, 1))
        scattered[shown:] = [0.0, 30.0, 4.0]
        assert _neighbours(0, scattered, [photos[0], photos[4]], TRIANGULATION) == found


# ------------------------------------------------------------------ patches in a photo


def can_match(warp: np.ndarray, px: tuple[float, float] = (320.0, 240.0), depth: float = 2.0) -> tuple[bool, float]:
    """Whether a patch is looked for that the photo shows there with this warp, and its magnification."""
    local = np.array([[(px[0] - LENS.cx) / LENS.fx, (px[1] - LENS.cy) / LENS.fy, 1.0]]) * depth
    tangents = np.zeros((1, 3, 2))
    tangents[0, :2] = warp * depth / np.array([[LENS.fx], [LENS.fy]])
    found = predicted(points_at(local, tangents), Camera(LENS, HERE))
    assert np.allclose(found.photo_from_patch[0], warp, atol=1e-4)
    return bool(found.can_match[0]), float(found.magnification[0])


@pytest.mark.parametrize(
    ("scales", "expected"),
    [
        ((0.46, 0.46), True), ((0.44, 0.44), False), ((2.19, 2.19), True), ((2.21, 2.21), False), ((0.46, 2.0), True),
        ((0.44, 2.0), False), ((1.0, 2.21), False), ((1.0, -1.0), False),
    ],
)  # fmt: skip
def test_a_patch_is_looked_for_in_like_scales(scales: tuple[float, float], expected: bool) -> None:
    """Both singular values lie in the range, whatever the rotation; a patch seen from behind is turned over."""
    for angle in (0.0, 0.7):
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        found, magnification = can_match(turn @ np.diag(scales))
        assert found == expected
        assert magnification == pytest.approx(np.sqrt(max(scales[0] * scales[1], 0)), rel=1e-4)


@pytest.mark.parametrize(
    ("px", "expected"),
    [((9.1, 200), True), ((8.9, 200), False), ((630.9, 200), True), ((631.1, 200), False), ((300, 9.1), True),
     ((300, 8.9), False), ((300, 470.9), True), ((300, 471.1), False)],
)  # fmt: skip
def test_a_patch_is_looked_for_within_the_photo(px: tuple[float, float], expected: bool) -> None:
    assert can_match(np.eye(2), px)[0] == expected


def test_patches_behind_the_camera_are_not_looked_for() -> None:
    behind = predicted(points_at(np.array([[0.0, 0, -2.0]]), np.eye(3)[None, :, :2] / -250), Camera(LENS, HERE))
    assert not behind.can_match[0]


def test_only_what_can_be_matched_and_is_similar_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """From a normalized correlation of 0.85 on."""
    asked, warp = [], np.array([[0.0, 2.0], [-0.5, 0.0]])

    def match_patches(*given: Any) -> tuple[np.ndarray, np.ndarray]:
        asked.append(given)
        return np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]), np.array([0.85, 0.849, -1.0])

    monkeypatch.setattr(patch_matching, "match_patches", match_patches)
    where: Any = SimpleNamespace(
        can_match=np.array([True, False, True, True]), px=np.arange(8.0).reshape(4, 2),
        photo_from_patch=np.tile(warp, (4, 1, 1)),
    )  # fmt: skip
    patches = np.arange(4, dtype=np.uint8)[:, None, None] * np.ones((1, 20, 20), np.uint8)
    found = matched(np.zeros((60, 70), np.uint8), patches, where, 4.5)
    assert found[0].tolist() == [1.0, 2.0]
    assert np.isnan(found[1:]).all()
    _, of_patches, warps, start, radius, steps, settled, motion, contrast = asked[0]
    assert of_patches[:, 0, 0].tolist() == [0, 2, 3]
    assert np.allclose(warps @ warp, np.eye(2))
    assert start.tolist() == [[0.0, 1.0], [4.0, 5.0], [6.0, 7.0]]
    assert (radius, steps, settled, motion, contrast) == (5, 10, 0.02, 4.5, 2.0)


# ------------------------------------------------------------------ the pose by patches


def planted(count: int = 80, noise_px: float = 0.0) -> tuple[SurfacePoints, np.ndarray]:
    """Points around CENTRE, and where a photo at POSE shows them."""
    rng = np.random.default_rng(1)
    local = rng.uniform([-1.2, -0.9, 3], [1.2, 0.9, 5], (count, 3))
    return points_at(transformed(POSE.world_from_camera, local)), project(local, LENS) + noise_px * rng.normal(
        size=(count, 2)
    )


START = Camera(LENS, moved(POSE, np.array([0.004, -0.003, 0.002, 0.004, 0.005, -0.003])))


def test_places_tell_the_pose_whatever_a_quarter_of_them_says() -> None:
    points, places = planted()
    places[:20] += np.random.default_rng(2).uniform(2, 5, (20, 2))
    solved = _solved(points, places, START, PATCH_POSE)
    assert np.abs(moved(START.pose, solved.step).world_from_camera - POSE.world_from_camera).max() < 1e-6
    assert np.all(solved.weight[:20] == 0)
    assert np.all(solved.weight[20:] > 0.4)


def test_weights_are_cauchys_up_to_five_robust_standard_deviations() -> None:
    """Nine residuals whose median square is that of two standard normal variables, 1.386, so that the variance is 1."""
    lengths = np.sqrt([1.386] * 5 + [1.0, 24.9, 25.1, 3.0])
    weights = _weights(np.stack([lengths, np.zeros(9)], 1), PATCH_POSE)
    assert weights[5:] == pytest.approx([0.5, 1 / 25.9, 0.0, 0.25])
    assert _weights(np.zeros((3, 2)), PATCH_POSE).tolist() == [1.0] * 3


def test_the_pose_is_the_mean_of_patches_and_pixels_weighed_by_their_information() -> None:
    points, places = planted(noise_px=0.05)
    solved = _solved(points, places, START, PATCH_POSE)
    for strength in (1e-3, 1.0, 30.0):
        information = strength * solved.hessian
        found = _combined(points, places, START, information, PATCH_POSE)
        assert found is not None
        assert (found.found, found.agreeing) == (80, int((solved.weight > 0).sum()))
        # As scattered as 0.05 px, places are as exact as 0.3 px, the least variance.
        share = 1 / (1 + strength)
        expected = moved(START.pose, share * solved.step)
        assert np.allclose(found.pose.world_from_camera, expected.world_from_camera, atol=1e-9)
        joint = np.linalg.inv(solved.hessian) * share
        squared = float(solved.step @ solved.hessian @ solved.step) * strength * share
        assert np.allclose(found.covariance, max(1.0, squared / 6) * joint, rtol=1e-6)
        assert (squared > 6) == (strength >= 1.0)


@pytest.mark.parametrize(("count", "wrong", "agree"), [(40, 0, True), (39, 0, False), (82, 41, True), (90, 46, False)])
def test_forty_patches_and_half_of_those_found_agree(count: int, wrong: int, agree: bool, monkeypatch) -> None:
    points, places = planted(count)
    solved = _solved(points, places, START, PATCH_POSE)
    weight = np.ones(count)
    weight[:wrong] = 0.0
    monkeypatch.setattr(patch_pose, "_solved", lambda *_: replace(solved, weight=weight))
    assert (_combined(points, places, START, np.eye(6), PATCH_POSE) is not None) == agree


def chosen(
    points: SurfacePoints, config=PATCH_POSE, valid: np.ndarray | None = None, surface: float = 4.0
) -> list[int]:
    frame = Frame(np.zeros((48, 64, 3), np.float32), *np.full((3, 48, 64), surface, np.float32))
    rendered: Any = SimpleNamespace(frame=frame, camera=Camera(LENS.resized(64, 48), HERE))
    camera = Camera(LENS, HERE)
    return _chosen(points, predicted(points, camera), camera, valid, rendered, config).tolist()


def facing(positions: list[tuple[float, ...]], scale: float = 1.0, **where: Any) -> SurfacePoints:
    """Points whose patches a photo at HERE shows at this scale."""
    tangents = np.zeros((len(positions), 3, 2))
    for own, position in zip(tangents, positions, strict=True):
        own[0, 0], own[1, 1] = scale * position[2] / LENS.fx, scale * position[2] / LENS.fy
    return points_at(np.array(positions), tangents, **where)


@pytest.mark.parametrize(("depth", "count"), [(4.39, 1), (4.41, 0), (3.61, 1), (3.59, 0)])
def test_points_are_visible_within_a_tenth_of_the_rendered_depth(depth: float, count: int) -> None:
    assert len(chosen(facing([(0.0, 0.0, depth)]))) == count
    assert chosen(facing([(0.0, 0.0, 4.0)]), surface=0.0) == []


def test_points_are_seen_from_within_35_degrees_and_in_the_valid_part() -> None:
    for angle, count in ((34.0, 1), (36.0, 0)):
        far = (4.0 * np.tan(np.radians(angle)), 0.0, 0.0)
        assert len(chosen(facing([(0.0, 0.0, 4.0)], photo_position=far))) == count
    valid = np.ones((480, 640), bool)
    valid[240, 320] = False
    assert chosen(facing([(0.0, 0.0, 4.0), (1.0, 0.0, 4.0)]), valid=valid) == [1]


def test_patches_from_nearly_the_same_side_and_distance_come_first() -> None:
    """In one cell: 8 degrees count as much as a factor e in distance."""
    places = [(0.01, 0.01, 4.0)] * 3
    positions = np.array([[0.0, 0, 0], [4.0 * np.tan(np.radians(6.0)), 0, 0], [0.01, 0.01, -4.0 * 0.9]])
    tangents = facing(places).tangents.copy()
    tangents[2] *= 1.9  # ln 1.9 = 0.64: 5.1 degrees
    points = replace(
        points_at(np.array(places), tangents), photo=np.arange(3, dtype=np.int32), photo_positions=positions
    )
    assert chosen(points, replace(PATCH_POSE, max_patches=1)) == [0]
    assert chosen(points, replace(PATCH_POSE, max_patches=2)) == [0, 2]
    smaller = replace(points, tangents=np.concatenate([points.tangents[:2], points.tangents[2:] / 3.9]))
    assert chosen(smaller, replace(PATCH_POSE, max_patches=2)) == [0, 2]  # ln (1.9 / 3.9) = -0.72: 5.8 degrees
    assert len(chosen(facing([(0.02 * n, 0.0, 4.0) for n in range(30)]), replace(PATCH_POSE, max_patches=7))) == 7


# ------------------------------------------------------------------ the stage

VERDICT = Verdict(
    Status.LOCALIZED, Reason.VERIFIED, 0.7, 100, 0.9, 1.0, np.eye(6), right_place=0.9, precise=0.75,
    asked=(2.0, 0.1),
)  # fmt: skip
FOUND = PatchPose(moved(HERE, np.full(6, 1e-3)), 1e-10 * np.eye(6), 80, 60)


def test_the_verdict_on_a_place_stays_and_its_precision_is_that_of_patches() -> None:
    told = patch_stage._verdict(VERDICT, FOUND)
    assert told.covariance is FOUND.covariance
    assert told.precise == pytest.approx(1.0, abs=1e-3)
    assert told.score == pytest.approx(0.9 * told.precise)
    assert told.right_place == 0.9
    uncertain = patch_stage._verdict(replace(VERDICT, status=Status.UNCERTAIN), FOUND)
    assert uncertain.covariance is FOUND.covariance
    assert (uncertain.precise, uncertain.score) == (0.75, 0.7)


@pytest.mark.parametrize("doubt", [{"asked": None}, {"intrinsics_untested": True}, {"shutter_motion": (0.1, 0.0)}])
def test_what_is_uncertain_for_other_reasons_stays_so(doubt: dict) -> None:
    verdict = replace(VERDICT, **doubt)
    assert patch_stage._verdict(verdict, FOUND) is verdict


def stage(monkeypatch: pytest.MonkeyPatch, found: PatchPose | None = FOUND, lens: Intrinsics = LENS, **changed: Any):
    """Whether patches are looked for, with the facts of a search that were changed."""
    facts = {
        "points": points_at(np.zeros((1, 3))), "rendered": SimpleNamespace(frame=None, camera=None), "photometric": 1,
        "lens_prior": None, "covariance": np.eye(6),
    } | changed  # fmt: skip
    asked = []
    monkeypatch.setattr(patch_stage, "refinement_covariance", lambda *_: facts["covariance"])
    monkeypatch.setattr(patch_stage, "patch_pose", lambda *given: asked.append(given) or found)
    query = SimpleNamespace(
        rgb=np.zeros((4, 4, 3), np.uint8), valid_mask=None, intrinsics=lens, lens_prior=facts["lens_prior"], region=None
    )
    config = SimpleNamespace(patches=PATCH_POSE, refinement=SimpleNamespace(photometric=REFINEMENT))
    refined = SimpleNamespace(rendered=facts["rendered"], photometric=facts["photometric"], pose=HERE)
    state: Any = SimpleNamespace(images=SimpleNamespace(query=query), config=config)
    result = patch_stage._patch_pose(state, SimpleNamespace(refined=refined), facts["points"])  # type: ignore[arg-type]
    return result, asked


def test_patches_are_looked_for_where_they_can_tell_more(monkeypatch: pytest.MonkeyPatch) -> None:
    result, asked = stage(monkeypatch)
    assert result is FOUND
    assert np.array_equal(asked[0][2].pose.world_from_camera, np.eye(4))
    for changed in ({"rendered": None}, {"photometric": None}, {"lens_prior": object()}, {"covariance": None}):
        result, asked = stage(monkeypatch, **changed)
        assert (result, asked) == (None, [])
    for side, looked in ((520, True), (519, False)):
        assert bool(stage(monkeypatch, lens=Intrinsics(side, 400, 500, 500, side / 2, 200))[1]) == looked


# ------------------------------------------------------------------ digest


def test_the_effect_is_the_distance_from_the_given_pose_without_own_patches(monkeypatch: pytest.MonkeyPatch) -> None:
    points = replace(points_at(np.arange(12.0).reshape(4, 3)), photo=np.array([0, 1, 1, 2], np.int32))
    photos = [PosedPhoto(np.zeros((480, 640), np.uint8), Camera(LENS, POSE))] * 3
    given = []
    found = PatchPose(moved(POSE, np.array([0, 0, 0, 0.01, 0, 0])), np.eye(6), 1, 1)
    monkeypatch.setattr(effect, "patch_pose", lambda *asked: given.append(asked) or found)
    refined = moved(POSE, np.array([0, 0, 0, 0, 0.03, 0.04]))
    told = effect.distances(1, photos, points, None, refined, np.eye(6))  # type: ignore[arg-type]
    assert told == pytest.approx((0.05, 0.01))
    assert np.array_equal(given[0][5].points_in_world, points.points_in_world[[0, 3]])
    monkeypatch.setattr(effect, "patch_pose", lambda *asked: None)
    assert effect.distances(1, photos, points, None, refined, np.eye(6)) is None  # type: ignore[arg-type]


def training_photo(pose: Pose = HERE) -> TrainingPhoto:
    image = np.zeros((4, 4), np.uint8)
    return TrainingPhoto("a", "b", image, None, Camera(LENS, pose), np.zeros((2, 2, 3), np.uint8), None)


@pytest.mark.parametrize(
    ("count", "expected"), [(1, [0]), (8, list(range(8))), (9, [0, 2, 4, 6, 8]), (17, [0, 3, 6, 9, 12, 15])]
)
def test_a_sample_has_eight_photos_at_most_evenly_spread(monkeypatch, count: int, expected: list[int]) -> None:
    tried: list[int] = []
    photos = [training_photo(moved(HERE, np.array([0, 0, 0, n, 0, 0.0]))) for n in range(count)]

    def refined(photo: TrainingPhoto, start: Pose, levels: int, rasterizer: object) -> _Refined | None:
        tried.append(int(start.position_in_world[0]))
        assert levels == 2
        return None if start.position_in_world[0] == 0 else _Refined(None, start, np.eye(6))  # type: ignore[arg-type]

    monkeypatch.setattr(digest_module, "_refined", refined)
    sample = _Sample.of(photos, None, DIGEST)  # type: ignore[arg-type]
    assert tried == expected
    assert list(sample.refined) == expected[1:]


def test_a_scene_is_off_where_photos_are_five_standard_deviations_away() -> None:
    photos = [training_photo() for _ in range(3)]
    for sigmas, is_off in (((0.1, 5.01, 9.0), True), ((0.1, 4.99, 9.0), False)):
        poses = [moved(HERE, np.array([0, 0, 0, 0.02 * n, 0, 0])) for n in sigmas]
        refined = [_Refined(None, pose, np.diag([1e-4] * 3 + [4e-4] * 3)) for pose in poses]  # type: ignore[arg-type]
        assert _Sample(dict(enumerate(refined))).is_off(photos, DIGEST) == is_off
    assert not _Sample({}).is_off(photos, DIGEST)


def test_a_photo_has_the_shape_of_its_camera_to_a_hundredth() -> None:
    for height, is_read in ((300, True), (297, True), (296, False), (303, True), (305, False)):
        data = cv2.imencode(".png", np.zeros((height, 400, 3), np.uint8))[1].tobytes()
        camera = NamedCamera("a.png", Camera(Intrinsics(800, 600, 700, 700, 400, 300), HERE))
        found = TrainingPhoto.read(camera, data, (0.0, 0.0, 0.0), None)  # type: ignore[arg-type]
        assert (found is not None) == is_read, height
        if found:
            assert found.camera.intrinsics.fx == pytest.approx(350)
            assert found.grey.shape == (height, 400)


def small_digest() -> PhotoDigest:
    points = points_at(np.arange(6.0).reshape(2, 3))
    return PhotoDigest(points, "key", ("a.png",), ("0" * 64,), np.zeros((1, 6)), 0.3, 1.01, (0.2, 0.1))


def test_a_digest_tells_its_bytes_and_whether_poses_were_refined() -> None:
    digest = small_digest()
    assert digest.nbytes == 2 * (3 * 8 + 9 * 4 + 6 * 4 + 400 + 4) + 3 * 8 + 6 * 8
    assert not digest.is_aligned
    assert replace(digest, offsets=np.full((1, 6), 0.1)).is_aligned


def stored(path: Path, **changed: Any) -> None:
    write_digest(small_digest(), path)
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    np.savez(path, **{name: change(arrays[name]) if (change := changed.get(name)) else a for name, a in arrays.items()})


def test_a_digest_comes_back_as_it_was(tmp_path: Path) -> None:
    stored(tmp_path / "d.npz")
    again = read_digest(tmp_path / "d.npz", "key")
    assert again is not None
    assert (again.reprojection_px, again.depth_ratio, again.effect) == (0.3, 1.01, (0.2, 0.1))
    stored(tmp_path / "d.npz", effect=lambda a: a[:0])
    again = read_digest(tmp_path / "d.npz", "key")
    assert again is not None
    assert again.effect is None


@pytest.mark.parametrize(
    ("name", "change"),
    [
        *((name, lambda a: np.concatenate([a, a])) for name in ("covariances", "tangents", "patches", "photo", "names",
                                                                 "sha256", "offsets", "quality")),
        *((name, lambda a: a * np.nan) for name in ("covariances", "tangents", "photo_positions", "offsets", "effect")),
        ("patches", lambda a: a.astype(np.int16)),
        ("patches", lambda a: a[:, 1:]),
        ("photo", lambda a: a - 1),
        ("photo", lambda a: a + 1),
    ],
)  # fmt: skip
def test_a_digest_with_other_arrays_is_not_used(tmp_path: Path, name: str, change: Any, caplog) -> None:
    stored(tmp_path / "d.npz", **{name: change})
    assert read_digest(tmp_path / "d.npz", "key") is None
    assert "d.npz can't be read and is not used" in caplog.text


def test_a_digest_that_can_not_be_written_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(OSError, match="no space"):
        write_digest(small_digest(), tmp_path / "d.npz")
    assert list(tmp_path.iterdir()) == []
