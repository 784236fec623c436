"""Photometric alignment: Gauss-Newton with IRLS-L1 against one frozen render with depth.

For the pixels x of a render I (intensity, depth: the point X in the render's camera frame) and the photo P:

    minimize  sum |r|,   r = P(project(T X)) - look(I)(x),   T = photo_camera_from_render_camera
    look(I) = gain I + bias + curve I (1 - I) + blur laplacian(I): exposure, haze, nearly any gamma, a little defocus

by inverse compositional steps (Baker and Matthews, IJCV 2004): the render is moved by a small twist, so its
gradients and Jacobians are computed once; each step solves 10 normal equations (twist and look; 13 with the
photo's lens, where that is approximate) with weights 1 / max(|r|, DELTA) that fall to nothing at CUT times the
median residual: what hides the scene has no say. Coarse to fine over an image pyramid. A saturated photo is compared
with a render cut off like it. The render's own change with the pose (occlusion, highlights) is ignored: render again
at the result and repeat.

Measured in the research: RGB, forward or symmetric gradients are no better on real photos; L2 is worst; two renders
are enough; the basin with four levels is some 10 degrees. The cut, here: with a third of the photo hidden medians
halve, and clean photos of poor models gain as much; blurred ones lose a little.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from service.geometry import moved, se3_exp, se3_log
from service.interfaces import Frame
from service.jit import inline, kernel, summing
from service.pose.absolute_pose.unknown_focal import correction_precision, correction_vector, stepped
from service.pose.refinement.covariance import inverse, spread, summed_by_cell
from service.pose.refinement.pyramid import cut_off, depth_pyramid, edge_owner_depth, luma, pyramid
from service.types import NO_CORRECTION, Camera, Intrinsics, IntrinsicsCorrection, Pose

TWIST, LOOK, LENS = slice(0, 6), slice(6, 10), slice(10, 13)
"""Places in the vector of unknowns."""
DELTA = 0.02
"""Residuals (0..1) below it are noise: they weigh like least squares."""
CUT = 9.0
MIN_SPREAD = 0.01
FOCAL_INFLATION = 2.5
"""Of the standard deviation that the cells' residuals give the focal length."""
LEAST_SPREAD = 0.09
"""What half of the photos of chair, materials and studio have: a photo whose quarters happen to agree isn't exacter
than the model. Each two of the scenes alone have 0.09 to 0.10."""
SPREAD_SHARE = 0.91
"""Of the spread that the quarters tell: what three quarters fit, they don't tell one another; were all quarters alike
it would be three quarters. Set so that the mean normalized error squared of each of those scenes is what it may be by
chance if the covariance is true: 4.3, 6.0 and 7.7."""
MAX_STEPS = 12
MAX_PIXELS, LENS_MAX_PIXELS = 10_000, 20_000
"""A level with more uses every second, third...: but for the lens 6000 were as exact as 30000 on the test scenes."""
MIN_PIXELS = 200
SETTLED_PX, SETTLED_COARSE_PX = 0.005, 0.05
"""Of the level, at the finest one and at those that a finer one follows."""
UNKNOWN = np.float32(-1e4)
"""In a photo; whatever mixes with it is negative, too."""
UNTOUCHED = np.array([1.0, 0.0, 0.0, 0.0])
"""The look of a photo that is like the render."""
SUSPICIOUS, FREE_SIGMA = 0.004, 0.15
"""Pull on a focal length that is said to be exact, from which on it is set free to see how far it goes."""
CORRELATED = 50.0
"""Neighbouring residuals err together: this many count as one observation against what is known of the lens."""


@dataclass(frozen=True, slots=True)
class RefinementResult:
    pose: Pose
    correction: IntrinsicsCorrection
    """Beside the intrinsics that were given."""
    loss: float
    """Mean absolute residual (0..1) at the finest level; infinite where too few pixels overlap."""
    end: _End | None = field(default=None, repr=False)


