"""Photos' bounds and geometry by values worked out by hand: intrinsics, reductions, masks, EXIF, sequences."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from io import BytesIO
from typing import Any

import numpy as np
import pytest
from PIL import Image

from service.errors import InvalidImage, InvalidIntrinsics, InvalidRequest
from service.photos import images
from service.photos.camera_identity import CameraIdentity, exif_focal_prior, identity_from_exif
from service.photos.images import (
    encode_image,
    open_photo,
    query_of,
    read_query,
    resized,
    undistorted_jpeg,
    with_focal_35mm,
    with_palette,
)
from service.photos.intrinsics import (
    distorted_pixels,
    has_distortion,
    intrinsics_from,
    oriented,
    require_size,
    taken_through,
    undistorted_points,
    undistorted_query,
)
from service.photos.jpeg_segments import scans_and_end
from service.photos.sequence import SequenceOptions, check_sequence, is_packed, packed, read_sequence, unpacked
from service.types import Intrinsics, IntrinsicsCorrection, Pose, Query

CAMERA = Intrinsics(640, 480, 500.0, 510.0, 330.0, 230.0)


def file(width: int, height: int, kind: str = "PNG", value: int = 100, **options: Any) -> bytes:
    stream = BytesIO()
    Image.new("RGB", (width, height), (value, value, value)).save(stream, kind, **options)
    return stream.getvalue()


# ------------------------------------------------------------------ intrinsics of turned photos


@pytest.mark.parametrize("turn", [(True, False, False), (False, True, False), (False, False, True), (True, True, True)])
@pytest.mark.parametrize(
    ("model", "distortion"),
    [("OPENCV", (-0.1, 0.05, 0.02, -0.03)), ("FULL_OPENCV", (-0.1, 0.05, 0.02, -0.03, 0.01, 0, 0, 0)),
     ("RADIAL", (-0.1, 0.05)), ("OPENCV_FISHEYE", (0.1, 0.02, 0.03, 0.04))],
)  # fmt: skip
def test_the_camera_of_a_turned_image_sees_turned_rays(turn, model, distortion):
    transpose, mirror_x, mirror_y = turn
    camera = replace(CAMERA, fy=500.0, model=model, distortion=distortion)
    rays = np.array([[0.3, -0.2, 1.0], [-0.25, 0.1, 1.0], [0.0, 0.4, 1.0]])
    px = distorted_pixels(rays, camera)
    turned = oriented(camera, *turn)
    if transpose:
        rays, px = rays[:, [1, 0, 2]], px[:, ::-1].copy()
    if mirror_x:
        rays = rays * [-1, 1, 1]
        px[:, 0] = turned.width - px[:, 0]
    if mirror_y:
        rays = rays * [1, -1, 1]
        px[:, 1] = turned.height - px[:, 1]
    assert (turned.width, turned.height) == ((480, 640) if transpose else (640, 480))
    assert distorted_pixels(rays, turned) == pytest.approx(px)


def hint(given: Intrinsics, width: int, height: int, *upright: bool) -> tuple[str, str, Any]:
    """The message, the hint, and the intrinsics that it tells."""
    with pytest.raises(InvalidIntrinsics) as caught:
        require_size(given, width, height, *([upright] if upright else []))  # type: ignore[arg-type]
    told = re.search(r"\{.*\}", caught.value.hint)
    assert told is not None
    return caught.value.message, caught.value.hint, json.loads(told[0])


def test_intrinsics_of_a_resized_photo_are_scaled():
    message, text, fitting = hint(CAMERA, 320, 240)
    assert message == "they are for 640 x 480, the upright photo has 320 x 240."
    assert text.startswith("Scale all of them by the ratio of the widths")
    assert fitting == {"width": 320, "height": 240, "fx": 250.0, "fy": 255.0, "cx": 165.0, "cy": 115.0}
    # A hundredth of the width times the height may be off by rounding; 320 x 243 isn't.
    assert "cropped" not in hint(CAMERA, 320, 242)[1]
    assert "cropped" in hint(CAMERA, 320, 243)[1]
    assert "cropped" in hint(CAMERA, 320, 237)[1]
    require_size(CAMERA, 640, 480)


def test_intrinsics_of_a_cropped_photo_are_scaled_to_cover_it():
    """To 320 x 480: as high as before, 160 pixels less on both sides."""
    _, text, fitting = hint(replace(CAMERA, trust="approximate"), 320, 480)
    assert text.startswith("Either they are of the camera's buffer")  # which is wide, the photo is tall
    _, text, fitting = hint(replace(CAMERA, model="RADIAL", fy=500.0, distortion=(0.1, 0.2)), 640, 240)
    assert text.startswith("The photo was cropped to another shape.")
    assert fitting == {
        "width": 640, "height": 240, "fx": 500.0, "fy": 500.0, "cx": 330.0, "cy": 110.0, "model": "RADIAL",
        "distortion": [0.1, 0.2],
    }  # fmt: skip
    _, _, fitting = hint(replace(CAMERA, trust="approximate"), 320, 300)
    # 320 x 240 would not cover it: 400 x 300, of which 40 on both sides go.
    assert fitting == {
        "width": 320, "height": 300, "fx": 312.5, "fy": 318.75, "cx": 166.25, "cy": 143.75, "trust": "approximate"
    }  # fmt: skip


def test_intrinsics_of_a_turned_buffer_are_turned():
    """Turned clockwise the buffer's x is the photo's y from above, and its y the photo's x from the right."""
    message, text, fitting = hint(CAMERA, 480, 640)
    assert message.startswith("width and height are swapped: ")
    assert fitting == {"width": 480, "height": 640, "fx": 510.0, "fy": 500.0, "cx": 250.0, "cy": 330.0}
    assert "(230, 310 at 480 x 640)" in text  # the other way
    _, text, fitting = hint(CAMERA, 480, 640, True, False, True)
    assert text.startswith("They are of the camera's buffer, before the photo was turned")
    assert fitting == {"width": 480, "height": 640, "fx": 510.0, "fy": 500.0, "cx": 230.0, "cy": 310.0}
    assert "swapped" not in hint(CAMERA, 500, 500)[0]


