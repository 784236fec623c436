"""Draws a scene: a plan view of its surfaces and cameras, and two renders that show it from different directions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8

from service.coverage.coverage_map import heading_of
from service.coverage.plan import assumed_up, plan_axes
from service.coverage.plan_drawing import PAPER, draw_dot, draw_wedge, shade, write_scale, write_words
from service.interfaces import Rasterizer
from service.photos.images import encode_image
from service.pose.features.rendered_views import to_uint8
from service.types import Camera, GaussianScene, SceneInfo

_PX, _RENDER_PX, _MARGIN, _LINE, _GAP = 600, 440, 30, 26, 6
_VIEW_COLOUR = (74, 152, 207)
_OPAQUE = 0.3
"""Fainter Gaussians are haze, which in plan view would cover the walls."""


def drawn_scene(scene: GaussianScene, rasterizer: Rasterizer, views: Sequence[Camera], info: SceneInfo) -> bytes:
    """Return a PNG: the plan with training cameras (red) and index views (blue), beside it two renders.

    `views` are relative to the scene's origin; `info` has the scene's name, up direction and unit.
    """
    trained = [named.camera for named in scene.cameras]
    captured = trained or list(views)
    surfaces = scene.means[scene.opacities > _OPAQUE].astype(np.float64)
    surfaces = surfaces if len(surfaces) else scene.means.astype(np.float64)
    up = info.up_in_world or (None if trained else assumed_up(surfaces))
    plan_from_world = plan_axes(captured, up)
    plan = _plan(surfaces, trained, views, plan_from_world, info.metres_per_unit)
    renders = _renders(rasterizer, captured)
    height = _LINE + max(len(plan), len(renders))
    image = np.full((height, _PX + renders.shape[1], 3), PAPER, np.uint8)
    image[_LINE : _LINE + len(plan), :_PX] = plan
    image[_LINE : _LINE + len(renders), _PX:] = renders
    write_words(image, f"{info.name}: {scene.count:,} Gaussians", (_MARGIN, _LINE - 7), 0.55)
    return encode_image(image, "png")


def _plan(
    surfaces: Float[np.ndarray, "n 3"],
    trained: Sequence[Camera],
    views: Sequence[Camera],
    plan_from_world: Float[np.ndarray, "3 3"],
    metres_per_unit: float | None,
) -> UInt8[np.ndarray, "h w 3"]:
    """Return the plan view with its legend, up to the middle 98 % of the surfaces and all cameras."""
    points = (surfaces @ plan_from_world.T)[:, :2]
    positions = {
        kind: np.array([c.pose.position_in_world @ plan_from_world.T for c in cameras]).reshape(-1, 3)[:, :2]
        for kind, cameras in (("view", views), ("trained", trained))
    }
    around = np.concatenate([np.quantile(points, [0.01, 0.99], axis=0), *positions.values()])
    low, high = around.min(0), around.max(0)
    # A scene of one point has no extent.
    scale = (_PX - 2 * _MARGIN) / (float((high - low).max()) or 1.0)
    height = int((high - low)[1] * scale) + 2 * _MARGIN

    def pixels(at: np.ndarray) -> np.ndarray:
        x, y = ((at - low) * scale).T
        return np.stack([_MARGIN + x, height - _MARGIN - y], 1)

    image = np.full((height + 4 * _LINE, _PX, 3), PAPER, np.uint8)
    shade(image[:height], pixels(points))
    for camera, at in zip(views, pixels(positions["view"]), strict=True):
        draw_wedge(image, at, 12.0, heading_of(camera.pose, plan_from_world), np.pi / 10, _VIEW_COLOUR)
    for at in pixels(positions["trained"]):
        draw_dot(image, at)
    unit = "m" if metres_per_unit else "units"
    write_scale(image, (_MARGIN, height + 20), scale / (metres_per_unit or 1.0), f"{unit}, seen from above")
    draw_wedge(image, np.array([_MARGIN, height + 44.0]), 12.0, 0.0, np.pi / 10, _VIEW_COLOUR)
    write_words(image, f"{len(views)} views of the index, in their direction", (_MARGIN + 24, height + 49), 0.5)
    draw_dot(image, np.array([_MARGIN + 6.0, height + 70.0]), 4)
    write_words(image, f"{len(trained)} training cameras", (_MARGIN + 24, height + 75), 0.5)
    return image


def _renders(rasterizer: Rasterizer, captured: Sequence[Camera]) -> UInt8[np.ndarray, "h w 3"]:
    """Return renders, one below the other, by the camera in the middle of the list and by that which looks most
    differently; nothing without cameras."""
    if not captured:
        return np.zeros((0, 0, 3), np.uint8)
    first = captured[len(captured) // 2]
    alike = [float(first.pose.axis_in_world @ camera.pose.axis_in_world) for camera in captured]
    chosen = [first] if len(captured) == 1 else [first, captured[int(np.argmin(alike))]]
    sized = [Camera(camera.intrinsics.with_long_side(_RENDER_PX), camera.pose) for camera in chosen]
    found = []
    for frame in rasterizer.render(sized):
        rgb = to_uint8(frame.rgb)
        # Upright photos are narrower than wide ones.
        padded = np.full((len(rgb) + _GAP, _RENDER_PX, 3), PAPER, np.uint8)
        padded[: len(rgb), : rgb.shape[1]] = rgb
        found.append(padded)
    return np.concatenate(found, 0)
