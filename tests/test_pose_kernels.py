"""The kernels of pose estimation as plain Python: beside numpy, finite differences and planted values, part by part."""

from __future__ import annotations

from collections.abc import Iterator
from math import ceil, comb
from types import SimpleNamespace

import numpy as np
import pytest
from plain_kernels import plain

from service.geometry import so3_exp

p3p = plain("service.pose.absolute_pose.p3p")
ransac = plain("service.pose.absolute_pose.ransac")
rig = plain("service.pose.absolute_pose.rig_kernels")
TRUNCATED, CAUCHY = 0, 1


@pytest.fixture(autouse=True)
def silent() -> Iterator[None]:
    """Divide by zero and overflow as machine code does."""
    with np.errstate(all="ignore"):
        yield


def pose(seed: int, turn: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and translation of camera_from_world; the points of `columns` are ahead."""
    rng = np.random.default_rng(seed)
    return so3_exp(turn * rng.normal(size=3)), rng.normal(size=3)


def seen(seed: int, count: int, noise: float = 0.0, turn: float = 1.0) -> SimpleNamespace:
    """Points from 2 to 6 ahead of a camera, in columns as in `ransac`, and the camera's pose."""
    rng = np.random.default_rng(seed)
    rotation, translation = pose(seed + 100, turn)
    uv = rng.uniform(-0.6, 0.6, (count, 2))
    local = np.column_stack([uv, np.ones(count)]) * rng.uniform(2, 6, (count, 1))
    points = (local - translation) @ rotation
    columns = np.vstack([(uv + noise * rng.normal(size=uv.shape)).T, points.T])
    return SimpleNamespace(columns=columns, points=points, local=local, rotation=rotation, translation=translation)


def form(matrix: np.ndarray) -> np.ndarray:
    return matrix[np.triu_indices(3)]


def symmetric(seed: int) -> np.ndarray:
    half = np.random.default_rng(seed).normal(size=(3, 3))
    return half + half.T


# ------------------------------------------------------------------ P3P


@pytest.mark.parametrize(
    "roots",
    [(1, 2, 3.5), (-2, 0.1, 0.3), (2, 2, 2), (1, 1, 1), (-1, -1, 4), (0, 0, 0), (2, 1j, -1j), (-3, 1 + 2j, 1 - 2j)],
)
@pytest.mark.parametrize("factor", [1.0, -2.5])
def test_a_root_of_a_cubic(roots: tuple[complex, ...], factor: float) -> None:
    a, b, c, d = np.real(np.poly(roots)) * factor
    found = p3p.real_cubic_root(a, b, c, d)
    assert min(abs(found - root) for root in roots) < 1e-8
    assert np.isnan(p3p.real_cubic_root(0.0, b, c, d))


def test_roots_of_random_cubics_are_exact() -> None:
    for coefficients in np.random.default_rng(0).normal(size=(200, 4)):
        found = p3p.real_cubic_root(*coefficients)
        assert min(abs(found - root) for root in np.roots(coefficients)) < 1e-7 * max(1, abs(found))


def test_forms_of_symmetric_matrices() -> None:
    m, n = symmetric(1), symmetric(2)
    out, (x, y) = np.empty(6), np.random.default_rng(3).normal(size=(2, 3))
    p3p.adjugate(form(m), out)
    assert np.allclose(out, form(np.linalg.inv(m) * np.linalg.det(m)))
    assert p3p.trace_of_product(form(m), form(n)) == pytest.approx(np.trace(m @ n))
    assert p3p.applied(form(m), x, y) == pytest.approx(x @ m @ y)


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 2, 0), (2, 0, 1)])
@pytest.mark.parametrize("seed", range(4))
def test_a_degenerate_conic_is_split_into_its_lines(order: tuple[int, ...], seed: int) -> None:
    pair = np.random.default_rng(seed).normal(size=(2, 3))
    pair = (pair * [0.1, 0.1, 3.0])[:, order]  # which minor is the largest
    conic = np.outer(pair[0], pair[1]) + np.outer(pair[1], pair[0])
    lines = np.empty((2, 3))
    assert p3p.split_lines(form(conic), np.empty(6), lines)
    units = [x / np.linalg.norm(x) for x in (*pair, *lines)]
    alike = np.abs([[units[i] @ units[j] for j in (2, 3)] for i in (0, 1)])
    assert np.allclose(np.sort(alike.max(1)), 1)
    assert alike.argmax(1).tolist() in ([0, 1], [1, 0])
    imaginary = np.outer(pair[0], pair[0]) + np.outer(pair[1], pair[1])
    assert not p3p.split_lines(form(imaginary), np.empty(6), lines)
    assert not p3p.split_lines(np.array([1.0, 0, 0, 0, 0, 0]), np.empty(6), lines)  # a double line


