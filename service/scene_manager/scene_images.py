"""Pictures of a scene from any pose, as files."""

from __future__ import annotations

import io

import numpy as np

from service.errors import InvalidIntrinsics
from service.loaded_scene import LoadedScene
from service.photos.images import encode_image
from service.scene_manager.status import PictureFormat, PictureSpec
from service.scene_manager.warm_up import overview
from service.scene_origin import shifted
from service.types import Camera, Intrinsics

PICTURE_TYPES: dict[PictureFormat, str] = {"png": "image/png", "jpeg": "image/jpeg", "depth": "application/x-npy"}
MAX_RENDER_PIXELS = 8_000_000
"""A renderer's thread holds about 30 bytes for each."""
THUMBNAIL_PX = 480
"""The long side: a card of the start page on a fine display."""


def thumbnail(loaded: LoadedScene) -> bytes:
    """Return a small JPEG of the scene."""
    return encode_image(loaded.for_display().render([overview(loaded, THUMBNAIL_PX)])[0].rgb)


def picture(loaded: LoadedScene, wanted: PictureSpec) -> bytes:
    """Render to a file. Raises InvalidIntrinsics."""
    pose = shifted(wanted.pose, -np.array(loaded.scene.info.origin_in_world))
    frame = loaded.for_display().render([Camera(_intrinsics(loaded, wanted.intrinsics), pose)])[0]
    if wanted.format == "depth":
        file = io.BytesIO()
        # Little-endian whatever the machine: the file goes to others.
        np.lib.format.write_array(file, frame.median_depth.astype("<f4"), allow_pickle=False)
        return file.getvalue()
    return encode_image(frame.rgb, "png" if wanted.format == "png" else "jpg", quality=wanted.quality)


def _intrinsics(loaded: LoadedScene, given: Intrinsics | None) -> Intrinsics:
    if given is None:
        cameras = loaded.scene.cameras
        return cameras[0].camera.intrinsics if cameras else Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0)
    if given.model not in ("PINHOLE", "SIMPLE_PINHOLE"):
        raise InvalidIntrinsics("pictures are rendered with a pinhole camera.", where="intrinsics.model")
    if given.width * given.height > MAX_RENDER_PIXELS:
        raise InvalidIntrinsics(
            f"{given.width} x {given.height} is more than {MAX_RENDER_PIXELS / 1e6:g} megapixels.", where="intrinsics"
        )
    return given
