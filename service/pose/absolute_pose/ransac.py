"""The compiled search for a pose: P3P in locally optimized RANSAC with progressive sampling, and its refinement.

Correspondences are five columns, so that scoring a pose is one vectorized loop:

    columns (5, m)   u, v: the pixel in normalized image coordinates; x, y, z: the point (world)
    pose             rotation (3, 3), translation (3): camera_from_world
    focal            fx, fy: errors are in pixels
"""

from __future__ import annotations

import math

import numpy as np

from service.jit import inline, inline_reordered_sums, kernel
from service.pose.absolute_pose.p3p import WORK, solve_p3p

TRUNCATED, CAUCHY = 0, 1
"""Losses: squared errors up to a limit; log(1 + error^2 / limit^2)."""


@inline_reordered_sums
def score_pose(columns, rotation, translation, focal, limit_px):
    """Return the truncated squared error, px^2, summed over all points (MSAC), and the number of inliers."""
    r00, r01, r02 = rotation[0, 0], rotation[0, 1], rotation[0, 2]
    r10, r11, r12 = rotation[1, 0], rotation[1, 1], rotation[1, 2]
    r20, r21, r22 = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    t0, t1, t2 = translation[0], translation[1], translation[2]
    us, vs, xs, ys, zs = columns[0], columns[1], columns[2], columns[3], columns[4]
    fx, fy, limit = focal[0], focal[1], limit_px * limit_px
    cost, inliers = 0.0, 0.0
    for i in range(len(us)):
        x, y, z = xs[i], ys[i], zs[i]
        ahead = r20 * x + r21 * y + r22 * z + t2
        inverse = 1.0 / ahead
        eu = fx * ((r00 * x + r01 * y + r02 * z + t0) * inverse - us[i])
        ev = fy * ((r10 * x + r11 * y + r12 * z + t1) * inverse - vs[i])
        square = eu * eu + ev * ev
        # Points behind the camera are outliers.
        within = (square < limit) & (ahead > 0.0)
        cost += square if within else limit
        inliers += 1.0 if within else 0.0
    return cost, inliers


