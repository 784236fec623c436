"""Mesh building blocks of the studio scene: boxes, quads, turned shapes, tubes, leaves, books."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, pi, sin

import bpy
import numpy as np
from mathutils import Matrix, Vector

Point = Sequence[float]


def add_mesh(
    name: str,
    vertices: Sequence,
    faces: Sequence,
    material: bpy.types.Material,
    uvs: Sequence | None = None,
    smooth: bool = False,
) -> bpy.types.Object:
    """Link a new mesh object; `uvs` holds one (u, v) per face corner in face order."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata([tuple(v) for v in vertices], [], [tuple(f) for f in faces])
    if uvs is not None:
        layer = mesh.uv_layers.new(name="UVMap")
        layer.data.foreach_set("uv", np.asarray(uvs, np.float32).ravel())
    mesh.materials.append(material)
    if smooth:
        mesh.shade_smooth()
    mesh.update()
    thing = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(thing)
    return thing


BOX_FACES = ((0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5))


def box(
    name: str,
    size: Point,
    centre: Point,
    material: bpy.types.Material,
    turn: float = 0.0,
    bevel: float = 0.004,
) -> bpy.types.Object:
    """Axis-aligned box turned about z by `turn` radians, edges rounded by `bevel` metres."""
    hx, hy, hz = (s / 2 for s in size)
    corners = [(x, y, z) for z in (-hz, hz) for y in (-hy, hy) for x in (-hx, hx)]
    thing = add_mesh(name, corners, BOX_FACES, material, [(0, 0), (1, 0), (1, 1), (0, 1)] * 6)
    thing.matrix_world = Matrix.Translation(centre) @ Matrix.Rotation(turn, 4, "Z")
    if bevel:
        modifier = thing.modifiers.new("Bevel", "BEVEL")
        modifier.width = min(bevel, min(size) * 0.3)
        modifier.segments = 2
    return thing


def quad(name: str, origin: Point, right: Point, up: Point, material: bpy.types.Material) -> bpy.types.Object:
    """Picture plane: lower left corner, and the vectors along its lower and left edges."""
    o, r, u = Vector(origin), Vector(right), Vector(up)
    corners = [o, o + r, o + r + u, o + u]
    return add_mesh(name, corners, [(0, 1, 2, 3)], material, [(0, 0), (1, 0), (1, 1), (0, 1)])


def smooth_profile(profile: Sequence[Point], steps: int) -> list[tuple[float, float]]:
    """Catmull-Rom curve through the (radius, height) points."""
    pts = np.asarray([profile[0], *profile, profile[-1]], float)
    out = []
    for k in range(1, len(pts) - 2):
        a, b, c, d = pts[k - 1 : k + 3]
        for t in np.linspace(0, 1, steps, endpoint=False):
            p = 0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
            out.append((max(float(p[0]), 0.0), float(p[1])))
    return [*out, (float(pts[-1][0]), float(pts[-1][1]))]


def lathe(
    name: str,
    profile: Sequence[Point],
    centre: Point,
    material: bpy.types.Material,
    segments: int = 48,
    steps: int = 6,
) -> bpy.types.Object:
    """Turned shape from (radius, height) points; steps 1 keeps the profile's corners sharp."""
    curve = smooth_profile(profile, steps) if steps > 1 else list(profile)
    rows = len(curve)
    vertices = [
        (r * cos(2 * pi * k / segments), r * sin(2 * pi * k / segments), z) for r, z in curve for k in range(segments)
    ]
    faces, uvs = [], []
    for i in range(rows - 1):
        for k in range(segments):
            n = (k + 1) % segments
            faces.append((i * segments + k, i * segments + n, (i + 1) * segments + n, (i + 1) * segments + k))
            u0, u1, v0, v1 = k / segments, (k + 1) / segments, i / (rows - 1), (i + 1) / (rows - 1)
            uvs += [(u0, v0), (u1, v0), (u1, v1), (u0, v1)]
    thing = add_mesh(name, vertices, faces, material, uvs, smooth=steps > 1)
    thing.location = centre
    return thing


def sphere(
    name: str, radius: float, centre: Point, material: bpy.types.Material, segments: int = 48
) -> bpy.types.Object:
    """Sphere with equirectangular UV."""
    rings = segments // 2
    angles = [pi * k / rings for k in range(rings + 1)]
    profile = [(radius * sin(a), -radius * cos(a)) for a in angles]
    thing = lathe(name, profile, centre, material, segments, steps=1)
    thing.data.shade_smooth()
    return thing


def cylinder(
    name: str,
    radius: float,
    height: float,
    base: Point,
    material: bpy.types.Material,
    segments: int = 40,
) -> bpy.types.Object:
    """Upright cylinder standing on `base`, with slightly broken edges."""
    e = min(0.004, radius * 0.2, height * 0.2)
    profile = [
        (0, 0),
        (radius - e, 0),
        (radius, e),
        (radius, height - e),
        (radius - e, height),
        (0, height),
    ]
    return lathe(name, profile, base, material, segments, steps=1)


