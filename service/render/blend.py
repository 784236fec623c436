"""Blending: every 4x4 block of pixels is one SIMD vector that takes its Gaussians front to back.

    tile 16x16 = 16 blocks          block = 16 lanes           batch of 128 Gaussians of the tile's list
    +--+--+--+--+                   | 0| 1| 2| 3|              local [10 values][128]: structure of arrays
    | 0| 1| 2| 3|                   | 4| 5| 6| 7|              lists [16 blocks][128 + 16]: which of the batch
    | 4| ...                        | 8| ...                   touch the block (exact ellipse against rectangle)

A tile's list is taken in batches of 128 records, which stay in the L1 cache while the 16 blocks read them. Blocks, not
whole tiles, are the unit of work since most Gaussians of a trained scene are smaller than a tile: a block skips what
doesn't touch it, and stops once its 16 pixels are opaque.

Semantics (gsplat's): alpha below 1/255 is skipped, alpha is clamped at 0.999, a Gaussian that would bring the
transmittance T to 1e-4 or below is not added and ends the pixel. Here T goes on decaying after that: the dependency
between iterations is one fma, and `T after > 1e-4` is the mask of what counts. An approximate image ends a block once
all of its pixels have a transmittance of `end_t` or less.
"""

from __future__ import annotations

import numpy as np

from service.jit import inline, kernel
from service.render.project import LOG2_ALPHA_MIN, TILE
from service.render.simd import (
    as_float,
    as_int,
    at,
    bits,
    broadcast,
    compress,
    fma,
    iota,
    isplat,
    load,
    popcount,
    select,
    splat,
    store,
    store_quarter,
    store_rgb_rows,
    to_float,
    transpose16,
    vmax,
    vmin,
)

BATCH = 128
"""Records of a tile's list at once: 10 values of each are 5 kB."""
LIST = BATCH + 16
"""Elements of a block's list: a compressed vector is stored with its unused lanes."""
T_MIN = np.float32(1e-4)
"""Transmittance at which a pixel ends; gsplat's."""
ALPHA_MAX = np.float32(0.999)
# Rows of `local`: a record's first ten values (see `project`); behind them work space of `gather_batch`.
X, Y, A, B, C, O, Z, R, G, BL = (i * BATCH for i in range(10))  # noqa: E741
LOCAL = 16 * BATCH
STATE = 7 * 16
"""Floats of a block's state: T, r, g, b, depth sum, median depth, alpha."""
TILE_STATE = 16 * STATE


@inline
def exp2(x):
    """Return 2^x for x in -126..127, by a polynomial of degree 5 on -0.5..0.5; relative error 2e-7."""
    # Adding 1.5 * 2^23 leaves the rounded x in the low bits of the mantissa; a shift moves it to the exponent.
    shifted = x + 12582912.0
    f = x - (shifted - 12582912.0)
    p = fma(f, 0.0013400432, 0.009618073)
    p = fma(p, f, 0.05550327)
    p = fma(p, f, 0.24022652)
    p = fma(p, f, 0.6931472)
    p = fma(p, f, 1.0)
    return as_float(as_int(p) + (as_int(shifted) << 23))


@inline
def gather_batch(records, entries, first, count, local):
    """Transpose up to 128 records to structure of arrays; pad with Gaussians that touch nothing."""
    for group in range(0, count, 16):
        for lane in range(16):
            entry = first + min(group + lane, count - 1)
            store(local, LOCAL + lane * 16, load(records, at(entries, entry) * 16))
        transpose16(local, LOCAL, 16, local, group, BATCH)
        if group + 16 > count:
            real = (iota() + isplat(group)) < isplat(count)
            store(local, O + group, select(real, load(local, O + group), -1e9))


@inline
def record_lists_by_block(local, count, tile_x, tile_y, alive, lists, lengths):
    """List for every block that isn't finished the Gaussians whose alpha reaches 1/255 on its pixel centres.

    The quadratic form's minimum over a rectangle lies on the edges that face the Gaussian's centre: on each, the
    unconstrained minimum, clamped to the edge.
    """
    for block in range(16):
        lengths[block] = 0
    for group in range(0, count, 16):
        mx, my = load(local, X + group), load(local, Y + group)
        a, b, c = load(local, A + group), load(local, B + group), load(local, C + group)
        # 16 Gaussians against 16 blocks: lanes are Gaussians here, pixels in `_run_block`.
        bound = load(local, O + group) - LOG2_ALPHA_MIN
        slope_y, slope_x = b / (c * -2.0), b / (a * -2.0)
        index = iota() + isplat(group)
        for row in range(4):
            low_y = np.float32(tile_y + row * 4 + 0.5) - my
            high_y = low_y + 3.0
            dy = vmin(vmax(low_y, 0.0), high_y)
            cdy = c * dy * dy
            best_x = slope_x * dy
            bdy = b * dy
            for column in range(4):
                block = row * 4 + column
                if not (alive >> np.uint32(block)) & np.uint32(1):
                    continue
                low_x = np.float32(tile_x + column * 4 + 0.5) - mx
                high_x = low_x + 3.0
                dx = vmin(vmax(low_x, 0.0), high_x)
                y = vmin(vmax(slope_y * dx, low_y), high_y)
                x = vmin(vmax(best_x, low_x), high_x)
                vertical = fma(dx, fma(a, dx, b * y), c * y * y)
                horizontal = fma(x, fma(a, x, bdy), cdy)
                hit = vmin(vertical, horizontal) <= bound
                length = np.intp(lengths[block])
                # Without a branch: the indices that hit move to the front, and the length grows by their number.
                store(lists, block * LIST + length, compress(index, hit))
                lengths[block] = length + popcount(bits(hit))


