"""The renderer's kernels as plain Python, beside the float64 reference: every pixel and every gradient.

test_rasterizers.py compares the compiled ones, on scenes so large that a few pixels may differ by rounding.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import reference_renderer as reference
import torch
from plain_kernels import plain
from test_rasterizers import lens, make_camera, make_scene, numeric_generator, relative, render_reference, tensor

from service.render import cpu, pack
from service.render.cpu import CpuRasterizer, dilation_for
from service.render.slabs import SlabConfig, open_sums, slabs
from service.types import Camera, Pose

project = plain("service.render.project")
blend = plain("service.render.blend")
KERNELS = {
    "project": project.project,
    "blocks_in_view": project.blocks_in_view,
    **{name: vars(blend)[name] for name in ("blend", "begin", "blend_further", "write")},
    "blend_backward": plain("service.render.backward").blend_backward,
    "sort_by_depth": plain("service.render.tiles").sort_by_depth,
    "fill_tiles": plain("service.render.tiles").fill_tiles,
    **{n: vars(plain("service.render.projection_gradients"))[n] for n in ("pose_twist", "scene_rows", "unpack_rows")},
}


NONE = np.empty(0, np.int32)
PARAMETERS = ("means", "quats", "scales", "opacities", "sh")


@pytest.fixture(autouse=True)
def plainly(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Render without the compiler, and divide by zero and overflow as machine code does: in silence."""
    for name, kernel in KERNELS.items():
        monkeypatch.setattr(cpu, name, kernel)
    for name in ("_fill", "_enclose"):
        monkeypatch.setattr(pack, name, vars(plain("service.render.pack"))[name])
    with np.errstate(all="ignore"):
        yield


def worst(ours: np.ndarray, truth: torch.Tensor) -> float:
    return float(np.abs(ours - truth.numpy()).max())


@pytest.mark.parametrize(("degree", "antialiased"), [(0, False), (1, True), (2, False), (3, True)])
def test_every_pixel_equals_the_reference(degree: int, antialiased: bool) -> None:
    scene, camera = make_scene(70, degree, degree, antialiased), make_camera(21, 18, seed=degree)
    frame = CpuRasterizer(scene).render([camera])[0]
    truth = render_reference(scene, camera)
    for ours, right in zip((frame.rgb, frame.alpha, frame.depth, frame.median_depth), truth, strict=True):
        assert worst(ours, right) < 1e-5
    assert truth.alpha.max() > 0.5


@pytest.mark.parametrize("antialiased", [False, True])
def test_every_pixel_that_is_drawn_in_slabs_equals_the_reference(monkeypatch, antialiased: bool) -> None:
    """In blocks of 16 Gaussians, of which each begins another slab."""
    monkeypatch.setattr(pack, "CHUNKS_PER_BLOCK", 1)
    monkeypatch.setitem(project.project.__globals__, "CHUNKS_PER_BLOCK", 1)
    scene, inside = make_scene(160, 1, 3, antialiased), make_camera(21, 18, seed=3)
    back = np.eye(4)
    back[2, 3] = -6.0
    camera = Camera(inside.intrinsics, Pose(inside.pose.world_from_camera @ back))
    drawn = []
    monkeypatch.setattr(cpu, "blend_further", lambda *given: drawn.append(1) or blend.blend_further(*given))
    frame = CpuRasterizer(scene, slab_config=SlabConfig(0, 1, 1.0, 0.0)).render([camera])[0]
    truth = render_reference(scene, camera)
    for ours, right in zip((frame.rgb, frame.alpha, frame.depth, frame.median_depth), truth, strict=True):
        assert worst(ours, right) < 1e-5
    assert truth.alpha.max() > 0.5
    assert len(drawn) > 3


def test_a_packed_scene_is_mapped_from_its_folder_and_written_anew_where_that_is_damaged(tmp_path: Path) -> None:
    scene, folder = make_scene(20, 1, 0), tmp_path / "packed"

    def is_mapped(found: pack.Packed) -> bool:
        alike = all(np.array_equal(getattr(found, n), getattr(whole, n)) for n in pack._ARRAYS)
        return alike and isinstance(found.order.base, np.memmap)

    whole = pack.pack(scene)
    assert is_mapped(pack.mapped_pack(scene, folder))
    np.save(tmp_path / "short.npy", whole.order[:-1])
    for damage in (b"", b"no array", (tmp_path / "short.npy").read_bytes()):
        (folder / "order.npy").write_bytes(damage)
        assert is_mapped(pack.mapped_pack(scene, folder))
    assert {file.name for file in folder.iterdir()} == {f"{name}.npy" for name in pack._ARRAYS}
    (tmp_path / "file").touch()
    assert not is_mapped(pack.mapped_pack(scene, tmp_path / "file" / "packed"))


