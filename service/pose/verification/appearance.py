"""How alike a photo and a render look, whatever the photo's exposure, and though something may hide a part of it.

    192 px, blocks of 8 x 8:   [][][][]...   gradients: do they correlate? In the better three quarters, and half
                               [][]##[]...   tints: where a block's do, has it the same colour, too?
                               [][]##[]...   ## hidden by a passer-by: neither does
    64 px, single pixels:      colours: do they correlate, in the better three quarters, and half?

Forms alone can't tell like things of other colours from one another, and colours of the better part leave out just
those that differ. Something hidden differs in both; a thing mistaken for its like, or for its mirror image, in tints.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from service.interfaces import Frame
from service.pose.features.rendered_views import to_uint8

PAIR_PX = 192
"""Long side at which photo and render are compared: coarse enough to forgive what training left blurred."""
COLOUR_SHRINK = 3
SIGMA_PX = 0.7
BLOCK_PX = 8
HIDDEN_SHARE, HALF = 0.25, 0.5
"""Of the photo, that may be hidden."""
MIN_ALPHA = 0.5
SAME_FORM, FLAT = 0.7, 0.1
"""Correlation of a block's gradients with which it shows the same, and the share of the median block's gradients below
which it shows nothing."""
WHOLE, ENOUGH = 0.99, 0.25
"""Shares of a block's pixels."""
WHITE = 255
LUMA = np.array([0.299, 0.587, 0.114], np.float32)
RIDGE = 1e-4
SMALLEST = 1e-6 / BLOCK_PX**4
"""Of gradients, which keeps flat blocks from agreeing."""
FEW = 8
"""Blocks or pixels; fewer tell nothing."""
APPEARANCE = ("gradients", "gradients_half", "colours", "colours_half")


@dataclass(frozen=True, slots=True)
class Pair:
    """A photo and a render of the same size, made small."""

    photo: UInt8[np.ndarray, "h w 3"]
    render: UInt8[np.ndarray, "h w 3"]
    opaque: Float32[np.ndarray, "h w"]
    """How much of a pixel is of the scene, 0..1, where the photo is known."""
    whole: bool
    """Whether all of the photo is."""

    @classmethod
    def of(cls, photo: UInt8[np.ndarray, "h w 3"], frame: Frame, known: Bool[np.ndarray, "h w"] | None = None) -> Pair:
        """`known` are the photo's pixels that are; None: all."""
        height, width = frame.alpha.shape
        factor = PAIR_PX / max(height, width)
        size = (max(BLOCK_PX, round(width * factor)), max(BLOCK_PX, round(height * factor)))
        render, opaque = to_uint8(frame.rgb), both_known(frame, known)
        small = [cv2.resize(layer, size, interpolation=cv2.INTER_AREA) for layer in (photo, render, opaque)]
        return cls(small[0], small[1], small[2], known is None)


