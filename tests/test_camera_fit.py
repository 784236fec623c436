"""How training cameras are judged: what a camera sees of points, by hand, and what decides between placements."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
from rest_in_ci import rest_in_ci

from service.geometry import look_at, so3_log
from service.scene_formats import camera_fit, colmap
from service.scene_formats.camera_evidence import (
    EVIDENCE,
    Evidence,
    Points,
    _correlation,
    _likelihood,
    _look,
    evidence,
    points_of,
)
from service.scene_formats.camera_fit import FIT, about, fitted
from service.scene_formats.frame_candidates import CameraFile, Candidate
from service.scene_formats.gaussians import RawGaussians
from service.scene_formats.similarity import moved_pose
from service.types import Camera, Intrinsics, NamedCamera, Pose

LENS = Intrinsics(64, 48, 50.0, 50.0, 32.0, 24.0)
HERE = Camera(LENS, Pose(np.eye(4)))


def points(positions: Any, size: float = 0.1, rgb: Any = (0.5, 0.5, 0.5), background: Any = None) -> Points:
    at = np.array(positions, np.float32).reshape(-1, 3)
    colours = np.broadcast_to(np.array(rgb, np.float32), (len(at), 3)).copy()
    return Points(at, np.full(len(at), size, np.float32), colours, np.zeros(3), background)


def plane(depth: float, left: float = 0.0, right: float = 64.0) -> np.ndarray:
    """Points in the middle of each of the 32 by 24 cells whose middle lies between two columns, at this depth."""
    u, v = np.meshgrid(np.arange(32) * 2 + 1.0, np.arange(24) * 2 + 1.0)
    u, v = u.ravel(), v.ravel()
    kept = (u >= left) & (u < right)
    return np.stack([(u[kept] - 32) / 50 * depth, (v[kept] - 24) / 50 * depth, np.full(kept.sum(), depth)], 1)


# ------------------------------------------------------------------ what a camera sees


def test_the_foremost_points_of_each_cell_are_seen_and_no_others() -> None:
    near, far, behind = plane(2.0, 0, 32), plane(2.17, 0, 32), -plane(2.0)
    just = plane(2.0 * 1.079, 0, 32)
    look = _look(points(np.concatenate([near, far, behind, just])), HERE, EVIDENCE)
    # 1.08 times the least depth of the cell is still in front.
    assert look.shape == (24, 32)
    assert sorted(look.front.tolist()) == [
        *range(len(near)),
        *range(len(near) * 2 + len(behind), len(near) * 3 + len(behind)),
    ]
    assert look.coverage == 0.5
    assert look.share == pytest.approx(3 * len(near) / (3 * len(near) + len(behind)))
    # 0.1 at a depth of 2, through a focal length of 50 pixels.
    assert look.size_px == pytest.approx(2.5, rel=0.1)
    assert _look(points(behind), HERE, EVIDENCE).size_px == 0.0
    upright = Camera(Intrinsics(48, 64, 50.0, 50.0, 24.0, 32.0), HERE.pose)
    assert _look(points(near), upright, EVIDENCE).shape == (32, 24)


@pytest.mark.parametrize(
    ("size_px", "likelihood"),
    [(0.5, 1.0), (15.0, 1.0), (0.5 / 3**0.5, 0.5), (15.0 * 3**0.5, 0.5), (0.16, 0.0), (46.0, 0.0), (0.0, 0.0)],
)
def test_sizes_are_likely_from_half_a_pixel_to_fifteen(size_px: float, likelihood: float) -> None:
    assert _likelihood(size_px, EVIDENCE) == pytest.approx(likelihood)


def test_geometry_is_the_share_of_the_points_that_is_seen() -> None:
    everything = points(plane(2.0))
    found = evidence(everything, [HERE], [None])
    assert (found.geometry, found.correlation, found.score) == (1.0, None, 1.0)
    away = Camera(LENS, Pose(np.diag([-1.0, 1.0, -1.0, 1.0])))
    # Half of what there is lies behind each of two cameras; together they see everything.
    both = points(np.concatenate([plane(2.0), -plane(2.0)]))
    assert evidence(both, [HERE], [None]).geometry == pytest.approx(0.5)
    assert evidence(both, [HERE, away], [None, None]).geometry == pytest.approx(1.0)
    assert evidence(everything, [away], [None]).geometry == 0.0
    # Of five cameras one may see nothing, half of it counts: a quantile of 0.2 between 0 and what the second has.
    assert evidence(everything, [HERE] * 4 + [away], [None] * 5).geometry == pytest.approx(min(1, 0.8 / 0.15))
    assert evidence(everything, [HERE] * 2 + [away] * 2, [None] * 4).geometry == 0.0


@pytest.mark.parametrize(("columns", "covered"), [(4.0, 1 / 16 / 0.15), (9.6, 1.0), (20.0, 1.0)])
def test_an_object_covers_15_hundredths_of_an_image(columns: float, covered: float) -> None:
    assert evidence(points(plane(2.0, 0, columns)), [HERE], [None]).geometry == pytest.approx(covered)


@pytest.mark.parametrize(
    ("columns", "hidden", "surrounded"), [(58.0, 700, True), (57.0, 700, False), (64.0, 760, False), (64.0, 770, True)]
)
def test_cameras_are_surrounded_that_see_nine_tenths_filled_by_half_of_the_scene(columns, hidden, surrounded) -> None:
    shown = plane(2.0, 0, columns)
    behind = np.tile([[0.0, 0.0, -1.0]], (hidden, 1))
    assert evidence(points(np.concatenate([shown, behind])), [HERE], [None]).surrounded is surrounded


def test_colours_correlate_where_there_are_points_and_over_the_whole_image() -> None:
    left = plane(2.0, 0, 32)
    rgb = np.linspace(0.2, 0.8, len(left))[:, None] * np.ones(3)
    seen = points(left, rgb=rgb)
    look = _look(seen, HERE, EVIDENCE)
    photo = np.zeros((48, 64, 3), np.uint8)
    drawn = np.zeros((24 * 32, 3))
    drawn[look.cell] = rgb[look.front]
    photo[:] = np.rint(255 * drawn.reshape(24, 32, 3)).repeat(2, 0).repeat(2, 1)
    assert _correlation(look, seen, photo) == pytest.approx(1.0, abs=1e-3)
    # As points on white, which is tried, too; and on a background that is known to be another.
    white = photo.copy()
    white[:, 32:] = 255
    assert _correlation(look, seen, white) == pytest.approx(1.0, abs=1e-3)
    known = points(left, rgb=rgb, background=(0.0, 0.0, 0.0))
    assert _correlation(_look(known, HERE, EVIDENCE), known, white) < 0.6
    # A photo of one colour has nothing to do with them.
    assert _correlation(look, seen, np.full((48, 64, 3), 128, np.uint8)) == pytest.approx(0.0, abs=0.5)
    found = evidence(seen, [HERE, HERE], [photo, None])
    assert found.correlation == pytest.approx(1.0, abs=1e-3)
    assert found.score == found.correlation


def test_the_finest_look_tells_the_pixels_of_the_small_photos_apart() -> None:
    rng = np.random.default_rng(0)
    photo = rng.integers(0, 256, (96, 128, 3), np.uint8)
    v, u = np.mgrid[:96, :128] + 0.5
    lens = Intrinsics(128, 96, 100.0, 100.0, 64.0, 48.0)
    at = np.stack([(u.ravel() - 64) / 50, (v.ravel() - 48) / 50, np.full(u.size, 2.0)], 1)
    seen, camera = points(at, rgb=photo.reshape(-1, 3) / 255), Camera(lens, HERE.pose)
    assert evidence(seen, [camera], [photo], FIT.finest).correlation == pytest.approx(1.0, abs=1e-3)
    # With half of its columns exchanged with their neighbours it is another photo, if neighbours aren't of one cell.
    exchanged = photo.reshape(96, 32, 4, 3)[:, :, [0, 2, 1, 3]].reshape(96, 128, 3)
    assert evidence(seen, [camera], [exchanged], FIT.finest).correlation == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize(("opacity", "kept"), [(0.51, 40), (0.5, 100)])
def test_points_are_opaque_gaussians_or_all_where_none_is(opacity: float, kept: int) -> None:
    rng = np.random.default_rng(0)
    raw: Any = SimpleNamespace(
        opacities=np.where(np.arange(100) < 40, opacity, 0.3), means=rng.normal(size=(100, 3)).astype(np.float32),
        scales=np.tile(np.float32([0.01, 0.4, 0.1]), (100, 1)), sh=np.zeros((100, 1, 3), np.float32),
    )  # fmt: skip
    found = points_of(raw)
    assert len(found.positions) == kept
    assert np.median(found.positions, axis=0) == pytest.approx([0, 0, 0], abs=1e-6)
    assert found.sizes == pytest.approx(0.2)  # the mean of the two larger ones
    assert found.rgb == pytest.approx(0.5)


# ------------------------------------------------------------------ what decides


class PlantedFit(NamedTuple):
    name: str
    verified: bool


class PlantedTrial:
    """Evidence by a candidate's name and fineness; a candidate is a peak unless it is named."""

    found: dict[str, tuple[float, float | None]]
    flat: set[str]
    likely = 2
    asked: list[tuple[str, str]]

    def __init__(self, raw, file, photo_of, background_rgb, config) -> None:
        self._file, self._config = file, config

    def evidence(self, candidate: Candidate, config) -> Evidence:
        fineness = {EVIDENCE.points: "first", FIT.fine.points: "fine", FIT.finest.points: "finest"}
        name = fineness.get(config.points, "coarse") if config is not FIT.coarse else "coarse"
        self.asked.append((candidate.name, name))
        geometry, correlation = self.found.get(f"{candidate.name}/{name}", self.found.get(candidate.name, (0.0, 0.0)))
        return Evidence(geometry, correlation, surrounded="surrounded" in self.flat)

    def is_peak(self, candidate: Candidate, found: Evidence, config, tie: float = 0.0) -> bool:
        return found.score >= FIT.least_correlation and candidate.name not in self.flat

    def same(self, a: Candidate, b: Candidate) -> bool:
        return a is b or "same" in self.flat

    def fit(self, candidate: Candidate, found: Evidence, *, verified: bool) -> PlantedFit:
        return PlantedFit(candidate.name, verified)

    def none(self, by: str, hint: str = "") -> str:
        return by


