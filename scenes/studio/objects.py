"""Small things of the studio: books, boxes, vessels, a toy car, a lamp, framed pictures."""

from __future__ import annotations

from math import cos, pi, sin

import bpy
import materials
import numpy as np
import prints
import shapes
import textures
from mathutils import Matrix, Vector

Rng = np.random.Generator
Material = bpy.types.Material
Place = tuple[float, float, float]


def books(
    name: str,
    place: Matrix,
    run: float,
    height: tuple[float, float],
    spines: Material,
    paper: Material,
    rng: Rng,
) -> None:
    """Row of books `run` metres long: local x along the row, spines facing local -y."""
    vertices, faces, uvs, kinds = [], [], [], []
    columns, rows = prints.SPINES
    x = 0.0
    while x < run - 0.05:
        thick = 0.018 + 0.032 * rng.random()
        tall = height[0] + (height[1] - height[0]) * rng.random()
        back = 0.01 + 0.025 * rng.random()
        deep = 0.15 + 0.06 * rng.random()
        lean = 0.03 * rng.normal() if rng.random() < 0.2 else 0.0
        base = len(vertices)
        for z in (0, tall):
            for y in (back, back + deep):
                left = x + lean * z
                vertices += [place @ Vector((left, y, z)), place @ Vector((left + thick, y, z))]
        col, row = rng.integers(columns), rng.integers(rows)
        u0, u1 = (col + 0.02) / columns, (col + 0.98) / columns
        v0, v1 = (row + 0.01) / rows, (row + 0.99) / rows
        for k, face in enumerate(shapes.BOX_FACES):
            faces.append([base + i for i in face])
            uvs += [(u0, v0), (u1, v0), (u1, v1), (u0, v1)]
            kinds.append(1 if k in (0, 1, 3) else 0)  # bottom, top and back show paper
        x += thick + 0.001 + (0.05 if rng.random() < 0.05 else 0)
    row_of_books = shapes.add_mesh(name, vertices, faces, spines, uvs)
    row_of_books.data.materials.append(paper)
    row_of_books.data.polygons.foreach_set("material_index", kinds)


def pile(name: str, place: Place, turn: float, printed: list[Material], paper: Material, rng: Rng) -> None:
    """Lying books, one for each of the printed covers, the first at the bottom."""
    z = place[2]
    for k, cover in enumerate(printed):
        w, d = 0.17 + 0.08 * rng.random(), 0.23 + 0.07 * rng.random()
        t = 0.02 + 0.025 * rng.random()
        angle = turn + 0.35 * rng.normal()
        centre = Vector((place[0], place[1], z + t / 2))
        shapes.box(f"{name}{k}", (w - 0.006, d - 0.01, t - 0.004), centre, paper, angle, 0)
        placed = Matrix.Translation(centre) @ Matrix.Rotation(angle, 4, "Z")
        axes = placed.to_3x3()
        across, along, up = axes.col[0] * w, axes.col[1] * d, axes.col[2] * t
        corner = centre - (across + along + up) / 2
        shapes.quad(f"{name}_lower{k}", corner, across, along, cover)
        shapes.quad(f"{name}_upper{k}", corner + up, across, along, cover)
        shapes.quad(f"{name}_spine{k}", corner, up, along, cover)
        z += t + 0.0015


def covers(count: int, rng: Rng) -> list[Material]:
    """Printed book covers."""
    out = []
    for k in range(count):
        draw = prints.POSTERS[rng.integers(len(prints.POSTERS))]
        image = np.clip(draw(360, 260, rng), 0, 1)
        prints.glyphs(image, (24, 24, 90, 240), 30, np.asarray(textures.INK), rng)
        out.append(materials.picture(f"cover{k}", image, 0.5))
    return out


def card_print(rng: Rng) -> Material:
    """Labelled cardboard shared by all the shelf boxes."""
    card = textures.plaster(300, 300, (0.70, 0.55, 0.38), rng)
    card[90:190, 70:230] = (0.93, 0.91, 0.85)
    prints.glyphs(card, (100, 82, 185, 222), 22, np.asarray(textures.INK), rng)
    card[205:235, 120:180] = (0.25, 0.20, 0.16)
    return materials.picture("card", card, 0.8)


def shelf_box(name: str, place: Place, card: Material, lid: Material) -> None:
    """Labelled box, identical to its neighbours."""
    x, y, z = place
    shapes.box(name, (0.25, 0.25, 0.24), (x, y, z + 0.12), card, bevel=0.003)
    shapes.box(f"{name}_lid", (0.262, 0.262, 0.05), (x, y, z + 0.245), lid, bevel=0.004)


