"""Large scenes made of small ones: the copies are what they claim to be, the scene in the middle is untouched."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from service.bench import large_scenes
from service.bench.render import room_cameras, synthetic_room
from service.render.cpu import CpuRasterizer
from service.scene_formats import load_scene
from service.types import GaussianScene, NamedCamera

COUNT = 4000


@pytest.fixture(scope="module")
def room() -> GaussianScene:
    cameras = tuple(NamedCamera(f"{i}.png", camera) for i, camera in enumerate(room_cameras(96)))
    return replace(synthetic_room(COUNT), cameras=cameras)


def test_the_mirrored_camera_sees_the_mirror_image(room: GaussianScene) -> None:
    raw = large_scenes._mirror(large_scenes._raw(room))
    mirrored = replace(room, means=raw.means, quats=raw.quats, sh=raw.sh)
    for named in room.cameras[:3]:
        (seen,) = CpuRasterizer(room).render([named.camera])
        (other,) = CpuRasterizer(mirrored).render([large_scenes._mirror_camera(named.camera)])
        # float32 and the order of blending: seen 1e-5
        assert np.abs(seen.rgb - other.rgb[:, ::-1]).max() < 1e-3
        assert np.abs(seen.median_depth - other.median_depth[:, ::-1]).mean() < 1e-3


def test_copies_stand_apart_and_their_cameras_with_them(room: GaussianScene) -> None:
    large = large_scenes.surround_with_copies(room, 5 * COUNT // 2)
    assert large.count == 5 * COUNT // 2
    assert np.array_equal(large.means[:COUNT], room.means)
    assert np.array_equal(large.sh[:COUNT], room.sh)
    assert [n.name for n in large.cameras[:6]] == [n.name for n in room.cameras]
    assert len(large.cameras) == 18
    middle = [large.means[i * COUNT : (i + 1) * COUNT].mean(0) for i in range(2)]
    assert np.linalg.norm(middle[0] - middle[1]) > 6
    # The copy's camera sees the copy as the original's sees the original: mirrored, with other colours.
    (seen,) = CpuRasterizer(room).render([room.cameras[0].camera])
    (other,) = CpuRasterizer(large).render([large.cameras[6].camera])
    assert np.abs(seen.median_depth - other.median_depth[:, ::-1]).mean() < 0.02
    assert np.abs(seen.rgb - other.rgb[:, ::-1]).mean() > 0.02


def test_other_scenes_are_put_around(room: GaussianScene) -> None:
    small = replace(synthetic_room(1000, sh_degree=1), cameras=())
    large = large_scenes.surround_with_copies(room, COUNT + 1500, [replace(small, means=small.means * np.float32(0.1))])
    assert large.count == COUNT + 1500
    assert large.sh_degree == 1
    spans = np.ptp(large.means[COUNT : COUNT + 1000], axis=0)
    assert spans == pytest.approx(np.ptp(room.means, axis=0), rel=0.05)  # as large as the scene in the middle
    with pytest.raises(ValueError, match="more than"):
        large_scenes.surround_with_copies(room, 10)


def test_a_copy_stands_in_the_middle_of_its_cell(room: GaussianScene) -> None:
    """A scene whose own centre is far from the origin; cells are a tenth larger than the scene in the middle."""
    shifted = replace(room, means=room.means + np.float32([50, 20, 5]), cameras=())
    large = large_scenes.surround_with_copies(room, 2 * COUNT, [shifted])
    (low, high), opaque = large_scenes._extent(room), room.opacities > 0.3
    copy = np.quantile(large.means[COUNT:][opaque].astype(np.float64), [0.005, 0.995], axis=0)
    away = copy.mean(0) - 0.5 * (low + high)
    assert np.abs(away / (high - low)) == pytest.approx([1.1, 1.1, 0.0], abs=0.01)


def test_a_scene_of_just_the_count_gets_no_copies(room: GaussianScene) -> None:
    alone = large_scenes.surround_with_copies(room, COUNT)
    assert np.array_equal(alone.means, room.means)
    assert alone.cameras == room.cameras
    assert large_scenes.surround_with_copies(room, COUNT + 1).count == COUNT + 1
    with pytest.raises(ValueError, match="more than"):
        large_scenes.surround_with_copies(room, COUNT - 1)


def test_the_most_contributing_gaussians_are_kept(room: GaussianScene) -> None:
    rasterizer = CpuRasterizer(room)
    half = large_scenes.keep_most_contributing(room, COUNT // 2, rasterizer)
    assert half.count == COUNT // 2
    (whole,), (part,) = (r.render([room.cameras[0].camera]) for r in (rasterizer, CpuRasterizer(half)))
    assert np.abs(whole.rgb - part.rgb).mean() < 0.03


@pytest.mark.ci
@pytest.mark.parametrize("compressed", [False, True])
def test_a_written_folder_is_the_scene(room: GaussianScene, tmp_path: Path, compressed: bool) -> None:
    source = tmp_path / "source"
    (source / "photos" / "day").mkdir(parents=True)
    (source / "photos" / "day" / "a.jpg").write_bytes(b"a photo")
    (source / "truth.json").write_text("[7]")
    (source / "other.txt").write_text("stays")
    told = {"background_rgb": (0.25, 0.5, 0.75), "up_in_world": (0.0, 1.0, 0.0), "render_mode": "antialiased"}
    room = replace(room, info=replace(room.info, **told, training_long_side_px=640))
    file = large_scenes.write_folder(room, tmp_path / "out", source, cameras=not compressed, compressed=compressed)
    # It has the same test photos.
    assert (tmp_path / "out" / "photos" / "day" / "a.jpg").read_bytes() == b"a photo"
    assert (tmp_path / "out" / "truth.json").read_text() == "[7]"
    assert not (tmp_path / "out" / "other.txt").exists()
    scene = load_scene(tmp_path / "out")
    assert scene.count == COUNT
    assert {name: getattr(scene.info, name) for name in told} == told
    if compressed:  # else the cameras say it
        assert scene.info.training_long_side_px == 640
    assert len(scene.cameras) == (0 if compressed else 6)
    if compressed:
        assert file.stat().st_size < 0.4 * 4 * 59 * COUNT
    else:
        assert np.allclose(scene.means, room.means)
        assert np.allclose(scene.sh, room.sh, atol=1e-6)
        for a, b in zip(scene.cameras, room.cameras, strict=True):
            assert np.allclose(a.camera.pose.world_from_camera, b.camera.pose.world_from_camera)
            assert a.camera.intrinsics == b.camera.intrinsics
