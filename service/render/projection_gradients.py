"""The chain rule of `project`: from a record's ten sums (`backward`) to gradients by camera and Gaussians.

Written for j_a = (fx/z, 0, -fx u/z) and j_b = (0, fy/z, -fy v/z), the rows of the perspective Jacobian, and
a = R^T j_a, b = R^T j_b, the same rows in the world frame: covariance in the image = [a; b] S [a; b]^T + dilation I.
Lanes are Gaussians: 16 records at a time are transposed into vectors, as in `project`.

Twist: world_from_camera @ exp(rotation, translation), so a point in the camera moves by -(rotation x p) - translation.
"""

from __future__ import annotations

import numpy as np

from service.jit import inline, kernel
from service.render.project import (
    C0,
    C1,
    C20,
    C21,
    C22,
    C23,
    C24,
    C30,
    C31,
    C32,
    C33,
    C34,
    C35,
    C36,
    HALF_LOG2E,
)
from service.render.simd import (
    as_int,
    fma,
    gather,
    isplat,
    load,
    select,
    splat,
    sqrt,
    store,
    sum16,
    transpose16,
    vmax,
    vmin,
)

ROW = 16
"""Floats of a Gaussian's row that `scene_rows` writes: d mean (3), d S (xx xy xz yy yz zz), d ln opacity,
d colour (3, 0 where clamped), viewing direction (3)."""


@kernel
def pose_twist(records, sums, visible, geometry, sh, degree, view, pinhole, width, height, dilation, antialiased,
               scratch, twist):  # fmt: skip
    """Write d loss / d twist (rotation, translation), float64."""
    r = view
    for k in range(6):
        twist[k] = 0.0
    for first in range(0, visible, 16):
        gx, gy, gz, x, y, z, wx, wy, wz, _, _, dx, dy, dz = _gaussian(
            records, sums, first, visible, geometry, sh, degree, view, pinhole, width, height, dilation, antialiased,
            scratch,
        )  # fmt: skip
        twist[0] += sum16(wx - (y * gz - z * gy))
        twist[1] += sum16(wy - (z * gx - x * gz))
        twist[2] += sum16(wz - (x * gy - y * gx))
        # The viewing direction, and so the colour, changes with the camera's position only, not with its rotation.
        twist[3] -= sum16(gx + fma(dx, r[0], fma(dy, r[1], dz * r[2])))
        twist[4] -= sum16(gy + fma(dx, r[4], fma(dy, r[5], dz * r[6])))
        twist[5] -= sum16(gz + fma(dx, r[8], fma(dy, r[9], dz * r[10])))


@kernel
def scene_rows(records, sums, visible, geometry, sh, degree, view, pinhole, width, height, dilation, antialiased,
               scratch, rows):  # fmt: skip
    """Write a row of 16 floats for every record; `rows` has room for a multiple of 16."""
    r = view
    for first in range(0, visible, 16):
        gx, gy, gz, _, _, _, _, _, _, a, b, dx, dy, dz = _gaussian(
            records, sums, first, visible, geometry, sh, degree, view, pinhole, width, height, dilation, antialiased,
            scratch,
        )  # fmt: skip
        (a0, a1, a2), (b0, b1, b2) = a, b
        # Rows of `scratch` from 768 on are the columns of the output: d mean, then d S = [a b] d covariance [a b]^T.
        gxx, gxy, gyy = load(scratch, 512), load(scratch, 528), load(scratch, 544)
        store(scratch, 768, fma(gx, r[0], fma(gy, r[4], fma(gz, r[8], dx))))
        store(scratch, 784, fma(gx, r[1], fma(gy, r[5], fma(gz, r[9], dy))))
        store(scratch, 800, fma(gx, r[2], fma(gy, r[6], fma(gz, r[10], dz))))
        ta0, ta1, ta2 = fma(gxx, a0, gxy * b0), fma(gxx, a1, gxy * b1), fma(gxx, a2, gxy * b2)
        tb0, tb1, tb2 = fma(gxy, a0, gyy * b0), fma(gxy, a1, gyy * b1), fma(gxy, a2, gyy * b2)
        store(scratch, 816, fma(a0, ta0, b0 * tb0))
        store(scratch, 832, fma(a0, ta1, b0 * tb1))
        store(scratch, 848, fma(a0, ta2, b0 * tb2))
        store(scratch, 864, fma(a1, ta1, b1 * tb1))
        store(scratch, 880, fma(a1, ta2, b1 * tb2))
        store(scratch, 896, fma(a2, ta2, b2 * tb2))
        store(scratch, 912, -load(scratch, 256))
        for k in range(3):
            store(scratch, 928 + k * 16, load(scratch, 560 + k * 16))
            store(scratch, 976 + k * 16, load(scratch, 608 + k * 16))
        transpose16(scratch, 768, 16, rows, first * 16, 16)


