"""HEIC photos, decoded by `heic_decoder_process.py` in a process of its own, since their decoders may crash."""

from __future__ import annotations

import base64
import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

_PROGRAM = Path(__file__).with_name("heic_decoder_process.py")


@dataclass(frozen=True, slots=True)
class DecodedHeic:
    """A HEIC photo, upright."""

    width: int
    height: int
    mode: str
    """Pillow's name of the pixels' layout, e.g. RGB."""
    exif: bytes
    """Empty if there is none."""
    pixels: bytes
    """Row by row; empty if the photo has more than were allowed."""


def decode_heic(data: bytes, max_pixels: int, max_s: float) -> DecodedHeic:
    """Decode a photo within a time limit; of one with more pixels only the header. Raises ValueError."""
    # -I and an almost empty environment: the process finds its libraries, and nothing of ours.
    command = [sys.executable, "-I", str(_PROGRAM), str(max_pixels)]
    kept = {name: os.environ[name] for name in ("PATH", "LD_LIBRARY_PATH") if name in os.environ}
    try:
        output = subprocess.run(command, input=data, capture_output=True, timeout=max_s, check=True, env=kept).stdout
    except (subprocess.CalledProcessError, subprocess.TimeoutExpired) as error:
        raise ValueError(f"its decoder crashed or took too long ({type(error).__name__})") from error
    line, _, pixels = output.partition(b"\n")
    head = json.loads(line)
    if "error" in head:
        raise ValueError(head["error"])
    return DecodedHeic(head["width"], head["height"], head["mode"], base64.b64decode(head["exif"]), pixels)
