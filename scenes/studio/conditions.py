"""What is different in the studio on another day: the lights, the furniture."""

from __future__ import annotations

from collections.abc import Callable

import bpy
import materials
import numpy as np
import prints
import room
import shapes
import textures
from mathutils import Matrix, Vector

Rng = np.random.Generator

THINGS: dict[str, tuple[str, ...]] = {
    "table": ("table_top", "table_leg", "ball", "ball_stand", "bowl", "fruit", "table_book"),
    "rug": ("rug",),
    "chair 0": ("chair0",),
    "chair 1": ("chair1",),
    "chair 2": ("chair2",),
    "pouf": ("pouf",),
    "plinth": ("plinth", "plaster_ring"),
    "easel": ("easel", "canvas"),
    "urn": ("urn",),
    "big plant": ("basket", "big_plant"),
    "seat": ("seat_box",),
    "cushion 0": ("cushion0",),
    "cushion 1": ("cushion1",),
    "cushion 2": ("cushion2",),
    "plant 0": ("pot0", "plant0"),
    "plant 1": ("pot1", "plant1"),
    "plant 2": ("pot2", "plant2"),
    "bench": ("bench_top", "bench_core", "bench_leg", "bench_low", "drawer", "handle"),
    "chest": ("chest",),
    "rolls": ("roll",),
    "cone": ("cone",),
    "plaster ball": ("plaster_ball",),
    "plaster cube": ("plaster_cube",),
    "car": ("car", "wheel"),
    "brushes": ("brush_jar", "stick"),
    "bench books": ("bench_books",),
    "lamp": ("lamp",),
    "jars": ("jar",),
    "sideboard": ("side_body", "side_foot", "side_top", "side_door", "side_knob", "inlay"),
    "vase": ("vase", "dry_grass"),
    "teapot": ("teapot", "spout"),
    "cups": ("cup",),
    "side pile": ("side_pile",),
    "bookcase": ("case", "books", "box", "ornament"),
    "globe": ("globe",),
    "top books": ("top_books",),
}
"""All that stands in the room: how the names of its objects begin. Pictures, flags and the pendant hang."""

MOVES: dict[str, tuple[float, float, float]] = {
    "table": (-0.38, -0.22, 0.5),
    "chair 0": (-0.45, 0.55, 1.3),
    "chair 1": (0.25, -0.75, -0.8),
    "chair 2": (-0.55, -0.12, 2.2),
    "pouf": (1.95, 0.10, 0.9),
    "easel": (-0.45, -0.35, 0.6),
    "urn": (-3.75, -0.05, 0.0),
    "big plant": (0.10, -0.45, 1.0),
    "cone": (1.05, -0.08, 0.0),
    "car": (-0.62, -0.10, 1.4),
    "vase": (0.50, 0.02, 0.8),
    "teapot": (-0.50, -0.02, 2.0),
}
"""A third of them: the displacement along x and y in metres, and the turn about their own middle in radians."""
GONE = "rug"


def objects_of(thing: str) -> list[bpy.types.Object]:
    """Return a thing's objects. Raises KeyError, if it has none or one of them is also another thing's."""
    found = [o for o in bpy.context.scene.objects if o.name.startswith(THINGS[thing])]
    others = [o.name for o in found for name, begins in THINGS.items() if name != thing and o.name.startswith(begins)]
    if not found or others:
        raise KeyError(f"{thing}: {len(found)} objects, also of other things: {others}")
    return found


def other_furniture(rng: Rng) -> None:
    """Move a third of the things, take one away, bring two: an armchair and a stack of crates."""
    bpy.context.view_layer.update()
    for name, (dx, dy, turn) in MOVES.items():
        things = objects_of(name)
        corners = [o.matrix_world @ Vector(c) for o in things for c in o.bound_box]
        middle = sum(corners, Vector()) / len(corners)
        move = Matrix.Translation((middle.x + dx, middle.y + dy, 0)) @ Matrix.Rotation(turn, 4, "Z")
        for thing in things:
            thing.matrix_world = move @ Matrix.Translation((-middle.x, -middle.y, 0)) @ thing.matrix_world
    for thing in objects_of(GONE):
        bpy.data.objects.remove(thing)
    armchair(Matrix.Translation((1.05, 0.85, 0)) @ Matrix.Rotation(-2.4, 4, "Z"), rng)
    crates((4.45, 3.60, 0), rng)


def armchair(place: Matrix, rng: Rng) -> None:
    """Upholstered armchair; its back is on the +y side."""
    cover = materials.picture("armchair", textures.fabric(500, 500, rng), 0.95, box_scale=1.4)
    parts = (
        ((0.62, 0.62, 0.30), (0, 0, 0.25)),
        ((0.78, 0.16, 0.85), (0, 0.36, 0.475)),
        ((0.14, 0.66, 0.56), (-0.36, 0.02, 0.33)),
        ((0.14, 0.66, 0.56), (0.36, 0.02, 0.33)),
    )
    for size, centre in parts:
        part = shapes.box("armchair", size, centre, cover, bevel=0.04)
        part.matrix_world = place @ part.matrix_basis


def crates(place: tuple[float, float, float], rng: Rng) -> None:
    """Three printed crates on top of each other."""
    x, y, z = place
    for k, tall in enumerate((0.42, 0.38, 0.34)):
        printed = np.clip(prints.POSTERS[(2 * k + 3) % 8](420, 520, rng), 0, 1)
        skin = materials.picture(f"crate{k}", printed, 0.7)
        shapes.box(f"crate{k}", (0.60, 0.44, tall), (x, y, z + tall / 2), skin, 0.2 - 0.25 * k, 0.006)
        z += tall


def dim(strengths: dict[str, float], outside: float) -> None:
    """Scale the room's lights, and the brightness of the view outside."""
    for name, factor in strengths.items():
        bpy.data.lights[name].energy *= factor
    for node in bpy.data.materials[room.OUTSIDE].node_tree.nodes:
        if node.type == "EMISSION":
            node.inputs["Strength"].default_value *= outside


def evening(rng: Rng) -> None:
    """Low red sun across the room, little light from the sky."""
    dim({"sun": 1.1, "daylight": 0.22, "fill": 0.10, "bounce": 0.10}, 0.30)
    bpy.data.lights["sun"].color = (1.0, 0.58, 0.28)
    bpy.data.lights["daylight"].color = (1.0, 0.76, 0.62)
    low = Vector((0.93, -0.30, -0.20))
    bpy.context.scene.objects["sun"].rotation_euler = low.to_track_quat("-Z", "Y").to_euler()


def night(rng: Rng) -> None:
    """Nothing but the bulb of the pendant lamp, which shines below its shade."""
    dim({"sun": 0, "daylight": 0, "fill": 0, "bounce": 0}, 0.002)
    bulb = bpy.context.scene.objects["bulb"]
    place = bulb.location.copy()
    bpy.data.objects.remove(bulb)
    light = bpy.data.lights.new("bulb", "POINT")
    light.energy, light.shadow_soft_size, light.color = 60, 0.05, (1.0, 0.72, 0.42)
    lamp = bpy.data.objects.new("bulb", light)
    lamp.location = place
    bpy.context.scene.collection.objects.link(lamp)


def as_it_was(rng: Rng) -> None:
    """Change nothing."""


CHANGES: dict[str, Callable[[Rng], None]] = {
    "same_light": as_it_was,
    "evening": evening,
    "night": night,
    "furniture": other_furniture,
    "people": as_it_was,
    "phone": as_it_was,
}
