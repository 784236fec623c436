"""The mirror image of a photo, as front cameras of phones store it."""

from __future__ import annotations

from dataclasses import replace

from service.types import Intrinsics, Query


def mirrored_query(query: Query) -> Query:
    """Return the photo with left and right exchanged, and the camera that takes it so.

    A prior pose or region is left as it is: it refers to the photo as it was sent.
    """
    valid = None if query.valid_mask is None else query.valid_mask[:, ::-1]
    return replace(
        query,
        rgb=query.rgb[:, ::-1],
        valid_mask=valid,
        intrinsics=mirrored_intrinsics(query.intrinsics),
        photo_intrinsics=mirrored_intrinsics(query.photo_intrinsics),
    )


def mirrored_intrinsics(intrinsics: Intrinsics) -> Intrinsics:
    """Return the camera whose image is the mirror image: its principal point changes sides."""
    # In pixels from the left edge, whose mirror image is the right one.
    return replace(intrinsics, cx=intrinsics.width - intrinsics.cx)
