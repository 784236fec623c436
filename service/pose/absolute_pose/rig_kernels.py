"""The compiled search for the pose of a rig: cameras whose poses relative to one another are known.

Each hypothesis is P3P in one camera, and is scored by the matches of all (a generalized absolute pose from minimal
solutions of its cameras; the general one, three rays of any cameras, is needed where no camera has three right matches:
Nister and Stewenius, A Minimal Solution to the Generalised 3-Point Pose Problem, 2007). Samples are drawn in each
camera in turn as in `ransac`; refinement minimizes the errors in all cameras over the rig's twist.

    columns (c, 5, m)     as in `ransac`, for each camera; beyond its own number NaN, which counts as outliers
    counts (c)            matches of each camera
    rotations (c, 3, 3), translations (c, 3)   camera_from_rig
    focals (c, 2), limits (c)                  pixels
    starts (s, 4, 3)      poses that are tried first: rotation, and translation as the last row
    pose                  rotation (3, 3), translation (3): rig_from_world
"""

from __future__ import annotations

import math

import numpy as np

from service.jit import inline, kernel
from service.pose.absolute_pose.p3p import WORK, solve_p3p
from service.pose.absolute_pose.ransac import (
    CAUCHY,
    TRUNCATED,
    copy_pose,
    damped_step,
    draw,
    enough_trials,
    linearize,
    moved,
    orthonormalize,
    reprojection_error,
    score_pose,
)


@inline
def compose(left_rotation, left_translation, right_rotation, right_translation, rotation, translation):
    """Write the motion that applies the right one, then the left one."""
    for i in range(3):
        translation[i] = left_translation[i]
        for k in range(3):
            translation[i] += left_rotation[i, k] * right_translation[k]
        for j in range(3):
            value = 0.0
            for k in range(3):
                value += left_rotation[i, k] * right_rotation[k, j]
            rotation[i, j] = value


@inline
def after_inverse(left_rotation, left_translation, right_rotation, right_translation, rotation, translation):
    """Write the motion that applies the right one, then the inverse of the left one."""
    for i in range(3):
        translation[i] = 0.0
        for k in range(3):
            translation[i] += left_rotation[k, i] * (right_translation[k] - left_translation[k])
        for j in range(3):
            value = 0.0
            for k in range(3):
                value += left_rotation[k, i] * right_rotation[k, j]
            rotation[i, j] = value


@inline
def score_rig(columns, rotations, translations, focals, limits, rotation, translation, own_rotation, own_translation):
    """Return the truncated squared errors of all cameras, in squares of their limits, and the number of inliers."""
    cost, inliers = 0.0, 0.0
    for c in range(len(columns)):
        compose(rotations[c], translations[c], rotation, translation, own_rotation, own_translation)
        own_cost, own_inliers = score_pose(columns[c], own_rotation, own_translation, focals[c], limits[c])
        cost += own_cost / (limits[c] * limits[c])
        inliers += own_inliers
    return cost, inliers


@inline
def add_as_rig(normal, gradient, rotation, translation, weight, adjoint, product, total_normal, total_gradient):
    """Add a camera's normal equations in its own twist (lower triangle) as those of the rig's twist, times a weight.

    A twist (v, w) of the rig is (R v + t x R w, R w) of the camera with camera_from_rig (R, t).
    """
    for j in range(3):
        x, y, z = rotation[0, j], rotation[1, j], rotation[2, j]
        for i in range(3):
            adjoint[i, j] = adjoint[i + 3, j + 3] = rotation[i, j]
            adjoint[i + 3, j] = 0.0
        adjoint[0, j + 3] = translation[1] * z - translation[2] * y
        adjoint[1, j + 3] = translation[2] * x - translation[0] * z
        adjoint[2, j + 3] = translation[0] * y - translation[1] * x
    for i in range(6):
        for j in range(6):
            value = 0.0
            for k in range(6):
                value += (normal[i, k] if k <= i else normal[k, i]) * adjoint[k, j]
            product[i, j] = value
    for i in range(6):
        value = 0.0
        for k in range(6):
            value += adjoint[k, i] * gradient[k]
        total_gradient[i] += weight * value
        for j in range(i + 1):
            value = 0.0
            for k in range(6):
                value += adjoint[k, i] * product[k, j]
            total_normal[i, j] += weight * value


