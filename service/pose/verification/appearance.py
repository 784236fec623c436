"""Appearance signals: how alike photo and render are, whatever the exposure, and with a part occluded.

    192 px, blocks of 8 x 8:   [][][][]...   gradients: do they correlate? In the better three quarters, and half
                               [][]##[]...   local colours: where a block's gradients do, do its colours, too?
                               [][]##[]...   ## occluded by a passer-by: neither does
    64 px, single pixels:      colours: do they correlate, in the better three quarters, and half?

Gradients alone can't distinguish similar things of different colours, and the colours of the better part leave out just
those that differ. What is occluded differs in both; a thing mistaken for a similar one, or for its mirror image,
differs in the local colours.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from service.interfaces import Frame
from service.pose.features.rendered_views import VIEWS, to_uint8

WHITE = 255
"""Value of a saturated channel."""
LUMA = np.array([0.299, 0.587, 0.114], np.float32)
"""Weights of red, green and blue in luma (ITU-R BT.601)."""
GLOBAL_SIGNALS = ("gradients", "gradients_half", "colours", "colours_half")
LOCAL_COLOUR = "local_colour_correlation"


@dataclass(frozen=True, slots=True)
class AppearanceConfig:
    """How photo and render are compared."""

    long_side_px: int = 192
    """Size of the comparison: coarse enough to ignore what training left blurred."""
    colour_shrink: int = 3
    """Single pixels are compared at a size smaller by this."""
    sigma_px: float = 0.7
    """Gaussian blur before gradients are computed."""
    block_px: int = 8
    hidden_share: float = 0.25
    half_share: float = 0.5
    """Shares of the photo that may be occluded, for a signal and its `_half`."""
    min_alpha: float = VIEWS.min_alpha
    """Opacity from which on a pixel counts as surface."""
    same_gradients: float = 0.7
    """Correlation of a block's gradients from which on photo and render show the same there."""
    flat_share: float = 0.1
    """Share of the median block's gradients below which a block shows nothing."""
    min_valid_share: float = 0.99
    min_unsaturated_share: float = 0.25
    """Shares of a block's pixels with which its colour counts."""
    ridge: float = 1e-4
    """Relative and absolute regularization of the colour fit: a render may be without colours."""
    min_count: int = 8
    """Blocks or pixels; fewer are no evidence."""
    fits: int = 3
    """Alternations of fitting gains and leaving out the pixels that fit worst."""
    edge_sigma_px: float = 1.5
    """Gaussian blur before colours' edges are compared: JPEG files have less detail in colours."""
    dark: float = 12.0
    """Added to a channel (0..255) before its logarithm: in the dark colours are noise."""

    @property
    def min_energy(self) -> float:
        """Squared gradients below which a block counts as flat, for the two images together."""
        return 1e-6 / self.block_px**4


APPEARANCE = AppearanceConfig()


@dataclass(frozen=True, slots=True)
class ImagePair:
    """A photo and a render of the same size, resampled."""

    photo: UInt8[np.ndarray, "h w 3"]
    render: UInt8[np.ndarray, "h w 3"]
    opaque: Float32[np.ndarray, "h w"]
    """Opacity of the render, 0..1, where the photo is valid."""
    whole: bool
    """Whether all of the photo is valid."""

    @classmethod
    def of(
        cls, photo: UInt8[np.ndarray, "h w 3"], frame: Frame, valid: Bool[np.ndarray, "h w"] | None = None
    ) -> ImagePair:
        """Resample a photo and a render of the same size; `valid` are the photo's valid pixels, None: all."""
        height, width = frame.alpha.shape
        factor = APPEARANCE.long_side_px / max(height, width)
        size = (max(APPEARANCE.block_px, round(width * factor)), max(APPEARANCE.block_px, round(height * factor)))
        render, opaque = to_uint8(frame.rgb), visible_alpha(frame, valid)
        # All three at one size and by area, so that they stay aligned.
        small = [cv2.resize(layer, size, interpolation=cv2.INTER_AREA) for layer in (photo, render, opaque)]
        return cls(small[0], small[1], small[2], valid is None)