def refine_photometric(
    photo: UInt8[np.ndarray, "h w 3"],
    frame: Frame,
    camera: Camera,
    start: Camera,
    levels: int,
    lens: IntrinsicsCorrection = NO_CORRECTION,
    focal_sigma: float = 0.0,
    known: Bool[np.ndarray, "h w"] | None = None,
    roughly: bool = False,
) -> RefinementResult:
    """Move `start` until the photo, where it is known, agrees with the frame, which `camera` rendered.

    The photo has the frame's size; `start` has the photo's intrinsics, without the `lens` to begin with, and its pose
    need not be the camera's. The lens is estimated too unless `focal_sigma` (of the logarithm) is 0. `roughly` is
    enough where another alignment follows.
    """
    state = _State(start.pose.camera_from_world @ camera.pose.world_from_camera, lens, focal_sigma, UNTOUCHED.copy())
    loss, level = np.inf, None
    coarse_to_fine = _levels(photo, known, frame, camera.intrinsics, start.intrinsics, levels, bool(focal_sigma))
    for finer, level in zip(reversed(range(levels)), coarse_to_fine, strict=True):
        if finer and len(level.pixels) < MIN_PIXELS:
            continue  # so small, what is seen of the scene says nothing
        state.look[3] = 0.0  # another at each level
        loss = _align_level(level, state, SETTLED_COARSE_PX if finer or roughly else SETTLED_PX)
        if not np.isfinite(loss):
            return RefinementResult(start.pose, lens, loss)
    assert level is not None
    render_from_photo = np.linalg.inv(state.photo_from_render)
    pose = moved(camera.pose, se3_log(render_from_photo))
    return RefinementResult(pose, state.lens, loss, _End(frame, level, state.look))


@dataclass(slots=True)
class _State:
    photo_from_render: Float64[np.ndarray, "4 4"]
    lens: IntrinsicsCorrection
    focal_sigma: float
    look: Float64[np.ndarray, "4"]
    """Gain, bias, curve, blur (in squared pixels of the level)."""

    @property
    def slopes(self) -> Float64[np.ndarray, "13"]:
        """What the unknowns' columns are multiplied with: the photo shows the render's gradients times the gain."""
        factor = np.full(13, self.look[0])
        factor[LOOK] = 1.0
        return factor


@dataclass(frozen=True, slots=True)
class _Level:
    """One level of the pyramid, linearized."""

    photo: Float32[np.ndarray, "h w"]
    pixels: Int64[np.ndarray, "n"]
    """Places in the render without its border."""
    points: Float32[np.ndarray, "3 n"]
    columns: Float32[np.ndarray, "13 n"]
    photo_lens: Intrinsics

    def residuals(self, state: _State) -> tuple[Float32[np.ndarray, "n"], Float32[np.ndarray, "n"], float]:
        """Return residuals, weights (0 outside the photo), and the mean absolute residual, infinite if few overlap."""
        residuals, weights = np.empty((2, len(self.pixels)), np.float32)
        k = _parameters(self.photo_lens.corrected(state.lens))
        total, count = _residuals(
            self.photo, self.points, self.columns[LOOK], state.photo_from_render, k,
            state.look, DELTA, residuals, weights,
        )  # fmt: skip
        if count < MIN_PIXELS:
            return residuals, weights, np.inf
        return residuals, weights * _bisquare(residuals, weights), total / count


@dataclass(frozen=True, slots=True)
class _End:
    """Where an alignment ended: what it takes to weigh the answer."""

    frame: Frame
    level: _Level
    look: Float64[np.ndarray, "4"]


