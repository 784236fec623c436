"""Several photos of one camera, or a video, as the input of one job: packed into one byte string, read one by one."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import UInt8

from service.device_readings import DeviceReadings
from service.errors import InvalidImage, InvalidRequest
from service.photos.camera_identity import CameraIdentity
from service.photos.exif_gps import with_readings
from service.photos.images import open_photo, photo_size, query_of
from service.photos.video import frame_count, is_video, read_video
from service.types import Intrinsics, LensPrior, Pose, PriorRegion, Query

PHOTO_LONG_SIDE = 832
"""Pixels of the photos of a sequence: tracking works at 800 at most, and a JPEG comes at its own next step."""
_ZIP = b"PK\x03\x04"


@dataclass(frozen=True, slots=True)
class SequencePhoto:
    """One of several photos of a camera, in the order in which they were taken."""

    name: str
    time_s: float
    """Since any moment; ascending."""
    query: Query
    camera: CameraIdentity
    """By the photo's header; of a video it is only known to be one."""


@dataclass(frozen=True, slots=True)
class SequenceOptions:
    """Which photos of a sequence are read, and what is known of their camera."""

    limit: int
    """More photos or frames are refused."""
    every: int = 1
    times_s: Sequence[float] | None = None
    """Of all photos, also of those that `every` leaves out; None: one a second, and a video's own times."""
    intrinsics: Intrinsics | None = None
    prior: Pose | None = None
    """Of the first photo; so is the region."""
    region: PriorRegion | None = None
    background_rgb: tuple[float, float, float] = (0.0, 0.0, 0.0)
    lens_prior: LensPrior | None = None
    """How certain `intrinsics` are, where earlier photos of the camera are their source."""
    readings: DeviceReadings | None = None
    """What the device measured beside the first photo."""
    exif_gps: bool = False
    """Whether EXIF's position and heading of each photo are readings, too."""


def is_packed(data: bytes) -> bool:
    """Whether the bytes are what `packed` makes, or another ZIP."""
    return data.startswith(_ZIP)


def is_sequence(data: bytes) -> bool:
    """Whether the bytes are what `packed` makes, or a video."""
    return is_packed(data) or is_video(data)


def packed(files: Sequence[tuple[str, bytes]]) -> bytes:
    """Return (name, photo) pairs as one ZIP, deterministic: the same photos give the same bytes."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for index, (name, data) in enumerate(files):
            # ZipInfo without a date, and the number first: two photos may have one name.
            archive.writestr(zipfile.ZipInfo(f"{index}/{name}"), data)
    return file.getvalue()


def unpacked(data: bytes) -> list[tuple[str, bytes]]:
    """Return the (name, photo) pairs that `packed` put together."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return [(entry.filename.partition("/")[2], archive.read(entry)) for entry in archive.infolist()]


def check_sequence(data: bytes, options: SequenceOptions) -> None:
    """Check count, times and sizes by the files' headers alone. Raises InvalidImage, InvalidRequest."""
    if is_video(data):
        if options.times_s is not None:
            raise InvalidRequest("a video has its own times.", where="times_s")
        _check_count(-(-frame_count(data) // options.every), options)
        return
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = archive.infolist()
        _check_count(-(-len(entries) // options.every), options)
        if options.times_s is not None and len(options.times_s) != len(entries):
            raise InvalidRequest(f"{len(options.times_s)} times for {len(entries)} photos.", where="times_s")
        sizes: list[tuple[int, int]] = []
        # Photos that are skipped may be broken: they are never decoded.
        for index in range(0, len(entries), options.every):
            with at_photo(index):
                sizes.append(photo_size(archive.read(entries[index])))
                _check_size(sizes[-1], sizes[0])


def read_sequence(data: bytes, options: SequenceOptions) -> Generator[SequencePhoto, None, None]:
    """Yield the photos, decoded one at a time. Raises InvalidImage, InvalidIntrinsics.

    Count and size are checked again: a video's header need not be true, and its frames are counted as they come.
    """
    given = {"intrinsics": options.intrinsics, "lens_prior": options.lens_prior, "long_side": PHOTO_LONG_SIDE}
    first: tuple[int, int] | None = None
    for count, (index, name, time_s, source) in enumerate(_sources(data, options), 1):
        _check_count(count, options)
        with at_photo(index):
            # The prior is of the first pose; later ones start from the pose before.
            prior = options.prior if first is None else None
            if isinstance(source, bytes):
                opened = open_photo(source)
                camera = opened.camera
                query = opened.query(prior=prior, background_rgb=options.background_rgb, **given)
                readings = options.readings if first is None else None
                query = with_readings(query, readings, opened if options.exif_gps else None)
            else:
                camera = CameraIdentity(source.shape[1], source.shape[0], is_video=True)
                query = query_of(source, prior=prior, **given)
                query = with_readings(query, options.readings if first is None else None)
            if first is None:
                query = replace(query, region=options.region)
            # One camera: intrinsics that are refined with one photo hold for the next.
            size = query.photo_intrinsics.width, query.photo_intrinsics.height
            first = first or size
            _check_size(size, first)
        yield SequencePhoto(name, time_s, query, camera)


def _sources(
    data: bytes, options: SequenceOptions
) -> Iterator[tuple[int, str, float, bytes | UInt8[np.ndarray, "h w 3"]]]:
    """Yield number, name, time, and the file or the decoded frame."""
    if is_video(data):
        for frame in read_video(data, options.every):
            yield frame.number, f"frame {frame.number}", frame.time_s, frame.rgb
        return
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        for index, entry in list(enumerate(archive.infolist()))[:: options.every]:
            time_s = float(index) if options.times_s is None else options.times_s[index]
            yield index, entry.filename.partition("/")[2], time_s, archive.read(entry)


def _check_count(count: int, options: SequenceOptions) -> None:
    if count > options.limit:
        raise InvalidImage(
            f"a sequence may have {options.limit} photos or frames; these are more.",
            where="photo",
            hint="Send every=N to use each Nth, or several jobs.",
        )


def _check_size(size: tuple[int, int], first: tuple[int, int]) -> None:
    if size != first:
        raise InvalidImage(
            f"has {size[0]} x {size[1]} pixels, the first one {first[0]} x {first[1]}.",
            hint="A sequence is one camera's: send photos of another size as a job of their own.",
        )


@contextmanager
def at_photo(index: int) -> Iterator[None]:
    """Name the photo in an InvalidImage that is raised inside."""
    try:
        yield
    except InvalidImage as error:
        error.where = f"photo.{index}"
        raise
