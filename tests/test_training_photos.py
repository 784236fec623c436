"""Digests of training photos: photos with more detail than the scene, which is a blurred studio."""

from __future__ import annotations

import json
import logging
import zipfile
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from small_room import write_room
from typer.testing import CliRunner

from service.cli.app import app
from service.errors import SceneNotFound
from service.geometry import moved, pose_distance, project, se3_exp, transformed
from service.interfaces import SurfacePoints
from service.loaded_scene import LoadedScene
from service.localize import localize
from service.photos.images import encode_image
from service.pose.features.rendered_views import to_uint8
from service.pose.training_photos.corners import surface_corners
from service.pose.training_photos.digest import PhotoDigest, TrainingPhoto, digest_of, scene_key
from service.pose.training_photos.digest_file import DIGEST_FILE, read_digest, write_digest
from service.pose.training_photos.patch_kernels import linearize_places, match_patches
from service.pose.training_photos.patch_matching import PATCHES, grey
from service.pose.training_photos.surface_points import PosedPhoto, triangulated_corners
from service.results import PoseEstimate, Status
from service.scene_manager.scene_archive import unpack
from service.types import Camera, Intrinsics, NamedCamera, Pose, Query

STUDIO = Path(__file__).parents[1] / "scenes" / "studio"
LENS = Intrinsics(640, 480, 533.0, 533.0, 320.0, 240.0)
PHOTOS = 6
BLUR = 0.006
"""Standard deviation, in metres, of where the Gaussians of the blurred studio lie about those of the sharp one."""


def viewpoint(number: int) -> Pose:
    """A camera near the studio's first one."""
    offset = np.random.default_rng(number).uniform(-1, 1, 6) * [0.05, 0.05, 0.05, 0.25, 0.15, 0.15]
    return moved(sharp().scene.cameras[0].camera.pose, offset)


@cache
def sharp() -> LoadedScene:
    return LoadedScene.load(STUDIO)


def photo_from(pose: Pose, lens: Intrinsics = LENS) -> np.ndarray:
    """Return what a camera sees in the sharp studio, uint8."""
    return to_uint8(sharp().rasterizer.render([Camera(lens, pose)])[0].rgb)


def training_photo(loaded: LoadedScene, number: int, given: Pose) -> TrainingPhoto:
    """Return the photo of a viewpoint, with a pose that the camera file gives."""
    named = NamedCamera(f"{number}.png", Camera(LENS, given))
    found = TrainingPhoto.read(
        named, encode_image(photo_from(viewpoint(number)), "png"), (0.0, 0.0, 0.0), loaded.matcher
    )
    assert found is not None
    return found


def blurred_studio() -> LoadedScene:
    """Return the studio with less detail than its photos have, and with their digest."""
    noise = np.random.default_rng(7).normal(0, BLUR, sharp().scene.means.shape)
    cameras = tuple(NamedCamera(f"{number}.png", Camera(LENS, viewpoint(number))) for number in range(PHOTOS))
    loaded = LoadedScene.of(replace(sharp().scene, means=sharp().scene.means + noise, cameras=cameras))
    photos = [training_photo(loaded, number, viewpoint(number)) for number in range(PHOTOS)]
    loaded.photo_digest = digest_of(photos, loaded.scene, loaded.rasterizer)
    return loaded


@pytest.fixture(scope="module")
def studio() -> LoadedScene:
    return blurred_studio()


def digest(loaded: LoadedScene) -> PhotoDigest:
    assert loaded.photo_digest is not None
    return loaded.photo_digest


# ------------------------------------------------------------------ triangulated points


def test_points_lie_on_the_surface_that_the_photos_show(studio: LoadedScene) -> None:
    points = digest(studio).points
    own = np.flatnonzero(points.photo == 0)
    local = transformed(viewpoint(0).camera_from_world, points.points_in_world[own])
    column, row = project(local, LENS).astype(int).T
    depth = sharp().rasterizer.render([Camera(LENS, viewpoint(0))])[0].median_depth[row, column]
    assert len(own) > 50
    # Seen: 0.0025; the render's own depth is that of Gaussians, some of which are as thick.
    assert np.median(np.abs(depth / local[:, 2] - 1)) < 0.004