@inline_reordered_sums
def linearize(columns, rotation, translation, focal, limit_px, loss, normal, gradient):
    """Write the normal equations of the loss in the pose's twist (translation, rotation; camera axes, applied on the
    left) and return the loss. Points behind the camera count as a point at the limit.
    """
    us, vs, xs, ys, zs = columns[0], columns[1], columns[2], columns[3], columns[4]
    r00, r01, r02 = rotation[0, 0], rotation[0, 1], rotation[0, 2]
    r10, r11, r12 = rotation[1, 0], rotation[1, 1], rotation[1, 2]
    r20, r21, r22 = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    t0, t1, t2 = translation[0], translation[1], translation[2]
    fx, fy, limit = focal[0], focal[1], limit_px * limit_px
    cost = 0.0
    h00 = h02 = h03 = h04 = h05 = h11 = h12 = h13 = h14 = h15 = 0.0
    h22 = h23 = h24 = h25 = h33 = h34 = h35 = h44 = h45 = h55 = 0.0
    g0 = g1 = g2 = g3 = g4 = g5 = 0.0
    for i in range(len(us)):
        x, y, z = xs[i], ys[i], zs[i]
        ahead = r20 * x + r21 * y + r22 * z + t2
        inverse = 1.0 / ahead
        u = (r00 * x + r01 * y + r02 * z + t0) * inverse
        v = (r10 * x + r11 * y + r12 * z + t1) * inverse
        eu, ev = fx * (u - us[i]), fy * (v - vs[i])
        square = eu * eu + ev * ev
        if not ahead > 0.0:
            cost += limit if loss == 0 else limit * math.log(2.0)
            continue
        if loss == 0:
            if square >= limit:
                cost += limit
                continue
            weight = 1.0
            cost += square
        else:
            weight = 1.0 / (1.0 + square / limit)
            cost += limit * math.log1p(square / limit)
        # d (u, v) / d twist is (1/z, 0, -u/z, -uv, 1 + u^2, -v), (0, 1/z, -v/z, -1 - v^2, uv, u).
        a0, a2, a3, a4, a5 = fx * inverse, -fx * u * inverse, -fx * u * v, fx * (1.0 + u * u), -fx * v
        b1, b2, b3, b4, b5 = fy * inverse, -fy * v * inverse, -fy * (1.0 + v * v), fy * u * v, fy * u
        wa, wb = weight * eu, weight * ev
        g0 += a0 * wa
        g1 += b1 * wb
        g2 += a2 * wa + b2 * wb
        g3 += a3 * wa + b3 * wb
        g4 += a4 * wa + b4 * wb
        g5 += a5 * wa + b5 * wb
        w0, w2, w3, w4, w5 = weight * a0, weight * a2, weight * a3, weight * a4, weight * a5
        x1, x2, x3, x4, x5 = weight * b1, weight * b2, weight * b3, weight * b4, weight * b5
        h00 += w0 * a0
        h02 += w0 * a2
        h03 += w0 * a3
        h04 += w0 * a4
        h05 += w0 * a5
        h11 += x1 * b1
        h12 += x1 * b2
        h13 += x1 * b3
        h14 += x1 * b4
        h15 += x1 * b5
        h22 += w2 * a2 + x2 * b2
        h23 += w2 * a3 + x2 * b3
        h24 += w2 * a4 + x2 * b4
        h25 += w2 * a5 + x2 * b5
        h33 += w3 * a3 + x3 * b3
        h34 += w3 * a4 + x3 * b4
        h35 += w3 * a5 + x3 * b5
        h44 += w4 * a4 + x4 * b4
        h45 += w4 * a5 + x4 * b5
        h55 += w5 * a5 + x5 * b5
    gradient[0], gradient[1], gradient[2], gradient[3], gradient[4], gradient[5] = g0, g1, g2, g3, g4, g5
    # The lower triangle, which the factorization reads.
    normal[0, 0], normal[1, 0], normal[2, 0], normal[3, 0], normal[4, 0], normal[5, 0] = h00, 0.0, h02, h03, h04, h05
    normal[1, 1], normal[2, 1], normal[3, 1], normal[4, 1], normal[5, 1] = h11, h12, h13, h14, h15
    normal[2, 2], normal[3, 2], normal[4, 2], normal[5, 2] = h22, h23, h24, h25
    normal[3, 3], normal[4, 3], normal[5, 3] = h33, h34, h35
    normal[4, 4], normal[5, 4], normal[5, 5] = h44, h45, h55
    return cost


@inline
def damped_step(normal, gradient, damping, factor, step):
    """Write the solution of (N + damping diag N) step = -gradient, by Cholesky; return False if there is none."""
    for i in range(6):
        for j in range(i + 1):
            value = normal[i, j] * (1.0 + damping if i == j else 1.0)
            for k in range(j):
                value -= factor[i, k] * factor[j, k]
            if i == j:
                if not value > 0.0:
                    return False
                factor[i, i] = math.sqrt(value)
            else:
                factor[i, j] = value / factor[j, j]
    for i in range(6):
        value = -gradient[i]
        for k in range(i):
            value -= factor[i, k] * step[k]
        step[i] = value / factor[i, i]
    for i in range(5, -1, -1):
        value = step[i]
        for k in range(i + 1, 6):
            value -= factor[k, i] * step[k]
        step[i] = value / factor[i, i]
    return True


@inline
def moved(rotation, translation, step, new_rotation, new_translation):
    """Write the pose after a twist (translation, rotation) in camera axes, applied on the left; orthonormal."""
    x, y, z = 0.5 * step[3], 0.5 * step[4], 0.5 * step[5]
    # Cayley's map of the half angles: the exponential to second order, and a rotation exactly.
    scale = 1.0 / (1.0 + x * x + y * y + z * z)
    q = (
        (scale * (1 + x * x - y * y - z * z), scale * 2 * (x * y - z), scale * 2 * (x * z + y)),
        (scale * 2 * (x * y + z), scale * (1 - x * x + y * y - z * z), scale * 2 * (y * z - x)),
        (scale * 2 * (x * z - y), scale * 2 * (y * z + x), scale * (1 - x * x - y * y + z * z)),
    )
    for i in range(3):
        for j in range(3):
            new_rotation[i, j] = q[i][0] * rotation[0, j] + q[i][1] * rotation[1, j] + q[i][2] * rotation[2, j]
        turned = q[i][0] * translation[0] + q[i][1] * translation[1] + q[i][2] * translation[2]
        new_translation[i] = turned + step[i]


