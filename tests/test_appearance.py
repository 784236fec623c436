"""The gate's appearance signals: on planted blocks, pixels and occlusions, by hand and beside plain numpy."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from service.interfaces import Frame
from service.pose.verification import appearance as module
from service.pose.verification.appearance import (
    APPEARANCE,
    BlockStatistics,
    ImagePair,
    _blocks,
    _shares,
    appearance,
    colour_correlation,
    colour_edge_correlation,
    gradient_correlation,
    local_colour_correlation,
)

SIZE = (144, 192)


def texture(seed: int, contrast: float = 40.0) -> np.ndarray:
    """A smooth random picture in colours, float, around 128."""
    rng = np.random.default_rng(seed)
    coarse = rng.normal(0, 1, (SIZE[0] // 4, SIZE[1] // 4, 3))
    return 128 + contrast * coarse.repeat(4, 0).repeat(4, 1)


def uint8(image: np.ndarray) -> np.ndarray:
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def frame_of(image: np.ndarray, alpha: np.ndarray | None = None) -> Frame:
    height, width = image.shape[:2]
    alpha = np.ones((height, width), np.float32) if alpha is None else alpha.astype(np.float32)
    return Frame(uint8(image).astype(np.float32) / 255, alpha, alpha, alpha)


def blocks_of(count: int, **changed: Any) -> BlockStatistics:
    """Blocks that agree, each with another colour."""
    rgb = np.random.default_rng(3).uniform(30, 220, (count, 3)).astype(np.float32)
    given = {
        "correlation": np.full(count, 0.9), "around": np.full(count, 0.9), "weight": np.ones(count),
        "photo_rgb": rgb, "render_rgb": rgb, "valid": np.ones(count, bool),
    }  # fmt: skip
    return BlockStatistics(**(given | changed))


# ------------------------------------------------------------------ images and blocks


def test_pairs_are_compared_at_192_pixels_and_blocks_are_their_means() -> None:
    large = np.zeros((288, 384, 3), np.uint8)
    pair = ImagePair.of(large, frame_of(large))
    assert pair.photo.shape == (144, 192, 3)
    assert pair.whole
    valid = np.ones((288, 384), bool)
    valid[:, :192] = False
    half = ImagePair.of(large, frame_of(large, np.full((288, 384), 0.8)), valid)
    assert not half.whole
    assert np.allclose(half.opaque[:, :96], 0)
    assert np.allclose(half.opaque[:, 96:], 0.8)
    assert ImagePair.of(np.zeros((4, 400, 3), np.uint8), frame_of(np.zeros((4, 400, 3)))).photo.shape == (8, 192, 3)
    image = np.random.default_rng(0).uniform(0, 1, (21, 26)).astype(np.float32)
    found = _blocks(image)
    assert found.shape == (2, 3, 1)
    assert np.allclose(found[..., 0], image[:16, :24].reshape(2, 8, 3, 8).mean((1, 3)), atol=1e-6)


def test_blocks_correlate_as_their_gradients_do() -> None:
    """Away from occlusions 1, or -1 for a negative; by the gradients of the blurred luma."""
    photo = texture(0)
    same, negative = (
        BlockStatistics.of(ImagePair.of(uint8(photo), frame_of(render))) for render in (photo, 255 - photo)
    )
    assert np.all(same.correlation > 0.999)
    assert np.all(same.around > 0.999)
    assert np.all(negative.correlation < -0.99)
    occluded = photo.copy()
    occluded[:72] = texture(1)[:72]
    found = BlockStatistics.of(ImagePair.of(uint8(occluded), frame_of(photo)))
    grid, around = found.correlation.reshape(18, 24), found.around.reshape(18, 24)
    assert np.abs(grid[:8].mean()) < 0.15
    assert grid[10:].min() > 0.999
    assert np.all(around[8] < 0.99)  # next to what is occluded
    assert around[11:].min() > 0.999
    # Weights are those of the render's squared gradients: twice the contrast weighs four times.
    strong = BlockStatistics.of(ImagePair.of(uint8(photo), frame_of(128 + 0.5 * (photo - 128))))
    assert np.median(same.weight / strong.weight) == pytest.approx(4, rel=0.05)


@pytest.mark.parametrize(
    ("transparent", "saturated", "valid"), [(0, 0, True), (1, 0, False), (0, 47, True), (0, 48, False)]
)
def test_a_block_counts_if_all_of_it_is_opaque_and_a_quarter_not_saturated(transparent, saturated, valid) -> None:
    """Of the 64 pixels of a block; one channel is enough to be saturated."""
    photo, alpha = np.full((*SIZE, 3), 100, np.uint8), np.ones(SIZE)
    for n in range(transparent):
        alpha[8 + n // 8, 8 + n % 8] = 0.0
    for n in range(saturated):
        photo[8 + n // 8, 8 + n % 8] = [255, 50, 50]
    found = BlockStatistics.of(ImagePair.of(photo, frame_of(np.full((*SIZE, 3), 60.0), alpha)))
    assert found.valid.reshape(18, 24)[1, 1] == valid
    assert found.valid.reshape(18, 24)[2, 2]
    if valid:
        assert found.photo_rgb.reshape(18, 24, 3)[1, 1] == pytest.approx([100] * 3, rel=1e-4)
        assert found.render_rgb.reshape(18, 24, 3)[1, 1] == pytest.approx([60] * 3, rel=1e-4)


def test_a_masks_edge_has_no_gradients() -> None:
    """Of a photo with invalid pixels a pixel more is left out."""
    photo = uint8(texture(2))
    valid = np.ones(SIZE, bool)
    valid[:, :96] = False
    found = BlockStatistics.of(ImagePair.of(photo, frame_of(photo), valid))
    assert not found.weight.reshape(18, 24)[:, :12].any()
    assert np.all(found.weight.reshape(18, 24)[:, 12:] > 0)
    assert not found.valid.reshape(18, 24)[:, 12].any()
    assert found.valid.reshape(18, 24)[:, 13:].all()


# ------------------------------------------------------------------ signals


def test_gradients_are_compared_over_the_best_three_quarters_and_half() -> None:
    """Eight blocks of equal weight; the two worst, then four, are left out; shares are of the weight."""
    correlation = np.array([0.1, 0.9, 0.2, 0.8, 0.3, 0.7, 0.4, 0.6])
    blocks = blocks_of(8, correlation=correlation)
    assert gradient_correlation(blocks) == pytest.approx((np.mean([3, 4, 6, 7, 8, 9]) / 10, np.mean([6, 7, 8, 9]) / 10))
    heavy = replace(blocks, weight=np.array([8.0, 1, 1, 1, 1, 1, 1, 1]))  # the worst has more than half of the weight
    assert gradient_correlation(heavy) == pytest.approx(((0.8 + 3.9) / 15, (0.8 + 3.9) / 15))
    assert gradient_correlation(replace(blocks, weight=np.zeros(8))) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("changed", "counted"),
    [
        ({"correlation": 0.71}, True), ({"correlation": 0.69}, False), ({"around": 0.71}, True),
        ({"around": 0.69}, False), ({"weight": 0.11}, True), ({"weight": 0.09}, False), ({"valid": False}, False),
    ],
)  # fmt: skip
def test_local_colours_are_those_of_blocks_that_show_the_same(changed: dict[str, Any], counted: bool) -> None:
    """Twenty blocks agree in colour, ten don't."""
    good = blocks_of(30)
    wrong = good.photo_rgb.copy()
    wrong[:10] = wrong[:10, ::-1]
    (name, value), fields = *changed.items(), {}
    fields[name] = getattr(good, name).copy()
    fields[name][:10] = value
    found = local_colour_correlation(replace(good, photo_rgb=wrong, **fields))
    assert (found < 0.99) == counted
    assert (found > 0.9999) != counted


