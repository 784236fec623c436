"""A street that is the same in every run, as trainers leave outdoor captures: facades, sky shell and floaters.

         y    house house house house      Two rows of houses, no two alike, with windows, doors (some recessed),
         ^    = = pavement = = = = = =         shops and signs; a road with markings, parked cars, trees, lamp posts.
         |    - - road - - - - - - - - |end    One end is closed by a house. Training cameras go along both pavements
         +->x = = pavement = = = = = =         and look along and across. z is up; a unit is three metres. Around all,
              house house house house          at ten times its length, is a shell of huge Gaussians: the sky.

Test photos are renders of the street without floaters, from places between the training cameras and beside their paths,
by another lens, with noise, another exposure and JPEG's losses; the scene differs from what they show by its floaters
and by small errors of its Gaussians.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from service.bench.street_surfaces import (
    LATTICE,
    Paint,
    Points,
    Surface,
    box,
    bricks,
    cells,
    cylinder,
    gaussians,
    leaves,
    noise,
    placed,
    rectangle,
    rough,
)
from service.geometry import look_at
from service.photos.images import encode_image
from service.render import RASTERIZERS
from service.scene_formats.gaussians import RawGaussians, joined
from service.types import SH_C0, Camera, GaussianScene, Intrinsics, NamedCamera, Pose, SceneInfo

LENS = Intrinsics(1200, 900, 900.0, 900.0, 600.0, 450.0)
"""Of the training photos."""
PHOTO_LENS = Intrinsics(1024, 768, 700.0, 700.0, 512.0, 384.0)
UP = np.array([0.0, 0.0, 1.0])
EYE = 0.53
"""Height of the cameras."""


@dataclass(frozen=True, slots=True)
class StreetConfig:
    """A street; lengths in scene units of three metres."""

    count: int = 3_000_000
    """Gaussians, about."""
    length: float = 60.0
    half_width: float = 2.6
    """From the middle of the road to the facades."""
    kerb: float = 1.5
    """From there to the pavement."""
    training_cameras: int = 400
    photos: int = 16
    sky_share: float = 0.02
    """Of the Gaussians."""
    sky_opacity: tuple[float, float] = (0.3, 0.95)
    floaters: int = 4000
    seed: int = 0


STREET = StreetConfig()


@dataclass(frozen=True, slots=True)
class Street:
    """A street as it is, and as a trainer models it."""

    clean: GaussianScene
    trained: GaussianScene
    photo_cameras: tuple[Camera, ...]


def make_street(config: StreetConfig = STREET) -> Street:
    """Return a street with training cameras, from the seed alone."""
    rng = np.random.default_rng(config.seed)
    surfaces = [*_ground(config, rng), *_houses(config, rng), *_things(config, rng)]
    in_sky = round(config.sky_share * config.count)
    clean = joined([placed(surfaces, config.count - in_sky - config.floaters, rng), _sky(config, in_sky, rng)])
    cameras = _training_cameras(config, rng)
    floaters = _floaters(config, np.stack([c.camera.pose.position_in_world for c in cameras]), rng)
    trained = joined([_with_errors(clean, rng), floaters])
    info = SceneInfo("street", "Street", "", "ply", up_in_world=(0.0, 0.0, 1.0), training_focal_px=LENS.fx)
    clean, trained = (_scene(raw, info, cameras) for raw in (clean, trained))
    return Street(clean, trained, _photo_cameras(config, rng))


def write_photos(street: Street, folder: Path, seed: int = 0) -> None:
    """Write the test photos and their truth as the demo scene's folder has them."""
    (folder / "photos").mkdir(parents=True)
    rng, renderer, truth = np.random.default_rng(seed), RASTERIZERS.load("cpu").create(street.clean), []
    for number, camera in enumerate(street.photo_cameras):
        (frame,) = renderer.render([camera])
        taken = frame.rgb * rng.uniform(0.85, 1.15) + rng.normal(0, 0.012, frame.rgb.shape)
        name = f"photo_{number:02}.jpg"
        photo = encode_image(np.clip(taken, 0, 1).astype(np.float32), quality=85)
        (folder / "photos" / name).write_bytes(photo)
        k = camera.intrinsics
        lens = {"width": k.width, "height": k.height, "fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy}
        pose = camera.pose.world_from_camera.tolist()
        truth.append({"photo": name, "intrinsics": lens, "world_from_camera": pose})
    (folder / "truth.json").write_text(json.dumps(truth, indent=1), "utf-8")


def _scene(raw: RawGaussians, info: SceneInfo, cameras: Sequence[NamedCamera]) -> GaussianScene:
    return GaussianScene(raw.means, raw.quats, raw.scales, raw.opacities, raw.sh, info, tuple(cameras))


def _with_errors(raw: RawGaussians, rng: np.random.Generator) -> RawGaussians:
    """Return the Gaussians a fifth of their size off, with slightly other colours and opacities."""
    size = np.sort(raw.scales, axis=1)[:, 1:2]
    return replace(
        raw,
        means=raw.means + 0.2 * size * rng.standard_normal(raw.means.shape, np.float32),
        opacities=np.clip(raw.opacities - np.abs(rng.normal(0, 0.05, len(raw.opacities))), 0.02, 1).astype(np.float32),
        sh=raw.sh + np.float32(0.02 / SH_C0) * rng.standard_normal(raw.sh.shape, np.float32),
    )


def _ground(config: StreetConfig, rng: np.random.Generator) -> list[Surface]:
    asphalt, stone = (
        rough(rng, (0.3, 0.3, 0.32), 0.06, (2.0, 0.3, 0.06)),
        rough(rng, (0.5, 0.48, 0.45), 0.06, (0.9, 0.2, 0.05)),
    )
    slabs, patches = cells(rng, (0.22, 0.17), 0.5), cells(rng, (1.9, 0.8), 0.3)

    def road(p: Points) -> np.ndarray:
        rgb = asphalt(p) - 0.08 * (patches(p) > 0.8)[:, None]
        middle = (np.abs(p[:, 1] - config.kerb) < 0.03) & (p[:, 0] % 2.0 < 1.1)
        crossing = (p[:, 0] % 17.0 < 1.0) & (p[:, 1] % 0.34 < 0.17)
        return np.where((middle | crossing)[:, None], 0.82 + 0.3 * (asphalt(p) - 0.3), rgb)

    def pavement(p: Points) -> np.ndarray:
        return stone(p) + 0.16 * (slabs(p) - 0.5)[:, None]

    long, wide = config.length + 8, config.half_width + 0.4 - config.kerb
    found = [rectangle((-4, -config.kerb, 0), (long, 0, 0), (0, 2 * config.kerb, 0), road, 0.6)]
    for side in (-1, 1):
        edge = side * config.kerb
        found.append(rectangle((-4, edge, 0.05), (long, 0, 0), (0, side * wide, 0), pavement, 0.8))
        found.append(rectangle((-4, edge, 0), (long, 0, 0), (0, 0, 0.05), stone))
    return found


def _houses(config: StreetConfig, rng: np.random.Generator) -> list[Surface]:
    found: list[Surface] = []
    for side in (-1, 1):
        x, before = -4.0, 0.0
        while x < config.length + 4:
            width, height = rng.uniform(1.8, 3.6), rng.uniform(2.2, 4.6)
            front = side * (config.half_width + rng.uniform(0, 0.25))
            found += _house(
                np.array([x, front, 0]), np.array([1.0, 0, 0]), np.array([0.0, side, 0]), width, height, rng
            )
            # Of the higher of two neighbours a side shows.
            low, wall = min(before, height), rough(rng, rng.uniform(0.3, 0.7, 3), 0.1, (0.6, 0.15))
            if abs(before - height) > 0.05:
                found.append(rectangle((x, front, low), (0, side * 1.2, 0), (0, 0, abs(before - height)), wall, 0.5))
            x, before = x + width, height
    across = 2 * config.half_width + 1
    end = np.array([config.length + 4, -0.5 * across, 0])
    return found + _house(end, np.array([0.0, 1, 0]), np.array([1.0, 0, 0]), across, 4.0, rng)


def _house(
    corner: np.ndarray, along: np.ndarray, inwards: np.ndarray, width: float, height: float, rng: np.random.Generator
) -> list[Surface]:
    """Return a facade from its lower corner: wall, floors of windows, a door or a shop with its sign."""
    tint = rng.choice([[0.55, 0.28, 0.2], [0.78, 0.72, 0.6], [0.62, 0.64, 0.68], [0.7, 0.5, 0.36], [0.42, 0.5, 0.44]])
    tint = tint + rng.uniform(-0.1, 0.1, 3)
    wall = bricks(rng, tint) if rng.random() < 0.5 else rough(rng, tint, 0.11, (1.1, 0.35, 0.1, 0.05))
    holes = _openings(width, height, rng)

    def facade(p: Points) -> np.ndarray:
        rgb = wall(p)
        bands = (p[:, 1] % holes[0].pitch < 0.06) & (p[:, 1] > 0.5)
        return np.where(bands[:, None], np.clip(rgb + 0.18, 0, 1), rgb)

    found = []
    # The wall is in strips, so that there is none in front of an opening.
    for low, high, bottom, top in _around(holes, width, height):
        part = lambda p, at=(low, bottom): facade(p + at)  # noqa: E731
        place = corner + along * low + UP * bottom
        found.append(rectangle(place, along * (high - low), UP * (top - bottom), part))
    for hole in holes:
        place = corner + along * hole.left + UP * hole.bottom
        paint = hole.paint(rng)
        found.append(rectangle(place + inwards * hole.depth, along * hole.width, UP * hole.height, paint, 1.2))
        reveal = rough(rng, np.clip(tint + 0.1, 0, 1), 0.05, (0.2,))
        for at in (place, place + along * hole.width):
            found.append(rectangle(at, inwards * hole.depth, UP * hole.height, reveal))
        found.append(rectangle(place + UP * hole.height, along * hole.width, inwards * hole.depth, reveal))
    return found


@dataclass(frozen=True, slots=True)
class _Opening:
    """A window, door, shop window or sign in a facade; places from its lower left corner."""

    kind: str
    left: float
    bottom: float
    width: float
    height: float
    depth: float
    """How far it is recessed."""
    pitch: float
    """Height of the house's floors."""

    def paint(self, rng: np.random.Generator) -> Paint:
        if self.kind == "sign":
            ground, ink = rng.uniform(0.05, 0.5, 3), rng.uniform(0.55, 1.0, 3)
            glyphs, rows = cells(rng, (0.045, 0.06)), (0.2 * self.height, 0.8 * self.height)
            inside = lambda p: (glyphs(p) > 0.5) & (p[:, 1] > rows[0]) & (p[:, 1] < rows[1])  # noqa: E731
            return lambda p: np.where(inside(p)[:, None], ink, ground)
        if self.kind == "shop":
            goods, tints = cells(rng, (0.09, 0.11)), [cells(rng, (0.09, 0.11)) for _ in range(3)]
            dark = rough(rng, (0.2, 0.2, 0.22), 0.12, (0.4, 0.1))
            return lambda p: np.where(goods(p)[:, None] > 0.55, np.stack([t(p) for t in tints], 1), dark(p))
        frame, glass = rng.uniform(0.3, 0.95, 3), rough(rng, rng.uniform(0.08, 0.35, 3), 0.14, (0.3, 0.08))
        if self.kind == "door":
            glass = rough(rng, rng.uniform(0.1, 0.6, 3), 0.06, (0.2, 0.06))
        curtain, hang, bar = rng.uniform(0.5, 0.9, 3), rng.uniform(0.2, 0.9) * self.height, rng.uniform(0.3, 0.7)

        def window(p: Points) -> np.ndarray:
            from_edge = np.minimum(
                np.minimum(p[:, 0], self.width - p[:, 0]), np.minimum(p[:, 1], self.height - p[:, 1])
            )
            bars = (np.abs(p[:, 0] - 0.5 * self.width) < 0.015) | (np.abs(p[:, 1] - bar * self.height) < 0.015)
            rgb = np.where((p[:, 1] > hang)[:, None] & (self.kind == "window"), curtain + 0.4 * glass(p), glass(p))
            return np.where(((from_edge < 0.035) | bars)[:, None], frame, rgb)

        return window


def _openings(width: float, height: float, rng: np.random.Generator) -> list[_Opening]:
    pitch, depth = rng.uniform(0.85, 1.1), rng.uniform(0.03, 0.08)
    sill, tall, columns = rng.uniform(0.22, 0.35), rng.uniform(0.4, 0.55), int(rng.integers(2, 5))
    wide = min(0.45, 0.6 * width / columns) * rng.uniform(0.7, 1)
    door = 0.1 if rng.random() < 0.5 else width - 0.45
    found = [_Opening("door", door, 0.05, 0.34, 0.68, rng.choice([0.05, 0.25, 0.4]), pitch)]
    low, high = (0.55, width - 0.12) if door < 0.2 else (0.12, width - 0.57)
    if rng.random() < 0.6:
        found += [_Opening("shop", low, 0.2, high - low, 0.45, 0.04, pitch),
                  _Opening("sign", low, 0.67, high - low, 0.14, 0.0, pitch)]  # fmt: skip
    else:
        found.append(_Opening("window", low + 0.1, sill + 0.05, min(0.5, high - low - 0.2), 0.4, depth, pitch))
    for floor in range(1, int(height / pitch)):
        for column in range(columns):
            left = (column + 0.5) * width / columns - 0.5 * wide
            found.append(_Opening("window", left, floor * pitch + sill, wide, tall, depth, pitch))
    # A sign that isn't recessed has no reveals to speak of, but a thickness.
    return [replace(hole, depth=max(hole.depth, 0.01)) for hole in found if hole.bottom + hole.height < height - 0.05]


def _around(holes: Sequence[_Opening], width: float, height: float) -> list[tuple[float, float, float, float]]:
    """Return the rectangles (left, right, bottom, top) of a wall around its openings."""
    rows = sorted({0.0, height, *(h.bottom for h in holes), *(h.bottom + h.height for h in holes)})
    found = []
    for bottom, top in pairwise(rows):
        middle, x = 0.5 * (bottom + top), 0.0
        cut = [hole for hole in holes if hole.bottom < middle < hole.bottom + hole.height]
        for hole in sorted(cut, key=lambda h: h.left):
            found.append((x, hole.left, bottom, top))
            x = hole.left + hole.width
        found.append((x, width, bottom, top))
    return [each for each in found if each[1] - each[0] > 1e-3 and each[3] - each[2] > 1e-3]


def _things(config: StreetConfig, rng: np.random.Generator) -> list[Surface]:
    """Return parked cars, trees and lamp posts."""
    found: list[Surface] = []
    bark = rough(rng, (0.3, 0.24, 0.18), 0.12, (0.1, 0.04))
    for side in (-1, 1):
        for x in np.arange(1.0, config.length, 3.1):
            x, y = x + rng.uniform(-0.4, 0.4), side * (config.kerb - 0.38)
            paint = rough(rng, rng.uniform(0.08, 0.8, 3), 0.05, (0.5, 0.1))
            glass = rough(rng, (0.12, 0.14, 0.17), 0.1, (0.2, 0.06))
            if rng.random() < 0.6:
                found += box((x, y - 0.29, 0.1), (1.4, 0.58, 0.2), paint) + box(
                    (x + 0.3, y - 0.25, 0.3), (0.75, 0.5, 0.18), glass
                )
                found += [
                    cylinder((x + at, y + s * 0.27, 0.0), 0.1, 0.12, glass) for at in (0.25, 1.1) for s in (-1, 1)
                ]
            if rng.random() < 0.45:
                top = rng.uniform(1.1, 1.6)
                found.append(cylinder((x - 0.5, side * (config.kerb + 0.2), 0.05), 0.05, top, bark))
                green = rough(rng, rng.uniform([0.1, 0.25, 0.05], [0.35, 0.5, 0.2]), 0.2, (0.3, 0.07, 0.03))
                found.append(leaves((x - 0.5, side * (config.kerb + 0.2), top + 0.2), (0.6, 0.5, 0.6), green))
            elif rng.random() < 0.5:
                found.append(cylinder((x - 0.6, side * (config.kerb + 0.12), 0.05), 0.025, 1.8, glass))
    return found


def _sky(config: StreetConfig, count: int, rng: np.random.Generator) -> RawGaussians:
    """Return the shell: clouds on a gradient, ten lengths of the street away, down to below the horizon."""
    sine, angle = rng.uniform(-0.25, 1, count), rng.uniform(0, 2 * np.pi, count)
    flat = np.sqrt(1 - sine**2)
    directions = np.stack([flat * np.cos(angle), flat * np.sin(angle), sine], 1)
    radius = 10 * config.length
    at = np.stack([angle / (2 * np.pi) * LATTICE * 0.4, sine * 2.0], 1)
    clouds = noise(rng, 0.4)(at) + 0.5 * noise(rng, 0.13)(at)
    rgb = np.array([0.75, 0.82, 0.9]) + np.clip(sine, 0, 1)[:, None] * [-0.4, -0.3, -0.05] + 0.06 * clouds
    rgb[sine < 0] = [0.45, 0.47, 0.45]
    # Enough for the shell to be closed whatever the count.
    spacing = radius * np.sqrt(2.5 * np.pi / count)
    scales = np.exp(rng.uniform(np.log(max(10.0, spacing)), np.log(max(40.0, 1.5 * spacing)), (count, 3)))
    scales[:, 2] *= 0.3
    points = directions * radius * rng.uniform(0.9, 1.1, (count, 1)) + [0.5 * config.length, 0, 0]
    return gaussians(points, directions, scales, rng.uniform(*config.sky_opacity, count), rgb)


def _floaters(config: StreetConfig, places: np.ndarray, rng: np.random.Generator) -> RawGaussians:
    """Return what trainers leave: specks beside cameras, haze between them, and huge ones inside and outside."""
    shares = np.array([0.45, 0.38, 0.02, 0.15])
    specks, haze, veils, huge = np.round(shares * config.floaters).astype(int)
    away = rng.standard_normal((specks, 3)) * 0.25
    near = places[rng.integers(len(places), size=specks)] + away
    low, high = np.array([-2, -config.half_width, 0.1]), np.array([config.length + 2, config.half_width, 3.5])
    between, across = rng.uniform(low, high, (haze, 3)), rng.uniform(low, high, (veils, 3))
    # Behind the houses, above the roofs and below the road: as many as wanted, of more.
    outside = rng.uniform([-60, -90, -30], [config.length + 60, 90, 90], (8 * huge, 3))
    from_cameras = np.min([np.linalg.norm(outside - place, axis=1) for place in places[::10]], axis=0)
    large = _log_uniform((3.0, 40.0), (8 * huge, 3), rng)
    # Others would veil training photos, which is what training removes.
    hidden = np.flatnonzero(from_cameras > 3 * large.max(1))[:huge]
    sizes, opacities = [], []
    for count, size, opacity in (
        (specks, (0.005, 0.06), (0.1, 0.95)), (haze, (0.05, 0.5), (0.02, 0.4)), (veils, (1.0, 40.0), (0.003, 0.03)),
    ):  # fmt: skip
        sizes.append(_log_uniform(size, (count, 3), rng))
        opacities.append(_log_uniform(opacity, count, rng))
    sizes.append(large[hidden])
    opacities.append(_log_uniform((0.05, 0.9), len(hidden), rng))
    points = np.concatenate([near, between, across, outside[hidden]])
    normals = rng.standard_normal(points.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    rgb = np.clip(rng.uniform(0.2, 0.8, (len(points), 1)) + rng.normal(0, 0.08, points.shape), 0, 1)
    return gaussians(points, normals, np.concatenate(sizes), np.concatenate(opacities), rgb)


def _log_uniform(range_: tuple[float, float], shape: int | tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    return np.exp(rng.uniform(np.log(range_[0]), np.log(range_[1]), shape))


def _training_cameras(config: StreetConfig, rng: np.random.Generator) -> list[NamedCamera]:
    """Return cameras along both pavements, that look forward, across and back in turn."""
    found = []
    each = config.training_cameras // 2
    for side in (-1, 1):
        for number, x in enumerate(np.linspace(0.5, config.length - 0.5, each)):
            place = np.array([x, side * (config.kerb + 0.6), EYE]) + rng.normal(0, 0.04, 3)
            turn = (35, 90, 145, 70, 20, 110)[number % 6] + rng.normal(0, 4)
            found.append(NamedCamera(f"train/{len(found):04}.png", Camera(LENS, _looking(place, -side * turn, 6, rng))))
    return found


def _photo_cameras(config: StreetConfig, rng: np.random.Generator) -> tuple[Camera, ...]:
    """Return cameras up to a metre beside the paths, turned another way than the nearest training camera."""
    found = []
    for number in range(config.photos):
        side = (-1, 1)[number % 2]
        x = 3 + (config.length - 6) * (number + rng.uniform(0.1, 0.9)) / config.photos
        place = np.array([x, side * (config.kerb + 0.6) + rng.uniform(-0.33, 0.2), EYE + rng.uniform(-0.12, 0.15)])
        found.append(Camera(PHOTO_LENS, _looking(place, -side * rng.uniform(15, 165), 5, rng)))
    return tuple(found)


def _looking(place: np.ndarray, turn_deg: float, lift_deg: float, rng: np.random.Generator) -> Pose:
    """Return a pose that looks so far to the left of +x and about so far up, upright within a few degrees."""
    turn, lift = np.radians(turn_deg), np.radians(lift_deg + rng.normal(0, 3))
    ahead = np.array([np.cos(turn) * np.cos(lift), np.sin(turn) * np.cos(lift), np.sin(lift)])
    return look_at(place, place + ahead, UP + rng.normal(0, 0.02, 3))
