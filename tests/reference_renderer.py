"""The specification of the renderer: dense, float64, differentiable by autograd, slow, short.

Every Gaussian meets every pixel, near to far. Written from the equations of EWA splatting (Zwicker 2001) and
of 3DGS (Kerbl 2023) with gsplat's conventions; shares no code with the kernels.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

ALPHA_MIN, ALPHA_MAX, T_MIN, NEAR = 1 / 255, 0.999, 1e-4, 0.01


class Picture(NamedTuple):
    rgb: Tensor
    alpha: Tensor
    depth: Tensor
    median_depth: Tensor


def rotation(quats: Tensor) -> Tensor:
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).reshape(*quats.shape[:-1], 3, 3)


def sh_basis(directions: Tensor, count: int) -> Tensor:
    """Real spherical harmonics in 3DGS's order and signs, from the Cartesian table."""
    x, y, z = directions.unbind(-1)
    pi = torch.pi
    basis = [
        torch.full_like(x, 0.5 * (1 / pi) ** 0.5),
        -((3 / (4 * pi)) ** 0.5) * y, (3 / (4 * pi)) ** 0.5 * z, -((3 / (4 * pi)) ** 0.5) * x,
        0.5 * (15 / pi) ** 0.5 * x * y, -0.5 * (15 / pi) ** 0.5 * y * z,
        0.25 * (5 / pi) ** 0.5 * (3 * z * z - 1), -0.5 * (15 / pi) ** 0.5 * x * z,
        0.25 * (15 / pi) ** 0.5 * (x * x - y * y),
        -0.25 * (35 / (2 * pi)) ** 0.5 * y * (3 * x * x - y * y), 0.5 * (105 / pi) ** 0.5 * x * y * z,
        -0.25 * (21 / (2 * pi)) ** 0.5 * y * (5 * z * z - 1), 0.25 * (7 / pi) ** 0.5 * z * (5 * z * z - 3),
        -0.25 * (21 / (2 * pi)) ** 0.5 * x * (5 * z * z - 1), 0.25 * (105 / pi) ** 0.5 * z * (x * x - y * y),
        -0.25 * (35 / (2 * pi)) ** 0.5 * x * (x * x - 3 * y * y),
    ]  # fmt: skip
    return torch.stack(basis[:count], -1)


def render(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor, camera_from_world: Tensor,
    lens: tuple[float, float, float, float], width: int, height: int, dilation: float,
    background: Tensor, antialiased: bool = False,
) -> Picture:  # fmt: skip
    """All tensors float64. `lens` is fx, fy, cx, cy."""
    fx, fy, cx, cy = lens
    r, t = camera_from_world[:3, :3], camera_from_world[:3, 3]
    points = means @ r.T + t
    order = torch.argsort(points[:, 2].detach())
    order = order[points[order, 2] > NEAR]
    points, opacities, sh = points[order], opacities[order], sh[order]
    x, y, z = points.unbind(-1)
    factor = rotation(quats[order]) * scales[order][:, None, :]
    covariance = r @ factor @ factor.transpose(1, 2) @ r.T
    u = z * torch.clamp(x / z, -(cx / fx + 0.15 * width / fx), (width - cx) / fx + 0.15 * width / fx)
    v = z * torch.clamp(y / z, -(cy / fy + 0.15 * height / fy), (height - cy) / fy + 0.15 * height / fy)
    zero = torch.zeros_like(z)
    jacobian = torch.stack([fx / z, zero, -fx * u / z**2, zero, fy / z, -fy * v / z**2], -1).reshape(-1, 2, 3)
    sharp = jacobian @ covariance @ jacobian.transpose(1, 2)
    dull = sharp + dilation * torch.eye(2, dtype=means.dtype)
    if antialiased:
        opacities = opacities * torch.sqrt(torch.clamp(torch.det(sharp) / torch.det(dull), min=1e-30))
    conics = torch.linalg.inv(dull)
    eye = -r.T @ t
    directions = torch.nn.functional.normalize(means[order] - eye, dim=-1)
    colours = torch.clamp((sh_basis(directions, sh.shape[1])[:, :, None] * sh).sum(1) + 0.5, min=0)
    centres = torch.stack([fx * x / z + cx, fy * y / z + cy], -1)
    return composite(centres, conics, z, colours, opacities, width, height, background)


def composite(
    centres: Tensor, conics: Tensor, depths: Tensor, colours: Tensor, opacities: Tensor, width: int, height: int,
    background: Tensor,
) -> Picture:  # fmt: skip
    """Blend ellipses that are sorted from near to far; `conics` are 2x2 inverses of covariances."""
    py, px = torch.meshgrid(
        torch.arange(height, dtype=depths.dtype) + 0.5,
        torch.arange(width, dtype=depths.dtype) + 0.5,
        indexing="ij",
    )
    dx = centres[:, 0, None] - px.reshape(1, -1)
    dy = centres[:, 1, None] - py.reshape(1, -1)
    sigma = 0.5 * (conics[:, 0, 0, None] * dx**2 + conics[:, 1, 1, None] * dy**2) + conics[:, 0, 1, None] * dx * dy
    alphas = torch.clamp(opacities[:, None] * torch.exp(-sigma), max=ALPHA_MAX)
    alphas = torch.where(alphas >= ALPHA_MIN, alphas, torch.zeros_like(alphas))
    after = torch.cumprod(1 - alphas, 0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    counted = after > T_MIN
    weights = torch.where(counted, alphas * before, torch.zeros_like(alphas))
    alpha = weights.sum(0)
    rgb = weights.T @ colours + (1 - alpha)[:, None] * background
    depth = torch.where(alpha > 0, (weights * depths[:, None]).sum(0) / torch.clamp(alpha, min=1e-12), 0.0)
    crossing = (before > 0.5) & (after <= 0.5) & counted
    median = torch.where(crossing, depths[:, None], torch.zeros_like(sigma)).amax(0)
    shape = (height, width)
    return Picture(rgb.reshape(*shape, 3), alpha.reshape(shape), depth.reshape(shape), median.reshape(shape))