def test_local_colours_of_fewer_than_eight_blocks_are_no_evidence() -> None:
    swapped = blocks_of(8).photo_rgb[:, ::-1].copy()
    assert local_colour_correlation(blocks_of(8, photo_rgb=swapped)) < 0.95
    assert local_colour_correlation(blocks_of(7, photo_rgb=swapped[:7])) == 1.0
    assert local_colour_correlation(blocks_of(8, photo_rgb=swapped, valid=np.zeros(8, bool))) == 1.0


def test_local_colours_depend_on_neither_exposure_nor_saturation() -> None:
    blocks = blocks_of(40)
    luma = blocks.render_rgb @ np.float32([0.299, 0.587, 0.114])
    for photo in (
        blocks.render_rgb * np.float32([0.5, 0.9, 0.7]) + np.float32([10, 0, 30]),
        0.4 * blocks.render_rgb + 0.5 * luma[:, None],
        np.repeat(luma[:, None], 3, 1),
    ):
        assert local_colour_correlation(replace(blocks, photo_rgb=photo.astype(np.float32))) > 0.9999


@pytest.mark.parametrize("seed", range(6))
def test_shares_are_the_best_of_what_is_not_negative(seed: int) -> None:
    """By the conditions of Karush, Kuhn and Tucker: the slope is 0 where a share is positive, else it rises."""
    rng = np.random.default_rng(seed)
    render = rng.normal(0, 30, (50, 3)).astype(np.float32)
    luma = (render @ np.float32([0.299, 0.587, 0.114]))[:, None]
    mixed = rng.uniform(-1, 1, 3) * render + rng.uniform(-1, 1, 3) * luma
    photo = (mixed + rng.normal(0, 3, (50, 3))).astype(np.float32)
    shares = np.stack(_shares(photo, render, luma))
    for c in range(3):
        parts = np.stack([render[:, c], luma[:, 0]], 1).astype(float)
        slope = parts.T @ (parts @ shares[:, c] - photo[:, c])
        size = np.abs(parts.T @ photo[:, c]).max() + (parts**2).sum()
        assert np.all(shares[:, c] >= 0)
        for share, rise in zip(shares[:, c], slope, strict=True):
            assert abs(rise) < 2e-3 * size if share > 0 else rise > -2e-3 * size


