"""The perspective three-point problem (P3P) as the intersection of two conics.

The law of cosines in the three triangles of camera and two points gives three quadratic forms in the points' distances
d = (d0, d1, d2): d' M d = a. Two combinations of them are homogeneous, d' C1 d = d' C2 d = 0: conics in the plane of
d's directions (Persson and Nordberg, Lambda Twist, ECCV 2018). A real root g of det(C1 + g C2) makes C1 + g C2 a pair
of lines, which its adjugate splits (Ding, Yang, Larsson, Olsson and Astrom, Revisiting the P3P Problem, CVPR 2023);
each line meets a conic in at most two directions.

    forms (6)    of a symmetric matrix: 00, 01, 02, 11, 12, 22
    rays (3, 3)  unit vectors in camera axes, one a row
"""

from __future__ import annotations

import math

import numpy as np

from service.jit import inline

WORK = (14, 6)
"""Shape of the memory that a solution needs: a row for each vector and form, and of the matrices."""
_NEWTON_STEPS = 3
_EXACT = 1e-13
"""Squared distances need no further step where they are off by less, relative."""
_PAIRS = np.array([[0, 1], [0, 2], [1, 2]])
"""Of points, in the order of the squared distances a."""


@inline
def real_cubic_root(a, b, c, d):
    """Return a real root of a x^3 + b x^2 + c x + d, in closed form and polished; NaN where there is none."""
    if a == 0.0:
        return math.nan
    p, q, r = b / a, c / a, d / a
    shift = p / 3.0
    # x = y - shift: y^3 + 3 u y - 2 v = 0
    u, v = q / 3.0 - shift * shift, 0.5 * (p * q / 3.0 - r) - shift * shift * shift
    discriminant = u * u * u + v * v
    if discriminant > 0.0:
        w = math.sqrt(discriminant)
        y = np.cbrt(v + w) if v > 0.0 else np.cbrt(v - w)
        x = (y - u / y if y != 0.0 else 0.0) - shift
    else:
        radius = math.sqrt(-u)
        x = 0.0 - shift
        if radius > 0.0:
            angle = math.acos(min(1.0, max(-1.0, v / (radius * radius * radius)))) / 3.0
            x = 2.0 * radius * math.cos(angle) - shift
    for _ in range(2):
        slope = (3.0 * x + 2.0 * p) * x + q
        if slope != 0.0:
            x -= (((x + p) * x + q) * x + r) / slope
    return x


@inline
def adjugate(m, out):
    """Write the adjugate of a symmetric matrix; both are forms."""
    out[0] = m[3] * m[5] - m[4] * m[4]
    out[1] = m[2] * m[4] - m[1] * m[5]
    out[2] = m[1] * m[4] - m[2] * m[3]
    out[3] = m[0] * m[5] - m[2] * m[2]
    out[4] = m[1] * m[2] - m[0] * m[4]
    out[5] = m[0] * m[3] - m[1] * m[1]


@inline
def trace_of_product(m, n):
    """Return the trace of the product of two forms."""
    return m[0] * n[0] + m[3] * n[3] + m[5] * n[5] + 2.0 * (m[1] * n[1] + m[2] * n[2] + m[4] * n[4])


@inline
def applied(m, x, y):
    """Return x' M y of a form M."""
    return (
        x[0] * (m[0] * y[0] + m[1] * y[1] + m[2] * y[2])
        + x[1] * (m[1] * y[0] + m[3] * y[1] + m[4] * y[2])
        + x[2] * (m[2] * y[0] + m[4] * y[1] + m[5] * y[2])
    )


@inline
def split_lines(m, minors, lines):
    """Write the two lines whose union is the degenerate conic of form `m`; return False if they aren't real."""
    adjugate(m, minors)
    # The adjugate is -p p' for the point p where the lines meet.
    largest = 0 if minors[0] < minors[3] else 3
    largest = largest if minors[largest] < minors[5] else 5
    if not minors[largest] < 0.0:
        return False
    root = math.sqrt(-minors[largest])
    if largest == 0:
        p0, p1, p2 = minors[0] / root, minors[1] / root, minors[2] / root
    elif largest == 3:
        p0, p1, p2 = minors[1] / root, minors[3] / root, minors[4] / root
    else:
        p0, p1, p2 = minors[2] / root, minors[4] / root, minors[5] / root
    # The matrix plus the cross product with p has rank one: its rows are one line, its columns the other.
    full = (
        (m[0], m[1] - p2, m[2] + p1),
        (m[1] + p2, m[3], m[4] - p0),
        (m[2] - p1, m[4] + p0, m[5]),
    )
    row, column, most = 0, 0, -1.0
    for i in range(3):
        for j in range(3):
            if abs(full[i][j]) > most:
                row, column, most = i, j, abs(full[i][j])
    for j in range(3):
        lines[0, j], lines[1, j] = full[row][j], full[j][column]
    return most > 0.0