def test_numbers_have_bounds():
    good = {"width": 640, "height": 480, "fx": 500, "fy": 500, "cx": 320, "cy": 240}
    assert intrinsics_from(good | {"cx": 9.9e11}).cx == 9.9e11
    for key, value in (("cx", 1e12), ("cy", -1e12)):
        with pytest.raises(InvalidIntrinsics, match="must be a finite number"):
            intrinsics_from(good | {key: value})
    for focal in ({"fx": 1e6, "fy": 1e6}, {"fx": 1e3, "fy": 1e6}):
        assert intrinsics_from(good | focal | {"trust": "approximate"}).fy == 1e6
    for focal in ({"fx": 1.01e6}, {"fy": 1.01e6}):
        with pytest.raises(InvalidIntrinsics, match="at most 1e"):
            intrinsics_from(good | focal | {"trust": "approximate"})


# ------------------------------------------------------------------ distortion


@pytest.mark.parametrize("k1", [-0.15, 0.2])
def test_points_are_where_the_straight_image_has_them(k1):
    rays = np.array([[0.3, -0.2, 1.0], [-0.25, 0.1, 1.0], [0.0, 0.4, 1.0], [0.0, 0.0, 1.0]])
    lens = replace(CAMERA, model="OPENCV", distortion=(k1, 0.0, 0.0, 0.0))
    found = undistorted_points(distorted_pixels(rays, lens).astype(np.float32), lens)
    assert found == pytest.approx(rays[:, :2] * [500, 510] + [330, 230], abs=1e-3)
    assert has_distortion(lens)
    assert has_distortion(replace(CAMERA, model="OPENCV_FISHEYE", distortion=(0.0, 0.0, 0.0, 0.0)))
    assert not has_distortion(replace(lens, distortion=(0.0, 0.0, 0.0, 0.0)))


