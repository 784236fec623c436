"""A scene's Gaussians in a compact binary form for drawing: the most important first, SH degree 0.

Layout, all little-endian:

    uint32               length of the header in bytes (a multiple of 4)
    header               JSON, padded with spaces: {"scene", "sha256", "count", "total"}
    float32[count, 3]    centres in the world
    float32[count, 6]    covariances in the world: xx, xy, xz, yy, yz, zz
    uint8[count, 4]      red, green, blue (sRGB, from SH degree 0), opacity

Ordered by importance, the greatest first, so that any prefix is a good choice.
"""
