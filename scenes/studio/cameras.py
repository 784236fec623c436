"""Camera poses of the studio's photos: training views that cover the room, and held-out views.

Poses are camera-to-world matrices in OpenGL axes (+x right, +y up, looking along -z), which is
also what Blender's cameras use.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, sin

import bpy
import numpy as np
import room
from mathutils import Vector
from mathutils.bvhtree import BVHTree

Array = np.ndarray
Rng = np.random.Generator

CLEARANCE = 0.36  # metres that every camera keeps from the nearest surface
LENS = 30.0  # 35 mm equivalent of the normal lens: 61.9 degrees along the long side
WIDE_LENS = 18.0  # 90 degrees
LONG_SIDE, SHORT_SIDE = 640, 480


@dataclass(frozen=True)
class View:
    """One photo to take: upright image size, lens (35 mm on the long side) and pose."""

    name: str
    width: int
    height: int
    lens: float
    pose: Array

    @property
    def focal(self) -> float:
        """Focal length in pixels, the same along x and y."""
        return self.lens / 36.0 * max(self.width, self.height)


class Room:
    """Ray casts into the finished scene."""

    def __init__(self) -> None:
        vertices: list = []
        faces: list = []
        for thing in bpy.context.scene.objects:
            if thing.type != "MESH":
                continue
            start = len(vertices)
            vertices += [thing.matrix_world @ v.co for v in thing.data.vertices]
            faces += [[start + k for k in face.vertices] for face in thing.data.polygons]
        self.tree = BVHTree.FromPolygons(vertices, faces)

    def hit(self, origin: Array, direction: Array) -> tuple[Array, Array, float] | None:
        """Return point, normal and distance of the first surface along a unit direction."""
        point, normal, _, distance = self.tree.ray_cast(Vector(origin), Vector(direction))
        return None if point is None else (np.array(point), np.array(normal), distance)

    def gap(self, point: Array) -> float:
        """Return the distance from a point to the nearest surface."""
        return self.tree.find_nearest(Vector(point))[3]

    def sees(self, eye: Array, point: Array, tolerance: float = 0.01) -> bool:
        """Return whether nothing occludes a surface point from the eye."""
        ray = point - eye
        distance = float(np.linalg.norm(ray))
        found = self.hit(eye, ray / distance)
        return found is not None and found[2] > distance - tolerance


def look(position: Array, yaw: float, pitch: float, roll: float = 0.0) -> Array:
    """Return the pose of a camera looking along `yaw` (about z from +x) and `pitch` (up is positive)."""
    forward = np.array([cos(pitch) * cos(yaw), cos(pitch) * sin(yaw), sin(pitch)])
    right = np.array([sin(yaw), -cos(yaw), 0.0])
    up = np.cross(right, forward)
    pose = np.eye(4)
    pose[:3, 0] = cos(roll) * right + sin(roll) * up
    pose[:3, 1] = cos(roll) * up - sin(roll) * right
    pose[:3, 2] = -forward
    pose[:3, 3] = position
    return pose


def ray(view: View, u: float, v: float) -> Array:
    """World direction with unit z-depth through image position (u, v), pixel centres at +0.5."""
    local = np.array([(u - view.width / 2) / view.focal, (view.height / 2 - v) / view.focal, -1.0])
    return view.pose[:3, :3] @ local


def project(view: View, points: Array) -> tuple[Array, Array, Array]:
    """Image positions (u, v) and z-depths of world points; depth is negative behind."""
    local = (points - view.pose[:3, 3]) @ view.pose[:3, :3]
    depth = -local[:, 2]
    safe = np.where(np.abs(depth) < 1e-9, 1e-9, depth)
    u = view.width / 2 + view.focal * local[:, 0] / safe
    v = view.height / 2 - view.focal * local[:, 1] / safe
    return u, v, depth


def free_position(space: Room, rng: Rng) -> Array:
    """Return a random eye position with a minimum distance from all surfaces."""
    low = np.array([CLEARANCE, CLEARANCE, 0.7])
    high = np.array([room.SIZE[0] - CLEARANCE, room.SIZE[1] - CLEARANCE, 2.1])
    while True:
        at = low + (high - low) * rng.random(3)
        if space.gap(at) >= CLEARANCE:
            return at


def open_view(space: Room, view: View) -> bool:
    """Return whether the image is not mostly filled by a close surface."""
    depths = []
    for u in np.linspace(0.08, 0.92, 7) * view.width:
        for v in np.linspace(0.08, 0.92, 6) * view.height:
            direction = ray(view, u, v)
            found = space.hit(view.pose[:3, 3], direction / np.linalg.norm(direction))
            depths.append(found[2] if found else 3.0)
    return float(np.median(depths)) > 1.0 and float(np.quantile(depths, 0.1)) > 0.5


def surface_sample(space: Room, rng: Rng, count: int) -> tuple[Array, Array]:
    """Return points and normals on the surfaces that are visible from free space."""
    points, normals = [], []
    while len(points) < count:
        eye = free_position(space, rng)
        for _ in range(25):
            direction = rng.normal(size=3)
            found = space.hit(eye, direction / np.linalg.norm(direction))
            if found:
                points.append(found[0])
                facing = np.sign(np.dot(found[1], eye - found[0])) or 1.0
                normals.append(found[1] * facing)
    return np.array(points), np.array(normals)


def visible(space: Room, view: View, points: Array, normals: Array) -> Array:
    """Return the mask of surface points that a view shows at a sufficient angle."""
    u, v, depth = project(view, points)
    eye = view.pose[:3, 3]
    toward = eye - points
    cosine = np.einsum("ij,ij->i", toward, normals) / np.linalg.norm(toward, axis=1)
    mask = (depth > 0.3) & (u > 4) & (u < view.width - 4) & (v > 4) & (v < view.height - 4)
    mask &= cosine > 0.17
    for k in np.flatnonzero(mask):
        mask[k] = space.sees(eye, points[k])
    return mask


def training_views(space: Room, rng: Rng, count: int, pool: int = 640) -> list[View]:
    """Choose among random views greedily: each adds most to the coverage of points that few views show."""
    points, normals = surface_sample(space, rng, 2500)
    views: list[View] = []
    while len(views) < pool:
        pitch = float(np.clip(rng.normal(-0.10, 0.40), -0.95, 0.85))
        pose = look(free_position(space, rng), rng.random() * 2 * np.pi, pitch, rng.normal() * 0.03)
        view = View("candidate", LONG_SIDE, SHORT_SIDE, LENS, pose)
        if open_view(space, view):
            views.append(view)
    masks = np.array([visible(space, view, points, normals) for view in views])
    eyes = np.array([view.pose[:3, 3] for view in views])
    ahead = np.array([-view.pose[:3, 2] for view in views])
    seen = np.zeros(len(points))
    crowd = np.ones(pool)  # shrinks for candidates much like a view already chosen
    chosen: list[View] = []
    for k in range(count):
        best = int(np.argmax((masks @ (0.8**seen)) * crowd))
        near = np.exp(-np.sum((eyes - eyes[best]) ** 2, axis=1) / 0.35**2)
        crowd *= 1 - 0.75 * near * np.clip(ahead @ ahead[best], 0.2, 1)
        crowd[best] = 0
        seen += masks[best]
        chosen.append(View(f"{k:04d}", LONG_SIDE, SHORT_SIDE, LENS, views[best].pose))
    shares = ", ".join(f"{np.mean(seen >= n):.1%} in {n}+" for n in (1, 3, 6))
    print(f"training views: surface points seen {shares}", flush=True)
    return chosen


def heldout_views(space: Room, rng: Rng, training: list[View], lenses: list[tuple]) -> list[View]:
    """Return views each between two training views; `lenses` holds (width, height, lens) per view."""
    pool: list[Array] = []
    while len(pool) < 150:
        a, b = (training[k].pose for k in rng.choice(len(training), 2, replace=False))
        apart = np.linalg.norm(a[:3, 3] - b[:3, 3])
        if not 0.3 < apart < 1.5 or np.dot(a[:3, 2], b[:3, 2]) < 0.6:
            continue
        t = 0.35 + 0.3 * rng.random()
        eye = a[:3, 3] * (1 - t) + b[:3, 3] * t + 0.04 * rng.normal(size=3)
        ahead = -(a[:3, 2] * (1 - t) + b[:3, 2] * t)
        yaw = float(np.arctan2(ahead[1], ahead[0])) + 0.08 * rng.normal()
        pitch = float(np.arctan2(ahead[2], np.hypot(ahead[0], ahead[1])))
        pose = look(eye, yaw, pitch, 0.04 * rng.normal())
        alone = min(np.linalg.norm(v.pose[:3, 3] - eye) for v in training) > 0.12
        inside = 0.7 <= eye[2] <= 2.1 and space.gap(eye) >= CLEARANCE and -0.55 < pitch < 0.28
        if alone and inside and open_view(space, View("candidate", 640, 480, LENS, pose)):
            pool.append(pose)
    # Farthest-point choice, so that the held-out photos differ in place and direction.
    keys = np.array([np.concatenate([p[:3, 3], 1.2 * p[:3, 2]]) for p in pool])
    picks = [0]
    while len(picks) < len(lenses):
        gaps = np.linalg.norm(keys[:, None] - keys[picks][None], axis=2).min(axis=1)
        picks.append(int(np.argmax(gaps)))
    return [View(f"photo_{k:02d}", *lens, pool[pick]) for k, (lens, pick) in enumerate(zip(lenses, picks, strict=True))]
