"""The benches: which photos, what is held back, starts, modifications, and what is counted."""

import io
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from stand_ins import PlannedNumbers

from service.accuracy import Accuracy
from service.bench import localize as bench
from service.bench import modifications
from service.bench import render as render_bench
from service.bench.bench_photos import find_photos, prepare_photo
from service.bench.miss_images import miss_image, save_miss_images
from service.bench.modifications import MODIFICATIONS, modify
from service.bench.modified_photo import Photo
from service.bench.pose_metrics import Units, nees, units_of
from service.bench.start_poses import KINDS, start_pose
from service.errors import CorruptScene, InvalidOptions, SceneNotFound, UnknownName
from service.geometry import look_at, moved, pose_distance, project, rotation_from_quat, so3_log, transformed
from service.interfaces import Frame
from service.loaded_scene import LoadedScene
from service.photos.images import encode_image, read_query, with_palette
from service.pose.features.scene_focus import centre_depth
from service.results import PoseEstimate, Reason, Status, Verdict
from service.types import Camera, Intrinsics, Pose

UP = np.array([0.0, 0.0, 1.0])
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
LENS = Intrinsics(64, 48, 60.0, 61.0, 33.0, 23.0)


def poses(count=8) -> list[Pose]:
    angles = np.linspace(0, 5, count)
    return [look_at(np.array([3 * np.cos(a), 3 * np.sin(a), 1.0]), np.zeros(3), UP) for a in angles]


def scene_ply(path: Path) -> None:
    """Ten Gaussians, through the fewest properties that make a scene."""
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", *(f"scale_{i}" for i in range(3))]
    names += [f"rot_{i}" for i in range(4)]
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 10\n"
    header += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    values = np.random.default_rng(0).normal(size=(10, len(names))).astype("<f4")
    path.write_bytes(header.encode() + values.tobytes())


def frames(names: list[str], found: list[Pose]) -> list[dict]:
    keys = {"w": 64, "h": 48, "fl_x": 60.0, "fl_y": 61.0, "cx": 33.0, "cy": 23.0}
    return [
        {"file_path": n, "transform_matrix": (p.world_from_camera @ OPENGL).tolist(), **keys}
        for n, p in zip(names, found, strict=True)
    ]


def photo(path: Path, seed: int = 0) -> None:
    path.parent.mkdir(exist_ok=True)
    pixels = np.random.default_rng(seed).integers(0, 255, (48, 64, 3), np.uint8)
    Image.fromarray(pixels).save(path)


def folder_of(path: Path, layout: str, wrong: Pose | None = None) -> Path:
    """A scene of 8 photos in one of the layouts; `wrong` replaces the query frames' poses among the cameras."""
    path.mkdir()
    scene_ply(path / "scene.ply")
    names = [f"images/{i}.png" for i in range(8)]
    for i, name in enumerate(names):
        photo(path / name, i)
    held = (0, 5) if layout != "unsplit" else (0,)
    stored = [wrong if wrong and i in held else pose for i, pose in enumerate(poses())]
    data = {"frames": frames(names, stored)}
    if layout == "nerfstudio":
        data["test_filenames"] = [names[i] for i in held]
        data["train_filenames"] = [n for i, n in enumerate(names) if i not in held]
    elif layout == "blender":
        (path / "transforms_test.json").write_text(json.dumps({"frames": [data["frames"][i] for i in held]}))
    elif layout == "studio":  # truth in a file of its own, the same views among the cameras under other names
        entries = []
        for i in held:
            photo(path / "photos" / f"query{i}.jpg", i)
            entry = {"photo": f"query{i}.jpg", "original": f"{i}.png", "modification": "none"}
            entry["intrinsics"] = {"width": 64, "height": 48, "fx": 60.0, "fy": 61.0, "cx": 33.0, "cy": 23.0}
            entries.append(entry | {"world_from_camera": poses()[i].world_from_camera.tolist()})
        (path / "truth.json").write_text(json.dumps(entries))
    (path / "transforms.json").write_text(json.dumps(data))
    return path


LAYOUTS = ["nerfstudio", "blender", "studio", "unsplit"]


