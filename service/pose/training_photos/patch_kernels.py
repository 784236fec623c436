"""Compiled inner loops of patch matching: projection of surface points, and least-squares matching.

A patch is the square of a training photo around a corner, seen as a plane's picture:

    patch, side P         photo to match with
    +-----------+            +-------+
    |           |   warp     |       |   a window of side W = 2 radius + 1 around the place looked for; the warp (2x2)
    |     + <---+------------+---+   |   maps its pixels, from its middle, to the patch, from the patch's middle
    |           |            |       |
    +-----------+            +-------+
"""

from __future__ import annotations

import numpy as np

from service.jit import inline, inline_reordered_sums, kernel

OUTSIDE = -1.0
"""Similarity of a patch that was not found."""


@kernel
def project_surface(points, tangents, transform, k):
    """Return where surface points project to (n, 2), their depths (n), and photo_from_patch (n, 2, 2).

    `points` (n, 3); `tangents` (n, 3, 2) are the motions of the point, in the world, for a pixel of its patch to the
    right and down; `transform` is camera_from_world; `k` is fx, fy, cx, cy.
    """
    n = len(points)
    px, depth, photo_from_patch = np.empty((n, 2)), np.empty(n), np.empty((n, 2, 2))
    for i in range(n):
        x, y, z = transform[:3, 3]
        for a in range(3):
            x += transform[0, a] * points[i, a]
            y += transform[1, a] * points[i, a]
            z += transform[2, a] * points[i, a]
        depth[i] = z
        inverse = 1.0 / z
        px[i, 0], px[i, 1] = k[0] * x * inverse + k[2], k[1] * y * inverse + k[3]
        for b in range(2):
            dx, dy, dz = 0.0, 0.0, 0.0
            for a in range(3):
                dx += transform[0, a] * tangents[i, a, b]
                dy += transform[1, a] * tangents[i, a, b]
                dz += transform[2, a] * tangents[i, a, b]
            photo_from_patch[i, 0, b] = k[0] * (dx - x * inverse * dz) * inverse
            photo_from_patch[i, 1, b] = k[1] * (dy - y * inverse * dz) * inverse
    return px, depth, photo_from_patch


@inline
def _warp_patch(patch, warp, radius, warped):
    """Fill the patch as the photo's window and its border of one pixel show it; negative where the patch ends."""
    side, middle, end = 2 * radius + 3, 0.5 * (len(patch) - 1), len(patch) - 1
    for row in range(side):
        for column in range(side):
            across, down = column - radius - 1, row - radius - 1
            x = warp[0, 0] * across + warp[0, 1] * down + middle
            y = warp[1, 0] * across + warp[1, 1] * down + middle
            if not (x >= 0 and y >= 0 and x < end and y < end):
                warped[row * side + column] = -1.0
                continue
            left, top = int(x), int(y)
            a, b = x - left, y - top
            upper = (1 - a) * patch[top, left] + a * patch[top, left + 1]
            lower = (1 - a) * patch[top + 1, left] + a * patch[top + 1, left + 1]
            warped[row * side + column] = (1 - b) * upper + b * lower


@inline
def _fill_template(warped, window, inside, template, gx, gy):
    """Fill template and gradients, orthogonal to a change of gain and bias; return how many pixels the patch covers."""
    side, used, total = window + 2, 0, 0.0
    for row in range(window):
        for column in range(window):
            j, at = row * window + column, (row + 1) * side + column + 1
            left, right, above, below = warped[at - 1], warped[at + 1], warped[at - side], warped[at + side]
            known = warped[at] >= 0 and left >= 0 and right >= 0 and above >= 0 and below >= 0
            inside[j] = 1.0 if known else 0.0
            template[j] = warped[at] if known else 0.0
            gx[j] = 0.5 * (right - left) if known else 0.0
            gy[j] = 0.5 * (below - above) if known else 0.0
            used += known
            total += template[j]
    mean = np.float32(total / max(used, 1))
    sums = np.zeros(5)
    for j in range(window * window):
        template[j] = (template[j] - mean) * inside[j]
        sums[0] += gx[j]
        sums[1] += gy[j]
        sums[2] += gx[j] * template[j]
        sums[3] += gy[j] * template[j]
        sums[4] += template[j] * template[j]
    bias_x, bias_y = np.float32(sums[0] / max(used, 1)), np.float32(sums[1] / max(used, 1))
    gain_x, gain_y = np.float32(sums[2] / max(sums[4], 1e-6)), np.float32(sums[3] / max(sums[4], 1e-6))
    for j in range(window * window):
        gx[j] = (gx[j] - bias_x - gain_x * template[j]) * inside[j]
        gy[j] = (gy[j] - bias_y - gain_y * template[j]) * inside[j]
    return used


