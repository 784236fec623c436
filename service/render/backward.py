"""Gradients of the image by the Gaussians' ellipses and colours, front to back like the blending itself.

For one pixel let s_i = d loss / d (weight of Gaussian i), w_i its weight, P_i the sum of w s up to and with i, and
total the sum over all. Then d loss / d alpha_i = T_i s_i - (total - P_i) / (1 - alpha_i). The total follows from the
image, and the suffix is the total minus the prefix, so that no list of a pixel's Gaussians is stored.

Per Gaussian ten sums over its pixels are enough. v = -alpha d loss / d alpha = d loss / d sigma has six moments about
the centre, and w times the gradients of red, green, blue and depth gives four:

    sums of a record [ v | v dx | v dy | v dx^2 | v dx dy | v dy^2 | w gr | w gg | w gb | w gd | 0 ... ]   16 floats

A block takes 16 Gaussians and keeps v and w as rows [Gaussian][pixel]; transposed, the sums over pixels become
additions of vectors whose lanes are Gaussians; transposed again, they are added to the Gaussians' rows. This replaces
a sum over 16 lanes for each of ten values by three transpositions for 16 Gaussians.
"""

from __future__ import annotations

import numpy as np

from service.jit import inline, kernel
from service.render.blend import (
    ALPHA_MAX,
    BATCH,
    BL,
    LIST,
    T_MIN,
    A,
    B,
    C,
    G,
    O,
    R,
    X,
    Y,
    Z,
    exp2,
    gather_batch,
    record_lists_by_block,
)
from service.render.project import LOG2_ALPHA_MIN, TILE
from service.render.simd import (
    at,
    bits,
    broadcast,
    fma,
    gather,
    iload,
    iota,
    isplat,
    load,
    select,
    splat,
    store,
    to_float,
    transpose16,
    vmin,
)

INPUT = 8 * 16
"""Floats of a block's constants: gr, gg, gb, gd, ga, total, and the state T and prefix."""
WORK = 3 * 256
"""Floats for v, w and the sums of 16 Gaussians."""


@kernel
def blend_backward(records, starts, entries, width, height, background, rgb, alpha, depth, d_rgb, d_depth, d_alpha,
                   local, lists, lengths, inputs, work, batch_sums, sums):  # fmt: skip
    """Add every record's ten sums to `sums`, 16 floats a record. Images are flat, as `blend` wrote them."""
    tiles_x = (width + TILE - 1) // TILE
    tiles_y = (height + TILE - 1) // TILE
    for tile in range(tiles_x * tiles_y):
        first, last = np.intp(starts[tile]), np.intp(starts[tile + 1])
        if first == last:
            continue
        tile_x, tile_y = tile % tiles_x * TILE, tile // tiles_x * TILE
        alive = np.uint32(0)
        for block in range(16):
            x, y = tile_x + block % 4 * 4, tile_y + block // 4 * 4
            if x < width and y < height:
                alive |= np.uint32(1) << np.uint32(block)
                _read_block(inputs, block, x, y, width, height, background, rgb, alpha, depth, d_rgb, d_depth, d_alpha)
        while first < last and alive != 0:
            count = min(BATCH, last - first)
            gather_batch(records, entries, first, count, local)
            record_lists_by_block(local, count, tile_x, tile_y, alive, lists, lengths)
            # Sums of the batch first: its 128 rows stay in the cache while 16 blocks add to them.
            for i in range(count):
                store(batch_sums, i * 16, splat(0.0))
            for block in range(16):
                if not (alive >> np.uint32(block)) & np.uint32(1) or lengths[block] == 0:
                    continue
                x, y = tile_x + block % 4 * 4, tile_y + block // 4 * 4
                if not _run_block(local, lists, block, np.intp(lengths[block]), x, y, inputs, work, batch_sums):
                    alive &= ~(np.uint32(1) << np.uint32(block))
            for i in range(count):
                target = at(entries, first + i) * 16
                store(sums, target, load(sums, target) + load(batch_sums, i * 16))
            first += count


@inline
def _read_block(inputs, block, x, y, width, height, background, rgb, alpha, depth, d_rgb, d_depth, d_alpha):
    """Convert the gradients of a block's pixels to those of the weights: s = gr r + gg g + gb b + gd z + ga."""
    base = block * INPUT
    for k in range(8):
        store(inputs, base + k * 16, splat(0.0))
    for row in range(min(4, height - y)):
        for column in range(min(4, width - x)):
            pixel = np.uint64((y + row) * width + x + column)
            lane = np.uint64(base + row * 4 + column)
            three = pixel * np.uint64(3)
            a = alpha[pixel]
            ga, total = d_alpha[pixel], np.float32(0.0)
            for c in range(np.uint64(3)):
                g = d_rgb[three + c]
                ga -= g * background[c]
                total += g * (rgb[three + c] - (np.float32(1.0) - a) * background[c])
                inputs[lane + c * np.uint64(16)] = g
            # The depth is normalized by alpha: d depth / d w_i = (z_i - depth) / alpha.
            gd = d_depth[pixel] / max(a, np.float32(1e-12)) if a > 0 else np.float32(0.0)
            ga -= gd * depth[pixel]
            inputs[lane + np.uint64(48)] = gd
            inputs[lane + np.uint64(64)] = ga
            inputs[lane + np.uint64(80)] = total + gd * depth[pixel] * a + ga * a
            inputs[lane + np.uint64(96)] = 1.0  # transmittance; pixels outside the image keep 0 and add nothing


