"""The segments of a JPEG, read without decoding it: how many scans it has, and whether its end is there.

Each scan is a pass over all pixels, so a small file of many scans takes long to decode.
"""

from __future__ import annotations

import re
from collections.abc import Callable

END = b"\xff\xd9"
"""The marker behind the last scan."""
_MARKER = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]")
"""Excludes a stuffed byte, and a restart within a scan."""
_SCAN, _END = 0xDA, 0xD9
_ANY_PIXELS = bytes(range(1, 128))


def scans_and_end(data: bytes) -> tuple[int, bool]:
    """Return the number of scans of a JPEG's first image, and whether its end marker follows them."""
    at, scans = 2, 0  # behind the start-of-image marker
    while found := _MARKER.search(data, at):
        kind, at = found[0][-1], found.end()
        # What follows is no part of the photo: phones append videos.
        if kind == _END:
            return scans, True
        scans += kind == _SCAN
        at += int.from_bytes(data[at : at + 2])  # the segment's length
    return scans, False


def lacks_only_its_end(data: bytes, decode: Callable[[bytes], bytes]) -> bool:
    """Return whether all pixels of a JPEG without an end marker are there; `decode`
    returns a hash of its pixels.

    Bytes behind the last pixel are passed over, but those in place of missing pixels are decoded as such.
    """
    try:
        return decode(data + END) == decode(data + _ANY_PIXELS + END)
    except OSError:
        return False