def decided(monkeypatch: pytest.MonkeyPatch, *, cameras: int = 4, gaussians: int = 1000, flat=(), **found: Any):
    """Fit cameras whose candidates `a`, `b` ... have (geometry, correlation); `as_is` is the file's own."""
    names = sorted({name.partition("__")[0] for name in found} - {"as_is"})
    PlantedTrial.found = {
        name.replace("as_is", "").replace("__", "/"): value if isinstance(value, tuple) else (0.5, value)
        for name, value in found.items()
    }
    PlantedTrial.flat, PlantedTrial.asked = set(flat), []
    monkeypatch.setattr(camera_fit, "_Trial", PlantedTrial)
    tried = [Candidate("")] + [
        Candidate(
            name,
            is_normalization=name.startswith("n"),
            is_measured=name == "measured",
            is_model_frame=name.startswith("model"),
        )
        for name in names
    ]
    monkeypatch.setattr(camera_fit, "candidates", lambda file: tried)
    file: Any = SimpleNamespace(cameras=("camera",) * cameras, stated=())
    raw: Any = SimpleNamespace(means=np.zeros((gaussians, 3)))
    return fitted(raw, file, lambda named: None)


def test_few_cameras_or_gaussians_are_not_judged(monkeypatch: pytest.MonkeyPatch) -> None:
    for changed in ({"cameras": 3}, {"gaussians": 999}):
        found = decided(monkeypatch, as_is=0.0, a=0.9, **changed)
        assert (found.decided_by, found.verified) == ("as the camera file has them; too few to check", False)
    assert decided(monkeypatch, as_is=0.0, a=0.9) == ("a", True)