class TestPhotos:
    @pytest.mark.parametrize("layout", LAYOUTS)
    def test_found_with_their_truth(self, tmp_path, layout):
        found = find_photos(folder_of(tmp_path / "s", layout))
        held = [0] if layout == "unsplit" else [0, 5]
        assert len(found) == len(held)
        for index, one in zip(held, found, strict=True):
            assert one.path.is_file()
            assert one.camera.intrinsics == LENS
            assert np.allclose(one.camera.pose.world_from_camera, poses()[index].world_from_camera, atol=1e-12)

    def test_every_eighth_photo_of_colmaps_model(self, tmp_path):
        """Beside a scene file alone; photos lie in `images`."""
        scene_ply(tmp_path / "scene.ply")
        model = tmp_path / "sparse" / "0"
        model.mkdir(parents=True)
        (model / "cameras.txt").write_text("1 PINHOLE 64 48 60 61 33 23\n")
        lines = [f"{k + 1} 1 0 0 0 {k} 0 0 1 day/{k:02d}.jpg\n\n" for k in range(17)]
        (model / "images.txt").write_text("".join(lines))
        found = find_photos(tmp_path)
        assert [one.path for one in found] == [tmp_path / "images" / "day" / f"{k:02d}.jpg" for k in (0, 8, 16)]
        # As the model names it, so that its camera is held back.
        assert [one.names[0] for one in found] == [f"day/{k:02d}.jpg" for k in (0, 8, 16)]
        assert found[1].camera.pose.position_in_world == pytest.approx([-8, 0, 0])

    def test_truth_moves_with_the_scene(self, tmp_path):
        folder = folder_of(tmp_path / "s", "nerfstudio")
        (folder / "scene.json").write_text(json.dumps({"world_from_scene": np.diag([2.0, 2.0, 2.0, 1.0]).tolist()}))
        (first, _) = find_photos(folder)
        assert np.allclose(first.camera.pose.position_in_world, 2 * poses()[0].position_in_world)

    def test_nothing_to_ask(self, tmp_path):
        scene_ply(tmp_path / "scene.ply")
        with pytest.raises(SceneNotFound, match="no test photos"):
            find_photos(tmp_path)
        with pytest.raises(SceneNotFound, match="no such folder"):
            find_photos(tmp_path / "none")

    @pytest.mark.parametrize("text", ["{", "7", "[{}]", '[{"photo": "a", "intrinsics": {}, "world_from_camera": []}]'])
    def test_broken_truth(self, tmp_path, text):
        (tmp_path / "truth.json").write_text(text)
        with pytest.raises(CorruptScene, match="truth"):
            find_photos(tmp_path)


def estimate(pose: Pose, status=Status.LOCALIZED) -> PoseEstimate:
    verdict = Verdict(status, Reason.VERIFIED, 0.9, 100, 0.8, 1.0, None)
    return PoseEstimate(pose, verdict, LENS, "given", "s", "0", "fake", "fake", "fake", 0, False, 0, (), (), ())


class FakeRasterizer:
    name = "fake"

    def render(self, cameras, **options):
        flat = [np.full((c.intrinsics.height, c.intrinsics.width), 2.0, np.float32) for c in cameras]
        return [Frame(np.repeat(f[:, :, None], 3, 2), f, f, f) for f in flat]

    def pose_gradient(self, camera, d_rgb, d_depth=None, d_alpha=None):
        raise NotImplementedError

    scene_gradients = pose_gradient


class FakeMatcher:
    name = "fake"


class FakeLoaded(LoadedScene):
    """With nothing to prepare."""

    def prepare(self, estimator):
        return None


@pytest.fixture
def runs(monkeypatch):
    """`run` with a fake scene and an estimator that answers what `answer` says; returns what it was given."""
    seen = {"scenes": [], "queries": [], "answer": lambda query, index: poses()[0]}

    def loaded(scene, **_):
        seen["scenes"].append(scene)
        return FakeLoaded(scene, FakeRasterizer(), FakeMatcher())

    def fake_localize(query, loaded, request):
        seen["queries"].append((query, request))
        return estimate(seen["answer"](query, len(seen["queries"])))

    monkeypatch.setattr(bench.LoadedScene, "of", loaded)
    monkeypatch.setattr(bench, "localize", fake_localize)
    return seen