def masked() -> Query:
    """A grey photo whose left quarter is no photo."""
    mask = np.ones((48, 64), bool)
    mask[:, :16] = False
    camera = Intrinsics(64, 48, 50.0, 50.0, 32.0, 24.0, trust="approximate")
    return Query(np.full((48, 64, 3), 200, np.uint8), camera, "guessed", camera, valid_mask=mask)


def test_what_is_no_photo_stays_none_when_it_is_undistorted():
    query = masked()
    assert undistorted_query(query, IntrinsicsCorrection(1.1)).rgb is query.rgb
    # Pincushion distortion: the corners of the straight image lie beyond the photo's.
    straight = undistorted_query(query, IntrinsicsCorrection(k1=0.2))
    assert straight.valid_mask is not None
    assert straight.valid_mask[24, 20:60].all()
    assert not straight.valid_mask[:, :15].any()
    assert not straight.valid_mask[0, 63]
    alone = undistorted_query(replace(query, valid_mask=None), IntrinsicsCorrection(k1=0.2))
    assert alone.valid_mask is not None
    assert alone.valid_mask[24, 5]


def test_a_fisheye_of_the_whole_photo_is_one_of_the_reduced_photo_too():
    """The query has half of the photo's pixels, and begins 4 of its pixels to the right and 2 below."""
    shown = Intrinsics(64, 48, 50.0, 50.0, 28.0, 22.0, trust="approximate")
    photo = Intrinsics(128, 96, 100.0, 100.0, 64.0, 48.0, trust="approximate")
    query = replace(masked(), intrinsics=shown, photo_intrinsics=photo)
    lens = Intrinsics(128, 96, 80.0, 80.0, 70.0, 44.0, "OPENCV_FISHEYE", (0.01, 0.0, 0.0, 0.0))
    found = taken_through(query, lens)
    camera = found.intrinsics
    assert (camera.model, camera.width, camera.height) == ("PINHOLE", 64, 48)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (40.0, 40.0, 31.0, 20.0)
    assert (found.intrinsics_source, found.photo_intrinsics) == ("fisheye", lens)
    assert found.lens_prior is not None
    assert found.lens_prior.log_focal_scale == 0.05
    assert found.valid_mask is not None
    assert found.valid_mask[20, 31]
    assert not found.valid_mask[20, 2]
    # Where nothing was cut off there is no mask.
    narrow = replace(lens, fx=8000.0, fy=8000.0)
    assert taken_through(replace(query, valid_mask=None), narrow).valid_mask is None


def test_a_mask_and_a_lens_leave_what_both_leave():
    rgba = np.full((60, 80, 4), 255, np.uint8)
    rgba[:, :20, 3] = 0
    stream = BytesIO()
    Image.fromarray(rgba).save(stream, "PNG")
    lens = Intrinsics(80, 60, 60.0, 60.0, 40.0, 30.0, "SIMPLE_RADIAL", (0.2,))
    mask = read_query(stream.getvalue(), intrinsics=lens).valid_mask
    assert mask is not None
    assert mask[30, 25:70].all()
    assert not mask[:, :18].any()
    assert not mask[0, 79]


def test_our_own_jpegs_are_undistorted():
    grey = encode_image(np.full((60, 80, 3), 200, np.uint8))
    lens = Intrinsics(80, 60, 60.0, 60.0, 40.0, 30.0, "SIMPLE_RADIAL", (0.2,))
    rgb = np.asarray(Image.open(BytesIO(undistorted_jpeg(grey, lens))))
    assert rgb[30, 40].min() > 195
    assert rgb[0, 0].max() < 20


# ------------------------------------------------------------------ reductions


