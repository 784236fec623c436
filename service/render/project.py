"""Projection: Gaussians in the world to ellipses on the image, 16 at a time (EWA splatting, Zwicker et al. 2001).

Covariance in the image: J R S R^T J^T + dilation * I, with the perspective Jacobian J at the centre, whose direction is
clamped to 1.3 times the field of view, as in gsplat. Input is structure of arrays (see `pack`), so that one operation
takes 16 Gaussians; output is one record for each visible Gaussian, one cache line, since later steps read all values of
a single Gaussian:

    [ x | y | A | B | C | log2 opacity | depth | r | g | b | packed index (int bits) | raw r | raw g | raw b | - | - ]

log2 alpha = log2 opacity - (A dx^2 + B dx dy + C dy^2), dx = x - pixel: factors 1/2 and log2 e are in A, B, C, so that
blending needs one exp2. The raw colours are those before the clamp at 0, whose gradient needs their sign.
"""

from __future__ import annotations

import numpy as np

from service.jit import inline, kernel
from service.render.pack import CHUNKS_PER_BLOCK, VISIBLE_SIGMAS
from service.render.simd import (
    as_float,
    as_int,
    bits,
    floor,
    fma,
    iota,
    isplat,
    load,
    select,
    sqrt,
    store,
    to_float,
    to_int,
    transpose16,
    vmax,
    vmin,
)
from service.types import SH_C0

RECORD = 16
"""Floats of a record."""
TILE = 16
"""Pixels of a tile's side."""
SQUARE = 4
"""Pixels of the side of a square, of which `blend` knows whether it still lets light through."""
SQUARES = TILE // SQUARE
HALF_LOG2E = np.float32(0.5 * np.log2(np.e))
TWO_LN2 = np.float32(2 * np.log(2.0))
LOG2_ALPHA_MIN = np.float32(-np.log2(255.0))

C0 = SH_C0
C1 = 0.4886025119029199
C20, C21, C22, C23, C24 = (
    1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396,
)  # fmt: skip
C30, C31, C32, C33, C34, C35, C36 = (
    -0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154, -0.4570457994644658,
    1.445305721320277, -0.5900435899266435,
)  # fmt: skip


@inline
def log2_of(x):
    """Return log2 of positive floats, by the series of atanh around 1; error below 1e-7."""
    shifted = as_int(x) - 0x3F3504F3  # sqrt(1/2): the mantissa lands in [sqrt(1/2), sqrt(2))
    exponent = select(shifted < 0, (shifted >> 23) - 512, shifted >> 23)
    mantissa = as_float((shifted & 0x7FFFFF) + 0x3F3504F3)
    s = (mantissa - 1.0) / (mantissa + 1.0)
    s2 = s * s
    series = fma(s2, fma(s2, fma(s2, fma(s2, 1.0 / 9, 1.0 / 7), 1.0 / 5), 1.0 / 3), 1.0)
    return fma(s * series, 2.8853900817779268, to_float(exponent))


@inline
def colour(sh, at, degree, x, y, z):
    """Return red, green, blue of SH at unit directions; `at`: the chunk's offset. Basis: Sloan 2013, as 3DGS."""
    r, g, b = load(sh, at) * C0, load(sh, at + 16) * C0, load(sh, at + 32) * C0
    if degree >= 1:
        at += 48
        r, g, b = _add_basis(sh, at, y * -C1, r, g, b)
        r, g, b = _add_basis(sh, at + 48, z * C1, r, g, b)
        r, g, b = _add_basis(sh, at + 96, x * -C1, r, g, b)
    if degree >= 2:
        at += 144
        xx, yy, zz = x * x, y * y, z * z
        r, g, b = _add_basis(sh, at, x * y * C20, r, g, b)
        r, g, b = _add_basis(sh, at + 48, y * z * C21, r, g, b)
        r, g, b = _add_basis(sh, at + 96, (zz * 2.0 - xx - yy) * C22, r, g, b)
        r, g, b = _add_basis(sh, at + 144, x * z * C23, r, g, b)
        r, g, b = _add_basis(sh, at + 192, (xx - yy) * C24, r, g, b)
    if degree >= 3:
        at += 240
        xx, yy, zz = x * x, y * y, z * z
        r, g, b = _add_basis(sh, at, y * (xx * 3.0 - yy) * C30, r, g, b)
        r, g, b = _add_basis(sh, at + 48, x * y * z * C31, r, g, b)
        r, g, b = _add_basis(sh, at + 96, y * (zz * 4.0 - xx - yy) * C32, r, g, b)
        r, g, b = _add_basis(sh, at + 144, z * (zz * 2.0 - (xx + yy) * 3.0) * C33, r, g, b)
        r, g, b = _add_basis(sh, at + 192, x * (zz * 4.0 - xx - yy) * C34, r, g, b)
        r, g, b = _add_basis(sh, at + 240, z * (xx - yy) * C35, r, g, b)
        r, g, b = _add_basis(sh, at + 288, x * (xx - yy * 3.0) * C36, r, g, b)
    return r + 0.5, g + 0.5, b + 0.5


