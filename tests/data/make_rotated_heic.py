"""Made rotated.heic, with pillow-heif 1.x (its wheel brings a GPL encoder, so it is no dependency)."""

from pathlib import Path

import numpy as np
import pillow_heif  # pyright: ignore[reportMissingImports]
from PIL import ExifTags, Image

pillow_heif.register_heif_opener()
rows, columns = np.mgrid[:96, :128]
pixels = np.stack([columns * 255 // 127, rows * 255 // 95, np.full_like(rows, 64)], -1).astype(np.uint8)
exif = Image.Exif()
exif[ExifTags.Base.Orientation] = 6
exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = 26
Image.fromarray(pixels).save(Path(__file__).with_name("rotated.heic"), quality=90, exif=exif.tobytes())
