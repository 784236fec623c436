"""What users can set, with its default and bounds, is what `tests/data/what_users_set.json` records.

As `openapi.yaml` is for the API: a change of these is one for users, and belongs in the changelog. `python
tests/test_what_users_set.py` writes the file anew.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

from typer.main import get_command

import service
from service.cli.app import app
from service.estimators import ESTIMATORS
from service.web.settings import Settings

FILE = Path(__file__).parent / "data" / "what_users_set.json"


def options(command: Any, path: str = "splatfix") -> Iterator[tuple[str, list[Any]]]:
    """Default, least and largest value of each option of the commands."""
    for name, part in getattr(command, "commands", {}).items():
        yield from options(part, f"{path} {name}")
    for option in getattr(command, "params", ()):
        low, high = getattr(option, "min", None), getattr(option, "max", None)
        if isinstance(option.default, (bool, int, float, str)) or low is not None or high is not None:
            yield f"{path} {option.opts[0]}", [option.default, low, high]


def settings() -> Iterator[tuple[str, list[Any]]]:
    for name, field in Settings.model_fields.items():
        if not isinstance(field.default, Path):  # a home folder
            default = field.default if field.default_factory is None else "by the machine"
            yield name, [default, *sorted(str(bound) for bound in field.metadata)]


def estimators() -> Iterator[tuple[str, Any]]:
    """Defaults of the options of each estimator of the package."""
    for name in ESTIMATORS.names():
        # Other tests add estimators.
        if not (Path(service.__file__).parent / "estimators" / f"{name}.py").is_file():
            continue
        for field in fields(ESTIMATORS.load(name).Options):
            yield f"{name} {field.name}", field.default


def found() -> dict[str, dict[str, Any]]:
    of = {"options": options(get_command(app)), "settings": settings(), "estimators": estimators()}
    return json.loads(json.dumps({kind: dict(rows) for kind, rows in of.items()}))


def test_what_users_can_set_is_as_recorded() -> None:
    assert found() == json.loads(FILE.read_text())


if __name__ == "__main__":
    FILE.write_text(json.dumps(found(), indent=1) + "\n")