def _levels(
    photo: UInt8[np.ndarray, "h w 3"],
    known: Bool[np.ndarray, "h w"] | None,
    frame: Frame,
    render_lens: Intrinsics,
    photo_lens: Intrinsics,
    levels: int,
    lens_free: bool,
) -> Iterator[_Level]:
    """Linearize the levels of the pyramid, coarsest first; each only when it is asked for."""
    shown = luma(photo)
    if known is not None:
        shown[~known] = UNKNOWN
    photos, renders = pyramid(shown, levels), pyramid(luma(cut_off(photo, frame)), levels)
    depths = depth_pyramid(edge_owner_depth(frame), levels)
    for photo_level, render, depth in zip(reversed(photos), reversed(renders), reversed(depths), strict=True):
        height, width = render.shape
        pixels = np.flatnonzero(depth[1:-1, 1:-1].ravel() > 0)
        stride = max(1, -(-len(pixels) // (LENS_MAX_PIXELS if lens_free else MAX_PIXELS)))
        pixels = np.ascontiguousarray(pixels[::stride])  # one layout: one compilation
        points, columns = _linearize(render, depth, pixels, _parameters(render_lens.resized(width, height)))
        yield _Level(photo_level, pixels, points, columns, photo_lens.resized(width, height))


def _align_level(level: _Level, state: _State, settled_px: float = SETTLED_PX) -> float:
    """Run Gauss-Newton at one level, changing `state`; return the mean absolute residual."""
    if len(level.pixels) < MIN_PIXELS:
        return np.inf
    typical_depth = float(np.median(level.points[2]))
    loss = np.inf
    for _ in range(MAX_STEPS):
        residuals, weights, loss = level.residuals(state)
        if not np.isfinite(loss):
            return np.inf
        columns = level.columns if state.focal_sigma else level.columns[: LENS.start]
        step = _solved(columns, residuals, weights, state, loss)
        if not np.all(np.isfinite(step)):
            return np.inf
        state.photo_from_render = state.photo_from_render @ se3_exp(-step[TWIST])
        state.look += step[LOOK]
        if state.focal_sigma:
            state.lens = stepped(state.lens, step[LENS], state.focal_sigma)
        lens = level.photo_lens
        moved_px = lens.fx * (np.linalg.norm(step[:3]) + np.linalg.norm(step[3:6]) / typical_depth)
        if moved_px + lens.long_side * np.abs(step[LENS]).max() < settled_px:
            break
    return loss


@dataclass(frozen=True, slots=True)
class PoseUncertainty:
    """What the pixels say of a pose."""

    last_step: Float64[np.ndarray, "6"]
    """The twist (rad, scene units) by which alignment would still move the pose: true = pose @ exp(twist)."""
    covariance: Float64[np.ndarray, "k k"]
    """Of the twist; with an approximate lens also of its `correction_vector`."""
    focal_step: float
    """By how much the logarithm of the focal length would change if it were free..."""
    focal_sigma: float
    """...and the standard deviation of that."""


def pose_uncertainty(
    photo: UInt8[np.ndarray, "h w 3"],
    frame: Frame,
    camera: Camera,
    answer: Camera,
    focal_sigma: float,
    known: Bool[np.ndarray, "h w"] | None = None,
    result: RefinementResult | None = None,
) -> PoseUncertainty | None:
    """Weigh an answer against the frame, which `camera` rendered nearby; None where the pixels don't determine it.

    If `result` is the refinement with this frame that led to the answer, most is known already.
    """
    end = result.end if result and result.pose is answer.pose else None
    if end and end.frame is frame:
        level, look = replace(end.level, photo_lens=answer.intrinsics), end.look
    else:
        (level,) = _levels(photo, known, frame, camera.intrinsics, answer.intrinsics, 1, bool(focal_sigma))
        look = UNTOUCHED
    state = _State(answer.pose.camera_from_world @ camera.pose.world_from_camera, NO_CORRECTION, 0.0, look.copy())
    before = state.photo_from_render
    if not np.isfinite(_align_level(level, state)):
        return None
    pull = se3_log(before @ np.linalg.inv(state.photo_from_render))
    residuals, weights, _ = level.residuals(state)
    columns = level.columns * state.slopes[:, None].astype(np.float32)
    inner = (frame.alpha.shape[0] - 2, frame.alpha.shape[1] - 2)
    scores, hessians, places = summed_by_cell(columns, weights, residuals, level.pixels, inner, DELTA)
    size = spread(scores[:, : LENS.start], hessians[:, : LENS.start, : LENS.start], places)
    hessian, focal = hessians.sum(0), LENS.start + 1
    covariance = _covariance(hessian, SPREAD_SHARE * max(size, LEAST_SPREAD), focal_sigma)
    free_focal = inverse(hessian[:focal, :focal])
    if covariance is None:
        return None
    if free_focal is None:  # a flat wall seen straight on says nothing of it
        return PoseUncertainty(pull, covariance, 0.0, np.inf)
    focal_step = float((free_focal @ scores.sum(0)[:focal])[-1])
    if not focal_sigma and abs(focal_step) > SUSPICIOUS:
        # From a pose that makes up for a wrong focal length one step leads a fifth of the way.
        free = replace(state, focal_sigma=FREE_SIGMA, look=state.look.copy())
        _align_level(level, free)
        focal_step = float(np.log(free.lens.focal_factor))
    # A wrong lens makes residuals that are alike over quarters: against it only those of cells may be held.
    sigma = FOCAL_INFLATION * float(np.linalg.norm(scores[:, :focal] @ free_focal[-1]))
    return PoseUncertainty(pull, covariance, focal_step, sigma)


def _covariance(
    hessian: Float64[np.ndarray, "13 13"], size: float, focal_sigma: float
) -> Float64[np.ndarray, "k k"] | None:
    """Return the covariance of the twist, with an approximate lens also of that; None if it isn't positive definite."""
    if not np.isfinite(size):
        return None
    if not focal_sigma:
        found = inverse(hessian[: LENS.start, : LENS.start])
        return None if found is None else size * found[TWIST, TWIST]
    information = hessian / size
    information[LENS, LENS] += np.diag(correction_precision(focal_sigma))
    keep = np.r_[TWIST, LENS]
    found = inverse(information)
    return None if found is None else found[np.ix_(keep, keep)]


def _parameters(lens: Intrinsics) -> Float64[np.ndarray, "4"]:
    return np.array([lens.fx, lens.fy, lens.cx, lens.cy])


def _bisquare(residuals: Float32[np.ndarray, "n"], weights: Float32[np.ndarray, "n"]) -> Float32[np.ndarray, "n"]:
    """Return Tukey's weights: 1 at no residual, 0 from CUT medians on."""
    some = np.abs(residuals[::4][weights[::4] > 0])
    middle = len(some) // 2
    spread = max(float(np.partition(some, middle)[middle]), MIN_SPREAD) if len(some) else MIN_SPREAD
    ratio = residuals * np.float32(1 / (CUT * spread))
    kept = np.maximum(1 - ratio * ratio, 0)
    return kept * kept


def _solved(
    columns: Float32[np.ndarray, "k n"],
    residuals: Float32[np.ndarray, "n"],
    weights: Float32[np.ndarray, "n"],
    state: _State,
    loss: float,
) -> Float64[np.ndarray, "13"]:
    """Solve the weighted normal equations; each unknown is scaled, for they differ by orders of magnitude."""
    size = len(columns)
    hessian, right = _normal_equations(columns, weights, residuals, state.slopes)
    if state.focal_sigma:
        trust = CORRELATED * loss * correction_precision(state.focal_sigma)
        hessian[range(10, 13), range(10, 13)] += trust
        right[LENS] -= trust * correction_vector(state.lens)
    scale = 1.0 / np.sqrt(np.maximum(hessian.diagonal(), 1e-12))
    damped = hessian * scale * scale[:, None]
    damped[range(size), range(size)] += 1e-6
    step = np.zeros(13)
    step[:size] = scale * np.linalg.solve(damped, scale * right)
    return step


@kernel
def _linearize(render, depth, pixels, k):
    """Return the points in the render's camera frame, and the columns d value / d (twist, look, lens).

    The twist moves the points, the gain's column is the render's value. The last three: `correction_vector`.
    """
    fx, fy, cx, cy = k[0], k[1], k[2], k[3]
    inner = render.shape[1] - 2
    n = len(pixels)
    points = np.empty((3, n), np.float32)
    columns = np.empty((13, n), np.float32)
    side = max(render.shape)
    for i in range(n):
        row, column = pixels[i] // inner + 1, pixels[i] % inner + 1
        z = depth[row, column]
        x, y = (column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy
        points[0, i], points[1, i], points[2, i] = x * z, y * z, z
        # d value / d (x / z) and d value / d (y / z)
        du = 0.5 * (render[row, column + 1] - render[row, column - 1]) * fx
        dv = 0.5 * (render[row + 1, column] - render[row - 1, column]) * fy
        along = du * x + dv * y
        columns[0, i] = -dv - along * y
        columns[1, i] = du + along * x
        columns[2, i] = dv * x - du * y
        columns[3, i] = du / z
        columns[4, i] = dv / z
        columns[5, i] = -along / z
        columns[6, i] = render[row, column]
        columns[7, i] = 1.0
        columns[8, i] = render[row, column] * (np.float32(1) - render[row, column])
        around = render[row, column + 1] + render[row, column - 1] + render[row + 1, column] + render[row - 1, column]
        columns[9, i] = around - np.float32(4) * render[row, column]
        columns[10, i] = -along
        columns[11, i] = -du / fx * side
        columns[12, i] = -dv / fy * side
    return points, columns


@kernel
def _residuals(photo, points, basis, transform, k, look, delta, residuals, weights):
    """Fill residuals and weights, 0 where the photo doesn't say; return the sum of |r| and how many pixels it has.

    In three passes, so that the first and the last do several pixels at a time:
    points -> places in the photo -> its values there -> residuals.
    """
    n = points.shape[1]
    right, down = np.empty((2, n), np.float32)
    _places(points, transform.astype(np.float32), k.astype(np.float32), photo.shape, right, down)
    width, flat = photo.shape[1], photo.ravel()
    for i in range(n):
        if right[i] < 0:
            residuals[i] = -1.0
            continue
        column, row = np.int32(right[i]), np.int32(down[i])
        a, b = right[i] - np.float32(column), down[i] - np.float32(row)
        at = np.uint32(row * width + column)
        below = at + np.uint32(width)
        upper = flat[at] + a * (flat[at + np.uint32(1)] - flat[at])
        lower = flat[below] + a * (flat[below + np.uint32(1)] - flat[below])
        residuals[i] = upper + b * (lower - upper)
    gain, bias, curve, blur = np.float32(look[0]), np.float32(look[1]), np.float32(look[2]), np.float32(look[3])
    delta, total, count = np.float32(delta), 0.0, 0
    for i in range(n):
        shown = residuals[i]
        residual = shown - gain * basis[0, i] - bias - curve * basis[2, i] - blur * basis[3, i]
        residuals[i] = residual if shown >= 0 else np.float32(0)
        weights[i] = np.float32(1) / max(abs(residual), delta) if shown >= 0 else np.float32(0)
    for i in range(n):
        total += abs(residuals[i])
        count += weights[i] > 0
    return total, count


@inline
def _places(points, t, k, shape, right, down):
    """Fill where the points are seen in the photo, in pixels from the centre of its first one; right: -1 if outside."""
    fx, fy, cx, cy = k[0], k[1], k[2] - np.float32(0.5), k[3] - np.float32(0.5)
    last_column, last_row = np.float32(shape[1] - 1), np.float32(shape[0] - 1)
    t00, t01, t02, t03 = t[0, 0], t[0, 1], t[0, 2], t[0, 3]
    t10, t11, t12, t13 = t[1, 0], t[1, 1], t[1, 2], t[1, 3]
    t20, t21, t22, t23 = t[2, 0], t[2, 1], t[2, 2], t[2, 3]
    for i in range(points.shape[1]):
        x, y, z = points[0, i], points[1, i], points[2, i]
        depth = t20 * x + t21 * y + t22 * z + t23
        nearness = np.float32(1) / depth
        u = fx * ((t00 * x + t01 * y + t02 * z + t03) * nearness) + cx
        v = fy * ((t10 * x + t11 * y + t12 * z + t13) * nearness) + cy
        inside = (depth > 0) & (u >= 0) & (v >= 0) & (u < last_column) & (v < last_row)
        right[i] = u if inside else np.float32(-1)
        down[i] = v


@summing
def _normal_equations(columns, weights, residuals, factor):
    """Return columns . weights . columns^T and columns . weights . residuals; each column times its factor."""
    count, n = columns.shape
    hessian, right = np.empty((count, count)), np.empty(count)
    weighted = np.empty(n, np.float32)
    for a in range(count):
        total = np.float32(0)
        for i in range(n):
            weighted[i] = columns[a, i] * weights[i]
            total += weighted[i] * residuals[i]
        right[a] = factor[a] * total
        for b in range(a + 1):
            total = np.float32(0)
            for i in range(n):
                total += weighted[i] * columns[b, i]
            hessian[a, b] = hessian[b, a] = factor[a] * factor[b] * total
    return hessian, right
