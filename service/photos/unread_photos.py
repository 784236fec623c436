"""Formats of pictures that are not read, recognised by their first bytes so that the error can name them."""

from __future__ import annotations

from collections.abc import Callable

_FORMATS: tuple[tuple[str, Callable[[bytes], bool]], ...] = (
    ("an AVIF", lambda d: d[4:12] in (b"ftypavif", b"ftypavis")),
    ("a JPEG XL", lambda d: d.startswith((b"\xff\x0a", b"\x00\x00\x00\x0cJXL "))),
    ("a GIF", lambda d: d.startswith((b"GIF87a", b"GIF89a"))),
    ("a BMP", lambda d: d.startswith(b"BM")),
    ("a JPEG 2000", lambda d: d.startswith((b"\xff\x4f\xff\x51", b"\x00\x00\x00\x0cjP  "))),
    ("an OpenEXR", lambda d: d.startswith(b"\x76\x2f\x31\x01")),
    ("a PDF", lambda d: d.startswith(b"%PDF-")),
    # Most cameras' raw formats (DNG, NEF, CR2, ARW) are TIFF inside.
    ("a TIFF or raw", lambda d: d.startswith((b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+"))),
)


def unread_format(data: bytes) -> str | None:
    """Return the name, with its article, of the format that a file begins like; None: none of those known here."""
    return next((name for name, begins_like in _FORMATS if begins_like(data)), None)