@inline
def orthonormalize(rotation):
    """Make the rows orthonormal, the first one's direction kept: they are nearly so, and errors would add up."""
    for i in range(3):
        for j in range(i):
            dot = 0.0
            for k in range(3):
                dot += rotation[i, k] * rotation[j, k]
            for k in range(3):
                rotation[i, k] -= dot * rotation[j, k]
        norm = math.sqrt(rotation[i, 0] ** 2 + rotation[i, 1] ** 2 + rotation[i, 2] ** 2)
        for k in range(3):
            rotation[i, k] /= norm


@inline
def copy_pose(rotation, translation, to_rotation, to_translation):
    """Copy a pose. By hand: numba takes a second to compile an assignment to a slice."""
    for i in range(3):
        to_translation[i] = translation[i]
        for j in range(3):
            to_rotation[i, j] = rotation[i, j]


@inline
def refine_pose(columns, rotation, translation, focal, limit_px, loss, steps, tolerance):
    """Minimize the loss in place by Levenberg-Marquardt: at most `steps`, until they are shorter than `tolerance`
    (radians; shares of the distance).
    """
    normal, factor, gradient, step = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(6), np.zeros(6)
    new_normal, new_gradient = np.zeros((6, 6)), np.zeros(6)
    new_rotation, new_translation = np.zeros((3, 3)), np.zeros(3)
    orthonormalize(rotation)
    cost = linearize(columns, rotation, translation, focal, limit_px, loss, normal, gradient)
    damping = 1e-3
    for _ in range(steps):
        if not damped_step(normal, gradient, damping, factor, step):
            break
        moved(rotation, translation, step, new_rotation, new_translation)
        new_cost = linearize(
            columns, new_rotation, new_translation, focal, limit_px, loss, new_normal, new_gradient
        )  # fmt: skip
        if new_cost < cost:
            copy_pose(new_rotation, new_translation, rotation, translation)
            normal, new_normal, gradient, new_gradient = new_normal, normal, new_gradient, gradient
            cost, damping = new_cost, max(1e-10, 0.1 * damping)
        else:
            damping = min(1e10, 10.0 * damping)
            if damping == 1e10:
                break
        length = math.sqrt(translation[0] ** 2 + translation[1] ** 2 + translation[2] ** 2) + 1e-12
        longest = 0.0
        for k in range(3):
            longest = max(longest, abs(step[k]) / length, abs(step[k + 3]))
        if longest < tolerance:
            break


@inline
def next_random(state):
    """Advance a generator's state, uint64 (1), by SplitMix64 (Steele, Lea and Flood, OOPSLA 2014); return 64 bits."""
    state[0] += np.uint64(0x9E3779B97F4A7C15)
    z = state[0]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@inline
def draw(state, below, count, chosen):
    """Write `count` different numbers below `below`."""
    for i in range(count):
        again = True
        while again:
            # The upper 32 bits, scaled: the bias is below 2^-22 for a thousand points.
            chosen[i] = np.int64(((next_random(state) >> np.uint64(32)) * np.uint64(below)) >> np.uint64(32))
            again = False
            for j in range(i):
                again = again or chosen[i] == chosen[j]


@inline
def enough_trials(inlier_share, confidence, factor, fewest, most):
    """Return how many trials find three inliers at once with this confidence, times a factor for noise."""
    good = inlier_share**3
    if good >= 1.0 - 1e-9:
        return fewest
    if good <= 1e-9:
        return most
    needed = math.ceil(math.log(1.0 - confidence) / math.log(1.0 - good) * factor)
    return max(fewest, min(most, np.int64(needed)))


