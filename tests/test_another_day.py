"""The studio on another day: the phone's lens against OpenCV, and the photos against their truth and the scene."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from api_server import ROOT

from scenes.studio import phone
from service.bench.bench_photos import BenchPhoto, find_photos
from service.geometry import moved
from service.photos.images import read_query
from service.render.cpu import CpuRasterizer
from service.scene_formats import load_scene
from service.types import Camera

STUDIO = ROOT / "scenes" / "studio"
ANOTHER_DAY = ROOT / "scenes" / "studio_another_day"
CONDITIONS = ("same_light", "evening", "night", "furniture", "people", "phone")


def distorted_by_opencv(lens: phone.Lens, rays: np.ndarray) -> np.ndarray:
    """Return n x 2 pixels where a camera that doesn't turn shows n x 3 rays."""
    matrix = np.array([[lens.focal, 0, lens.width / 2], [0, lens.focal, lens.height / 2], [0, 0, 1]])
    pixels, _ = cv2.projectPoints(rays[:, None], np.zeros(3), np.zeros(3), matrix, np.array([lens.k1, 0, 0, 0]))
    return pixels[:, 0]


class TestLens:
    @pytest.mark.parametrize("k1", [-0.08, 0.05])
    @pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.02, -0.03, 0.01)])
    def test_distortion_and_shutter_are_opencvs(self, k1, turn):
        lens = phone.Lens(480, 360, 346.0, k1, turn)
        u = np.linspace(0, 480, 13)
        for v in np.linspace(0, 360, 10):
            x, y = phone.straightened(lens, u, np.full(13, v))
            # From the axes of the camera at the middle row to those at this row's time.
            rotation = cv2.Rodrigues(np.array(turn) * (v / 360 - 0.5))[0]
            pixels = distorted_by_opencv(lens, np.column_stack([x, y, np.ones(13)]) @ rotation)
            assert np.abs(pixels - np.column_stack([u, np.full(13, v)])).max() < 1e-6

    def test_resamples_the_pinhole_image(self):
        lens = phone.Lens(120, 90, 86.7, -0.08, (0.004, -0.006, 0.002))
        width, height = phone.pinhole_size(lens.width, lens.height)
        focal = lens.focal * phone.DENSITY
        v, u = np.mgrid[:height, :width] + 0.5

        def pattern(x, y):
            return np.stack([np.sin(3 * x + 2 * y), np.cos(4 * y), x * y], -1)

        image = pattern((u - width / 2) / focal, (v - height / 2) / focal)
        photo = phone.through_lens(image, focal, lens)
        rows, columns = np.mgrid[:90, :120] + 0.5
        expected = pattern(*phone.straightened(lens, columns, rows))
        assert np.abs(photo - expected).max() < 2e-3  # the mean over a pixel instead of its centre

    def test_too_small_an_image(self):
        lens = phone.Lens(120, 90, 86.7, -0.08, (0, 0, 0))
        with pytest.raises(ValueError, match="too small for the lens"):
            phone.through_lens(np.zeros((120, 160, 3)), lens.focal * phone.DENSITY, lens)


def test_hand_shake_is_within_its_range():
    rng = np.random.default_rng(0)
    speeds = [np.degrees(np.linalg.norm(phone.hand_shake(rng))) / phone.READOUT for _ in range(200)]
    assert min(speeds) > 3
    assert max(speeds) < 15
    assert max(speeds) - min(speeds) > 10


def test_noise_has_the_stated_variance():
    grey = np.full((300, 300, 3), 0.2)
    noise = phone.noisy(grey, 3e-4, 0.002, np.random.default_rng(0)) - grey
    assert abs(noise.var() / (3e-4 * 0.2 + 0.002**2) - 1) < 0.02


def test_srgb_is_the_standards():
    # IEC 61966-2-1: the middle of the 8-bit range is 0.2140 of linear light.
    assert phone.srgb(np.array([0.21404, 0.0031308, 1.5])) == pytest.approx([0.5, 0.04045, 1], abs=1e-4)


class TestPhotos:
    @pytest.mark.parametrize("condition", CONDITIONS)
    def test_are_far_from_the_training_cameras(self, condition):
        training = np.array(
            [f["transform_matrix"] for f in json.loads((STUDIO / "transforms.json").read_text())["frames"]]
        )
        photos = find_photos(ANOTHER_DAY / condition)
        truth = json.loads((ANOTHER_DAY / condition / "truth.json").read_text())
        assert len(photos) == 24
        for photo, entry in zip(photos, truth, strict=True):
            far = np.linalg.norm(training[:, :3, 3] - photo.camera.pose.position_in_world, axis=1)
            alike = training[:, :3, 2] @ photo.camera.pose.axis_in_world < -np.cos(np.radians(30))
            assert far.min() == pytest.approx(entry["nearest_training_camera_m"], abs=6e-4)
            assert far[alike].min() == pytest.approx(entry["nearest_alike_m"], abs=6e-4)
            assert far.min() >= 0.35
            assert far[alike].min() >= 0.8

    def test_people_cover_a_part(self):
        truth = json.loads((ANOTHER_DAY / "people" / "truth.json").read_text())
        covered = [entry["covered"] for entry in truth]
        assert min(covered) >= 0.14
        assert max(covered) <= 0.40

    def test_are_small(self):
        assert sum(path.stat().st_size for path in ANOTHER_DAY.rglob("*.jpg")) < 4e6

    @pytest.mark.parametrize("condition", CONDITIONS)
    def test_the_truth_fits_the_pixels(self, condition, rasterizer):
        """Edges of renders at the truth are more like the photo's than of renders that are turned by a degree."""
        at_truth, turned = [], []
        for photo in find_photos(ANOTHER_DAY / condition)[::6]:
            at_truth.append(edge_correlation(rasterizer, photo, np.zeros(3)))
            turned += [edge_correlation(rasterizer, photo, turn) for turn in np.radians(np.eye(3)[:2])]
        assert np.median(at_truth) > 0.5
        assert np.median(at_truth) > 3 * np.median(turned)


@pytest.fixture(scope="module")
def rasterizer() -> CpuRasterizer:
    return CpuRasterizer(load_scene(STUDIO / "scene.compressed.ply"))


def edge_correlation(rasterizer: CpuRasterizer, photo: BenchPhoto, turn: np.ndarray) -> float:
    """Correlation of the Laplacians of a photo and of a render, at half the photo's size."""
    query = read_query(photo.path.read_bytes(), intrinsics=photo.camera.intrinsics)
    pose = moved(photo.camera.pose, np.concatenate([turn, np.zeros(3)]))
    small = query.intrinsics.with_long_side(240)
    render = rasterizer.render([Camera(small, pose)])[0].rgb
    reduced = cv2.resize(query.rgb, (small.width, small.height), interpolation=cv2.INTER_AREA)
    edges = [cv2.Laplacian(image.astype(np.float32).mean(2), cv2.CV_32F, ksize=3) for image in (render, reduced)]
    return float(np.corrcoef(edges[0].ravel(), edges[1].ravel())[0, 1])
