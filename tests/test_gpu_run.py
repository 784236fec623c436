"""What `tests/gpu_run.sh` takes along to a machine without a network, beside what it asks that machine for."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SCRIPT = (ROOT / "tests" / "gpu_run.sh").read_text("utf-8")
IMPORTS = "import service.bench.gpu_equality, service.bench.gpu_memory, service.bench.gpu_speed, service.bench.gpu"
WITHOUT = """
import sys
from importlib.abc import MetaPathFinder

class Missing(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {missing}:
            raise ModuleNotFoundError(f"{{name}} is not on the machine with the GPU", name=name)

sys.meta_path.insert(0, Missing())
{imports}
from service.matchers import MATCHERS
MATCHERS.load("xfeat").create()
"""


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


@pytest.mark.ci
def test_what_the_benchmark_imports_is_on_the_machine_or_carried_along() -> None:
    """Of the packages that this one needs all others are made unimportable."""
    wheels = re.search(r'^PACKAGES="(.*)"$', SCRIPT, re.MULTILINE)
    modules = re.search(r"^for module in \((.*)\):$", SCRIPT, re.MULTILINE)
    assert wheels
    assert modules
    modules_of = packages_distributions()
    there = {name for module in (*re.findall(r'"(\w+)"', modules[1]), "numba", "numpy") for name in modules_of[module]}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    needed = {normal(re.split(r"[ \[<>=~!;]", line)[0]) for line in project["dependencies"]}
    needed -= {normal(name) for name in (*wheels[1].split(), *there)}
    missing = {module for module, names in modules_of.items() if needed & set(map(normal, names))}
    assert {"fastapi", "pydantic", "viser"} <= missing
    code = WITHOUT.format(missing=missing, imports=IMPORTS)
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