def ornament(kind: int, place: Place, rng: Rng) -> None:
    """Small vessel for a gap in the bookcase, glazed or marbled in turn."""
    if kind % 2:
        tone = textures.PALETTE[(kind * 3 + 1) % 6]
        skin = materials.plain(f"glaze{kind}", tuple(tone), 0.25, coat=1.0)
    else:
        marble = np.clip(prints.poster_marble(200, 400, rng), 0, 1)
        skin = materials.picture(f"pot{kind}", marble, 0.4)
    profile = [(0.045, 0), (0.07, 0.03), (0.085, 0.09), (0.05, 0.16), (0.03, 0.19), (0.045, 0.215)]
    shapes.lathe(f"ornament{kind}", [(0, 0), *profile], place, skin)


def car(place: Place, turn: float) -> None:
    """Toy car in red lacquer."""
    lacquer = materials.plain("lacquer", (0.74, 0.07, 0.06), 0.22, coat=1.0)
    cabin = materials.plain("car_cabin", (0.90, 0.86, 0.74), 0.22, coat=1.0)
    tyre = materials.plain("tyre", (0.07, 0.07, 0.08), 0.7)
    chrome = materials.plain("chrome", (0.82, 0.82, 0.82), 0.25, metallic=1)
    base = Matrix.Translation(place) @ Matrix.Rotation(turn, 4, "Z")
    hull = [
        (-0.17, 0.05),
        (-0.17, 0.085),
        (-0.10, 0.10),
        (0.09, 0.10),
        (0.16, 0.085),
        (0.175, 0.05),
    ]
    top = [(-0.11, 0.095), (-0.075, 0.145), (0.015, 0.148), (0.07, 0.095)]
    prism("car_body", hull, 0.15, lacquer, base)
    prism("car_roof", top, 0.125, cabin, base)
    on_side = Matrix.Rotation(pi / 2, 4, "X")
    for x in (-0.105, 0.105):
        for y in (-0.066, 0.066):
            for radius, deep, material in ((0.036, 0.032, tyre), (0.02, 0.036, chrome)):
                wheel = shapes.cylinder("wheel", radius, deep, (0, 0, 0), material, 28)
                axle = Matrix.Translation((x, y + deep / 2, 0.036))
                wheel.matrix_world = base @ axle @ on_side


def prism(name: str, outline: list, width: float, material: Material, base: Matrix) -> None:
    """Rounded prism of an x-z outline, `width` wide in y."""
    n = len(outline)
    vertices = [(x, side * width / 2, z) for side in (-1, 1) for x, z in outline]
    faces = [list(range(n)), list(range(2 * n - 1, n - 1, -1))]
    faces += [[(i + 1) % n, i, n + i, n + (i + 1) % n] for i in range(n)]
    part = shapes.add_mesh(name, vertices, faces, material, smooth=True)
    part.matrix_world = base
    modifier = part.modifiers.new("Bevel", "BEVEL")
    modifier.width, modifier.segments = 0.014, 4


def brushes(place: Place, rng: Rng) -> None:
    """Jar with paint brushes."""
    x, y, z = place
    glass = np.clip(prints.poster_glass(200, 400, rng), 0, 1)
    jar = materials.picture("brush_jar", glass, 0.3, coat=0.7)
    profile = [(0, 0), (0.055, 0), (0.06, 0.03), (0.056, 0.13), (0.06, 0.14)]
    shapes.lathe("brush_jar", profile, place, jar)
    for k in range(8):
        dx, dy = cos(k * 0.8), sin(k * 0.8)
        stick = materials.plain(f"stick{k}", tuple(textures.PALETTE[k]), 0.4)
        low = (x + 0.02 * dx, y + 0.02 * dy, z + 0.03)
        high = (x + 0.075 * dx, y + 0.075 * dy, z + 0.25 + 0.07 * rng.random())
        shapes.tube(f"stick{k}", [low, high], 0.006, stick)


def lamp(place: Place, steel: Material) -> None:
    """Desk lamp with an enamelled shade."""
    x, y, z = place
    enamel = materials.plain("enamel", (0.16, 0.36, 0.42), 0.28, coat=0.8)
    shapes.cylinder("lamp_foot", 0.09, 0.02, place, enamel)
    arm = [(x, y, z), (x + 0.04, y, z + 0.26), (x - 0.10, y - 0.04, z + 0.46)]
    shapes.tube("lamp_arm", arm, 0.01, steel, True)
    profile = [(0.10, -0.10), (0.085, -0.04), (0.04, 0.03), (0.0, 0.045)]
    shade = shapes.lathe("lamp_shade", profile, (0, 0, 0), enamel)
    hung = Matrix.Translation((x - 0.13, y - 0.06, z + 0.44))
    shade.matrix_world = hung @ Matrix.Rotation(0.5, 4, "Y")


