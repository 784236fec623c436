"""The kernels of images and cells as plain Python: beside numpy, finite differences and brute force."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from plain_kernels import plain

from service.geometry import moved, project, se3_exp, transformed
from service.types import Intrinsics, Pose

patches = plain("service.pose.training_photos.patch_kernels")
refinement = plain("service.pose.refinement.kernels")
lens_kernels = plain("service.pose.absolute_pose.lens_kernels")
floaters = plain("service.pose.retrieval.floaters")
free_space = plain("service.pose.retrieval.free_space")

POSE = moved(Pose(np.eye(4)), np.array([0.1, -0.2, 0.15, 0.3, -0.2, 0.1]))
LENS = Intrinsics(640, 480, 500.0, 480.0, 310.0, 250.0)
K = np.array([LENS.fx, LENS.fy, LENS.cx, LENS.cy])


@pytest.fixture(autouse=True)
def silent() -> Iterator[None]:
    """Divide by zero and overflow as machine code does."""
    with np.errstate(all="ignore"):
        yield


def points_ahead(count: int) -> np.ndarray:
    """In the world, 2 to 6 in front of POSE."""
    local = np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 6], (count, 3))
    return transformed(POSE.world_from_camera, local)


def bilinear(image: np.ndarray, x: float, y: float) -> float:
    """The value at a place in pixels from the first pixel's centre."""
    left, top = int(np.floor(x)), int(np.floor(y))
    a, b = x - left, y - top
    square = image[top : top + 2, left : left + 2].astype(float)
    return float(np.array([1 - b, b]) @ square @ np.array([1 - a, a]))


# ------------------------------------------------------------------ pose and lens


def test_a_projection_is_linearized_in_pose_and_lens() -> None:
    """Radial distortion, focal length and principal point, by finite differences; a point behind has no part."""
    points = points_ahead(6)
    points[2] = transformed(POSE.world_from_camera, np.array([[0.1, 0.2, -3.0]]))[0]
    points[3] = transformed(POSE.world_from_camera, np.array([[0.1, 0.2, 0.0]]))[0]
    photo_px = np.random.default_rng(1).uniform(0, 400, (6, 2))
    here = np.array([0.0, 0.1, 0.02, -0.01])  # ln focal factor, k1, shifts in long sides

    def by_hand(pose: Pose, vector: np.ndarray) -> np.ndarray:
        u, v = (lambda p: p[:, :2] / p[:, 2:])(transformed(pose.camera_from_world, points)).T
        radial = np.exp(vector[0]) * (1 + vector[1] * (u**2 + v**2))
        at = vector[2:] * LENS.long_side
        return photo_px - np.stack([LENS.fx * u * radial + LENS.cx + at[0], LENS.fy * v * radial + LENS.cy + at[1]], 1)

    matrix = POSE.camera_from_world
    camera = (LENS.fx, LENS.fy, LENS.cx + 0.02 * 640, LENS.cy - 0.01 * 640, 0.1, 640.0)
    jacobian, residual, ahead = lens_kernels.linearize_projection(
        photo_px, matrix[:3, :3], matrix[:3, 3], points, camera
    )
    assert ahead.tolist() == [True, True, False, False, True, True]
    assert not jacobian[~ahead].any()
    assert not residual[~ahead].any()
    assert np.allclose(residual[ahead], by_hand(POSE, here)[ahead])
    for i, step in enumerate(1e-6 * np.eye(6)):
        slope = (by_hand(moved(POSE, -step), here) - by_hand(moved(POSE, step), here)) / 2e-6
        assert np.allclose(jacobian[ahead, :, i], slope[ahead], rtol=1e-5, atol=1e-3)
    for i, step in enumerate(1e-6 * np.eye(4)):
        slope = (by_hand(POSE, here - step) - by_hand(POSE, here + step)) / 2e-6
        assert np.allclose(jacobian[ahead, :, 6 + i], slope[ahead], rtol=1e-5, atol=1e-3)


