"""How many scans a JPEG has: each is a pass over all pixels, so a small file of many scans takes long to decode."""

from __future__ import annotations

import re

_MARKER = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]")
"""Excludes a stuffed byte, and a restart within a scan."""
_SCAN, _END = 0xDA, 0xD9


def count_scans(data: bytes) -> int:
    """Count the scans of a JPEG's first image, without decoding it."""
    at, scans = 2, 0  # behind the start-of-image marker
    while found := _MARKER.search(data, at):
        kind, at = found[0][-1], found.end()
        # What follows is no part of the photo: phones append videos.
        if kind == _END:
            break
        scans += kind == _SCAN
        at += int.from_bytes(data[at : at + 2])  # the segment's length
    return scans