@inline
def _gaussian(records, sums, first, visible, geometry, sh, degree, view, pinhole, width, height, dilation, antialiased,
              scratch):  # fmt: skip
    """Apply the chain rule to 16 records.

    Returns d point in the camera frame, the point, d rotation through the covariance, a, b, and d direction mapped to
    the Gaussian's centre. Leaves in `scratch`: sums at 256, d covariance (xx, xy, yy) at 512, d colour at 560, the
    viewing direction at 608.
    """
    fx, fy, cx, cy = pinhole[0], pinhole[1], pinhole[2], pinhole[3]
    r = view
    for lane in range(16):
        i = min(first + lane, visible - 1) * 16  # the last group repeats the last record, with sums of 0
        store(scratch, lane * 16, load(records, i))
        store(scratch, 256 + lane * 16, load(sums, i) if first + lane < visible else splat(0.0))
    transpose16(scratch, 0, 16, scratch, 0, 16)
    transpose16(scratch, 256, 16, scratch, 256, 16)
    place = as_int(load(scratch, 160))
    at = (place >> isplat(4)) * 160 + (place & isplat(15))
    mx, my, mz = gather(geometry, at), gather(geometry, at + 16), gather(geometry, at + 32)
    x = fma(mx, r[0], fma(my, r[1], fma(mz, r[2], r[3])))
    y = fma(mx, r[4], fma(my, r[5], fma(mz, r[6], r[7])))
    z = load(scratch, 96)
    inverse_z = 1.0 / z
    jx, jy = inverse_z * fx, inverse_z * fy
    x_z, y_z = x * inverse_z, y * inverse_z
    # The clamp of `project`: J is taken at most 15 % of the image outside its border.
    u = vmin(
        vmax(x_z, -(cx / fx + np.float32(0.15) * width / fx)),
        (width - cx) / fx + np.float32(0.15) * width / fx,
    )
    v = vmin(
        vmax(y_z, -(cy / fy + np.float32(0.15) * height / fy)),
        (height - cy) / fy + np.float32(0.15) * height / fy,
    )
    a0, a1, a2 = (r[0] - u * r[8]) * jx, (r[1] - u * r[9]) * jx, (r[2] - u * r[10]) * jx
    b0, b1, b2 = (r[4] - v * r[8]) * jy, (r[5] - v * r[9]) * jy, (r[6] - v * r[10]) * jy

    # Q, the inverse covariance, from the record's scaled A, B, C.
    qa, qb, qc = (
        load(scratch, 32) / HALF_LOG2E,
        load(scratch, 48) / (2 * HALF_LOG2E),
        load(scratch, 64) / HALF_LOG2E,
    )
    m, sx, sy = load(scratch, 256), load(scratch, 272), load(scratch, 288)
    sxx, sxy, syy = load(scratch, 304), load(scratch, 320), load(scratch, 336)
    gu, gv = -fma(qa, sx, qb * sy), -fma(qb, sx, qc * sy)
    # d covariance = -Q D Q with D = 1/2 [[sxx, sxy], [sxy, syy]]
    e0, e1 = fma(qa, sxx, qb * sxy), fma(qa, sxy, qb * syy)
    f0, f1 = fma(qb, sxx, qc * sxy), fma(qb, sxy, qc * syy)
    gxx, gxy, gyy = fma(e0, qa, e1 * qb) * -0.5, fma(e0, qb, e1 * qc) * -0.5, fma(f0, qb, f1 * qc) * -0.5
    if antialiased:
        # ln compensation = 1/2 (ln det without - ln det with dilation); d / d ln opacity = -m
        determinant = 1.0 / (qa * qc - qb * qb)
        sxx0, sxy0, syy0 = qc * determinant - dilation, -qb * determinant, qa * determinant - dilation
        sharp = 1.0 / (sxx0 * syy0 - sxy0 * sxy0)
        half = m * 0.5
        gxx, gxy, gyy = (
            fma(half, qa - syy0 * sharp, gxx),
            fma(half, qb + sxy0 * sharp, gxy),
            fma(half, qc - sxx0 * sharp, gyy),
        )
    store(scratch, 512, gxx)
    store(scratch, 528, gxy)
    store(scratch, 544, gyy)

    s00, s01, s02 = gather(geometry, at + 48), gather(geometry, at + 64), gather(geometry, at + 80)
    s11, s12, s22 = gather(geometry, at + 96), gather(geometry, at + 112), gather(geometry, at + 128)
    sa0, sa1, sa2 = _times(s00, s01, s02, s11, s12, s22, a0, a1, a2)
    sb0, sb1, sb2 = _times(s00, s01, s02, s11, s12, s22, b0, b1, b2)
    # d a, d b in the world frame, then rotated to the camera frame: d j
    da0, da1, da2 = _rotated(
        r, 2.0 * fma(gxx, sa0, gxy * sb0), 2.0 * fma(gxx, sa1, gxy * sb1), 2.0 * fma(gxx, sa2, gxy * sb2)
    )
    db0, db1, db2 = _rotated(
        r, 2.0 * fma(gxy, sa0, gyy * sb0), 2.0 * fma(gxy, sa1, gyy * sb1), 2.0 * fma(gxy, sa2, gyy * sb2)
    )
    ja2, jb2 = -jx * u, -jy * v
    # j x d j, with j_a = (jx, 0, ja2) and j_b = (0, jy, jb2)
    wx = jy * db2 - jb2 * db1 - ja2 * da1
    wy = ja2 * da0 - jx * da2 + jb2 * db0
    wz = jx * da1 - jy * db0
    # Through jx = fx / z, jy = fy / z and the clamped u, v.
    d_jx, d_jy = da0 - u * da2, db1 - v * db2
    du = select((u <= x_z) & (u >= x_z), -jx * da2, 0.0)
    dv = select((v <= y_z) & (v >= y_z), -jy * db2, 0.0)
    gx = fma(gu, jx, du * inverse_z)
    gy = fma(gv, jy, dv * inverse_z)
    gz = load(scratch, 400) - inverse_z * (fma(d_jx, jx, d_jy * jy) + fma(du, x_z, dv * y_z))
    gz = gz - fma(gu * jx, x_z, gv * jy * y_z)
    dx, dy, dz = _direction(scratch, sh, place, degree, view, mx, my, mz)
    return gx, gy, gz, x, y, z, wx, wy, wz, (a0, a1, a2), (b0, b1, b2), dx, dy, dz