@inline
def _add_basis(sh, at, basis, r, g, b):
    return fma(basis, load(sh, at), r), fma(basis, load(sh, at + 16), g), fma(basis, load(sh, at + 32), b)


@inline
def in_view(sphere, view, low_x, high_x, low_y, high_y, near):
    """Whether a bounding sphere reaches into the field of view, enlarged to the clamped region."""
    x, y, z, radius = sphere[0], sphere[1], sphere[2], sphere[3]
    cx = view[0] * x + view[1] * y + view[2] * z + view[3]
    cy = view[4] * x + view[5] * y + view[6] * z + view[7]
    cz = view[8] * x + view[9] * y + view[10] * z + view[11]
    # Behind the camera. The tests below compare with the planes through the camera's centre.
    if cz + radius < near:
        return False
    # Distances from the four side planes, whose normals aren't normalized: the radius is scaled instead.
    return (
        cx - high_x * cz < radius * np.sqrt(1 + high_x * high_x)
        and -cx - low_x * cz < radius * np.sqrt(1 + low_x * low_x)
        and cy - high_y * cz < radius * np.sqrt(1 + high_y * high_y)
        and -cy - low_y * cz < radius * np.sqrt(1 + low_y * low_y)
    )


@kernel
def blocks_in_view(spheres, view, pinhole, width, height, near, blocks, extents):
    """Write the numbers of the blocks that may be seen, and the least and largest depth of each; return how many."""
    low_x, high_x, low_y, high_y = _clamp_region(pinhole, width, height)
    count = 0
    for block in range(spheres.shape[0]):
        sphere = spheres[block]
        if in_view(sphere, view, low_x, high_x, low_y, high_y, near):
            blocks[count] = block
            depth = view[8] * sphere[0] + view[9] * sphere[1] + view[10] * sphere[2] + view[11]
            extents[count, 0], extents[count, 1] = depth - sphere[3], depth + sphere[3]
            count += 1
    return count


@inline
def _clamp_region(pinhole, width, height):
    """Return low x, high x, low y, high y of the region that ellipses are clamped to, at depth 1; low is -x, -y."""
    fx, fy, cx, cy = pinhole[0], pinhole[1], pinhole[2], pinhole[3]
    high_x = (width - cx) / fx + np.float32(0.15) * width / fx
    low_x = cx / fx + np.float32(0.15) * width / fx
    high_y = (height - cy) / fy + np.float32(0.15) * height / fy
    low_y = cy / fy + np.float32(0.15) * height / fy
    return low_x, high_x, low_y, high_y


