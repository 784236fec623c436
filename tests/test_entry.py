"""The entry of the command: foreign packages of the same names are reported, and the demo scene is found."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from service.cli.demo import demo_scene

ROOT = Path(__file__).parents[1]


def started(path: list[Path]) -> subprocess.CompletedProcess[str]:
    code = "import sys, splatfix; sys.argv = ['splatfix', '--help']; splatfix.main()"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, path))}
    return subprocess.run(
        [sys.executable, "-P", "-c", code], env=environment, capture_output=True, text=True, encoding="utf-8"
    )


def test_the_command_starts():
    done = started([ROOT])
    assert done.returncode == 0, done.stderr
    assert "localize" in done.stdout


@pytest.mark.parametrize("name", ["service", "viewer"])
def test_a_foreign_package_is_told_with_its_place(tmp_path, name):
    foreign = tmp_path / name
    foreign.mkdir()
    (foreign / "__init__.py").write_text("", "utf-8")
    done = started([tmp_path, ROOT])
    assert done.returncode == 2
    assert f"'{name}'" in done.stderr
    assert str(foreign) in done.stderr
    assert "uv tool install" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_distribution_that_overwrote_a_package_is_named(tmp_path):
    """Both lie in one folder, as pip leaves them; the last installed has written its files over ours."""
    (tmp_path / "splatfix").symlink_to(ROOT / "splatfix")
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import splatfix; splatfix._HERE = __import__('pathlib')"
    code += f".Path({str(tmp_path)!r}); splatfix.main()"
    (tmp_path / "service").mkdir()
    (tmp_path / "service" / "__init__.py").write_text("", "utf-8")
    other = tmp_path / "other_service-1.0.dist-info"
    other.mkdir()
    (other / "METADATA").write_text("Metadata-Version: 2.1\nName: other-service\nVersion: 1.0\n", "utf-8")
    (other / "RECORD").write_text("service/__init__.py,,\n", "utf-8")
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True)
    assert done.returncode == 2
    assert "is not ours alone (of other-service)" in done.stderr


def test_the_demo_scene_is_here():
    assert (demo_scene() / "scene.compressed.ply").is_file()