@inline
def polish_distances(d, cosines, squares):
    """Improve the three distances by Newton steps on the law of cosines; return whether they are all positive."""
    for _ in range(_NEWTON_STEPS):
        r0 = d[0] * d[0] + d[1] * d[1] - 2.0 * cosines[0] * d[0] * d[1] - squares[0]
        r1 = d[0] * d[0] + d[2] * d[2] - 2.0 * cosines[1] * d[0] * d[2] - squares[1]
        r2 = d[1] * d[1] + d[2] * d[2] - 2.0 * cosines[2] * d[1] * d[2] - squares[2]
        if abs(r0) + abs(r1) + abs(r2) < _EXACT * squares[2]:
            break
        # Half of the Jacobian, which has zeros: (a b 0; c 0 e; 0 f g).
        a, b = d[0] - cosines[0] * d[1], d[1] - cosines[0] * d[0]
        c, e = d[0] - cosines[1] * d[2], d[2] - cosines[1] * d[0]
        f, g = d[1] - cosines[2] * d[2], d[2] - cosines[2] * d[1]
        determinant = -(a * e * f + b * c * g)
        if determinant == 0.0:
            break
        scale = 0.5 / determinant
        d[0] -= scale * (-e * f * r0 - b * g * r1 + b * e * r2)
        d[1] -= scale * (-c * g * r0 + a * g * r1 - a * e * r2)
        d[2] -= scale * (c * f * r0 - a * f * r1 - b * c * r2)
    return d[0] > 0.0 and d[1] > 0.0 and d[2] > 0.0


@inline
def pose_of_distances(d, rays, points, inverse, rotation, translation):
    """Write camera_from_world of three points (world) that are these distances along their rays."""
    for k in range(3):
        origin = d[0] * rays[0, k]
        x, y = d[1] * rays[1, k] - origin, d[2] * rays[2, k] - origin
        rotation[k, 0], rotation[k, 1] = x, y
    rotation[0, 2] = rotation[1, 0] * rotation[2, 1] - rotation[2, 0] * rotation[1, 1]
    rotation[1, 2] = rotation[2, 0] * rotation[0, 1] - rotation[0, 0] * rotation[2, 1]
    rotation[2, 2] = rotation[0, 0] * rotation[1, 1] - rotation[1, 0] * rotation[0, 1]
    for i in range(3):
        x, y, z = rotation[i, 0], rotation[i, 1], rotation[i, 2]
        for j in range(3):
            rotation[i, j] = x * inverse[0, j] + y * inverse[1, j] + z * inverse[2, j]
        at = rotation[i, 0] * points[0, 0] + rotation[i, 1] * points[0, 1] + rotation[i, 2] * points[0, 2]
        translation[i] = d[0] * rays[0, i] - at


@inline
def inverse_of_edges(points, inverse):
    """Write the inverse of the matrix with columns p1 - p0, p2 - p0 and their cross product; False if it has none."""
    ax, ay, az = points[1, 0] - points[0, 0], points[1, 1] - points[0, 1], points[1, 2] - points[0, 2]
    bx, by, bz = points[2, 0] - points[0, 0], points[2, 1] - points[0, 1], points[2, 2] - points[0, 2]
    cx, cy, cz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    square = cx * cx + cy * cy + cz * cz
    if not square > 0.0:
        return False
    inverse[0, 0], inverse[0, 1], inverse[0, 2] = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
    inverse[1, 0], inverse[1, 1], inverse[1, 2] = cy * az - cz * ay, cz * ax - cx * az, cx * ay - cy * ax
    inverse[2, 0], inverse[2, 1], inverse[2, 2] = cx, cy, cz
    for i in range(3):
        for j in range(3):
            inverse[i, j] /= square
    return True


