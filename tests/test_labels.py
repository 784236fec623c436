"""Every name that people would be shown has words: the stages in the source, and the closed lists of the others."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

import pytest

import service
from service.estimators import ESTIMATORS
from service.labels import TABLES, label
from service.results import HINTS, Reason
from service.types import IntrinsicsSource

ROOT = Path(service.__file__).parent
STAGE_ARGUMENT = {
    **dict.fromkeys(
        ("IterationRecord", "StageTiming", "match_record", "_record", "record", "_add", "_search_views"), 0
    ),
    "record_of": 4,
}
"""What makes a record or a timing, and which of its arguments is the stage."""


def stages_in(path: Path) -> Iterator[str]:
    """Yield the names of stages that a file gives to records: constants, those of a name also where it is assigned."""
    tree = ast.parse(path.read_text())
    assigned: dict[str, list[ast.expr]] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            assigned.setdefault(node.targets[0].id, []).append(node.value)
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        function = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        given = [keyword.value for keyword in node.keywords if keyword.arg == "stage"]
        at = STAGE_ARGUMENT.get(function)
        given += [] if at is None else node.args[at : at + 1]
        for value in given:
            yield from _constants(value, assigned)


def _constants(value: ast.expr, assigned: dict[str, list[ast.expr]]) -> Iterator[str]:
    if isinstance(value, ast.Constant) and isinstance(value.value, str):
        yield value.value
    elif isinstance(value, ast.IfExp):
        yield from (*_constants(value.body, assigned), *_constants(value.orelse, assigned))
    elif isinstance(value, ast.Name):
        for one in assigned.get(value.id, []):
            yield from _constants(one, assigned)


def test_every_name_has_words() -> None:
    folders = ("estimators", "pose", "jobs")
    sources = [*ROOT.glob("*.py"), *(path for folder in folders for path in (ROOT / folder).rglob("*.py"))]
    stages = {stage for path in sources for stage in stages_in(path)}
    # Each way in which the source gives a name to a stage.
    assert {"retrieve_rotated", "match", "refine", "check_mirror", "sample_poses", "decode", "match_rig"} <= stages
    exist = {
        "stage": stages,
        "estimator": set(ESTIMATORS.names()),
        "reason": {str(reason) for reason in Reason},
        "source": set(get_args(IntrinsicsSource)),
    }
    assert {kind: set(table) for kind, table in TABLES.items()} == exist


@pytest.mark.parametrize("kind", TABLES)
def test_words_differ_and_are_no_identifiers(kind) -> None:
    words = list(TABLES[kind].values())
    assert len(set(words)) == len(words)
    assert not [text for text in words if "_" in text or not text.strip()]
    assert label(kind, "of_a_plug_in") == "of a plug in"


def test_hints_are_words_too() -> None:
    assert not [hint for hint in HINTS.values() if re.search(r"`|[a-z]_[a-z]", hint)]
