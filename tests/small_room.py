"""A scene folder that can be localized in: a box whose walls are patchworks of random colours, seen from inside."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from service.geometry import look_at, quat_from_rotation
from service.types import Pose

SIZE = np.array([4.0, 3.0, 2.5])
SPACING = 0.06
WIDTH, HEIGHT, FOCAL = 320, 240, 240.0
INTRINSICS = {"width": WIDTH, "height": HEIGHT, "fx": FOCAL, "fy": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2}


HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
UPSIDE_DOWN = np.diag([1.0, -1.0, -1.0, 1.0])
MIRROR_NOISE = 0.1


def write_room(
    folder: Path,
    cameras: int = 24,
    *,
    repeated: bool = False,
    symmetric: bool = False,
    upside_down: bool = False,
    apart: float = 0.0,
) -> Path:
    """Write `scene.ply` (Inria's layout, degree 0) and `transforms.json`; return the folder.

    A `repeated` room is the same after HALF_TURN: every photo has two places where it may have been taken. One
    half of a `symmetric` room is nearly the mirror image of the other: MIRROR_NOISE sets its colours apart. One that is
    the same `upside_down` is so after UPSIDE_DOWN. With `apart` there is another room like it that far along x.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(3)
    walls = [_wall(axis, side, rng) for axis in range(3) for side in (-1, 1)]
    means, quats, colours = (np.concatenate(parts) for parts in zip(*walls, strict=True))
    if repeated:  # a half turn changes no Gaussian's shape here
        one = means[:, 0] > 0
        means = np.concatenate([means[one], means[one] * [-1, -1, 1]])
        quats, colours = (np.concatenate([part[one]] * 2) for part in (quats, colours))
    if symmetric:
        one = means[:, 0] > 0
        means = np.concatenate([means[one], means[one] * [-1, 1, 1]])
        noise = rng.normal(0, MIRROR_NOISE, (one.sum(), 3))
        quats, colours = np.concatenate([quats[one]] * 2), np.concatenate([colours[one], colours[one] + noise])
    if upside_down:
        one = means[:, 2] > 0
        means = np.concatenate([means[one], means[one] * [1, -1, -1]])
        quats, colours = (np.concatenate([part[one]] * 2) for part in (quats, colours))
    poses = training_poses(cameras)
    if apart:
        means = np.concatenate([means, means + np.array([apart, 0, 0])])
        quats, colours = np.concatenate([quats] * 2), np.concatenate([colours] * 2)
        shift = np.eye(4)
        shift[0, 3] = apart
        poses += [Pose(shift @ pose.world_from_camera) for pose in poses]
    scales = np.tile(np.log([0.5 * SPACING, 0.5 * SPACING, 0.003]), (len(means), 1))
    columns = {
        **dict(zip("xyz", means.T, strict=True)),
        **{f"f_dc_{i}": (colours[:, i] - 0.5) / 0.28209479177387814 for i in range(3)},
        "opacity": np.full(len(means), 6.0),
        **{f"scale_{i}": scales[:, i] for i in range(3)},
        **{f"rot_{i}": quats[:, i] for i in range(4)},
    }
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(means)}"]
    header += [*(f"property float {name}" for name in columns), "end_header\n"]
    table = np.stack(list(columns.values()), 1).astype("<f4")
    (folder / "scene.ply").write_bytes("\n".join(header).encode() + table.tobytes())
    frames = [
        {
            "file_path": f"images/{i}.png",
            "transform_matrix": (pose.world_from_camera @ np.diag([1.0, -1, -1, 1])).tolist(),
        }
        for i, pose in enumerate(poses)
    ]
    camera = {"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    (folder / "transforms.json").write_text(json.dumps({**camera, "frames": frames}))
    return folder


def training_poses(count: int) -> list[Pose]:
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return [pose_at(angle, 0.2 * np.sin(3 * angle)) for angle in angles]


def pose_at(angle: float, height: float) -> Pose:
    """A camera near the middle that looks out, level with `height`."""
    outwards = np.array([np.cos(angle), np.sin(angle), 0.0])
    position = -0.6 * outwards + [0.0, 0.0, height]
    return look_at(position, position + outwards, np.array([0.0, 0.0, 1.0]))


def _wall(axis: int, side: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gaussians on one wall; colours are constant over patches of 2 to 5 of them."""
    u, v = (a for a in range(3) if a != axis)
    across = [np.arange(-SIZE[a] / 2, SIZE[a] / 2, SPACING) for a in (u, v)]
    grid = np.stack(np.meshgrid(*across, indexing="ij"), -1)
    means = np.zeros((*grid.shape[:2], 3))
    means[..., u], means[..., v], means[..., axis] = grid[..., 0], grid[..., 1], side * SIZE[axis] / 2
    colours = np.zeros_like(means)
    for _ in range(400):
        row, column = rng.integers(0, grid.shape[0]), rng.integers(0, grid.shape[1])
        height, width = rng.integers(2, 6, 2)
        colours[row : row + height, column : column + width] = rng.uniform(0, 1, 3)
    rotation = np.zeros((3, 3))
    rotation[u, 0] = rotation[v, 1] = 1.0
    rotation[:, 2] = np.cross(rotation[:, 0], rotation[:, 1])
    count = means.shape[0] * means.shape[1]
    return means.reshape(-1, 3), np.tile(quat_from_rotation(rotation), (count, 1)), colours.reshape(-1, 3)
