"""A video's frames, one after the other: OpenCV's decoder behind checks. The only file with it.

MP4, MOV, WebM, Matroska and AVI, told by their first bytes: lists of other files, which such decoders follow, too,
never reach it. The size is checked before the first frame is decoded, and each frame again; frames are counted as they
come, for what a file says of their number need not be true.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO, cast

import cv2
import numpy as np
from jaxtyping import UInt8

from service.errors import InvalidImage

MAX_FRAME_PIXELS = 4096 * 2304
"""4K, of cinema and television."""
MAX_EVERY = 1000
_HEAD_BYTES = 12
_STILL_BRANDS = (b"heic", b"heix", b"hevc", b"hevx", b"heim", b"heis", b"mif1", b"msf1", b"avif", b"avis", b"jxl ")
"""What may follow `ftyp` in a file that holds a photo."""


@dataclass(frozen=True, slots=True)
class VideoFrame:
    number: int
    """In the file, from 0."""
    time_s: float
    """Since the video's beginning, as the file tells; ascending."""
    rgb: UInt8[np.ndarray, "h w 3"]
    """Upright."""


def is_video(head: bytes) -> bool:
    """Return whether a file that begins so is a video of a kind that is read here."""
    if head[4:8] == b"ftyp":
        return head[8:12] not in _STILL_BRANDS
    return head.startswith(b"\x1aE\xdf\xa3") or (head.startswith(b"RIFF") and head[8:12] == b"AVI ")


def frame_count(source: BinaryIO) -> int:
    """Return how many frames the file says it has; 0 if it says nothing. Raises InvalidImage."""
    video = _opened(source)
    try:
        count = video.get(cv2.CAP_PROP_FRAME_COUNT)
    finally:
        video.release()
    return int(count) if 0 < count < 1e12 else 0


def read_video(source: BinaryIO, every: int = 1) -> Iterator[VideoFrame]:
    """Yield each `every`th frame, beginning with the first; what can't be decoded ends the video.

    Raises InvalidImage if it is no video, has no frame, or one that is too large or of another size.
    """
    video = _opened(source)
    try:
        shape, time_s = None, -1.0
        number = 0
        while video.grab():
            if number % every == 0:
                # Not all containers tell times: then frames follow one another evenly.
                told = round(video.get(cv2.CAP_PROP_POS_MSEC) / 1000, 6)  # a microsecond is less than it knows
                time_s = told if np.isfinite(told) and told > time_s else time_s + every / _rate(video)
                decoded, bgr = video.retrieve()
                if not decoded:
                    break
                shape = shape or bgr.shape
                _check(bgr, shape, number)
                yield VideoFrame(number, max(time_s, 0.0), cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB))
            number += 1
    finally:
        video.release()
    if shape is None:
        raise InvalidImage("the video has no frame that can be decoded.", where="photo", hint="Upload the file again.")


def _opened(source: BinaryIO) -> cv2.VideoCapture:
    source.seek(0)
    if not is_video(source.read(_HEAD_BYTES)):
        raise InvalidImage("not an MP4, MOV, WebM, Matroska or AVI video.", where="photo")
    source.seek(0)
    try:
        # One thread: a job runs on one.
        video = cv2.VideoCapture(cast(Any, source), cv2.CAP_FFMPEG, [cv2.CAP_PROP_N_THREADS, 1])
    except cv2.error as error:
        raise InvalidImage(f"the video can't be opened: {str(error)[:200]}.", where="photo") from None
    width, height = (int(video.get(p)) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    if not video.isOpened() or min(width, height) < 1:
        video.release()
        raise InvalidImage(
            "the video can't be opened: it is truncated, damaged, or coded in an unknown way.",
            where="photo",
            hint="Convert it to H.264 in an .mp4.",
        )
    if width * height > MAX_FRAME_PIXELS:
        video.release()
        raise InvalidImage(
            f"the video's frames have {width} x {height} pixels; the limit is {MAX_FRAME_PIXELS}.",
            where="photo",
            hint="Send it smaller: more than 800 pixels on the long side don't help.",
        )
    return video


def _rate(video: cv2.VideoCapture) -> float:
    rate = video.get(cv2.CAP_PROP_FPS)
    return rate if np.isfinite(rate) and 0.1 <= rate <= 1000 else 30.0


def _check(bgr: np.ndarray, shape: tuple[int, ...], number: int) -> None:
    if bgr.dtype != np.uint8 or bgr.ndim != 3 or bgr.shape[2] != 3:
        raise InvalidImage(f"frame {number} is no colour picture of 8 bits.", where="photo")
    if bgr.shape != shape or bgr.shape[0] * bgr.shape[1] > MAX_FRAME_PIXELS:
        raise InvalidImage(
            f"frame {number} has {bgr.shape[1]} x {bgr.shape[0]} pixels, the first one {shape[1]} x {shape[0]}.",
            where="photo",
            hint="All frames must have one size.",
        )