@inline
def block_hidden(sphere, view, pinhole, near, far, tiles_x, tiles_y, tile_depths, open_sums, margin):
    """Whether what a bounding sphere has between two depths is hidden wherever it may reach in the image.

    `margin`: by how many squares of 4 x 4 pixels the dilation may enlarge what it has.
    """
    x, y, z, radius = sphere[0], sphere[1], sphere[2], sphere[3]
    cz = view[8] * x + view[9] * y + view[10] * z + view[11]
    nearest, farthest = max(cz - radius, near), min(cz + radius, far)
    if nearest >= farthest:
        return True
    cx = view[0] * x + view[1] * y + view[2] * z + view[3]
    cy = view[4] * x + view[5] * y + view[6] * z + view[7]
    low_x, high_x = _between(cx - radius, cx + radius, nearest, farthest, pinhole[0], pinhole[2])
    low_y, high_y = _between(cy - radius, cy + radius, nearest, farthest, pinhole[1], pinhole[3])
    if len(open_sums):
        wide, high = tiles_x * SQUARES, tiles_y * SQUARES
        x0, x1 = _cells(low_x, high_x, SQUARE, wide, margin)
        y0, y1 = _cells(low_y, high_y, SQUARE, high, margin)
        if closed(x0, y0, x1, y1, wide, open_sums):
            return True
    if len(tile_depths) == 0:
        return False
    x0, x1 = _cells(low_x, high_x, TILE, tiles_x, 1)
    y0, y1 = _cells(low_y, high_y, TILE, tiles_y, 1)
    return hidden(nearest, x0, y0, x1, y1, tiles_x, tile_depths)


@inline
def _between(low, high, nearest, farthest, focal, centre):
    """Return the range of pixels along one axis that a box in the camera frame projects to."""
    first = min(low / nearest, low / farthest) * focal + centre
    return first, max(high / nearest, high / farthest) * focal + centre


@inline
def _cells(first, last, side, count, margin):
    """Return the range of cells of so many pixels that a range of pixels is in, some more at each end."""
    low, high = first / side - margin, last / side + (1 + margin)
    return int(max(0, min(low, count))), int(max(0, min(high, count)))


@inline
def hidden(depth, x0, y0, x1, y1, tiles_x, tile_depths):
    """Whether a depth lies behind the occlusion depths of all these tiles."""
    for ty in range(y0, y1):
        for tx in range(x0, x1):
            if depth <= tile_depths[np.intp(ty * tiles_x + tx)]:
                return False
    return True


@inline
def closed(x0, y0, x1, y1, wide, open_sums):
    """Whether none of these squares is open; `open_sums` as in `project`, of `wide` squares a row."""
    top, bottom = np.intp(y0 * (wide + 1)), np.intp(y1 * (wide + 1))
    return open_sums[bottom + x1] - open_sums[bottom + x0] == open_sums[top + x1] - open_sums[top + x0]


@inline
def _not_hidden(mask, rects, scratch, tiles_x, tile_depths, open_sums):
    """Return the mask without the lanes that are hidden in all tiles, or closed in all squares, that they reach."""
    for lane in range(16):
        if not (mask >> np.uint32(lane)) & np.uint32(1):
            continue
        x0, y0, x1, y1 = rects[512 + lane], rects[528 + lane], rects[544 + lane], rects[560 + lane]
        is_hidden = len(tile_depths) > 0 and hidden(scratch[96 + lane], x0, y0, x1, y1, tiles_x, tile_depths)
        if not is_hidden and len(open_sums):
            x0, y0, x1, y1 = rects[576 + lane], rects[592 + lane], rects[608 + lane], rects[624 + lane]
            is_hidden = closed(x0, y0, x1, y1, tiles_x * SQUARES, open_sums)
        if is_hidden:
            mask &= ~(np.uint32(1) << np.uint32(lane))
    return mask


