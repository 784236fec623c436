"""`splatfix bench peer`: a map of planted features, and COLMAP's parts on renders of the demo scene."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from service.bench.localize import load_bench_scene
from service.bench.peer import comparison
from service.bench.peer.comparison import MIN_INLIERS, PEERS, Task, figures, run
from service.bench.peer.photo_map import PhotoMap, Points, PosedPhoto
from service.bench.peer.photo_matching import (
    MatchingConfig,
    PhotoFeatures,
    matched,
    near_epipolar_lines,
    pairs_of_cameras,
)
from service.bench.peer.words import Words, WordsConfig
from service.bench.pose_metrics import Outcome, Units
from service.errors import BackendMissing, SceneNotFound, UnknownName
from service.geometry import pose_distance, so3_exp
from service.photos.images import encode_image
from service.results import Status
from service.types import Camera, Intrinsics, NamedCamera, Pose

STUDIO = Path(__file__).parents[1] / "scenes" / "studio"
K = Intrinsics(320, 240, 300.0, 300.0, 160.0, 120.0)


def camera(angle_deg: float, distance: float = 4.0) -> Camera:
    """Looks at the origin from a circle in the plane of x and z."""
    matrix = np.eye(4)
    matrix[:3, :3] = so3_exp(np.array([0.0, np.radians(angle_deg), 0.0]))
    matrix[:3, 3] = matrix[:3, :3] @ [0.0, 0.0, -distance]
    return Camera(K, Pose(matrix))


def seen(points: np.ndarray, by: Camera) -> np.ndarray:
    """Project points, with OpenCV."""
    matrix, k = by.pose.camera_from_world, by.intrinsics
    rotation, _ = cv2.Rodrigues(matrix[:3, :3])
    kmat = np.array([[k.fx, 0, k.cx], [0, k.fy, k.cy], [0, 0, 1.0]])
    return cv2.projectPoints(points, rotation, matrix[:3, 3], kmat, None)[0].reshape(-1, 2)


def unit(rows: np.ndarray) -> np.ndarray:
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def turned(radians: Sequence[float]) -> PhotoFeatures:
    """Descriptors in a plane, by their direction: distances are what angles say."""
    rows = np.array([[np.cos(a), np.sin(a)] for a in radians], np.float32)
    return PhotoFeatures(np.zeros((len(rows), 2)), rows)


def test_matches_are_mutual_and_pass_the_ratio_test() -> None:
    # 0.12 is nearer to 0.1 than 0.0 is, and takes it.
    assert matched(turned([0.0, 3.0]), turned([0.1, 1.5])).tolist() == [[0, 0]]
    assert matched(turned([0.0, 0.12]), turned([0.1, 1.5])).tolist() == [[1, 0]]
    # Chords of 0.400 and 0.497, of 0.400 and 0.503: ratios of 0.804 and 0.795.
    chord = lambda length: 2 * np.arcsin(length / 2)  # noqa: E731
    for second, found in ((0.497, []), (0.503, [[0, 0]])):
        assert matched(turned([0.0, 3.0]), turned([chord(0.4), -chord(second)])).tolist() == found
    # Farther than 0.7 nothing is alike, whatever comes second.
    for nearest, found in ((0.69, [[0, 0]]), (0.71, [])):
        assert matched(turned([0.0, np.pi]), turned([chord(nearest), np.pi])).tolist()[:-1] == found
    assert matched(turned([0.0]), turned([0.0])).shape == (0, 2)  # no ratio


def test_blocks_give_what_all_at_once_gives() -> None:
    rng = np.random.default_rng(0)
    a = PhotoFeatures(np.zeros((200, 2)), unit(rng.normal(size=(200, 8))))
    order = rng.permutation(200)
    b = PhotoFeatures(np.zeros((200, 2)), unit(a.descriptors[order] + 0.02 * rng.normal(size=(200, 8))))
    pairs = matched(a, b)
    assert len(pairs) > 150
    assert np.all(order[pairs[:, 1]] == pairs[:, 0])


def test_photos_are_paired_by_place_and_direction() -> None:
    cameras = [camera(angle) for angle in (0, 20, 40, 180, 200)]
    assert pairs_of_cameras(cameras) == [(0, 1), (0, 2), (1, 2), (3, 4)]
    # (0, 1), (1, 0) or (1, 2), (2, 1), (3, 4): the nearest one of each.
    nearest = pairs_of_cameras(cameras, MatchingConfig(pairs_of_photo=1))
    assert {(0, 1), (3, 4)} <= set(nearest)
    assert (0, 2) not in nearest
    assert pairs_of_cameras([camera(0), camera(0)]) == [(0, 1)]


def test_matches_off_the_epipolar_line_are_left_out() -> None:
    a, b = camera(0), camera(25)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (30, 3))
    a_px, b_px = seen(points, a), seen(points, b)
    assert near_epipolar_lines(a, b, a_px, b_px, 1e-3).all()
    # The cameras move sideways, so that lines are nearly level: a shift along them can't be seen, one across can.
    assert near_epipolar_lines(a, b, a_px, b_px + np.array([40.0, 0.0]), 8.0).all()
    assert not near_epipolar_lines(a, b, a_px, b_px + np.array([0.0, 5.0]), 4.0).any()
    assert near_epipolar_lines(a, b, a_px, b_px + np.array([0.0, 3.0]), 4.0).all()
    assert not near_epipolar_lines(a, a, a_px, a_px, 4.0).any()


def test_the_photo_with_the_same_words_comes_first() -> None:
    rng = np.random.default_rng(0)
    kinds = unit(rng.normal(size=(3, 60, 16)).reshape(-1, 16)).reshape(3, 60, 16)
    words = Words.of(list(kinds))
    for number, kind in enumerate(kinds):
        assert words.ranked(unit(kind + 0.02 * rng.normal(size=kind.shape)))[0] == number
    assert sorted(words.ranked(kinds[0])) == [0, 1, 2]


def test_words_count_by_how_few_photos_have_them() -> None:
    everywhere, first, second = np.eye(8, dtype=np.float32)[:3]
    photos = [np.repeat([everywhere, own], [16, 4], 0) for own in (first, second)]
    words = Words.of(photos, WordsConfig(words=12))
    weights = dict(zip(map(tuple, words.centres.tolist()), words.weights, strict=True))
    # All have the first, whose logarithm is 0; a half has each other one.
    assert max(weights.values()) == pytest.approx(np.log(2) + 0.05)
    counted = {name: weight for name, weight in weights.items() if name != tuple(everywhere)}
    assert set(np.round(list(counted.values()), 6)) == {np.round(np.log(2) + 0.05, 6)}
    assert np.linalg.norm(words.photos, axis=1) == pytest.approx(1)
    assert words.nbytes == 10 * 8 * 4 + 10 * 8 + 2 * 2 * 10  # a quarter of 40 features


@dataclass(frozen=True)
class PlantedPeer:
    """Sees each of the points under a descriptor of its own; a photo's first pixel tells which camera took it."""

    points_in_world: np.ndarray
    descriptors: np.ndarray
    cameras: Sequence[Camera]

    def features(self, grey: np.ndarray) -> PhotoFeatures:
        rng = np.random.default_rng(int(grey[0, 0]))
        noise = 0.03 * rng.normal(size=self.descriptors.shape)
        return PhotoFeatures(seen(self.points_in_world, self.cameras[grey[0, 0]]), unit(self.descriptors + noise))

    def points(self, cameras: Sequence[Camera], px: Sequence[np.ndarray], matches: dict[Any, np.ndarray]) -> Points:
        assert all(np.all(pairs[:, 0] == pairs[:, 1]) and len(pairs) > 20 for pairs in matches.values())
        return Points(self.points_in_world, tuple(np.arange(len(one)) for one in px))

    def pose(self, px: np.ndarray, in_world: np.ndarray, intrinsics: Intrinsics) -> tuple[Pose, int] | None:
        k = intrinsics
        kmat = np.array([[k.fx, 0, k.cx], [0, k.fy, k.cy], [0, 0, 1.0]])
        good, vector, position = cv2.solvePnP(in_world, px, kmat, None)
        matrix = np.eye(4)
        matrix[:3, :3] = cv2.Rodrigues(vector)[0].T
        matrix[:3, 3] = -matrix[:3, :3] @ position[:, 0]
        return (Pose(matrix), len(px)) if good else None


