"""What a header tells of a camera: files by Pillow's EXIF writer, and hostile ones, put together here."""

from __future__ import annotations

import struct
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from service.photos import images
from service.photos.camera_identity import CameraIdentity, exif_focal_prior, identity_from_exif
from service.photos.images import open_photo

MAKE, MODEL, ORIENTATION, LENS = 0x010F, 0x0110, 0x0112, 0xA434
FOCAL, FOCAL_35, ZOOM, WIDTH, HEIGHT = 0x920A, 0xA405, 0xA404, 0xA002, 0xA003
PHONE = {FOCAL: 4.25, FOCAL_35: 26, ZOOM: 2.0, LENS: "back camera 4.25mm f/1.8", WIDTH: 80, HEIGHT: 60}


def jpeg(
    names: dict[int, object] | None = None,
    tags: dict[int, object] | None = None,
    size: tuple[int, int] = (80, 60),
    kind: str = "JPEG",
) -> bytes:
    exif = Image.Exif()
    exif.update(names or {})
    exif.get_ifd(0x8769).update(tags or {})
    stream = BytesIO()
    Image.new("RGB", size).save(stream, kind, exif=exif)
    return stream.getvalue()


def tiff(entries: list[tuple[int, int, int, bytes]]) -> bytes:
    """An EXIF block by hand: (tag, type, count, data), which need not fit each other; the first directory only."""
    head, after = b"MM\0*" + struct.pack(">IH", 8, len(entries)), b""
    start = len(head) + 12 * len(entries) + 4
    for tag, kind, count, data in entries:
        inside = data.ljust(4, b"\0") if len(data) <= 4 else struct.pack(">I", start + len(after))
        after += data if len(data) > 4 else b""
        head += struct.pack(">HHI", tag, kind, count) + inside
    return b"Exif\0\0" + head + struct.pack(">I", 0) + after


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP"])
def test_what_a_phone_writes_is_read_without_decoding(kind, monkeypatch):
    data = jpeg({MAKE: "Apple", MODEL: "iPhone 12", ORIENTATION: 6}, PHONE, kind=kind)
    monkeypatch.setattr(images, "_decode", None)
    monkeypatch.setattr(Image.Image, "load", None)
    assert open_photo(data).camera == CameraIdentity(
        width=80,
        height=60,
        orientation=6,
        make="Apple",
        model="iPhone 12",
        lens_model="back camera 4.25mm f/1.8",
        focal_length_mm=4.25,
        focal_35mm=26.0,
        digital_zoom=2.0,
        exif_width=80,
        exif_height=60,
    )


def test_a_heic_is_read_as_it_is_decoded():
    found = open_photo((Path(__file__).parent / "data" / "rotated.heic").read_bytes()).camera
    assert (found.width, found.height, found.orientation, found.focal_35mm) == (96, 128, 1, 26.0)


def test_without_exif_there_is_only_a_size():
    found = open_photo(jpeg()).camera
    assert found == CameraIdentity(80, 60)
    assert not found.is_named
    assert not found.is_cropped


@pytest.mark.parametrize(
    "value",
    [b"\xff\xfe\x00", "", "\0\0", (1, 2), [3], None, 7, {"a": 1}, "\x1b[31m", float("nan"), b"", object()],
)
def test_odd_values_are_left_out(value):
    everything = (MAKE, MODEL, LENS, FOCAL, FOCAL_35, ZOOM, WIDTH, HEIGHT)
    found = identity_from_exif(dict.fromkeys(everything, value), dict.fromkeys(everything, value), (80, 60), 1)
    assert all(text.isprintable() and len(text) <= 64 for text in (found.make, found.model, found.lens_model))
    assert found.focal_length_mm in (None, 3.0, 7.0)
    assert found.focal_35mm in (None, 7.0)
    assert found.digital_zoom in (1.0, 3.0, 7.0)
    assert found.exif_width in (None, 3, 7)
    hash(found)


def test_numbers_out_of_range_and_long_texts_are_left_out():
    tags = {FOCAL_35: 60_000, FOCAL: -4.0, ZOOM: 0.0, WIDTH: 0, HEIGHT: 60, LENS: "x" * 100_000}
    found = identity_from_exif({MAKE: "Apple\0hidden", MODEL: " padded  "}, tags, (80, 60), 1)
    assert (found.make, found.model, found.lens_model) == ("Apple", "padded", "x" * 64)
    assert (found.focal_35mm, found.focal_length_mm, found.digital_zoom) == (None, None, 1.0)
    assert (found.exif_width, found.exif_height) == (None, None)
    assert not found.is_cropped