@kernel
def project(geometry, sh, spheres, chunk_spheres, blocks, degree, view, pinhole, width, height, dilation,
            antialiased, near, far, tile_depths, open_sums, records, depths, rects, scratch):  # fmt: skip
    """Write a record, a depth and a tile rectangle for every visible Gaussian; return (visible, tile entries).

    Visible are those of `blocks` between the depths `near` and `far`. `view`: camera_from_world, 12 floats row by row.
    `pinhole`: fx, fy, cx, cy. `tile_depths`: for each tile the depth beyond which nothing is seen; empty: unlimited.
    `open_sums`: the number of open squares of 4 x 4 pixels above and left of each corner of squares, row by row, where
    in the others nothing is seen; empty: all are open. A rectangle is four 16-bit tile numbers: x0, y0, x1, y1 (ends
    excluded).
    """
    fx, fy, cx, cy = pinhole[0], pinhole[1], pinhole[2], pinhole[3]
    low_x, high_x, low_y, high_y = _clamp_region(pinhole, width, height)
    tiles_x, tiles_y = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    r00, r01, r02, t0 = view[0], view[1], view[2], view[3]
    r10, r11, r12, t1 = view[4], view[5], view[6], view[7]
    r20, r21, r22, t2 = view[8], view[9], view[10], view[11]
    # Position of the camera in the world: -R^T t.
    eye_x = -(r00 * t0 + r10 * t1 + r20 * t2)
    eye_y = -(r01 * t0 + r11 * t1 + r21 * t2)
    eye_z = -(r02 * t0 + r12 * t1 + r22 * t2)
    coefficients = (degree + 1) * (degree + 1) * 3
    chunks = geometry.shape[0] // 160
    visible = 0
    entries = 0
    integers = scratch.view(np.int32)
    may_hide = len(tile_depths) > 0 or len(open_sums) > 0
    margin = 1 + int(np.float32(VISIBLE_SIGMAS) * np.sqrt(dilation) / SQUARE)
    for place in range(blocks.shape[0]):
        block = np.intp(blocks[place])
        if may_hide and block_hidden(
            spheres[block], view, pinhole, near, far, tiles_x, tiles_y, tile_depths, open_sums, margin
        ):
            continue
        for chunk in range(block * CHUNKS_PER_BLOCK, min((block + 1) * CHUNKS_PER_BLOCK, chunks)):
            if may_hide and block_hidden(
                chunk_spheres[chunk], view, pinhole, near, far, tiles_x, tiles_y, tile_depths, open_sums, margin
            ):
                continue
            at = chunk * 160
            mx, my, mz = load(geometry, at), load(geometry, at + 16), load(geometry, at + 32)
            z = fma(mx, r20, fma(my, r21, fma(mz, r22, t2)))
            seen = (z > near) & (z <= far)
            if bits(seen) == 0:
                continue
            x = fma(mx, r00, fma(my, r01, fma(mz, r02, t0)))
            y = fma(mx, r10, fma(my, r11, fma(mz, r12, t1)))
            inverse_z = 1.0 / z
            u, v = x * inverse_z, y * inverse_z
            px, py = fma(u, fx, cx), fma(v, fy, cy)
            # Rows of J R: the covariance is then two quadratic forms of S and one mixed.
            u, v = vmin(vmax(u, -low_x), high_x), vmin(vmax(v, -low_y), high_y)
            jx, jy = inverse_z * fx, inverse_z * fy
            a0, a1, a2 = (r00 - u * r20) * jx, (r01 - u * r21) * jx, (r02 - u * r22) * jx
            b0, b1, b2 = (r10 - v * r20) * jy, (r11 - v * r21) * jy, (r12 - v * r22) * jy
            s00, s01, s02 = load(geometry, at + 48), load(geometry, at + 64), load(geometry, at + 80)
            s11, s12, s22 = load(geometry, at + 96), load(geometry, at + 112), load(geometry, at + 128)
            sa0 = fma(s00, a0, fma(s01, a1, s02 * a2))
            sa1 = fma(s01, a0, fma(s11, a1, s12 * a2))
            sa2 = fma(s02, a0, fma(s12, a1, s22 * a2))
            cxx = fma(a0, sa0, fma(a1, sa1, a2 * sa2))
            cxy = fma(b0, sa0, fma(b1, sa1, b2 * sa2))
            sb0 = fma(s00, b0, fma(s01, b1, s02 * b2))
            sb1 = fma(s01, b0, fma(s11, b1, s12 * b2))
            sb2 = fma(s02, b0, fma(s12, b1, s22 * b2))
            cyy = fma(b0, sb0, fma(b1, sb1, b2 * sb2))
            dxx, dyy = cxx + dilation, cyy + dilation
            determinant = dxx * dyy - cxy * cxy
            log2_opacity = load(geometry, at + 144)
            if antialiased:
                sharp = cxx * cyy - cxy * cxy
                shrink = log2_of(vmax(sharp, 1e-30) / determinant) * 0.5
                log2_opacity = select(sharp > 0.0, log2_opacity + shrink, -1e9)
            # Where alpha falls to 1/255: sigma = ln2 (log2 opacity - log2 1/255), half width sqrt(2 sigma cov).
            reach = (log2_opacity - LOG2_ALPHA_MIN) * TWO_LN2
            seen = seen & (determinant > 0.0) & (reach > 0.0)
            wide, high = sqrt(vmax(reach, 0.0) * dxx), sqrt(vmax(reach, 0.0) * dyy)
            seen = seen & (px + wide > 0.0) & (px - wide < width) & (py + high > 0.0) & (py - high < height)
            mask = bits(seen)
            if mask == 0:
                continue
            to_tile = np.float32(1.0 / TILE)
            store(integers, 512, to_int(vmax((px - wide) * to_tile, 0.0)))
            store(integers, 528, to_int(vmax((py - high) * to_tile, 0.0)))
            store(integers, 544, to_int(vmin(floor((px + wide) * to_tile) + 1.0, tiles_x)))
            store(integers, 560, to_int(vmin(floor((py + high) * to_tile) + 1.0, tiles_y)))
            store(scratch, 96, z)
            if len(open_sums):
                to_square = np.float32(1.0 / SQUARE)
                store(integers, 576, to_int(vmax((px - wide) * to_square, 0.0)))
                store(integers, 592, to_int(vmax((py - high) * to_square, 0.0)))
                store(integers, 608, to_int(vmin(floor((px + wide) * to_square) + 1.0, tiles_x * SQUARES)))
                store(integers, 624, to_int(vmin(floor((py + high) * to_square) + 1.0, tiles_y * SQUARES)))
            if may_hide:
                mask = _not_hidden(mask, integers, scratch, tiles_x, tile_depths, open_sums)
                if mask == 0:
                    continue
            # Colours for chunks with a visible Gaussian only: at degree 3, SH are five times the memory of the rest.
            inverse = HALF_LOG2E / determinant
            dx, dy, dz = mx - eye_x, my - eye_y, mz - eye_z
            length = 1.0 / sqrt(fma(dx, dx, fma(dy, dy, dz * dz)))
            red, green, blue = colour(sh, chunk * coefficients * 16, degree, dx * length, dy * length, dz * length)
            store(scratch, 0, px)
            store(scratch, 16, py)
            store(scratch, 32, dyy * inverse)
            store(scratch, 48, cxy * inverse * -2.0)
            store(scratch, 64, dxx * inverse)
            store(scratch, 80, log2_opacity)
            store(scratch, 112, vmax(red, 0.0))
            store(scratch, 128, vmax(green, 0.0))
            store(scratch, 144, vmax(blue, 0.0))
            store(scratch, 160, as_float(iota() + isplat(chunk * 16)))
            store(scratch, 176, red)
            store(scratch, 192, green)
            store(scratch, 208, blue)
            # From vectors of 16 Gaussians to their records.
            transpose16(scratch, 0, 16, scratch, 256, 16)
            # Visible Gaussians are written without gaps, in the packed order.
            for lane in range(16):
                if (mask >> np.uint32(lane)) & np.uint32(1):
                    x0, y0 = integers[512 + lane], integers[528 + lane]
                    x1, y1 = integers[544 + lane], integers[560 + lane]
                    store(records, visible * 16, load(scratch, 256 + lane * 16))
                    depths[visible] = scratch[96 + lane]
                    rects[visible] = (
                        np.uint64(x0) | np.uint64(y0) << np.uint64(16)
                        | np.uint64(x1) << np.uint64(32) | np.uint64(y1) << np.uint64(48)
                    )  # fmt: skip
                    entries += (x1 - x0) * (y1 - y0)
                    visible += 1
    return visible, entries
