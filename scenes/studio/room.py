"""Shell of the studio: floor, walls with a window and a door, beamed ceiling, and the lights."""

from __future__ import annotations

from math import pi

import bpy
import materials
import numpy as np
import prints
import shapes
import textures
from mathutils import Vector

SIZE = (5.0, 4.0, 2.7)  # metres; x runs east, y north, z up
PER_METRE = 330  # texture pixels a metre on walls and floor
WINDOW = (1.05, 2.95, 0.95, 2.25)  # y from, y to, z from, z to, in the west wall
OUTSIDE = "view"  # name of the picture behind the window
DOOR = (4.0, 4.85, 2.05)  # x from, x to, height, in the south wall


def build(rng: np.random.Generator) -> None:
    """Everything that is fixed to the building."""
    floor_and_ceiling(rng)
    walls(rng)
    window(rng)
    door(rng)
    skirting(rng)
    lights()


def floor_and_ceiling(rng: np.random.Generator) -> None:
    """Oak floor boards; boarded ceiling with three beams."""
    lx, ly, lz = SIZE
    w, h = int(lx * PER_METRE), int(ly * PER_METRE)
    oak = [(0.66, 0.47, 0.30), (0.58, 0.40, 0.25), (0.71, 0.53, 0.35), (0.50, 0.34, 0.22)]
    floor = materials.picture("floor", textures.planks(h, w, 30, oak, rng), roughness=0.42, bump=0.8)
    shapes.quad("floor", (0, 0, 0), (lx, 0, 0), (0, ly, 0), floor)
    white = [(0.86, 0.83, 0.76), (0.80, 0.77, 0.70), (0.89, 0.86, 0.80)]
    boards = materials.picture("ceiling", textures.planks(h, w, 22, white, rng, 700), roughness=0.8)
    shapes.quad("ceiling", (0, ly, lz), (lx, 0, 0), (0, -ly, 0), boards)
    for k, x in enumerate((1.1, 2.5, 3.9)):
        grain = textures.wood(300, 1600, (0.46 + 0.03 * k, 0.32, 0.21), rng)
        beam = materials.picture(f"beam{k}", np.rot90(grain), roughness=0.6, box_scale=0.27)
        shapes.box(f"beam{k}", (0.14, ly, 0.17), (x, ly / 2, lz - 0.085), beam, bevel=0.012)
    # A shell outside keeps the sun out everywhere but at the window.
    dark = materials.plain("shell", (0.3, 0.3, 0.3))
    shapes.box("roof", (lx + 0.8, ly + 0.8, 0.1), (lx / 2, ly / 2, lz + 0.06), dark, bevel=0)


def wall_piece(name: str, origin: tuple, right: tuple, image: np.ndarray, part: tuple) -> None:
    """Part (u0, u1, v0, v1 in 0..1) of a wall that spans `right` metres and the room's height."""
    u0, u1, v0, v1 = part
    height, width = image.shape[:2]
    rows = slice(int((1 - v1) * height), int((1 - v0) * height))
    crop = image[rows, int(u0 * width) : int(u1 * width)]
    material = materials.picture(name, crop, roughness=0.85, bump=2.5)
    r, tall = Vector(right), SIZE[2]
    base = Vector(origin) + r * u0 + Vector((0, 0, tall * v0))
    shapes.quad(name, base, r * (u1 - u0), (0, 0, tall * (v1 - v0)), material)


def walls(rng: np.random.Generator) -> None:
    """Three plastered walls of different colours and one of brick."""
    lx, ly, lz = SIZE
    h, wx, wy = int(lz * PER_METRE), int(lx * PER_METRE), int(ly * PER_METRE)
    whole = (0, 1, 0, 1)
    north = textures.plaster(h, wx, (0.80, 0.74, 0.63), rng)
    wall_piece("north", (0, ly, 0), (lx, 0, 0), north, whole)
    south = textures.plaster(h, wx, (0.47, 0.60, 0.57), rng)
    # Two-tone paint with an uneven edge, as in old workshops.
    edge = h * 0.62 + 16 * textures.fbm((1, wx), (1, 40), rng, 4)
    below = (np.arange(h)[:, None] > edge).astype(float)
    south = textures.blend(south, south * (0.62, 0.72, 0.80), below)
    wall_piece("south", (lx, 0, 0), (-lx, 0, 0), south, whole)
    brick = textures.bricks(h, wy, (26, 80), rng)
    wall_piece("east", (lx, ly, 0), (0, -ly, 0), brick, whole)
    west = textures.plaster(h, wy, (0.84, 0.67, 0.49), rng)
    a, b, c, d = (WINDOW[0] / ly, WINDOW[1] / ly, WINDOW[2] / lz, WINDOW[3] / lz)
    parts = {"low": (0, 1, 0, c), "high": (0, 1, d, 1), "left": (0, a, c, d), "right": (b, 1, c, d)}
    for name, part in parts.items():
        wall_piece(f"west_{name}", (0, 0, 0), (0, ly, 0), west, part)