@pytest.mark.parametrize(("correlation", "expected"), [(0.33, ("", True)), (0.329, ("a", True))])
def test_cameras_that_correlate_clearly_are_taken_as_they_are(monkeypatch, correlation, expected) -> None:
    assert decided(monkeypatch, as_is=correlation, a=0.9) == expected
    # Unless others nearby fit better.
    assert decided(monkeypatch, as_is=0.5, a=0.9, flat=[""]) == ("a", True)


@pytest.mark.parametrize(
    ("geometry", "surrounded", "expected"),
    [(0.3, True, ("", True)), (0.3, False, ("", False)), (0.29, True, ("a", True))],
)
def test_without_photos_a_plausible_geometry_is_enough(monkeypatch, geometry, surrounded, expected) -> None:
    flat = ["surrounded"] if surrounded else []
    assert decided(monkeypatch, as_is=(geometry, None), a=(0.9, None), flat=flat) == expected


def test_what_is_alike_is_compared_again_and_the_simpler_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    # Within 0.03 of the best they are compared at the finest; of those the first within 0.015 is taken.
    assert decided(monkeypatch, as_is=0.0, a=0.5, b=0.514, b__finest=0.514) == ("a", True)
    assert decided(monkeypatch, as_is=0.0, a=0.5, b=0.516) == ("b", True)
    assert decided(monkeypatch, as_is=0.0, a=0.5, b=0.529, b__finest=0.4) == ("a", True)
    assert decided(monkeypatch, as_is=0.0, a=0.5, a__finest=0.9, b=0.531) == ("b", True)
    # Normalizations are many: the best of them is taken, to a ten-thousandth.
    assert decided(monkeypatch, as_is=0.0, n1=0.5, n2=0.5002) == ("n2", True)
    assert decided(monkeypatch, as_is=0.0, n1=0.5, n2=0.50005) == ("n1", True)
    # Eight finalists and the file's own; what is coarsely behind them is not compared.
    many = {f"n{k}": 0.5 for k in range(1, 9)} | {"n9": 0.49, "n9__fine": 0.9}
    assert decided(monkeypatch, as_is=0.0, **many) == ("n1", True)
    assert sum(fineness == "fine" for _, fineness in PlantedTrial.asked) == 9
    # But a normalization that places the cameras as the best one does: nothing coarse ranks the two.
    near = many | {"n9__finest": 0.9}
    assert decided(monkeypatch, as_is=0.0, **near) == ("n1", True)
    assert decided(monkeypatch, as_is=0.0, **near, flat=["same"]) == ("n9", True)