@kernel
def blend(records, starts, entries, width, height, background, end_t, local, lists, lengths, state,
          rgb, alpha, depth, median):  # fmt: skip
    """Write the image. Flat float32 outputs: rgb interleaved, the others one plane each. `end_t`: at least T_MIN."""
    tiles_x = (width + TILE - 1) // TILE
    tiles_y = (height + TILE - 1) // TILE
    for tile in range(tiles_x * tiles_y):
        tile_x, tile_y = tile % tiles_x * TILE, tile // tiles_x * TILE
        _clear(state, 0)
        first, last = np.intp(starts[tile]), np.intp(starts[tile + 1])
        inside = _blocks_inside(tile_x, tile_y, width, height)
        _blend_list(records, entries, first, last, tile_x, tile_y, inside, end_t, local, lists, lengths, state, 0)
        _write_tile(state, 0, tile_x, tile_y, width, height, background, rgb, alpha, depth, median)


@kernel
def begin(width, height, states, alive):
    """Begin an image that is blended in several steps: clear the states of all tiles, and mark their blocks."""
    tiles_x = (width + TILE - 1) // TILE
    for tile in range(len(alive)):
        _clear(states, tile * TILE_STATE)
        alive[tile] = _blocks_inside(tile % tiles_x * TILE, tile // tiles_x * TILE, width, height)


@kernel
def blend_further(records, starts, entries, width, end_t, close_t, local, lists, lengths, states, alive):
    """Blend what is behind everything that was blended before; tiles without a block that is `alive` are passed by.

    Afterwards blocks are no longer alive whose pixels all have a transmittance of `close_t` or less.
    """
    tiles_x = (width + TILE - 1) // TILE
    for tile in range(len(alive)):
        first, last = np.intp(starts[tile]), np.intp(starts[tile + 1])
        if alive[tile] != 0 and first < last:
            tile_x, tile_y = tile % tiles_x * TILE, tile // tiles_x * TILE
            alive[tile] = _blend_list(
                records, entries, first, last, tile_x, tile_y, alive[tile], end_t, local, lists, lengths,
                states, tile * TILE_STATE,
            )  # fmt: skip
            for block in range(16):
                if bits(load(states, tile * TILE_STATE + block * STATE) > close_t) == 0:
                    alive[tile] &= ~(np.uint32(1) << np.uint32(block))


@kernel
def write(width, height, background, states, rgb, alpha, depth, median):
    """Write the image that was blended in several steps; the states are used up."""
    tiles_x = (width + TILE - 1) // TILE
    tiles_y = (height + TILE - 1) // TILE
    for tile in range(tiles_x * tiles_y):
        tile_x, tile_y = tile % tiles_x * TILE, tile // tiles_x * TILE
        base = tile * TILE_STATE
        _write_tile(states, base, tile_x, tile_y, width, height, background, rgb, alpha, depth, median)


@inline
def _blocks_inside(tile_x, tile_y, width, height):
    """Return a bit for each block of the tile that lies inside the image."""
    inside = np.uint32(0)
    for block in range(16):
        if tile_x + block % 4 * 4 < width and tile_y + block // 4 * 4 < height:
            inside |= np.uint32(1) << np.uint32(block)
    return inside


@inline
def _clear(states, base):
    for block in range(16):
        store(states, base + block * STATE, splat(1.0))  # transmittance
        for k in range(1, 7):
            store(states, base + block * STATE + k * 16, splat(0.0))


@inline
def _blend_list(records, entries, first, last, tile_x, tile_y, alive, end_t, local, lists, lengths, states, base):
    """Blend a part of a tile's list onto its state. Returns a bit for each block that still lets light through."""
    lane_x = to_float(iota() & isplat(3))
    lane_y = to_float(iota() >> isplat(2))
    while first < last and alive != 0:
        count = min(BATCH, last - first)
        gather_batch(records, entries, first, count, local)
        record_lists_by_block(local, count, tile_x, tile_y, alive, lists, lengths)
        first += count
        for block in range(16):
            if not (alive >> np.uint32(block)) & np.uint32(1) or lengths[block] == 0:
                continue
            px = lane_x + np.float32(tile_x + block % 4 * 4 + 0.5)
            py = lane_y + np.float32(tile_y + block // 4 * 4 + 0.5)
            at = base + block * STATE
            if not _run_block(local, lists, block, np.intp(lengths[block]), px, py, end_t, states, at):
                alive &= ~(np.uint32(1) << np.uint32(block))
    return alive


@inline
def _run_block(local, lists, block, length, px, py, end_t, state, base):
    """Blend the block's list onto its state. Returns False when every pixel's transmittance is `end_t` or less."""
    t, r, g = load(state, base), load(state, base + 16), load(state, base + 32)
    b, d, m = load(state, base + 48), load(state, base + 64), load(state, base + 80)
    total = load(state, base + 96)
    going = True
    for start in range(0, length, 16):
        for k in range(start, min(start + 16, length)):
            i = at(lists, block * LIST + k)
            dx = px - broadcast(local, X + i)
            dy = py - broadcast(local, Y + i)
            e = broadcast(local, O + i) - fma(
                dx,
                fma(dx, broadcast(local, A + i), dy * broadcast(local, B + i)),
                dy * dy * broadcast(local, C + i),
            )
            a = select(e >= LOG2_ALPHA_MIN, vmin(exp2(e), ALPHA_MAX), 0.0)
            # Overwritten as long as more than half of the light comes through: the last value is the median depth.
            m = select((t > 0.5) & (e >= LOG2_ALPHA_MIN), broadcast(local, Z + i), m)
            w = a * t
            t = fma(-a, t, t)
            w = select(t > T_MIN, w, 0.0)
            total = total + w
            r = fma(w, broadcast(local, R + i), r)
            g = fma(w, broadcast(local, G + i), g)
            b = fma(w, broadcast(local, BL + i), b)
            d = fma(w, broadcast(local, Z + i), d)
        if bits(t > end_t) == 0:  # every 16 Gaussians only: not in the inner loop
            going = False
            break
    store(state, base, t)
    store(state, base + 16, r)
    store(state, base + 32, g)
    store(state, base + 48, b)
    store(state, base + 64, d)
    store(state, base + 80, m)
    store(state, base + 96, total)
    return going


@inline
def _write_tile(states, base, tile_x, tile_y, width, height, background, rgb, alpha, depth, median):
    for block in range(16):
        x, y = tile_x + block % 4 * 4, tile_y + block // 4 * 4
        if x < width and y < height:
            _write_block(states, base + block * STATE, x, y, width, height, background, rgb, alpha, depth, median)


@inline
def _write_block(state, at, x, y, width, height, background, rgb, alpha, depth, median):
    """Add the background, normalize the depth, and write the part of the block that lies inside the image."""
    a = load(state, at + 96)
    rest = 1.0 - a
    r = fma(rest, background[0], load(state, at + 16))
    g = fma(rest, background[1], load(state, at + 32))
    b = fma(rest, background[2], load(state, at + 48))
    d = select(a > 0.0, load(state, at + 64) / vmax(a, 1e-12), 0.0)
    m = select(a >= 0.5, load(state, at + 80), 0.0)
    pixel = y * width + x
    if x + 4 <= width and y + 4 <= height:
        store_rgb_rows(rgb, pixel * 3, width * 3, r, g, b)
        _store_rows(alpha, pixel, width, a)
        _store_rows(depth, pixel, width, d)
        _store_rows(median, pixel, width, m)
        return
    # At the right and lower border pixel by pixel, through the state's memory.
    store(state, at, r)
    store(state, at + 16, g)
    store(state, at + 32, b)
    store(state, at + 48, a)
    store(state, at + 64, d)
    store(state, at + 80, m)
    for row in range(min(4, height - y)):
        for column in range(min(4, width - x)):
            source, target = at + row * 4 + column, pixel + row * width + column
            rgb[target * 3] = state[source]
            rgb[target * 3 + 1] = state[source + 16]
            rgb[target * 3 + 2] = state[source + 32]
            alpha[target] = state[source + 48]
            depth[target] = state[source + 64]
            median[target] = state[source + 80]


@inline
def _store_rows(plane, pixel, width, vector):
    store_quarter(plane, pixel, vector, 0)
    store_quarter(plane, pixel + width, vector, 1)
    store_quarter(plane, pixel + 2 * width, vector, 2)
    store_quarter(plane, pixel + 3 * width, vector, 3)