@inline
def _times(s00, s01, s02, s11, s12, s22, x, y, z):
    """Multiply a symmetric matrix and a vector."""
    return (
        fma(s00, x, fma(s01, y, s02 * z)),
        fma(s01, x, fma(s11, y, s12 * z)),
        fma(s02, x, fma(s12, y, s22 * z)),
    )


@inline
def _rotated(r, x, y, z):
    """Rotate a vector from the world to the camera frame."""
    return (
        fma(x, r[0], fma(y, r[1], z * r[2])),
        fma(x, r[4], fma(y, r[5], z * r[6])),
        fma(x, r[8], fma(y, r[9], z * r[10])),
    )


@inline
def _direction(scratch, sh, place, degree, r, mx, my, mz):
    """Return the colour's gradient by the Gaussian's centre: through the viewing direction and the SH basis."""
    # A colour that was clamped at 0 has no gradient.
    red = select(load(scratch, 176) > 0.0, load(scratch, 352), 0.0)
    green = select(load(scratch, 192) > 0.0, load(scratch, 368), 0.0)
    blue = select(load(scratch, 208) > 0.0, load(scratch, 384), 0.0)
    store(scratch, 560, red)
    store(scratch, 576, green)
    store(scratch, 592, blue)
    # centre - camera position, with the position -R^T t
    x = mx + (r[0] * r[3] + r[4] * r[7] + r[8] * r[11])
    y = my + (r[1] * r[3] + r[5] * r[7] + r[9] * r[11])
    z = mz + (r[2] * r[3] + r[6] * r[7] + r[10] * r[11])
    inverse = 1.0 / sqrt(fma(x, x, fma(y, y, z * z)))
    x, y, z = x * inverse, y * inverse, z * inverse
    store(scratch, 608, x)
    store(scratch, 624, y)
    store(scratch, 640, z)
    gx, gy, gz = splat(0.0), splat(0.0), splat(0.0)
    coefficients = (degree + 1) * (degree + 1) * 3
    at = (place >> isplat(4)) * (coefficients * 16) + (place & isplat(15))
    if degree >= 1:
        gy = _weighted_coefficient(sh, at, 1, red, green, blue) * -C1
        gz = _weighted_coefficient(sh, at, 2, red, green, blue) * C1
        gx = _weighted_coefficient(sh, at, 3, red, green, blue) * -C1
    if degree >= 2:
        k = _weighted_coefficient(sh, at, 4, red, green, blue) * C20
        gx, gy = fma(k, y, gx), fma(k, x, gy)
        k = _weighted_coefficient(sh, at, 5, red, green, blue) * C21
        gy, gz = fma(k, z, gy), fma(k, y, gz)
        k = _weighted_coefficient(sh, at, 6, red, green, blue) * (2 * C22)
        gx, gy, gz = fma(-k, x, gx), fma(-k, y, gy), fma(k * 2.0, z, gz)
        k = _weighted_coefficient(sh, at, 7, red, green, blue) * C23
        gx, gz = fma(k, z, gx), fma(k, x, gz)
        k = _weighted_coefficient(sh, at, 8, red, green, blue) * (2 * C24)
        gx, gy = fma(k, x, gx), fma(-k, y, gy)
    if degree >= 3:
        xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
        k = _weighted_coefficient(sh, at, 9, red, green, blue) * (3 * C30)
        gx, gy = fma(k * 2.0, xy, gx), fma(k, xx - yy, gy)
        k = _weighted_coefficient(sh, at, 10, red, green, blue) * C31
        gx, gy, gz = fma(k, yz, gx), fma(k, xz, gy), fma(k, xy, gz)
        k = _weighted_coefficient(sh, at, 11, red, green, blue) * C32
        gx, gy, gz = fma(k * -2.0, xy, gx), fma(k, 4.0 * zz - xx - 3.0 * yy, gy), fma(k * 8.0, yz, gz)
        k = _weighted_coefficient(sh, at, 12, red, green, blue) * (3 * C33)
        gx, gy, gz = fma(k * -2.0, xz, gx), fma(k * -2.0, yz, gy), fma(k, 2.0 * zz - xx - yy, gz)
        k = _weighted_coefficient(sh, at, 13, red, green, blue) * C34
        gx, gy, gz = fma(k, 4.0 * zz - 3.0 * xx - yy, gx), fma(k * -2.0, xy, gy), fma(k * 8.0, xz, gz)
        k = _weighted_coefficient(sh, at, 14, red, green, blue) * C35
        gx, gy, gz = fma(k * 2.0, xz, gx), fma(k * -2.0, yz, gy), fma(k, xx - yy, gz)
        k = _weighted_coefficient(sh, at, 15, red, green, blue) * (3 * C36)
        gx, gy = fma(k, xx - yy, gx), fma(k * -2.0, xy, gy)
    # Of a normalized vector: the tangential part, divided by the length.
    along = fma(gx, x, fma(gy, y, gz * z))
    return (gx - along * x) * inverse, (gy - along * y) * inverse, (gz - along * z) * inverse