# ------------------------------------------------------------------ patches


def test_surface_points_and_the_steps_of_their_patches_are_projected() -> None:
    points, tangents = points_ahead(4), np.random.default_rng(1).normal(0, 0.01, (4, 3, 2))
    px, depth, photo_from_patch = patches.project_surface(points, tangents, POSE.camera_from_world, K)
    local = transformed(POSE.camera_from_world, points)
    assert np.allclose(px, project(local, LENS))
    assert np.allclose(depth, local[:, 2])
    for axis in range(2):
        ends = [
            project(transformed(POSE.camera_from_world, points + sign * 1e-4 * tangents[..., axis]), LENS)
            for sign in (1, -1)
        ]
        assert np.allclose(photo_from_patch[:, :, axis], (ends[0] - ends[1]) / 2e-4, rtol=1e-5, atol=1e-5)


def test_a_patch_is_warped_to_the_window_and_its_border() -> None:
    patch = np.random.default_rng(2).integers(0, 255, (11, 11)).astype(np.uint8)
    warp, radius = np.array([[0.9, 0.35], [-0.3, 1.2]]), 3
    warped, known = np.empty(81, np.float32), 0
    patches._warp_patch(patch, warp, radius, warped)
    for row in range(9):
        for column in range(9):
            x, y = warp @ [column - 4, row - 4] + 5
            inside = 0 <= x < 10 and 0 <= y < 10
            expected = bilinear(patch, x, y) if inside else -1.0
            assert warped[9 * row + column] == pytest.approx(expected, abs=1e-3)
            known += inside
    assert 40 < known < 81
    patches._warp_patch(patch, np.eye(2), 4, whole := np.empty(121, np.float32))
    # The first pixels have values; the last ones would need the next.
    assert np.all((whole.reshape(11, 11) >= 0) == (np.arange(11) < 10)[:, None] * (np.arange(11) < 10))
    patches._warp_patch(patch, np.eye(2), 5, whole := np.empty(169, np.float32))
    assert np.argwhere(whole.reshape(13, 13) >= 0).min(0).tolist() == [1, 1]


def test_a_template_and_its_gradients_ignore_gain_and_bias() -> None:
    rng, window = np.random.default_rng(3), 7
    warped = rng.uniform(0, 255, 81).astype(np.float32)
    warped[[0, 30]] = -1.0, 0.0  # a corner that no pixel needs, and a black pixel, which is known
    warped[9 * 4 + 7] = -1.0
    inside, template, gx, gy = np.empty((4, 49), np.float32)
    used = patches._fill_template(warped, window, inside, template, gx, gy)
    grid = warped.reshape(9, 9)
    known = np.ones((7, 7), bool)
    for row, column in ((3, 6), (2, 6), (4, 6), (3, 5)):  # the unknown one and its neighbours within the window
        known[row, column] = False
    assert used == known.sum() == 45
    assert np.array_equal(inside.reshape(7, 7) > 0, known)
    middle = grid[1:-1, 1:-1]
    slopes = [(0.5 * (grid[1:-1, 2:] - grid[1:-1, :-2]))[known], (0.5 * (grid[2:, 1:-1] - grid[:-2, 1:-1]))[known]]
    centred = middle[known] - middle[known].mean()
    assert np.allclose(template[known.ravel()], centred, atol=1e-3)
    basis = np.stack([np.ones_like(centred), centred], 1)
    for found, slope in zip((gx, gy), slopes, strict=True):
        rest = slope - basis @ np.linalg.lstsq(basis, slope, rcond=None)[0]
        assert np.allclose(found[known.ravel()], rest, atol=1e-2)
        assert not found[~known.ravel()].any()
    assert not template[~known.ravel()].any()
    nothing = np.full(81, -1.0, np.float32)
    assert patches._fill_template(nothing, window, inside, template, gx, gy) == 0
    assert not np.any([inside, template, gx, gy])


