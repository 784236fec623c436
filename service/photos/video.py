"""A video's frames, one after the other, decoded by `video_decoder_process.py` in a process of its own.

MP4, MOV, WebM, Matroska and AVI, recognized by their first bytes, so that playlists, which such decoders follow, never
reach it. The size is checked before the first frame is decoded, and again for each frame; frames are counted as they
come, since a header's count need not be true.
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
"""Frames that one request may skip between two: each is decoded all the same, within `_FRAME_S`."""
_CHILD = Path(__file__).with_name("video_decoder_process.py")
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
    """Since the beginning of the video, by its time stamps; ascending."""
    rgb: UInt8[np.ndarray, "h w 3"]
    """Upright."""


def is_video(data: bytes) -> bool:
    """Whether a file that begins with these bytes (12 are enough) is a video of a kind that is read here."""
    # MP4, MOV and HEIC share a container; the brand distinguishes them.
    if data[4:8] == b"ftyp":
        return data[8:12] not in _STILL_BRANDS
    return data.startswith(b"\x1aE\xdf\xa3") or (data.startswith(b"RIFF") and data[8:12] == b"AVI ")


def frame_count(data: bytes) -> int:
    """Return the number of frames in the header; 0 if there is none. Raises InvalidImage."""
    with closing(_messages(data, every=0)) as messages:
        head, _ = next(messages)
    return head["frames"]


def read_video(data: bytes, every: int = 1) -> Iterator[VideoFrame]:
    """Yield each `every`th frame, beginning with the first; a frame that can't be decoded ends the video.

    Raises InvalidImage if it is no video, has no frame, or one that is too large or of another size.
    """
    number = -1
    with closing(_messages(data, every)) as messages:
        next(messages)
        for head, pixels in messages:
            number = head["number"]
            rgb = np.frombuffer(pixels, np.uint8).reshape(head["height"], head["width"], 3)
            yield VideoFrame(number, head["time_s"], rgb)
    if number < 0:
        raise InvalidImage("the video has no frame that can be decoded.", where="photo", hint="Upload the file again.")


def _messages(data: bytes, every: int) -> Generator[tuple[dict[str, Any], bytes], None, None]:
    """Yield the decoder's messages; at least one. Raises InvalidImage."""
    if not is_video(data):
        raise InvalidImage("not an MP4, MOV, WebM, Matroska or AVI video.", where="photo")
    child = [sys.executable, "-I", str(_CHILD), str(every), str(MAX_FRAME_PIXELS)]
    kept = {name: os.environ[name] for name in ("PATH", "LD_LIBRARY_PATH") if name in os.environ}
    # A file, not a pipe: MP4 may have its index at the end.
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
    finally:  # also where the caller stops reading early
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
    """Return the next message; None at the end of the pipe: the decoder has crashed or takes too long."""
    until = time.monotonic() + _FRAME_S
    # Two lengths, big-endian, then JSON and pixels.
    lengths = _read_exactly(pipe, 8, until)
    line, pixels = (
        (_read_exactly(pipe, length, until) for length in struct.unpack(">II", lengths)) if lengths else (b"", b"")
    )
    return None if lengths is None or line is None or pixels is None else (json.loads(line), pixels)


def _read_exactly(pipe: int, count: int, until: float) -> bytes | None:
    """Return `count` bytes; None if the pipe ends or time is up first."""
    data = bytearray()
    while len(data) < count:
        ready = select.select([pipe], [], [], max(0.0, until - time.monotonic()))[0]
        part = os.read(pipe, count - len(data)) if ready else b""
        if not part:
            return None
        data += part
    return bytes(data)
