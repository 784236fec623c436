"""The binary message of a live session: a header and a JPEG.

Little-endian. Offset, type, field:

     0  4 bytes  "SFLV"
     4  uint8    version, 1
     5  uint8    flags: 1 = intrinsics follow; all others 0
     6  uint16   length of the header in bytes, 24 or 56: where the JPEG begins
     8  uint32   id of the frame, ascending
    12  uint32   0
    16  float64  capture time in seconds, by any clock, not descending
    24  float64  fx, fy, cx, cy of this frame in pixels, with flag 1 only
"""

from __future__ import annotations

import math
import struct

from service.errors import InvalidImage, InvalidIntrinsics, InvalidRequest
from service.live.live_values import LiveFrame
from service.photos.images import photo_size
from service.types import Intrinsics

MAGIC, VERSION = b"SFLV", 1
HAS_INTRINSICS = 1
_HEAD = struct.Struct("<4sBBHIId")
_INTRINSICS = struct.Struct("<4d")


def read_frame(message: bytes, after: LiveFrame | None) -> LiveFrame:
    """Read a message, which follows the frame `after` in its session.

    Raises InvalidRequest at the field of the header that is wrong, InvalidImage, InvalidIntrinsics.
    """
    if len(message) < _HEAD.size:
        raise InvalidRequest(
            f"the header has {_HEAD.size} bytes or more, the message only {len(message)}.", where="frame"
        )
    magic, version, flags, length, frame_id, zero, time_s = _HEAD.unpack_from(message)
    if magic != MAGIC or version != VERSION:
        raise InvalidRequest(
            f"a message begins with {MAGIC.decode()} and version {VERSION}, not {magic!r} and {version}.", where="frame"
        )
    if flags & ~HAS_INTRINSICS or zero:
        raise InvalidRequest(f"unknown flags or reserved bytes: {flags:#x}, {zero:#x}.", where="frame.flags")
    needed = _HEAD.size + (_INTRINSICS.size if flags & HAS_INTRINSICS else 0)
    if length != needed or len(message) <= length:
        raise InvalidRequest(
            f"the header has {needed} bytes with these flags, then comes the JPEG; it says {length}, in a message of "
            f"{len(message)}.",
            where="frame.length",
        )
    _require_later(frame_id, time_s, after)
    jpeg = bytes(message[length:])
    if not jpeg.startswith(b"\xff\xd8\xff"):
        raise InvalidImage("a frame is a JPEG.", where="frame")
    intrinsics = _intrinsics(message, jpeg) if flags & HAS_INTRINSICS else None
    return LiveFrame(frame_id, time_s, jpeg, intrinsics)


def _require_later(frame_id: int, time_s: float, after: LiveFrame | None) -> None:
    if after is not None and frame_id <= after.id:
        raise InvalidRequest(f"must ascend: {frame_id} after {after.id}.", where="frame.id")
    if not math.isfinite(time_s) or (after is not None and time_s < after.time_s):
        raise InvalidRequest("must be finite, and not before that of the last frame.", where="frame.time")


def _intrinsics(message: bytes, jpeg: bytes) -> Intrinsics:
    try:
        return Intrinsics(*photo_size(jpeg), *_INTRINSICS.unpack_from(message, _HEAD.size))
    except InvalidIntrinsics as error:
        error.where = f"frame.{error.where}"
        raise