def test_a_correction_must_correlate_clearly_and_cameras_as_they_are_need_less(monkeypatch) -> None:
    assert decided(monkeypatch, as_is=0.0, a=0.33) == ("a", True)
    assert decided(monkeypatch, as_is=(0.1, 0.0), a=0.32) == "their photos"
    # What localizing the photos has told needs no more than cameras as they are.
    assert decided(monkeypatch, as_is=(0.1, 0.0), measured=0.2) == ("measured", True)
    assert decided(monkeypatch, as_is=(0.1, 0.0), measured=0.19) == "their photos"
    assert decided(monkeypatch, as_is=(0.1, 0.2), a=0.1) == ("", True)
    assert decided(monkeypatch, as_is=(0.1, 0.19), a=0.1) == "their photos"
    # Of a plausible geometry, and no worse than the best by more than 0.03, they stay in doubt.
    assert decided(monkeypatch, as_is=(0.3, 0.19), a=0.22) == ("", False)
    assert decided(monkeypatch, as_is=(0.3, 0.18), a=0.22) == "their photos"
    assert decided(monkeypatch, as_is=(0.29, 0.19), a=0.22) == "their photos"


def test_without_photos_the_likeliest_of_the_best_geometries_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    nowhere = {"as_is": (0.1, None)}
    assert decided(monkeypatch, **nowhere, a=(0.29, None)) == "the Gaussians in front of them"
    assert decided(monkeypatch, **nowhere, a=(0.3, None)) == ("a", True)
    # Nine tenths of the best are as good; another with seven tenths of it leaves a doubt, unless it is the same.
    assert decided(monkeypatch, **nowhere, a=(0.82, None), b=(0.9, None)) == ("a", False)
    assert decided(monkeypatch, **nowhere, a=(0.82, None), b=(0.9, None), flat=["same"]) == ("a", True)
    assert decided(monkeypatch, **nowhere, a=(0.62, None), b=(0.9, None)) == ("b", True)
    assert decided(monkeypatch, **nowhere, a=(0.64, None), b=(0.9, None)) == ("b", False)


