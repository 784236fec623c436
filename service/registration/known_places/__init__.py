"""Readers of known places: positions and poses of photos, and points, in a target frame; one file for each kind.

`known_place` has the values, `reading.read_places` chooses the reader by a file's content.
"""
