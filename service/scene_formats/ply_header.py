"""Parse the header of a PLY file, with limits: its counts are compared with the file's size before anything is read."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from io import BufferedReader
from itertools import islice
from pathlib import Path

import numpy as np

from service.errors import CorruptScene, UnsupportedFormat

MAX_HEADER_BYTES = 256 * 1024
"""A 3DGS header has 2 KB."""
MAX_PROPERTIES = 4096
"""Feature fields add hundreds of properties to each Gaussian."""
MAX_LIST = 65_536
"""Entries of a list property; a face has three or four."""
BLOCK = 16_384
"""Records read at once: 4 MB at SH degree 3, which fit a processor's cache."""
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}


@dataclass(frozen=True, slots=True)
class PlyElement:
    """One element of a header: so many records with the same properties."""

    name: str
    count: int
    dtype: np.dtype | None
    """Of one record, with the properties as fields; None if it has a list property."""
    lists: tuple[tuple[str, str], ...] = ()
    """Of an element with a list property: for each property the type of its length ("" of a plain one) and values."""


@dataclass(frozen=True, slots=True)
class PlyHeader:
    """A file's header, and where its records begin."""

    elements: tuple[PlyElement, ...]
    comments: tuple[str, ...]
    data_offset: int
    text: bool = False
    """Numbers are written as text, a record a line."""

    def element(self, name: str) -> PlyElement | None:
        """Return the element of this name, if there is one."""
        return next((e for e in self.elements if e.name == name), None)

    def has_doubles(self, element: str, properties: Sequence[str]) -> bool:
        """Whether one of an element's properties has 8 bytes."""
        found = self.element(element)
        return found is not None and found.dtype is not None and any(found.dtype[p].itemsize == 8 for p in properties)


def read_header(path: Path) -> PlyHeader:
    """Parse the header. Raises CorruptScene."""
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
    return PlyHeader(_elements(lines, order, path), comments, newline + 1, text=order == "=")


def _byte_order(lines: list[str], path: Path) -> str:
    formats = [line.split() for line in lines if line.startswith("format ")]
    if len(formats) != 1 or len(formats[0]) != 3:
        raise CorruptScene("the header needs exactly one 'format' line.", where=path.name)
    kind = formats[0][1]
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
    return tuple(PlyElement(name, count, _dtype(name, p, order, path), _lists(p, order)) for name, count, p in found)


def _lists(properties: list[list[str]], order: str) -> tuple[tuple[str, str], ...]:
    """Return the types of an element's properties if one is a list, as `PlyElement.lists`; () where one is unknown."""
    kinds = [p[1:3] if p[0] == "list" else ["", p[0]] for p in properties]
    if not any(p[0] == "list" for p in properties) or any(set(k) - {"", *_TYPES} or len(k) < 2 for k in kinds):
        return ()
    return tuple((order + _TYPES[k[0]] if k[0] else "", order + _TYPES[k[1]]) for k in kinds)


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
    """Read an element's records. Raises CorruptScene, before it allocates, if the file is too short."""
    return np.concatenate([block for _, block in element_blocks(path, header, name)])


def element_blocks(path: Path, header: PlyHeader, name: str) -> Iterator[tuple[slice, np.ndarray]]:
    """Yield an element's records in blocks that fit a cache, each with its slice. Raises as `element_records`.

    What follows the last element is passed over: other readers do, and some programs write a newline there.
    """
    with path.open("rb") as file:
        element = _seek(file, path, header, name)
        dtype = element.dtype
        assert dtype is not None
        for start in range(0, element.count, BLOCK):
            rows = min(BLOCK, element.count - start)
            block = _text_block(file, dtype, rows, path, start) if header.text else np.fromfile(file, dtype, rows)
            yield slice(start, start + rows), block


def _text_block(file: BufferedReader, dtype: np.dtype, rows: int, path: Path, start: int) -> np.ndarray:
    lines = list(islice(file, rows))
    try:
        values = np.array([line.split() for line in lines], np.float64)
    except ValueError:  # a word that is no number, or lines of different lengths
        values = np.empty((0, 0))
    if values.shape != (rows, len(dtype.names or ())):
        raise CorruptScene(
            f"needs {len(dtype.names or ())} numbers on each of {rows} lines.",
            where=f"{path.name}, records {start} to {start + rows}",
        )
    block = np.empty(rows, dtype)
    with np.errstate(over="ignore", invalid="ignore"):
        for column, field in enumerate(dtype.names or ()):
            block[field] = values[:, column]
    return block


def _seek(file: BufferedReader, path: Path, header: PlyHeader, name: str) -> PlyElement:
    """Move to an element's first record and return it. Raises CorruptScene unless the file can hold the header's."""
    file.seek(header.data_offset)
    for element in header.elements:
        if element.name == name:
            break
        _skip(file, element, header.text, path)
    else:
        raise CorruptScene(f"the header has no element '{name}'.", where=path.name)
    if element.dtype is None:
        raise UnsupportedFormat(f"element '{element.name}' has a list property.", where=path.name)
    there = path.stat().st_size - file.tell()
    # Text takes at least a digit and a blank a number.
    size = 2 * len(element.dtype.names or ()) if header.text else element.dtype.itemsize
    if there < element.count * size - header.text:
        whole = max(0, there // max(size, 1))
        raise CorruptScene(
            f"truncated: the header has {element.count} of '{name}', the file ends after {whole}.",
            where=f"{path.name}, byte {path.stat().st_size}",
            hint="Copy or export it again.",
        )
    return element


def _skip(file: BufferedReader, element: PlyElement, text: bool, path: Path) -> None:
    """Pass over an element's records; those with lists (faces) have to be walked through."""
    if element.dtype is not None and not text:
        size = element.count * element.dtype.itemsize
        # Compared, not tried: a file may be positioned behind its end, though not at any number.
        if size > path.stat().st_size - file.tell():
            raise CorruptScene(f"truncated within '{element.name}'.", where=path.name)
        file.seek(size, 1)
        return
    if element.count and not element.lists and element.dtype is None:
        raise UnsupportedFormat(f"element '{element.name}' has a list of unknown type.", where=path.name)
    types = [(np.dtype(length) if length else None, np.dtype(value).itemsize) for length, value in element.lists]
    for number in range(element.count):
        if text:
            whole = bool(file.readline())
        else:
            whole = all(_skip_property(file, length, size) for length, size in types)
        if not whole:
            raise CorruptScene(f"truncated within '{element.name}'.", where=f"{path.name}, record {number}")


def _skip_property(file: BufferedReader, length: np.dtype | None, size: int) -> bool:
    """Pass over one property; False at the file's end."""
    if length is None:
        return len(file.read(size)) == size
    head = file.read(length.itemsize)
    if len(head) < length.itemsize:
        return False
    values = int(np.frombuffer(head, length)[0])
    if not 0 <= values <= MAX_LIST:
        return False
    return len(file.read(values * size)) == values * size