def window(rng: np.random.Generator) -> None:
    """Window recess, frame with glazing bars, sill, and the view outside."""
    y0, y1, z0, z1 = WINDOW
    mid = (y0 + y1) / 2
    reveal = materials.picture("reveal", textures.plaster(200, 400, (0.86, 0.83, 0.77), rng))
    # The blocks beside the window are as thick as the wall: the sun enters by the window only.
    deep, x = 0.32, -0.163
    south, north = (y0 - 0.4) / 2, y1 + 0.75
    shapes.box("reveal_low", (deep, 4.8, z0), (x, 2, z0 / 2), reveal, bevel=0)
    shapes.box("reveal_high", (deep, 4.8, 0.6), (x, 2, z1 + 0.3), reveal, bevel=0)
    shapes.box("reveal_south", (deep, y0 + 0.4, 3), (x, south, 1.4), reveal, bevel=0)
    shapes.box("reveal_north", (deep, 1.5, 3), (x, north, 1.4), reveal, bevel=0)
    paint = materials.picture("frame", textures.painted(300, 600, (0.86, 0.84, 0.78), rng), 0.4)
    for k, y in enumerate(np.linspace(y0 + 0.03, y1 - 0.03, 5)):
        thick = 0.06 if k in (0, 2, 4) else 0.028
        shapes.box(f"bar_v{k}", (0.05, thick, z1 - z0), (-0.2, y, (z0 + z1) / 2), paint)
    for k, z in enumerate((z0 + 0.03, z0 + 0.46, z0 + 0.88, z1 - 0.03)):
        thick = 0.06 if k in (0, 3) else 0.028
        shapes.box(f"bar_h{k}", (0.048, y1 - y0, thick), (-0.2, mid, z), paint)
    oak = textures.wood(300, 900, (0.60, 0.42, 0.27), rng)
    sill = materials.picture("sill", oak, roughness=0.4, box_scale=0.9)
    shapes.box("sill", (0.46, y1 - y0 + 0.16, 0.04), (0.0, mid, z0 - 0.005), sill, bevel=0.008)
    view = materials.glowing_picture("view", prints.sky_view(700, 1200, rng), 1.15)
    # Merging spares this one by its name: the sun must shine through the painted sky.
    outside = shapes.quad(OUTSIDE, (-1.1, y0 - 1.6, z0 - 1.2), (0, 5.1, 0), (0, 0, 3.6), view)
    outside.visible_shadow = False


def door(rng: np.random.Generator) -> None:
    """Panelled door with frame and brass knob."""
    x0, x1, top = DOOR
    mid = (x0 + x1) / 2
    paint = materials.picture("door", textures.painted(500, 700, (0.23, 0.38, 0.36), rng), 0.4, box_scale=0.8)
    frame = materials.picture("door_frame", textures.painted(400, 500, (0.84, 0.78, 0.66), rng), 0.5, box_scale=0.9)
    shapes.box("door", (x1 - x0, 0.05, top), (mid, 0.025, top / 2), paint)
    for z, tall in ((0.42, 0.52), (1.05, 0.44), (1.66, 0.56)):
        for side in (-0.19, 0.19):
            shapes.box("panel", (0.28, 0.02, tall), (mid + side, 0.056, z), paint, bevel=0.012)
    for x in (x0 - 0.04, x1 + 0.04):
        shapes.box("jamb", (0.09, 0.08, top + 0.09), (x, 0.04, (top + 0.09) / 2), frame)
    shapes.box("lintel", (x1 - x0 + 0.17, 0.085, 0.1), (mid, 0.042, top + 0.05), frame)
    brass = materials.plain("brass", (0.80, 0.62, 0.30), 0.28, metallic=1)
    shapes.sphere("knob", 0.032, (x0 + 0.08, 0.11, 1.0), brass, 24)
    shapes.tube("knob_stem", [(x0 + 0.08, 0.05, 1.0), (x0 + 0.08, 0.10, 1.0)], 0.012, brass)


def skirting(rng: np.random.Generator) -> None:
    """Skirting boards along the walls, leaving out the door."""
    lx, ly, _ = SIZE
    paint = materials.picture("skirting", textures.painted(300, 900, (0.72, 0.66, 0.55), rng), 0.5, box_scale=0.7)
    shapes.box("skirt_n", (lx, 0.02, 0.11), (lx / 2, ly - 0.01, 0.055), paint)
    shapes.box("skirt_s", (DOOR[0] - 0.09, 0.02, 0.11), ((DOOR[0] - 0.09) / 2, 0.01, 0.055), paint)
    shapes.box("skirt_w", (0.02, ly, 0.11), (0.01, ly / 2, 0.055), paint)
    shapes.box("skirt_e", (0.02, ly, 0.11), (lx - 0.01, ly / 2, 0.055), paint)


def area_light(name: str, place: tuple, turn: tuple, size: tuple, watts: float, colour: tuple) -> None:
    """Rectangular light that cameras do not see."""
    data = bpy.data.lights.new(name, "AREA")
    data.shape = "RECTANGLE"
    data.size, data.size_y = size
    data.energy = watts
    data.color = colour
    lamp = bpy.data.objects.new(name, data)
    lamp.location = place
    lamp.rotation_euler = turn
    lamp.visible_camera = False
    bpy.context.scene.collection.objects.link(lamp)


def lights() -> None:
    """Daylight from the window with a low sun, and soft fill so that no corner is black."""
    y0, y1, z0, z1 = WINDOW
    mid = ((y0 + y1) / 2, (z0 + z1) / 2)
    pane = (z1 - z0 - 0.1, y1 - y0 - 0.1)
    area_light("daylight", (-0.12, *mid), (0, -pi / 2, 0), pane, 75, (0.93, 0.97, 1.0))
    area_light("fill", (2.5, 2.0, 2.46), (0, 0, 0), (3.6, 2.8), 62, (1.0, 0.90, 0.78))
    area_light("bounce", (2.5, 2.0, 2.30), (pi, 0, 0), (3.0, 2.4), 16, (1.0, 0.93, 0.84))
    sun = bpy.data.lights.new("sun", "SUN")
    sun.energy = 8
    sun.angle = 0.05
    sun.color = (1.0, 0.86, 0.66)
    lamp = bpy.data.objects.new("sun", sun)
    lamp.rotation_euler = Vector((0.80, 0.26, -0.56)).to_track_quat("-Z", "Y").to_euler()
    bpy.context.scene.collection.objects.link(lamp)