def test_slabs_are_in_order_and_have_all_blocks() -> None:
    """One block reaches through all of them, one is around the camera."""
    extents = np.array([[3, 9], [1, 2], [-1, 0.5], [2, 3], [5, 6], [7, 8]], np.float32)
    found = [
        (sorted(b.tolist()), *map(float, ends))
        for b, *ends in slabs(np.arange(6, dtype=np.int32), extents, 0.125, SlabConfig(0, 2))
    ]
    assert found == [([1, 2, 3], 0.125, 3.0), ([0, 3, 4], 3.0, 7.0), ([0, 5], 7.0, np.inf)]
    (all_around,) = slabs(np.arange(2, dtype=np.int32), np.array([[-1, 1], [-2, 1]], np.float32), 0.1, SlabConfig(0, 1))
    assert (sorted(all_around[0].tolist()), all_around[2]) == ([0, 1], np.inf)


def test_open_squares_are_counted_above_and_left_of_every_corner() -> None:
    is_open = np.random.default_rng(1).random((8, 12)) < 0.2
    alive = np.zeros((2, 3), np.uint32)
    for y, x in np.argwhere(is_open):
        alive[y // 4, x // 4] |= np.uint32(1 << (y % 4 * 4 + x % 4))
    sums = open_sums(alive).reshape(9, 13)
    assert all(sums[y, x] == is_open[:y, :x].sum() for y in range(9) for x in range(13))
    for x0, y0, x1, y1 in ((0, 0, 12, 8), (2, 1, 4, 3), (6, 4, 7, 5), (3, 3, 3, 5), (10, 6, 12, 8)):
        assert project.closed(x0, y0, x1, y1, 12, sums.reshape(-1)) == (not is_open[y0:y1, x0:x1].any())


@pytest.mark.parametrize(("degree", "antialiased"), [(1, False), (2, True), (3, False)])
def test_every_gradient_equals_autograd(degree: int, antialiased: bool) -> None:
    scene, camera = make_scene(60, degree, 10 + degree, antialiased), make_camera(21, 18, seed=degree)
    rng, k = np.random.default_rng(degree), camera.intrinsics
    d_rgb = rng.normal(size=(k.height, k.width, 3)).astype(np.float32)
    d_depth, d_alpha = rng.normal(size=(2, k.height, k.width)).astype(np.float32)
    leaves = [tensor(getattr(scene, name)).requires_grad_() for name in PARAMETERS]
    twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    generators = torch.stack([tensor(numeric_generator(i)) for i in range(6)])
    step = torch.linalg.matrix_exp((twist[:, None, None] * generators).sum(0))
    picture = reference.render(
        *leaves, torch.linalg.inv(tensor(camera.pose.world_from_camera) @ step), lens(camera), k.width, k.height,
        dilation_for(camera, scene.info), tensor(scene.info.background_rgb), antialiased,
    )  # fmt: skip
    loss = (picture.rgb * tensor(d_rgb)).sum() + (picture.depth * tensor(d_depth)).sum()
    (loss + (picture.alpha * tensor(d_alpha)).sum()).backward()
    renderer = CpuRasterizer(scene)
    ours = renderer.scene_gradients(camera, d_rgb, d_depth, d_alpha)
    for name, leaf in zip(PARAMETERS, leaves, strict=True):
        full = np.zeros(leaf.shape)
        full[ours.index] = getattr(ours, name)
        assert relative(full, leaf.grad) < 1e-4, name
    assert relative(renderer.pose_gradient(camera, d_rgb, d_depth, d_alpha), twist.grad) < 1e-4


# ------------------------------------------------------------------ what is left out


def test_spheres_are_in_view_if_they_reach_into_the_enlarged_frustum() -> None:
    """By the planes' unit normals; left and right, top and bottom differ, and the camera is turned and moved."""
    rng = np.random.default_rng(1)
    view = make_camera(seed=4).pose.camera_from_world[:3].ravel()
    low_x, high_x, low_y, high_y, near = 0.9, 0.5, 0.3, 0.7, 0.2
    normals = np.array([[1, 0, -high_x], [-1, 0, -low_x], [0, 1, -high_y], [0, -1, -low_y]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    counts = [0, 0]
    for centre, radius in zip(rng.uniform(-3, 3, (400, 3)), rng.uniform(0.05, 1.0, 400), strict=True):
        local = view.reshape(3, 4) @ np.append(centre, 1)
        right = bool(local[2] + radius >= near and np.all(normals @ local < radius))
        assert project.in_view(np.append(centre, radius), view, low_x, high_x, low_y, high_y, near) == right
        counts[right] += 1
    assert min(counts) > 50
    straight = np.eye(4)[:3].ravel()
    assert project.in_view([0, 0, 0.1, 0.1], straight, 1, 1, 1, 1, 0.2)  # it ends at the near plane
    assert not project.in_view([0, 0, 0.1, 0.099], straight, 1, 1, 1, 1, 0.2)
    slopes = (0.75, 0.75, 0.75, 0.75)
    for x, y in ((2.0, 0), (-2.0, 0), (0, 2.0), (0, -2.0)):  # 2 - 0.75 = 1.25: touches a side plane from outside
        assert not project.in_view([x, y, 1.0, 1.0], straight, *slopes, 0.0)
        assert project.in_view([x, y, 1.0, 1.001], straight, *slopes, 0.0)


def test_a_block_is_hidden_behind_all_tiles_that_its_box_may_reach_and_one_more() -> None:
    view, pinhole = np.eye(4)[:3].ravel(), (100.0, 80.0, 20.0, 30.0)
    sphere = [2.5, -0.5, 5.0, 1.0]
    # x 1.5 to 3.5 of depth 4 to 6: 45 to 107.5 px, tiles 2.8 to 6.7; y -1.5 to 0.5: 0 to 40 px, tiles 0 to 2.5.
    columns, rows = range(1, 8), range(0, 4)
    open_tiles = set()
    for tile in range(10 * 6):
        depths = np.full(60, 3.9)
        depths[tile] = 4.0
        if not project.block_hidden(sphere, view, pinhole, 0.01, np.inf, 10, 6, depths, NONE, 1):
            open_tiles.add((tile % 10, tile // 10))
    assert open_tiles == {(x, y) for x in columns for y in rows}
    # Cut by the near plane, or the slab's, it is narrower: from depth 5 on it ends at 90 px, up to 5 it begins at 50.
    for near, far, columns in ((5.0, np.inf, range(1, 7)), (0.01, 5.0, range(2, 8)), (6.0, 7.0, ()), (3.0, 4.0, ())):
        shown = set()
        for tile in range(10 * 6):
            depths = np.full(60, -np.inf)
            depths[tile] = np.inf
            if not project.block_hidden(sphere, view, pinhole, near, far, 10, 6, depths, NONE, 1):
                shown.add(tile % 10)
        assert shown == set(columns)
    turned = make_camera(seed=4).pose.camera_from_world
    centre = np.linalg.inv(turned) @ [2.5, -0.5, 5.0, 1.0]
    for tile, is_hidden in (((7, 3), False), ((8, 3), True), ((7, 4), True), ((1, 0), False), ((0, 0), True)):
        depths = np.full(60, 3.9)
        depths[tile[0] + 10 * tile[1]] = 4.1
        found = project.block_hidden(
            [*centre[:3], 1.0], turned[:3].ravel(), pinhole, 0.01, np.inf, 10, 6, depths, NONE, 1
        )
        assert found == is_hidden


def test_a_far_block_takes_no_part_and_a_hidden_gaussian_none_either() -> None:
    """In front of a wall beyond which nothing shows, what is nearer is drawn as without the wall."""
    scene, camera = make_scene(70), make_camera(21, 18)
    z = scene.means @ camera.pose.camera_from_world[2, :3] + camera.pose.camera_from_world[2, 3]
    depth = float(np.median(z[z > 0.1]))
    fewer = {n: getattr(scene, n)[z <= depth] for n in PARAMETERS}
    wall = np.full((2, 2), depth, np.float32)
    frame = CpuRasterizer(scene).render([camera], occlusion_depths=[wall])[0]
    truth = render_reference(replace(scene, **fewer), camera)
    assert worst(frame.rgb, truth.rgb) < 1e-5
    assert worst(frame.rgb, render_reference(scene, camera).rgb) > 0.01


@pytest.mark.parametrize("depths", [[4.0, 1.0, 2.0], [1.0, 4.0, np.nextafter(np.float32(4), np.float32(0))], None, []])
def test_records_are_sorted_by_depth(depths: list[float] | None) -> None:
    """As bits, 4 and 1 differ by 2^24: one more than 24 bits hold."""
    given = np.random.default_rng(2).uniform(0.01, 3.0, 50) if depths is None else depths
    values = np.asarray(given, np.float32)
    keys, swap = np.zeros((2, max(len(values), 1)), np.uint64)
    histogram = np.zeros(2 * 4096, np.int32)
    KERNELS["sort_by_depth"](values, len(values), keys, swap, histogram)
    order = (keys[: len(values)] & np.uint64(0xFFFFFFFF)).astype(int)
    assert np.all(np.diff(values[order]) >= (-1e-6 if depths else 0))
    assert sorted(order.tolist()) == list(range(len(values)))