@inline
def search_pose(columns, focal, limit_px, fewest, most, confidence, factor, refine_steps, seed, rotation, translation):
    """Write the pose of the lowest truncated squared error that was found; return how many inliers it has; 0: none.

    Samples of three come from the first n correspondences, and include the n-th; n grows such that after `most` trials
    all were as likely drawn as by RANSAC (PROSAC, Chum and Matas, CVPR 2005). A pose that is better than all before is
    refined on its inliers (LO-RANSAC, Chum, Matas and Kittler, DAGM 2003).
    """
    count = columns.shape[1]
    state, chosen = np.zeros(1, np.uint64), np.zeros(3, np.int64)
    state[0] = seed
    rays, points, work = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(WORK)
    rotations, translations = np.zeros((4, 3, 3)), np.zeros((4, 3))
    best_cost, best_inliers, minimal_cost = math.inf, 0.0, math.inf
    needed, trial = most, 0
    # Of `most` uniform samples this many would lie within the first `pool`.
    pool, growth, share = 3, 1.0, float(most)
    for i in range(3):
        share *= (3.0 - i) / (count - i)
    while trial < most and trial < needed:
        trial += 1
        if trial > growth and pool < count:
            larger = share * (pool + 1.0) / (pool - 2.0)
            growth += math.ceil(larger - share)
            share = larger
            pool += 1
        if pool < count and trial <= growth and pool > 3:
            draw(state, pool - 1, 2, chosen)
            chosen[2] = pool - 1
        else:
            draw(state, pool, 3, chosen)
        for i in range(3):
            u, v = columns[0, chosen[i]], columns[1, chosen[i]]
            norm = 1.0 / math.sqrt(u * u + v * v + 1.0)
            rays[i, 0], rays[i, 1], rays[i, 2] = u * norm, v * norm, norm
            for k in range(3):
                points[i, k] = columns[2 + k, chosen[i]]
        improved = -1
        for i in range(solve_p3p(rays, points, work, rotations, translations)):
            cost, inliers = score_pose(columns, rotations[i], translations[i], focal, limit_px)
            if cost < minimal_cost:
                improved, minimal_cost = i, cost
        if improved < 0:
            continue
        refine_pose(
            columns, rotations[improved], translations[improved], focal, limit_px, TRUNCATED, refine_steps, 1e-6
        )
        cost, inliers = score_pose(columns, rotations[improved], translations[improved], focal, limit_px)
        if cost < best_cost:
            best_cost, best_inliers = cost, inliers
            copy_pose(rotations[improved], translations[improved], rotation, translation)
            needed = enough_trials(inliers / count, confidence, factor, fewest, most)
    return np.int64(best_inliers)


@kernel
def solve_pnp(photo_px, points_in_world, camera, limit_px, trials, chances, steps, seed, scale_px, tolerance):
    """Return camera_from_world, rotation and translation, and which correspondences are its inliers; none: no pose.

    `camera` is fx, fy, cx, cy; `trials` fewest and most, `chances` confidence and factor of `enough_trials`; `steps` of
    Levenberg-Marquardt in the search, and of the refinement on the inliers with a Cauchy loss of `scale_px`.
    """
    count, focal = len(photo_px), np.empty(2)
    focal[0], focal[1] = camera[0], camera[1]
    columns = np.empty((5, count))
    inlier = np.zeros(count, np.bool_)
    rotation, translation = np.zeros((3, 3)), np.zeros(3)
    for i in range(count):
        columns[0, i] = (photo_px[i, 0] - camera[2]) / camera[0]
        columns[1, i] = (photo_px[i, 1] - camera[3]) / camera[1]
        for k in range(3):
            columns[2 + k, i] = points_in_world[i, k]
    found = search_pose(
        columns, focal, limit_px, trials[0], trials[1], chances[0], chances[1], steps[0], seed, rotation, translation
    )
    if found == 0:
        return rotation, translation, inlier
    good = 0
    for i in range(count):
        inlier[i] = reprojection_error(columns, i, rotation, translation, focal) < limit_px
        good += inlier[i]
    kept, at = np.empty((5, good)), 0
    for i in range(count):
        if inlier[i]:
            for k in range(5):
                kept[k, at] = columns[k, i]
            at += 1
    refine_pose(kept, rotation, translation, focal, scale_px, CAUCHY, steps[1], tolerance)
    return rotation, translation, inlier


@inline
def reprojection_error(columns, i, rotation, translation, focal):
    """Return the error of one correspondence, px; infinite behind the camera."""
    x, y, z = columns[2, i], columns[3, i], columns[4, i]
    ahead = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z + translation[2]
    if not ahead > 0.0:
        return math.inf
    eu = (rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z + translation[0]) / ahead - columns[0, i]
    ev = (rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z + translation[1]) / ahead - columns[1, i]
    return math.hypot(focal[0] * eu, focal[1] * ev)
