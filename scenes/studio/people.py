"""People who stand in the studio: simple figures, and where they stand in a photo."""

from __future__ import annotations

from math import cos, pi, sin

import bpy
import cameras
import materials
import numpy as np
import room
import shapes
import textures
from cameras import Room, View
from mathutils import Matrix, Vector
from mathutils.bvhtree import BVHTree

Rng = np.random.Generator

COVERED = (0.14, 0.40)
"""Share of a photo that people cover."""
SKINS = ((0.86, 0.66, 0.54), (0.62, 0.42, 0.30), (0.40, 0.26, 0.19), (0.76, 0.56, 0.42))
HAIRS = ((0.12, 0.09, 0.08), (0.45, 0.30, 0.16), (0.72, 0.56, 0.32), (0.50, 0.48, 0.46))
CLOTHES = ((0.16, 0.22, 0.36), (0.62, 0.20, 0.18), (0.85, 0.83, 0.78), (0.24, 0.36, 0.26), (0.20, 0.20, 0.22))


def crowd(rng: Rng) -> list[bpy.types.Object]:
    """Return six people who differ in height, clothes and posture, at the origin, facing +y."""
    return [person(f"person{k}", 1.52 + 0.07 * k, k, rng) for k in range(6)]


def person(name: str, tall: float, kind: int, rng: Rng) -> bpy.types.Object:
    """One standing figure: legs, trunk, arms, neck, head with hair."""
    skin = materials.plain(f"{name}_skin", SKINS[kind % 4], 0.6)
    hair = materials.plain(f"{name}_hair", HAIRS[(kind * 3) % 4], 0.8)
    trousers = materials.plain(f"{name}_trousers", CLOTHES[(kind * 2 + 4) % 5], 0.9)
    weave = textures.fabric(300, 300, rng) if kind % 3 == 0 else textures.plaster(300, 300, CLOTHES[kind % 5], rng)
    shirt = materials.picture(f"{name}_shirt", weave, 0.9)
    s = tall / 1.75
    parts = []
    for side in (-0.10, 0.10):
        leg = [(0.045, 0.05), (0.055, 0.30), (0.06, 0.45), (0.085, 0.75), (0.09, 0.88)]
        parts.append(shapes.lathe("leg", leg, (side, 0, 0), trousers, 24))
        parts.append(shapes.box("shoe", (0.09, 0.26, 0.08), (side, 0.05, 0.04), hair, bevel=0.03))
    trunk = [(0, 0.80), (0.165, 0.83), (0.16, 0.98), (0.15, 1.08), (0.19, 1.30), (0.19, 1.41), (0.08, 1.49), (0, 1.50)]
    parts.append(flattened(shapes.lathe("trunk", trunk, (0, 0, 0), shirt, 36), 0.62))
    parts.append(shapes.cylinder("neck", 0.055, 0.12, (0, 0, 1.45), skin, 24))
    head = [(0, 1.52), (0.06, 1.535), (0.085, 1.60), (0.09, 1.66), (0.075, 1.73), (0, 1.75)]
    parts.append(shapes.lathe("head", head, (0, 0.01, 0), skin, 32))
    cap = [(0.09, 1.60), (0.10, 1.66), (0.085, 1.745), (0, 1.77)]
    parts.append(shapes.lathe("hair", cap, (0, -0.022, 0), hair, 32))
    for side in (-1, 1):
        parts += arm(side, raised=kind % 2 == 1 and side == 1, spread=0.1 + 0.06 * kind, shirt=shirt, skin=skin)
    for part in parts:
        part.matrix_world = Matrix.Scale(s, 4) @ part.matrix_basis
    return shapes.join(parts, name)


def flattened(thing: bpy.types.Object, depth: float) -> bpy.types.Object:
    """Scale an object along y."""
    thing.matrix_basis = thing.matrix_basis @ Matrix.Diagonal((1, depth, 1, 1))
    return thing