class TestRun:
    @pytest.mark.parametrize("layout", LAYOUTS)
    @pytest.mark.parametrize("cameras", ["given", "ignored"])
    def test_query_frames_are_out_before_the_scene_is_loaded(self, tmp_path, runs, layout, cameras):
        """Wrong poses of the query frames change nothing in the scene that is localized in, nor in the units."""
        wrong = moved(poses()[3], np.array([0.3, -1.0, 0.5, 7.0, -8.0, 9.0]))
        outcomes = [
            bench.run(folder_of(tmp_path / name, layout, pose), cameras=cameras)
            for name, pose in (("right", None), ("wrong", wrong))
        ]
        right, spoilt = runs["scenes"]
        assert right.info.sha256 == spoilt.info.sha256
        held = {"0"} if layout == "unsplit" else {"0", "5"}
        expected = set() if cameras == "ignored" else set("01234567") - held
        assert {Path(c.name).stem for c in right.cameras} == expected
        assert outcomes[0]["units_per_scene_unit"] == outcomes[1]["units_per_scene_unit"]
        assert outcomes[0]["training_cameras"] == 8 - len(held)

    def test_output(self, tmp_path, runs):
        folder = folder_of(tmp_path / "s", "nerfstudio")
        near = moved(poses()[5], np.array([np.radians(2), 0, 0, 0, 0, 0]))
        runs["answer"] = lambda query, index: [poses()[0], poses()[0], near][index - 1]  # the first warms up
        steps = []
        asked = Accuracy(deg=1.0, share=0.05)
        outcome = bench.run(folder, accuracy=asked, progress=lambda done, total: steps.append((done, total)))
        demanded = {
            "scene", "estimator", "start", "queries", "success_5deg_0p05", "success_1deg_0p01",
            "median_rotation_deg", "median_translation_units", "localized", "false_localized",
            "latency_ms_p50", "latency_ms_p95", "cpu_ms_p50", "per_query",
        }  # fmt: skip
        assert demanded <= outcome.keys()
        # Next to nothing is done; sums in place of differences would count from the machine's start.
        assert 0 <= outcome["cpu_ms_p50"] < 1000
        assert 0 < outcome["latency_ms_p50"] <= outcome["latency_ms_p95"] < 60_000
        assert 0 <= outcome["prepare_s"] < 60
        assert json.loads(json.dumps(outcome)) == outcome
        assert (outcome["queries"], outcome["localized"], outcome["false_localized"]) == (2, 2, 0)
        assert (outcome["success_5deg_0p05"], outcome["success_1deg_0p01"]) == (1.0, 0.5)
        assert (outcome["success_asked"], outcome["false_asked"]) == (0.5, 1)
        # Everything that the fake rasterizer shows is 2 scene units away.
        bounds = [line["asked_units"] / outcome["units_per_scene_unit"] for line in outcome["per_query"]]
        assert bounds == pytest.approx([0.1, 0.1])
        assert all(request.accuracy == asked for _, request in runs["queries"])
        assert outcome["median_rotation_deg"] == pytest.approx(1)
        assert [line["photo"] for line in outcome["per_query"]] == ["images/0.png", "images/5.png"]
        assert steps == [(1, 2), (2, 2)]
        assert all(query.prior is None for query, _ in runs["queries"])

    def test_a_miss_is_drawn_and_blamed(self, tmp_path, runs, monkeypatch):
        """The fake scene looks like stripes which tell where they were seen from; the photo has the answer's."""
        far = moved(poses()[5], np.array([0, 0, 0, 1.0, 0, 0]))
        folder = folder_of(tmp_path / "s", "nerfstudio")

        def stripes(_, cameras):
            row = [np.arange(c.intrinsics.width) * (0.3 + abs(c.pose.world_from_camera[0, 3])) for c in cameras]
            size = [(c.intrinsics.height, c.intrinsics.width, 3) for c in cameras]
            rgb = [np.broadcast_to(0.5 + 0.4 * np.sin(r)[None, :, None], s) for r, s in zip(row, size, strict=True)]
            return [Frame(r.astype(np.float32), *3 * (np.ones(r.shape[:2], np.float32),)) for r in rgb]

        monkeypatch.setattr(FakeRasterizer, "render", stripes)
        (seen,) = stripes(None, [Camera(LENS, far)])
        (folder / "images" / "5.png").write_bytes(encode_image(0.5 * seen.rgb + 0.2, "png"))
        runs["answer"] = lambda query, index: [poses()[0], poses()[0], far][index - 1]
        outcome = bench.run(folder, on_miss=save_miss_images(tmp_path / "misses"))
        right, wrong = outcome["per_query"]
        assert "picture" not in right
        assert [p.name for p in (tmp_path / "misses").iterdir()] == [wrong["picture"]] == ["s-images_5.png-0.jpg"]
        assert wrong["residual_at_answer"] < 0.003 < 0.05 < wrong["residual_at_truth"]  # 8 bits; seen: 0.001, 0.13

    def test_what_is_no_photo_counts_for_no_residual(self, monkeypatch):
        """The left half of the photo is transparent; there the render is anything."""
        rgba = np.full((48, 64, 4), 100, np.uint8)
        rgba[:, 32:, 3] = 255
        rgba[:, :32, 3] = 0
        rgba[::2, 32:, 0] = 200
        buffer = io.BytesIO()
        Image.fromarray(rgba).save(buffer, "PNG")
        render = rgba[:, :, :3].astype(np.float32) / 255
        render[:, :30] = np.random.default_rng(0).uniform(size=(48, 30, 3))

        def rendered(cameras):
            flat = np.ones((48, 64), np.float32)
            return [Frame(render, flat, flat, flat) for _ in cameras]

        loaded = SimpleNamespace(rasterizer=SimpleNamespace(render=rendered))
        one = SimpleNamespace(background_rgb=(0.0, 0.0, 0.0), loaded=loaded)
        trial = SimpleNamespace(data=buffer.getvalue(), intrinsics=LENS, truth=Camera(LENS, poses()[0]))
        image, here, there = miss_image(one, trial, estimate(poses()[0]))
        assert here == there < 0.002
        # The differences, too, are black there.
        drawn = read_query(image).rgb
        assert drawn.shape[:2] == (48, 5 * 64)
        assert drawn[:, 2 * 64 + 2 : 2 * 64 + 28].max() < 12

    def test_trials_have_starts_of_their_own_the_same_every_time(self, tmp_path, runs):
        folder = folder_of(tmp_path / "s", "nerfstudio")
        outcome = bench.run(folder, start="easy", trials=3, seed=4)
        again = bench.run(folder, start="easy", trials=3, seed=4)
        other = bench.run(folder, start="easy", trials=3, seed=5)
        starts = [[line["start_rotation_deg"] for line in o["per_query"]] for o in (outcome, again, other)]
        assert outcome["queries"] == 6
        assert len(set(starts[0])) == 6
        assert starts[0] == starts[1] != starts[2]
        priors = [query.prior for query, _ in runs["queries"]]
        assert all(prior is not None for prior in priors)
        assert pose_distance(priors[1], poses()[0])[0] == pytest.approx(starts[0][0])

    def test_intrinsics_withheld(self, tmp_path, runs):
        folder = folder_of(tmp_path / "s", "nerfstudio")
        bench.run(folder, intrinsics="withheld")
        assert runs["queries"][0][0].intrinsics_source == "guessed"
        bench.run(folder)
        assert runs["queries"][-1][0].intrinsics == LENS

    def test_modified_geometry_is_sent_and_compared_with_its_own_truth(self, tmp_path, runs):
        folder = folder_of(tmp_path / "s", "unsplit")
        turned = moved(poses()[0], np.array([0, 0, np.radians(90), 0, 0, 0]))
        runs["answer"] = lambda query, index: turned
        outcome = bench.run(folder, modify=("roll=90", "gain=0.5"))
        query = runs["queries"][0][0]
        assert query.rgb.shape == (65, 48, 3)  # 64 columns of 1/60, now as rows of 1/60.5 focal lengths
        assert (query.intrinsics.width, query.intrinsics_source) == (48, "given")
        assert outcome["success_1deg_0p01"] == 1
        assert outcome["modify"] == ["roll=90", "gain=0.5"]

    def test_a_modified_scene_keeps_units_and_cameras(self, tmp_path, runs):
        folder = folder_of(tmp_path / "s", "nerfstudio")
        plain, spoilt = bench.run(folder), bench.run(folder, modify_scene=("thin=0.5",))
        scene, modified = runs["scenes"][0], runs["scenes"][-1]
        assert (scene.count, modified.count, spoilt["modify_scene"]) == (10, 5, ["thin=0.5"])
        assert modified.info.sha256 != scene.info.sha256
        assert len(modified.cameras) == len(scene.cameras) == spoilt["training_cameras"]
        assert spoilt["units_per_scene_unit"] == plain["units_per_scene_unit"]

    @pytest.mark.parametrize(
        ("arguments", "error"),
        [
            ({"start": "hrad"}, UnknownName),
            ({"modify": ("sharpen=3",)}, UnknownName),
            ({"modify_scene": ("smoke=3",)}, UnknownName),
            ({"modify_scene": ("dark=x",)}, InvalidOptions),
            ({"modify": ("blur=x",)}, InvalidOptions),
            ({"modify": ("blur",)}, InvalidOptions),
            ({"modify": ("occlusion=2",)}, InvalidOptions),
            ({"modify": ("occlusion=0.2",)}, InvalidOptions),
            ({"layout": "tartan"}, UnknownName),
        ],
    )
    def test_wrong_words(self, tmp_path, runs, arguments, error):
        with pytest.raises(error):
            bench.run(folder_of(tmp_path / "s", "nerfstudio"), **arguments)

    def test_depth_of_the_middle(self):
        assert centre_depth(FakeRasterizer(), Camera(LENS, poses()[0])) == 2


