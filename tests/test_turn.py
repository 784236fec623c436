"""By how much a photo is turned: photos of the demo scene, turned by NumPy and by Pillow."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageOps

from service.pose.features.in_plane_rotation import CORNERS, Corners, detect_corners, rolls_to_upright

PHOTOS = sorted((Path(__file__).parent.parent / "scenes" / "studio" / "photos").glob("*.jpg"))


def upright(number: int, width: int) -> Image.Image:
    with Image.open(PHOTOS[number]) as image:
        return ImageOps.contain(ImageOps.exif_transpose(image).convert("RGB"), (width, width))


def picture(number: int) -> np.ndarray:
    """A photo that is darker than the views, with noise, and of another size."""
    noise = np.random.default_rng(number).normal(0, 10, (416, 416, 3))
    rgb = np.asarray(upright(number, 416))
    return np.clip(0.6 * rgb + noise[: len(rgb), : rgb.shape[1]], 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def views() -> Corners:
    return Corners.pooled([detect_corners(np.asarray(upright(k, 350)), CORNERS.of_view) for k in range(len(PHOTOS))])


@pytest.mark.parametrize("quarters", range(4))
def test_a_photo_turned_by_quarters_is_told_how_to_stand(quarters: int, views: Corners) -> None:
    """numpy turns counter-clockwise, so the rest of the circle is left."""
    for number in range(len(PHOTOS)):
        turned = np.ascontiguousarray(np.rot90(picture(number), quarters))
        assert rolls_to_upright(detect_corners(turned, CORNERS.of_photo), views)[0] == -2 * quarters % 8


@pytest.mark.parametrize("degrees", [45, 135, 200, 330])
def test_of_a_photo_turned_by_any_angle_the_nearest_eighth_is_told(degrees: int, views: Corners) -> None:
    """The blank corners that turning leaves are known to be none of the photo."""
    for number in range(0, len(PHOTOS), 4):
        photo = Image.fromarray(picture(number))
        turned = np.asarray(photo.rotate(degrees, Image.Resampling.BICUBIC, expand=True))
        blank = Image.new("L", photo.size, 255).rotate(degrees, expand=True)
        known = np.asarray(blank) > 0
        assert rolls_to_upright(detect_corners(turned, CORNERS.of_photo, known), views)[0] == round(-degrees / 45) % 8


def test_where_nothing_has_corners_nothing_is_turned(views: Corners) -> None:
    blank = detect_corners(np.full((312, 416, 3), 128, np.uint8), CORNERS.of_view)
    assert len(blank.directions_deg) == len(blank.descriptors) == 0
    assert rolls_to_upright(blank, views) == [0]
    assert rolls_to_upright(detect_corners(picture(0), CORNERS.of_photo), Corners.pooled([blank])) == [0]