@inline
def _weighted_coefficient(sh, at, k, red, green, blue):
    """Return the sum over the channels of SH coefficient k times the colour's gradient."""
    r, g, b = gather(sh, at + 48 * k), gather(sh, at + (48 * k + 16)), gather(sh, at + (48 * k + 32))
    return fma(r, red, fma(g, green, b * blue))


@kernel
def unpack_rows(rows, records, visible, order, quats, scales, opacities, degree,
                index, d_means, d_quats, d_scales, d_opacities, d_sh):  # fmt: skip
    """Convert rows to gradients by the scene's parameters: from S to quaternion and scales, from colour to SH."""
    places = records.view(np.int32)
    for v in range(visible):
        row = v * ROW
        i = order[places[v * 16 + 10]]
        index[v] = i
        for axis in range(3):
            d_means[v, axis] = rows[row + axis]
        d_opacities[v] = rows[row + 9] / opacities[i]
        _shape(rows, row, quats[i], scales[i], d_quats[v], d_scales[v])
        _sh_row(rows, row, degree, d_sh[v])


@inline
def _shape(rows, row, quat, scale, d_quat, d_scale):
    """Differentiate S = M M^T, M = R diag(scale): d M = 2 D M, then R by the quaternion, tangential part."""
    w, x, y, z = quat[0], quat[1], quat[2], quat[3]
    d00, d01, d02 = rows[row + 3], rows[row + 4], rows[row + 5]
    d11, d12, d22 = rows[row + 6], rows[row + 7], rows[row + 8]
    r00, r01, r02 = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    r10, r11, r12 = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    r20, r21, r22 = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    # t = D R: column j of d M is 2 t_j scale_j
    t00, t01, t02 = (d00 * r00 + d01 * r10 + d02 * r20, d00 * r01 + d01 * r11 + d02 * r21,
                     d00 * r02 + d01 * r12 + d02 * r22)  # fmt: skip
    t10, t11, t12 = (d01 * r00 + d11 * r10 + d12 * r20, d01 * r01 + d11 * r11 + d12 * r21,
                     d01 * r02 + d11 * r12 + d12 * r22)  # fmt: skip
    t20, t21, t22 = (d02 * r00 + d12 * r10 + d22 * r20, d02 * r01 + d12 * r11 + d22 * r21,
                     d02 * r02 + d12 * r12 + d22 * r22)  # fmt: skip
    d_scale[0] = 2 * scale[0] * (r00 * t00 + r10 * t10 + r20 * t20)
    d_scale[1] = 2 * scale[1] * (r01 * t01 + r11 * t11 + r21 * t21)
    d_scale[2] = 2 * scale[2] * (r02 * t02 + r12 * t12 + r22 * t22)
    # g = d R, from d M = d R diag(scale)
    a0, a1, a2 = 2 * scale[0] * scale[0], 2 * scale[1] * scale[1], 2 * scale[2] * scale[2]
    g00, g10, g20 = a0 * t00, a0 * t10, a0 * t20
    g01, g11, g21 = a1 * t01, a1 * t11, a1 * t21
    g02, g12, g22 = a2 * t02, a2 * t12, a2 * t22
    qw = 2 * (x * (g21 - g12) + y * (g02 - g20) + z * (g10 - g01))
    qx = 2 * (-2 * x * (g11 + g22) + y * (g10 + g01) + z * (g20 + g02) + w * (g21 - g12))
    qy = 2 * (x * (g10 + g01) - 2 * y * (g00 + g22) + z * (g21 + g12) + w * (g02 - g20))
    qz = 2 * (x * (g20 + g02) + y * (g21 + g12) - 2 * z * (g00 + g11) + w * (g10 - g01))
    along = qw * w + qx * x + qy * y + qz * z
    d_quat[0], d_quat[1] = qw - along * w, qx - along * x
    d_quat[2], d_quat[3] = qy - along * y, qz - along * z