def test_without_photos_two_readings_of_what_the_trainer_wrote_leave_a_doubt(monkeypatch) -> None:
    nowhere = {"as_is": (0.1, None)}
    assert decided(monkeypatch, **nowhere, model1=(0.5, None), model2=(0.6, None)) == ("model1", False)
    assert decided(monkeypatch, **nowhere, model1=(0.5, None), model2=(0.6, None), flat=["same"]) == ("model1", True)
    assert decided(monkeypatch, **nowhere, model1=(0.5, None), model2=(0.29, None)) == ("model1", True)


def rooms(count: int, rng: np.random.Generator) -> tuple[RawGaussians, list[NamedCamera]]:
    """A row of rooms of 4 by 4 by 2.4 units with different furniture, each with 20 level cameras in it."""
    shells, cameras = [], []
    for room in range(count):
        wall = rng.uniform(-1, 1, (1500, 3))
        side, sign = rng.integers(3, size=1500), rng.choice([-1.0, 1.0], 1500)
        wall[np.arange(1500), side] = sign
        box = rng.uniform(-0.3, 0.3, (200, 3)) + np.array([*rng.uniform(-0.5, 0.5, 2), -0.7])
        middle = np.array([4.5 * room, 0.8 * (room % 3), 0.3 * (room % 2)])
        shells.append(np.concatenate([wall, box]) * [2, 2, 1.2] + middle)
        for number in range(20):
            at = middle + rng.uniform(-0.7, 0.7, 3) * [2, 2, 0.5]
            turn = 2 * np.pi * number / 20
            pose = look_at(at, at + np.array([np.cos(turn), np.sin(turn), -0.1]), np.array([0.0, 0.0, 1.0]))
            cameras.append(NamedCamera(f"{room}/{number}.png", Camera(LENS, pose)))
    means = np.concatenate(shells).astype(np.float32)
    n = len(means)
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1))
    scales, sh = np.full((n, 3), 0.03, np.float32), rng.normal(size=(n, 1, 3)).astype(np.float32)
    return RawGaussians(means, quats, scales, np.full(n, 0.9, np.float32), sh), cameras


@pytest.mark.parametrize("turned", rest_in_ci(False, True))
def test_cameras_of_a_large_scene_are_judged_part_by_part(turned: bool) -> None:
    raw, cameras = rooms(30, np.random.default_rng(0))
    turn = np.eye(4)
    turn[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]] if turned else np.eye(3)
    moved = [replace(n, camera=replace(n.camera, pose=moved_pose(n.camera.pose, turn))) for n in cameras]
    fit = fitted(raw, CameraFile(tuple(moved)), lambda named: None)
    assert len(fit.cameras) == len(cameras)
    # Ten cameras see a third of thirty rooms at most: the whole scene tells nothing.
    poses = np.stack([n.camera.pose.world_from_camera for n in fit.cameras])
    right = np.stack([n.camera.pose.world_from_camera for n in cameras])
    np.testing.assert_allclose(poses[:, :3, 3], right[:, :3, 3], atol=1e-9)
    if turned:
        # Cameras all around in plain rooms may look the other way as well.
        assert fit.is_doubtful or np.allclose(poses, right)
    else:
        np.testing.assert_allclose(poses, right, atol=1e-9)
        assert fit.verified
        assert not fit.warnings