def test_a_window_is_sampled_between_pixels_and_correlated() -> None:
    rng = np.random.default_rng(4)
    photo = rng.integers(0, 255, (20, 30)).astype(np.uint8)
    values = np.empty(25, np.float32)
    patches._fill_window(photo, 6.3, 4.8, 5, values)
    expected = [bilinear(photo, 6.3 + x, 4.8 + y) - 128 for y in range(5) for x in range(5)]
    assert np.allclose(values, expected, atol=1e-3)
    inside = (rng.random(25) > 0.3).astype(np.float32)
    template, gx, gy = rng.normal(size=(3, 25)).astype(np.float32)
    sums = patches._correlate(values, inside, template, gx, gy)
    kept = values * inside
    assert np.allclose(sums, [gx @ kept, gy @ kept, template @ kept, kept.sum(), kept @ kept], rtol=1e-4)


def picture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 128 + 50 * np.sin(0.5 * x + 0.2 * y) + 40 * np.sin(0.3 * x - 0.55 * y + 1)


def found_in(photo: np.ndarray, start: list[float], patch: np.ndarray | None = None, **changed: float):
    """Match a patch of the picture, from its pixel (20, 20) on; its middle is at (30, 30)."""
    at = {"steps": 20, "settled_px": 0.005, "max_motion_px": 4.0, "min_contrast": 2.0} | changed
    patch = photo[20:41, 20:41] if patch is None else patch
    place, similarity = patches.match_patches(
        photo, patch[None], np.eye(2)[None], np.array([start]), 5, int(at["steps"]), at["settled_px"],
        at["max_motion_px"], at["min_contrast"],
    )  # fmt: skip
    return place[0], similarity[0]


def test_a_patch_is_found_where_it_was_cut_out() -> None:
    row, column = np.mgrid[:60, :70].astype(float)
    photo = np.round(picture(column, row)).astype(np.uint8)
    place, similarity = found_in(photo, [31.8, 29.2])
    assert np.allclose(place, 30.5, atol=0.02)
    assert similarity == pytest.approx(1.0, abs=1e-3)
    darker = np.round(0.5 * photo + 60).astype(np.uint8)
    place, similarity = found_in(darker, [31.8, 29.2], photo[20:41, 20:41])
    assert np.allclose(place, 30.5, atol=0.03)
    assert similarity > 0.995
    noisy = np.clip(photo + np.random.default_rng(5).normal(0, 30, photo.shape), 0, 255).astype(np.uint8)
    _, similarity = found_in(noisy, [30.5, 30.5], photo[20:41, 20:41], settled_px=9.0)
    near = noisy[25:36, 25:36].astype(float).ravel(), photo[25:36, 25:36].astype(float).ravel()
    assert similarity == pytest.approx(np.corrcoef(*near)[0, 1], abs=1e-4)
    assert similarity < 0.9


@pytest.mark.parametrize(
    ("start", "changed", "is_found"),
    [
        ([31.5, 30.5], {"max_motion_px": 1.5}, True),
        ([31.5, 30.5], {"max_motion_px": 0.9}, False),
        ([30.5, 29.5], {"max_motion_px": 1.5}, True),
        ([30.5, 29.5], {"max_motion_px": 0.9}, False),
        ([31.5, 30.5], {"steps": 1}, False),
        ([30.5, 30.5], {"steps": 1, "settled_px": 0.5}, True),
    ],
)
def test_a_match_settles_within_the_steps_and_motions_that_are_allowed(start, changed, is_found) -> None:
    row, column = np.mgrid[:60, :70].astype(float)
    place, similarity = found_in(np.round(picture(column, row)).astype(np.uint8), start, **changed)
    assert (similarity != patches.OUTSIDE) == is_found
    assert np.allclose(place, 30.5 if is_found else start, rtol=0, atol=0.05 if is_found else 0)