@dataclass(frozen=True, slots=True)
class Blocks:
    """A pair, block by block."""

    correlation: Float64[np.ndarray, "n"]
    """Of the gradients, -1..1."""
    around: Float64[np.ndarray, "n"]
    """The same of the block with its neighbours: what hides a part may agree in single blocks, by chance."""
    weight: Float64[np.ndarray, "n"]
    """What of gradients is in the render; 0 where scene or photo are unknown."""
    photo_rgb: Float32[np.ndarray, "n 3"]
    render_rgb: Float32[np.ndarray, "n 3"]
    """Means of the pixels that are not cut off at white in the photo."""
    known: Bool[np.ndarray, "n"]
    """Whether the whole block is, and not too much of it cut off."""

    @classmethod
    def of(cls, pair: Pair) -> Blocks:
        """Compare where the scene is opaque and the photo is known."""
        opaque = pair.opaque > MIN_ALPHA
        if not pair.whole:  # the gradients along the unknown's edge are its own
            opaque = cv2.erode(opaque.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        a, b = (_gradients(image) * opaque[..., None] for image in (pair.photo, pair.render))
        sums = [_blocks(image).sum(2, dtype=np.float64) for image in (a * b, a * a, b * b)]
        alone, around = _correlations(*sums), _correlations(*(cv2.blur(i, (3, 3)) for i in sums))
        unspoilt = cv2.inRange(pair.photo, (0, 0, 0), (WHITE - 1, WHITE - 1, WHITE - 1))
        share = _blocks(unspoilt.astype(np.float32)).reshape(-1, 1) / 255
        means = [
            _blocks(cv2.copyTo(i, unspoilt).astype(np.float32)).reshape(-1, 3) / np.maximum(share, ENOUGH)
            for i in (pair.photo, pair.render)
        ]
        known = (_blocks(opaque.astype(np.float32)).ravel() > WHOLE) & (share[:, 0] > ENOUGH)
        return cls(alone, around, sums[2].ravel(), means[0], means[1], known)


def appearance(
    photo: UInt8[np.ndarray, "h w 3"], frame: Frame, known: Bool[np.ndarray, "h w"] | None = None
) -> dict[str, float]:
    """Return the signals of how alike photo and frame look."""
    pair = Pair.of(photo, frame, known)
    blocks = Blocks.of(pair)
    agreements = gradient_agreement(blocks) + colour_agreement(pair)
    return dict(zip(APPEARANCE, agreements, strict=True)) | {"tints": tint_agreement(blocks)}


def gradient_agreement(blocks: Blocks) -> tuple[float, float]:
    """Return how well the gradients correlate, -1..1.

    Blocks weigh by what the render has in them. Those that agree best and hold three quarters of the weight count,
    and for the second value, half of it: a passer-by spoils a few blocks, a wrong pose all.
    """
    worst_first = np.argsort(blocks.correlation)
    below = np.cumsum(blocks.weight[worst_first])

    def best(hidden: float) -> float:
        kept = worst_first[below > hidden * below[-1]]
        return float(blocks.correlation[kept] @ blocks.weight[kept] / max(blocks.weight[kept].sum(), SMALLEST))

    return best(HIDDEN_SHARE), best(HALF)


def tint_agreement(blocks: Blocks) -> float:
    """Return the correlation of the colours of blocks whose gradients agree, 0..1: all of them, none is left out.

    Each channel may be the render's channel with a part of its luma, neither negative, and an offset: of any exposure,
    white balance and saturation, down to a photo without colours. 1 where so few agree that their colours tell nothing.
    """
    if not blocks.known.any():
        return 1.0
    shows = blocks.weight > FLAT * np.median(blocks.weight[blocks.known])
    same = blocks.known & shows & (np.minimum(blocks.correlation, blocks.around) > SAME_FORM)
    if same.sum() < FEW:
        return 1.0
    photo, render = (rgb[same] - rgb[same].mean(0) for rgb in (blocks.photo_rgb, blocks.render_rgb))
    luma = (render @ LUMA)[:, None]
    of_channel, of_luma = _shares(photo, render, luma)
    expected = of_channel * render + of_luma * luma
    return _cosine(photo, expected)


def _shares(
    photo: Float32[np.ndarray, "n 3"], render: Float32[np.ndarray, "n 3"], luma: Float32[np.ndarray, "n 1"]
) -> tuple[Float32[np.ndarray, "3"], Float32[np.ndarray, "3"]]:
    """Return the factors of a render's channels and of its luma, none negative, that are nearest to the photo."""
    rr, ll, rl = ((u * v).sum(0) for u, v in ((render, render), (luma, luma), (render, luma)))
    pr, pl = (photo * render).sum(0), (photo * luma).sum(0)
    rr, ll = rr * (1 + RIDGE) + RIDGE, ll * (1 + RIDGE) + RIDGE  # a render may be without colours, too
    determinant = rr * ll - rl * rl
    of_channel, of_luma = (pr * ll - pl * rl) / determinant, (pl * rr - pr * rl) / determinant
    alone_r, alone_l = np.maximum(pr / rr, 0), np.maximum(pl / ll, 0)
    return (
        np.where(of_channel < 0, 0, np.where(of_luma < 0, alone_r, of_channel)),
        np.where(of_channel < 0, alone_l, np.where(of_luma < 0, 0, of_luma)),
    )


def both_known(frame: Frame, known: Bool[np.ndarray, "h w"] | None) -> Float32[np.ndarray, "h w"]:
    """Return how much each pixel is of the scene, 0..1, where the photo is known."""
    return frame.alpha if known is None else frame.alpha * known


def colour_agreement(pair: Pair) -> tuple[float, float]:
    """Return the correlation of the colours of two thumbnails, -1..1, where scene and photo are known.

    Each channel has its own gain and offset (exposure, white balance); the quarter, and for the second value the
    half, that fits them worst is left out.
    """
    height, width = pair.opaque.shape
    size = (max(1, round(width / COLOUR_SHRINK)), max(1, round(height / COLOUR_SHRINK)))
    layers = (pair.photo, pair.render, pair.opaque)
    small = [cv2.resize(layer, size, interpolation=cv2.INTER_AREA) for layer in layers]
    opaque = small[2] > MIN_ALPHA
    a, b = (np.ascontiguousarray(image[opaque].T, np.float32) for image in small[:2])
    if a.shape[1] < FEW:
        return 0.0, 0.0
    most = _correlation(a, b, HIDDEN_SHARE)
    return most, max(most, _correlation(a, b, HALF))  # a half that is of one colour tells nothing


def _correlation(a: Float32[np.ndarray, "3 n"], b: Float32[np.ndarray, "3 n"], hidden: float) -> float:
    """Return the correlation of what is left when the share that fits worst is left out, after three fits."""
    kept = np.ones(a.shape[1], np.float32)
    for _ in range(3):
        x, y = _centred(a, kept), _centred(b, kept)
        gain = ((x * y) @ kept) / np.maximum((y * y) @ kept, np.float32(1e-6))
        misfit = np.abs(x - gain[:, None] * y).sum(0)
        count = len(kept) - int(hidden * len(kept))
        kept = (misfit <= np.partition(misfit, count - 1)[count - 1]).astype(np.float32)
    return _cosine(_centred(a, kept) * kept, _centred(b, kept) * kept)


def _cosine(a: Float32[np.ndarray, "*n"], b: Float32[np.ndarray, "*n"]) -> float:
    return float((a * b).sum() / max(np.sqrt((a * a).sum() * (b * b).sum()), 1e-6))


def _centred(values: Float32[np.ndarray, "3 n"], kept: Float32[np.ndarray, "n"]) -> Float32[np.ndarray, "3 n"]:
    return values - (values @ kept / kept.sum())[:, None]


def _blocks(image: np.ndarray) -> Float32[np.ndarray, "rows columns channels"]:
    """Return the blocks' means."""
    rows, columns = image.shape[0] // BLOCK_PX, image.shape[1] // BLOCK_PX
    whole = image[: rows * BLOCK_PX, : columns * BLOCK_PX]
    means = np.asarray(cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA), np.float32)
    return means.reshape(rows, columns, -1)


def _correlations(ab: np.ndarray, aa: np.ndarray, bb: np.ndarray) -> Float64[np.ndarray, "n"]:
    return (ab / np.sqrt(np.maximum(aa * bb, 0.0) + SMALLEST)).ravel()


def _gradients(rgb: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w 2"]:
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    gray = cv2.GaussianBlur(gray, (0, 0), SIGMA_PX)
    along_x = cv2.Sobel(gray, cv2.CV_32F, 1, 0, ksize=1)
    along_y = cv2.Sobel(gray, cv2.CV_32F, 0, 1, ksize=1)
    return np.stack([along_x, along_y], 2)
