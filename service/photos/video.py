"""A video's frames, one after the other, decoded by `video_decoder_process.py` in a process of its own.

MP4, MOV, WebM, Matroska and AVI, recognized by their first bytes, so that playlists, which such decoders follow, never
reach it. The size is checked before the first frame is decoded, and again for each frame; frames are counted as they
come, since a header's count need not be true.
"""

from __future__ import annotations

import json
import logging
import struct
import subprocess
import tempfile
import threading
from collections.abc import Generator, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from jaxtyping import UInt8

from service.errors import InvalidImage
from service.operating_system import child_environment, limited_command

MAX_FRAME_PIXELS = 4096 * 2304
"""4K, of cinema and television."""
MAX_EVERY = 1000
"""Frames that one request may skip between two: each is decoded all the same, within `_FRAME_S`."""
_CHILD = Path(__file__).with_name("video_decoder_process.py")
_MEMORY_BYTES = 2 << 30
"""4K takes 0.6 GB, with the frames that later ones refer to."""
_FRAME_S = 60
"""Wall time for one message; a thousand frames of 4K, of which the last one is wanted, take 20 s."""
_STILL_BRANDS = (b"heic", b"heix", b"hevc", b"hevx", b"heim", b"heis", b"mif1", b"msf1", b"avif", b"avis", b"jxl ")
"""What may follow `ftyp` in a file that holds a photo."""
log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class VideoFrame:
    """One decoded frame."""

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
    child = limited_command(_CHILD, every, MAX_FRAME_PIXELS, memory_bytes=_MEMORY_BYTES)
    # A file, not a pipe: MP4 may have its index at the end.
    with tempfile.TemporaryFile() as file:
        file.write(data)
        file.seek(0)
        decoder = subprocess.Popen(
            child, stdin=file, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=child_environment()
        )
    assert decoder.stdout is not None
    count = 0
    try:
        while message := _message(decoder, decoder.stdout):
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


def _message(decoder: subprocess.Popen[bytes], pipe: IO[bytes]) -> tuple[dict[str, Any], bytes] | None:
    """Return the next message; None at the end of the pipe: the decoder has crashed or takes too long."""
    # Ending the process ends the read: no system but Unix waits for a pipe with a deadline.
    deadline = threading.Timer(_FRAME_S, decoder.kill)
    deadline.start()
    try:
        # Two lengths, big-endian, then JSON and pixels.
        lengths = pipe.read(8)
        if len(lengths) < 8:
            return None
        parts = [pipe.read(length) for length in struct.unpack(">II", lengths)]
    finally:
        deadline.cancel()
    whole = sum(map(len, parts)) == sum(struct.unpack(">II", lengths))
    return (json.loads(parts[0]), parts[1]) if whole else None