def triangle(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Distances, unit rays, and the cosines and squares of the pairs 01, 02, 12."""
    rng = np.random.default_rng(seed)
    d, rays = rng.uniform(1, 4, 3), rng.normal(size=(3, 3)) * [0.5, 0.5, 0] + [0, 0, 1]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    pairs = [(0, 1), (0, 2), (1, 2)]
    points = d[:, None] * rays
    return (
        d, rays, np.array([rays[i] @ rays[j] for i, j in pairs]),
        np.array([np.sum((points[i] - points[j]) ** 2) for i, j in pairs]),
    )  # fmt: skip


@pytest.mark.parametrize("seed", range(6))
def test_distances_are_polished_by_newton_steps(seed: int) -> None:
    """Three steps of quadratic convergence; positive distances only."""
    d, _, cosines, squares = triangle(seed)
    for axis in range(3):
        found = d * (1 + 1e-3 * np.random.default_rng(seed).normal(size=3))
        assert p3p.polish_distances(found, cosines, squares)
        assert np.allclose(found, d, rtol=0, atol=1e-10)
        signs = np.where(np.arange(3) == axis, -1.0, 1.0)
        pair_signs = signs[[0, 0, 1]] * signs[[1, 2, 2]]
        assert not p3p.polish_distances(d * signs, cosines * pair_signs, squares)


@pytest.mark.parametrize("seed", range(4))
def test_a_pose_from_distances_along_rays(seed: int) -> None:
    d, rays, _, _ = triangle(seed)
    rotation, translation = pose(seed)
    points = (d[:, None] * rays - translation) @ rotation
    inverse, found, at = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    assert p3p.inverse_of_edges(points, inverse)
    first, second = points[1] - points[0], points[2] - points[0]
    assert np.allclose(inverse @ np.column_stack([first, second, np.cross(first, second)]), np.eye(3))
    p3p.pose_of_distances(d, rays, points, inverse, found, at)
    assert np.allclose(found, rotation)
    assert np.allclose(at, translation)
    assert not p3p.inverse_of_edges(np.array([[0.0, 0, 0], [1, 2, 3], [2, 4, 6]]), inverse)


def distances_by_grunert(rays: np.ndarray, points: np.ndarray) -> np.ndarray:
    """All distances of three points, by roots of a quartic (Grunert 1841, as in Haralick et al., IJCV 1994)."""
    a, b, c = (np.linalg.norm(points[i] - points[j]) ** 2 for i, j in ((1, 2), (0, 2), (0, 1)))
    cosa, cosb, cosg = (rays[i] @ rays[j] for i, j in ((1, 2), (0, 2), (0, 1)))
    q, s = (a - c) / b, (a + c) / b
    quartic = [
        (q - 1) ** 2 - 4 * c / b * cosa**2,
        4 * (q * (1 - q) * cosb - (1 - s) * cosa * cosg + 2 * c / b * cosa**2 * cosb),
        2 * (q**2 - 1 + 2 * q**2 * cosb**2 + 2 * (b - c) / b * cosa**2 - 4 * s * cosa * cosb * cosg
             + 2 * (b - a) / b * cosg**2),
        4 * (-q * (1 + q) * cosb + 2 * a / b * cosg**2 * cosb - (1 - s) * cosa * cosg),
        (1 + q) ** 2 - 4 * a / b * cosg**2,
    ]  # fmt: skip
    found = []
    for v in np.roots(quartic):
        if abs(v.imag) < 1e-6 and v.real > 0:
            v = v.real
            u = ((q - 1) * v**2 - 2 * q * cosb * v + 1 + q) / (2 * (cosg - v * cosa))
            if u > 0:
                first = np.sqrt(b / (1 + v**2 - 2 * v * cosb))
                found.append(first * np.array([1, u, v]))
    return np.array(found)


def test_p3p_finds_all_solutions_of_grunerts_quartic_and_no_other() -> None:
    work, rotations, translations = np.zeros(p3p.WORK), np.zeros((4, 3, 3)), np.zeros((4, 3))
    counts = [0] * 5
    for seed in range(120):
        d, rays, _, _ = triangle(seed)
        rotation, translation = pose(seed)
        points = (d[:, None] * rays - translation) @ rotation
        count = p3p.solve_p3p(rays, points, work, rotations, translations)
        found = [np.linalg.norm(points @ rotations[i].T + translations[i], axis=1) for i in range(count)]
        expected = distances_by_grunert(rays, points)
        assert len(expected) == count
        assert all(np.abs(found - one).max(1).min() < 1e-4 for one in expected)
        assert min(np.abs(rotations[:count] - rotation).max((1, 2))) < 1e-7
        assert min(np.abs(translations[:count] - translation).max(1)) < 1e-7
        counts[count] += 1
    assert min(counts[1:3]) > 10
    assert counts[4] > 0
    assert p3p.solve_p3p(rays, np.zeros((3, 3)), work, rotations, translations) == 0


# ------------------------------------------------------------------ RANSAC and refinement of one camera

FOCAL = np.array([500.0, 480.0])


def errors_px(data: SimpleNamespace, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Projected less observed, (m, 2); infinite behind the camera."""
    local = data.points @ rotation.T + translation
    found = (local[:, :2] / local[:, 2:] - data.columns[:2].T) * FOCAL
    return np.where(local[:, 2:] > 0, found, np.inf)


def with_one_behind(data: SimpleNamespace) -> SimpleNamespace:
    """The first point mirrored at the camera's centre: it projects to the same pixel, from behind."""
    data.points[0] = (-data.local[0] - data.translation) @ data.rotation
    data.columns[2:] = data.points.T
    return data


def loss_of(errors: np.ndarray, limit: float, loss: int) -> float:
    square = np.minimum((errors**2).sum(1), 1e300)
    behind = ~np.isfinite(errors).all(1)
    if loss == TRUNCATED:
        return float(np.minimum(square, limit**2).sum())
    return float(np.where(behind, limit**2 * np.log(2), limit**2 * np.log(1 + square / limit**2)).sum())


def test_a_pose_is_scored_by_truncated_squared_errors() -> None:
    data = with_one_behind(seen(1, 40, 0.01))
    errors = errors_px(data, data.rotation, data.translation)
    cost, inliers = ransac.score_pose(data.columns, data.rotation, data.translation, FOCAL, 6.0)
    assert cost == pytest.approx(loss_of(errors, 6.0, TRUNCATED))
    assert inliers == np.sum(np.linalg.norm(errors, axis=1) < 6.0)
    assert 5 < inliers < 35
    for i in range(3):
        found = ransac.reprojection_error(data.columns, i, data.rotation, data.translation, FOCAL)
        assert found == pytest.approx(np.linalg.norm(errors[i]))
    # An error of exactly the limit is none of an inlier.
    exact = np.array([[0.0], [0.0], [3.0], [0.0], [1.0]])
    assert ransac.score_pose(exact, np.eye(3), np.zeros(3), np.ones(2), 3.0) == (9.0, 0.0)
    exact[4] = 0.0
    assert ransac.score_pose(exact, np.eye(3), np.zeros(3), np.ones(2), 3.0) == (9.0, 0.0)
    assert ransac.reprojection_error(exact, 0, np.eye(3), np.zeros(3), np.ones(2)) == np.inf


def moved_by_numpy(rotation: np.ndarray, translation: np.ndarray, step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    turn = so3_exp(step[3:])
    return turn @ rotation, turn @ translation + step[:3]


@pytest.mark.parametrize("loss", [TRUNCATED, CAUCHY])
def test_normal_equations_are_those_of_finite_differences(loss: int) -> None:
    data, limit = with_one_behind(seen(2, 25, 0.01)), 6.0
    normal, gradient = np.full((6, 6), np.nan), np.full(6, np.nan)
    arguments = (FOCAL, limit, loss, normal, gradient)
    cost = ransac.linearize(data.columns, data.rotation, data.translation, *arguments)
    errors = errors_px(data, data.rotation, data.translation)
    assert cost == pytest.approx(loss_of(errors, limit, loss))
    steps = 1e-6 * np.eye(6)
    ends = [
        [errors_px(data, *moved_by_numpy(data.rotation, data.translation, s * step)) for s in (1, -1)] for step in steps
    ]
    ahead = np.isfinite(errors).all(1)
    jacobian = np.stack([(one[ahead] - other[ahead]) / 2e-6 for one, other in ends], -1)
    square = (errors[ahead] ** 2).sum(1)
    weights = (square < limit**2) * 1.0 if loss == TRUNCATED else 1 / (1 + square / limit**2)
    assert 0.2 < weights.mean() < 0.95
    by_hand = np.einsum("n,nci,ncj->ij", weights, jacobian, jacobian)
    lower = np.tril_indices(6)
    assert np.allclose(normal[lower], by_hand[lower], rtol=1e-5, atol=1e-2)
    assert np.allclose(gradient, np.einsum("n,nc,nci->i", weights, errors[ahead], jacobian), rtol=1e-5, atol=1e-2)


def test_an_error_at_the_limit_is_truncated_and_a_point_in_the_cameras_plane_counts_as_behind() -> None:
    normal, gradient = np.zeros((6, 6)), np.zeros(6)
    column = np.array([[0.0], [0.0], [3.0], [0.0], [1.0]])
    assert ransac.linearize(column, np.eye(3), np.zeros(3), np.ones(2), 3.0, TRUNCATED, normal, gradient) == 9.0
    assert not gradient.any()
    column[4] = 0.0
    cost = ransac.linearize(column, np.eye(3), np.zeros(3), np.ones(2), 3.0, CAUCHY, normal, gradient)
    assert cost == pytest.approx(9 * np.log(2))
    assert not gradient.any()


def test_a_damped_step_solves_the_damped_equations() -> None:
    rng = np.random.default_rng(3)
    half = rng.normal(size=(6, 9))
    normal, gradient, step, factor = half @ half.T, rng.normal(size=6), np.empty(6), np.zeros((6, 6))
    for damping in (0.0, 0.7):
        assert ransac.damped_step(np.tril(normal), gradient, damping, factor, step)
        assert np.allclose((normal + damping * np.diag(np.diag(normal))) @ step, -gradient)
    assert not ransac.damped_step(np.zeros((6, 6)), gradient, 0.0, factor, step)
    normal[5, 5] = -1.0
    assert not ransac.damped_step(normal, gradient, 0.1, factor, step)


def test_a_twist_moves_a_pose_on_the_left() -> None:
    """To second order: the third is a twelfth of the angle's cube."""
    rotation, translation = pose(5)
    found, at = np.empty((3, 3)), np.empty(3)
    for step in 0.02 * np.random.default_rng(4).normal(size=(5, 6)):
        ransac.moved(rotation, translation, step, found, at)
        right = moved_by_numpy(rotation, translation, step)
        bound = np.linalg.norm(step[3:]) ** 3
        assert np.abs(found - right[0]).max() < 0.1 * bound
        assert np.abs(at - right[1]).max() < 0.1 * bound * np.linalg.norm(translation)
        assert np.allclose(found @ found.T, np.eye(3), atol=1e-14)


def test_rows_become_orthonormal_the_first_ones_direction_kept() -> None:
    rows = pose(6)[0] + 0.01 * np.random.default_rng(5).normal(size=(3, 3))
    found = rows.copy()
    ransac.orthonormalize(found)
    assert np.allclose(found @ found.T, np.eye(3), atol=1e-12)
    assert np.allclose(found[0], rows[0] / np.linalg.norm(rows[0]))
    assert found[1] @ np.cross(rows[0], rows[1]) == pytest.approx(0, abs=1e-12)
    assert np.abs(found - rows).max() < 0.05


@pytest.mark.parametrize("loss", [TRUNCATED, CAUCHY])
def test_refinement_finds_the_planted_pose_in_a_few_steps(loss: int) -> None:
    data = seen(7, 20)
    start = moved_by_numpy(data.rotation, data.translation, np.array([0.02, -0.03, 0.02, 0.02, -0.01, 0.02]))
    errors = []
    for steps in (1, 3, 5):
        rotation, translation = start[0].copy(), start[1].copy()
        ransac.refine_pose(data.columns, rotation, translation, FOCAL, 60.0, loss, steps, 0.0)
        errors.append(np.abs(rotation - data.rotation).max() + np.abs(translation - data.translation).max())
    assert errors[0] < 5e-3
    assert errors[1] < 1e-6
    assert errors[2] < 1e-11


def test_refinement_ends_with_short_steps_and_where_no_step_is_better(monkeypatch: pytest.MonkeyPatch) -> None:
    data, solved = seen(8, 20), []
    names = ransac.refine_pose.__globals__

    def counted(*arguments: object) -> bool:
        solved.append(arguments)
        return ransac.damped_step(*arguments)

    monkeypatch.setitem(names, "damped_step", counted)
    offset = np.array([0.02, -0.03, 0.02, 0.02, -0.01, 0.02])
    lengths = []
    for tolerance in (1.0, 1e-3, 1e-7):
        solved.clear()
        rotation, translation = moved_by_numpy(data.rotation, data.translation, offset)
        ransac.refine_pose(data.columns, rotation, translation, FOCAL, 60.0, TRUNCATED, 50, tolerance)
        lengths.append(len(solved))
    assert lengths[0] == 1
    assert lengths[0] < lengths[1] < lengths[2] < 8
    # At the minimum no step is better, and the damping rises tenfold from 1e-3 to 1e10: 13 times.
    solved.clear()
    noisy = seen(8, 20, 0.01)
    rotation, translation = noisy.rotation.copy(), noisy.translation.copy()
    ransac.refine_pose(noisy.columns, rotation, translation, FOCAL, 60.0, CAUCHY, 50, 1e-12)
    before = (rotation.copy(), translation.copy())
    solved.clear()
    ransac.refine_pose(noisy.columns, rotation, translation, FOCAL, 60.0, CAUCHY, 100, 0.0)
    assert 13 <= len(solved) <= 16
    assert np.allclose(rotation, before[0], atol=1e-9)
    # Lengths are shares of the distance: the same scene a hundred times as large ends alike.
    large = data.columns.copy()
    large[2:] *= 100
    solved.clear()
    rotation, translation = moved_by_numpy(data.rotation, data.translation, offset)
    translation *= 100
    ransac.refine_pose(large, rotation, translation, FOCAL, 60.0, TRUNCATED, 50, 1e-3)
    assert len(solved) == lengths[1]


def test_random_numbers_are_splitmix64s() -> None:
    """The first ones of the reference implementation for the seed 1234567."""
    state = np.array([1234567], np.uint64)
    expected = [6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431]
    assert [int(ransac.next_random(state)) for _ in range(4)] == expected


def test_draws_are_different_numbers_all_alike() -> None:
    state, chosen, counts = np.zeros(1, np.uint64), np.zeros(3, np.int64), np.zeros(5)
    for _ in range(600):
        ransac.draw(state, 5, 3, chosen)
        assert len(set(chosen.tolist())) == 3
        counts[chosen] += 1
    assert np.all(np.abs(counts - 360) < 60)  # five standard deviations


def test_trials_are_as_many_as_find_three_inliers_at_once() -> None:
    """ln 0.01 / ln(1 - 1/8) = 34.49."""
    assert ransac.enough_trials(0.5, 0.99, 1.0, 10, 1000) == 35
    assert ransac.enough_trials(0.5, 0.99, 3.0, 10, 1000) == 104
    assert ransac.enough_trials(0.5, 0.99, 1.0, 40, 1000) == 40
    assert ransac.enough_trials(0.5, 0.99, 1.0, 10, 30) == 30
    assert ransac.enough_trials(1.0, 0.99, 1.0, 10, 30) == 10
    assert ransac.enough_trials(0.0, 0.99, 1.0, 10, 30) == 30


def growth_of_pools(count: int, most: int) -> list[int]:
    """How many correspondences are drawn from in each trial (PROSAC, Chum and Matas 2005, equations 3 to 5)."""
    expected = [most * comb(n, 3) / comb(count, 3) for n in range(3, count + 1)]
    pools, pool, limit = [], 3, 1
    for trial in range(1, most + 1):
        if trial > limit and pool < count:
            limit += ceil(expected[pool + 1 - 3] - expected[pool - 3] - 1e-9)
            pool += 1
        pools.append(pool if trial <= limit else count)
    return pools


def test_samples_grow_as_prosacs_and_include_the_last_of_the_pool(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = []

    def recorded(state: np.ndarray, below: int, count: int, chosen: np.ndarray) -> None:
        ransac.draw(state, below, count, chosen)
        drawn.append((int(below), count))

    monkeypatch.setitem(ransac.search_pose.__globals__, "draw", recorded)
    rng = np.random.default_rng(9)
    columns = np.vstack([rng.uniform(-1, 1, (2, 9)), rng.normal(size=(3, 9))])
    ransac.search_pose(columns, FOCAL, 2.0, 1, 60, 0.99, 1e9, 2, 0, np.zeros((3, 3)), np.zeros(3))
    pools = [below + 1 if count == 2 else below for below, count in drawn]
    assert pools == growth_of_pools(9, 60)
    assert {count for below, count in drawn if 3 < below + (count == 2) < 9} == {2}
    assert drawn[0] == (3, 3)
    assert drawn[-1] == (9, 3)


def outliers_among(seed: int, count: int, wrong: int) -> SimpleNamespace:
    data = seen(seed, count, 0.0005)
    rng = np.random.default_rng(seed)
    which = rng.permutation(count)[:wrong]
    data.columns[:2, which] = rng.uniform(-0.6, 0.6, (2, wrong))
    data.inlier = np.linalg.norm(errors_px(data, data.rotation, data.translation), axis=1) < 3.0
    return data


def test_the_planted_pose_and_its_inliers_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    data, trials = outliers_among(10, 30, 12), []
    names = ransac.solve_pnp.__globals__
    monkeypatch.setitem(names, "solve_p3p", lambda *arguments: trials.append(1) or p3p.solve_p3p(*arguments))
    px = data.columns[:2].T * FOCAL + [310.0, 250.0]
    camera = (*FOCAL, 310.0, 250.0)
    arguments = (px, data.points, camera, 3.0, (20, 300), (0.999, 1.5), (5, 10), 0, 1.0, 1e-9)
    rotation, translation, inlier = ransac.solve_pnp(*arguments)
    assert np.array_equal(inlier, data.inlier)
    assert 15 <= inlier.sum() <= 20
    assert 20 <= len(trials) < 300
    # Seen: 3e-4 and 1e-3, of 0.25 px of noise.
    assert np.abs(rotation - data.rotation).max() < 1.5e-3
    assert np.abs(translation - data.translation).max() < 5e-3
    # The minimum of the Cauchy loss over the inliers: no small motion is better.
    kept = SimpleNamespace(columns=data.columns[:, inlier], points=data.points[inlier])
    best = loss_of(errors_px(kept, rotation, translation), 1.0, CAUCHY)
    for step in (*1e-4 * np.eye(6), *-1e-4 * np.eye(6)):
        assert loss_of(errors_px(kept, *moved_by_numpy(rotation, translation, step)), 1.0, CAUCHY) > best
    # The same seed, the same answer; nothing without correspondences that agree.
    again = ransac.solve_pnp(*arguments)
    assert np.array_equal(again[0], rotation)
    nothing = ransac.solve_pnp(np.zeros((9, 2)), np.zeros((9, 3)), *arguments[2:])
    assert not nothing[2].any()
    assert not nothing[0].any()
