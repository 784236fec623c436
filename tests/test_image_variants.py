"""Which sizes and rotations of a photo are compared with the index, with features and scores that are planted."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service.geometry import moved
from service.interfaces import Features
from service.pose.features.image_sizes import PHOTO_PX
from service.pose.retrieval.image_variant import ImageVariant, Retrieval
from service.pose.retrieval.scores import retrieval_scores
from service.types import BoxPrior, Camera, Intrinsics, Pose

VIEW_LENS = Intrinsics(320, 240, 300.0, 300.0, 160.0, 120.0)


def retrieval(
    scores: Mapping[int, list[float]],
    suggested: list[int] = [],  # noqa: B006
    *,
    focal: float = 300.0,
    source: str = "given",
    region: BoxPrior | None = None,
    positions: list[float] | None = None,
) -> tuple[Retrieval, list[tuple[int, int]]]:
    """Return a retrieval whose photo has these scores by its rotation, and a list of what is extracted."""
    extracted: list[tuple[int, int]] = []

    def features(long_side: int, roll: int) -> Features:
        extracted.append((long_side, roll))
        # What stands for descriptors says which rotation it is of.
        return Features(np.zeros((1, 2), np.float32), np.ones(1, np.float32), np.full((1, 2), roll, np.float32))

    def of_rotation(own: np.ndarray, _: Any) -> np.ndarray:
        return np.array(scores[int(own[0, 0])])

    places = positions or [0.0] * len(next(iter(scores.values())))
    poses = [moved(Pose(np.eye(4)), np.array([0, 0, 0, x, 0, 0])) for x in places]
    none = np.zeros((1, 2), np.float32)
    views = [
        SimpleNamespace(camera=Camera(VIEW_LENS, pose), features=Features(none, np.ones(1, np.float32), none))
        for pose in poses
    ]
    lens = Intrinsics(640, 480, focal, focal, 320.0, 240.0)
    query = SimpleNamespace(intrinsics=lens, intrinsics_source=source, region=region, scene_priors=None)
    images: Any = SimpleNamespace(query=query, features=features, corners=lambda: None)
    found = Retrieval(images, SimpleNamespace(views=views, corners=None, scores=of_rotation))  # type: ignore[arg-type]
    found._suggested.extend(suggested)
    return found, extracted


def test_of_the_suggested_rotations_two_are_extracted() -> None:
    """Each costs as much as the photo itself; the upright one is known anyway."""
    scores = {0: [1.0], **{roll: [0.1 * roll] for roll in range(1, 8)}}
    found, extracted = retrieval(scores, [3, 0, 5, 7, 1])
    upright = ImageVariant(320)
    assert found.rotated_variant(upright) == upright
    assert {roll for _, roll in extracted} == {0, 3, 5}
    assert found.rotated_variant(upright, likeliest_only=True) == upright
    assert len(extracted) == 3  # each once


@pytest.mark.parametrize(("ratio", "rotated"), [(1.29, False), (1.31, True)])
def test_a_rotation_has_to_be_better_by_three_tenths(ratio: float, rotated: bool) -> None:
    """Rotated photos have 1.3 times the score and more with the right rotation."""
    found, _ = retrieval({0: [1.0, 0.2], 2: [0.1, ratio], 4: [0.1, 0.5]}, [4, 2])
    assert found.rotated_variant(ImageVariant(320)).roll_steps_45deg == (2 if rotated else 0)
    # The likeliest by corners is another one, which is worse.
    assert found.rotated_variant(ImageVariant(320), likeliest_only=True).roll_steps_45deg == 0


def test_the_best_of_two_rotations_is_taken() -> None:
    found, _ = retrieval({0: [1.0], 2: [3.0], 6: [2.0]}, [6, 2])
    assert found.rotated_variant(ImageVariant(320)) == ImageVariant(320, 2)


@pytest.mark.parametrize(("score", "upright"), [(1.49, False), (1.51, True)])
def test_a_photo_like_some_view_needs_no_rotation(score: float, upright: bool) -> None:
    """Of clean upright photos the best view has 1.8 and more, of rotated ones 1.3 at most."""
    found, _ = retrieval({0: [0.3, score, 0.2]})
    assert found.is_upright(ImageVariant(320)) is upright


def test_an_oblique_rotation_fits_the_same_canvas() -> None:
    """By 45 degrees a 4:3 image needs a canvas of 0.99 times its long side squared, instead of 0.75: pixels cost."""
    found, extracted = retrieval({roll: [1.0] for roll in range(8)})
    for roll in range(8):
        found.features(ImageVariant(400, roll))
    assert [roll for long_side, roll in extracted if long_side == 400] == [0, 2, 4, 6]
    (size,) = {long_side for long_side, roll in extracted if roll % 2}
    width, height = size, 0.75 * size
    canvas = ((width + height) / np.sqrt(2)) ** 2
    assert canvas <= 1.35 * 400 * 300
    assert size > 0.75 * 400  # no more detail is lost than that takes


@pytest.mark.parametrize(
    ("ratio", "source", "side"),
    [
        # Of the angles that a pixel covers in the photo and in the views.
        (1.0, "given", PHOTO_PX),
        (1.39, "given", PHOTO_PX),
        (1.41, "given", 1.41 * PHOTO_PX),
        (1 / 1.39, "given", PHOTO_PX),
        (1 / 1.41, "given", PHOTO_PX / 1.41),
        (1.41, "guessed", PHOTO_PX),
        (1.52, "exif", 1.52 * PHOTO_PX),
        (3.0, "given", 640),  # at most
        (0.4, "exif", 0.4 * PHOTO_PX),
        (0.2, "given", 160),  # at least
    ],
)
def test_a_photo_is_resized_to_the_views_angle_per_pixel(ratio: float, source: str, side: float) -> None:
    focal = 300.0 * 640 / 320 / ratio
    found, _ = retrieval({0: [1.0]}, focal=focal, source=source)
    assert found.upright_variant().long_side == pytest.approx(side, abs=1)


@pytest.mark.parametrize("inside", [0, 3, 20])
def test_the_sixteen_views_nearest_to_a_prior_are_searched_at_least(inside: int) -> None:
    """They may see what the photo shows from outside of its region."""
    count = 40
    region = BoxPrior(np.full(3, -1.0), np.full(3, 1.0))
    positions = [0.0] * inside + [2.0 + k for k in range(count - inside)]
    planted = list(np.linspace(5.0, 1.0, count)[::-1])
    found, _ = retrieval({0: planted}, region=region, positions=positions)
    scores = found.scores(ImageVariant(320))
    kept = max(inside, 16)
    assert np.array_equal(scores[:kept], planted[:kept])
    assert scores[kept:].max() <= 0 < scores[:kept].min()
    unrestricted, _ = retrieval({0: planted})
    assert np.array_equal(unrestricted.scores(ImageVariant(320)), planted)


def test_a_small_variants_features_may_be_as_far_off_in_its_own_pixels() -> None:
    for side in (PHOTO_PX // 2, PHOTO_PX, 2 * PHOTO_PX):
        error = ImageVariant(side).max_error_px
        assert error == pytest.approx(ImageVariant(PHOTO_PX).max_error_px * max(1, PHOTO_PX / side))
    assert ImageVariant(320, 3).scaled(0.5) == ImageVariant(160, 3)


# ------------------------------------------------------------------ scores


def test_what_every_view_shows_counts_for_nothing() -> None:
    """Two photo features: one is in all views, one is in the second only."""
    everywhere, one = np.float32([1, 0, 0]), np.float32([0, 1, 0])
    views = [np.stack([everywhere, np.float32([0, 0, 1])]) for _ in range(8)]
    views[1] = np.stack([everywhere, one])
    scores = retrieval_scores(np.stack([everywhere, one]), views)
    assert scores == pytest.approx([0, 1, 0, 0, 0, 0, 0, 0])


@pytest.mark.parametrize(
    ("views", "showing", "score"),
    [
        (20, 3, 1.0),  # fewer than the usual rank show it: it distinguishes them
        (20, 4, 0.0),
        (100, 5, 1.0),  # of many views a twentieth may show it
        (100, 6, 0.0),
        (2, 2, 0.0),
        (1, 1, 0.0),
    ],
)
def test_a_feature_distinguishes_three_views_or_a_twentieth_of_them(views: int, showing: int, score: float) -> None:
    feature, other = np.float32([[1, 0]]), np.float32([[0, 1]])
    scores = retrieval_scores(feature, [feature] * showing + [other] * (views - showing))
    assert scores[:showing] == pytest.approx([score] * showing)
    assert not scores[showing:].any()


def test_only_the_strongest_150_features_take_part() -> None:
    count = 200
    basis = np.eye(count, dtype=np.float32)
    nothing = np.zeros((1, count), np.float32)
    for take in (149, 150):
        # The photo's feature after `take` others; the view's likewise.
        for photo, view in ((np.roll(basis, take, 0), basis[:1]), (basis[:1], np.roll(basis, take, 0))):
            scores = retrieval_scores(photo, [view, *[nothing] * 5])
            assert scores[0] == (1.0 if take < 150 else 0.0)
