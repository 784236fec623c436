"""Compiled inner loops of photometric refinement: linearization, residuals, normal equations. Float32 throughout."""

from __future__ import annotations

import numpy as np

from service.jit import inline, kernel, kernel_reordered_sums


@kernel
def linearize(render, depth, pixels, k):
    """Return the pixels' points in the render's camera frame, and the jacobian d intensity / d unknowns, transposed.

    `render` and `depth` are (h, w); `pixels` index the render without its border, row by row; `k` is fx, fy, cx, cy of
    the render. The 14 unknowns: twist of the render's camera (6), gain, bias, gamma, blur, and the photo's
    `correction_vector` (4). The jacobian is at the identity and a gain of 1.
    """
    fx, fy, cx, cy = k[0], k[1], k[2], k[3]
    # The border is left out: central differences need both neighbours.
    inner = render.shape[1] - 2
    n = len(pixels)
    points = np.empty((3, n), np.float32)
    jacobian = np.empty((14, n), np.float32)
    side = max(render.shape)
    for i in range(n):
        row, column = pixels[i] // inner + 1, pixels[i] % inner + 1
        z = depth[row, column]
        x, y = (column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy
        points[0, i], points[1, i], points[2, i] = x * z, y * z, z
        # d intensity / d (x / z) and d intensity / d (y / z)
        du = 0.5 * (render[row, column + 1] - render[row, column - 1]) * fx
        dv = 0.5 * (render[row + 1, column] - render[row - 1, column]) * fy
        along = du * x + dv * y
        # A point X of the render moves by w x X + v with the twist (w, v).
        jacobian[0, i] = -dv - along * y
        jacobian[1, i] = du + along * x
        jacobian[2, i] = dv * x - du * y
        jacobian[3, i] = du / z
        jacobian[4, i] = dv / z
        jacobian[5, i] = -along / z
        jacobian[6, i] = render[row, column]
        jacobian[7, i] = 1.0
        # d / d gamma, then d / d blur: the laplacian.
        jacobian[8, i] = render[row, column] * (np.float32(1) - render[row, column])
        around = render[row, column + 1] + render[row, column - 1] + render[row + 1, column] + render[row - 1, column]
        jacobian[9, i] = around - np.float32(4) * render[row, column]
        # A longer focal length magnifies the photo, distortion does so with the squared radius; a shift of the
        # principal point carries it along.
        jacobian[10, i] = -along
        jacobian[11, i] = -along * (x * x + y * y)
        jacobian[12, i] = -du / fx * side
        jacobian[13, i] = -dv / fy * side
    return points, jacobian


@kernel
def fill_residuals(photo, points, basis, transform, k, photometric, l1_floor, residuals, weights):
    """Fill residuals and L1 weights, both 0 where the photo is unknown; return the sum of |r| and the pixels counted.

    `transform` is photo_from_render (4, 4), `k` the photo's fx, fy, cx, cy, k1, `basis` the photometric rows of the
    jacobian. Three passes, so that the first and the last vectorize: points -> places in the photo -> values there ->
    residuals.
    """
    n = points.shape[1]
    columns, rows = np.empty((2, n), np.float32)
    _project_points(points, transform.astype(np.float32), k.astype(np.float32), photo.shape, columns, rows)
    width, flat = photo.shape[1], photo.ravel()
    for i in range(n):
        if columns[i] < 0:
            residuals[i] = -1.0
            continue
        column, row = np.int32(columns[i]), np.int32(rows[i])
        a, b = columns[i] - np.float32(column), rows[i] - np.float32(row)
        # Unsigned indices spare numba's handling of negative ones.
        at = np.uint32(row * width + column)
        below = at + np.uint32(width)
        upper = flat[at] + a * (flat[at + np.uint32(1)] - flat[at])
        lower = flat[below] + a * (flat[below + np.uint32(1)] - flat[below])
        residuals[i] = upper + b * (lower - upper)
    gain, bias = np.float32(photometric[0]), np.float32(photometric[1])
    gamma, blur = np.float32(photometric[2]), np.float32(photometric[3])
    floor, total, count = np.float32(l1_floor), 0.0, 0
    for i in range(n):
        value = residuals[i]
        residual = value - gain * basis[0, i] - bias - gamma * basis[2, i] - blur * basis[3, i]
        residuals[i] = residual if value >= 0 else np.float32(0)
        weights[i] = np.float32(1) / max(abs(residual), floor) if value >= 0 else np.float32(0)
    for i in range(n):
        total += abs(residuals[i])
        count += weights[i] > 0
    return total, count


@inline
def _project_points(points, t, k, shape, columns, rows):
    """Fill where the points project to, in pixels from the centre of the photo's first pixel; column -1 if outside."""
    fx, fy, cx, cy, k1 = k[0], k[1], k[2] - np.float32(0.5), k[3] - np.float32(0.5), k[4]
    last_column, last_row = np.float32(shape[1] - 1), np.float32(shape[0] - 1)
    # Scalars instead of array reads let the loop vectorize.
    t00, t01, t02, t03 = t[0, 0], t[0, 1], t[0, 2], t[0, 3]
    t10, t11, t12, t13 = t[1, 0], t[1, 1], t[1, 2], t[1, 3]
    t20, t21, t22, t23 = t[2, 0], t[2, 1], t[2, 2], t[2, 3]
    for i in range(points.shape[1]):
        x, y, z = points[0, i], points[1, i], points[2, i]
        depth = t20 * x + t21 * y + t22 * z + t23
        inverse_depth = np.float32(1) / depth
        across = (t00 * x + t01 * y + t02 * z + t03) * inverse_depth
        down = (t10 * x + t11 * y + t12 * z + t13) * inverse_depth
        radial = np.float32(1) + k1 * (across * across + down * down)
        u = fx * (across * radial) + cx
        v = fy * (down * radial) + cy
        # A depth of 0 gives inf or NaN, which pass none of these comparisons.
        inside = (depth > 0) & (u >= 0) & (v >= 0) & (u < last_column) & (v < last_row)
        columns[i] = u if inside else np.float32(-1)
        rows[i] = v


@kernel_reordered_sums
def normal_equations(jacobian, weights, residuals, factors):
    """Return the hessian J W J^T and the right-hand side J W r, where J is the jacobian's rows times their factors."""
    count, n = jacobian.shape
    hessian, rhs = np.empty((count, count)), np.empty(count)
    weighted = np.empty(n, np.float32)
    for a in range(count):
        total = np.float32(0)
        for i in range(n):
            weighted[i] = jacobian[a, i] * weights[i]
            total += weighted[i] * residuals[i]
        rhs[a] = factors[a] * total
        # The hessian is symmetric: the lower triangle is enough.
        for b in range(a + 1):
            total = np.float32(0)
            for i in range(n):
                total += weighted[i] * jacobian[b, i]
            hessian[a, b] = hessian[b, a] = factors[a] * factors[b] * total
    return hessian, rhs


@kernel
def damped_solution(hessian, rhs, damping):
    """Return D y with (D H D + damping I) y = D rhs, where D = diag(H)^-1/2, by L D L^T without pivoting.

    H is positive semidefinite; not finite where a pivot is 0.
    """
    size = len(rhs)
    scale, low, pivots, x = np.empty(size), np.empty((size, size)), np.empty(size), np.empty(size)
    for a in range(size):
        scale[a] = 1.0 / np.sqrt(max(hessian[a, a], 1e-12))
    for a in range(size):
        pivots[a] = hessian[a, a] * scale[a] * scale[a] + damping
        x[a] = scale[a] * rhs[a]
        for b in range(a):
            total = hessian[a, b] * scale[a] * scale[b]
            for k in range(b):
                total -= low[a, k] * low[b, k] * pivots[k]
            low[a, b] = total / pivots[b]
            pivots[a] -= low[a, b] * total
            x[a] -= low[a, b] * x[b]
    for a in range(size - 1, -1, -1):
        x[a] /= pivots[a]
        for b in range(a + 1, size):
            x[a] -= low[b, a] * x[b]
    return x * scale


@kernel
def sum_scores_by_cell(jacobian, weights, residuals, pixels, width, cell_px, count, l1_floor):
    """Return each cell's sums of score J w r and hessian w J J^T, and how many pixels it has.

    The hessian leaves out residuals from `l1_floor` on: there the L1 loss has no curvature.
    """
    size = jacobian.shape[0]
    across = (width + cell_px - 1) // cell_px
    scores = np.zeros((count, size))
    hessians = np.zeros((count, size, size))
    used = np.zeros(count, np.int64)
    for i in range(len(pixels)):
        cell = pixels[i] // width // cell_px * across + pixels[i] % width // cell_px
        used[cell] += 1
        curved = abs(residuals[i]) < l1_floor
        for a in range(size):
            weighted = jacobian[a, i] * weights[i]
            scores[cell, a] += weighted * residuals[i]
            if curved:
                for b in range(a + 1):
                    hessians[cell, a, b] += weighted * jacobian[b, i]
    for cell in range(count):
        for a in range(size):
            for b in range(a):
                hessians[cell, b, a] = hessians[cell, a, b]
    return scores, hessians, used