def test_windows_at_the_border_of_a_photo() -> None:
    """A window of 11 pixels, and the pixel after it."""
    row, column = np.mgrid[:60, :70].astype(float)
    photo = np.round(picture(column, row)).astype(np.uint8)
    for place, is_found in (
        ([5.5, 30.5], True), ([5.4, 30.5], False), ([30.5, 5.5], True), ([30.5, 5.4], False),
        ([64.4, 30.5], True), ([64.5, 30.5], False), ([30.5, 54.4], True), ([30.5, 54.5], False),
    ):  # fmt: skip
        x, y = round(place[0] - 0.5), round(place[1] - 0.5)
        grown = picture(*np.meshgrid(np.arange(x - 10, x + 11), np.arange(y - 10, y + 11)))
        _, similarity = found_in(photo, place, np.round(grown).astype(np.uint8), steps=1, settled_px=2.0)
        assert (similarity != patches.OUTSIDE) == is_found, place


def test_patches_without_contrast_or_corner_are_not_looked_for() -> None:
    row, column = np.mgrid[:60, :70].astype(float)
    photo = np.round(picture(column, row)).astype(np.uint8)
    spread = photo[25:36, 25:36].std()
    assert found_in(photo, [30.5, 30.5], min_contrast=0.99 * spread)[1] > 0.9
    assert found_in(photo, [30.5, 30.5], min_contrast=1.01 * spread)[1] == patches.OUTSIDE
    edge = np.round(picture(column, 0 * row)).astype(np.uint8)
    assert found_in(edge, [30.5, 30.5])[1] == patches.OUTSIDE
    small = photo[25:36, 25:36]  # of the window of 11 x 11 pixels 8 x 8 are known: 0.53
    assert found_in(photo, [30.5, 30.5], small)[1] == patches.OUTSIDE
    assert found_in(photo, [30.5, 30.5], photo[24:37, 24:37])[1] > 0.9  # 10 x 10: 0.83


def test_places_are_whitened_by_matching_and_the_points_uncertainty() -> None:
    rng, points = np.random.default_rng(6), points_ahead(3)
    half = rng.normal(0, 0.01, (3, 3, 3))
    covariances, observed = half @ half.transpose(0, 2, 1), rng.uniform(0, 400, (3, 2))
    rows, residuals = np.empty((3, 2, 6)), np.empty((3, 2))
    patches.linearize_places(points, covariances, observed, POSE.camera_from_world, K, 0.5, rows, residuals)

    def places(pose: Pose, moved_points: np.ndarray) -> np.ndarray:
        return project(transformed(pose.camera_from_world, moved_points), LENS)

    by_point = np.stack([(places(POSE, points + s) - places(POSE, points - s)) / 2e-6 for s in 1e-6 * np.eye(3)], -1)
    by_twist = np.stack(
        [(places(moved(POSE, s), points) - places(moved(POSE, -s), points)) / 2e-6 for s in 1e-6 * np.eye(6)], -1
    )
    for i in range(3):
        spread = by_point[i] @ covariances[i] @ by_point[i].T + 0.25 * np.eye(2)
        whitening = np.linalg.inv(np.linalg.cholesky(spread))
        assert np.allclose(residuals[i], whitening @ (observed[i] - places(POSE, points)[i]), rtol=1e-5)
        assert np.allclose(rows[i], whitening @ by_twist[i], rtol=1e-4, atol=1e-3)


# ------------------------------------------------------------------ photometric refinement


