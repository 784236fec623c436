"""Encoded photos, videos and sequences to `Query`: decoded in bounded time and memory, upright, undistorted.

`images` reads one photo, `intrinsics` its camera, `video` a video's frames; `sequence` reads several photos or a video
one by one. The `*_decoder_process` programs run decoders that hostile files can crash in processes of their own.
"""
