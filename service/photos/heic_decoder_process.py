"""Decode one HEIC photo in a process of its own: its decoders are known to crash on hostile files.

    python -I heic_decoder_process.py MAX_PIXELS < photo.heic

Writes a line of JSON, {"error"} or {"width", "height", "mode", "exif" (base64)}, and then the pixels, unless there are
more than MAX_PIXELS. Started by `heic` only, within limits of memory and time that a hostile file can't lift; imports
nothing of the service. The only file with pi_heif.
"""

from __future__ import annotations

import base64
import json
import sys
from io import BytesIO

from pi_heif import HeifImageFile


def main() -> None:
    """Decode the file on stdin."""
    for part in decoded(sys.stdin.buffer.read(), int(sys.argv[1])):
        sys.stdout.buffer.write(part)


def decoded(data: bytes, max_pixels: int) -> list[bytes]:
    """Return the line of JSON, and the pixels unless there are more than `max_pixels`."""
    try:
        photo = HeifImageFile(BytesIO(data))
        # The header alone has the size: a bomb is refused before it takes memory.
        fits = photo.width * photo.height <= max_pixels
        if fits:
            photo.load()
    except Exception as error:  # decoders raise almost anything on a broken file
        return [_line(error=str(error) or type(error).__name__)]
    exif = base64.b64encode(photo.info.get("exif") or b"").decode()
    head = _line(width=photo.width, height=photo.height, mode=photo.mode, exif=exif)
    return [head, photo.tobytes()] if fits else [head]


def _line(**values: object) -> bytes:
    return json.dumps(values).encode() + b"\n"


if __name__ == "__main__":
    main()