@inline
def _run_block(local, lists, block, length, x, y, inputs, work, batch_sums):
    """Take the block's list and add to its Gaussians' sums. Returns False when every pixel is opaque."""
    base = block * INPUT
    gr, gg, gb = load(inputs, base), load(inputs, base + 16), load(inputs, base + 32)
    gd, ga, total = load(inputs, base + 48), load(inputs, base + 64), load(inputs, base + 80)
    t, prefix = load(inputs, base + 96), load(inputs, base + 112)
    px = to_float(iota() & isplat(3)) + np.float32(x + 0.5)
    py = to_float(iota() >> isplat(2)) + np.float32(y + 0.5)
    going = True
    for start in range(0, length, 16):
        count = min(16, length - start)
        for k in range(count):
            i = at(lists, block * LIST + start + k)
            dx = px - broadcast(local, X + i)
            dy = py - broadcast(local, Y + i)
            slope = fma(dx, broadcast(local, A + i), dy * broadcast(local, B + i))
            e = broadcast(local, O + i) - fma(dx, slope, dy * dy * broadcast(local, C + i))
            raw = exp2(e)
            a = select(e >= LOG2_ALPHA_MIN, vmin(raw, ALPHA_MAX), 0.0)
            # As in `blend`, operation by operation: the total is the image's, and must be this sum's.
            w = a * t
            t = fma(-a, t, t)
            counted = t > T_MIN
            w = select(counted, w, 0.0)
            s = fma(gd, broadcast(local, Z + i), ga)
            s = fma(
                gr,
                broadcast(local, R + i),
                fma(gg, broadcast(local, G + i), fma(gb, broadcast(local, BL + i), s)),
            )
            ws = w * s
            prefix = prefix + ws
            v = fma(total - prefix, a / (1.0 - a), -ws)
            # A clamped alpha doesn't change with sigma.
            store(work, k * 16, select(counted & (raw <= ALPHA_MAX), v, 0.0))
            store(work, 256 + k * 16, w)
        for k in range(count, 16):
            store(work, k * 16, splat(0.0))
            store(work, 256 + k * 16, splat(0.0))
        _sum_up(local, lists, block * LIST + start, count, x, y, inputs, base, work, batch_sums)
        if bits(t > T_MIN) == 0:
            going = False
            break
    store(inputs, base + 96, t)
    store(inputs, base + 112, prefix)
    return going


@inline
def _sum_up(local, lists, listed, count, x, y, inputs, base, work, batch_sums):
    """Sum v's moments and w's products over the 16 pixels of the block, for 16 Gaussians at once."""
    transpose16(work, 0, 16, work, 0, 16)
    transpose16(work, 256, 16, work, 256, 16)
    zero = splat(0.0)
    # Moments about the block's first pixel, whose columns and rows are the integers 0..3.
    m, mx, my, mxx, mxy, myy = zero, zero, zero, zero, zero, zero
    r, g, b, d = zero, zero, zero, zero
    for row in range(4):
        line = row * 64
        v0, v1, v2, v3 = load(work, line), load(work, line + 16), load(work, line + 32), load(work, line + 48)
        level = np.float32(row)
        s0 = (v0 + v1) + (v2 + v3)
        s1 = fma(v3, 3.0, fma(v2, 2.0, v1))
        s2 = fma(v3, 9.0, fma(v2, 4.0, v1))
        m, mx, mxx = m + s0, mx + s1, mxx + s2
        my, mxy, myy = fma(s0, level, my), fma(s1, level, mxy), fma(s0, level * level, myy)
        for column in range(4):
            lane = row * 4 + column
            w = load(work, 256 + lane * 16)
            r = fma(w, broadcast(inputs, base + lane), r)
            g = fma(w, broadcast(inputs, base + 16 + lane), g)
            b = fma(w, broadcast(inputs, base + 32 + lane), b)
            d = fma(w, broadcast(inputs, base + 48 + lane), d)
    # A list's unused end holds anything: keep the index inside the batch.
    index = iload(lists, listed) & isplat(BATCH - 1)
    # Shifted to the moments about each Gaussian's centre.
    ox, oy = (
        np.float32(x + 0.5) - gather(local, index),
        np.float32(y + 0.5) - gather(local, index + isplat(Y)),
    )
    store(work, 512, m)
    store(work, 528, fma(ox, m, mx))
    store(work, 544, fma(oy, m, my))
    store(work, 560, fma(ox, fma(ox, m, mx * 2.0), mxx))
    store(work, 576, fma(ox, fma(oy, m, my), fma(oy, mx, mxy)))
    store(work, 592, fma(oy, fma(oy, m, my * 2.0), myy))
    store(work, 608, r)
    store(work, 624, g)
    store(work, 640, b)
    store(work, 656, d)
    for k in range(10, 16):
        store(work, 512 + k * 16, zero)
    transpose16(work, 512, 16, work, 512, 16)
    for k in range(count):
        target = at(lists, listed + k) * 16
        store(batch_sums, target, load(batch_sums, target) + load(work, 512 + k * 16))
