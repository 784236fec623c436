"""Decode what was sent with a job: one photo, or the first of several, as the query that is localized."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from service.errors import InvalidPrior, InvalidRequest
from service.jobs.engine import LocalizeTask, RigSource, SequenceSource
from service.jobs.model import JobSpec
from service.lenses.lens_memory import RecalledLens
from service.photos.camera_identity import CameraIdentity
from service.photos.exif_gps import with_readings
from service.photos.images import open_photo
from service.photos.sequence import (
    SequenceOptions,
    at_photo,
    check_sequence,
    is_packed,
    is_sequence,
    read_sequence,
    unpacked,
)
from service.photos.video import is_video
from service.results import StageTiming
from service.rig import RigPhoto
from service.types import Query

MAX_FRAMES = 1000
"""Photos of a sequence, unless an operator sets another limit."""
_OF_SEQUENCES = ("every", "times_s")


@dataclass(frozen=True, slots=True)
class DecodedPhoto:
    """A job's photo as it is localized, and what its header says of its camera."""

    query: Query
    """The photo; of a sequence the first."""
    decode: StageTiming
    """What decoding took."""
    source: Query | SequenceSource | RigSource
    """What is localized: the query, the whole sequence as it was sent, or the photos of a rig."""
    camera: CameraIdentity
    """By the header of the photo, of a sequence the first one's."""
    recalled: RecalledLens | None
    """What was known of its lens; None: nothing, or the intrinsics are given."""

    def task(self, spec: JobSpec, task_id: str = "", held: str = "", budget_s: float | None = None) -> LocalizeTask:
        """Return what an engine is to do: look in the scenes that are held, within the spec's budget or another."""
        return LocalizeTask(
            id=task_id,
            held=held,
            estimator=spec.estimator,
            options=spec.options,
            seed=spec.seed,
            budget_s=spec.budget_s if budget_s is None else budget_s,
            source=self.source,
            decode=self.decode,
            accuracy=spec.accuracy,
        )


Recall = Callable[[CameraIdentity], RecalledLens | None]
"""Returns what is known of the lens of a camera's photo."""


def read_photo(
    data: bytes,
    spec: JobSpec,
    background_rgb: tuple[float, float, float],
    max_frames: int = MAX_FRAMES,
    recall: Recall | None = None,
) -> DecodedPhoto:
    """Decode a photo, of several the first, against what the request says of it. Takes up to seconds.

    `background_rgb` (0..1) is the scene's: what is transparent is filled with it. `recall` is asked where the spec has
    no intrinsics; without it, what the spec holds of an earlier answer counts. Raises BadInput.
    """
    wall, cpu = time.perf_counter(), time.thread_time()
    known = spec.lens and spec.lens.recalled
    read = _read_rig if spec.rig else _read_sequence if is_sequence(data) else _read_single
    found = read(data, spec, background_rgb, max_frames, recall or (lambda _: known))
    return replace(found, decode=StageTiming("decode", time.perf_counter() - wall, time.thread_time() - cpu))


_UNTIMED = StageTiming("decode", 0.0, 0.0)


def _read_single(
    data: bytes, spec: JobSpec, background_rgb: tuple[float, float, float], _: int, recall: Recall
) -> DecodedPhoto:
    # A value that is the default may not have been sent at all.
    defaults = {field.name: field.default for field in fields(JobSpec)}
    for name in _OF_SEQUENCES:
        if getattr(spec, name) != defaults[name]:
            raise InvalidRequest("is for several photos, or a video; this is a single photo.", where=name)
    opened = open_photo(data)
    recalled = recall(opened.camera) if spec.intrinsics is None else None
    query = opened.query(
        intrinsics=recalled.intrinsics if recalled else spec.intrinsics,
        lens_prior=recalled and recalled.prior,
        prior=spec.prior,
        background_rgb=background_rgb,
    )
    query = with_readings(replace(query, region=spec.region), spec.readings, opened if spec.exif_gps else None)
    return DecodedPhoto(query, _UNTIMED, query, opened.camera, recalled)


def _read_rig(
    data: bytes, spec: JobSpec, background_rgb: tuple[float, float, float], _: int, recall: Recall
) -> DecodedPhoto:
    assert spec.rig is not None
    defaults = {field.name: field.default for field in fields(JobSpec)}
    for name in ("intrinsics", "camera_id", "prior", "region", *_OF_SEQUENCES):
        if getattr(spec, name) != defaults[name]:
            field = "prior" if name == "region" else name
            raise InvalidRequest("not together with `rig`, whose photos are one query.", where=field)
    files = unpacked(data) if is_packed(data) else [("", data)]
    if len(files) != len(spec.rig.cameras) or is_video(data):
        raise InvalidRequest(
            f"has {len(spec.rig.cameras)} cameras; {len(files)} photos were sent.",
            where="rig.cameras",
            hint="Send a photo for each camera, in their order.",
        )
    if spec.names_several_scenes:
        raise InvalidRequest("a rig is looked for in one scene.", where="scene", hint="Name one scene.")
    photos, first = [], None
    for index, ((name, photo), camera) in enumerate(zip(files, spec.rig.cameras, strict=True)):
        with at_photo(index):
            opened = open_photo(photo)
            first = first or opened.camera
            query = opened.query(intrinsics=camera.intrinsics, background_rgb=background_rgb)
            if not index:
                query = with_readings(query, spec.readings, opened if spec.exif_gps else None)
        photos.append(RigPhoto(query, camera.rig_from_camera, name))
    assert first is not None
    return DecodedPhoto(photos[0].query, _UNTIMED, RigSource(tuple(photos), spec.rig.metric), first, None)


def _read_sequence(
    data: bytes, spec: JobSpec, background_rgb: tuple[float, float, float], max_frames: int, recall: Recall
) -> DecodedPhoto:
    _require_ascending(spec.times_s)
    if spec.truth is not None:
        raise InvalidPrior("a single photo's; this is a sequence.", where="truth")
    if spec.names_several_scenes:
        raise InvalidRequest(
            "only a single photo is looked for in several scenes; this is a sequence.",
            where="scene",
            hint="Name one scene; one photo of the sequence, sent by itself, shows which.",
        )
    options = SequenceOptions(
        max_frames,
        spec.every,
        spec.times_s,
        spec.intrinsics,
        spec.prior,
        spec.region,
        background_rgb,
        readings=spec.readings,
        exif_gps=spec.exif_gps,
    )
    # Before the job is accepted, so that most faults of a sequence are answered at once.
    check_sequence(data, options)
    first = next(read_sequence(data, options))
    recalled = recall(first.camera) if spec.intrinsics is None else None
    if recalled:
        options = replace(options, intrinsics=recalled.intrinsics, lens_prior=recalled.prior)
        first = next(read_sequence(data, options))
    return DecodedPhoto(first.query, _UNTIMED, SequenceSource(data, options), first.camera, recalled)


def _require_ascending(times_s: Sequence[float] | None) -> None:
    if times_s is not None and not (np.all(np.isfinite(times_s)) and np.all(np.diff(times_s) > 0)):
        raise InvalidRequest("must be finite numbers, each greater than the one before.", where="times_s")