def test_the_ridge_of_the_shares_is_relative_and_absolute(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "APPEARANCE", replace(APPEARANCE, ridge=0.5))
    rng = np.random.default_rng(1)
    render, luma = rng.normal(0, 1, (20, 3)).astype(np.float32), rng.normal(0, 1, (20, 1)).astype(np.float32)
    for of_channel, of_luma in ((0.7, 0.4), (-2.0, 0.4), (0.7, -2.0)):
        found = _shares(of_channel * render + of_luma * luma, render, luma)
        for c in range(3):
            parts = np.concatenate([render[:, c : c + 1], luma], 1).astype(float)
            told = parts.T @ (parts @ [of_channel, of_luma])
            square = parts.T @ parts
            square[np.diag_indices(2)] = square.diagonal() * 1.5 + 0.5
            both = np.linalg.solve(square, told)
            alone = np.diag(1 / square.diagonal()) @ told
            best = [0, alone[1]] if both[0] < 0 else [alone[0], 0] if both[1] < 0 else both
            assert (found[0][c], found[1][c]) == pytest.approx(np.maximum(best, 0), rel=1e-4)


def test_colours_of_pixels_correlate_but_for_the_quarter_that_fits_worst() -> None:
    render = uint8(texture(4))
    opaque = np.ones(SIZE, np.float32)
    photo = uint8(0.7 * render.astype(float) * [1.0, 0.8, 0.9] + [20, 30, 10])
    assert min(colour_correlation(ImagePair(photo, render, opaque, True))) > 0.99
    for share, most, half in ((0.22, True, True), (0.4, False, True), (0.7, False, False)):
        occluded = photo.copy()
        occluded[: round(share * SIZE[0])] = uint8(texture(5))[: round(share * SIZE[0])]
        found = colour_correlation(ImagePair(occluded, render, opaque, True))
        assert (found[0] > 0.99) == most
        assert (found[1] > 0.99) == half
        assert found[1] >= found[0]
    unrelated = colour_correlation(ImagePair(uint8(texture(6)), render, opaque, True))
    assert unrelated[0] < 0.6


def test_colours_are_compared_where_the_scene_is_opaque() -> None:
    """At a third of the size: eight pixels at least."""
    render, opaque = uint8(texture(4)), np.zeros(SIZE, np.float32)
    opaque[:12, :6] = 1.0
    assert min(colour_correlation(ImagePair(render, render, opaque, True))) > 0.999
    opaque[9:12, 3:6] = 0.5
    assert colour_correlation(ImagePair(render, render, opaque, True)) == (0.0, 0.0)
    opaque[9:12, 3:6] = 0.51
    assert min(colour_correlation(ImagePair(render, render, opaque, True))) > 0.999


def test_edges_in_colour_do_not_depend_on_the_lights_colour_or_on_shading() -> None:
    render = 60 + 0.5 * texture(7, 60.0).clip(0, 255)
    assert colour_edge_correlation(uint8(render), frame_of(render)) == pytest.approx(1.0, abs=1e-4)
    shaded = render * np.linspace(0.5, 1.2, SIZE[1])[None, :, None] * [1.0, 0.85, 0.9]
    assert colour_edge_correlation(uint8(shaded), frame_of(render)) > 0.97
    swapped = render[..., [1, 0, 2]]
    assert colour_edge_correlation(uint8(swapped), frame_of(render)) < 0.4
    grey = np.repeat(render.mean(2, keepdims=True), 3, 2)
    assert abs(colour_edge_correlation(uint8(render), frame_of(grey))) < 0.3
    # What is transparent has no part in it.
    alpha = np.ones(SIZE)
    alpha[:, :96] = 0.0
    other = render.copy()
    other[:, :94] = texture(8)[:, :94]
    assert colour_edge_correlation(uint8(other), frame_of(render, alpha)) > 0.98
    assert colour_edge_correlation(uint8(other), frame_of(render)) < 0.8


def test_the_signals_have_names_and_tell_a_right_picture_from_a_wrong_one() -> None:
    photo = texture(9)
    right, wrong = (appearance(uint8(photo), frame_of(render)) for render in (photo, texture(10)))
    names = ["gradients", "gradients_half", "colours", "colours_half", "local_colour_correlation"]
    assert list(right) == names
    assert min(right.values()) > 0.999
    assert max(wrong["gradients"], wrong["colours"]) < 0.6
    assert APPEARANCE.min_energy == pytest.approx(1e-6 / 8**4)
