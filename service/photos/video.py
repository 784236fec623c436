"""A video's frames, one after the other, decoded by `video_child.py` in a process of its own.

MP4, MOV, WebM, Matroska and AVI, told by their first bytes: lists of other files, which such decoders follow, too,
never reach it. The size is checked before the first frame is decoded, and each frame again; frames are counted as they
come, for what a file says of their number need not be true.
"""

from __future__ import annotations

import json
import logging
import os
import select
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Generator, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from service.errors import InvalidImage

MAX_FRAME_PIXELS = 4096 * 2304
"""4K, of cinema and television."""
MAX_EVERY = 1000
_CHILD = Path(__file__).with_name("video_child.py")
_FRAME_S = 60
"""Wall time for one message; a thousand frames of 4K, of which the last one is wanted, take 20 s."""
_STILL_BRANDS = (b"heic", b"heix", b"hevc", b"hevx", b"heim", b"heis", b"mif1", b"msf1", b"avif", b"avis", b"jxl ")
"""What may follow `ftyp` in a file that holds a photo."""
log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class VideoFrame:
    number: int
    """In the file, from 0."""
    time_s: float
    """Since the video's beginning, as the file tells; ascending."""
    rgb: UInt8[np.ndarray, "h w 3"]
    """Upright."""


def is_video(data: bytes) -> bool:
    """Return whether a file that begins so (12 bytes are enough) is a video of a kind that is read here."""
    if data[4:8] == b"ftyp":
        return data[8:12] not in _STILL_BRANDS
    return data.startswith(b"\x1aE\xdf\xa3") or (data.startswith(b"RIFF") and data[8:12] == b"AVI ")


def frame_count(data: bytes) -> int:
    """Return how many frames the file says it has; 0 if it says nothing. Raises InvalidImage."""
    with closing(_told(data, every=0)) as messages:
        head, _ = next(messages)
    return head["frames"]


def read_video(data: bytes, every: int = 1) -> Iterator[VideoFrame]:
    """Yield each `every`th frame, beginning with the first; what can't be decoded ends the video.

    Raises InvalidImage if it is no video, has no frame, or one that is too large or of another size.
    """
    number = -1
    with closing(_told(data, every)) as messages:
        next(messages)
        for head, pixels in messages:
            number = head["number"]
            rgb = np.frombuffer(pixels, np.uint8).reshape(head["height"], head["width"], 3)
            yield VideoFrame(number, head["time_s"], rgb)
    if number < 0:
        raise InvalidImage("the video has no frame that can be decoded.", where="photo", hint="Upload the file again.")


def _told(data: bytes, every: int) -> Generator[tuple[dict[str, Any], bytes], None, None]:
    """Yield the decoder's messages; at least one. Raises InvalidImage."""
    if not is_video(data):
        raise InvalidImage("not an MP4, MOV, WebM, Matroska or AVI video.", where="photo")
    child = [sys.executable, "-I", str(_CHILD), str(every), str(MAX_FRAME_PIXELS)]
    kept = {name: os.environ[name] for name in ("PATH", "LD_LIBRARY_PATH") if name in os.environ}
    with tempfile.TemporaryFile() as file:
        file.write(data)
        file.seek(0)
        decoder = subprocess.Popen(
            child, stdin=file, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=kept, bufsize=0
        )
    assert decoder.stdout is not None
    count = 0
    try:
        while message := _message(decoder.stdout.fileno()):
            if "end" in message[0]:
                return
            if "error" in message[0]:
                raise InvalidImage(message[0]["error"], where="photo", hint=message[0]["hint"])
            count += 1
            yield message
    finally:
        decoder.kill()
        decoder.stdout.close()
        decoder.wait()
    log.warning("the decoder of a video crashed or took too long, after %d messages", count)
    if count == 0:
        raise InvalidImage(
            "the video can't be opened: its decoder crashed or took too long.",
            where="photo",
            hint="Convert it to H.264 in an .mp4.",
        )


def _message(pipe: int) -> tuple[dict[str, Any], bytes] | None:
    """Return the next one; None at the end, also if the decoder crashed or takes too long."""
    until = time.monotonic() + _FRAME_S
    lengths = _taken(pipe, 8, until)
    line, pixels = (_taken(pipe, length, until) for length in struct.unpack(">II", lengths)) if lengths else (b"", b"")
    return None if lengths is None or line is None or pixels is None else (json.loads(line), pixels)


def _taken(pipe: int, count: int, until: float) -> bytes | None:
    """Return so many bytes; None if they don't come."""
    data = bytearray()
    while len(data) < count:
        ready = select.select([pipe], [], [], max(0.0, until - time.monotonic()))[0]
        part = os.read(pipe, count - len(data)) if ready else b""
        if not part:
            return None
        data += part
    return bytes(data)
