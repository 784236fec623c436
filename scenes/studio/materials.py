"""Blender materials of the studio scene, all fed by the arrays of textures.py or plain colours."""

from __future__ import annotations

import bpy
import numpy as np


def linear(colour: tuple) -> tuple[float, float, float, float]:
    """sRGB colour to the linear RGBA that shader sockets take."""
    rgb = np.asarray(colour, float)
    rgb = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    return (float(rgb[0]), float(rgb[1]), float(rgb[2]), 1.0)


def principled(name: str) -> tuple[bpy.types.Material, bpy.types.Node, bpy.types.NodeTree]:
    """A new material, its Principled node and its tree."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    tree = material.node_tree
    node = next(n for n in tree.nodes if n.type == "BSDF_PRINCIPLED")
    return material, node, tree


def plain(
    name: str,
    colour: tuple,
    roughness: float = 0.7,
    metallic: float = 0.0,
    coat: float = 0.0,
    emission: float = 0.0,
) -> bpy.types.Material:
    """Material of one colour; `coat` adds a lacquer layer, `emission` a glow of that colour."""
    material, node, _ = principled(name)
    node.inputs["Base Color"].default_value = linear(colour)
    node.inputs["Roughness"].default_value = roughness
    node.inputs["Metallic"].default_value = metallic
    node.inputs["Coat Weight"].default_value = coat
    node.inputs["Coat Roughness"].default_value = 0.12
    if emission:
        node.inputs["Emission Color"].default_value = linear(colour)
        node.inputs["Emission Strength"].default_value = emission
        material.cycles.emission_sampling = "NONE"
    return material


def image_of(name: str, array: np.ndarray) -> bpy.types.Image:
    """Blender image from an array whose row 0 is the top."""
    height, width = array.shape[:2]
    image = bpy.data.images.new(name, width, height, alpha=False)
    pixels = np.ones((height, width, 4), np.float32)
    pixels[..., :3] = array[::-1]
    image.pixels.foreach_set(pixels.ravel())
    image.update()
    image.pack()
    return image


def picture(
    name: str,
    array: np.ndarray,
    roughness: float = 0.7,
    bump: float = 0.0,
    coat: float = 0.0,
    box_scale: float = 0.0,
) -> bpy.types.Material:
    """Material painted with an array.

    The texture follows the UV map, or with `box_scale` (repeats a metre) `shapes.merge` lays it
    along the object's axes. `bump` raises light parts of the texture by so many millimetres.
    """
    material, node, tree = principled(name)
    texture = tree.nodes.new("ShaderNodeTexImage")
    texture.image = image_of(name, array)
    if box_scale:
        material["box_scale"] = box_scale
    tree.links.new(texture.outputs["Color"], node.inputs["Base Color"])
    node.inputs["Roughness"].default_value = roughness
    node.inputs["Coat Weight"].default_value = coat
    node.inputs["Coat Roughness"].default_value = 0.15
    if bump:
        relief = tree.nodes.new("ShaderNodeBump")
        relief.inputs["Distance"].default_value = bump / 1000
        relief.inputs["Strength"].default_value = 1.0
        tree.links.new(texture.outputs["Color"], relief.inputs["Height"])
        tree.links.new(relief.outputs["Normal"], node.inputs["Normal"])
    return material


def glowing_picture(name: str, array: np.ndarray, strength: float) -> bpy.types.Material:
    """Picture that is its own light, for the view outside the window."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    material.cycles.emission_sampling = "NONE"  # the area light in the window does the lighting
    tree = material.node_tree
    tree.nodes.clear()
    texture = tree.nodes.new("ShaderNodeTexImage")
    texture.image = image_of(name, array)
    emission = tree.nodes.new("ShaderNodeEmission")
    emission.inputs["Strength"].default_value = strength
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(texture.outputs["Color"], emission.inputs["Color"])
    tree.links.new(emission.outputs["Emission"], output.inputs["Surface"])
    return material