@pytest.mark.parametrize("ranks_photos", [True, False])
def test_a_photo_is_localized_in_a_map(ranks_photos: bool) -> None:
    rng = np.random.default_rng(0)
    cameras = [camera(angle) for angle in (0, 10, 20, 30, 15)]
    peer = PlantedPeer(rng.uniform(-0.5, 0.5, (40, 3)), unit(rng.normal(size=(40, 32))), cameras)
    photos = [PosedPhoto(np.full((240, 320), number, np.uint8), None, each) for number, each in enumerate(cameras)]
    made = PhotoMap.of(photos[:4], peer, ranks_photos)
    assert made.facts.photos == 4
    assert (made.facts.features, made.facts.points) == (160, 40)
    assert made.nbytes > 0
    # The query's own pose is not what is asked: only its intrinsics are known.
    asked = PosedPhoto(photos[4].grey, None, Camera(K, camera(90).pose))
    found = made.localize(asked, peer, best_photos=2)
    assert found
    degrees, distance = pose_distance(found[0], cameras[4].pose)
    assert (degrees, distance) < (0.01, 0.001)
    # Where pixels show nothing there are no features.
    masked = PosedPhoto(asked.grey, np.zeros((240, 320), bool), asked.camera)
    assert made.localize(masked, peer, best_photos=2) is None


