"""The renderer's kernels as plain Python, beside the float64 reference: every pixel and every gradient.

test_rasterizers.py compares the compiled ones, on scenes so large that a few pixels may differ by rounding.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import reference_renderer as reference
import torch
from plain_kernels import plain
from test_rasterizers import lens, make_camera, make_scene, numeric_generator, relative, render_reference, tensor

from service.render import cpu, pack
from service.render.cpu import CpuRasterizer, dilation_for
from service.types import Camera, GaussianScene

project = plain("service.render.project")
blend = plain("service.render.blend")
KERNELS = {
    "project": project.project,
    "blend": blend.blend,
    "blend_backward": plain("service.render.backward").blend_backward,
    "sort_by_depth": plain("service.render.tiles").sort_by_depth,
    "fill_tiles": plain("service.render.tiles").fill_tiles,
    **{n: vars(plain("service.render.projection_gradients"))[n] for n in ("pose_twist", "scene_rows", "unpack_rows")},
}


PARAMETERS = ("means", "quats", "scales", "opacities", "sh")


@pytest.fixture(autouse=True)
def plainly(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Render without the compiler, and divide by zero and overflow as machine code does: in silence."""
    for name, kernel in KERNELS.items():
        monkeypatch.setattr(cpu, name, kernel)
    monkeypatch.setattr(pack, "_fill", plain("service.render.pack")._fill)
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