@pytest.mark.parametrize(
    ("entry", "make"),
    [
        ((MAKE, 2, 6, b"Canon\0"), "Canon"),
        ((MAKE, 2, 9, b"\xc3\x84\x1b[1mX\0\0"), "Ã[1mX"),  # a text with control characters
        ((MAKE, 7, 5, b"Canon"), "Canon"),  # as bytes
        ((MAKE, 3, 1, b"\0\1"), ""),  # a number
        ((MAKE, 5, 1, struct.pack(">II", 1, 0)), ""),  # a fraction over zero
        ((MAKE, 2, 50_000, b"y" * 50_000), "y" * 64),
    ],
)
def test_a_make_of_any_type_is_a_short_text_or_none(entry, make):
    stream = BytesIO()
    Image.new("RGB", (80, 60)).save(stream, "JPEG", exif=tiff([entry]))
    assert open_photo(stream.getvalue()).camera.make == make


@pytest.mark.parametrize("size", [(4032, 3024), (3024, 4032), (1000, 750), (640, 480)])
def test_the_aspect_is_the_same_however_the_camera_was_held_and_the_photo_resized(size):
    assert CameraIdentity(*size).aspect == 1.33


@pytest.mark.parametrize(
    ("size", "cropped"),
    [
        ((4032, 3024), False),
        ((3024, 4032), False),  # turned, EXIF's size left
        ((1008, 756), False),  # resized
        ((63, 47), False),  # rounded to pixels
        ((2000, 1500), False),  # or cropped: nothing tells
        ((3024, 3024), True),
        ((4032, 2268), True),
        ((1500, 1200), True),
        ((5000, 3000), False),  # larger than EXIF says: that is of another photo
    ],
)
def test_a_crop_shows_in_the_shape(size, cropped):
    assert CameraIdentity(*size, exif_width=4032, exif_height=3024).is_cropped is cropped


def focal(mode) -> float:
    """In long sides of the photo."""
    return float(np.exp(mode.log_focal))


def test_the_first_value_lies_between_both_definitions():
    assert exif_focal_prior(CameraIdentity(4032, 3024)) == ()
    first, *_ = exif_focal_prior(CameraIdentity(4032, 3024, focal_35mm=26.0))
    by_width, by_diagonal = 26 / 36, 26 * 5040 / 43.2666 / 4032
    assert by_width < focal(first) < by_diagonal
    assert focal(first) == pytest.approx(np.sqrt(by_width * by_diagonal), rel=1e-4)
    for definition in (by_width, by_diagonal):
        assert abs(np.log(definition) - first.log_focal) < first.sigma
    # On 3:2 both are the same.
    first, *_ = exif_focal_prior(CameraIdentity(6000, 4000, focal_35mm=50.0))
    assert focal(first) == pytest.approx(50 / 36)
    assert first.sigma == pytest.approx(0.03)


def test_longer_focal_lengths_are_possible_and_shares_add_up():
    modes = exif_focal_prior(CameraIdentity(4032, 3024, focal_35mm=26.0))
    assert sum(mode.probability for mode in modes) == pytest.approx(1)
    assert modes[0].probability > 0.9
    assert modes[1].log_focal > modes[0].log_focal + 0.3


def test_a_digital_zoom_may_or_may_not_be_in_the_tag():
    modes = exif_focal_prior(CameraIdentity(4032, 3024, focal_35mm=26.0, digital_zoom=2.0))
    assert focal(modes[1]) == pytest.approx(2 * focal(modes[0]))
    assert modes[0].probability > modes[1].probability > 0.2


@pytest.mark.parametrize("size", [(3024, 3024), (2000, 3000), (4032, 1000)])
def test_the_focal_length_in_pixels_survives_a_crop(size):
    """By a simulated camera: 26 mm on 4032 pixels are as many pixels in any part of the photo."""
    first, *_ = exif_focal_prior(CameraIdentity(*size, focal_35mm=26.0, exif_width=4032, exif_height=3024))
    assert 26 / 36 * 4032 <= focal(first) * max(size) <= 26 / 36 * 4032 * 1.05


def test_a_small_crop_was_rather_resized():
    """1080 x 1080, as messengers send it: of the whole square in the middle of the frame, not of a ninth."""
    identity = CameraIdentity(1080, 1080, focal_35mm=26.0, exif_width=4032, exif_height=3024)
    first, *others = exif_focal_prior(identity)
    square = np.log(26 / 36 * 4032 / 3024)
    assert abs(square - first.log_focal) < 1.5 * first.sigma
    assert any(abs(np.log(26 / 36 * 4032 / 1080) - mode.log_focal) < mode.sigma for mode in others)


@pytest.mark.parametrize(("mm", "width"), [(26, 1_000_000), (2000, 9999)])
def test_a_tag_and_sizes_that_are_of_no_lens_say_nothing(mm, width):
    photo = open_photo(jpeg({}, {FOCAL_35: mm, WIDTH: width, HEIGHT: 700}, size=(400, 300)))
    assert photo.camera.is_cropped
    assert exif_focal_prior(photo.camera) == ()
    # It is not refused for intrinsics that nobody sent.
    assert photo.query().intrinsics_source == "guessed"