@inline
def _sh_row(rows, row, degree, d_sh):
    """Multiply the colour's gradient by the SH basis at the viewing direction."""
    red, green, blue = rows[row + 10], rows[row + 11], rows[row + 12]
    x, y, z = rows[row + 13], rows[row + 14], rows[row + 15]
    _put(d_sh, 0, C0, red, green, blue)
    if degree >= 1:
        _put(d_sh, 1, -C1 * y, red, green, blue)
        _put(d_sh, 2, C1 * z, red, green, blue)
        _put(d_sh, 3, -C1 * x, red, green, blue)
    xx, yy, zz = x * x, y * y, z * z
    if degree >= 2:
        _put(d_sh, 4, C20 * x * y, red, green, blue)
        _put(d_sh, 5, C21 * y * z, red, green, blue)
        _put(d_sh, 6, C22 * (2 * zz - xx - yy), red, green, blue)
        _put(d_sh, 7, C23 * x * z, red, green, blue)
        _put(d_sh, 8, C24 * (xx - yy), red, green, blue)
    if degree >= 3:
        _put(d_sh, 9, C30 * y * (3 * xx - yy), red, green, blue)
        _put(d_sh, 10, C31 * x * y * z, red, green, blue)
        _put(d_sh, 11, C32 * y * (4 * zz - xx - yy), red, green, blue)
        _put(d_sh, 12, C33 * z * (2 * zz - 3 * xx - 3 * yy), red, green, blue)
        _put(d_sh, 13, C34 * x * (4 * zz - xx - yy), red, green, blue)
        _put(d_sh, 14, C35 * z * (xx - yy), red, green, blue)
        _put(d_sh, 15, C36 * x * (xx - 3 * yy), red, green, blue)


@inline
def _put(d_sh, k, basis, red, green, blue):
    d_sh[k, 0], d_sh[k, 1], d_sh[k, 2] = basis * red, basis * green, basis * blue