@pytest.mark.parametrize(("width", "kept"), [(1000, 1000), (1300, 1300), (1301, 1000), (2600, 1000)])
def test_photos_up_to_a_third_too_large_are_kept(width, kept):
    rgb = np.zeros((width // 20, width, 3), np.uint8)
    found = query_of(rgb, intrinsics=Intrinsics(width, width // 20, 800.0, 800.0, width / 2, width / 40))
    assert found.rgb.shape[1] == kept
    assert found.intrinsics.fx == pytest.approx(800 * kept / width)
    assert found.intrinsics.cx == pytest.approx(kept / 2)
    assert read_query(file(width, width // 20)).rgb.shape[1] == kept


@pytest.mark.parametrize(
    ("size", "fits"),
    [((1000, 32), True), ((32, 32), True), ((31, 400), False), ((2000, 63), True), ((2000, 62), False)],
)
def test_the_short_side_has_32_pixels_once_the_long_one_has_1000(size, fits):
    if fits:
        query_of(np.zeros((size[1], size[0], 3), np.uint8))
    else:
        with pytest.raises(InvalidImage, match="short side must have 32 pixels when the long one has at most 1000"):
            query_of(np.zeros((size[1], size[0], 3), np.uint8))


@pytest.mark.parametrize(("alpha", "valid"), [(128, True), (127, False), (0, False)])
def test_half_opaque_pixels_are_valid(alpha, valid):
    rgba = np.full((60, 80, 4), 255, np.uint8)
    rgba[40:, :, 3] = alpha
    stream = BytesIO()
    Image.fromarray(rgba).save(stream, "PNG")
    found = read_query(stream.getvalue())
    assert found.valid_mask is not None
    assert found.valid_mask[:40].all()
    assert found.valid_mask[40:].all() == found.valid_mask[40:].any() == valid


def test_a_photo_is_converted_band_by_band(monkeypatch):
    """Bands of three rows; only the last one is transparent."""
    monkeypatch.setattr(images, "DEFAULTS", replace(images.DEFAULTS, band_pixels=3 * 80))
    rgba = np.random.default_rng(0).integers(0, 255, (61, 80, 4), np.uint8)
    rgba[..., 3] = 255
    rgba[60, :, 3] = 0
    stream = BytesIO()
    Image.fromarray(rgba).save(stream, "PNG")
    found = read_query(stream.getvalue(), background_rgb=(1.0, 0.5, 0.0))
    assert np.array_equal(found.rgb[:60], rgba[:60, :, :3])
    assert found.rgb[60, 0].tolist() == [255, 128, 0]
    assert found.valid_mask is not None
    assert found.valid_mask.sum() == 60 * 80
    assert found.warnings[0] == "Transparent parts of the photo are ignored."
    for plain in (read_query(stream.getvalue()), open_photo(stream.getvalue()).query()):
        assert plain.rgb[60, 0].tolist() == [0, 0, 0]


@pytest.mark.parametrize(("scans", "read"), [(24, True), (25, False)])
def test_a_progressive_jpeg_has_24_scans_at_most(monkeypatch, scans, read):
    monkeypatch.setattr(images, "scans_and_end", lambda data: (scans, True))
    if read:
        open_photo(file(64, 48, "JPEG"))
    else:
        with pytest.raises(InvalidImage, match="a JPEG of 25 scans; the limit is 24"):
            open_photo(file(64, 48, "JPEG"))
    open_photo(file(64, 48, "PNG"))


def test_scans_are_counted_by_their_markers():
    assert scans_and_end(file(64, 48, "JPEG")) == (1, True)
    assert scans_and_end(file(64, 48, "JPEG", progressive=True))[0] > 3


def test_images_are_encoded_with_their_colours_and_opacity():
    rgb = np.float32([[[0.0, 0.5, 1.5], [-1.0, 0.25, 1.0]]]).repeat(8, 0).repeat(8, 1)
    found = np.asarray(Image.open(BytesIO(encode_image(rgb, "png"))))
    assert found[0, 0].tolist() == [0, 128, 255]
    assert found[0, 8].tolist() == [0, 64, 255]
    rgba = np.full((4, 4, 4), (10, 20, 30, 40), np.uint8)
    assert np.asarray(Image.open(BytesIO(encode_image(rgba, "png"))))[0, 0].tolist() == [10, 20, 30, 40]
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)
    sizes = [len(encode_image(noise, quality=quality)) for quality in (20, 90)]
    assert sizes[0] < sizes[1] == len(encode_image(noise))
    small = with_palette(encode_image(noise, "png"))
    assert Image.open(BytesIO(small)).mode == "P"
    assert len(small) < 0.6 * len(encode_image(noise, "png"))


def test_a_focal_length_is_written_where_it_is_read():
    plain = encode_image(np.zeros((60, 80, 3), np.uint8))
    assert open_photo(with_focal_35mm(plain, 31)).camera.focal_35mm == 31
    assert open_photo(plain).camera.focal_35mm is None


def test_images_shrink_by_averages_and_grow_smoothly():
    stripes = np.zeros((8, 8, 3), np.float32)
    stripes[:, ::2] = 1
    assert resized(stripes, 4, 8) == pytest.approx(np.full((8, 4, 3), 0.5))
    grown = resized(np.float32([[[0, 0, 0], [1, 1, 1]]] * 2), 8, 2)
    assert np.diff(grown[0, :, 0]).max() <= 0.26


# ------------------------------------------------------------------ EXIF


def test_the_likeliest_focal_lengths_have_their_shares():
    plain = exif_focal_prior(CameraIdentity(6000, 4000, focal_35mm=36.0))
    assert [(mode.log_focal, mode.sigma, mode.probability) for mode in plain] == [
        pytest.approx((0.0, 0.03, 0.92)), pytest.approx((0.4, 0.3, 0.08)),
    ]  # fmt: skip
    zoomed = exif_focal_prior(CameraIdentity(6000, 4000, focal_35mm=36.0, digital_zoom=2.0))
    tag = 0.92 * 0.7
    assert [mode.probability for mode in zoomed] == pytest.approx(np.array([tag, 0.3, 0.08]) / (tag + 0.38))
    assert zoomed[1].log_focal == pytest.approx(np.log(2))


@pytest.mark.parametrize(("side", "probability"), [(2000, 0.3), (1999, 0.8)])
def test_a_crop_to_less_than_half_was_rather_resized(side, probability):
    identity = CameraIdentity(side, side, focal_35mm=36.0, exif_width=6000, exif_height=4000)
    modes = exif_focal_prior(identity)
    tag = 0.92 * (1 - probability)
    total = tag + 0.08 + probability
    resampled = next(mode for mode in modes if mode.probability == pytest.approx(probability / total))
    # Between the whole long side and a part as long as the short side: 36 mm are 1 and 1.5 of those.
    assert np.exp(resampled.log_focal) == pytest.approx(np.sqrt(1.0 * 1.5))
    assert resampled.sigma == pytest.approx(np.log(1.5) / 2 + 0.03)


@pytest.mark.parametrize(("width", "known"), [(1060, True), (1100, False)])
def test_no_lens_is_longer_than_a_hundred_photos(width, known):
    """2000 mm of a frame of 1080 pixels are 100 long sides of a photo of 600."""
    identity = CameraIdentity(600, 600, focal_35mm=2000.0, exif_width=width, exif_height=700)
    assert bool(exif_focal_prior(identity)) is known


FOCAL, FOCAL_35, ZOOM, WIDTH, HEIGHT = 0x920A, 0xA405, 0xA404, 0xA002, 0xA003


@pytest.mark.parametrize(
    ("tag", "value", "field", "expected"),
    [
        (FOCAL, 0.1, "focal_length_mm", 0.1), (FOCAL, 0.09, "focal_length_mm", None),
        (FOCAL, 10_000, "focal_length_mm", 10_000), (FOCAL, 10_001, "focal_length_mm", None),
        (FOCAL, 4.256, "focal_length_mm", 4.26),
        (FOCAL_35, 4, "focal_35mm", 4), (FOCAL_35, 3.9, "focal_35mm", None),
        (FOCAL_35, 2000, "focal_35mm", 2000), (FOCAL_35, 2001, "focal_35mm", None),
        (ZOOM, 200, "digital_zoom", 200), (ZOOM, 201, "digital_zoom", 1), (ZOOM, 0.5, "digital_zoom", 1),
        (ZOOM, 1.234, "digital_zoom", 1.23),
    ],
)  # fmt: skip
def test_exif_numbers_have_the_range_of_lenses(tag, value, field, expected):
    assert getattr(identity_from_exif({}, {tag: value}, (80, 60), 1), field) == expected


@pytest.mark.parametrize(("width", "expected"), [(1, 1), (1_000_000, 1_000_000), (1_000_001, None), (0.5, None)])
def test_exif_sizes_are_those_of_photos(width, expected):
    found = identity_from_exif({}, {WIDTH: width, HEIGHT: 60}, (80, 60), 1)
    assert (found.exif_width, found.exif_height) == (expected, expected and 60)


@pytest.mark.parametrize(("height", "cropped"), [(3024, False), (2994, False), (2990, True), (3025, False)])
def test_a_shape_within_a_hundredth_is_no_crop(height, cropped):
    """And what rounding to whole pixels does: 1/2994 here."""
    assert CameraIdentity(4032, height, exif_width=4032, exif_height=3024).is_cropped is cropped
    assert not CameraIdentity(4032, height, exif_width=4032).is_cropped
    assert not CameraIdentity(4032, height, exif_height=3024).is_cropped
    assert CameraIdentity(4032, height, make="Canon").is_named
    assert CameraIdentity(4032, height, model="EOS").is_named


# ------------------------------------------------------------------ sequences


def sequence(count: int, size: tuple[int, int] = (64, 48), **odd: bytes) -> bytes:
    return packed([(f"{i}.png", odd.get(f"n{i}") or file(*size)) for i in range(count)])


def test_a_sequence_keeps_names_times_and_the_first_pose():
    data = sequence(4)
    assert is_packed(data)
    assert [name for name, _ in unpacked(data)] == ["0.png", "1.png", "2.png", "3.png"]
    prior = Pose(np.eye(4))
    options = SequenceOptions(2, every=2, times_s=[0.5, 1.0, 2.5, 3.0], prior=prior)
    check_sequence(data, options)
    found = list(read_sequence(data, options))
    assert [(photo.name, photo.time_s) for photo in found] == [("0.png", 0.5), ("2.png", 2.5)]
    assert [photo.query.prior for photo in found] == [prior, None]
    plain = list(read_sequence(data, SequenceOptions(4)))
    assert [photo.time_s for photo in plain] == [0.0, 1.0, 2.0, 3.0]
    assert (plain[0].camera.width, plain[0].camera.height) == (64, 48)


def test_photos_of_a_sequence_are_832_pixels_long():
    (photo,) = read_sequence(sequence(1, (1664, 64)), SequenceOptions(1))
    assert photo.query.rgb.shape == (32, 832, 3)


def test_a_sequence_has_as_many_photos_and_times_as_it_may():
    data = sequence(5)
    for limit, every, fits in ((5, 1, True), (4, 1, False), (3, 2, True), (2, 2, False), (2, 3, True)):
        options = SequenceOptions(limit, every=every)
        if fits:
            check_sequence(data, options)
            assert len(list(read_sequence(data, options))) == -(-5 // every)
        else:
            for call in (check_sequence, lambda *given: list(read_sequence(*given))):
                with pytest.raises(InvalidImage, match=f"may have {limit} photos"):
                    call(data, options)
    for times in ([0.0] * 4, [0.0] * 6):
        with pytest.raises(InvalidRequest, match=f"{len(times)} times for 5 photos"):
            check_sequence(data, SequenceOptions(5, times_s=times))


def test_photos_of_a_sequence_have_one_size_but_for_those_that_are_skipped():
    data = sequence(4, n1=file(48, 64), n3=b"broken")
    check_sequence(data, SequenceOptions(4, every=2))
    for call in (check_sequence, lambda *given: list(read_sequence(*given))):
        with pytest.raises(InvalidImage, match="has 48 x 64 pixels, the first one 64 x 48") as caught:
            call(data, SequenceOptions(4))
        assert caught.value.where == "photo.1"
