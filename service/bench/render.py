"""`splatfix bench render`: times of the renderer on a synthetic room that is the same in every run.

The room imitates an interior reconstructed by a 3DGS trainer: flat Gaussians on walls, floor, ceiling and boxes, sized
so that they overlap, and a tenth of them free in the air. Each of six cameras inside, 4:3, sees 7 to 10 % of them. A
pixel evaluates about 40 Gaussians at 800 px and 100 at 100 px (200 of 500,000), counting each that touches the pixel's
4x4 block until the block is opaque.

Each size is rendered as if the scene had been trained at it, with the full dilation of 0.3 px^2. A scene trained at a
larger size has less overlap in a small render, and is faster.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float64

from service.geometry import look_at
from service.interfaces import Rasterizer
from service.loaded_scene import choose_rasterizer
from service.render import RASTERIZERS
from service.types import Camera, GaussianScene, Intrinsics, SceneInfo

CASES = ((20_000, 200), (100_000, 100), (100_000, 200), (100_000, 400), (100_000, 800), (500_000, 200), (500_000, 800))
"""Pairs of the number of Gaussians and the image width in px."""
ROOM = np.array([8.0, 6.0, 3.0])
"""Width, depth and height of the room in scene units; its centre is the origin, z is up."""
FIELD_OF_VIEW_RAD = np.radians(60.0)
"""Horizontal."""
_LOOSE_SHARE = 0.1
"""Of the Gaussians: free in the air."""
_SCALE_OVER_SPACING = 0.8
"""Median scale of a Gaussian over the distance of neighbours; gives the overlap that the module's docstring states."""


def run(
    *,
    repeats: int = 30,
    progress: Callable[[int, int], None] | None = None,
    cases: Sequence[tuple[int, int]] = CASES,
) -> list[dict[str, Any]]:
    """Return the list that `--json` writes: a row per case, stage and number of threads, in ms per image.

    Minimum and median are over `repeats`, then averaged over the six cameras. The stages pose_gradient and
    all_gradients are timed after a render of the same camera, whose lists the renderer keeps: they are the time in
    addition to the forward pass. With more than one thread the six cameras are rendered in one call.
    """
    rows = []
    scenes: dict[int, GaussianScene] = {}
    for done, (count, width) in enumerate(cases, 1):
        cameras = room_cameras(width)
        scene = scenes.setdefault(count, synthetic_room(count))
        # As if trained at this size; otherwise the dilation would shrink.
        info = replace(scene.info, training_focal_px=cameras[0].intrinsics.fx)
        rasterizer = RASTERIZERS.load(choose_rasterizer()[0]).create(replace(scene, info=info))
        for (stage, threads), times in _times(rasterizer, cameras, repeats).items():
            wall_ms, cpu_ms = 1e3 * times
            rows.append(
                {
                    "gaussians": count,
                    "sh_degree": scene.sh_degree,
                    "width": width,
                    "height": cameras[0].intrinsics.height,
                    "stage": stage,
                    "threads": threads,
                    "ms_min": float(wall_ms.min(0).mean()),
                    "ms_median": float(np.median(wall_ms, axis=0).mean()),
                    "cpu_ms_min": float(cpu_ms.min(0).mean()),
                }
            )
        if progress:
            progress(done, len(cases))
    return rows


def _times(
    rasterizer: Rasterizer, cameras: Sequence[Camera], repeats: int
) -> dict[tuple[str, int], Float64[np.ndarray, "2 r c"]]:
    """Return seconds of wall and CPU time, by stage and threads, for each repeat and camera.

    A first repeat, which allocates the memory, is not counted.
    """
    each = [_stage_times(rasterizer, camera, repeats) for camera in cameras]
    times = {(stage, 1): np.stack([e[stage] for e in each], 2) for stage in each[0]}
    cores = os.cpu_count() or 1
    if cores > 1:
        together = [_seconds(lambda: rasterizer.render(cameras)) for _ in range(repeats + 1)]
        times["forward", cores] = np.array(together[1:]).T[:, :, None] / len(cameras)
    return times


def _stage_times(rasterizer: Rasterizer, camera: Camera, repeats: int) -> dict[str, Float64[np.ndarray, "2 r"]]:
    shape = (camera.intrinsics.height, camera.intrinsics.width, 3)
    d_rgb = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    stages = {
        "forward": lambda: rasterizer.render([camera]),
        "pose_gradient": lambda: rasterizer.pose_gradient(camera, d_rgb),
        "all_gradients": lambda: rasterizer.scene_gradients(camera, d_rgb),
    }
    seconds = {stage: [] for stage in stages}
    for _ in range(repeats + 1):
        # In turn, so that a slow moment of the machine affects all stages alike.
        for stage, call in stages.items():
            seconds[stage].append(_seconds(call))
    return {stage: np.array(each[1:]).T for stage, each in seconds.items()}