@pytest.mark.parametrize("turned", [False, True])
def test_many_cameras_around_an_object_are_no_large_scene(turned: bool) -> None:
    """What symmetric cameras around an object leave open, no part of them decides."""
    rng = np.random.default_rng(0)
    raw, _ = rooms(1, rng)
    raw = replace(raw, means=raw.means * np.float32(0.3))
    orbit = [2.5 * np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
             for e in (0.2, 0.6) for a in np.linspace(0, 2 * np.pi, 100, endpoint=False)]  # fmt: skip
    turn = np.eye(4)
    turn[:3, :3] = np.diag([1, -1, -1]) if turned else np.eye(3)
    cameras = [Camera(LENS, moved_pose(look_at(at, np.zeros(3), np.array([0.0, 0.0, 1.0])), turn)) for at in orbit]
    file = CameraFile(tuple(NamedCamera(f"{i}.png", camera) for i, camera in enumerate(cameras)))
    trial = camera_fit._Trial(raw, file, lambda named: None, None, FIT)
    trial.divide()
    assert trial.evidence(Candidate(""), EVIDENCE).geometry == 0
    fit = fitted(raw, file, lambda named: None)
    assert fit.cameras
    assert fit.is_doubtful


@pytest.mark.ci
def test_cameras_of_another_large_scene_are_left_out() -> None:
    raw, cameras = rooms(30, np.random.default_rng(0))
    beside = np.eye(4)
    beside[:3, 3] = [3.0, 40.0, -9.0]
    moved = [replace(n, camera=replace(n.camera, pose=moved_pose(n.camera.pose, beside))) for n in cameras]
    assert fitted(raw, CameraFile(tuple(moved)), lambda named: None).cameras == ()


def test_placements_are_disturbed_by_five_degrees_and_fifteen_hundredths() -> None:
    turns = list(camera_fit._disturbances(FIT))
    assert [np.degrees(np.linalg.norm(so3_log(turn))) for turn, _ in turns] == pytest.approx([5.0] * 6 + [0, 0])
    assert [scale for _, scale in turns] == pytest.approx([1.0] * 6 + [1.15, 1 / 1.15])
    # About a point, which stays where it is.
    point = np.array([1.0, 2.0, 3.0])
    for turn, scale in turns:
        matrix = about(point, turn, scale)
        assert matrix[:3, :3] @ point + matrix[:3, 3] == pytest.approx(point)
        assert np.cbrt(np.linalg.det(matrix[:3, :3])) == pytest.approx(scale)


def trial() -> Any:
    poses = [Pose(np.block([[np.eye(3), np.array([[k], [0.0], [0.0]])], [0, 0, 0, 1]])) for k in range(6)]
    cameras = tuple(NamedCamera(f"{k}.jpg", Camera(LENS, pose)) for k, pose in enumerate(poses))
    return camera_fit._Trial(SimpleNamespace(), CameraFile(cameras), lambda named: None, None, FIT)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("shift", "turn_deg", "same"), [(0.24, 0.0, True), (0.26, 0.0, False), (0.0, 11.0, True), (0.0, 12.0, False)]
)
def test_placements_are_the_same_within_a_tenth_of_the_spread_and_eleven_degrees(shift, turn_deg, same) -> None:
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    # The cameras reach 2.5 from their mean; the turn is about each camera's own place.
    moved = np.array([[1.0, 0, 0, 0], [0, c, -s, shift], [0, s, c, 0], [0, 0, 0, 1]])
    one = trial()
    assert one.same(Candidate("a"), Candidate("b", file_from_cameras=moved)) is same