def test_photos_without_a_common_point_make_no_map() -> None:
    class Blind(PlantedPeer):
        def points(self, cameras: Any, px: Any, matches: Any) -> Points:
            return Points(np.zeros((0, 3)), tuple(np.full(len(one), -1) for one in px))

    rng = np.random.default_rng(0)
    cameras = [camera(0), camera(10)]
    peer = Blind(rng.uniform(-0.5, 0.5, (40, 3)), unit(rng.normal(size=(40, 32))), cameras)
    photos = [PosedPhoto(np.full((240, 320), number, np.uint8), None, each) for number, each in enumerate(cameras)]
    with pytest.raises(SceneNotFound, match="no point in common"):
        PhotoMap.of(photos, peer, ranks_photos=False)


def test_figures_ask_for_a_verdict_of_ours_only() -> None:
    outcomes = [
        Outcome(Status.LOCALIZED, 0.5, 0.005, 1.0, 10.0),
        Outcome(Status.UNCERTAIN, 0.5, 0.005, 1.0, 20.0),
        Outcome(Status.LOCALIZED, 2.0, 0.03, 1.0, 30.0),
        Outcome(Status.LOCALIZED, 9.0, 0.03, 1.0, 40.0),
        Outcome(Status.NOT_LOCALIZED, 180.0, np.inf, 1.0, 50.0),
    ]
    ours, peer = figures(outcomes, has_verdict=True), figures(outcomes, has_verdict=False)
    assert (ours["right_1deg_0p01"], ours["right_5deg_0p05"]) == (1, 2)
    assert (peer["right_1deg_0p01"], peer["right_5deg_0p05"]) == (2, 3)
    for one in (ours, peer):
        assert (one["photos"], one["localized"], one["false_localized"], one["cpu_ms_p50"]) == (5, 3, 1, 30.0)
        assert (one["median_rotation_deg"], one["median_translation_units"]) == (2.0, 0.03)


def test_unknown_methods_and_missing_packages_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UnknownName, match="unknown method 'orb'; known: splatfix, splatfix_photos, sift_best10"):
        next(run([Task(tmp_path)], ["orb"]))
    monkeypatch.delitem(sys.modules, "service.bench.peer.colmap", raising=False)
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(BackendMissing) as missing:
        import service.bench.peer.colmap  # noqa: F401
    assert "splatfix[peer]" in (missing.value.hint or "")


def test_each_photo_is_timed_after_one_that_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, step in (("perf_counter", 0.5), ("process_time", 0.25)):  # seconds from one look to the next
        ticks = itertools.count()
        monkeypatch.setattr(comparison.time, name, lambda ticks=ticks, step=step: step * next(ticks))
    asked: list[str] = []
    beside = np.eye(4)
    beside[2, 3] = 0.1
    trials: list[Any] = [SimpleNamespace(photo=name, truth=Camera(K, Pose(np.eye(4)))) for name in "ab"]
    scene: Any = SimpleNamespace(units=Units(np.zeros(3), 2.0, False))

    def localize_one(trial: Any) -> comparison.Answer:
        asked.append(trial.photo)
        return (Pose(beside), Status.LOCALIZED) if trial.photo == "a" else (None, Status.NOT_LOCALIZED)

    one, other = comparison.measured(scene, trials, localize_one)
    assert asked == ["a", "a", "b"]
    assert one == Outcome(Status.LOCALIZED, 0.0, pytest.approx(0.2), 500.0, 250.0)
    assert other == Outcome(Status.NOT_LOCALIZED, 180.0, np.inf, 500.0, 250.0)


