"""Depth order and tile lists: radix sort by depth, then a stable counting sort into 16x16-pixel tiles.

keys     depth's float bits, shifted so that the range in use fills 24 bits   [24 bits key | record number]
sort     2 passes of 12 bits, least significant first
lists    entries[starts[t] : starts[t + 1]] = the records of tile t, near to far

One sort of all records, then a stable distribution: a tile's list needs no sort of its own. 12 bits, as two histograms
of 4096 counters fit the L1 cache.
"""

from __future__ import annotations

import numpy as np

from service.jit import kernel


@kernel
def sort_by_depth(depths, visible, keys, swap, histogram):
    """Leave in `keys` the record numbers (low 32 bits) in order of depth; `swap` and `histogram` are work space."""
    if visible == 0:
        return
    bits = depths.view(np.uint32)  # of positive floats: ordered like their values
    low, high = bits[np.uint64(0)], bits[np.uint64(0)]
    for i in range(np.uint64(visible)):
        low, high = min(low, bits[i]), max(high, bits[i])
    shift = np.uint32(0)
    while ((high - low) >> shift) >= np.uint32(1 << 24):
        shift += np.uint32(1)
    histogram[:] = 0
    for i in range(np.uint64(visible)):
        key = np.uint64((bits[i] - low) >> shift)
        keys[i] = key << np.uint64(32) | i
        histogram[key & np.uint64(4095)] += 1
        histogram[np.uint64(4096) + (key >> np.uint64(12))] += 1
    # Counts become the places where each digit's records begin.
    first = second = np.int32(0)
    for i in range(np.uint64(4096)):
        count = histogram[i]
        histogram[i] = first
        first += count
        count = histogram[np.uint64(4096) + i]
        histogram[np.uint64(4096) + i] = second
        second += count
    for i in range(np.uint64(visible)):
        digit = (keys[i] >> np.uint64(32)) & np.uint64(4095)
        swap[np.uint64(histogram[digit])] = keys[i]
        histogram[digit] += 1
    for i in range(np.uint64(visible)):
        digit = np.uint64(4096) + (swap[i] >> np.uint64(44))
        keys[np.uint64(histogram[digit])] = swap[i]
        histogram[digit] += 1


@kernel
def fill_tiles(keys, visible, rects, tiles_x, tiles_y, starts, entries):
    """Write the tile lists; `starts` has one element more than there are tiles."""
    mask = np.uint64(0xFFFF)
    wide = np.uint64(tiles_x)
    starts[:] = 0
    # A counting sort: how many records each tile has, one place further on for the sums below.
    for i in range(np.uint64(visible)):
        rect = rects[i]
        x1, y1 = (rect >> np.uint64(32)) & mask, rect >> np.uint64(48)
        for ty in range((rect >> np.uint64(16)) & mask, y1):
            for tx in range(rect & mask, x1):
                starts[ty * wide + tx + np.uint64(1)] += 1
    total = np.int32(0)
    for t in range(np.uint64(tiles_x * tiles_y + 1)):
        total += starts[t]
        starts[t] = total
    # starts[t] is now where tile t begins; filling moves it on, and the last step moves it back.
    for i in range(np.uint64(visible)):
        record = keys[i] & np.uint64(0xFFFFFFFF)
        rect = rects[record]
        x1, y1 = (rect >> np.uint64(32)) & mask, rect >> np.uint64(48)
        for ty in range((rect >> np.uint64(16)) & mask, y1):
            for tx in range(rect & mask, x1):
                t = ty * wide + tx
                entries[np.uint64(starts[t])] = np.int32(record)
                starts[t] += 1
    for t in range(np.uint64(tiles_x * tiles_y), np.uint64(0), -1):
        starts[t] = starts[t - np.uint64(1)]
    starts[0] = 0
