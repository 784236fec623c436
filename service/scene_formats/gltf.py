"""Read Gaussians from a binary glTF file with the extension KHR_gaussian_splatting: plain attributes, or SPZ inside.

Values are stored activated: linear scales, opacities 0..1, quaternions xyzw. The axes are glTF's, +y up, and are kept:
writers turn a .ply in different ways. Nodes' transforms are applied.
https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from service.errors import CorruptScene, UnsupportedFormat
from service.geometry import rotation_from_quat
from service.scene_formats.gaussians import RawGaussians, cut_sh, joined, require_count, sh_from_rgb
from service.scene_formats.manifest import MAX_JSON_BYTES, numbers
from service.scene_formats.similarity import moved_gaussians
from service.scene_formats.spz import decoded

SUFFIXES = (".glb",)
_EXTENSION = "KHR_gaussian_splatting"
_SPZ = f"{_EXTENSION}_compression_spz"
_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_MAX_NODES = 10_000


def accepts(head: bytes, suffix: str) -> bool:
    """Whether it is a binary glTF file."""
    return head.startswith(b"glTF")


def read(path: Path) -> RawGaussians:
    """Return the Gaussians of all nodes in the scene's frame. Raises CorruptScene, UnsupportedFormat."""
    file = _File.open(path)
    found = []
    for mesh, world_from_node in file.placed_meshes():
        for primitive in file.entry("meshes", mesh).get("primitives", ()):
            extension = primitive.get("extensions", {}).get(_EXTENSION) if isinstance(primitive, dict) else None
            if isinstance(extension, dict):
                found.append(moved_gaussians(file.gaussians(primitive, extension), world_from_node))
    if not found:
        raise UnsupportedFormat(
            f"a glTF file without Gaussians (no primitive has {_EXTENSION}).", where=path.name,
            hint="Export the scene as .ply or .spz.",
        )  # fmt: skip
    return replace(joined(found), up=(0.0, 1.0, 0.0))