def tube(
    name: str,
    points: Sequence[Point],
    radius: float,
    material: bpy.types.Material,
    straight: bool = False,
) -> bpy.types.Object:
    """Round bar along a path."""
    curve = bpy.data.curves.new(name, "CURVE")
    curve.dimensions = "3D"
    curve.bevel_depth = radius
    curve.bevel_resolution = 3
    curve.use_fill_caps = True
    curve.resolution_u = 6
    if straight or len(points) < 3:
        spline = curve.splines.new("POLY")
        spline.points.add(len(points) - 1)
        for target, p in zip(spline.points, points, strict=True):
            target.co = (*p, 1)
    else:
        spline = curve.splines.new("BEZIER")
        spline.bezier_points.add(len(points) - 1)
        for target, p in zip(spline.bezier_points, points, strict=True):
            target.co = p
            target.handle_left_type = target.handle_right_type = "AUTO"
    curve.materials.append(material)
    thing = bpy.data.objects.new(name, curve)
    bpy.context.scene.collection.objects.link(thing)
    return thing


def torus(name: str, major: float, minor: float, centre: Point, material: bpy.types.Material) -> bpy.types.Object:
    """Ring lying flat."""
    n, m = 56, 24
    ring = [(2 * pi * i / n, 2 * pi * j / m) for i in range(n) for j in range(m)]
    vertices = [((major + minor * cos(b)) * cos(a), (major + minor * cos(b)) * sin(a), minor * sin(b)) for a, b in ring]
    faces = [
        (i * m + j, (i + 1) % n * m + j, (i + 1) % n * m + (j + 1) % m, i * m + (j + 1) % m)
        for i in range(n)
        for j in range(m)
    ]
    thing = add_mesh(name, vertices, faces, material, smooth=True)
    thing.location = centre
    return thing


def leaves(
    name: str,
    centre: Point,
    count: int,
    length: tuple[float, float],
    width: float,
    material: bpy.types.Material,
    rng: np.random.Generator,
    upright: float = 0.6,
) -> bpy.types.Object:
    """Bunch of arched leaves growing from one point, all in one mesh."""
    rows = 7
    vertices, faces, uvs = [], [], []
    for k in range(count):
        around = Matrix.Rotation(k * 2.39996, 3, "Z")
        # One draw a row beyond the two in use: changing the count would shift every later draw,
        # and with it the look of the photos already published.
        longer, higher = rng.random(2 + rows)[:2]
        reach = length[0] + (length[1] - length[0]) * longer
        rise = upright * (0.5 + 0.8 * higher)
        base = len(vertices)
        for i in range(rows):
            t = i / (rows - 1)
            half = 0.35 * width * sin(pi * min(t * 0.92 + 0.08, 1)) ** 0.8
            out = reach * t * (1 - 0.25 * rise * t)
            up = reach * (rise * 1.5 * t - 0.95 * t * t)
            for side in (-1, 1):
                vertices.append(Vector(centre) + around @ Vector((out, side * half, up + 0.25 * abs(half))))
        for i in range(rows - 1):
            a = base + 2 * i
            faces.append((a, a + 1, a + 3, a + 2))
            v0, v1 = i / (rows - 1), (i + 1) / (rows - 1)
            uvs += [(0, v0), (1, v0), (1, v1), (0, v1)]
    return add_mesh(name, vertices, faces, material, uvs, smooth=True)


def lay_along_axes(mesh: bpy.types.Mesh, scale: float) -> None:
    """UV along the mesh's own axes, u (the grain) along the longest side of each face's plane."""
    corners = np.empty(len(mesh.vertices) * 3, np.float32)
    mesh.vertices.foreach_get("co", corners)
    corners = corners.reshape(-1, 3)
    extent = np.ptp(corners, axis=0)
    if not mesh.uv_layers:
        mesh.uv_layers.new(name="UVMap")
    uv = mesh.uv_layers[0].data
    for face in mesh.polygons:
        normal = max(range(3), key=lambda k: abs(face.normal[k]))
        a, b = (k for k in range(3) if k != normal)
        if extent[b] > extent[a]:
            a, b = b, a
        for corner in face.loop_indices:
            at = corners[mesh.loops[corner].vertex_index]
            # The shift keeps opposite faces of a board from showing the same stretch of grain.
            shift = 0.37 * normal + float(extent.sum())
            uv[corner].uv = (at[a] * scale + shift, at[b] * scale + shift)


def merge(spare: str) -> bpy.types.Object:
    """Join everything but the object called `spare` into one mesh in world coordinates.

    A single mesh traces a good deal faster than hundreds of small ones whose bounds overlap.
    """
    things = [o for o in bpy.context.scene.objects if o.type in {"MESH", "CURVE"} and o.name != spare]
    return join(things, "studio")


def join(things: Sequence[bpy.types.Object], name: str) -> bpy.types.Object:
    """Replace objects by one mesh in world coordinates."""
    graph = bpy.context.evaluated_depsgraph_get()
    scene = bpy.context.scene
    pieces = []
    for thing in things:
        mesh = bpy.data.meshes.new_from_object(thing.evaluated_get(graph))
        scale = mesh.materials[0].get("box_scale", 0.0)
        if scale:
            lay_along_axes(mesh, scale)
        elif not mesh.uv_layers:
            mesh.uv_layers.new(name="UVMap")
        mesh.uv_layers[0].name = "UVMap"
        mesh.transform(thing.matrix_world)
        pieces.append(bpy.data.objects.new(thing.name, mesh))
        bpy.data.objects.remove(thing)
    bpy.ops.object.select_all(action="DESELECT")
    for piece in pieces:
        scene.collection.objects.link(piece)
        piece.select_set(True)
    whole = pieces[0]
    bpy.context.view_layer.objects.active = whole
    bpy.ops.object.join()
    whole.name = name
    return whole
