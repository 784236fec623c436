"""The synthetic street: the same from the same seed, and made of what it claims."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from service.bench.bench_photos import find_photos
from service.bench.street import Street, StreetConfig, make_street, write_photos
from service.photos.images import read_query
from service.pose.retrieval.floaters import find_floaters
from service.render.cpu import CpuRasterizer
from service.types import Intrinsics

RECORDED = {
    "clean.means": [4.79234, -0.00799, 1.84638, 8.44898, 7.16323, 5.94075],
    "clean.quats": [0.70944, 0.42024, 0.06788, 0.0, 0.25076, 0.39638, 0.30902, 0.0],
    "clean.scales": [0.47168, 0.48068, 0.13583, 3.23184, 3.30649, 0.97847],
    "clean.opacities": [0.94119, 0.05771],
    "clean.sh": [0.07948, -0.10546, -0.29878, 0.76884, 0.66031, 0.68488],
    "trained.means": [4.78296, -0.00575, 1.88373, 8.50749, 7.39334, 6.20159],
    "trained.quats": [0.7092, 0.4176, 0.06735, 0.0, 0.25062, 0.3985, 0.31063, 0.0],
    "trained.scales": [0.48038, 0.4892, 0.14727, 3.24809, 3.32039, 1.05842],
    "trained.opacities": [0.89701, 0.08422],
    "trained.sh": [0.07911, -0.10431, -0.29713, 0.77126, 0.66488, 0.68923],
    "cameras": [
        *(0.01173, 0.01889, 0.16552, 4.00077, -0.16681, -0.00813, 0.01279, -0.00861, -0.00175, -0.99229, 0.10705),
        *(0.53797, 0.76061, 0.07326, 0.62307, 2.19885, 0.62695, 0.09756, 0.75456, 2.10576, 0.02098, 0.00686),
        *(0.05835, 0.03693),
    ],
    "photos": [
        *(0.09226, 0.02769, 0.23256, 3.93267, -0.23431, -0.02411, 0.09512, -0.21827, -1e-05, -0.99452, 0.09858),
        *(0.53487, 0.90045, 0.04363, 0.35203, 0.51587, 0.35456, 0.08756, 0.89559, 2.19981, 0.0082, 0.00334),
        *(0.03368, 0.07893),
    ],
}
"""Means and standard deviations in the street that docs/results/scale.md was measured in, at the size of `SMALL`."""
SMALL = StreetConfig(count=60_000, length=8.0, training_cameras=24, photos=2, floaters=400, seed=3)


@pytest.fixture(scope="module")
def street() -> Street:
    return make_street(SMALL)


def test_the_seed_decides() -> None:
    few = replace(SMALL, count=5000, floaters=50)
    poses = [make_street(replace(few, seed=seed)).photo_cameras[0].pose.world_from_camera for seed in (3, 4)]
    assert not np.allclose(poses[0], poses[1])


def moments(values: Sequence[np.ndarray] | np.ndarray) -> list[float]:
    rows = np.asarray(values, np.float64).reshape(len(values), -1)
    return [*rows.mean(0), *rows.std(0)]


def test_it_is_the_street_that_was_measured(street: Street) -> None:
    """Whoever changes the street measures again: figures of different streets can't be compared."""
    found = {
        f"{kind}.{name}": moments(getattr(getattr(street, kind), name))
        for kind in ("clean", "trained")
        for name in ("means", "quats", "scales", "opacities", "sh")
    }
    found["cameras"] = moments([named.camera.pose.world_from_camera[:3] for named in street.clean.cameras])
    found["photos"] = moments([camera.pose.world_from_camera[:3] for camera in street.photo_cameras])
    assert found.keys() == RECORDED.keys()
    for name, values in found.items():
        assert values == pytest.approx(RECORDED[name], rel=2e-5, abs=2e-5), name
    lenses = {named.camera.intrinsics for named in street.trained.cameras}, {c.intrinsics for c in street.photo_cameras}
    assert lenses == (
        {Intrinsics(1200, 900, 900.0, 900.0, 600.0, 450.0)},
        {Intrinsics(1024, 768, 700.0, 700.0, 512.0, 384.0)},
    )


def test_houses_stand_along_the_road_under_a_far_sky(street: Street) -> None:
    clean, trained = street.clean, street.trained
    assert clean.count == pytest.approx(SMALL.count - SMALL.floaters, rel=0.02)
    assert 0.9 * SMALL.floaters < trained.count - clean.count <= SMALL.floaters
    far = np.linalg.norm(clean.means, axis=1) > 5 * SMALL.length
    assert far.mean() == pytest.approx(SMALL.sky_share, rel=0.05)
    assert np.median(clean.scales[far].max(1)) > 10 > 100 * np.median(clean.scales[~far].max(1))
    across = replace(street.photo_cameras[0], pose=clean.cameras[1].camera.pose)  # looks at the houses opposite
    (frame,) = CpuRasterizer(clean).render([across])
    row, column = frame.alpha.shape[0] // 2, frame.alpha.shape[1] // 2
    opposite = clean.cameras[1].camera.pose.position_in_world[1]
    assert opposite < -SMALL.kerb
    # To the facade, or to a car or tree before it.
    assert 0.5 < frame.median_depth[row, column] < SMALL.half_width - opposite + 0.5
    assert (frame.alpha > 0.95).mean() > 0.99  # houses, road and sky have no gaps
    assert frame.rgb[row - 100 : row + 100].std() > 0.05


def test_photos_have_their_truth_and_show_the_clean_street(street: Street, tmp_path: Path) -> None:
    write_photos(street, tmp_path)
    photos = find_photos(tmp_path)
    assert [photo.name for photo in photos] == ["photo_00.jpg", "photo_01.jpg"]
    # The seed's first draw is the exposure of the first photo.
    gains = [np.random.default_rng(0).uniform(0.85, 1.15), None]
    tables = io.BytesIO()
    Image.new("RGB", (16, 16)).save(tables, "JPEG", quality=85)
    for photo, camera, gain in zip(photos, street.photo_cameras, gains, strict=True):
        stored = Image.open(io.BytesIO(photo.path.read_bytes()))
        assert stored.quantization == Image.open(tables).quantization  # type: ignore[attr-defined]
        assert np.allclose(photo.camera.pose.world_from_camera, camera.pose.world_from_camera)
        places = [n.camera.pose.position_in_world for n in street.clean.cameras]
        assert np.min(np.linalg.norm(places - camera.pose.position_in_world, axis=1)) > 0.01
        query = read_query(photo.path.read_bytes(), intrinsics=photo.camera.intrinsics)
        (frame,) = CpuRasterizer(street.clean).render([camera])
        # Another exposure and noise, but the same picture.
        assert np.corrcoef(query.rgb.ravel(), np.clip(frame.rgb, 0, 1).ravel())[0, 1] > 0.98
        if gain is not None:
            assert query.rgb.mean() / 255 / frame.rgb.mean() == pytest.approx(gain, rel=0.01)


def test_veils_with_cameras_in_them_are_floaters_and_the_street_is_not(street: Street) -> None:
    found, planted = find_floaters(street.trained), np.arange(street.trained.count) >= street.clean.count
    assert found.left_out
    assert found.found[~planted].mean() < 1e-3
    inside = planted & (street.trained.scales.max(1) > 1.0) & (street.trained.opacities < 0.03)
    assert found.found[inside].mean() > 0.7