@inline
def linearize_rig(
    columns, rotations, translations, focals, limits, loss, rotation, translation, own, work, total, total_gradient
):
    """Write the normal equations in the rig's twist, in squares of the limits, and return the loss.

    `own` is memory of a pose (4, 3), `work` of (3, 6, 6) and a gradient in its own row.
    """
    cost = 0.0
    for i in range(6):
        total_gradient[i] = 0.0
        for j in range(6):
            total[i, j] = 0.0
    for c in range(len(columns)):
        compose(rotations[c], translations[c], rotation, translation, own[:3], own[3])
        weight = 1.0 / (limits[c] * limits[c])
        cost += weight * linearize(columns[c], own[:3], own[3], focals[c], limits[c], loss, work[0], work[3, 0])
        add_as_rig(work[0], work[3, 0], rotations[c], translations[c], weight, work[1], work[2], total, total_gradient)
    return cost


@inline
def refine_rig(columns, rotations, translations, focals, limits, loss, steps, tolerance, rotation, translation):
    """Minimize the loss over the rig's pose in place by Levenberg-Marquardt, as `refine_pose` does for one camera."""
    own, work = np.zeros((4, 3)), np.zeros((4, 6, 6))
    normal, factor, gradient, step = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(6), np.zeros(6)
    new_normal, new_gradient = np.zeros((6, 6)), np.zeros(6)
    new_rotation, new_translation = np.zeros((3, 3)), np.zeros(3)
    orthonormalize(rotation)
    cost = linearize_rig(
        columns, rotations, translations, focals, limits, loss, rotation, translation, own, work, normal, gradient
    )
    damping = 1e-3
    for _ in range(steps):
        if not damped_step(normal, gradient, damping, factor, step):
            break
        moved(rotation, translation, step, new_rotation, new_translation)
        new_cost = linearize_rig(
            columns, rotations, translations, focals, limits, loss, new_rotation, new_translation, own, work,
            new_normal, new_gradient,
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
def draw_three(columns, count, trial, pool, growth, share, c, state, chosen, rays, points):
    """Write the rays and points of three matches of camera c, drawn from its pool, which grows."""
    if trial > growth[c] and pool[c] < count:
        larger = share[c] * (pool[c] + 1.0) / (pool[c] - 2.0)
        growth[c] += math.ceil(larger - share[c])
        share[c] = larger
        pool[c] += 1
    if pool[c] < count and trial <= growth[c] and pool[c] > 3:
        draw(state, pool[c] - 1, 2, chosen)
        chosen[2] = pool[c] - 1
    else:
        draw(state, pool[c], 3, chosen)
    for i in range(3):
        u, v = columns[0, chosen[i]], columns[1, chosen[i]]
        norm = 1.0 / math.sqrt(u * u + v * v + 1.0)
        rays[i, 0], rays[i, 1], rays[i, 2] = u * norm, v * norm, norm
        for k in range(3):
            points[i, k] = columns[2 + k, chosen[i]]


@inline
def search_rig(
    columns, counts, rotations, translations, focals, limits, starts, fewest, most, confidence, factor, refine_steps,
    seed, rotation, translation,
):  # fmt: skip
    """Write the rig's pose of the lowest cost that was found; return how many inliers it has; 0: none.

    First the starts are refined.
    Each camera with four matches or more has `most` trials, in turn with the others; its pool of matches grows as in
    `search_pose`. The search ends when the inliers of any one camera say that it was enough for that camera.
    """
    cameras = len(columns)
    state, chosen = np.zeros(1, np.uint64), np.zeros(3, np.int64)
    state[0] = seed
    rays, points, work = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(WORK)
    p3p_rotations, p3p_translations = np.zeros((4, 3, 3)), np.zeros((4, 3))
    own, candidate = np.zeros((4, 3)), np.zeros((4, 3))
    pool, growth, share = np.full(cameras, 3), np.ones(cameras), np.full(cameras, float(most))
    for c in range(cameras):
        for i in range(3):
            share[c] *= (3.0 - i) / max(counts[c] - i, 1)
    best_cost, best_inliers, minimal_cost = math.inf, 0.0, math.inf
    needed, trial, c = most, 0, -1
    number = 0
    while number < len(starts) or (trial < most and trial < needed):
        improved = number < len(starts)
        if improved:
            copy_pose(starts[number, :3], starts[number, 3], candidate[:3], candidate[3])
            number += 1
        else:
            c = (c + 1) % cameras
            trial += c == 0
            if counts[c] >= 4:
                draw_three(columns[c], counts[c], trial, pool, growth, share, c, state, chosen, rays, points)
                for i in range(solve_p3p(rays, points, work, p3p_rotations, p3p_translations)):
                    after_inverse(rotations[c], translations[c], p3p_rotations[i], p3p_translations[i], own[:3], own[3])
                    cost, inliers = score_rig(
                        columns, rotations, translations, focals, limits, own[:3], own[3], work[:3, :3], work[3, :3]
                    )
                    if cost < minimal_cost:
                        minimal_cost, improved = cost, True
                        copy_pose(own[:3], own[3], candidate[:3], candidate[3])
        if not improved:
            continue
        refine_rig(
            columns, rotations, translations, focals, limits, TRUNCATED, refine_steps, 1e-6, candidate[:3], candidate[3]
        )  # fmt: skip
        cost, inliers = score_rig(
            columns, rotations, translations, focals, limits, candidate[:3], candidate[3], own[:3], own[3]
        )
        if cost < best_cost:
            best_cost, best_inliers = cost, inliers
            copy_pose(candidate[:3], candidate[3], rotation, translation)
            needed = most
            for k in range(cameras):
                compose(rotations[k], translations[k], rotation, translation, own[:3], own[3])
                _, own_inliers = score_pose(columns[k], own[:3], own[3], focals[k], limits[k])
                if counts[k] >= 4:
                    needed = min(needed, enough_trials(own_inliers / counts[k], confidence, factor, fewest, most))
    return np.int64(best_inliers)


@kernel
def solve_rig(
    columns, counts, rotations, translations, focals, limits, starts, trials, chances, steps, seed, loss_scale,
    tolerance,
):  # fmt: skip
    """Return rig_from_world, rotation and translation, and which correspondences are its inliers; none: no pose.

    The arguments are those of `solve_pnp`; `loss_scale` is in limits.
    """
    cameras, width = len(columns), columns.shape[2]
    inlier = np.zeros((cameras, width), np.bool_)
    rotation, translation, own = np.zeros((3, 3)), np.zeros(3), np.zeros((4, 3))
    found = search_rig(
        columns, counts, rotations, translations, focals, limits, starts, trials[0], trials[1], chances[0], chances[1],
        steps[0], seed, rotation, translation,
    )  # fmt: skip
    if found == 0:
        return rotation, translation, inlier
    kept = columns.copy()
    scales = np.empty(cameras)
    for c in range(cameras):
        scales[c] = loss_scale * limits[c]
        compose(rotations[c], translations[c], rotation, translation, own[:3], own[3])
        for i in range(counts[c]):
            inlier[c, i] = reprojection_error(columns[c], i, own[:3], own[3], focals[c]) < limits[c]
            if not inlier[c, i]:
                kept[c, 4, i] = math.nan
    refine_rig(kept, rotations, translations, focals, scales, CAUCHY, steps[1], tolerance, rotation, translation)
    return rotation, translation, inlier
