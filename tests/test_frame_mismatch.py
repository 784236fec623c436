"""Intrinsics of another frame than the photo's: what the error says, and whether its values are right."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
from PIL import Image, ImageOps
from test_images import RAYS, colmap_pixels, encoded, exif_with, gradient

from service.errors import InvalidIntrinsics
from service.photos.images import read_query
from service.photos.intrinsics import CLOCKWISE, UPRIGHT, intrinsics_from, oriented
from service.types import Intrinsics

STORED = Intrinsics(80, 60, 70.0, 75.0, 44.0, 27.0, "OPENCV", (0.1, 0.01, 0.02, -0.03))
"""Of a camera's landscape buffer."""
TURNS = {1: UPRIGHT, 2: (False, True, False), 3: (False, True, True), 4: (False, False, True)}
TURNS |= {5: (True, False, False), 6: CLOCKWISE, 7: (True, True, True), 8: (True, False, True)}


def moved_as_pillow_does(px: np.ndarray, orientation: int) -> np.ndarray:
    """Where pixels of a stored photo are in the upright one: by what Pillow makes of an image of coordinates."""
    rows, columns = np.mgrid[: STORED.height, : STORED.width]
    image = Image.fromarray(np.stack([columns, rows, 0 * rows], -1).astype(np.uint8))
    upright = np.asarray(ImageOps.exif_transpose(Image.open(BytesIO(encoded(image, exif=exif_with(orientation))))))
    where = {tuple(upright[v, u, :2]): (u, v) for v in range(upright.shape[0]) for u in range(upright.shape[1])}
    origin, x, y = (np.array(where[at]) for at in ((10, 10), (11, 10), (10, 11)))
    # Of pixels' centres, and linear.
    return origin + 0.5 + (px - 10.5) @ np.stack([x - origin, y - origin])


def misfit(data: bytes, given_: Intrinsics) -> tuple[str, list[Intrinsics]]:
    """What the error says, and the intrinsics that it recommends."""
    with pytest.raises(InvalidIntrinsics) as caught:
        read_query(data, intrinsics=given_)
    hint = caught.value.hint
    return str(caught.value), [intrinsics_from(json.loads(text)) for text in re.findall(r"\{.*?\}", hint)]


class TestIntrinsicsOfAnotherFrame:
    @pytest.mark.parametrize("orientation", range(1, 9))
    def test_a_turned_camera_sees_the_same(self, orientation):
        upright = oriented(STORED, *TURNS[orientation])
        linear = moved_as_pillow_does(np.array([[10.5, 10.5], [11.5, 10.5], [10.5, 11.5]]), orientation)
        turn, rays = np.stack([linear[1] - linear[0], linear[2] - linear[0]], 1), 0.3 * RAYS
        expected = moved_as_pillow_does(colmap_pixels(rays, STORED), orientation)
        assert np.allclose(colmap_pixels(rays @ turn.T, upright), expected, atol=1e-9)

    @pytest.mark.parametrize("orientation", [5, 6, 7, 8])
    def test_the_buffers_intrinsics_are_turned_as_the_photo_is(self, orientation):
        data = encoded(Image.fromarray(gradient()), exif=exif_with(orientation))
        says, (fitting,) = misfit(data, STORED)
        assert "before the photo was turned by its EXIF orientation" in says
        assert fitting == oriented(STORED, *TURNS[orientation])
        assert read_query(data, intrinsics=fitting).photo_intrinsics == fitting

    def test_a_lost_orientation_is_named_with_both_turns(self):
        says, (clockwise,) = misfit(encoded(Image.fromarray(gradient(60, 80))), STORED)
        assert "lost its EXIF orientation" in says
        assert clockwise == oriented(STORED, *CLOCKWISE)
        other = oriented(STORED, *TURNS[8])
        assert f"({other.cx:g}, {other.cy:g} at 60 x 80)" in says
        # A landscape photo without its orientation, and intrinsics of the upright one.
        says, (back,) = misfit(encoded(Image.fromarray(gradient())), oriented(STORED, *TURNS[8]))
        assert "lost its EXIF orientation" in says
        assert (back.width, back.height, back.fx, back.fy) == (80, 60, 70.0, 75.0)

    def test_a_display_crop_keeps_the_focal_length(self):
        """A square screen shows the middle of a camera's picture, here at twice its size."""
        says, (fitting,) = misfit(encoded(Image.fromarray(gradient(120, 120))), replace(STORED, trust="approximate"))
        assert "cropped to another shape" in says
        assert "not resized, keep fx and fy, and subtract its left and upper edge from cx and cy" in says
        left = (2 * STORED.width - 120) / 2
        twice = STORED.resized(160, 120)
        assert fitting == replace(twice, width=120, cx=twice.cx - left, trust="approximate")

    def test_a_turned_and_cropped_frame(self):
        """A phone held upright: its screen shows the middle of the turned buffer."""
        says, (fitting,) = misfit(encoded(Image.fromarray(gradient(40, 80))), STORED)
        assert "swapped" in says
        assert "cropped" in says
        turned = oriented(STORED, *CLOCKWISE)
        assert fitting == replace(turned, width=40, cx=turned.cx - 10)

    def test_a_resized_photo(self):
        says, (fitting,) = misfit(encoded(Image.fromarray(gradient(160, 120))), STORED)
        assert "ratio of the widths" in says
        assert fitting == STORED.resized(160, 120)