class TestStarts:
    UNITS = Units(np.array([1.0, -2.0, 0.5]), 0.5, False)
    CAMERAS = tuple(Camera(LENS, pose) for pose in poses())

    @pytest.mark.parametrize(
        ("kind", "degrees", "lengths"),
        [("near", (0, 2), (0, 0.05)), ("easy", (0, 30), (0, 0.5)), ("hard", (30, 60), (0.5, 1))],
    )
    @given(seed=st.integers(0, 1000))
    def test_world_frame(self, kind, degrees, lengths, seed):
        angles, shift = self.change(kind, np.random.default_rng(seed))
        assert np.all((shift >= lengths[0] - 1e-9) & (shift <= lengths[1] + 1e-9))
        assert np.all((angles >= degrees[0] - 1e-6) & (angles <= degrees[1] + 1e-6))
        for end in (0, 1):
            angles, shift = self.change(kind, PlannedNumbers(end))
            assert angles == pytest.approx(np.full(3, degrees[end]), abs=1e-6)
            assert shift == pytest.approx(np.full(3, lengths[end]), abs=1e-9)

    def change(self, kind, rng):
        """Return angles and shift of a start, undone by hand in the normalized frame: start = T Rz Ry Rx gt."""
        truth = poses()[1]
        start = start_pose(kind, truth, self.UNITS, self.CAMERAS, rng)
        assert start is not None
        normalized = self.UNITS.normalized_from_world()
        both = []
        for pose in (start, truth):
            matrix = np.eye(4)
            matrix[:3, :3] = pose.world_from_camera[:3, :3]
            matrix[:3, 3] = (normalized @ [*pose.position_in_world, 1])[:3]
            both.append(matrix)
        change = both[0] @ np.linalg.inv(both[1])
        r = change[:3, :3]  # Rz Ry Rx, taken apart
        angles = np.degrees([np.arctan2(r[2, 1], r[2, 2]), -np.arcsin(r[2, 0]), np.arctan2(r[1, 0], r[0, 0])])
        return np.abs(angles), np.abs(change[:3, 3])

    def test_as_far_as_the_protocol_says(self):
        """Three turns of up to 30 degrees are some 30 together; 4 units from the focus that is over a unit off."""
        units = units_of(self.CAMERAS, lambda camera: 0.0)
        rng = np.random.default_rng(0)
        found = []
        for _ in range(100):
            start = start_pose("easy", poses()[2], units, self.CAMERAS, rng)
            assert start is not None
            angle, distance = pose_distance(start, poses()[2])
            found.append((angle, distance * units.units_per_scene_unit))
        angle, distance = np.median(found, axis=0)
        assert 25 < angle < 35  # seen: 29.9
        assert 1.2 < distance < 2.0  # seen: 1.59

    @given(seed=st.integers(0, 1000))
    def test_inplace(self, seed):
        start = start_pose("inplace", poses()[1], self.UNITS, self.CAMERAS, np.random.default_rng(seed))
        assert start is not None
        angle, distance = pose_distance(start, poses()[1])
        assert 15 <= angle <= 40
        assert distance == 0

    def test_random_is_within_the_cameras(self):
        positions = np.stack([pose.position_in_world for pose in poses()])
        rng = np.random.default_rng(0)
        turns = []
        for _ in range(200):
            start = start_pose("random", poses()[1], self.UNITS, self.CAMERAS, rng)
            assert start is not None
            assert np.all(start.position_in_world >= positions.min(0))
            assert np.all(start.position_in_world <= positions.max(0))
            turns.append(np.linalg.norm(so3_log(start.world_from_camera[:3, :3])))
        assert 110 < np.degrees(np.mean(turns)) < 140  # the mean of uniform rotations is 126.5

    def test_none_and_unknown(self):
        rng = np.random.default_rng(0)
        assert start_pose("none", poses()[0], self.UNITS, self.CAMERAS, rng) is None
        with pytest.raises(UnknownName, match="inplace"):
            start_pose("far", poses()[0], self.UNITS, self.CAMERAS, rng)
        assert KINDS == ("none", "near", "easy", "hard", "pnerf", "inplace", "random")

    def test_a_case_by_hand(self):
        """Quarter turns about x and then z carry (0, -1, 0) to (0, 0, -1) and leave it there."""

        class Drawn:
            def choice(self, signs, count):
                return np.array([1.0, 1, 1, 1, -1, 1])

            def uniform(self, low, high, count):
                return np.array([90.0, 0.0, 90.0]) if high == 60 else np.array([0.5, 0.75, 1.0])

        truth = look_at(np.array([1.0, -4.0, 0.5]), np.array([1.0, 0.0, 0.5]), UP)  # focus at (1, -2, 0.5), 2 away
        start = start_pose("hard", truth, self.UNITS, self.CAMERAS, Drawn())  # type: ignore[arg-type]
        assert start is not None
        # normalized by 0.5: offset (0, -1, 0) -> (0, 0, -1), then shifted by (0.5, -0.75, 1)
        assert start.position_in_world == pytest.approx(np.array([1.0, -2, 0.5]) + 2 * np.array([0.5, -0.75, 0.0]))
        # it looked along +y: Rx takes that to +z, where Rz leaves it
        assert start.axis_in_world == pytest.approx([0.0, 0.0, 1.0])

    @given(seed=st.integers(0, 1000))
    def test_pnerf_turns_in_place(self, seed):
        start = start_pose("pnerf", poses()[1], self.UNITS, self.CAMERAS, np.random.default_rng(seed))
        assert start is not None
        shift = (start.position_in_world - poses()[1].position_in_world) * 0.5
        assert np.all(np.abs(shift) <= 0.25)
        r = start.world_from_camera[:3, :3] @ poses()[1].world_from_camera[:3, :3].T
        angles = np.degrees([np.arctan2(r[2, 1], r[2, 2]), -np.arcsin(r[2, 0]), np.arctan2(r[1, 0], r[0, 0])])
        assert np.all(np.abs(angles) <= 15)


