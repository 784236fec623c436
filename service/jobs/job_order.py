"""A request as jobs take it: a photo that isn't decoded yet, and what to do with it."""

from __future__ import annotations

import secrets
import time
from dataclasses import dataclass

from service.jobs.model import JobSpec, NewJob, PhotoInfo
from service.jobs.read_photo import DecodedPhoto


@dataclass(frozen=True, slots=True)
class JobOrder:
    """A photo, or several, and what to do with it; not yet decoded."""

    photo: bytes
    """A photo or a video as it was sent; several photos as `photos.sequence.packed` puts them together."""
    name: str
    """Of the file; empty if it has none."""
    photo_sha256: str
    spec: JobSpec
    client: str
    """Who asks, and sees the job: the scope of idempotency keys."""
    idempotency_key: str | None
    digest: str
    """Of the request's meaning: the same for the same request."""
    lens_owner: str = ""
    """Among whose lenses the photo's is; empty: the photo's lens isn't remembered."""
    most_queued: int | None = None
    """How many jobs of the client may wait at once; None: as many as the queue takes."""


def new_job(order: JobOrder, scene: str, photo: DecodedPhoto) -> NewJob:
    """Return the job that an order becomes, listed under that scene."""
    spec, now = order.spec, time.time()
    return NewJob(
        id=secrets.token_hex(8),
        client=order.client,
        idempotency_key=order.idempotency_key,
        digest=order.digest,
        created=now,
        deadline=spec.deadline_s and now + spec.deadline_s,
        scene=scene,
        estimator=spec.estimator,
        spec=spec,
        photo=PhotoInfo(order.name, order.photo_sha256, photo.query.intrinsics),
        photo_sha256=order.photo_sha256,
        photo_bytes=len(order.photo),
        keep_photo=spec.keep_photo,
    )
