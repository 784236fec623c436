"""Readers of known places: positions and poses of photos, and points, in a target frame; one file for each kind.

`known_place` has the values, `read_places` chooses the reader by a file's content.
"""

from service.registration.known_places.reading import read_places

__all__ = ["read_places"]