@dataclass(frozen=True, slots=True)
class BlockStatistics:
    """A pair, block by block."""

    correlation: Float64[np.ndarray, "n"]
    """Correlation of the gradients, -1..1."""
    around: Float64[np.ndarray, "n"]
    """The same of the block with its neighbours: an occluder may agree in single blocks, by chance."""
    weight: Float64[np.ndarray, "n"]
    """Sum of the render's squared gradients; 0 where the scene is transparent or the photo invalid."""
    photo_rgb: Float32[np.ndarray, "n 3"]
    render_rgb: Float32[np.ndarray, "n 3"]
    """Means of the pixels that are not saturated in the photo."""
    valid: Bool[np.ndarray, "n"]
    """Whether the whole block is, and enough of it is not saturated."""

    @classmethod
    def of(cls, pair: ImagePair) -> BlockStatistics:
        """Compare where the scene is opaque and the photo is valid."""
        opaque = pair.opaque > APPEARANCE.min_alpha
        if not pair.whole:  # gradients along the mask's edge are the mask's
            opaque = cv2.erode(opaque.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        a, b = (_gradients(image) * opaque[..., None] for image in (pair.photo, pair.render))
        # Products per block give the correlation without a second pass.
        sums = [_blocks(image).sum(2, dtype=np.float64) for image in (a * b, a * a, b * b)]
        alone, around = _correlations(*sums), _correlations(*(cv2.blur(i, (3, 3)) for i in sums))
        # A saturated channel has lost its colour.
        unsaturated = cv2.inRange(pair.photo, (0, 0, 0), (WHITE - 1, WHITE - 1, WHITE - 1))
        share = _blocks(unsaturated.astype(np.float32)).reshape(-1, 1) / 255
        counted = np.maximum(share, APPEARANCE.min_unsaturated_share)
        means = [
            _blocks(cv2.copyTo(i, unsaturated).astype(np.float32)).reshape(-1, 3) / counted
            for i in (pair.photo, pair.render)
        ]
        whole = _blocks(opaque.astype(np.float32)).ravel() > APPEARANCE.min_valid_share
        valid = whole & (share[:, 0] > APPEARANCE.min_unsaturated_share)
        return cls(alone, around, sums[2].ravel(), means[0], means[1], valid)


def appearance(
    photo: UInt8[np.ndarray, "h w 3"], frame: Frame, valid: Bool[np.ndarray, "h w"] | None = None
) -> dict[str, float]:
    """Return the signals of how alike photo and frame look, by name; `valid` are the photo's valid pixels."""
    pair = ImagePair.of(photo, frame, valid)
    blocks = BlockStatistics.of(pair)
    agreements = gradient_correlation(blocks) + colour_correlation(pair)
    return dict(zip(GLOBAL_SIGNALS, agreements, strict=True)) | {LOCAL_COLOUR: local_colour_correlation(blocks)}


def colour_edge_correlation(
    photo: UInt8[np.ndarray, "h w 3"], frame: Frame, valid: Bool[np.ndarray, "h w"] | None = None
) -> float:
    """Return the correlation of the edges of photo and frame in colour, -1..1; `valid` are the photo's valid pixels.

    Compared are the gradients of the logarithms of red to green and of yellow to blue: ratios of neighbouring pixels,
    which depend neither on the light's colour nor on its brightness, also where these differ within the photo (Funt and
    Finlayson, "Color constant color indexing", IEEE PAMI 17, 1995). Where the scene has no colours, the value is low.
    """
    pair = ImagePair.of(photo, frame, valid)
    pixels = (pair.photo, pair.render)
    images = [cv2.GaussianBlur(rgb.astype(np.float32), (0, 0), APPEARANCE.edge_sigma_px) for rgb in pixels]
    # Square roots: each pair of gradients then weighs by the brightness of its pixel in the darker image.
    weight = np.sqrt(np.minimum(*(image.mean(2) for image in images)))
    weight *= cv2.erode(pair.opaque, np.ones((3, 3), np.uint8)) > APPEARANCE.min_alpha
    return _cosine(*(_colour_gradients(image) * weight[..., None] for image in images))


def gradient_correlation(blocks: BlockStatistics) -> tuple[float, float]:
    """Return the correlation of the gradients, -1..1: over the best three quarters, and over the best half.

    Blocks weigh by the render's squared gradients; shares are of that weight. A passer-by lowers the correlation of a
    few blocks, a wrong pose that of all.
    """
    # By correlation: what occludes the scene correlates least.
    worst_first = np.argsort(blocks.correlation)
    below = np.cumsum(blocks.weight[worst_first])

    def best(hidden: float) -> float:
        kept = worst_first[below > hidden * below[-1]]
        weight = blocks.weight[kept]
        return float(blocks.correlation[kept] @ weight / max(weight.sum(), APPEARANCE.min_energy))

    return best(APPEARANCE.hidden_share), best(APPEARANCE.half_share)


def local_colour_correlation(blocks: BlockStatistics) -> float:
    """Return the correlation of the colours of all blocks whose gradients agree, 0..1; 1 where those are too few.

    The photo's channels are fitted by the render's channel, its luma (both factors non-negative) and an offset, so that
    exposure, white balance and saturation don't matter, down to a photo without colours.
    """
    if not blocks.valid.any():
        return 1.0
    # Flat blocks correlate by chance.
    shows = blocks.weight > APPEARANCE.flat_share * np.median(blocks.weight[blocks.valid])
    same = blocks.valid & shows & (np.minimum(blocks.correlation, blocks.around) > APPEARANCE.same_gradients)
    if same.sum() < APPEARANCE.min_count:
        return 1.0
    photo, render = (rgb[same] - rgb[same].mean(0) for rgb in (blocks.photo_rgb, blocks.render_rgb))
    luma = (render @ LUMA)[:, None]
    of_channel, of_luma = _shares(photo, render, luma)
    expected = of_channel * render + of_luma * luma
    return _cosine(photo, expected)


def _shares(
    photo: Float32[np.ndarray, "n 3"], render: Float32[np.ndarray, "n 3"], luma: Float32[np.ndarray, "n 1"]
) -> tuple[Float32[np.ndarray, "3"], Float32[np.ndarray, "3"]]:
    """Return the non-negative least-squares factors of the render's channels and of its luma."""
    rr, ll, rl = ((u * v).sum(0) for u, v in ((render, render), (luma, luma), (render, luma)))
    pr, pl = (photo * render).sum(0), (photo * luma).sum(0)
    ridge = APPEARANCE.ridge
    rr, ll = rr * (1 + ridge) + ridge, ll * (1 + ridge) + ridge
    # Two unknowns a channel: the normal equations are solved in closed form.
    determinant = rr * ll - rl * rl
    of_channel, of_luma = (pr * ll - pl * rl) / determinant, (pl * rr - pr * rl) / determinant
    alone_r, alone_l = np.maximum(pr / rr, 0), np.maximum(pl / ll, 0)
    return (
        np.where(of_channel < 0, 0, np.where(of_luma < 0, alone_r, of_channel)),
        np.where(of_channel < 0, alone_l, np.where(of_luma < 0, 0, of_luma)),
    )


def visible_alpha(frame: Frame, valid: Bool[np.ndarray, "h w"] | None) -> Float32[np.ndarray, "h w"]:
    """Return the render's opacity where the photo is valid, else 0."""
    return frame.alpha if valid is None else frame.alpha * valid


def colour_correlation(pair: ImagePair) -> tuple[float, float]:
    """Return the correlation of the colours of single pixels, -1..1, where scene and photo are known.

    Each channel has its own gain and offset (exposure, white balance); the quarter of the pixels that fits them worst
    is left out, for the second value the half.
    """
    height, width = pair.opaque.shape
    size = (max(1, round(width / APPEARANCE.colour_shrink)), max(1, round(height / APPEARANCE.colour_shrink)))
    layers = (pair.photo, pair.render, pair.opaque)
    small = [cv2.resize(layer, size, interpolation=cv2.INTER_AREA) for layer in layers]
    opaque = small[2] > APPEARANCE.min_alpha
    a, b = (np.ascontiguousarray(image[opaque].T, np.float32) for image in small[:2])
    if a.shape[1] < APPEARANCE.min_count:
        return 0.0, 0.0
    most = _correlation(a, b, APPEARANCE.hidden_share)
    return most, max(most, _correlation(a, b, APPEARANCE.half_share))  # a half of one colour has no correlation


def _correlation(a: Float32[np.ndarray, "3 n"], b: Float32[np.ndarray, "3 n"], hidden: float) -> float:
    """Return the correlation of what is left when the share that fits worst is left out, by alternating fits."""
    kept = np.ones(a.shape[1], np.float32)
    for _ in range(APPEARANCE.fits):
        x, y = _centred(a, kept), _centred(b, kept)
        gain = ((x * y) @ kept) / np.maximum((y * y) @ kept, np.float32(1e-6))
        # The gain is fitted to what is kept, so one pass isn't enough.
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
    side = APPEARANCE.block_px
    rows, columns = image.shape[0] // side, image.shape[1] // side
    whole = image[: rows * side, : columns * side]
    means = np.asarray(cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA), np.float32)
    return means.reshape(rows, columns, -1)


def _correlations(ab: np.ndarray, aa: np.ndarray, bb: np.ndarray) -> Float64[np.ndarray, "n"]:
    return (ab / np.sqrt(np.maximum(aa * bb, 0.0) + APPEARANCE.min_energy)).ravel()


def _colour_gradients(rgb: Float32[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w 4"]:
    red, green, blue = cv2.split(np.log(rgb + np.float32(APPEARANCE.dark)))
    opponents = cv2.merge([red - green, 0.5 * (red + green) - blue])
    return np.concatenate([cv2.Sobel(opponents, cv2.CV_32F, *along, ksize=1) for along in ((1, 0), (0, 1))], 2)


def _gradients(rgb: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w 2"]:
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    gray = cv2.GaussianBlur(gray, (0, 0), APPEARANCE.sigma_px)
    along_x = cv2.Sobel(gray, cv2.CV_32F, 1, 0, ksize=1)
    along_y = cv2.Sobel(gray, cv2.CV_32F, 0, 1, ksize=1)
    return np.stack([along_x, along_y], 2)