def jars(top: float, rng: Rng) -> None:
    """Paint pots in a row at the back of the bench, labels all different."""
    for k in range(6):
        x, y, tall = 2.12 + 0.105 * k, 3.90, 0.09 + 0.03 * (k % 3)
        label = np.clip(prints.POSTERS[(k + 3) % 8](120, 280, rng), 0, 1)
        skin = materials.picture(f"jar{k}", label, 0.35)
        shapes.cylinder(f"jar{k}", 0.043, tall, (x, y, top), skin, 32)
        lid = materials.plain(f"jar_lid{k}", tuple(textures.PALETTE[k]), 0.4)
        shapes.cylinder(f"jar_lid{k}", 0.045, 0.018, (x, y, top + tall), lid, 32)


def vase(place: Place, rng: Rng) -> None:
    """Blue glazed vase with dry leaves."""
    glaze = materials.plain("vase", (0.10, 0.34, 0.50), 0.2, coat=1.0)
    belly = [(0, 0), (0.07, 0), (0.08, 0.01), (0.13, 0.12), (0.12, 0.21), (0.05, 0.31)]
    neck = [(0.045, 0.36), (0.075, 0.40), (0.068, 0.40), (0.035, 0.35)]
    shapes.lathe("vase", belly + neck, place, glaze, 64)
    dry = materials.picture("dry_leaf", textures.leaf(rng, (0.60, 0.46, 0.22)), 0.6)
    mouth = (place[0], place[1], place[2] + 0.36)
    shapes.leaves("dry_grass", mouth, 13, (0.30, 0.42), 0.05, dry, rng, 1.25)


def teapot(place: Place) -> None:
    """Green glazed teapot."""
    x, y, z = place
    glaze = materials.plain("teapot", (0.12, 0.40, 0.27), 0.2, coat=1.0)
    body = [(0, 0), (0.07, 0), (0.075, 0.008), (0.115, 0.06), (0.11, 0.11), (0.07, 0.15)]
    lid = [(0.06, 0.155), (0.058, 0.162), (0.02, 0.18), (0.012, 0.19), (0.02, 0.205), (0.0, 0.215)]
    shapes.lathe("teapot", body + lid, place, glaze, 64)
    spout = [(0.09, 0.05), (0.15, 0.08), (0.19, 0.15)]
    handle = [(-0.10, 0.12), (-0.17, 0.13), (-0.18, 0.07), (-0.105, 0.045)]
    shapes.tube("spout", [(x + dx, y, z + dz) for dx, dz in spout], 0.017, glaze)
    shapes.tube("teapot_handle", [(x + dx, y, z + dz) for dx, dz in handle], 0.011, glaze)


def cups(top: float, rng: Rng) -> None:
    """Cups of different decor beside the teapot."""
    profile = [(0, 0), (0.03, 0), (0.042, 0.03), (0.046, 0.085), (0.041, 0.085), (0.036, 0.03)]
    for k, (x, y) in enumerate(((2.66, 0.30), (2.80, 0.17), (2.90, 0.34))):
        image = np.clip(prints.POSTERS[(1, 2, 5)[k]](160, 320, rng), 0, 1)
        skin = materials.picture(f"cup{k}", image, 0.3, coat=0.6)
        shapes.lathe(f"cup{k}", [*profile, (0, 0.012)], (x, y, top), skin)


def frame(name: str, origin: Place, right: Place, size: tuple, image: np.ndarray, wood: Material) -> None:
    """Framed picture on a wall: lower left corner, unit vector along the lower edge, (w, h)."""
    r, o = Vector(right), Vector(origin)
    out = r.cross(Vector((0, 0, 1)))
    w, h = size
    skin = materials.picture(name, np.clip(image, 0, 1), 0.6)
    shapes.quad(name, o + out * 0.012, r * w, (0, 0, h), skin)
    wide = 0.028
    # From and to along the lower edge, lower end and height of each of the four laths.
    laths = (
        (-wide, w + wide, -wide, wide),
        (-wide, w + wide, h, wide),
        (-wide, 0, 0, h),
        (w, w + wide, 0, h),
    )
    for k, (a, b, z, tall) in enumerate(laths):
        centre = o + r * ((a + b) / 2) + out * 0.015 + Vector((0, 0, z + tall / 2))
        dims = (b - a, 0.03, tall) if abs(r.x) > 0.5 else (0.03, b - a, tall)
        shapes.box(f"{name}_lath{k}", dims, centre, wood)