def test_intensities_are_linearized_as_finite_differences_of_a_parabola_say() -> None:
    """Central differences of a parabola are its slopes; depths, gain, bias, gamma and blur, lens."""
    height, width = 9, 12
    k = np.array([14.0, 13.0, 5.7, 4.6])
    y, x = np.mgrid[:height, :width]

    def shade(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """At pixel coordinates with the first pixel's centre at 0."""
        return 0.4 + 0.02 * u - 0.03 * v + 0.002 * u**2 + 0.003 * v**2

    render, depth = shade(x, y), 2 + 0.1 * x + 0.05 * y
    pixels = np.array([0, 7, 23, 69])
    points, jacobian = refinement.linearize(render, depth, pixels, k)
    row, column = pixels // 10 + 1, pixels % 10 + 1
    rays = np.stack([(column + 0.5 - k[2]) / k[0], (row + 0.5 - k[3]) / k[1], np.ones(4)])
    assert np.allclose(points, rays * depth[row, column], rtol=1e-5)

    def seen(local: np.ndarray, vector: np.ndarray) -> np.ndarray:
        """Where the render's surface point shows after a motion, in a photo with other intrinsics."""
        u, v = local[0] / local[2], local[1] / local[2]
        return shade(k[0] * u + k[2] - 0.5, k[1] * v + k[3] - 0.5)

    at = points.astype(float)
    for i, step in enumerate(1e-6 * np.eye(6)):
        ends = [seen(transformed(se3_exp(sign * step), at.T).T, np.zeros(4)) for sign in (1, -1)]
        assert np.allclose(jacobian[i], (ends[0] - ends[1]) / 2e-6, rtol=1e-3, atol=1e-5)
    shown = render[row, column]
    assert np.allclose(jacobian[6], shown)
    assert np.allclose(jacobian[7], 1)
    assert np.allclose(jacobian[8], shown * (1 - shown))
    assert np.allclose(jacobian[9], 2 * 0.002 + 2 * 0.003, atol=1e-5)  # the Laplacian of the parabola
    # The photo at a pixel shows what the render has nearer to the middle where the photo's lens is longer.
    u, v = rays[0], rays[1]
    for i, direction in enumerate(((u, v), (u * (u**2 + v**2), v * (u**2 + v**2)))):
        ends = [
            shade(k[0] * (u - s * direction[0]) + k[2] - 0.5, k[1] * (v - s * direction[1]) + k[3] - 0.5)
            for s in (1e-6, -1e-6)
        ]
        assert np.allclose(jacobian[10 + i], (ends[0] - ends[1]) / 2e-6, rtol=1e-3, atol=1e-5)
    for i, axis in enumerate(np.eye(2)):
        ends = [shade(column - 12 * s * axis[0], row - 12 * s * axis[1]) for s in (1e-6, -1e-6)]
        assert np.allclose(jacobian[12 + i], (ends[0] - ends[1]) / 2e-6, rtol=1e-3, atol=1e-5)


def test_residuals_and_weights_of_points_in_a_photo() -> None:
    rng = np.random.default_rng(7)
    photo = rng.uniform(0, 1, (30, 40)).astype(np.float32)
    photo[10:14, 10:14] = -1.0  # unknown
    camera, k1 = Intrinsics(40, 30, 45.0, 43.0, 19.0, 16.0), 0.08
    points = rng.uniform([-1.6, -1.2, 2], [1.6, 1.2, 4], (300, 3)).astype(np.float32)
    points[0, 2] = -2.0
    points[1, 2] = 0.0
    basis = rng.uniform(0, 1, (4, 300)).astype(np.float32)
    transform = se3_exp(np.array([0.02, -0.03, 0.05, 0.05, -0.02, 0.1]))
    gains = np.array([0.8, 0.1, 0.3, 0.2])
    residuals, weights = np.empty((2, 300), np.float32)
    k = np.array([camera.fx, camera.fy, camera.cx, camera.cy, k1])
    total, count = refinement.fill_residuals(
        photo, points.T.copy(), basis, transform, k, gains, 0.05, residuals, weights
    )
    local = transformed(transform, points.astype(float))
    u, v = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
    radial = 1 + k1 * (u**2 + v**2)
    x, y = camera.fx * u * radial + camera.cx - 0.5, camera.fy * v * radial + camera.cy - 0.5
    used = 0
    for i in range(300):
        inside = local[i, 2] > 0 and 0 <= x[i] < 39 and 0 <= y[i] < 29
        value = bilinear(photo, x[i], y[i]) if inside else -1.0
        if value < 0:
            assert residuals[i] == weights[i] == 0
            continue
        expected = value - gains[0] * basis[0, i] - gains[1] - gains[2] * basis[2, i] - gains[3] * basis[3, i]
        assert residuals[i] == pytest.approx(expected, abs=1e-3)
        assert weights[i] == pytest.approx(1 / max(abs(residuals[i]), 0.05), rel=1e-4)
        used += 1
    assert 50 < used < 250
    assert count == used
    assert total == pytest.approx(np.abs(residuals).sum(), rel=1e-5)


def test_places_at_the_border_of_a_photo_have_values() -> None:
    """From the first pixel's centre on, up to but without the last one's."""
    k, columns, rows = np.array([1.0, 1.0, 0.5, 0.5, 0.0], np.float32), *np.empty((2, 6), np.float32)
    places = np.array([[0, 0], [-0.01, 0], [0, -0.01], [3.99, 2.99], [4, 1], [1, 3]], np.float32)
    points = np.vstack([places.T, np.ones(6, np.float32)])
    refinement._project_points(points, np.eye(4, dtype=np.float32), k, (4, 5), columns, rows)
    assert (columns >= 0).tolist() == [True, False, False, True, False, False]
    points[2] = 0.0
    refinement._project_points(points, np.eye(4, dtype=np.float32), k, (4, 5), columns, rows)
    assert np.all(columns == -1)


@pytest.mark.parametrize("known", [10, 14])
def test_damped_normal_equations_are_solved_as_by_lapack(known: int) -> None:
    rng = np.random.default_rng(known)
    # Unknowns of very different sizes, one without any gradient, as the blur of a flat render.
    jacobian = rng.normal(size=(known, 40)) * 10.0 ** rng.uniform(-4, 4, (known, 1))
    jacobian[3] = 0.0
    hessian, rhs = jacobian @ jacobian.T, jacobian @ rng.normal(size=40)
    scale = np.diag(1 / np.sqrt(np.maximum(np.diag(hessian), 1e-12)))
    expected = scale @ np.linalg.solve(scale @ hessian @ scale + 1e-3 * np.eye(known), scale @ rhs)
    found = refinement.damped_solution(hessian, rhs, 1e-3)
    assert np.allclose(found, expected, rtol=1e-9, atol=0)
    assert found[3] == 0.0
    assert not np.isfinite(refinement.damped_solution(np.full((2, 2), np.nan), rhs[:2], 1e-3)).any()


def test_normal_equations_and_scores_by_cell_are_sums() -> None:
    rng = np.random.default_rng(8)
    jacobian = rng.normal(size=(5, 70)).astype(np.float32)
    weights, residuals = rng.uniform(0, 2, 70).astype(np.float32), rng.normal(0, 0.1, 70).astype(np.float32)
    factors = rng.uniform(0.5, 2, 5)
    hessian, rhs = refinement.normal_equations(jacobian, weights, residuals, factors)
    scaled = factors[:, None] * jacobian
    assert np.allclose(hessian, (scaled * weights) @ scaled.T, rtol=1e-4, atol=1e-4)
    assert np.allclose(rhs, (scaled * weights) @ residuals, rtol=1e-4, atol=1e-4)
    # Ten pixels a row, cells of 4: three across and two down.
    pixels = rng.permutation(70)
    residuals[3] = np.float32(0.1)
    scores, hessians, used = refinement.sum_scores_by_cell(
        jacobian, weights, residuals, pixels, 10, 4, 6, np.float32(0.1)
    )
    cell = pixels // 10 // 4 * 3 + pixels % 10 // 4
    for c in range(6):
        own = cell == c
        curved = own & (np.abs(residuals) < np.float32(0.1))
        assert used[c] == own.sum()
        assert np.allclose(scores[c], (jacobian * weights * residuals)[:, own].sum(1), atol=1e-4)
        by_hand = (jacobian * weights)[:, curved] @ jacobian[:, curved].T
        assert np.allclose(hessians[c], by_hand, atol=1e-4)


# ------------------------------------------------------------------ cells


def test_areas_are_summed_in_the_cells_that_are_asked_for() -> None:
    """A third of a side is a cell; what is as long as the side isn't counted, nor what lies in other cells."""
    rng = np.random.default_rng(9)
    means, areas = rng.uniform(-2, 2, (200, 3)), rng.uniform(0, 1, 200)
    largest, side = rng.uniform(0, 1.2, 200), 1.0
    largest[4] = side  # its cell is asked for
    cells = np.floor(means / (side / 3)).astype(np.int64)
    asked = np.unique(cells[::2], axis=0)
    keys = floaters._keys(asked)
    table, totals = np.full(512, -1, np.int64), np.zeros(512)
    floaters._insert(table, keys)
    assert np.array_equal(np.sort(table[table != -1]), np.sort(keys))
    floaters._add_areas(table, totals, means, areas, largest, side)
    step = np.array([[0, 0, 0], [1, 0, 0], [0, -1, 2]])
    offsets = floaters._keys(step) - floaters._keys(np.zeros((1, 3), np.int64))
    found = floaters._sums(table, totals, keys, offsets)
    known = {tuple(cell) for cell in asked}
    for cell, total in zip(asked, found, strict=True):
        near = [tuple(cell + one) for one in step]
        expected = sum(
            area for own, area, long in zip(cells, areas, largest, strict=True)
            if long < side and tuple(own) in near and tuple(own) in known
        )  # fmt: skip
        assert total == pytest.approx(expected)
    assert areas[largest >= side].sum() > 1


def test_a_table_that_is_nearly_full_holds_every_key() -> None:
    keys = np.random.default_rng(10).permutation(10_000)[:31].astype(np.int64)
    table = np.full(32, -1, np.int64)
    floaters._insert(table, keys)
    assert [table[floaters._slot(table, key)] for key in keys] == keys.tolist()
    assert table[floaters._slot(table, np.int64(10_001))] == -1


def test_far_gaussians_count_in_the_outermost_cell() -> None:
    far = np.array([[10**7, 0, 0], [-(10**7), 0, 0]])
    keys = floaters._keys(far)
    table, totals = np.full(8, -1, np.int64), np.zeros(8)
    floaters._insert(table, keys)
    floaters._add_areas(table, totals, far * 5.0, np.array([1.0, 2.0]), np.zeros(2), 3.0)
    assert totals[floaters._slot(table, keys[0])] == 1.0
    assert totals[floaters._slot(table, keys[1])] == 2.0


def test_steps_end_before_filled_cells() -> None:
    filled = np.zeros((4, 5, 6), bool)
    filled[3, 1, 1] = filled[0, 4, 1] = filled[0, 1, 5] = filled[0, 0, 0] = True
    starts = np.array([[0.5, 1.5, 1.5]] * 5 + [[0.5, 0.5, 0.5]])
    directions = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0.5, 0, 0], [-1, 0, 0.0]])
    assert free_space._steps_in_the_clear(filled, starts, directions, 1, 9).tolist() == [2, 2, 3, 9, 4, 9]
    assert free_space._steps_in_the_clear(filled, starts, directions, 2, 9).tolist() == [1, 1, 2, 9, 3, 9]
    assert free_space._steps_in_the_clear(filled, starts[5:], directions[5:], 0, 9).tolist() == [0]
    assert free_space._steps_in_the_clear(filled, starts[:1], directions[:1], 1, 2).tolist() == [2]
    # Beyond the grid nothing is filled, whatever lies on its border.
    middle = np.array([[1.5, 2.5, 1.5]] * 3)
    assert free_space._steps_in_the_clear(filled, middle, np.eye(3), 0, 9).tolist() == [9, 9, 9]
    assert free_space._steps_in_the_clear(filled, middle, -np.eye(3), 0, 9).tolist() == [9, 9, 9]
