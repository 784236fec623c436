"""The field bench: lenses that bend as OpenCV's do, what is told of them, what counts as what, and resuming."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image
from test_bench import FakeLoaded, FakeMatcher, FakeRasterizer, folder_of, poses

from service.bench import capture_modifications, field, field_queries
from service.bench import localize as bench
from service.bench.bench_photos import BenchPhoto
from service.bench.field_queries import LONG_SIDE, FieldQuery, Sent, decoded, send
from service.bench.field_random import random_row
from service.bench.field_rows import TOLD, Row, all_rows, chosen_rows
from service.bench.field_table import chi_square_6, outcome_of, summary, table
from service.bench.modifications import modify
from service.bench.modified_photo import Photo
from service.bench.pose_metrics import Units
from service.bench.scene_modifications import modified_scene
from service.errors import InvalidOptions, InvalidRequest, UnknownName
from service.geometry import moved
from service.pose.refinement.refine_stage import RefinedPose, RefineOutcome
from service.results import PoseEstimate, Reason, Status, Verdict
from service.scene_formats import splat
from service.types import Camera, GaussianScene, Intrinsics, NamedCamera, Pose, SceneInfo

LENS = Intrinsics(240, 180, 200.0, 204.0, 124.0, 86.0)
RNG = np.random.default_rng(0)
TOLERANCE_PX = 0.04
"""OpenCV's Lanczos kernel shifts a ramp by up to 0.03 px."""
EDGE_TOLERANCE_PX = 0.15
"""Within the kernel's reach of the edge; seen: 0.09."""


def map_photo(lens: Intrinsics = LENS) -> Photo:
    """A photo whose red and green say where each pixel is: after resampling, where it came from."""
    rows, columns = np.mgrid[: lens.height, : lens.width]
    rgb = np.stack([(columns + 0.5) / 256, (rows + 0.5) / 256, np.zeros(rows.shape)], 2)
    return Photo(rgb.astype(np.float32), lens, poses()[1])


def source_of(photo: Photo) -> np.ndarray:
    return photo.rgb[..., :2].reshape(-1, 2) * 256


def check_places(found: np.ndarray, expected: np.ndarray) -> None:
    error = np.abs(found - expected).max(1)
    assert error.max() < EDGE_TOLERANCE_PX
    inner = ((expected > 5) & (expected < expected.max(0) - 5)).all(1)
    assert error[inner].max() < TOLERANCE_PX


def pixels_of(lens: Intrinsics) -> np.ndarray:
    rows, columns = np.mgrid[: lens.height, : lens.width]
    return np.stack([columns + 0.5, rows + 0.5], 2).reshape(-1, 2)


def matrix(lens: Intrinsics) -> np.ndarray:
    return np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])


class TestLenses:
    @pytest.mark.parametrize("spec", ["k1=-0.1", "k1=0.1", "k1=-0.02", "fisheye=1"])
    def test_each_pixel_comes_from_where_opencv_says(self, spec):
        """OpenCV projects the rays of the old places through the lens that the photo now claims to have."""
        photo = modify(map_photo(), [spec], RNG)
        lens, (x, y) = photo.intrinsics, source_of(photo).T
        rays = np.stack([(x - LENS.cx) / LENS.fx, (y - LENS.cy) / LENS.fy, np.ones_like(x)], 1)[:, None]
        place = np.zeros(3), np.zeros(3), matrix(lens)
        if spec.startswith("fisheye"):
            assert lens.model == "OPENCV_FISHEYE"
            projected, _ = cv2.fisheye.projectPoints(rays, *place, np.zeros(4))
        else:
            assert (lens.model, lens.distortion) == ("SIMPLE_RADIAL", (float(spec[3:]),))
            projected, _ = cv2.projectPoints(rays, *place, np.array([*lens.distortion, 0, 0, 0]))
        check_places(projected[:, 0], pixels_of(lens))
        assert lens.fx == lens.fy

    @pytest.mark.parametrize("spec", ["k1=-0.1", "fisheye=1", "shutter_yaw=300", "shutter_pitch=-300"])
    def test_every_pixel_is_of_the_photo_and_none_is_wasted(self, spec):
        photo = modify(map_photo(), [spec], RNG)
        found, size = source_of(photo), np.array([LENS.width, LENS.height])
        assert found.min() > 0.5 - EDGE_TOLERANCE_PX
        assert (found < size - 0.5 + EDGE_TOLERANCE_PX).all()
        # At some side the source's edge is reached to a pixel or two.
        assert min(*(found.min(0) - 0.5), *(size - 0.5 - found.max(0))) < 2.0
        assert photo.intrinsics.width < LENS.width
        aspect = photo.intrinsics.width / photo.intrinsics.height
        assert aspect == pytest.approx(LENS.width / LENS.height, rel=0.02)

    @pytest.mark.parametrize("spec", ["jpeg=95", "scale=0.5", "crop=0.8", "letterbox=0.2", "blur=0.1"])
    def test_what_follows_leaves_the_distortion(self, spec):
        """Once more OpenCV's projection, of a photo that was changed after it was distorted."""
        photo = modify(map_photo(), ["k1=-0.1", spec], RNG)
        lens, (x, y) = photo.intrinsics, source_of(photo).T
        rays = np.stack([(x - LENS.cx) / LENS.fx, (y - LENS.cy) / LENS.fy, np.ones_like(x)], 1)[:, None]
        projected, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix(lens), np.array([-0.1, 0, 0, 0]))
        error = np.abs(projected[:, 0] - pixels_of(lens)).max(1)[photo.rgb[..., 1].ravel() > 0]
        assert (lens.model, lens.distortion) == ("SIMPLE_RADIAL", (-0.1,))
        assert np.median(error) < 1.0  # JPEG rounds colours to a pixel here
        assert np.quantile(error, 0.9) < 2.5

    def test_a_pincushion_needs_no_cut(self):
        camera = modify(map_photo(), ["k1=0.1"], RNG).intrinsics
        assert (camera.width, camera.height, camera.cx, camera.cy) == (240, 180, LENS.cx, LENS.cy)

    @pytest.mark.parametrize(("axis", "name"), [([0, 1.0, 0], "shutter_yaw"), ([1.0, 0, 0], "shutter_pitch")])
    def test_a_rolling_shutter_is_a_homography_a_row(self, axis, name):
        photo = modify(map_photo(), [f"{name}=100"], RNG)
        lens = photo.intrinsics
        found, expected = source_of(photo).reshape(lens.height, lens.width, 2), []
        for row in range(lens.height):
            # 100 degrees a second, 20 ms over the whole height, 0 in its middle
            of_whole = (row + 0.5 + (LENS.height - lens.height) / 2) / LENS.height - 0.5
            rotation, _ = cv2.Rodrigues(np.radians(100 * 0.02 * of_whole) * np.array(axis))
            homography = matrix(LENS) @ rotation @ np.linalg.inv(matrix(lens))
            pixels = np.stack([np.arange(lens.width) + 0.5, np.full(lens.width, row + 0.5)], 1)[:, None]
            expected.append(cv2.perspectiveTransform(pixels, homography)[:, 0])
        check_places(found.reshape(-1, 2), np.concatenate(expected))

    def test_zoom_and_corners_know_where_they_were_cut(self):
        zoomed = modify(map_photo(), ["zoom=2"], RNG)
        assert (zoomed.intrinsics.width, zoomed.intrinsics.fx) == (240, 400.0)
        inner = np.s_[20:160, 20:220]
        expected = (pixels_of(LENS).reshape(180, 240, 2)) / 2 + [60, 45]
        assert np.abs(zoomed.rgb[inner][..., :2] * 256 - expected[inner]).max() < 0.02
        assert zoomed.focal_of_whole == pytest.approx(200 / 240)
        corner = modify(map_photo(), ["off_centre=0.5"], np.random.default_rng(3))
        left, top = corner.rgb[0, 0, :2] * 256 - 0.5
        assert (left in (0, 120), top in (0, 90)) == (True, True)
        assert (corner.intrinsics.cx, corner.intrinsics.cy) == (124 - left, 86 - top)
        assert corner.focal_of_whole == pytest.approx(200 / 240)

    def test_what_cannot_be(self):
        with pytest.raises(InvalidOptions, match="already"):
            modify(map_photo(), ["k1=0.1", "fisheye=1"], RNG)
        with pytest.raises(InvalidOptions, match="fold"):
            modify(map_photo(replace(LENS, fx=80.0, fy=80.0)), ["k1=-0.1"], RNG)