def test_points_are_triangulated_whatever_the_rendered_depth(studio: LoadedScene) -> None:
    """That is a start and a check: here it is 4 % too far."""
    cameras = [Camera(LENS, viewpoint(number)) for number in range(PHOTOS)]
    photos = [PosedPhoto(grey(photo_from(camera.pose)), camera) for camera in cameras]
    frame = sharp().rasterizer.render([cameras[0]])[0]
    found = {}
    for factor in (1.0, 1.04, 1.3):
        off = replace(frame, median_depth=frame.median_depth * np.float32(factor))
        corners = surface_corners(photos[0].grey, None, off, cameras[0])
        found[factor] = triangulated_corners(0, corners, photos)
    # Seen: 0.9995 and 0.9611, of 369 and 367 points, and no point at all.
    assert np.median(found[1.0].depth_ratio) == pytest.approx(1.0, abs=0.003)
    assert np.median(found[1.04].depth_ratio) == pytest.approx(1 / 1.04, abs=0.004)
    # Far off, a neighbour shows something else there.
    assert len(found[1.3].rms_px) == 0


def test_what_is_kept_of_a_photo_is_small(studio: LoadedScene) -> None:
    found = digest(studio)
    assert found.names == tuple(f"{number}.png" for number in range(PHOTOS))
    assert found.nbytes < 200_000 * len(found.names)
    assert len(found.points.patches) == len(found.points.photo) == len(found.points.points_in_world)


def test_its_effect_is_measured_with_photos_without_their_own_patches(studio: LoadedScene) -> None:
    effect = digest(studio).effect
    assert effect is not None
    without, with_digest = effect
    assert with_digest < without


def test_poses_are_refined_where_the_scene_does_not_lie_as_the_camera_file_says(studio: LoadedScene) -> None:
    """As after training with optimized poses. The scene's own poses are the true ones here."""
    rng = np.random.default_rng(1)
    given = [moved(viewpoint(number), rng.normal(0, [0.01] * 3 + [0.03] * 3)) for number in range(4)]
    photos = [training_photo(studio, number, given[number]) for number in range(4)]
    found = digest_of(photos, studio.scene, studio.rasterizer)
    assert found is not None
    assert found.is_aligned
    assert found.effect is None
    assert not digest(studio).is_aligned
    for number in range(4):
        # Seen: 0.0034 at most, from 0.02 to 0.05.
        assert np.linalg.norm(found.points.photo_positions[number] - viewpoint(number).position_in_world) < 0.005
        used = moved(given[number], -found.offsets[number])
        assert np.linalg.norm(used.position_in_world - viewpoint(number).position_in_world) < 0.02


def test_photos_that_share_nothing_have_no_digest(studio: LoadedScene) -> None:
    assert digest_of([training_photo(studio, 0, viewpoint(0))], studio.scene, studio.rasterizer) is None
    assert digest_of([], studio.scene, studio.rasterizer) is None


# ------------------------------------------------------------------ the pose by patches


def unseen(number: int) -> Pose:
    """A viewpoint between those of the training photos."""
    return moved(viewpoint(number), np.array([0.02, -0.03, 0.05, 0.05, 0.03, -0.04]))


def query_at(pose: Pose, lens: Intrinsics = LENS) -> Query:
    return Query(photo_from(pose, lens), lens, "given", lens)


def both(loaded: LoadedScene, query: Query) -> tuple[PoseEstimate, PoseEstimate]:
    """Localize without and with the digest."""
    without = replace(loaded, photo_digest=None, _prepared=loaded._prepared)
    return localize(query, without), localize(query, loaded)


def test_a_photo_is_localized_more_exactly(studio: LoadedScene) -> None:
    distances = []
    for number in (1, 4):
        truth = unseen(number)
        without, with_digest = both(studio, query_at(truth))
        distances.append([pose_distance(found.pose, truth)[1] for found in (without, with_digest)])
        assert without.verdict.status is with_digest.verdict.status is Status.LOCALIZED
        assert "refine_by_patches" not in {record.stage for record in without.records}
        (record,) = [record for record in with_digest.records if record.stage == "refine_by_patches"]
        assert (record.num_matches or 0) >= (record.num_inliers or 0) >= 40
        assert np.array_equal(record.pose.world_from_camera, with_digest.pose.world_from_camera)
        smaller, larger = with_digest.verdict.covariance, without.verdict.covariance
        assert smaller is not None
        assert larger is not None
        assert np.trace(smaller[3:, 3:]) < np.trace(larger[3:, 3:])
        # Seen: 1.6 standard deviations at most.
        assert distances[-1][1] < 3 * np.sqrt(np.trace(smaller[3:, 3:]))
    before, after = np.median(distances, 0)
    # Seen: 3.9 mm and 0.9 mm.
    assert after < 0.5 * before
    assert after < 0.0015


def test_the_covariance_never_makes_a_verdict_better(studio: LoadedScene) -> None:
    without, with_digest = both(studio, query_at(unseen(2)))
    assert with_digest.verdict.status is without.verdict.status
    assert with_digest.verdict.right_place == without.verdict.right_place