def dotted_photo() -> tuple[Photo, np.ndarray]:
    """A dark photo with a bright dot where each of some points is seen."""
    camera = Intrinsics(160, 120, 130.0, 140.0, 85.0, 57.0)
    pose = poses()[2]
    points_in_camera = np.array([[-0.2, -0.15, 1.0], [0.25, -0.1, 1.2], [0.05, 0.2, 0.9], [-0.15, 0.2, 1.1]])
    rows, columns = np.mgrid[:120, :160]
    rgb = np.zeros((120, 160, 3), np.float32)
    for x, y in project(points_in_camera, camera):
        rgb += np.exp(-((columns + 0.5 - x) ** 2 + (rows + 0.5 - y) ** 2) / 8)[..., None].astype(np.float32)
    return Photo(rgb, camera, pose), transformed(pose.world_from_camera, points_in_camera)


class TestModifications:
    @pytest.mark.parametrize(
        "specs",
        [
            ["roll=90"],
            ["roll=-90"],
            ["roll=180"],
            ["roll=23"],
            ["crop=0.8"],
            ["roll=45", "crop=0.9"],
            ["jpeg=90"],
            ["scale=1.6"],
            ["scale=0.75", "roll=10"],
        ],
    )
    def test_truth_goes_with_the_pixels(self, specs):
        """The dots must lie where the new camera projects the points from the new pose."""
        original, points_in_world = dotted_photo()
        photo = modify(original, specs, np.random.default_rng(0))
        assert photo.rgb.shape == (photo.intrinsics.height, photo.intrinsics.width, 3)
        expected = project(transformed(photo.pose.camera_from_world, points_in_world), photo.intrinsics)
        for x, y in expected:
            left, top = int(x) - 6, int(y) - 6
            window = photo.rgb[top : top + 13, left : left + 13, 1].astype(float)
            window = np.where(window > 0.1, window, 0)
            rows, columns = np.mgrid[top : top + 13, left : left + 13]
            found = [(window * (c + 0.5)).sum() / window.sum() for c in (columns, rows)]
            assert np.abs(np.array(found) - [x, y]).max() < 0.1  # seen: 0.06; half a pixel would be 0.5

    def test_quarter_turns_lose_nothing(self):
        rgb = np.random.default_rng(0).uniform(0, 1, (48, 64, 3)).astype(np.float32)
        original = Photo(rgb, Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0), poses()[0])
        for spec, turned in (
            ("roll=90", np.rot90(rgb, 1)),
            ("roll=-90", np.rot90(rgb, -1)),
            ("roll=180", rgb[::-1, ::-1]),
        ):
            found = modify(original, [spec], np.random.default_rng(0)).rgb
            assert np.allclose(found, turned, atol=1e-5), spec

    def test_values(self):
        rgb = np.full((40, 60, 3), 0.4, np.float32)
        original = Photo(rgb, Intrinsics(60, 40, 50.0, 50.0, 30.0, 20.0), poses()[0])
        rng = np.random.default_rng(0)
        assert np.allclose(modify(original, ["gain=1.5"], rng).rgb, 0.6)
        assert np.allclose(modify(original, ["gain=4"], rng).rgb, 1.0)
        assert np.allclose(modify(original, ["gamma=2"], rng).rgb, 0.16)
        assert np.allclose(modify(original, ["blur=3"], rng).rgb, 0.4, atol=1e-6)
        assert modify(original, ["noise=0.1"], rng).rgb.std() == pytest.approx(0.1, rel=0.05)
        warm = modify(original, ["white_balance=1.25"], rng).rgb
        assert np.allclose(warm[0, 0], [0.5, 0.4, 0.32])
        red = replace(original, rgb=rgb * np.array([1.0, 0.0, 0.0], np.float32))
        assert np.allclose(modify(red, ["saturation=0"], rng).rgb, 0.299 * 0.4, atol=1e-6)
        assert np.allclose(modify(red, ["saturation=0.5"], rng).rgb[0, 0], [0.2598, 0.0598, 0.0598], atol=1e-6)
        assert np.allclose(modify(original, ["jpeg=80"], rng).rgb, 0.4, atol=0.01)

    def test_samples_on_and_beyond_the_edge_are_black(self):
        white = np.ones((4, 6, 3), np.float32)
        x, y = np.meshgrid([0.0, 1e-6, 3.0, 6 - 1e-6, 6.0], [0.0, 1e-6, 2.0, 4 - 1e-6, 4.0])
        expected = np.zeros((5, 5))
        expected[1:4, 1:4] = 1
        assert np.array_equal(modifications._sample(white, x, y)[..., 0], expected)

    def test_blur_has_its_width(self):
        """A bright point becomes a Gaussian of the given sigma, in pixels of a photo 800 wide."""
        rgb = np.zeros((81, 401, 3), np.float32)
        rgb[40, 200] = 1
        original = Photo(rgb, Intrinsics(401, 81, 300.0, 300.0, 200.5, 40.5), poses()[0])
        row = modify(original, ["blur=4"], np.random.default_rng(0)).rgb[:, :, 0].sum(0)
        columns = np.arange(401) - 200
        assert row.sum() == pytest.approx(1, abs=1e-5)
        assert np.sqrt((row * columns**2).sum()) == pytest.approx(4 * 401 / 800, rel=0.03)

    @pytest.mark.parametrize("name", MODIFICATIONS)
    def test_all_take_both_ends_of_their_range(self, name):
        original, _ = dotted_photo()
        for value in MODIFICATIONS[name][:2]:
            original = replace(original, occluders=(original.rgb,))
            found = modify(original, [f"{name}={value}"], np.random.default_rng(0))
            assert found.rgb.dtype == np.float32
            assert np.isfinite(found.rgb).all()
            assert found.rgb.shape[:2] == (found.intrinsics.height, found.intrinsics.width)

    def test_the_file_is_without_loss(self, tmp_path):
        (one,) = find_photos(folder_of(tmp_path / "s", "unsplit"))
        cropped = prepare_photo(one, ("crop=1",), (0.0, 0.0, 0.0), 0)
        assert cropped.truth.intrinsics == cropped.intrinsics == one.camera.intrinsics
        assert np.array_equal(read_query(cropped.data).rgb, read_query(one.path.read_bytes()).rgb)
        assert prepare_photo(one, (), (0.0, 0.0, 0.0), 0).data == one.path.read_bytes()

    def test_padding_is_transparent(self, tmp_path):
        """So it has the scene's background in the query, and none of it is taken for the photo."""
        (one,) = find_photos(folder_of(tmp_path / "s", "unsplit"))
        turned = prepare_photo(one, ("roll=30",), (0.0, 0.0, 0.0), 0)
        size = (turned.truth.intrinsics.width, turned.truth.intrinsics.height)
        assert Image.open(io.BytesIO(turned.data)).size == size
        alpha = np.asarray(Image.open(io.BytesIO(turned.data)).convert("RGBA"))[..., 3]
        assert alpha[0, 0] == 0
        assert (alpha > 0).sum() == pytest.approx(64 * 48 * 60.5**2 / 60 / 61, rel=0.1)  # less the rim
        shown = read_query(turned.data, intrinsics=turned.intrinsics, background_rgb=(0.0, 1.0, 0.0)).rgb
        assert shown[0, 0].tolist() == [0, 255, 0]

    @pytest.mark.parametrize("share", [0.05, 0.2, 0.35, 0.9])
    def test_occlusion_covers_exactly_its_share_with_the_other_scene(self, share):
        rng = np.random.default_rng(1)
        rgb = np.full((48, 64, 3), 2.0, np.float32)  # no photo has that
        other = rng.uniform(0, 1, (30, 40, 3)).astype(np.float32)
        original = Photo(rgb, LENS, poses()[0], occluders=(other,))
        places = []
        for seed in range(3):
            found = modify(original, [f"occlusion={share}"], np.random.default_rng(seed)).rgb
            covered = np.all(found != 2.0, axis=2)
            assert covered.sum() == round(share * 48 * 64)
            known = {tuple(p) for p in other.reshape(-1, 3).tolist()}
            assert {tuple(p) for p in found[covered].tolist()} <= known
            places.append(covered)
        assert not np.array_equal(places[0], places[1])

    def test_a_false_focal_length_is_told_and_the_truth_kept(self, tmp_path):
        (one,) = find_photos(folder_of(tmp_path / "s", "unsplit"))
        false = prepare_photo(one, ("focal=1.1",), (0.0, 0.0, 0.0), 0)
        assert false.truth == one.camera
        assert (false.intrinsics.fx, false.intrinsics.fy) == pytest.approx((66.0, 67.1))
        assert np.array_equal(read_query(false.data).rgb, read_query(one.path.read_bytes()).rgb)