def grey(height: int = 120, width: int = 160, value: float = 0.5) -> Photo:
    camera = Intrinsics(width, height, 150.0, 150.0, width / 2, height / 2)
    return Photo(np.full((height, width, 3), value, np.float32), camera, poses()[0])


def linear(photo: Photo) -> np.ndarray:
    return photo.rgb.astype(np.float64) ** 2.2


class TestCapture:
    def test_vignetting_is_a_share_of_light_at_the_corners(self):
        light = linear(modify(grey(), ["vignetting=0.6"], RNG)) / linear(grey())
        assert light[0, 0] == pytest.approx(0.4, abs=0.01)
        assert light[60, 80] == pytest.approx(1.0, abs=0.01)
        # half of the radius: a quarter of the loss
        assert light[30, 40] == pytest.approx(0.85, abs=0.01)
        assert np.abs(light - light[::-1, ::-1]).max() < 1e-6  # about the image's middle

    def test_local_light_has_smooth_regions_and_one_hard_edge(self):
        light = np.log(linear(modify(grey(value=0.3), ["local_light=0.6"], np.random.default_rng(1))))
        assert np.ptp(light[..., 1]) > 0.5
        assert np.ptp(light[..., 0] - light[..., 2]) > 0.05
        steps = np.abs(np.diff(light[..., 1], axis=1))
        # The edge is one pixel wide, and elsewhere the light changes by little from one to the next.
        assert steps.max() > 0.4
        assert np.median(steps) < 0.02
        assert 0 < (steps > 0.4).any(1).mean() <= 1

    def test_each_light_and_the_shadow_are_where_and_what_they_are_drawn_to_be(self):
        """All that is random is planted: one region a quarter of the long side right of the middle, others far away."""
        away = [np.array([50.0, 50.0]), 0.15, np.zeros(3)]
        region = [np.array([0.25, -0.1]), 0.2, np.array([1.0, 0.0, -1.0])]

        def light_of(drawn: list, long_side: int) -> np.ndarray:
            rng = SimpleNamespace(uniform=lambda *bounds: drawn.pop(0))
            photo = grey(long_side * 3 // 4, long_side, 0.4)
            return np.log(linear(capture_modifications.local_light(photo, 0.2, rng)) / linear(photo))  # type: ignore[arg-type]

        no_shadow = [0.0, 9.0]
        for long_side in (160, 320):
            light = light_of([*region, *away, *away, *away, *no_shadow], long_side)
            column, row, step = round(0.75 * long_side), round((0.375 - 0.1) * long_side), round(0.2 * long_side)
            # One and the other end of the colours' range; at one radius exp(-1 / 2) of it is left.
            assert light[row, column] == pytest.approx([0.26, 0.2, 0.14], rel=0.01)
            for at in ((row, column - step), (row + step, column)):
                assert light[at] == pytest.approx(np.array([0.26, 0.2, 0.14]) * np.exp(-0.5), rel=0.03)
            # The second and the fourth one are darker.
            for order in ([away, region, away, away], [away, away, away, region]):
                darker = light_of([*(value for each in order for value in each), *no_shadow], long_side)
                assert np.abs(darker + light).max() < 1e-4
        # A shadow in a direction 30 degrees below x, from a tenth of the long side on: bluish.
        light = light_of([*away, *away, *away, *away, np.radians(30), 0.1], 160)
        y, x = (np.mgrid[:120, :160] + 0.5 - np.array([60, 80])[:, None, None]) / 160
        beyond = np.cos(np.radians(30)) * x + 0.5 * y - 0.1
        assert light[beyond > 0.01] == pytest.approx(
            np.tile([-0.22, -0.2, -0.18], ((beyond > 0.01).sum(), 1)), abs=1e-4
        )
        assert np.abs(light[beyond < -0.01]).max() < 1e-6

    def test_shadows_fall_in_all_directions(self):
        drawn = []
        real = np.random.default_rng(0)

        def uniform(low, high, size=None):
            drawn.append((low, high))
            return real.uniform(low, high, size)

        capture_modifications.local_light(grey(), 0.2, SimpleNamespace(uniform=uniform))  # type: ignore[arg-type]
        assert drawn[-2] == (0, pytest.approx(2 * np.pi))

    def test_motion_is_in_the_direction_that_is_drawn(self):
        dot = grey(value=0.0)
        dot.rgb[60, 80] = 1.0
        rng = SimpleNamespace(uniform=lambda *bounds: np.radians(30))
        smeared = capture_modifications.motion_blur(dot, 80.0, rng).rgb[..., 0]  # type: ignore[arg-type]
        rows, columns = np.nonzero(smeared > 1e-4)
        covariance = np.cov(columns, rows, aweights=smeared[rows, columns])
        assert np.degrees(np.arctan2(*np.linalg.eigh(covariance)[1][::-1, 1]) % np.pi) == pytest.approx(30, abs=3)

    def test_a_cast_keeps_the_mean_of_the_logarithms(self):
        logs = np.log(linear(modify(grey(), ["colour_cast=0.3"], RNG)) / linear(grey()))[0, 0]
        assert np.linalg.norm(logs) == pytest.approx(0.3, rel=1e-4)
        assert logs.sum() == pytest.approx(0, abs=1e-4)

    def test_motion_spreads_a_dot_along_a_line_about_its_place(self):
        dot = grey(value=0.0)
        dot.rgb[60, 80] = 1.0
        smeared = modify(dot, ["motion_blur=50"], np.random.default_rng(2)).rgb[..., 0]
        rows, columns = np.nonzero(smeared > 1e-4)
        weights = smeared[rows, columns].astype(float)
        assert weights.sum() == pytest.approx(1, abs=1e-3)
        offsets = np.stack([columns - 80, rows - 60], 1)
        assert weights @ offsets == pytest.approx([0, 0], abs=0.01)
        variances = np.linalg.eigvalsh((offsets * weights[:, None]).T @ offsets)
        # A line of 50 px at 800 is one of 10 px at 160; across it only the pixels' own width is left.
        assert variances[1] == pytest.approx(10**2 / 12, rel=0.1)
        assert variances[0] < 0.3

    def test_noise_is_greater_in_the_light_and_smeared(self):
        def spread(value: float, sigma: float) -> float:
            noisy = modify(grey(200, 800, value), [f"phone_noise={sigma}"], np.random.default_rng(0))
            return float((linear(noisy) - linear(noisy).mean()).std())

        assert spread(0.8, 0.05) > 2 * spread(0.3, 0.05)
        # Without a smear it would be 0.05 sqrt(0.8^2.2 + 0.02) = 0.040.
        assert spread(0.8, 0.05) < 0.03
        step = grey(value=0.2)
        step.rgb[:, 80:] = 0.8
        columns = modify(step, ["phone_noise=0.05"], np.random.default_rng(0)).rgb.mean((0, 2))
        assert columns[79] < 0.25 < 0.75 < columns[80]

    def test_bars_are_a_share_of_the_screenshot(self):
        for spec, size, value in (("letterbox=0.25", (160, 160), 0), ("white_bars=0.2", (150, 200), 1)):
            photo = modify(grey(), [spec], RNG)
            assert photo.rgb.shape[:2] == size
            assert (photo.intrinsics.height, photo.intrinsics.width) == size
            assert (photo.rgb == value).all(2).mean() == pytest.approx(1 - 160 * 120 / np.prod(size))
            assert (photo.intrinsics.cx, photo.intrinsics.cy) == (size[1] / 2, size[0] / 2)
            assert photo.focal_of_whole == 150 / 160


def some_scene(count: int = 400) -> GaussianScene:
    rng = np.random.default_rng(4)
    quats = rng.normal(size=(count, 4))
    named = tuple(NamedCamera(str(i), Camera(LENS, pose)) for i, pose in enumerate(poses()))
    return GaussianScene(
        rng.normal(size=(count, 3)),
        quats / np.linalg.norm(quats, axis=1, keepdims=True),
        np.exp(rng.normal(-3, 0.7, (count, 3))),
        rng.uniform(0.01, 0.999, count),
        rng.normal(0, 0.3, (count, 16, 3)),
        SceneInfo("s", "s", "abc", "ply"),
        named,
    )


UNITS = Units(np.zeros(3), 2.0, False)


def changed(spec: str, scene: GaussianScene | None = None) -> GaussianScene:
    return modified_scene(scene or some_scene(), [spec], UNITS, 0)


class TestScenes:
    def test_each_is_another_scene_in_the_same_frame(self):
        scene = some_scene()
        digests = {modified_scene(scene, row.modify_scene, UNITS, 0).info.sha256 for row in all_rows()}
        assert len(digests) == 1 + sum(bool(row.modify_scene) for row in all_rows())
        assert scene.info.sha256 in digests
        assert changed("floaters=1", scene).cameras is scene.cameras
        with pytest.raises(UnknownName, match="floaters"):
            changed("smoke=1")
        with pytest.raises(InvalidOptions, match=r"0 to 0\.95"):
            changed("thin=2")

    def test_a_splat_file_keeps_as_much(self, tmp_path):
        """Written as web viewers' converters do, and read by our reader."""
        scene, record = some_scene(), np.dtype([("f", "<f4", 6), ("b", "u1", 8)])
        records = np.zeros(scene.count, record)
        records["f"] = np.concatenate([scene.means, scene.scales], 1)
        rgba = np.concatenate([0.5 + 0.28209479 * scene.sh[:, 0], scene.opacities[:, None]], 1)
        both = np.concatenate(
            [np.rint(np.clip(rgba, 0, 1) * 255), np.clip(np.rint(scene.quats * 128 + 128), 0, 255)], 1
        )
        records["b"] = both.astype(np.uint8)
        records.tofile(tmp_path / "s.splat")
        stored, own = splat.read(tmp_path / "s.splat"), changed("splat=1")
        assert np.allclose(own.sh, stored.sh, atol=1e-5)
        assert np.allclose(own.opacities, stored.opacities, atol=1e-6)
        quats = stored.quats / np.linalg.norm(stored.quats, axis=1, keepdims=True)
        assert np.allclose(own.quats, quats, atol=1e-6)
        assert np.array_equal(own.scales, stored.scales)

    @pytest.mark.parametrize(("spec", "position"), [("spz=1", 1 / 8192), ("sog=1", 2e-4)])
    def test_rounding_is_as_fine_as_the_format(self, spec, position):
        scene, own = some_scene(), changed(spec)
        assert 0 < np.abs(own.means - scene.means).max() <= position * 1.01
        assert np.abs(own.opacities - scene.opacities).max() <= 0.5 / 255 + 1e-6
        angle = 2 * np.arccos(np.clip(np.abs((own.quats * scene.quats).sum(1)), 0, 1))
        assert 0.02 < np.degrees(angle.max()) < 1.2  # seen: 0.2 and 0.8; float32 of 1 - 6e-8 alone is 0.04
        scales, colours = np.abs(np.log(own.scales / scene.scales)), np.abs(own.sh[:, 0] - scene.sh[:, 0])
        if spec == "spz=1":
            assert scales.max() < 1 / 32 + 1e-5
            assert colours.max() < 0.5 / 0.15 / 255 + 1e-5
        else:
            assert len(np.unique(own.scales)) <= len(np.unique(own.sh[:, 1:])) <= 256
            # Of 1200 values 256 codes each stand for five; at the ends they are farther apart.
            assert np.quantile(scales, 0.9) < 0.02
            assert np.quantile(colours, 0.9) < 0.01
        assert np.abs(own.sh - scene.sh).max() < 0.3  # SPZ clips at 1, which is 3.3 deviations here

    def test_what_is_removed(self):
        scene = some_scene()
        assert changed("sh_degree=1").sh.shape[1] == 4
        thin, soft, hole = changed("thin=0.5"), changed("soft=0.25"), changed("hole=0.125")
        assert (thin.count, soft.count, hole.count) == (200, 300, 350)
        # Three quarters of what covers the picture are left by half of the Gaussians.
        cover = [np.sum(s.opacities * s.scales.prod(1) / s.scales.min(1)) for s in (thin, scene)]
        assert cover[0] > 0.75 * cover[1]
        kept = {tuple(mean): scale for mean, scale in zip(scene.means.tolist(), scene.scales, strict=True)}
        for mean, scale in zip(soft.means.tolist(), soft.scales, strict=True):
            assert np.allclose(scale, 1.35 * kept[tuple(mean)])
        gone = np.array(sorted(set(map(tuple, scene.means.tolist())) - set(map(tuple, hole.means.tolist()))))
        inside = ((scene.means >= gone.min(0)) & (scene.means <= gone.max(0))).all(1)
        assert inside.sum() == len(gone) == 50

    def test_what_is_added_floats_among_the_cameras(self):
        scene, more = some_scene(), changed("floaters=1")
        new = np.s_[scene.count :]
        assert more.count == scene.count + 3300
        assert (more.opacities[new] <= 0.06).sum() == 3000
        assert more.scales[new].max() <= 0.15  # 0.3 units, of which two are one of the scene's
        positions = np.stack([pose.position_in_world for pose in poses()])
        assert (np.abs(more.means[new]).max(0) <= np.abs(positions).max(0) + 1).all()

    @pytest.mark.parametrize(("spec", "gain"), [("warm=1", [1.18, 1.02, 0.85]), ("dark=0.5", [0.5] * 3)])
    def test_colours_from_anywhere_are_multiplied(self, spec, gain):
        scene, own = some_scene(), changed(spec)
        basis = np.random.default_rng(0).normal(size=16)
        basis[0] = 0.28209479
        before, after = (0.5 + np.einsum("k,nkc->nc", basis, s.sh) for s in (scene, own))
        assert np.allclose(after, before * gain, atol=1e-5)


class TestRandom:
    def test_combinations_are_those_of_their_number_and_can_be_made(self):
        drawn = [random_row(np.random.default_rng([0, n]), LENS) for n in range(200)]
        assert drawn[:5] == [random_row(np.random.default_rng([0, n]), LENS) for n in range(5)]
        assert {row.told for row in drawn} == set(TOLD)
        names = {spec.partition("=")[0] for row in drawn for spec in (*row.modify, *row.modify_scene)}
        assert {"k1", "fisheye", "shutter_yaw", "zoom", "roll", "focal", "occlusion", "hole", "local_light"} <= names
        assert all(row.fits(LENS) for row in drawn)
        photo = replace(map_photo(), occluders=(map_photo().rgb,))
        for row in drawn[:25]:
            modify(photo, row.modify, RNG)

    def test_a_distorted_photo_is_not_bent_again(self):
        lens = replace(LENS, model="SIMPLE_RADIAL", distortion=(-0.05,), fy=LENS.fx)
        assert all(random_row(np.random.default_rng(n), lens).fits(lens) for n in range(100))


def photo_file(path) -> BenchPhoto:
    image = Image.fromarray(np.random.default_rng(0).integers(0, 255, (180, 240, 3), np.uint8))
    image.save(path)
    return BenchPhoto(path.name, path, Camera(LENS, poses()[1]))


def exif_focal(sent: Sent) -> int | None:
    """Read the tag as another program would."""
    image = Image.open(io.BytesIO(sent.data))
    return image.getexif().get_ifd(ExifTags.IFD.Exif).get(ExifTags.Base.FocalLengthIn35mmFilm)


class TestWhatIsSent:
    @pytest.mark.parametrize(
        ("specs", "millimetres"),
        [((), 30), (("focal=0.67",), 20), (("crop=0.5",), 30), (("zoom=2",), 30), (("off_centre=0.6",), 30)],
    )
    def test_exif_is_that_of_the_whole_photo(self, tmp_path, specs, millimetres):
        one = photo_file(tmp_path / "a.png")
        sent = send(decoded(one, (0, 0, 0)), FieldQuery(Row("r", "exif", specs), one), 0)
        # 36 mm x 200 / 240
        assert (exif_focal(sent), sent.intrinsics) == (millimetres, None)
        image = Image.open(io.BytesIO(sent.data))
        assert image.size == (sent.truth.intrinsics.width, sent.truth.intrinsics.height)

    def test_no_more_is_told_than_the_row_says(self, tmp_path):
        one = photo_file(tmp_path / "a.png")
        photo = decoded(one, (0, 0, 0))
        sent = {told: send(photo, FieldQuery(Row("r", told, ("k1=-0.05", "focal=1.1")), one), 0) for told in TOLD}
        assert {told: exif_focal(each) for told, each in sent.items() if told != "exif"} == dict.fromkeys(
            set(TOLD) - {"exif"}
        )
        assert sent["exif"].intrinsics is sent["withheld"].intrinsics is None
        pinhole = sent["pinhole"].intrinsics
        assert pinhole is not None
        assert (pinhole.model, pinhole.distortion, pinhole.trust) == ("PINHOLE", (), "exact")
        truth = sent["told"].truth.intrinsics
        assert sent["told"].intrinsics == replace(truth, fx=truth.fx * 1.1, fy=truth.fy * 1.1)
        assert sent["approximate"].intrinsics == replace(
            truth, fx=truth.fx * 1.1, fy=truth.fy * 1.1, trust="approximate"
        )
        centred = sent["centred"].intrinsics
        assert centred is not None
        assert (centred.cx, centred.cy) == (truth.width / 2, truth.height / 2)

    @pytest.mark.parametrize(
        ("long_side", "expected"),
        [(LONG_SIDE - 2, LONG_SIDE - 2), (LONG_SIDE, LONG_SIDE), (LONG_SIDE + 400, LONG_SIDE)],
    )
    def test_a_photo_is_decoded_at_the_size_that_is_sent(self, tmp_path, long_side, expected):
        pixels = np.full((60, long_side, 3), 51, np.uint8)
        Image.fromarray(pixels).save(tmp_path / "a.png")
        lens = Intrinsics(long_side, 60, 900.0, 900.0, long_side / 2, 30.0)
        photo = decoded(BenchPhoto("a.png", tmp_path / "a.png", Camera(lens, poses()[1])), (0, 0, 0))
        assert photo.rgb.shape[1] == photo.intrinsics.width == expected
        assert photo.intrinsics.fx == pytest.approx(900 * expected / long_side)
        # 0 to 1, and not resampled where it is small enough.
        assert np.abs(photo.rgb - 0.2).max() < 1e-6
        if long_side == expected:
            assert photo.intrinsics == lens

    def test_a_distorted_photo_stays_as_it_is(self, tmp_path):
        plain = photo_file(tmp_path / "a.png")
        lens = Intrinsics(240, 180, 200.0, 200.0, 120.0, 90.0, "SIMPLE_RADIAL", (-0.08,))
        one = replace(plain, camera=Camera(lens, poses()[1]))
        photo = decoded(one, (0, 0, 0))
        assert np.array_equal(photo.rgb, decoded(plain, (0, 0, 0)).rgb)
        assert photo.intrinsics == lens
        fits = {row.name for row in all_rows() if row.fits(lens)}
        assert {"lens/told", "lens/pinhole"} <= fits
        assert not fits & {"lens/k1=0.1/exif", "lens/shutter_yaw=30/told", "photo/roll=45"}
        assert "lens/pinhole" not in {row.name for row in all_rows() if row.fits(LENS)}


class TestRows:
    def test_names_are_unique_and_choosable(self):
        rows = all_rows()
        assert len({row.name for row in rows}) == len(rows)
        some = chosen_rows(["lens/k1=-0.1/*", "photo/jpeg=20"])
        assert [row.name.rpartition("/")[2] for row in some] == ["told", "exif", "withheld", "pinhole", "jpeg=20"]
        assert {row.pool for row in chosen_rows(["lens/k1=*/exif"])} == {"lens/k1/exif"}
        with pytest.raises(UnknownName, match="jpg"):
            chosen_rows(["photo/jpg*"])

    def test_each_can_be_made(self):
        photo = replace(map_photo(), occluders=(map_photo().rgb,))
        for row in all_rows():
            if row.fits(LENS):
                assert modify(photo, row.modify, RNG).rgb.shape[2] == 3


def line(localized: bool, right: bool, stays: bool = True, **more) -> dict:
    found = {
        "scene": "s", "row": "lens/k1=0.1/exif", "pool": "lens/k1/exif", "group": "lens", "localized": localized,
        "right": right, "reason": "focal_uncertain", "below_floor": [], "cpu_ms": 100.0, "rotation_deg": 0.1,
        "translation_units": 0.01, "nees": 5.0, "focal_error": -0.01, "k1_error": 0.02, "home": {"stays": stays},
    }  # fmt: skip
    return found | more


class TestTable:
    def test_every_query_is_counted_once(self):
        lines = [line(True, True)] * 5 + [line(False, True)] * 4 + [line(True, False)] * 3 + [line(False, False)] * 2
        lines += [line(False, False, stays=False)]
        found = summary(lines)
        assert [found[key] for key in ("localized", "refused", "wrong", "lost", "unanswerable")] == [5, 4, 3, 2, 1]
        assert (found["queries"], found["answerable"]) == (15, 14)
        assert (found["refused_by"], found["not_found_by"]) == ({"focal_uncertain": 4}, {"focal_uncertain": 3})
        assert (found["focal_error"], found["k1_error"]) == (0.01, 0.02)
        assert outcome_of(line(True, False, stays=False)) == "wrong"

    def test_ellipsoids(self):
        """Quantiles of a chi-square with six degrees of freedom, from a table."""
        assert [chi_square_6(x) for x in (5.348, 12.592, 16.812)] == pytest.approx([0.5, 0.95, 0.99], abs=1e-4)
        drawn = np.sum(np.random.default_rng(0).normal(size=(4000, 6)) ** 2, 1)
        found = summary([line(True, True, nees=float(value)) for value in drawn])
        assert (found["in_68"], found["in_95"]) == pytest.approx((0.68, 0.95), abs=0.02)

    def test_shares_of_many_counts_of_few(self):
        few = table([line(True, True)] * 3 + [line(False, True, row="lens/k1=0.2/exif", below_floor=["tints"])])
        rows = [cells.split(" | ") for cells in few.splitlines()[2:]]
        assert [cells[0].strip("| *") for cells in rows] == [
            "lens/k1=0.1/exif", "lens/k1=0.2/exif", "lens/k1/exif", "all of lens",
        ]  # fmt: skip
        assert [cells[1] for cells in rows] == ["3", "1", "4", "4"]
        assert rows[2][7] == "3 of 4"
        assert rows[2][-2] == "focal_uncertain (tints) 1"
        many = table([line(True, True)] * 39 + [line(False, True)]).splitlines()
        assert many[2].split(" | ")[7] == "97.5 %"
        assert table([line(True, True), line(True, True, scene="t")], by_scene=True).count("\n") == 3

    @pytest.mark.parametrize(("count", "share", "ellipsoids"), [(39, "39 of 39", "–"), (40, "100.0 %", "100, 100")])
    def test_forty_are_enough_for_shares(self, count, share, ellipsoids):
        cells = [cell.strip() for cell in table([line(True, True, nees=0.1)] * count).splitlines()[2].split("|")]
        assert (cells.count(share), cells.count(ellipsoids)) == (1, 1)

    def test_medians_have_their_units_and_what_is_unknown_a_dash(self):
        cells = table([line(True, True, rotation_deg=0.25, translation_units=0.0125)] * 2).splitlines()
        # A pool of a single row has no line of its own beside that of its group.
        assert len(cells) == 2 + 2
        found = [cell.strip() for cell in cells[2].strip("| ").split("|")]
        assert "0.250°, 0.0125" in found
        assert "1.00 %, 0.0200" in found
        assert table([line(False, False)]).splitlines()[2].count(" – ") == 3
        assert "1.00 % |" in table([line(True, True, k1_error=None)]).splitlines()[2]


@pytest.fixture
def fake_scene(monkeypatch):
    monkeypatch.setattr(bench.LoadedScene, "of", lambda scene, **_: FakeLoaded(scene, FakeRasterizer(), FakeMatcher()))


@pytest.fixture
def answers(monkeypatch, fake_scene):
    """`field.run` with a fake answer to each query."""
    seen = {"asked": []}

    def fake_answer(one, photo, query, seed, request):
        seen["asked"].append(query.key)
        return {"row": query.row.name, "photo": query.photo.name, "number": query.number}

    monkeypatch.setattr(bench.LoadedScene, "of", lambda scene, **_: FakeLoaded(scene, FakeRasterizer(), FakeMatcher()))
    monkeypatch.setattr(field, "answer", fake_answer)
    return seen


class TestRun:
    def spec(self, tmp_path, *patterns, **more) -> field.FieldSpec:
        folder = tmp_path / "s"
        if not folder.exists():
            folder_of(folder, "nerfstudio")
        return field.FieldSpec({"s": (folder, None)}, chosen_rows(patterns), tmp_path / "out", **more)

    def test_what_has_a_line_is_not_run_again(self, tmp_path, answers):
        steps = []
        field.run(self.spec(tmp_path, "lens/told"), lambda *step: steps.append(step))
        assert steps == [("s", 1, 2), ("s", 2, 2)]
        # the first is answered twice, for compilation
        assert len(answers["asked"]) == 3
        file = tmp_path / "out" / "s.jsonl"
        lines = file.read_text().splitlines(keepends=True)
        file.write_text(lines[0] + lines[1][:20])  # killed while it wrote
        answers["asked"].clear()
        whole = field.run(self.spec(tmp_path, "lens/told", "lens/exif"))
        assert sorted(set(answers["asked"])) == [
            ("lens/exif", "images/0.png", 0), ("lens/exif", "images/5.png", 0), ("lens/told", "images/5.png", 0),
        ]  # fmt: skip
        assert len(whole) == 4
        assert [json.loads(text) for text in file.read_text().splitlines()] == whole
        assert field.read_results(self.spec(tmp_path)) == whole

    def test_each_modified_scene_is_loaded_once(self, tmp_path, answers, monkeypatch):
        loaded, prepared = [], []

        class Loaded(FakeLoaded):
            def prepare(self, estimator):
                prepared.append((self.scene.info.sha256, estimator))

        def load(scene, **_):
            loaded.append(scene.info.sha256)
            return Loaded(scene, FakeRasterizer(), FakeMatcher())

        monkeypatch.setattr(bench.LoadedScene, "of", load)
        field.run(self.spec(tmp_path, "scene/dark=0.5", "scene/warm=1", "lens/told"))
        assert len(loaded) == len(set(loaded)) == 3
        assert [sha.partition("-")[2] for sha in loaded] == ["", "dark=0.5-0", "warm=1-0"]
        assert prepared == [(sha, "view_index") for sha in loaded]

    def test_a_line_is_on_the_disk_before_the_next_query(self, tmp_path, answers, monkeypatch):
        """A run takes days: neither its own end nor the machine's loses what is done."""
        file = tmp_path / "out" / "s.jsonl"
        seen, synced = [], []
        own = field.answer

        def answer(*query):
            seen.append(len(file.read_text().splitlines()) if file.exists() else 0)
            return own(*query)

        monkeypatch.setattr(field, "answer", answer)
        monkeypatch.setattr(field.os, "fsync", lambda number: synced.append(len(file.read_text().splitlines())))
        field.run(self.spec(tmp_path, "lens/told"))
        assert seen == [0, 0, 1]  # the first one is answered twice
        assert synced == [1, 2]

    @pytest.mark.parametrize(("count", "names"), [(1, "0"), (2, "04"), (3, "025"), (7, "0123456"), (8, "01234567"),
                                                  (None, "01234567")])  # fmt: skip
    def test_fewer_photos_are_spread_evenly(self, tmp_path, count, names):
        photos = tuple(BenchPhoto(str(k), tmp_path, Camera(LENS, poses()[0])) for k in range(8))
        spec = field.FieldSpec({}, chosen_rows(["lens/told"]), tmp_path, photos=count)
        found = list(field.queries("s", SimpleNamespace(photos=photos), spec))
        assert "".join(query.photo.name for query in found) == names

    def test_random_combinations_hide_parts_only_where_there_is_something_to_hide_them_with(self, tmp_path):
        photos = tuple(BenchPhoto(str(k), tmp_path, Camera(LENS, poses()[0])) for k in range(8))
        spec = field.FieldSpec({}, (), tmp_path, random=60)
        without = list(field.queries("s", SimpleNamespace(photos=photos), spec))
        with_others = list(field.queries("s", SimpleNamespace(photos=photos), replace(spec, occluders=tmp_path)))
        assert [query.number for query in with_others] == list(range(60))
        hidden = {query.number for query in with_others if query.row.needs_occluders}
        assert 0 < len(hidden) < 60
        assert [query.number for query in without] == [number for number in range(60) if number not in hidden]

    def test_random_combinations_come_after_the_rows(self, tmp_path, answers):
        more = replace(self.spec(tmp_path, "lens/told"), random=6, occluders=tmp_path / "s" / "images")
        found = field.run(more)
        drawn = [one for one in found if one["row"].startswith("random/")]
        assert len(found) == 8
        assert sorted(one["number"] for one in drawn) == list(range(6))
        assert len(field.run(replace(more, random=8))) == 10

    def test_results_of_another_seed_are_not_mixed(self, tmp_path, answers):
        field.run(self.spec(tmp_path, "lens/told"))
        with pytest.raises(InvalidRequest, match="seed 0, not 1"):
            field.run(self.spec(tmp_path, "lens/told", seed=1))

    def test_rows_that_need_occluders_need_a_folder(self, tmp_path, answers):
        assert field.run(self.spec(tmp_path, "photo/occlusion=*")) == []
        occluders = tmp_path / "s" / "images"
        found = field.run(self.spec(tmp_path, "photo/occlusion=*", occluders=occluders, photos=1))
        assert [one["photo"] for one in found] == ["images/0.png"] * 2


@pytest.mark.usefixtures("fake_scene")
class TestAnswerable:
    """An estimator that says what it is told to, and a refinement that leads where it is told to."""

    OFF = np.array([0, 0, 0, 0, 0, 1.0])

    def answered(self, monkeypatch, tmp_path, status: Status, off: float, leads: float | None, told="withheld"):
        verdict = Verdict(status, Reason.FEW_INLIERS, 0.3, 10, 0.5, 1.0, np.eye(6) * 1e-4)
        one = bench.load_bench_scene(folder_of(tmp_path / "s", "nerfstudio"))
        photo = one.photos[0]
        truth = photo.camera.pose
        starts = []

        def localized(read, loaded, request):
            pose = moved(truth, off * self.OFF)
            return PoseEstimate(
                pose, verdict, read.photo_intrinsics, read.intrinsics_source, "s", "0", "f", "f", "f", 0, False, 0, (),
                (), (),
            )  # fmt: skip

        def refined(start, images, renderer):
            starts.append((start.pose, images.query.photo_intrinsics))
            yield from ()
            if leads is None:
                return RefineOutcome(None)
            pose: Pose = moved(start.pose, leads * self.OFF)
            return RefineOutcome(RefinedPose(pose, start.correction, 0.01, None, None, None))

        monkeypatch.setattr(field_queries, "localize", localized)
        monkeypatch.setattr(field_queries, "refine_stage", refined)
        query = FieldQuery(Row("lens/x", told), photo)
        found = field_queries.answer(one, decoded(photo, (0, 0, 0)), query, 0, bench.Request())
        return json.loads(json.dumps(found)), starts, photo.camera

    @pytest.mark.parametrize(("leads", "outcome"), [(0.0, "lost"), (1.0, "unanswerable"), (None, "unanswerable")])
    def test_a_lost_photo_is_refined_from_the_truth(self, monkeypatch, tmp_path, leads, outcome):
        found, starts, camera = self.answered(monkeypatch, tmp_path, Status.UNCERTAIN, 1.0, leads)
        assert outcome_of(found) == outcome
        ((pose, lens),) = starts
        assert np.allclose(pose.world_from_camera, camera.pose.world_from_camera)
        assert lens == replace(camera.intrinsics, trust="approximate")

    def test_a_told_lens_is_exact_there_too(self, monkeypatch, tmp_path):
        _, ((_, lens),), camera = self.answered(monkeypatch, tmp_path, Status.UNCERTAIN, 1.0, 0.0, "told")
        assert lens == camera.intrinsics

    def test_only_where_it_was_not_right(self, monkeypatch, tmp_path):
        found, starts, _ = self.answered(monkeypatch, tmp_path, Status.LOCALIZED, 0.0, 0.0)
        assert (starts, "home" in found, outcome_of(found)) == ([], False, "localized")
        assert found["nees"] == pytest.approx(0.0, abs=1e-9)

    def test_a_wrong_answer_is_wrong_though_nobody_could_answer(self, monkeypatch, tmp_path):
        found, starts, _ = self.answered(monkeypatch, tmp_path, Status.LOCALIZED, 1.0, None)
        assert (len(starts), outcome_of(found)) == (1, "wrong")

    @pytest.mark.parametrize(("off", "stays"), [(0.04, True), (0.06, False)])
    def test_near_means_within_the_bounds_of_a_success(self, monkeypatch, tmp_path, off, stays):
        units = bench.load_bench_scene(folder_of(tmp_path / "t", "nerfstudio")).units.units_per_scene_unit
        found, *_ = self.answered(monkeypatch, tmp_path, Status.UNCERTAIN, 1.0, off / units)
        assert found["home"]["stays"] is stays
        assert found["home"]["translation_units"] == pytest.approx(off)
        monkeypatch.setattr(self, "OFF", np.array([0, 0, np.radians(100 * off), 0, 0, 0]))  # 4 and 6 degrees
        found, *_ = self.answered(monkeypatch, tmp_path / "t", Status.UNCERTAIN, 1.0, 1.0)
        assert found["home"]["stays"] is stays

    def test_a_line_has_times_and_uncertainties_in_their_units(self, monkeypatch):
        """Planted: a clock whose wall time is twice the processor's, and a covariance of known deviations."""
        sigma = np.array([0.01, 0.02, 0.02, 0.3, 0.6, 0.6])
        verdict = Verdict(Status.UNCERTAIN, Reason.FEW_INLIERS, 0.3, 10, 0.5, 1.0, np.diag(sigma**2))
        truth = Camera(replace(LENS, model="SIMPLE_RADIAL", distortion=(-0.05,), fy=LENS.fx), poses()[1])
        lens = replace(truth.intrinsics, fx=210.0, fy=210.0, distortion=(-0.08,))
        answer = PoseEstimate(truth.pose, verdict, lens, "given", "s", "0", "f", "f", "f", 0, False, 0, (), (), ())
        now = [0.0]

        def later(read, loaded, request):
            now[0] += 3.0
            return answer

        clock = SimpleNamespace(perf_counter=lambda: 2 * now[0], process_time=lambda: now[0])
        monkeypatch.setattr(field_queries, "time", clock)
        monkeypatch.setattr(field_queries, "localize", later)
        monkeypatch.setattr(field_queries, "send", lambda *_: Sent(b"", None, truth))
        monkeypatch.setattr(field_queries, "read_query", lambda *_, **__: now.__setitem__(0, now[0] + 1.0))
        one = SimpleNamespace(background_rgb=(0, 0, 0), loaded=None, units=Units(np.zeros(3), 0.5, False))
        query = FieldQuery(Row("lens/x", "told"), SimpleNamespace(name="a"))
        monkeypatch.setattr(field_queries, "home", lambda one, sent, exact: exact)

        def line():
            return field_queries.answer(one, None, query, 0, bench.Request())

        found = line()
        # Decoding counts.
        assert (found["latency_ms"], found["cpu_ms"]) == (8000.0, 4000.0)
        assert found["sigma_deg"] == pytest.approx(np.degrees(0.03))
        assert found["sigma_units"] == pytest.approx(0.45)
        assert found["focal_error"] == pytest.approx(0.05)
        assert found["true_k1"] == -0.05
        assert found["k1_error"] == pytest.approx(-0.03)
        assert found["home"] is False
        # Without a covariance, and of a fisheye, whose coefficients are others.
        fisheye = replace(lens, model="OPENCV_FISHEYE", distortion=(0.1, 0.0, 0.0, 0.0))
        answer = replace(answer, verdict=replace(verdict, covariance=None), intrinsics=fisheye)
        found = line()
        assert found["sigma_deg"] is found["sigma_units"] is found["k1_error"] is found["nees"] is None
        assert found["true_k1"] == -0.05
        answer = replace(answer, intrinsics=replace(LENS))
        assert line()["k1_error"] == pytest.approx(0.05)  # a pinhole has none
        truth = replace(truth, intrinsics=fisheye)
        assert line()["k1_error"] is line()["true_k1"] is None
