"""The binary message of a live session: a header and a JPEG.

Little-endian. Offset, type, field:

     0  4 bytes  "SFLV"
     4  uint8    version, 1
     5  uint8    flags, added: 1 = intrinsics, 2 = odometry, 4 = gravity follow, in this order; all others 0
     6  uint16   length of the header in bytes, 24 to 176: where the JPEG begins
     8  uint32   id of the frame, ascending
    12  uint32   0
    16  float64  capture time in seconds, by any clock, not descending
    then, each with its flag only:
     1  4 x float64   fx, fy, cx, cy of this frame in pixels
     2  12 x float64  the first three rows of odom_from_camera, 4x4, OpenCV camera axes
     4  3 x float64   up by gravity in OpenCV camera axes, of any length
"""

from __future__ import annotations

import math
import struct

import numpy as np

from service.errors import InvalidImage, InvalidIntrinsics, InvalidPrior, InvalidRequest
from service.live.live_values import LiveFrame
from service.photos.images import photo_size
from service.types import Intrinsics, Pose

MAGIC, VERSION = b"SFLV", 1
HAS_INTRINSICS, HAS_ODOMETRY, HAS_UP = 1, 2, 4
_HEAD = struct.Struct("<4sBBHIId")
_PARTS = {HAS_INTRINSICS: struct.Struct("<4d"), HAS_ODOMETRY: struct.Struct("<12d"), HAS_UP: struct.Struct("<3d")}
_FARTHEST = 1e6
"""Of an odometry's position: farther ones would lose digits."""


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
    if flags & ~sum(_PARTS) or zero:
        raise InvalidRequest(f"unknown flags or reserved bytes: {flags:#x}, {zero:#x}.", where="frame.flags")
    needed = _HEAD.size + sum(part.size for flag, part in _PARTS.items() if flags & flag)
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
    parts, offset = {}, _HEAD.size
    for flag, part in _PARTS.items():
        if flags & flag:
            parts[flag] = part.unpack_from(message, offset)
            offset += part.size
    intrinsics = _intrinsics(parts[HAS_INTRINSICS], jpeg) if HAS_INTRINSICS in parts else None
    odometry = _odometry(parts[HAS_ODOMETRY]) if HAS_ODOMETRY in parts else None
    up = _up(parts[HAS_UP]) if HAS_UP in parts else None
    return LiveFrame(frame_id, time_s, jpeg, intrinsics, odometry, up)


def _require_later(frame_id: int, time_s: float, after: LiveFrame | None) -> None:
    if after is not None and frame_id <= after.id:
        raise InvalidRequest(f"must ascend: {frame_id} after {after.id}.", where="frame.id")
    if not math.isfinite(time_s) or (after is not None and time_s < after.time_s):
        raise InvalidRequest("must be finite, and not before that of the last frame.", where="frame.time")


def _intrinsics(numbers: tuple[float, ...], jpeg: bytes) -> Intrinsics:
    try:
        # The header doesn't repeat what the JPEG's own says, its size.
        fx, fy, cx, cy = numbers
        return Intrinsics(*photo_size(jpeg), fx, fy, cx, cy)
    except InvalidIntrinsics as error:
        error.where = f"frame.{error.where}"
        raise


def _odometry(numbers: tuple[float, ...]) -> Pose:
    matrix = np.vstack([np.reshape(numbers, (3, 4)), [0.0, 0.0, 0.0, 1.0]])
    try:
        pose = Pose(matrix)
    except InvalidPrior as error:
        error.where = "frame.odom_from_camera"
        raise
    if np.abs(pose.position_in_world).max() > _FARTHEST:
        raise InvalidRequest(f"is farther than {_FARTHEST:g} from its origin.", where="frame.odom_from_camera")
    return pose


def _up(numbers: tuple[float, ...]) -> tuple[float, float, float]:
    x, y, z = numbers
    # `not`: NaN compares false.
    if not 1e-6 < math.hypot(x, y, z) < _FARTHEST:
        raise InvalidRequest(f"is no direction: {x:g}, {y:g}, {z:g}.", where="frame.up_in_camera")
    return x, y, z