class TestRoom:
    def test_same_every_time(self):
        a, b = render_bench.synthetic_room(500), render_bench.synthetic_room(500)
        for name in ("means", "quats", "scales", "opacities", "sh"):
            assert np.array_equal(getattr(a, name), getattr(b, name))
        assert (a.count, a.sh_degree) == (500, 3)
        assert np.allclose(np.linalg.norm(a.quats, axis=1), 1, atol=1e-6)

    def test_furniture_stands_on_the_floor_of_the_room(self):
        means, normals, area = render_bench._on_surfaces(20_000, np.random.default_rng(0))
        # Of a room of 8 by 6 by 3, and six boxes: by hand.
        assert area == pytest.approx(180 + 10.92 + 16.56 + 8.96 + 10.36 + 3.2 + 8.82)
        assert (np.abs(means) <= np.array([4.0, 3.0, 1.5]) + 1e-9).all()
        levels = np.unique(means[normals[:, 2] == 1, 2].round(6))
        heights = (1.1, 1.9, 0.8, 1.4, 0.6, 2.0)
        assert levels == pytest.approx(sorted([-1.5, 1.5, *(-1.5 + height for height in heights)]))
        # As many everywhere: the share of the ceiling and the floor, beneath boxes, too.
        flat = normals[:, 2] == 1
        shares = [np.mean(flat & np.isclose(means[:, 2], level)) for level in (1.5, -1.5)]
        beneath = 1.2 * 1.8 + 1.0 * 2.2 + 2.4 * 0.8 + 2.0 * 0.7 + 0.8 * 0.8 + 0.9 * 0.9
        assert shares == pytest.approx([48 / area, (48 + beneath) / area], abs=0.01)

    def test_gaussians_that_are_a_sigma_larger_brighter_and_more_coloured(self, monkeypatch):
        monkeypatch.setattr(render_bench.np.random, "default_rng", lambda seed: PlannedNumbers(sigmas=1.0))
        room = render_bench.synthetic_room(400, sh_degree=1)
        wide = 0.8 * np.sqrt(238.82 / 400) * np.exp(0.35)  # the area by hand, above
        assert room.scales == pytest.approx(np.tile([wide, wide, 0.1 * wide], (400, 1)), rel=1e-5)
        assert room.opacities == pytest.approx(np.full(400, 0.924142), abs=1e-6)  # the logistic function at 1 + 1.5
        # A tenth, with centres that are drawn from all of the room, is in the middle; the others in their faces'.
        assert np.count_nonzero(np.all(room.means == 0, axis=1)) == 40
        x, y, z = room.means[0].astype(float)
        assert (x, y, z) == (-4, 0, 0)
        # Red varies with x, green with y, blue with z, and all with x.
        assert room.sh[0, 0] == pytest.approx(1.2 * np.sin([1.3 * -4 - 4, -4, -4]), abs=1e-5)
        assert room.sh[:, 1:] == pytest.approx(np.full((400, 3, 3), 0.05))

    def test_opacities_are_between_none_and_full(self):
        room = render_bench.synthetic_room(2000)
        assert 0 < room.opacities.min() < 0.2
        assert 0.95 < room.opacities.max() < 1

    def test_any_normal_is_the_thin_axis(self):
        normals = np.array([[0, 0, 1], [0, 0, -1], [1, 0, 0], [0, -1, 0], [0.6, 0, -0.8], [0.48, 0.6, 0.64]])
        for share in (0.0, 0.3):
            turned = rotation_from_quat(render_bench._rotations_to(normals, PlannedNumbers(share)))
            assert turned[:, :, 2] == pytest.approx(normals, abs=1e-12)
            # The upright one is turned about its own axis by twice what is drawn of half a turn.
            angle = 2 * np.pi * share
            assert turned[0, :, 0] == pytest.approx([np.cos(angle), np.sin(angle), 0], abs=1e-12)

    def test_cameras_are_inside_and_see_7_to_10_percent(self):
        room = render_bench.synthetic_room(20_000)
        shares = []
        for camera in render_bench.room_cameras(400):
            assert camera.intrinsics.width * 3 == camera.intrinsics.height * 4
            assert np.all(np.abs(camera.pose.position_in_world) < render_bench.ROOM / 2)
            points = transformed(camera.pose.camera_from_world, room.means)
            px = project(points, camera.intrinsics)
            reach = 3 * room.scales.max(1) / np.maximum(points[:, 2], 0.01) * camera.intrinsics.fx
            seen = np.all((px > -reach[:, None]) & (px < [400, 300] + reach[:, None]), axis=1) & (points[:, 2] > 0.01)
            shares.append(seen.mean())
        assert min(shares) > 0.07
        assert max(shares) < 0.12

    def test_flat_gaussians_lie_in_their_walls(self):
        room = render_bench.synthetic_room(2000)
        on_ceiling = np.isclose(room.means[:, 2], 1.5)
        thin = rotation_from_quat(room.quats[on_ceiling])[:, :, 2]
        assert on_ceiling.sum() > 100
        assert np.allclose(np.abs(thin[:, 2]), 1, atol=1e-5)

    def test_run(self, monkeypatch):
        class Backend:
            """The gradients are of the camera that was rendered last."""

            name = "fake"

            def __init__(self, scene):
                assert scene.info.training_focal_px == render_bench.room_cameras(16)[0].intrinsics.fx

            def render(self, cameras, **options):
                calls.append(len(cameras))
                self.camera = cameras[-1]

            def pose_gradient(self, camera, d_rgb, d_depth=None, d_alpha=None):
                calls.append(0)
                assert camera is self.camera
                assert d_rgb.shape == (12, 16, 3)

            scene_gradients = pose_gradient

        module = type("module", (), {"create": Backend})
        monkeypatch.setattr(render_bench.RASTERIZERS, "load", lambda name: module)
        monkeypatch.setattr(render_bench.os, "cpu_count", lambda: 2)
        clock = iter(np.arange(0, 1e4, 0.5))  # every call takes half a second
        monkeypatch.setattr(render_bench.time, "perf_counter", lambda: next(clock))
        shown, calls = [], []
        rows = render_bench.run(repeats=2, cases=((50, 16),), progress=lambda *now: shown.append(now))
        assert shown == [(1, 1)]
        # Three times of each camera, each with two gradients, and three times of all together.
        assert [calls.count(n) for n in (0, 1, 6)] == [36, 18, 3]
        assert [(r["stage"], r["threads"]) for r in rows] == [
            ("forward", 1),
            ("pose_gradient", 1),
            ("all_gradients", 1),
            ("forward", 2),
        ]
        assert [r["ms_min"] for r in rows] == [r["ms_median"] for r in rows] == [500, 500, 500, pytest.approx(500 / 6)]
        assert {k: rows[0][k] for k in ("gaussians", "sh_degree", "width", "height")} == {
            "gaussians": 50, "sh_degree": 3, "width": 16, "height": 12,
        }  # fmt: skip