def arm(
    side: int, raised: bool, spread: float, shirt: bpy.types.Material, skin: bpy.types.Material
) -> list[bpy.types.Object]:
    """One arm, hanging or with the hand raised before the chest."""
    shoulder = (0.20 * side, 0, 1.40)
    elbow = (side * (0.23 + spread * 0.5), -0.02, 1.13)
    hand = (side * 0.12, 0.32, 1.25) if raised else (side * (0.24 + spread), 0.10, 0.88)
    return [
        shapes.tube("upper_arm", [shoulder, elbow], 0.052, shirt),
        shapes.sphere("elbow", 0.052, elbow, shirt, 20),
        shapes.sphere("shoulder", 0.065, shoulder, shirt, 20),
        shapes.tube("lower_arm", [elbow, hand], 0.04, skin),
        shapes.sphere("hand", 0.052, hand, skin, 20),
    ]


class Gathering:
    """Places people before a camera."""

    def __init__(self, space: Room, people: list[bpy.types.Object]) -> None:
        self.space, self.people = space, people
        self.trees = [
            BVHTree.FromPolygons([v.co for v in p.data.vertices], [tuple(f.vertices) for f in p.data.polygons])
            for p in people
        ]

    def arrange(self, view: View, rng: Rng, tries: int = 2000) -> tuple[dict[int, Matrix], float] | None:
        """Return where one to three of the people stand in a view, and the share of it that they cover.

        None, if no arrangement was found that covers the share drawn within COVERED, to 0.015.
        """
        target = rng.uniform(COVERED[0] + 0.015, COVERED[1] - 0.015)
        grid = [(u, v) for u in np.linspace(0, view.width, 65)[1::2] for v in np.linspace(0, view.height, 49)[1::2]]
        rays = [cameras.ray(view, u, v) for u, v in grid]
        rays = [ray / np.linalg.norm(ray) for ray in rays]
        found = [self.space.hit(view.pose[:3, 3], ray) for ray in rays]
        behind = [np.inf if hit is None else hit[2] for hit in found]
        for _ in range(tries):
            chosen = rng.permutation(len(self.people))[: rng.integers(1, 4)].tolist()
            places = {k: self._place(view, rng) for k in chosen}
            if any(place is None for place in places.values()):
                continue
            share = self._covered(view, rays, behind, places)
            if abs(share - target) < 0.015:
                return places, share
        return None

    def stand(self, places: dict[int, Matrix]) -> None:
        """Move the people to their places, and the others out of the room."""
        for k, thing in enumerate(self.people):
            thing.matrix_world = places.get(k, Matrix.Translation((0, 0, -10)))

    def _place(self, view: View, rng: Rng) -> Matrix | None:
        """Return a standing place before the camera where nothing is in the way of the trunk."""
        eye, ahead = view.pose[:3, 3], -view.pose[:3, 2]
        bearing = np.arctan2(ahead[1], ahead[0]) + rng.uniform(-0.6, 0.6)
        distance = rng.uniform(0.6, 2.6)
        x, y = eye[0] + distance * cos(bearing), eye[1] + distance * sin(bearing)
        inside = 0.25 < x < room.SIZE[0] - 0.25 and 0.25 < y < room.SIZE[1] - 0.25
        if not inside or any(self.space.gap(np.array([x, y, z])) < 0.2 for z in (0.5, 0.95, 1.25, 1.55)):
            return None
        return Matrix.Translation((x, y, 0)) @ Matrix.Rotation(rng.uniform(0, 2 * pi), 4, "Z")

    def _covered(self, view: View, rays: list, behind: list[float], places: dict[int, Matrix]) -> float:
        """Return the share of the rays that meet one of the people before the room."""
        hidden = np.zeros(len(rays), bool)
        for k, place in places.items():
            back = place.inverted()
            eye, turn = back @ Vector(view.pose[:3, 3]), back.to_3x3()
            for n, ray in enumerate(rays):
                distance = None if hidden[n] else self.trees[k].ray_cast(eye, turn @ Vector(ray))[3]
                hidden[n] |= distance is not None and distance < behind[n]
        return float(np.mean(hidden))