@pytest.mark.parametrize(
    ("lens", "why"),
    [
        (replace(LENS, trust="approximate"), "approximate intrinsics"),
        (LENS.resized(480, 360), "hardly larger than renders"),
    ],
)
def test_other_photos_are_localized_as_without(studio: LoadedScene, lens: Intrinsics, why: str) -> None:
    without, with_digest = both(studio, query_at(unseen(1), lens))
    assert np.array_equal(without.pose.world_from_camera, with_digest.pose.world_from_camera), why
    assert without.verdict.score == with_digest.verdict.score


# ------------------------------------------------------------------ kernels


def waves(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A smooth picture, 0..255, at any place."""
    return 128 + 50 * np.sin(0.5 * x + 0.2 * y) + 40 * np.sin(0.3 * x - 0.55 * y + 1)


@pytest.mark.parametrize("turn_deg", [0.0, 12.0])
@pytest.mark.parametrize("scale", [0.8, 1.0, 1.3])
def test_a_patch_is_found_where_it_was_put_whatever_gain_and_bias(turn_deg: float, scale: float) -> None:
    side, place = PATCHES.side_px, np.array([41.3, 37.8])
    angle = np.radians(turn_deg)
    patch_from_photo = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) / scale
    row, column = np.mgrid[:80, :90]
    inner = np.einsum("ab,hwb->hwa", patch_from_photo, np.stack([column + 0.5, row + 0.5], -1) - place)
    photo = np.round(0.7 * waves(inner[..., 0], inner[..., 1]) + 20).astype(np.uint8)
    own = np.arange(side) + 0.5 - side / 2
    patch = np.round(waves(own[None, :], own[:, None])).astype(np.uint8)
    start = place + np.array([[1.6, -1.2], [-0.5, 2.0], [7.0, 0.0]])
    found, similarity = match_patches(
        photo, np.stack([patch] * 3), np.stack([patch_from_photo] * 3), start, 5, 20, 0.005, 4.0, 2.0
    )
    # Seen: 0.02 px at most, by rounding and bilinear interpolation.
    assert np.abs(found[:2] - place).max() < 0.05
    assert similarity[:2].min() > 0.99
    assert np.abs(found[2] - start[2]).max() <= 4.0


def test_an_edge_and_a_flat_patch_have_no_place() -> None:
    photo = np.zeros((60, 60), np.uint8)
    photo[:, 30:] = 200
    edge, flat = photo[20:40, 20:40], photo[20:40, :20]
    _, similarity = match_patches(
        photo,
        np.stack([edge, flat]),
        np.stack([np.eye(2)] * 2),
        np.array([[30.0, 30.0], [20.0, 30.0]]),
        5,
        10,
        0.02,
        4.0,
        2.0,
    )
    assert (similarity < 0).all()


def test_reprojection_is_linearized_as_finite_differences_say() -> None:
    rng = np.random.default_rng(2)
    points, pose = rng.uniform([-1, -1, 3], [1, 1, 5], (5, 3)), moved(Pose(np.eye(4)), rng.normal(0, 0.1, 6))
    k, covariances = np.array([500.0, 480.0, 320.0, 240.0]), np.zeros((5, 3, 3), np.float32)
    observed = rng.uniform(0, 400, (5, 2))

    def residuals_at(one: Pose) -> tuple[np.ndarray, np.ndarray]:
        rows, residuals = np.empty((5, 2, 6)), np.empty((5, 2))
        linearize_places(points, covariances, observed, one.camera_from_world, k, 0.5, rows, residuals)
        return residuals, rows

    here, rows = residuals_at(pose)
    for unknown in range(6):
        step = np.zeros(6)
        step[unknown] = 1e-6
        there, _ = residuals_at(Pose(pose.world_from_camera @ se3_exp(step)))
        assert np.allclose((here - there) / 1e-6, rows[:, :, unknown], rtol=1e-4, atol=1e-2)


def test_a_point_that_is_uncertain_along_x_says_less_of_x() -> None:
    covariances = np.zeros((1, 3, 3), np.float32)
    covariances[0, 0, 0] = 0.02**2  # 0.02 units at 4 are 2.5 px
    rows, residuals = np.empty((1, 2, 6)), np.empty((1, 2))
    k, observed = np.array([500.0, 500.0, 0.0, 0.0]), np.array([[3.0, 3.0]])
    linearize_places(np.array([[0.0, 0.0, 4.0]]), covariances, observed, np.eye(4), k, 0.5, rows, residuals)
    assert residuals[0] == pytest.approx([3.0 / np.hypot(2.5, 0.5), 3.0 / 0.5], rel=1e-5)


# ------------------------------------------------------------------ the file and the commands


def test_a_digest_is_read_as_it_was_written(studio: LoadedScene, tmp_path: Path) -> None:
    written = digest(studio)
    write_digest(written, tmp_path / DIGEST_FILE)
    assert [file.name for file in tmp_path.iterdir()] == [DIGEST_FILE]
    again = read_digest(tmp_path / DIGEST_FILE, scene_key(studio.scene))
    assert again is not None
    for name in SurfacePoints.__slots__:
        assert np.array_equal(getattr(again.points, name), getattr(written.points, name))
    assert (again.names, again.sha256, again.effect) == (written.names, written.sha256, written.effect)


@pytest.mark.parametrize(
    "damage", ["other scene", "truncated", "compressed", "shape", "photo", "nan", "version", "no file"]
)
def test_a_digest_that_does_not_fit_is_not_used(
    studio: LoadedScene, tmp_path: Path, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    path, key = tmp_path / DIGEST_FILE, scene_key(studio.scene)
    write_digest(digest(studio), path)
    with np.load(path) as file:
        stored = {name: file[name] for name in file.files}
    if damage == "other scene":
        key = "1" * 64
    elif damage == "truncated":
        path.write_bytes(path.read_bytes()[:5000])
    elif damage == "no file":
        path.write_bytes(b"no archive")
    elif damage == "compressed":
        np.savez_compressed(path, **stored)
        with zipfile.ZipFile(path) as archive:
            assert archive.infolist()[0].compress_type == zipfile.ZIP_DEFLATED
    else:
        changed = {
            "shape": {"tangents": stored["tangents"][1:]},
            "photo": {"photo": stored["photo"] + 100},
            "nan": {"points_in_world": stored["points_in_world"] * np.nan},
            "version": {"version": np.array(99)},
        }[damage]
        np.savez(path, **(stored | changed))
    with caplog.at_level(logging.WARNING):
        assert read_digest(path, key) is None
    assert "make it again" in caplog.text


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene folder with the photos of its cameras, which are renders."""
    path = write_room(tmp_path_factory.mktemp("photos") / "room", cameras=24)
    (path / "images").mkdir()
    loaded = LoadedScene.load(path)
    for named in loaded.scene.cameras:
        rgb = to_uint8(loaded.rasterizer.render([named.camera])[0].rgb)
        (path / named.name).write_bytes(encode_image(rgb, "png"))
    return path


def test_whoever_loads_the_scene_uses_what_lies_beside_it(folder: Path) -> None:
    loaded = LoadedScene.load(folder)
    assert loaded.photo_digest is None
    (folder / "images" / "3.png").write_bytes(b"no photo")
    made = loaded.digest_photos(folder)
    assert len(made.names) == 23  # one can't be read
    assert "images/3.png" not in made.names
    write_digest(made, folder / DIGEST_FILE)
    assert np.array_equal(digest(LoadedScene.load(folder)).points.patches, made.points.patches)


@pytest.mark.ci
def test_inspect_tells_size_and_effect(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPLATFIX_CACHE_DIR", str(tmp_path))
    (folder / DIGEST_FILE).unlink(missing_ok=True)
    shown = CliRunner().invoke(app, ["scenes", "inspect", str(folder)])
    assert "no digest of them: splatfix scenes index --photos" in shown.output
    made = CliRunner().invoke(app, ["scenes", "index", str(folder), "--photos"])
    facts = json.loads(CliRunner().invoke(app, ["scenes", "index", str(folder), "--photos", "--json"]).stdout)
    assert facts["views"] > 0
    assert facts["training_photos"]["bytes"] < 200_000 * facts["training_photos"]["photos"]
    shown = CliRunner().invoke(app, ["scenes", "inspect", str(folder)])
    (line,) = [line for line in made.output.splitlines() if line.startswith("training photos")]
    assert "points of" in line
    assert line in shown.output


def test_photos_that_are_not_there_are_said_to_be_missing(tmp_path: Path) -> None:
    loaded = LoadedScene.load(write_room(tmp_path / "room", cameras=3))
    with pytest.raises(SceneNotFound, match="no photo of a training camera") as error:
        loaded.digest_photos(tmp_path / "room")
    assert "images" in (error.value.hint or "")


def test_an_uploaded_folder_keeps_it(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "scene.zip", "w") as archive:
        archive.writestr("room/scene.ply", b"ply")
        archive.writestr(f"room/{DIGEST_FILE}", b"digest")
    unpack(tmp_path / "scene.zip", tmp_path / "room", 1000)
    assert (tmp_path / "room" / DIGEST_FILE).read_bytes() == b"digest"
