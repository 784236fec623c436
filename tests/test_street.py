"""The synthetic street: the same from the same seed, and made of what it claims."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from service.bench.bench_photos import find_photos
from service.bench.street import Street, StreetConfig, make_street, write_photos
from service.photos.images import read_query
from service.pose.retrieval.floaters import find_floaters
from service.render.cpu import CpuRasterizer

SMALL = StreetConfig(count=60_000, length=8.0, training_cameras=24, photos=2, floaters=400, seed=3)


@pytest.fixture(scope="module")
def street() -> Street:
    return make_street(SMALL)


def test_the_seed_decides(street: Street) -> None:
    again, few = make_street(SMALL), replace(SMALL, count=5000, floaters=50)
    assert np.array_equal(again.trained.means, street.trained.means)
    assert np.array_equal(again.trained.sh, street.trained.sh)
    poses = [make_street(replace(few, seed=seed)).photo_cameras[0].pose.world_from_camera for seed in (3, 4)]
    assert not np.allclose(poses[0], poses[1])


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
    for photo, camera in zip(photos, street.photo_cameras, strict=True):
        assert np.allclose(photo.camera.pose.world_from_camera, camera.pose.world_from_camera)
        places = [n.camera.pose.position_in_world for n in street.clean.cameras]
        assert np.min(np.linalg.norm(places - camera.pose.position_in_world, axis=1)) > 0.01
        query = read_query(photo.path.read_bytes(), intrinsics=photo.camera.intrinsics)
        (frame,) = CpuRasterizer(street.clean).render([camera])
        # Another exposure and noise, but the same picture.
        assert np.corrcoef(query.rgb.ravel(), np.clip(frame.rgb, 0, 1).ravel())[0, 1] > 0.98


def test_veils_with_cameras_in_them_are_floaters_and_the_street_is_not(street: Street) -> None:
    found, planted = find_floaters(street.trained), np.arange(street.trained.count) >= street.clean.count
    assert found.left_out
    assert found.found[~planted].mean() < 1e-3
    inside = planted & (street.trained.scales.max(1) > 1.0) & (street.trained.opacities < 0.03)
    assert found.found[inside].mean() > 0.7