@pytest.mark.parametrize(("method", "ranked"), [("sift_best10", True), ("dog_direct", False)])
def test_a_peers_answer_counts_from_twelve_inliers_on(method: str, ranked: bool, monkeypatch, tmp_path: Path) -> None:
    asked: list[Any] = []
    answers = [None, (Pose(np.eye(4)), 11), (Pose(np.eye(4)), 12)]

    class Map(SimpleNamespace):
        def localize(self, photo: PosedPhoto, peer: Any, best_photos: int) -> tuple[Pose, int] | None:
            asked.append((photo.camera.intrinsics, best_photos))
            return answers.pop(0)

    def of(photos: Any, peer: Any, ranks_photos: bool) -> Map:
        asked.append((photos, peer, ranks_photos))
        return Map(facts=SimpleNamespace(build_cpu_s=3.0, points=40), nbytes=77)

    monkeypatch.setitem(sys.modules, "service.bench.peer.colmap", SimpleNamespace(Colmap=lambda sift: sift))
    monkeypatch.setattr(comparison, "training_photos", lambda scene, folder: folder)
    monkeypatch.setattr(comparison.PhotoMap, "of", of)
    scene: Any = SimpleNamespace(background_rgb=(0.0, 0.0, 0.0))
    facts, localize_one = comparison._peer(scene, Task(tmp_path), PEERS[method])
    assert facts == {"build_cpu_s": 3.0, "map_bytes": 77, "points": 40}
    data = encode_image(np.zeros((240, 320, 3), np.uint8), "png")
    trial: Any = SimpleNamespace(data=data, intrinsics=K, truth=camera(0))
    found = [localize_one(trial)[1] for _ in range(3)]
    assert found == [Status.NOT_LOCALIZED, Status.UNCERTAIN, Status.LOCALIZED]
    assert asked == [(tmp_path, PEERS[method].sift, ranked), *[(K, 10 if ranked else 0)] * 3]


def test_training_photos_are_those_that_lie_there_in_their_cameras_shape(tmp_path: Path) -> None:
    # Half as large; too high by less and by more than a hundredth; no picture; not there.
    sizes = {"half.png": (120, 160), "bent.png": (161, 213), "other.png": (120, 163)}
    for name, size in sizes.items():
        (tmp_path / name).write_bytes(encode_image(np.zeros((*size, 3), np.uint8), "png"))
    (tmp_path / "broken.png").write_bytes(b"no picture")
    cameras = [NamedCamera(name, camera(0)) for name in (*sizes, "broken.png", "missing.png")]
    info = SimpleNamespace(origin_in_world=(100.0, 20.0, 3.0))
    scene: Any = SimpleNamespace(
        background_rgb=(0.0, 0.0, 0.0), loaded=SimpleNamespace(scene=SimpleNamespace(info=info, cameras=cameras))
    )
    photos = comparison.training_photos(scene, tmp_path)
    assert [each.grey.shape for each in photos] == [(120, 160), (161, 213)]
    first = photos[0].camera
    assert first.pose.position_in_world == pytest.approx(np.add(camera(0).pose.position_in_world, [100, 20, 3]))
    assert (first.intrinsics.fx, first.intrinsics.cx) == (150.0, 80.0)
    cameras[1:3] = []
    with pytest.raises(SceneNotFound, match="fewer than two photos"):
        comparison.training_photos(scene, tmp_path)


@pytest.mark.skipif(not find_spec("pycolmap"), reason="pycolmap isn't installed: pip install 'splatfix[peer]'")
@pytest.mark.parametrize("ranks_photos", [True, False])
def test_colmap_localizes_a_demo_photo_by_renders_from_near_it(ranks_photos: bool) -> None:
    from service.bench.peer.colmap import Colmap

    scene = load_bench_scene(STUDIO)
    photo = scene.photos[0]
    place, axis = photo.camera.pose.position_in_world, photo.camera.pose.axis_in_world
    near = sorted(
        (each for each in scene.training if each.pose.axis_in_world @ axis > 0.7),
        key=lambda each: float(np.linalg.norm(each.pose.position_in_world - place)),
    )[:10]
    cameras = [Camera(each.intrinsics.resized(640, 480), each.pose) for each in near]
    frames = scene.loaded.rasterizer.render(cameras)
    photos = [
        PosedPhoto(cv2.cvtColor((255 * frame.rgb).astype(np.uint8), cv2.COLOR_RGB2GRAY), None, each)
        for frame, each in zip(frames, cameras, strict=True)
    ]
    peer = Colmap(PEERS["dog_direct"].sift)
    made = PhotoMap.of(photos, peer, ranks_photos)
    grey = cv2.imread(str(photo.path), cv2.IMREAD_GRAYSCALE)
    asked = PosedPhoto(grey, None, Camera(photo.camera.intrinsics, cameras[0].pose))
    found = made.localize(asked, peer, best_photos=5)
    assert found
    degrees, distance = pose_distance(found[0], photo.camera.pose)
    assert degrees < 0.5
    assert distance < 0.05
    assert found[1] >= MIN_INLIERS
