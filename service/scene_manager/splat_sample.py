"""A scene's Gaussians in a compact binary form for drawing: the most important first, SH degree 0.

Layout, all little-endian:

    uint32               length of the header in bytes (a multiple of 4)
    header               JSON, padded with spaces: {"scene", "sha256", "count", "total"}
    float32[count, 3]    centres in the world
    float32[count, 6]    covariances in the world: xx, xy, xz, yy, yz, zz
    uint8[count, 4]      red, green, blue (sRGB, from SH degree 0), opacity

Ordered by importance, the greatest first, so that any prefix is a good choice.
"""

from __future__ import annotations

import json

import numpy as np
from jaxtyping import Float32

from service.geometry import rotation_from_quat
from service.types import SH_C0, GaussianScene

BINARY = "application/octet-stream"
_VIEWPOINTS = 16
_UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def packed_splats(scene: GaussianScene, limit: int) -> bytes:
    """Return the `limit` most important Gaussians in the layout above; deterministic."""
    chosen = np.argsort(-importance(scene), kind="stable")[:limit]
    info = scene.info
    header = json.dumps({"scene": info.id, "sha256": info.sha256, "count": len(chosen), "total": scene.count}).encode()
    # Aligned, so that a client can view the arrays without copying them.
    header += b" " * (-len(header) % 4)
    rotation = rotation_from_quat(scene.quats[chosen])
    axes = rotation * scene.scales[chosen][:, None, :]
    covariance = axes @ np.swapaxes(axes, 1, 2)
    rgb = 0.5 + SH_C0 * scene.sh[chosen, 0, :]
    rgba = np.concatenate([rgb, scene.opacities[chosen][:, None]], 1)
    return b"".join(
        [
            np.uint32(len(header)).astype("<u4").tobytes(),
            header,
            (scene.means[chosen] + np.array(info.origin_in_world)).astype("<f4").tobytes(),
            np.stack([covariance[:, i, j] for i, j in _UPPER], 1).astype("<f4").tobytes(),
            np.rint(np.clip(rgba, 0, 1) * 255).astype(np.uint8).tobytes(),
        ]
    )


def importance(scene: GaussianScene) -> Float32[np.ndarray, "n"]:
    """Opacity times projected area, where the scene was looked at from.

    The area is the mean over all directions (Cauchy: a quarter of the surface, here of the box of the axes,
    up to a factor), over the squared distance to the middle one of up to 16 training cameras; a nearest one
    would favour floaters before a lens.
    """
    a, b, c = scene.scales.T
    area = a * b + b * c + c * a
    if scene.cameras:
        every = max(1, len(scene.cameras) // _VIEWPOINTS)
        eyes = [np.float32(named.camera.pose.position_in_world) for named in scene.cameras[::every]]
        squared = np.stack([((scene.means - eye) ** 2).sum(1) for eye in eyes[:_VIEWPOINTS]])
        area = area / np.maximum(np.median(squared, 0), np.float32(1e-12))
    return (scene.opacities * area).astype(np.float32)
