"""Which photos were taken through one lens: the same owner, camera and setting."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass

from service.photos.camera_identity import CameraIdentity


@dataclass(frozen=True, slots=True)
class LensKey:
    """Names a lens of one owner."""

    owner: str
    """Who sent the photos: nobody else's photos have this key."""
    camera_id: str
    """What the owner calls the camera; empty: nothing."""
    make: str
    model: str
    lens_model: str
    focal_length_mm: float | None
    focal_35mm: float | None
    digital_zoom: float
    aspect: float
    """Long side over short side: cameras cut other shapes out of their frame."""
    is_video: bool
    """Videos show another part of the frame than photos."""

    @property
    def id(self) -> str:
        """16 hexadecimal digits, the same for the same key."""
        # Stored and shown in URLs: Python's own hash differs between processes.
        return hashlib.sha256(json.dumps(asdict(self)).encode()).hexdigest()[:16]


def lens_key(owner: str, camera_id: str | None, camera: CameraIdentity) -> LensKey | None:
    """Return the key of a photo's lens; None where nothing names the camera, or the photo was evidently cropped.

    A crop has another focal length in long sides than the photos that the camera makes. `camera_id` does not replace
    what EXIF says: that distinguishes the lenses of one phone.
    """
    if camera.is_cropped or not (camera_id or camera.is_named):
        return None
    return LensKey(
        owner=owner,
        camera_id=camera_id or "",
        make=camera.make,
        model=camera.model,
        lens_model=camera.lens_model,
        focal_length_mm=camera.focal_length_mm,
        focal_35mm=camera.focal_35mm,
        digital_zoom=camera.digital_zoom,
        aspect=camera.aspect,
        is_video=camera.is_video,
    )