def test_encode_image():
    rgb = np.random.default_rng(0).integers(0, 255, (40, 50, 3), np.uint8)
    assert np.array_equal(read_query(encode_image(rgb, "png")).rgb, rgb)
    assert np.array_equal(read_query(encode_image(rgb.astype(np.float32) / 255, "png")).rgb, rgb)
    assert len(encode_image(rgb, quality=20)) < len(encode_image(rgb, quality=90))


def test_the_squared_error_in_units_of_the_covariance():
    found = estimate(Pose(np.eye(4)))
    truth = moved(found.pose, np.array([0.0, 0.0, 0.02, 0.0, 0.3, 0.0]))
    spread = np.array([0.01, 0.01, 0.01, 0.1, 0.1, 0.1])
    told = [np.diag(spread**2), np.diag([0.0, *spread[1:] ** 2]), None]
    weighed = [nees(replace(found, verdict=replace(found.verdict, covariance=c)), truth) for c in told]
    assert weighed == [pytest.approx(2**2 + 3**2), None, None]


def test_a_palette_saves_most_of_the_bytes():
    shades = np.linspace(0, 255, 200).astype(np.uint8)
    picture = np.stack(np.meshgrid(shades, shades), 2)
    rgb = np.concatenate([picture, np.random.default_rng(0).integers(0, 9, (200, 200, 1), np.uint8)], 2)
    small = with_palette(encode_image(rgb, "png"))
    assert len(small) < len(encode_image(rgb, "png")) / 2
    assert np.abs(read_query(small).rgb.astype(int) - rgb).mean() < 6  # seen: 3.6
