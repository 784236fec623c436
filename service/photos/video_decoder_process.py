"""Decode one video in a process of its own: decoders of video are known to crash on hostile files.

    python -I video_decoder_process.py EVERY MAX_FRAME_PIXELS < video

Each message is two big-endian lengths of 4 bytes, JSON, and pixels (RGB, upright). The first one is of the video,
{"frames"}, the others of each EVERYth frame, {"number", "time_s", "width", "height"}; {"end"} or {"error", "hint"} is
the last one. With EVERY 0 no frame is decoded. Started by `video` only, with a limit of its memory; imports nothing of
the service.
"""

from __future__ import annotations

import json
import math
import struct
import sys
from collections.abc import Iterator
from typing import Any, BinaryIO, cast

import cv2
import numpy as np


class _Refused(Exception):
    """Two arguments: what is wrong, and what to do about it."""


def main() -> None:
    """Decode the file on stdin, which must be seekable, and write messages to stdout."""
    out = sys.stdout.buffer
    try:
        for head, pixels in _decoded(sys.stdin.buffer, *map(int, sys.argv[1:])):
            _write(out, head, pixels)
        _write(out, {"end": True})
    except _Refused as error:
        _write(out, dict(zip(("error", "hint"), error.args, strict=True)))


def _write(out: BinaryIO, head: dict[str, Any], pixels: bytes = b"") -> None:
    line = json.dumps(head).encode()
    out.write(struct.pack(">II", len(line), len(pixels)) + line)
    out.write(pixels)
    out.flush()  # the parent waits for each message, with a deadline


def _decoded(source: BinaryIO, every: int, max_pixels: int) -> Iterator[tuple[dict[str, Any], bytes]]:
    video = _opened(source, max_pixels)
    count = video.get(cv2.CAP_PROP_FRAME_COUNT)
    yield {"frames": int(count) if 0 < count < 1e12 else 0}, b""
    shape, time_s, number = None, -1.0, 0
    while every and video.grab():  # skipped frames are decoded, but not converted
        if number % every == 0:
            # Not all containers have time stamps: then frames follow one another evenly.
            stamp_s = round(video.get(cv2.CAP_PROP_POS_MSEC) / 1000, 6)  # stamps are coarser than a microsecond
            time_s = stamp_s if math.isfinite(stamp_s) and stamp_s > time_s else time_s + every / _rate(video)
            decoded, bgr = video.retrieve()
            if not decoded:
                break
            shape = shape or bgr.shape
            _check(bgr, shape, number, max_pixels)
            head = {"number": number, "time_s": max(time_s, 0.0), "width": shape[1], "height": shape[0]}
            yield head, cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB).tobytes()
        number += 1


def _opened(source: BinaryIO, max_pixels: int) -> cv2.VideoCapture:
    try:
        # One thread: a job runs on one.
        video = cv2.VideoCapture(cast(Any, source), cv2.CAP_FFMPEG, [cv2.CAP_PROP_N_THREADS, 1])
    except cv2.error as error:
        raise _Refused(f"the video can't be opened: {str(error)[:200]}.", "") from None
    width, height = (int(video.get(p)) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    if not video.isOpened() or min(width, height) < 1:
        raise _Refused(
            "the video can't be opened: it is truncated, damaged, or coded in an unknown way.",
            "Convert it to H.264 in an .mp4.",
        )
    if width * height > max_pixels:
        raise _Refused(
            f"the video's frames have {width} x {height} pixels; the limit is {max_pixels}.",
            "Send it smaller: more than 800 pixels on the long side don't help.",
        )
    return video


def _rate(video: cv2.VideoCapture) -> float:
    rate = video.get(cv2.CAP_PROP_FPS)
    return rate if math.isfinite(rate) and 0.1 <= rate <= 1000 else 30.0


def _check(bgr: np.ndarray, shape: tuple[int, ...], number: int, max_pixels: int) -> None:
    if bgr.dtype != np.uint8 or bgr.ndim != 3 or bgr.shape[2] != 3:
        raise _Refused(f"frame {number} is no colour picture of 8 bits.", "")
    if bgr.shape != shape or bgr.shape[0] * bgr.shape[1] > max_pixels:
        raise _Refused(
            f"frame {number} has {bgr.shape[1]} x {bgr.shape[0]} pixels, the first one {shape[1]} x {shape[0]}.",
            "All frames must have one size.",
        )


if __name__ == "__main__":
    main()