def _seconds(call: Callable[[], object]) -> tuple[float, float]:
    wall, cpu = time.perf_counter(), time.process_time()
    call()
    return time.perf_counter() - wall, time.process_time() - cpu


def synthetic_room(count: int, sh_degree: int = 3, seed: int = 0) -> GaussianScene:
    """Return a room of `count` Gaussians, which depends on the arguments only."""
    rng = np.random.default_rng(seed)
    loose = int(count * _LOOSE_SHARE)
    means, normals, area = _on_surfaces(count - loose, rng)
    means = np.concatenate([means, rng.uniform(-0.48, 0.48, (loose, 3)) * ROOM])
    normals = np.concatenate([normals, _directions(loose, rng)])
    spacing = np.sqrt(area / count)
    scales = _SCALE_OVER_SPACING * spacing * np.exp(rng.normal(0.0, 0.35, (count, 3)))
    # Flat, as trained Gaussians on surfaces are.
    scales[:, 2] *= 0.1
    sh = rng.normal(0.0, 0.05, (count, (sh_degree + 1) ** 2, 3))
    sh[:, 0] = 1.2 * np.sin(means[:, None, :] * [1.3, 1.7, 2.1] + means[:, :1, None])[:, 0]
    return GaussianScene(
        means=means.astype(np.float32),
        quats=_rotations_to(normals, rng).astype(np.float32),
        scales=scales.astype(np.float32),
        opacities=(1 / (1 + np.exp(-rng.normal(1.0, 1.5, count)))).astype(np.float32),
        sh=sh.astype(np.float32),
        info=SceneInfo(f"room-{count}", "synthetic room", f"room-{count}-{sh_degree}-{seed}", "synthetic"),
    )


def room_cameras(width: int) -> list[Camera]:
    """Return six cameras inside the room with images of this width, 4:3."""
    height = width * 3 // 4
    focal = width / (2 * np.tan(FIELD_OF_VIEW_RAD / 2))
    intrinsics = Intrinsics(width, height, focal, focal, width / 2, height / 2)
    cameras = []
    for index, distance in enumerate((2.8, 2.8, 2.2, 2.5, 2.7, 2.1)):
        angle = np.radians(60.0 * index + 20.0)
        target = np.array([4.0 * np.cos(angle), 3.0 * np.sin(angle), -0.3])
        back = np.array([np.cos(angle + 0.3), np.sin(angle + 0.3), 0.1 * np.cos(2 * angle) - 0.15])
        cameras.append(Camera(intrinsics, look_at(target - distance * back, target, np.array([0.0, 0.0, 1.0]))))
    return cameras


def _on_surfaces(
    count: int, rng: np.random.Generator
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"], float]:
    """Return points uniform on walls and furniture, their normals, and the total area in square scene units."""
    boxes = [(np.zeros(3), ROOM)]
    # Furniture along the walls, where no camera is.
    for x, y, w, d, h in (
        (-3.2, 1.8, 1.2, 1.8, 1.1),
        (3.2, -1.5, 1.0, 2.2, 1.9),
        (0.5, 2.5, 2.4, 0.8, 0.8),
        (-1.0, -2.5, 2.0, 0.7, 1.4),
        (2.9, 2.2, 0.8, 0.8, 0.6),
        (-3.3, -2.2, 0.9, 0.9, 2.0),
    ):
        boxes.append((np.array([x, y, (h - ROOM[2]) / 2]), np.array([w, d, h])))
    faces = []
    for centre, size in boxes:
        for axis in range(3):
            for side in (-0.5, 0.5):
                normal = np.eye(3)[axis]
                faces.append((centre + side * size * normal, size * (1 - normal), normal))
    areas = np.array([np.prod(size[normal == 0]) for _, size, normal in faces])
    # By area, so that the density is the same everywhere.
    of_point = rng.choice(len(faces), count, p=areas / areas.sum())
    centres, sizes, normals = (np.stack(part)[of_point] for part in zip(*faces, strict=True))
    means = centres + sizes * rng.uniform(-0.5, 0.5, (count, 3))
    return means, normals, float(areas.sum())


def _directions(count: int, rng: np.random.Generator) -> Float64[np.ndarray, "n 3"]:
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _rotations_to(normals: Float64[np.ndarray, "n 3"], rng: np.random.Generator) -> Float64[np.ndarray, "n 4"]:
    """Return quaternions wxyz that rotate the thin axis (z) to the normal, after a random rotation about z."""
    # From z to n: (1 + n_z, z x n), not yet normalized; a half turn about x where n is -z.
    tilt = np.stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(len(normals))], 1)
    tilt[tilt[:, 0] < 1e-6] = [0.0, 1.0, 0.0, 0.0]
    tilt /= np.linalg.norm(tilt, axis=1, keepdims=True)
    half = rng.uniform(0, np.pi, len(normals))
    cos, sin = np.cos(half), np.sin(half)
    w, x, y, z = tilt.T
    return np.stack([w * cos - z * sin, x * cos + y * sin, y * cos - x * sin, z * cos + w * sin], 1)
