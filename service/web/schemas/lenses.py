"""What is remembered of cameras' lenses, as the API returns it."""

from __future__ import annotations

from datetime import datetime

from service.web.api_model import Model


class LensOut(Model):
    """The estimate of a lens from earlier photos. Sigmas are standard deviations of the prior of the next photo."""

    id: str
    owner: str
    """Name of the API key whose photos it was learnt from; an address where the service has no keys."""
    camera_id: str
    """Of the requests; empty if they had none."""
    make: str
    """By EXIF data, like the fields up to `digital_zoom`; empty or null where they say nothing."""
    model: str
    lens_model: str
    focal_length_mm: float | None
    focal_35mm: float | None
    """The 35 mm equivalent."""
    digital_zoom: float
    aspect: float
    """Long side of the photos over their short side."""
    is_video: bool
    focal_length: float
    """In long sides of the photo."""
    focal_sigma: float
    """Relative."""
    k1: float
    """Radial distortion: the coefficient of COLMAP's SIMPLE_RADIAL."""
    k1_sigma: float
    principal_point: list[float]
    """Distance from the photo's centre, right and down, in long sides; of the photo as the camera stores it."""
    principal_point_sigma: float
    photos: int
    """How many were learnt from."""
    viewpoints: int
    """How many agreed since the last contradiction."""
    tested: bool
    """Whether enough viewpoints agreed for a tight prior."""
    updated: datetime


class LensList(Model):
    """The lenses that the caller may see."""

    lenses: list[LensOut]
    """Latest update first."""


class LensesDeleted(Model):
    """What was deleted."""

    deleted: int
    """How many."""