@inline
def solve_p3p(rays, points, work, rotations, translations):
    """Write every camera_from_world that sees three points (world) along three rays; return how many: 0 to 4.

    `work` is float64 of shape WORK, `rotations` (4, 3, 3), `translations` (4, 3). Rotations are orthonormal but for
    rounding.
    """
    inverse, lines, d = work[0:3], work[3:5], work[5]
    cosines, squares = work[6], work[7]
    first, second, minors, degenerate = work[8], work[9], work[10], work[11]
    if not inverse_of_edges(points, inverse):
        return 0
    total = 0.0
    for n in range(3):
        i, j = _PAIRS[n]
        cosine, square = 0.0, 0.0
        for k in range(3):
            cosine += rays[i, k] * rays[j, k]
            square += (points[i, k] - points[j, k]) ** 2
        cosines[n], squares[n] = cosine, square
        total += square
    c01, c02, c12 = cosines[0], cosines[1], cosines[2]
    s0, s1 = squares[0] / squares[2], squares[1] / squares[2]
    # M01 - s0 M12 and M02 - s1 M12.
    first[0], first[1], first[2], first[3], first[4], first[5] = 1.0, -c01, 0.0, 1.0 - s0, s0 * c12, -s0
    second[0], second[1], second[2], second[3], second[4], second[5] = 1.0, 0.0, -c02, -s1, s1 * c12, 1.0 - s1
    adjugate(first, minors)
    constant, linear = trace_of_product(first, minors) / 3.0, trace_of_product(second, minors)
    adjugate(second, minors)
    quadratic, cubic = trace_of_product(first, minors), trace_of_product(second, minors) / 3.0
    root = real_cubic_root(cubic, quadratic, linear, constant)
    if not math.isfinite(root):
        return 0
    for n in range(6):
        degenerate[n] = first[n] + root * second[n]
    if not split_lines(degenerate, minors, lines):
        return 0
    count = 0
    for n in range(2):
        count = _on_line(lines[n], first, total, cosines, squares, work[12:14], d, rays, points, inverse, rotations,
                         translations, count)  # fmt: skip
    return count


@inline
def _on_line(
    line, conic, total, cosines, squares, basis, d, rays, points, inverse, rotations, translations, count
):  # fmt: skip
    """Append the poses whose distances' direction is on a line and on a conic; return the new count."""
    # Two directions that span the line: perpendicular to it, made from its two largest components.
    u, v = basis[0], basis[1]
    x, y, z = abs(line[0]), abs(line[1]), abs(line[2])
    if x >= y and x >= z:
        u[0], u[1], u[2] = -line[1], line[0], 0.0
        v[0], v[1], v[2] = -line[2], 0.0, line[0]
    elif y >= z:
        u[0], u[1], u[2] = line[1], -line[0], 0.0
        v[0], v[1], v[2] = 0.0, -line[2], line[1]
    else:
        u[0], u[1], u[2] = line[2], 0.0, -line[0]
        v[0], v[1], v[2] = 0.0, line[2], -line[1]
    a, b, c = applied(conic, u, u), applied(conic, u, v), applied(conic, v, v)
    discriminant = b * b - a * c
    if not discriminant >= 0.0:
        return count
    # Both roots of a s^2 + 2 b s t + c t^2 without cancellation: (s, t) = (w, a) and (c, w).
    w = -b - math.copysign(math.sqrt(discriminant), b)
    for n in range(2):
        s, t = (w, a) if n == 0 else (c, w)
        if n == 1 and discriminant == 0.0:
            break
        for k in range(3):
            d[k] = s * u[k] + t * v[k]
        # The sum of the three forms scales the direction.
        form = 2.0 * (d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
        form -= 2.0 * (cosines[0] * d[0] * d[1] + cosines[1] * d[0] * d[2] + cosines[2] * d[1] * d[2])
        if not form > 0.0:
            continue
        scale = math.copysign(math.sqrt(total / form), d[0])
        for k in range(3):
            d[k] *= scale
        if not (d[0] > 0.0 and d[1] > 0.0 and d[2] > 0.0):
            continue
        if polish_distances(d, cosines, squares):
            pose_of_distances(d, rays, points, inverse, rotations[count], translations[count])
            count += 1
    return count