@dataclass(frozen=True, slots=True)
class _File:
    name: str
    tree: dict[str, Any]
    data: np.ndarray

    @classmethod
    def open(cls, path: Path) -> _File:
        """Split the file into its JSON and its binary chunk. Raises CorruptScene."""
        data = np.fromfile(path, np.uint8)
        if len(data) < 20:
            raise CorruptScene("truncated within the header of 20 bytes.", where=path.name)
        _, version, _, length, kind = struct.unpack_from("<4sIII4s", data[:20].tobytes())
        if version != 2 or kind != b"JSON" or length > min(MAX_JSON_BYTES, len(data) - 20):
            raise CorruptScene(f"glTF version {version}, or no JSON chunk of {length} bytes.", where=path.name)
        try:
            tree = json.loads(data[20 : 20 + length].tobytes())
        except (ValueError, RecursionError) as error:
            raise CorruptScene(f"its JSON chunk is damaged: {str(error)[:100]}.", where=path.name) from None
        if not isinstance(tree, dict):
            raise CorruptScene("its JSON chunk must be an object.", where=path.name)
        # The second chunk has a header of 8 bytes, too; its length is checked by each view.
        return cls(path.name, tree, data[20 + length + 8 :])

    def entry(self, kind: str, index: Any) -> dict[str, Any]:
        """Return one of the file's numbered objects. Raises CorruptScene."""
        entries = self.tree.get(kind)
        if isinstance(entries, list) and isinstance(index, int) and 0 <= index < len(entries):
            entry = entries[index]
            if isinstance(entry, dict):
                return entry
        raise CorruptScene(f"it has no {kind}[{str(index)[:20]}].", where=self.name)

    def placed_meshes(self) -> list[tuple[int, Float64[np.ndarray, "4 4"]]]:
        """Return the meshes of the file's scene with their transforms. Raises CorruptScene."""
        roots = self.entry("scenes", self.tree.get("scene", 0)).get("nodes", [])
        waiting = [(index, np.eye(4)) for index in roots] if isinstance(roots, list) else []
        found = []
        for _ in range(_MAX_NODES):  # bounded: a damaged file's nodes may contain each other
            if not waiting:
                return found
            index, parent = waiting.pop()
            node = self.entry("nodes", index)
            matrix = parent @ self._matrix(node, f"{self.name}: nodes[{index}]")
            if "mesh" in node:
                found.append((node["mesh"], matrix))
            children = node.get("children", [])
            waiting += [(child, matrix) for child in children] if isinstance(children, list) else []
        raise CorruptScene(f"more than {_MAX_NODES} nodes.", where=self.name)

    def _matrix(self, node: dict[str, Any], where: str) -> Float64[np.ndarray, "4 4"]:
        if "matrix" in node:  # column by column
            matrix = numbers(node["matrix"], (16,), where).reshape(4, 4).T
        else:
            matrix = np.eye(4)
            x, y, z, w = numbers(node.get("rotation", [0, 0, 0, 1]), (4,), where)
            scale = numbers(node.get("scale", [1, 1, 1]), (3,), where)
            if abs(np.linalg.norm([x, y, z, w]) - 1) > 1e-3:
                raise CorruptScene("its rotation is not a unit quaternion.", where=where)
            # Columns are scaled: glTF applies the scale before the rotation.
            matrix[:3, :3] = rotation_from_quat(np.array([w, x, y, z])) * scale
            matrix[:3, 3] = numbers(node.get("translation", [0, 0, 0]), (3,), where)
        gram = matrix[:3, :3] @ matrix[:3, :3].T
        scale = np.sqrt(np.trace(gram) / 3)
        if (
            not 1e-6 < scale < 1e6
            or np.linalg.det(matrix[:3, :3]) < 0
            or np.ptp(np.linalg.eigvalsh(gram)) > 1e-4 * scale**2
        ):
            raise CorruptScene("its transform mirrors, shears or scales unevenly.", where=where)
        return matrix

    def gaussians(self, primitive: dict[str, Any], extension: dict[str, Any]) -> RawGaussians:
        """Decode a primitive. Raises CorruptScene, UnsupportedFormat."""
        space = extension.get("colorSpace", "srgb_rec709_display")
        if space != "srgb_rec709_display":
            raise UnsupportedFormat(f"colours in {str(space)[:40]!r}; known: srgb_rec709_display.", where=self.name)
        packed = extension.get("extensions", {})
        spz = next((value for name, value in packed.items() if name.startswith(_SPZ)), None)
        if isinstance(spz, dict):
            return decoded(self._view(spz.get("bufferView")).tobytes(), self.name)
        names = primitive.get("attributes")
        if not isinstance(names, dict):
            raise CorruptScene("a primitive without attributes.", where=self.name)
        attribute = {name.removeprefix(f"{_EXTENSION}:"): index for name, index in names.items()}
        sh, warnings = cut_sh(self._sh(attribute))
        return RawGaussians(
            means=self._accessor(attribute, "POSITION", 3),
            quats=self._accessor(attribute, "ROTATION", 4)[:, [3, 0, 1, 2]],
            scales=self._accessor(attribute, "SCALE", 3),
            opacities=self._accessor(attribute, "OPACITY", 1)[:, 0],
            sh=sh,
            warnings=warnings,
        )

    def _sh(self, attribute: dict[str, Any]) -> Float32[np.ndarray, "n k 3"]:
        columns = []
        for degree in range(5):
            names = [f"SH_DEGREE_{degree}_COEF_{k}" for k in range(2 * degree + 1)]
            # Degrees come in order: after a missing one there are no others.
            if names[0] not in attribute:
                break
            columns += [self._accessor(attribute, name, 3) for name in names]
        if not columns:  # the fallback for viewers without the extension
            return sh_from_rgb(self._accessor(attribute, "COLOR_0", 4)[:, :3])
        return np.stack(columns, 1)

    def _view(self, index: Any) -> np.ndarray:
        """Return the bytes of a buffer view. Raises CorruptScene."""
        view = self.entry("bufferViews", index)
        start, length = view.get("byteOffset", 0), view.get("byteLength")
        if not isinstance(start, int) or not isinstance(length, int) or view.get("buffer", 0) != 0:
            raise CorruptScene(f"bufferViews[{index}] has no range in this file.", where=self.name)
        if 0 <= start <= start + length <= len(self.data):
            return self.data[start : start + length]
        raise CorruptScene(f"bufferViews[{index}] reaches beyond the file.", where=self.name)

    def _accessor(self, attribute: dict[str, Any], name: str, width: int) -> Float32[np.ndarray, "n m"]:
        """Return an attribute as floats; integers are shares of their greatest value. Raises CorruptScene."""
        if name not in attribute:
            raise CorruptScene(f"a primitive has no attribute '{name}'.", where=self.name)
        accessor = self.entry("accessors", attribute[name])
        where = f"{self.name}: {name}"
        kind, count = accessor.get("componentType"), accessor.get("count")
        if kind not in _TYPES or _WIDTHS.get(accessor.get("type", "")) != width or not isinstance(count, int):
            raise CorruptScene(f"must be {width} number(s) of a known type each.", where=where)
        require_count(count, where)
        dtype = np.dtype(_TYPES[kind])
        offset, view = accessor.get("byteOffset", 0), self._view(accessor.get("bufferView"))
        stride = self.entry("bufferViews", accessor["bufferView"]).get("byteStride", width * dtype.itemsize)
        needed = (count - 1) * stride + width * dtype.itemsize if isinstance(stride, int) else -1
        if (
            not isinstance(offset, int)
            or not 0 <= offset <= offset + needed <= len(view)
            or stride < dtype.itemsize * width
        ):
            raise CorruptScene("reaches beyond its buffer view.", where=where)
        # Attributes may be interleaved; the range was checked above.
        rows = np.lib.stride_tricks.as_strided(view[offset:], (count, width * dtype.itemsize), (stride, 1))
        values = np.ascontiguousarray(rows).view(dtype).astype(np.float32)
        return values if dtype.kind == "f" else np.maximum(values / np.iinfo(dtype).max, -1).astype(np.float32)
