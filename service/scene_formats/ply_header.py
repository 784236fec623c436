"""Parse the header of a PLY file, with limits: its counts are compared with the file's size before anything is read."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from service.errors import CorruptScene, UnsupportedFormat

MAX_HEADER_BYTES = 64 * 1024
"""A 3DGS header has 2 KB."""
MAX_PROPERTIES = 512
BLOCK = 16_384
"""Records read at once: 4 MB at SH degree 3, which fit a processor's cache."""
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True, slots=True)
class PlyElement:
    name: str
    count: int
    dtype: np.dtype | None
    """Of one record, with the properties as fields; None if it has a list property."""


@dataclass(frozen=True, slots=True)
class PlyHeader:
    elements: tuple[PlyElement, ...]
    comments: tuple[str, ...]
    data_offset: int

    def element(self, name: str) -> PlyElement | None:
        """Return the element of this name, if there is one."""
        return next((e for e in self.elements if e.name == name), None)


def read_header(path: Path) -> PlyHeader:
    """Parse the header. Raises CorruptScene, or UnsupportedFormat for a text PLY."""
    with path.open("rb") as file:
        head = file.read(MAX_HEADER_BYTES)
    # The data begin after the line's end, whatever stands behind end_header (a "\r").
    end = head.find(b"\nend_header")
    newline = head.find(b"\n", end + 1)
    if not head.startswith(b"ply") or end < 0 or newline < 0:
        raise CorruptScene(f"no 'ply' ... 'end_header' within the first {MAX_HEADER_BYTES} bytes.", where=path.name)
    lines = head[:end].decode("ascii", "replace").splitlines()
    comments = tuple(line[8:].strip() for line in lines if line.startswith("comment "))
    order = _byte_order(lines, path)
    return PlyHeader(_elements(lines, order, path), comments, newline + 1)


def _byte_order(lines: list[str], path: Path) -> str:
    formats = [line.split() for line in lines if line.startswith("format ")]
    if len(formats) != 1 or len(formats[0]) != 3:
        raise CorruptScene("the header needs exactly one 'format' line.", where=path.name)
    kind = formats[0][1]
    if kind == "ascii":  # parsing millions of numbers as text would take minutes
        raise UnsupportedFormat("a text PLY is not read.", where=path.name, hint="Save it as binary.")
    if kind not in _BYTE_ORDERS:
        raise CorruptScene(f"unknown PLY format '{kind[:40]}'.", where=path.name)
    return _BYTE_ORDERS[kind]


def _elements(lines: list[str], order: str, path: Path) -> tuple[PlyElement, ...]:
    found: list[tuple[str, int, list[list[str]]]] = []
    for number, line in enumerate(lines, 1):
        words = line.split()
        if words[:1] == ["element"]:
            # 18 digits fit an int64; int() of a longer text could take long.
            if len(words) != 3 or not words[2].isdecimal() or len(words[2]) > 18:
                raise CorruptScene(f"not 'element NAME COUNT': '{line[:80]}'.", where=f"{path.name}:{number}")
            found.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            if not found or len(words) < 3:
                raise CorruptScene(f"a property out of place: '{line[:80]}'.", where=f"{path.name}:{number}")
            found[-1][2].append(words[1:])
    return tuple(PlyElement(name, count, _dtype(name, p, order, path)) for name, count, p in found)


def _dtype(element: str, properties: list[list[str]], order: str, path: Path) -> np.dtype | None:
    if any(p[0] == "list" for p in properties):  # of meshes; records of no fixed size
        return None
    names = [p[-1] for p in properties]
    unknown = sorted({p[0] for p in properties} - _TYPES.keys())
    if unknown:
        raise CorruptScene(f"element '{element}' has the unknown type '{unknown[0][:40]}'.", where=path.name)
    if len(names) > MAX_PROPERTIES or len(set(names)) < len(names):
        raise CorruptScene(
            f"element '{element}' has {len(names)} properties, {len(set(names))} of them different; "
            f"the limit is {MAX_PROPERTIES}, each once.",
            where=path.name,
        )
    return np.dtype([(p[-1], order + _TYPES[p[0]]) for p in properties])


def element_records(path: Path, header: PlyHeader, name: str) -> np.ndarray:
    """Read an element's records. Raises CorruptScene, before it allocates, if the file has another size."""
    element, offset = _located(path, header, name)
    return np.fromfile(path, element.dtype, element.count, offset=offset)


def element_blocks(path: Path, header: PlyHeader, name: str) -> Iterator[tuple[slice, np.ndarray]]:
    """Yield an element's records in blocks that fit a cache, each with its slice. Raises as `element_records`."""
    element, offset = _located(path, header, name)
    with path.open("rb") as file:
        file.seek(offset)
        for start in range(0, element.count, BLOCK):
            block = np.fromfile(file, element.dtype, min(BLOCK, element.count - start))
            yield slice(start, start + len(block)), block


def _located(path: Path, header: PlyHeader, name: str) -> tuple[PlyElement, int]:
    """Return the element and its first byte. Raises CorruptScene unless the file's size fits the header."""
    # Elements follow one another in the header's order, records without padding.
    offset = header.data_offset
    for element in header.elements:
        if element.dtype is None:
            raise UnsupportedFormat(f"element '{element.name}' has a list property.", where=path.name)
        if element.name == name:
            break
        offset += element.count * element.dtype.itemsize
    else:
        raise CorruptScene(f"the header has no element '{name}'.", where=path.name)
    there = path.stat().st_size - offset
    needed = element.count * element.dtype.itemsize
    if there < needed:
        whole = max(0, there // max(element.dtype.itemsize, 1))
        raise CorruptScene(
            f"truncated: the header has {element.count} of '{name}', the file ends after {whole}.",
            where=f"{path.name}, byte {path.stat().st_size}",
            hint="Copy or export it again.",
        )
    if element is header.elements[-1] and there > needed:
        raise CorruptScene(
            f"{there - needed} bytes follow the {element.count} of '{name}' in the header.",
            where=f"{path.name}, byte {offset + needed}",
        )
    return element, offset
