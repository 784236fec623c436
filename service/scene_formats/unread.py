"""Scenes that are not read here, recognised by name: each with what can be done."""

from __future__ import annotations

from service.errors import UnsupportedFormat

CONVERT = "npx @playcanvas/splat-transform"
"""The converter that hints name."""
NO_CONVERTER = "No converter to plain 3DGS is known: train the scene with plain 3DGS."
_NO_SHAPES = "Name the Gaussians' own file: point clouds have no shapes."
UNREAD_SUFFIXES = {
    ".lcc": ("an XGRIDS scene", f"Convert it: {CONVERT} scene.lcc scene.ply"),
    ".lcc2": ("an XGRIDS scene", f"Convert it: {CONVERT} scene.lcc2 scene.ply"),
    "lod-meta.json": ("a streamed SOG scene", f"Take its finest level: {CONVERT} lod-meta.json scene.ply"),
    ".usdz": ("an OpenUSD scene", "No converter is known: export it as .ply from the program that made it."),
    ".gltf": ("a glTF scene in several files", "Save it as one binary file (.glb)."),
}
"""Suffix -> what it is, and a hint: such a file is refused by name, not overlooked."""
_LAYERS = (
    ("2DGS", {"scale_0"}, {"scale_2"}, NO_CONVERTER),
    ("Scaffold-GS or Octree-GS anchors", {"f_offset_0", "f_anchor_feat_0"}, set(), NO_CONVERTER),
    ("4D Gaussians", {"motion_0"}, set(), NO_CONVERTER),
    ("4D Gaussians", {"t", "scale_t"}, set(), NO_CONVERTER),
    ("a point cloud or mesh", {"x", "y", "z", "red"}, {"opacity"}, _NO_SHAPES),
    ("a point cloud or mesh", {"x", "y", "z"}, {"opacity", "scale_0"}, _NO_SHAPES),
)
"""Name, properties that it has, properties that it lacks, hint."""


def refuse_suffix(suffix: str, where: str) -> None:
    """Raise UnsupportedFormat if files of this suffix are known and not read."""
    if suffix in UNREAD_SUFFIXES:
        what, hint = UNREAD_SUFFIXES[suffix]
        raise UnsupportedFormat(f"{what} is not supported.", where=where, hint=hint)


def refuse_properties(names: tuple[str, ...], where: str) -> None:
    """Raise UnsupportedFormat if a .ply has the properties of a known kind of scene that is not 3DGS."""
    for what, present, absent, hint in _LAYERS:
        if present <= set(names) and not absent & set(names):
            raise UnsupportedFormat(f"not a 3DGS scene: {what}.", where=where, hint=hint)