@pytest.mark.parametrize(("better", "peak"), [(0.014, True), (0.016, False)])
def test_a_peak_fits_better_than_what_is_disturbed_but_for_a_tie(monkeypatch, better: float, peak: bool) -> None:
    one = trial()
    one._points[EVIDENCE.points] = points(plane(2.0))
    monkeypatch.setattr(one, "evidence", lambda candidate, config: Evidence(0.5, 0.4 + better))
    assert one.is_peak(Candidate(""), Evidence(0.5, 0.4), EVIDENCE, FIT.tie) is peak
    for least, fits in ((0.2, True), (0.19, False)):
        monkeypatch.setattr(one, "evidence", lambda candidate, config: Evidence(0.5, 0.0))
        assert one.is_peak(Candidate(""), Evidence(0.5, least), EVIDENCE) is fits


# ------------------------------------------------------------------ COLMAP's camera models

MODELS = (
    # COLMAP's src/colmap/sensor/models.h: id, name, parameters.
    (0, "SIMPLE_PINHOLE", "f, cx, cy"),
    (1, "PINHOLE", "fx, fy, cx, cy"),
    (2, "SIMPLE_RADIAL", "f, cx, cy, k"),
    (3, "RADIAL", "f, cx, cy, k1, k2"),
    (4, "OPENCV", "fx, fy, cx, cy, k1, k2, p1, p2"),
    (5, "OPENCV_FISHEYE", "fx, fy, cx, cy, k1, k2, k3, k4"),
    (6, "FULL_OPENCV", "fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6"),
    (7, "FOV", "fx, fy, cx, cy, omega"),
    (8, "SIMPLE_RADIAL_FISHEYE", "f, cx, cy, k"),
    (9, "RADIAL_FISHEYE", "f, cx, cy, k1, k2"),
    (10, "THIN_PRISM_FISHEYE", "fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, sx1, sy1"),
    (11, "RAD_TAN_THIN_PRISM_FISHEYE", "fx, fy, cx, cy, k0, k1, k2, k3, k4, k5, p0, p1, s0, s1, s2, s3"),
    (12, "SIMPLE_DIVISION", "f, cx, cy, k"),
    (13, "DIVISION", "fx, fy, cx, cy, k"),
    (14, "SIMPLE_FISHEYE", "f, cx, cy"),
    (15, "FISHEYE", "fx, fy, cx, cy"),
    (16, "EUCM", "fx, fy, cx, cy, alpha, beta"),
)
VALUES = {"f": 90.0, "fx": 80.0, "fy": 81.0, "cx": 48.0, "cy": 32.0}


@pytest.mark.parametrize("binary", [True, False])
def test_every_camera_model_of_colmap_is_read_by_its_number_and_its_name(tmp_path: Path, binary: bool) -> None:
    rows = [(number, name, [VALUES.get(p.strip(), 0.01) for p in given.split(",")]) for number, name, given in MODELS]
    if binary:
        data = struct.pack("<Q", len(rows))
        for number, _, values in rows:
            data += struct.pack(f"<iiQQ{len(values)}d", number + 1, number, 96, 64, *values)
        (tmp_path / "cameras.bin").write_bytes(data)
        found = colmap._binary_cameras(tmp_path / "cameras.bin")
    else:
        lines = [f"{n + 1} {name} 96 64 {' '.join(map(str, values))}" for n, name, values in rows]
        (tmp_path / "cameras.txt").write_text("# cameras\n" + "\n".join(lines) + "\n")
        found = colmap._text_cameras(tmp_path / "cameras.txt")
    assert len(found) == len(rows)
    for number, name, values in rows:
        one_focal = values[0] == 90.0
        fx, fy = (90.0, 90.0) if one_focal else (80.0, 81.0)
        assert found[number + 1] == Intrinsics(96, 64, fx, fy, 48.0, 32.0), name


def test_a_camera_model_without_a_focal_length_is_named(tmp_path: Path) -> None:
    (tmp_path / "cameras.bin").write_bytes(struct.pack("<QiiQQ", 1, 1, 17, 96, 64))
    with pytest.raises(ValueError, match="model 17 \\(EQUIRECTANGULAR\\)"):
        colmap._binary_cameras(tmp_path / "cameras.bin")