@inline
def _fill_window(photo, column, row, window, values):
    """Fill the photo's values in a window, less a middle grey, so that sums of squares keep their digits."""
    left, top = int(column), int(row)
    a, b = np.float32(column - left), np.float32(row - top)
    flat, width, middle = photo.ravel(), photo.shape[1], np.float32(128)
    for y in range(window):
        # Unsigned indices spare numba's handling of negative ones.
        above = np.uint32((top + y) * width + left)
        below = above + np.uint32(width)
        at = np.uint32(y * window)
        for x in range(np.uint32(window)):
            v00, v01 = np.float32(flat[above + x]), np.float32(flat[above + x + np.uint32(1)])
            v10, v11 = np.float32(flat[below + x]), np.float32(flat[below + x + np.uint32(1)])
            upper, lower = v00 + a * (v01 - v00), v10 + a * (v11 - v10)
            values[at + x] = upper + b * (lower - upper) - middle


@inline_reordered_sums
def _correlate(values, inside, template, gx, gy):
    """Return the sums of gx v, gy v, template v, v and v v, where v are the photo's values in the window."""
    zero = np.float32(0)
    of_gx, of_gy, of_template, of_one, of_square = zero, zero, zero, zero, zero
    for j in range(len(values)):
        value = values[j] * inside[j]
        of_gx += gx[j] * value
        of_gy += gy[j] * value
        of_template += template[j] * value
        of_one += value
        of_square += value * value
    return of_gx, of_gy, of_template, of_one, of_square


@kernel
def match_patches(photo, patches, warps, start, radius, max_steps, settled_px, max_motion_px, min_contrast):
    """Return where patches are found in a photo (n, 2), and how similar they are there (n).

    Gauss-Newton over the place, with gain and bias eliminated: `photo` (h, w) and `patches` (n, P, P) are grey values
    in 8 bits, `warps` (n, 2, 2) patch_from_photo, `start` (n, 2) predicted places in pixels. The similarity is the
    normalized correlation, OUTSIDE where the place moves by more than `max_motion_px`, where the window leaves the
    photo, or where the patch has a standard deviation of less than `min_contrast` or no corner.
    """
    count, window = len(patches), 2 * radius + 1
    found, similarity = start.copy(), np.full(count, OUTSIDE)
    warped = np.empty((window + 2) * (window + 2), np.float32)
    # Of the window's pixels: 0 where the patch ends, template less its mean, its gradients without gain and bias.
    inside, template, gx, gy, values = np.empty((5, window * window), np.float32)
    for i in range(count):
        _warp_patch(patches[i], warps[i], radius, warped)
        used = _fill_template(warped, window, inside, template, gx, gy)
        if used < 0.6 * window * window:
            continue
        variance, hxx, hxy, hyy = 0.0, 0.0, 0.0, 0.0
        for j in range(window * window):
            variance += template[j] * template[j]
            hxx += gx[j] * gx[j]
            hxy += gx[j] * gy[j]
            hyy += gy[j] * gy[j]
        determinant = hxx * hyy - hxy * hxy
        # An edge has one direction only: its place along it would be chance.
        if variance < used * min_contrast * min_contrast or determinant < 5e-5 * (hxx + hyy) * (hxx + hyy):
            continue
        x, y = start[i]
        for _ in range(max_steps):
            column, row = x - 0.5 - radius, y - 0.5 - radius
            if not (column >= 0 and row >= 0 and column + window < photo.shape[1] and row + window < photo.shape[0]):
                break
            _fill_window(photo, column, row, window, values)
            sums = _correlate(values, inside, template, gx, gy)
            gain = max(sums[2] / variance, 0.2)
            step_x = (hyy * sums[0] - hxy * sums[1]) / determinant / gain
            step_y = (hxx * sums[1] - hxy * sums[0]) / determinant / gain
            longest = max(abs(step_x), abs(step_y))
            # Beyond one or two pixels the linearization says little.
            shorter = 1.5 / longest if longest > 1.5 else 1.0
            x -= shorter * step_x
            y -= shorter * step_y
            if abs(x - start[i, 0]) > max_motion_px or abs(y - start[i, 1]) > max_motion_px:
                break
            if longest < settled_px:
                spread = sums[4] - sums[3] * sums[3] / used
                found[i, 0], found[i, 1] = x, y
                similarity[i] = sums[2] / np.sqrt(max(spread * variance, 1e-6))
                break
    return found, similarity


