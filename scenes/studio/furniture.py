"""Furniture and objects of the studio: glossy, textureless, repeated and richly textured ones."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, pi, sin

import bpy
import decor
import materials
import numpy as np
import objects
import prints
import shapes
import textures
from mathutils import Matrix, Vector

Rng = np.random.Generator
Material = bpy.types.Material
Place = tuple[float, float, float]


@dataclass(frozen=True)
class Stock:
    """Materials that several pieces share, and the one source of randomness."""

    oak: Material
    walnut: Material
    steel: Material
    gypsum: Material
    spines: Material
    paper: Material
    rng: Rng


def build(rng: Rng) -> None:
    """Furnish the room."""
    stock = Stock(
        oak=varnished("oak", (0.62, 0.44, 0.28), 0.45, rng),
        walnut=varnished("walnut", (0.42, 0.28, 0.19), 0.4, rng),
        steel=materials.plain("steel", (0.20, 0.20, 0.22), 0.4, metallic=0.8),
        gypsum=materials.plain("gypsum", (0.88, 0.86, 0.82), 0.9),
        spines=materials.picture("spines", prints.spine_atlas(rng), 0.55),
        paper=materials.picture("paper", textures.plaster(100, 100, (0.90, 0.86, 0.76), rng), 0.9),
        rng=rng,
    )
    rug_and_table(stock)
    chairs(stock)
    bookcase(stock)
    workbench(stock)
    sideboard(stock)
    window_seat(stock)
    corner_plant(rng)
    plinth_and_pouf(stock)
    easel(stock)
    decor.pictures(stock.walnut, rng)
    decor.pendant(stock.steel)
    decor.flags(stock.steel, rng)


def varnished(name: str, tone: tuple, roughness: float, rng: Rng) -> Material:
    """Furniture wood, laid along each board."""
    return materials.picture(name, textures.wood(400, 1200, tone, rng), roughness, box_scale=0.9)


def rug_and_table(stock: Stock) -> None:
    """Rug in the middle, round table with a metal ball, a bowl of fruit and books."""
    rng = stock.rng
    weave = materials.picture("rug", textures.rug(760, 1060, rng), 0.95)
    shapes.box("rug", (2.7, 1.9, 0.012), (2.55, 1.85, 0.006), weave, 0.06, 0)
    x, y, top = 2.62, 1.86, 0.74
    boards = textures.planks(420, 420, 6, [(0.60, 0.41, 0.26), (0.68, 0.49, 0.31)], rng, 900)
    round_top = materials.picture("table_top", boards, 0.35, box_scale=0.97)
    shapes.cylinder("table_top", 0.46, 0.03, (x, y, top - 0.03), round_top, 72)
    leg = [(0.24, 0), (0.22, 0.02), (0.06, 0.06), (0.035, 0.3), (0.05, 0.6), (0.16, 0.71)]
    shapes.lathe("table_leg", leg, (x, y, 0.013), stock.steel)
    # Rough enough that a splat model can hold its reflections.
    ball = materials.plain("ball", (0.86, 0.84, 0.80), 0.16, metallic=1)
    shapes.sphere("ball", 0.095, (x - 0.20, y + 0.10, top + 0.107), ball, 64)
    ring = materials.plain("ring", (0.25, 0.16, 0.10), 0.5)
    shapes.torus("ball_stand", 0.05, 0.014, (x - 0.20, y + 0.10, top + 0.014), ring)
    fruit_bowl((x + 0.16, y - 0.17, top), rng)
    printed = objects.covers(2, rng)
    pages = materials.plain("pages", (0.90, 0.86, 0.76), 0.9)
    objects.pile("table_book", (x + 0.19, y + 0.20, top), 0.7, printed, pages, rng)


def fruit_bowl(place: Place, rng: Rng) -> None:
    """Printed bowl with four fruits."""
    x, y, z = place
    circles = np.clip(prints.poster_circles(300, 600, rng), 0, 1)
    glazed = materials.picture("bowl", circles, 0.3, coat=0.6)
    outer = [(0.0, 0.0), (0.05, 0.0), (0.06, 0.012), (0.12, 0.05), (0.15, 0.095)]
    inner = [(0.144, 0.096), (0.11, 0.055), (0.04, 0.022), (0.0, 0.02)]
    shapes.lathe("bowl", outer + inner, place, glazed)
    tones = [(0.85, 0.42, 0.12), (0.72, 0.17, 0.12), (0.86, 0.68, 0.20), (0.50, 0.58, 0.20)]
    for k, tone in enumerate(tones):
        skin = materials.picture(f"fruit{k}", textures.plaster(160, 320, tone, rng), 0.4)
        spot = (x + 0.052 * cos(k * 1.6), y + 0.052 * sin(k * 1.6), z + 0.085 + 0.006 * k)
        shapes.sphere(f"fruit{k}", 0.042, spot, skin, 32)


def chairs(stock: Stock) -> None:
    """Three identical chairs with identical printed seats."""
    seat = materials.picture("seat", textures.fabric(360, 360, stock.rng), 0.9)
    for k, (x, y, turn) in enumerate(
        ((1.78, 1.72, pi / 2 + 0.25), (3.45, 2.05, -pi / 2 + 0.15), (2.75, 1.02, pi - 0.2))
    ):
        place = Matrix.Translation((x, y, 0)) @ Matrix.Rotation(turn, 4, "Z")
        for part in chair_parts(f"chair{k}", stock.walnut, seat):
            part.matrix_world = place @ part.matrix_basis


def chair_parts(name: str, walnut: Material, seat: Material) -> list[bpy.types.Object]:
    """One chair at the origin; its back is on the +y side."""
    parts = [
        shapes.box(f"{name}_seat", (0.42, 0.40, 0.03), (0, 0, 0.44), walnut, bevel=0.01),
        shapes.box(f"{name}_pad", (0.38, 0.36, 0.03), (0, -0.01, 0.468), seat, bevel=0.009),
    ]
    for sx in (-0.18, 0.18):
        parts.append(shapes.box(f"{name}_leg", (0.035, 0.035, 0.44), (sx, -0.17, 0.22), walnut))
        parts.append(shapes.box(f"{name}_post", (0.035, 0.035, 0.88), (sx, 0.18, 0.44), walnut))
    for z, tall in ((0.62, 0.05), (0.72, 0.05), (0.83, 0.09)):
        parts.append(shapes.box(f"{name}_rail", (0.36, 0.022, tall), (0, 0.18, z), walnut))
    parts.append(shapes.box(f"{name}_bar", (0.36, 0.02, 0.03), (0, -0.17, 0.2), walnut))
    return parts


def bookcase(stock: Stock) -> None:
    """Tall bookcase on the brick wall: books, six identical boxes, a globe on top."""
    x0, x1, y0, y1 = 4.66, 4.99, 1.0, 2.8
    mid, deep, rng = (y0 + y1) / 2, x1 - x0, stock.rng
    dark = textures.painted(500, 500, (0.30, 0.24, 0.20), rng)
    back = materials.picture("case_back", dark, box_scale=0.7)
    shapes.box("case_back", (0.01, y1 - y0, 2.0), (x1 - 0.01, mid, 1.02), back, bevel=0)
    for y in (y0, mid, y1):
        shapes.box("case_side", (deep, 0.028, 2.02), ((x0 + x1) / 2, y, 1.01), stock.walnut)
    levels = (0.06, 0.46, 0.85, 1.24, 1.63, 2.02)
    for z in levels:
        size = (deep, y1 - y0 + 0.04, 0.026)
        shapes.box("case_shelf", size, ((x0 + x1) / 2, mid, z), stock.walnut)
    card = objects.card_print(rng)
    for row, z in enumerate(levels[:-1]):
        for bay, end in enumerate((mid - 0.02, y1 - 0.02)):
            fill_bay((row, bay), (x0, end, z + 0.013), (y1 - y0) / 2 - 0.04, card, stock)
    earth = materials.picture("globe", prints.globe(rng), 0.35, coat=0.4)
    brass = materials.plain("globe_brass", (0.78, 0.60, 0.28), 0.3, metallic=1)
    shapes.sphere("globe", 0.17, (4.80, 1.42, 2.29), earth, 64)
    foot = [(0.11, 0), (0.1, 0.015), (0.02, 0.03), (0.018, 0.1)]
    shapes.lathe("globe_foot", foot, (4.80, 1.42, 2.033), brass)
    objects.pile("top_books", (4.82, 2.35, 2.033), 0.2, objects.covers(4, rng), stock.paper, rng)


def fill_bay(bay: tuple[int, int], place: Place, wide: float, card: Material, stock: Stock) -> None:
    """Boxes, or books with sometimes an ornament, from the northern end of a shelf southwards."""
    x, y, z = place
    if bay in ((0, 0), (2, 1)):
        for k in range(3):
            spot = (x + 0.16, y - 0.15 - 0.27 * k, z)
            objects.shelf_box(f"box{bay[0]}{k}", spot, card, stock.paper)
        return
    # Turned so that the spines (local -y) face the room (-x).
    turned = Matrix.Translation((x + 0.01, y, z)) @ Matrix.Rotation(-pi / 2, 4, "Z")
    full = sum(bay) % 3 != 0
    run = wide if full else wide * 0.62
    name = f"books{bay[0]}{bay[1]}"
    objects.books(name, turned, run, (0.20, 0.33), stock.spines, stock.paper, stock.rng)
    if not full:
        objects.ornament(bay[0], (x + 0.15, y - run - 0.13, z), stock.rng)


def workbench(stock: Stock) -> None:
    """Bench on the north wall: plaster shapes, a lacquered car, pots of brushes, a lamp, books."""
    x0, x1, y0, top = 1.35, 3.65, 3.36, 0.86
    mid, rng, oak = (x0 + x1) / 2, stock.rng, stock.oak
    boards = textures.planks(330, 1150, 4, [(0.66, 0.49, 0.32), (0.58, 0.41, 0.27)], rng, 1400)
    slab = materials.picture("bench_top", boards, 0.5)
    shapes.box("bench_core", (x1 - x0, 0.63, 0.048), (mid, 3.68, top - 0.026), oak)
    shapes.quad("bench_top", (x0, y0, top), (x1 - x0, 0, 0), (0, 0.635, 0), slab)
    for x in (x0 + 0.06, x1 - 0.06):
        for y in (y0 + 0.06, 3.93):
            shapes.box("bench_leg", (0.07, 0.07, top - 0.05), (x, y, (top - 0.05) / 2), oak)
    shapes.box("bench_low", (x1 - x0 - 0.1, 0.55, 0.03), (mid, 3.68, 0.2), oak)
    under_the_bench(rng)
    red = textures.painted(400, 500, (0.70, 0.33, 0.24), rng)
    drawers = materials.picture("drawers", red, 0.45, box_scale=1.1)
    x = x1 - 0.36
    shapes.box("drawers", (0.46, 0.52, 0.56), (x, 3.68, 0.51), drawers)
    for z in (0.33, 0.51, 0.69):
        shapes.box("drawer", (0.41, 0.02, 0.155), (x, y0 + 0.055, z), drawers, bevel=0.006)
        ends = [(x - 0.07, y0 + 0.03, z), (x + 0.07, y0 + 0.03, z)]
        shapes.tube("handle", ends, 0.008, stock.steel)
    cone = [(0, 0), (0.11, 0), (0.11, 0.005), (0.0, 0.30)]
    shapes.lathe("cone", cone, (1.62, 3.62, top), stock.gypsum, steps=1)
    shapes.sphere("plaster_ball", 0.10, (1.86, 3.76, top + 0.10), stock.gypsum)
    shapes.box("plaster_cube", (0.17,) * 3, (2.06, 3.58, top + 0.085), stock.gypsum, 0.5)
    objects.car((2.42, 3.60, top), 0.35)
    objects.brushes((2.78, 3.74, top), rng)
    objects.pile("bench_books", (3.02, 3.60, top), 0.3, objects.covers(5, rng), stock.paper, rng)
    objects.lamp((3.42, 3.78, top), stock.steel)
    objects.jars(top, rng)


def under_the_bench(rng: Rng) -> None:
    """Below the bench: a painted chest and rolls of printed paper."""
    blocks = np.clip(prints.poster_blocks(500, 700, rng), 0, 1)
    chest = materials.picture("chest", blocks, 0.6)
    shapes.box("chest", (0.62, 0.42, 0.36), (1.86, 3.66, 0.395), chest)
    lying = Matrix.Rotation(-pi / 2, 4, "X")
    for k in range(7):
        image = np.clip(prints.POSTERS[k](300, 200, rng), 0, 1)
        skin = materials.picture(f"roll{k}", image, 0.7)
        roll = shapes.cylinder(f"roll{k}", 0.038, 0.5, (0, 0, 0), skin, 24)
        row, column = divmod(k, 4)
        spot = (2.34 + 0.085 * column + 0.04 * row, 3.42, 0.256 + 0.068 * row)
        roll.matrix_world = Matrix.Translation(spot) @ lying


def sideboard(stock: Stock) -> None:
    """Sideboard on the south wall: tiles behind, glazed vase, teapot, cups, a pile of books."""
    x0, x1, deep, top = 1.55, 3.45, 0.44, 0.84
    mid, wide, half, rng = (x0 + x1) / 2, x1 - x0, deep / 2, stock.rng
    yellow = textures.painted(500, 700, (0.85, 0.68, 0.36), rng)
    paint = materials.picture("side_paint", yellow, 0.45, box_scale=0.8)
    shapes.box("side_body", (wide, deep, 0.70), (mid, half, 0.45), paint)
    shapes.box("side_foot", (wide - 0.1, deep - 0.08, 0.10), (mid, half, 0.05), stock.steel)
    size = (wide + 0.06, deep + 0.03, 0.036)
    shapes.box("side_top", size, (mid, half + 0.015, top - 0.018), stock.oak)
    for k, draw in enumerate(prints.POSTERS[n] for n in (2, 7, 6, 3)):
        x = x0 + 0.24 + 0.473 * k
        shapes.box("side_door", (0.43, 0.02, 0.60), (x, deep + 0.008, 0.46), paint, bevel=0.006)
        skin = materials.picture(f"inlay{k}", np.clip(draw(480, 320, rng), 0, 1), 0.4)
        corner = (x + 0.16, deep + 0.0195, 0.22)
        shapes.quad(f"inlay{k}", corner, (-0.32, 0, 0), (0, 0, 0.48), skin)
        shapes.sphere("side_knob", 0.016, (x + 0.19, deep + 0.032, 0.5), stock.steel, 20)
    glaze = materials.picture("tiles", textures.tiles(300, 1200, 75, rng), 0.25, coat=0.3)
    shapes.quad("tiles", (x1 + 0.03, 0.006, top), (-wide - 0.06, 0, 0), (0, 0, 0.49), glaze)
    objects.vase((1.86, 0.24, top), rng)
    objects.teapot((2.36, 0.26, top))
    objects.cups(top, rng)
    objects.pile("side_pile", (3.22, 0.25, top), 0.1, objects.covers(6, rng), stock.paper, rng)


def window_seat(stock: Stock) -> None:
    """Bench with cushions under the window, plants on the sill."""
    rng = stock.rng
    blue = textures.painted(500, 700, (0.33, 0.45, 0.55), rng)
    seat = materials.picture("bench_seat", blue, 0.5, box_scale=0.8)
    shapes.box("seat_box", (0.42, 1.7, 0.36), (0.24, 1.95, 0.18), seat)
    for k, y in enumerate((1.35, 1.97, 2.55)):
        skin = materials.picture(f"cushion{k}", textures.fabric(300, 300, rng), 0.9)
        cushion = shapes.box(f"cushion{k}", (0.40, 0.54, 0.10), (0.24, y, 0.412), skin, bevel=0.03)
        cushion.modifiers["Bevel"].segments = 4
    tones = ((0.70, 0.36, 0.24), (0.85, 0.80, 0.70), (0.26, 0.42, 0.50))
    profile = [(0, 0), (0.06, 0), (0.085, 0.12), (0.095, 0.125), (0.095, 0.15), (0.08, 0.15)]
    profile += [(0.075, 0.13), (0, 0.13)]
    foliage = materials.picture("leaf", textures.leaf(rng), 0.5)
    for k, (x, y, size) in enumerate(((0.06, 1.28, 0.8), (0.04, 2.72, 0.9), (0.08, 2.25, 0.62))):
        clay = materials.picture(f"clay{k}", textures.plaster(160, 320, tones[k], rng), 0.7)
        scaled = [(r * size, z * size) for r, z in profile]
        shapes.lathe(f"pot{k}", scaled, (x, y, 0.965), clay, steps=2)
        soil, width = (x, y, 0.965 + 0.13 * size), 0.05 - 0.01 * k
        shapes.leaves(f"plant{k}", soil, 22 + 5 * k, (0.13, 0.24), width, foliage, rng, 1.0)


def corner_plant(rng: Rng) -> None:
    """Big plant in a patterned pot, in the north-west corner."""
    big = materials.picture("leaf_big", textures.leaf(rng, (0.15, 0.36, 0.20)), 0.45)
    basket = materials.picture("basket", textures.tiles(200, 600, 33, rng), 0.8)
    profile = [(0, 0), (0.16, 0), (0.20, 0.16), (0.19, 0.34), (0.17, 0.34), (0.16, 0.30), (0, 0.30)]
    shapes.lathe("basket", profile, (0.46, 3.55, 0), basket, steps=3)
    shapes.leaves("big_plant", (0.46, 3.55, 0.32), 34, (0.55, 0.85), 0.12, big, rng, 1.45)


def plinth_and_pouf(stock: Stock) -> None:
    """Plaster ring standing on a plinth in the south-west corner, and a pouf before it."""
    rng = stock.rng
    stone = textures.plaster(400, 500, (0.72, 0.66, 0.60), rng)
    shapes.box("plinth", (0.36, 0.36, 0.80), (0.55, 0.50, 0.40), materials.picture("plinth", stone, 0.8))
    ring = shapes.torus("plaster_ring", 0.15, 0.055, (0, 0, 0), stock.gypsum)
    upright = Matrix.Rotation(0.7, 4, "Z") @ Matrix.Rotation(pi / 2, 4, "X")
    ring.matrix_world = Matrix.Translation((0.55, 0.50, 1.003)) @ upright
    cover = materials.picture("pouf", textures.rug(500, 1400, rng), 0.95)
    profile = [(0, 0), (0.22, 0), (0.29, 0.08), (0.31, 0.19), (0.27, 0.32), (0.15, 0.38)]
    shapes.lathe("pouf", [*profile, (0, 0.385)], (1.05, 0.95, 0), cover)


def easel(stock: Stock) -> None:
    """Easel with a canvas in the north-east corner, and a big metal vase beside it."""
    base = Matrix.Translation((4.28, 3.36, 0)) @ Matrix.Rotation(-0.75, 4, "Z")

    def at(x: float, y: float, z: float) -> Vector:
        return base @ Vector((x, y, z))

    oak, rng = stock.oak, stock.rng
    shapes.tube("easel_l", [at(-0.33, -0.12, 0), at(-0.06, 0.10, 1.75)], 0.018, oak)
    shapes.tube("easel_r", [at(0.33, -0.12, 0), at(0.06, 0.10, 1.75)], 0.018, oak)
    shapes.tube("easel_b", [at(0, 0.48, 0), at(0, 0.10, 1.70)], 0.018, oak)
    shapes.tube("easel_t", [at(-0.36, -0.06, 0.72), at(0.36, -0.06, 0.72)], 0.022, oak)
    marble, foliage = prints.poster_marble(700, 560, rng), prints.poster_leaves(700, 560, rng)
    where = textures.step(textures.fbm((700, 560), (200, 200), rng), 0.5, 0.1)
    painting = np.clip(textures.blend(marble, foliage, where), 0, 1)
    up = (at(0, 0.095, 1.0) - at(0, 0, 0.30)).normalized() * 0.86
    right = (at(1, 0, 0) - at(0, 0, 0)) * 0.68
    corner = at(-0.34, -0.075, 0.745)
    shapes.quad("canvas", corner, right, up, materials.picture("canvas", painting, 0.5))
    linen = materials.plain("linen", (0.80, 0.74, 0.62), 0.9)
    normal = right.cross(up).normalized()
    shapes.quad("canvas_back", corner - normal * 0.02 + right, -right, up, linen)
    copper = materials.plain("copper", (0.80, 0.46, 0.30), 0.24, metallic=1)
    urn = [(0, 0), (0.09, 0), (0.10, 0.02), (0.16, 0.18), (0.17, 0.30), (0.11, 0.44), (0.06, 0.50)]
    lip = [(0.07, 0.56), (0.10, 0.59), (0.09, 0.59), (0.05, 0.53)]
    shapes.lathe("urn", urn + lip, (4.70, 3.14, 0), copper, 64)
