"""Photos: every format, depth and orientation, the geometry of what comes out, and broken files."""

import struct
import time
import zlib
from contextlib import nullcontext, suppress
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import ExifTags, Image, ImageOps

from service.errors import InvalidImage, InvalidIntrinsics
from service.photos import images
from service.photos.images import photo_size, read_query
from service.photos.intrinsics import DISTORTION_COUNTS, intrinsics_from, undistorted
from service.types import Intrinsics, Pose

DATA = Path(__file__).parent / "data"


def encoded(image: Image.Image, kind: str = "PNG", **options) -> bytes:
    stream = BytesIO()
    image.save(stream, kind, **options)
    return stream.getvalue()


def gradient(width=80, height=60) -> np.ndarray:
    rows, columns = np.mgrid[:height, :width]
    blue = np.full_like(rows, 64)
    return np.stack([columns * 255 // (width - 1), rows * 255 // (height - 1), blue], -1).astype(np.uint8)


def exif_with(
    orientation: int | None = None, focal_35mm: float | None = None, size: tuple[int, int] | None = None
) -> bytes:
    exif = Image.Exif()
    if orientation is not None:
        exif[ExifTags.Base.Orientation] = orientation
    if focal_35mm is not None:
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = focal_35mm
    if size is not None:
        tags = exif.get_ifd(ExifTags.IFD.Exif)
        tags[ExifTags.Base.ExifImageWidth], tags[ExifTags.Base.ExifImageHeight] = size
    return exif.tobytes()


def png(width: int, height: int, *chunks: tuple[bytes, bytes], data: bytes = b"") -> bytes:
    """A PNG by hand: the header may promise anything."""
    parts = [(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)), *chunks]
    parts += [(b"IDAT", zlib.compress(data)), (b"IEND", b"")]
    body = b"".join(struct.pack(">I", len(d)) + n + d + struct.pack(">I", zlib.crc32(n + d)) for n, d in parts)
    return b"\x89PNG\r\n\x1a\n" + body


class TestFormats:
    @pytest.mark.parametrize(
        ("kind", "options", "tolerance"),
        # Seen: 0 without loss; 3 for JPEG and 5 for WebP at these settings.
        [
            ("PNG", {}, 0),
            ("JPEG", {"quality": 100, "subsampling": 0}, 4),
            ("WEBP", {"quality": 100}, 6),
            ("WEBP", {"lossless": True}, 0),
        ],
    )
    def test_pixels(self, kind, options, tolerance):
        pixels = gradient()
        query = read_query(encoded(Image.fromarray(pixels), kind, **options))
        assert query.rgb.dtype == np.uint8
        assert np.abs(query.rgb.astype(int) - pixels).max() <= tolerance
        assert not query.rgb.flags.writeable

    def test_heic_is_upright_and_has_its_focal_length(self):
        query = read_query((DATA / "rotated.heic").read_bytes())
        expected = np.rot90(gradient(128, 96), -1)  # orientation 6: turned clockwise
        assert query.rgb.shape == (128, 96, 3)
        assert np.abs(query.rgb.astype(int) - expected).max() <= 6  # seen: 4
        assert query.intrinsics_source == "exif"
        assert query.intrinsics.fx == pytest.approx(between_definitions(26, 128))

    @pytest.mark.parametrize("mode", ["L", "P", "CMYK", "1", "LA", "RGBA"])
    def test_modes_become_rgb(self, mode):
        image = Image.fromarray(gradient()).convert(mode)
        query = read_query(encoded(image, "JPEG" if mode == "CMYK" else "PNG"))
        expected = np.asarray(image.convert("RGB")).astype(int)
        assert np.abs(query.rgb - expected).mean() < 0.6  # seen: 0.28 for CMYK through JPEG, 0 for the rest

    def test_16_bit_gray_keeps_its_high_byte(self):
        deep = (np.arange(64 * 64).reshape(64, 64) * 16).astype(np.uint16)
        query = read_query(encoded(Image.fromarray(deep)))
        assert np.array_equal(query.rgb[..., 0], deep >> 8)

    def test_transparent_parts_take_the_background(self):
        rgba = np.zeros((40, 40, 4), np.uint8)
        rgba[:, :20] = [200, 100, 50, 255]
        rgba[:, 30:] = [255, 255, 255, 128]
        data = encoded(Image.fromarray(rgba))
        black, white = read_query(data), read_query(data, background_rgb=(1.0, 1.0, 1.0))
        assert black.rgb[5, 25].tolist() == [0, 0, 0]
        assert white.rgb[5, 25].tolist() == [255, 255, 255]
        assert white.rgb[5, 5].tolist() == [200, 100, 50]
        assert abs(int(black.rgb[5, 35, 0]) - 128) <= 1
        assert any("ransparent" in warning for warning in black.warnings)

    def test_opaque_alpha_is_no_warning(self):
        data = encoded(Image.fromarray(gradient()).convert("RGBA"), exif=exif_with(focal_35mm=30))
        assert read_query(data).warnings == ()


class TestOrientation:
    @pytest.mark.parametrize("orientation", range(1, 9))
    def test_same_as_pillow(self, orientation):
        data = encoded(Image.fromarray(gradient()), exif=exif_with(orientation))
        expected = np.asarray(ImageOps.exif_transpose(Image.open(BytesIO(data))))
        query = read_query(data)
        assert np.array_equal(query.rgb, expected)
        assert (query.photo_intrinsics.height, query.photo_intrinsics.width) == expected.shape[:2]

    @pytest.mark.parametrize("orientation", [0, 9, 200])
    def test_nonsense_is_ignored(self, orientation):
        data = encoded(Image.fromarray(gradient()), exif=exif_with(orientation))
        assert np.array_equal(read_query(data).rgb, gradient())

    def test_size_of_the_upright_photo(self, tmp_path):
        file = tmp_path / "photo.jpg"
        file.write_bytes(encoded(Image.fromarray(gradient()), "JPEG", exif=exif_with(8)))
        assert photo_size(file.read_bytes()) == (60, 80)


def spots(camera: Intrinsics, rays: np.ndarray, to_pixel, size: tuple[int, int]) -> np.ndarray:
    """A photo with a smooth bright spot where each ray hits, anti-aliased: a centroid finds it to 0.01 px."""
    width, height = size
    photo = np.zeros((height, width))
    radius = 0.012 * max(size)
    for x, y in to_pixel(rays, camera):
        left, top = int(x - 4 * radius), int(y - 4 * radius)
        rows, columns = np.mgrid[top : int(y + 4 * radius), left : int(x + 4 * radius)]
        spot = np.exp(-((columns + 0.5 - x) ** 2 + (rows + 0.5 - y) ** 2) / (2 * radius**2))
        photo[rows, columns] = np.maximum(photo[rows, columns], 250 * spot)
    return np.repeat(np.rint(photo).astype(np.uint8)[:, :, None], 3, axis=2)


def centroid(rgb: np.ndarray, near: np.ndarray, reach: int) -> np.ndarray:
    x, y = near.astype(int)
    window = rgb[y - reach : y + reach, x - reach : x + reach, 1].astype(float)
    window = np.where(window > 12, window, 0)
    rows, columns = np.mgrid[y - reach : y + reach, x - reach : x + reach]
    return np.array([(window * (columns + 0.5)).sum(), (window * (rows + 0.5)).sum()]) / window.sum()


def pinhole(rays, camera):
    return rays * [camera.fx, camera.fy] + [camera.cx, camera.cy]


RAYS = np.array([[-0.42, -0.25], [0.4, -0.28], [0.05, 0.02], [-0.35, 0.27], [0.43, 0.26]])


SMALL = 200
"""JPEG's reduced decode starts at 400 then."""


class TestGeometry:
    """A spot on a ray must appear where `Query.intrinsics` project that ray, whatever happened to the pixels."""

    @pytest.mark.parametrize("kind", ["JPEG", "PNG"])
    @pytest.mark.parametrize("size", [(160, 120), (249, 187), (413, 275), (827, 551), (1655, 1103)])
    def test_reduction_keeps_rays(self, kind, size):
        width, height = size
        camera = Intrinsics(width, height, 1.0 * width, 0.98 * width, 0.51 * width, 0.49 * height)
        photo = Image.fromarray(spots(camera, RAYS, pinhole, size))
        options = {"quality": 95} if kind == "JPEG" else {"compress_level": 1}
        query = read_query(encoded(photo, kind, **options), intrinsics=camera, long_side=SMALL)
        assert min(SMALL, width) <= max(query.rgb.shape) <= min(images.DEFAULTS.oversize * SMALL, width)
        for ray, expected in zip(RAYS, pinhole(RAYS, query.intrinsics), strict=True):
            found = centroid(query.rgb, expected, int(0.04 * query.rgb.shape[1]))
            # Seen: 0.027; 0.46 if the reduced width were taken for the exact half of an odd one.
            assert np.abs(found - expected).max() < 0.05, ray

    @pytest.mark.parametrize("orientation", range(1, 9))
    def test_orientation_keeps_rays_through_a_reduced_decode(self, orientation):
        upright_size = (551, 827) if orientation > 4 else (827, 551)
        width, height = upright_size
        camera = Intrinsics(width, height, 750.0, 750.0, width / 2 + 9, height / 2 - 7)
        rays = RAYS * [0.7, 0.9] if width > height else RAYS[:, ::-1] * [0.9, 0.7]
        upright = Image.fromarray(spots(camera, rays, pinhole, upright_size))
        back = {2: 0, 3: 3, 4: 1, 5: 5, 6: 2, 7: 6, 8: 4}  # Pillow's transpositions that undo the orientation
        stored = upright.transpose(Image.Transpose(back[orientation])) if orientation > 1 else upright
        data = encoded(stored, "JPEG", quality=95, exif=exif_with(orientation))
        query = read_query(data, intrinsics=camera, long_side=SMALL)
        for expected in pinhole(rays, query.intrinsics):
            found = centroid(query.rgb, expected, 8)
            assert np.abs(found - expected).max() < 0.05  # seen: 0.019


class TestDistortion:
    @pytest.mark.parametrize(
        ("model", "distortion"),
        [
            ("SIMPLE_RADIAL", (-0.12,)),
            ("RADIAL", (-0.2, 0.08)),
            ("OPENCV", (-0.15, 0.04, 0.003, -0.002)),
            ("FULL_OPENCV", (0.1, -0.05, 0.002, 0.001, 0.01, 0.2, -0.02, 0.003)),
            ("SIMPLE_RADIAL_FISHEYE", (0.04,)),
            ("RADIAL_FISHEYE", (-0.03, 0.01)),
            ("OPENCV_FISHEYE", (0.02, -0.01, 0.004, -0.001)),
        ],
    )
    def test_undistortion_puts_spots_on_their_rays(self, model, distortion):
        size = (800, 600)
        camera = Intrinsics(*size, 700.0, 690.0 if "OPENCV" in model else 700.0, 407.0, 293.0, model, distortion)
        photo = spots(camera, RAYS, colmap_pixels, size)
        query = read_query(encoded(Image.fromarray(photo)), intrinsics=camera)
        assert query.intrinsics.model == "PINHOLE"
        assert query.photo_intrinsics == camera
        moved = np.abs(colmap_pixels(RAYS, camera) - pinhole(RAYS, camera)).max()
        assert moved > 2, "the distortion must matter for the test to say something"
        for expected in pinhole(RAYS, query.intrinsics):
            found = centroid(query.rgb, expected, 30)
            # Seen: 0.26, because an undistorted round spot is not quite round; half a pixel would show.
            assert np.abs(found - expected).max() < 0.3

    def test_distortion_by_its_formula_at_every_pixel(self):
        """A photo whose colours are its own pixel coordinates tells where each pixel was taken from."""
        size = 240, 180
        camera = Intrinsics(*size, 200.0, 200.0, 121.0, 88.0, "OPENCV", (-0.15, 0.04, 0.003, -0.002))
        rows, columns = np.mgrid[: size[1], : size[0]]
        coordinates = np.stack([columns, rows, np.zeros_like(rows)], -1).astype(np.uint8)
        rgb, straight, _ = undistorted(coordinates, camera)
        x, y = (columns + 0.5 - straight.cx) / straight.fx, (rows + 0.5 - straight.cy) / straight.fy
        taken = colmap_pixels(np.stack([x, y], -1).reshape(-1, 2), camera).reshape(*size[::-1], 2) - 0.5
        inside = (taken > 2).all(-1) & (taken < np.array(size) - 3).all(-1)
        assert inside.mean() > 0.9
        error = np.abs(rgb[..., :2] - taken)[inside]
        assert error.max() < 0.56  # 0.5 is the rounding to uint8
        assert abs((rgb[..., :2] - taken)[inside].mean()) < 0.02  # a half-pixel mistake would be 0.5

    def test_what_the_polynomial_folds_back_is_black(self):
        camera = Intrinsics(400, 300, 150.0, 150.0, 200.0, 150.0, "SIMPLE_RADIAL", (-0.25,))
        rgb, *_ = undistorted(np.full((300, 400, 3), 200, np.uint8), camera)
        # r (1 - r^2 / 4) grows up to r = sqrt(4 / 3).
        assert rgb[150, int(200 + 150 * 1.1)].min() > 150
        assert rgb[150, int(200 + 150 * 1.2)].max() == 0

    def test_no_distortion_leaves_the_pixels(self):
        camera = Intrinsics(80, 60, 50.0, 50.0, 40.0, 30.0, "OPENCV", (0.0, 0.0, 0.0, 0.0))
        rgb, straight, _ = undistorted(gradient(), camera)
        assert np.array_equal(rgb, gradient())
        assert straight.model == "PINHOLE"


def colmap_pixels(rays: np.ndarray, camera: Intrinsics) -> np.ndarray:
    """COLMAP's documented equations, written out model by model."""
    u, v = rays.T
    r = np.hypot(u, v)
    d = camera.distortion
    if camera.model.endswith("FISHEYE"):
        theta = np.arctan(r)
        k = (*d, 0.0, 0.0, 0.0)[:4]
        bent = theta * (1 + k[0] * theta**2 + k[1] * theta**4 + k[2] * theta**6 + k[3] * theta**8)
        u, v = u * bent / np.maximum(r, 1e-12), v * bent / np.maximum(r, 1e-12)
    elif camera.model in ("SIMPLE_RADIAL", "RADIAL"):
        k1, k2 = (*d, 0.0)[:2]
        factor = 1 + k1 * r**2 + k2 * r**4
        u, v = u * factor, v * factor
    else:
        k1, k2, p1, p2, k3, k4, k5, k6 = (*d, 0.0, 0.0, 0.0, 0.0)[:8]
        factor = (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) / (1 + k4 * r**2 + k5 * r**4 + k6 * r**6)
        du = 2 * p1 * u * v + p2 * (r**2 + 2 * u**2)
        dv = 2 * p2 * u * v + p1 * (r**2 + 2 * v**2)
        u, v = u * factor + du, v * factor + dv
    return np.stack([camera.fx * u + camera.cx, camera.fy * v + camera.cy], 1)


def between_definitions(focal_35mm: float, long_side: int) -> float:
    """The focal length in pixels of a 4:3 photo, between those by the width (36 mm) and by the diagonal (43.27 mm)."""
    by_width, by_diagonal = focal_35mm / 36 * long_side, focal_35mm / 43.2666 * 1.25 * long_side
    return float(np.sqrt(by_width * by_diagonal))


COLMAP_PARAMETERS = {
    "SIMPLE_PINHOLE": "f, cx, cy",
    "PINHOLE": "fx, fy, cx, cy",
    "SIMPLE_RADIAL": "f, cx, cy, k",
    "RADIAL": "f, cx, cy, k1, k2",
    "OPENCV": "fx, fy, cx, cy, k1, k2, p1, p2",
    "OPENCV_FISHEYE": "fx, fy, cx, cy, k1, k2, k3, k4",
    "FULL_OPENCV": "fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6",
    "FOV": "fx, fy, cx, cy, omega",
    "SIMPLE_RADIAL_FISHEYE": "f, cx, cy, k",
    "RADIAL_FISHEYE": "f, cx, cy, k1, k2",
    "THIN_PRISM_FISHEYE": "fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, sx1, sy1",
}
"""Camera models by their number -> their parameters, as `src/colmap/sensor/models.h` of COLMAP lists them."""
WITHOUT = {"FOV", "THIN_PRISM_FISHEYE"}
"""Models that photos can't have here."""


class TestCameraModels:
    def test_all_are_known(self):
        assert set(DISTORTION_COUNTS) == set(COLMAP_PARAMETERS) - WITHOUT

    @pytest.mark.parametrize("model", [m for m in COLMAP_PARAMETERS if m not in WITHOUT])
    def test_each_takes_the_distortion_parameters_of_colmap(self, model):
        names = COLMAP_PARAMETERS[model].split(", ")
        count = len(names) - names.index("cy") - 1
        given = {"width": 80, "height": 60, "fx": 50, "fy": 50, "cx": 40, "cy": 30, "model": model}
        camera = intrinsics_from(given | {"distortion": [0.001] * count})
        assert (camera.model, camera.distortion) == (model, (0.001,) * count)
        for wrong in {count - 1, count + 1} - {-1}:
            with pytest.raises(InvalidIntrinsics, match=f"has {count} parameters .* here are {wrong}") as caught:
                intrinsics_from(given | {"distortion": [0.001] * wrong})
            assert caught.value.where == "distortion"
        one_focal = names[0] == "f"
        with pytest.raises(InvalidIntrinsics, match="one focal length") if one_focal else nullcontext():
            intrinsics_from(given | {"fy": 51, "distortion": [0.001] * count})


class TestFocalLength:
    def test_from_exif(self):
        query = read_query(encoded(Image.fromarray(gradient()), "JPEG", exif=exif_with(focal_35mm=27)))
        assert query.intrinsics_source == "exif"
        assert query.intrinsics.fx == query.intrinsics.fy == pytest.approx(between_definitions(27, 80))
        assert (query.intrinsics.cx, query.intrinsics.cy) == (40, 30)
        assert query.warnings == ()

    def test_a_crop_that_exif_betrays(self):
        """Half of the width is left of what the camera stored: its focal length in pixels stays."""
        query = read_query(encoded(Image.fromarray(gradient()), "JPEG", exif=exif_with(focal_35mm=27, size=(160, 60))))
        whole = read_query(encoded(Image.fromarray(gradient()), "JPEG", exif=exif_with(focal_35mm=27)))
        assert query.lens_prior is not None
        assert whole.lens_prior is not None
        assert query.intrinsics.fx == pytest.approx(27 / 36 * 160, rel=0.08)
        assert query.lens_prior.principal_point_scale > 5 * whole.lens_prior.principal_point_scale

    @pytest.mark.parametrize("focal", [None, 0, 60000])
    def test_guessed_with_a_warning(self, focal):
        query = read_query(encoded(Image.fromarray(gradient()), "JPEG", exif=exif_with(focal_35mm=focal)))
        assert query.intrinsics_source == "guessed"
        assert query.intrinsics.fx == pytest.approx(0.78 * 80)
        assert "focal length" in query.warnings[0]

    def test_given_wins(self):
        camera = Intrinsics(80, 60, 100.0, 101.0, 39.0, 31.0)
        query = read_query(encoded(Image.fromarray(gradient()), exif=exif_with(focal_35mm=27)), intrinsics=camera)
        assert query.intrinsics_source == "given"
        assert query.intrinsics == query.photo_intrinsics == camera

    def test_prior_is_handed_on(self):
        prior = Pose(np.eye(4))
        assert read_query(encoded(Image.fromarray(gradient())), prior=prior).prior is prior

    @pytest.mark.parametrize(
        ("size", "says"),
        [((60, 80), "swapped"), ((160, 120), "ratio"), ((80, 50), "cropped"), ((81, 61), "80 x 60")],
    )
    def test_other_size_than_the_photo(self, size, says):
        with pytest.raises(InvalidIntrinsics, match=says):
            read_query(encoded(Image.fromarray(gradient())), intrinsics=Intrinsics(*size, 70.0, 70.0, 30.0, 30.0))


GOOD = {"width": 640, "height": 480, "fx": 500.0, "fy": 501, "cx": 320, "cy": 240.5}


class TestIntrinsicsFrom:
    def test_pinhole(self):
        assert intrinsics_from(GOOD) == Intrinsics(640, 480, 500.0, 501.0, 320.0, 240.5)

    def test_distortion(self):
        given_ = {**GOOD, "model": "OPENCV", "distortion": [0.1, 0, 0, -0.1]}
        assert intrinsics_from(given_).distortion == (0.1, 0.0, 0.0, -0.1)

    @pytest.mark.parametrize(
        ("change", "where"),
        [
            ({"fx": 0}, "fx"),
            ({"fy": -3}, "fy"),
            ({"fx": float("nan")}, "fx"),
            ({"fx": float("inf")}, "fx"),
            ({"fx": "500"}, "fx"),
            ({"fx": True}, "fx"),
            ({"fx": None}, "fx"),
            ({"cx": float("nan")}, "cx"),
            ({"width": 640.5}, "width"),
            ({"width": float("nan")}, "width"),
            ({"width": float("inf")}, "width"),
            ({"width": 0}, "width"),
            ({"height": 10**400}, "height"),
            ({"model": "FOV"}, "model"),
            ({"model": 7}, "model"),
            ({"distortion": [0.1]}, "distortion"),
            ({"distortion": "no"}, "distortion"),
            ({"model": "OPENCV"}, "distortion"),
            ({"model": "OPENCV", "distortion": [0.1, "x", 0, 0]}, "distortion"),
            ({"model": "OPENCV", "distortion": [0.1, float("nan"), 0, 0]}, "distortion"),
            ({"model": "SIMPLE_RADIAL", "distortion": [0.1]}, "fy"),
            ({"focal": 3}, "focal"),
        ],
    )
    def test_errors_name_the_field(self, change, where):
        with pytest.raises(InvalidIntrinsics) as caught:
            intrinsics_from({**GOOD, **change})
        assert where in caught.value.where

    @pytest.mark.parametrize("key", GOOD)
    def test_missing(self, key):
        with pytest.raises(InvalidIntrinsics, match="missing"):
            intrinsics_from({k: v for k, v in GOOD.items() if k != key})


class TestBrokenPhotos:
    @pytest.mark.parametrize(
        ("data", "says"),
        [
            (b"", "empty"),
            (b"hello, this is text", "not a JPEG"),
            (b"GIF89a" + bytes(100), "a GIF file is not read"),
            (b"\xff\xd8\xff", "header"),
            (b"\x89PNG\r\n\x1a\n", "header"),
            (b"RIFF\x10\0\0\0WEBPVP8 " + bytes(20), "header"),
            (b"\0\0\0\x18ftypheic" + bytes(30), "header"),
        ],
    )
    def test_says_what_is_wrong(self, data, says):
        with pytest.raises(InvalidImage, match=says):
            read_query(data)

    @pytest.mark.parametrize("size", [(10_000, 10_000), (100_000, 100_000), (2**31 - 1, 2**31 - 1)])
    def test_bomb_is_refused_by_its_header(self, size):
        bomb = png(*size, data=bytes(10_000_000))  # 10 kB that would grow
        start = time.process_time()
        with pytest.raises(InvalidImage, match=r"megapixels|header"):
            read_query(bomb)
        assert time.process_time() - start < 0.2  # seen: 0.001

    def test_64_megapixels_of_a_phone_are_allowed(self):
        data = encoded(Image.new("L", (9248, 6936), 100), "JPEG", quality=30)
        assert read_query(data).rgb.shape == (867, 1156, 3)  # an eighth

    def test_text_bomb(self):
        text = b"Comment\0\0" + zlib.compress(bytes(80_000_000))
        with pytest.raises(InvalidImage):
            read_query(png(64, 64, (b"zTXt", text), data=bytes(64 * 193)))

    def test_jpeg_with_another_size_than_its_header_says(self):
        data = bytearray(encoded(Image.fromarray(gradient()), "JPEG"))
        at = data.index(b"\xff\xc0") + 5
        data[at : at + 2] = struct.pack(">H", 6000)  # the height
        with pytest.raises(InvalidImage):
            read_query(bytes(data))

    @pytest.mark.parametrize("size", [(31, 400), (1, 1), (6000, 100)])
    def test_too_small_or_narrow(self, size):
        with pytest.raises(InvalidImage, match="narrow"):
            read_query(encoded(Image.new("RGB", size), compress_level=1))

    @pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP"])
    def test_truncated(self, kind):
        noise = np.random.default_rng(0).integers(0, 255, (100, 120, 3), np.uint8)
        data = encoded(Image.fromarray(noise), kind)
        with pytest.raises(InvalidImage, match=r"truncated|broken"):
            read_query(data[: len(data) // 2])

    @pytest.mark.parametrize("progressive", [False, True])
    def test_a_jpeg_that_lacks_only_its_end_marker_is_read(self, progressive):
        noise = np.random.default_rng(0).integers(0, 255, (100, 120, 3), np.uint8)
        whole = encoded(Image.fromarray(noise), "JPEG", progressive=progressive)
        assert np.array_equal(read_query(whole[:-2]).rgb, read_query(whole).rgb)
        with pytest.raises(InvalidImage, match="truncated"):
            read_query(whole[:-40])

    def test_looking_for_the_end_of_a_jpeg_decodes_no_more_than_the_largest_photo(self, monkeypatch):
        whole = encoded(Image.fromarray(gradient()), "JPEG")
        asked = []
        monkeypatch.setattr(images, "lacks_only_its_end", lambda *_: asked.append(1) or False)
        monkeypatch.setattr(images.JpegImageFile, "width", 8000)
        for height, looks in ((2796, 1), (2797, 0)):  # a third of 64 * 1024^2 pixels
            monkeypatch.setattr(images.JpegImageFile, "height", height)
            images._open(whole[:-2])
            images._open(whole[:-2], header_only=True)
            images._open(whole)
            assert (len(asked), asked.clear()) == (looks, None)

    @pytest.mark.parametrize(
        ("kind", "data"),
        [
            *((kind, encoded(Image.fromarray(gradient()), kind)) for kind in ("AVIF", "GIF", "BMP", "TIFF")),
            ("JPEG XL", b"\x00\x00\x00\x0cJXL \r\n\x87\n" + bytes(40)),
        ],
    )
    def test_a_format_that_is_not_read_is_named(self, kind, data):
        with pytest.raises(InvalidImage, match=rf"^photo: an? {kind}\b.* is not read here. Convert it to JPEG.$"):
            read_query(data)

    @settings(max_examples=150)
    @given(st.data())
    def test_no_damage_raises_anything_else(self, data):
        """Bytes changed and cut at random: a query or InvalidImage, nothing else."""
        kind = data.draw(st.sampled_from(["JPEG", "PNG", "WEBP", "HEIC"]))
        whole = bytearray(_WHOLE[kind])
        for _ in range(data.draw(st.integers(0, 4))):
            whole[data.draw(st.integers(0, min(len(whole) - 1, 400)))] = data.draw(st.integers(0, 255))
        cut = data.draw(st.integers(1, len(whole)))
        with suppress(InvalidImage):
            assert read_query(bytes(whole[:cut])).rgb.ndim == 3


_WHOLE = {
    kind: encoded(Image.fromarray(gradient()), kind, exif=exif_with(6, 27)) for kind in ("JPEG", "PNG", "WEBP")
} | {"HEIC": (DATA / "rotated.heic").read_bytes()}


@pytest.mark.filterwarnings("ignore:Corrupt EXIF")  # Pillow's, on stderr: welcome
def test_broken_exif_is_no_error():
    data = encoded(Image.fromarray(gradient()), "JPEG", exif=b"Exif\0\0MM\0*\0\0\0\x08\xff\xff broken")
    assert read_query(data).intrinsics_source == "guessed"


def test_limits_are_what_the_messages_say():
    assert images.DEFAULTS.max_pixels >= 9248 * 6936
    assert images.DEFAULTS.max_pixels < 100e6


def test_an_approximate_focal_length_leaves_room_for_its_estimate():
    sizes = {"width": 64, "height": 48, "cx": 32, "cy": 24}
    assert intrinsics_from({**sizes, "fx": 9e6, "fy": 9e6}).fx == 9e6
    with pytest.raises(InvalidIntrinsics, match="at most 1e") as refused:
        intrinsics_from({**sizes, "fx": 9e6, "fy": 9e6, "trust": "approximate"})
    assert refused.value.where == "fx"
