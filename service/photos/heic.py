"""HEIC photos, decoded by `heic_decoder_process.py` in a process of its own, since their decoders may crash."""

from __future__ import annotations

import base64
import json
import subprocess
from dataclasses import dataclass
from pathlib import Path

from service.operating_system import child_environment, limited_command

_PROGRAM = Path(__file__).with_name("heic_decoder_process.py")
_MEMORY_BYTES = 2 << 30
"""64 megapixels take 1 GB: as stored, as RGB, and as output."""
_CPU_S = 20


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
    command = limited_command(_PROGRAM, max_pixels, memory_bytes=_MEMORY_BYTES, cpu_s=_CPU_S)
    kept = child_environment()
    try:
        output = subprocess.run(command, input=data, capture_output=True, timeout=max_s, check=True, env=kept).stdout
    except (subprocess.CalledProcessError, subprocess.TimeoutExpired) as error:
        raise ValueError(f"its decoder crashed or took too long ({type(error).__name__})") from error
    line, _, pixels = output.partition(b"\n")
    head = json.loads(line)
    if "error" in head:
        raise ValueError(head["error"])
    return DecodedHeic(head["width"], head["height"], head["mode"], base64.b64decode(head["exif"]), pixels)