@kernel
def linearize_places(points, covariances, observed, transform, k, noise_px, rows, residuals):
    """Fill whitened residuals (n, 2) of observed places, and d predicted / d right twist of the camera (n, 2, 6).

    A residual's covariance is that of matching, `noise_px` squared in each direction, and that of the point
    (`covariances`, (n, 3, 3), in the world) as the photo shows it. `transform` is camera_from_world; `k` is fx, fy, cx,
    cy.
    """
    place = np.empty((2, 3))
    of_twist = np.zeros((2, 6))
    for i in range(len(points)):
        x, y, z = transform[:3, 3]
        for a in range(3):
            x += transform[0, a] * points[i, a]
            y += transform[1, a] * points[i, a]
            z += transform[2, a] * points[i, a]
        u, v, inverse = x / z, y / z, 1.0 / z
        # d place / d point in the world.
        for a in range(3):
            place[0, a] = k[0] * inverse * (transform[0, a] - u * transform[2, a])
            place[1, a] = k[1] * inverse * (transform[1, a] - v * transform[2, a])
        sxx, sxy, syy = noise_px * noise_px, 0.0, noise_px * noise_px
        for a in range(3):
            for b in range(3):
                sxx += place[0, a] * covariances[i, a, b] * place[0, b]
                sxy += place[0, a] * covariances[i, a, b] * place[1, b]
                syy += place[1, a] * covariances[i, a, b] * place[1, b]
        # The inverse of the Cholesky factor of the covariance.
        w00 = 1.0 / np.sqrt(sxx)
        below = sxy * w00
        w11 = 1.0 / np.sqrt(max(syy - below * below, 1e-12))
        w10 = -below * w00 * w11
        # A point X moves in the camera's frame by -(w x X) - v with the twist (w, v).
        of_twist[0, 0], of_twist[1, 0] = k[0] * u * v, k[1] * (1 + v * v)
        of_twist[0, 1], of_twist[1, 1] = -k[0] * (1 + u * u), -k[1] * u * v
        of_twist[0, 2], of_twist[1, 2] = k[0] * v, -k[1] * u
        of_twist[0, 3], of_twist[1, 4] = -k[0] * inverse, -k[1] * inverse
        of_twist[0, 5], of_twist[1, 5] = k[0] * u * inverse, k[1] * v * inverse
        for c in range(6):
            rows[i, 0, c] = w00 * of_twist[0, c]
            rows[i, 1, c] = w10 * of_twist[0, c] + w11 * of_twist[1, c]
        rx, ry = observed[i, 0] - (k[0] * u + k[2]), observed[i, 1] - (k[1] * v + k[3])
        residuals[i, 0] = w00 * rx
        residuals[i, 1] = w10 * rx + w11 * ry
