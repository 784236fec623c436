"""The faults of mutations.py are faults: each changes what a function of the test's own computes."""

from __future__ import annotations

from dataclasses import replace

import mutation_run
import pytest
from api_server import ROOT
from mutation_run import Coverage, drawn, naming, runs_at_import
from mutations import KINDS, mutants_of

SOURCE = b'''"""A module \xe2\x80\x94 not all of it is ASCII."""
from __future__ import annotations
import logging
LIMIT = -3
log = logging.getLogger(__name__)

class Config:
    ratio: float | None = 0.8

def weighed(values: list[int], seen: list[int], top: int = 5, *, exact: bool = False) -> float:
    """1 < 2 and 3 + 4"""
    total = 0.0
    for value in values:
        if value > LIMIT and not (exact or value == 2) and value < top:
            seen.append(value)
        log.info("a + b")
        total = total + value * 2
    return total - len(seen) // 2 if seen is not None else f"{1 + 2}"
'''


def compute(source: bytes) -> list[object]:
    namespace = {"__name__": "toy"}
    exec(compile(source, "toy", "exec"), namespace)
    found = [namespace["Config"].ratio]
    for values in ([1, 2, 3], [-3, 4], [9, 1], [-6, -5, 0, 5, 8], [-7, 0, 1]):
        for options in ({}, {"exact": True}):
            seen = []
            try:
                found.append((namespace["weighed"](values, seen, **options), seen))
            except (TypeError, ZeroDivisionError) as error:
                found.append(repr(error))
    return found


MUTANTS = mutants_of("toy.py", SOURCE)


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda m: f"{m.line}-{m.before[:20]}-{m.after[:20]}")
def test_a_mutant_computes_something_else(mutant):
    changed = mutant.applied(SOURCE)
    assert len(changed) - len(SOURCE) == len(mutant.after) - len(mutant.before)
    assert compute(changed) != compute(SOURCE)


def test_every_kind_is_there_and_nothing_that_no_test_could_notice():
    assert {mutant.kind for mutant in MUTANTS} == set(KINDS)
    changes = {(mutant.before, mutant.after) for mutant in MUTANTS}
    assert {("0.8", "1.6"), ("3", "6"), ("5", "10"), ("seen.append(value)", "pass")} <= changes
    assert ("value > LIMIT", "(value >= LIMIT)") in changes
    assert ("value * 2", "(value / 2)") in changes
    assert ("not (exact or value == 2)", "(exact or value == 2)") in changes
    texts = " ".join(before for before, _ in changes)
    assert "log.info" not in texts
    assert "1 + 2" not in texts
    assert "None = " not in texts


def test_a_longer_run_begins_like_a_shorter_one_and_every_mutant_is_python_again():
    some = ["service/jobs", "service/render", "viewer/layers"]
    mutants = drawn(ROOT, 100, 1, some)
    assert drawn(ROOT, 10, 1, some) == mutants[:10]
    assert {mutant.kind for mutant in mutants[:5]} == set(KINDS)
    for mutant in mutants:
        compile(mutant.applied((ROOT / mutant.file).read_bytes()), mutant.file, "exec")


def test_what_names_a_module_is_found():
    named = {str(path) for path in naming("service/photos/images.py", ROOT)}
    assert {"tests/test_images.py", "service/photos/sequence.py"} <= named
    assert not {"tests/test_mutations.py", "service/geometry.py"} & named


def test_what_runs_at_an_import_is_told_from_what_a_test_calls():
    at_import = {mutant.before for mutant in MUTANTS if runs_at_import(mutant.line, SOURCE)}
    assert at_import == {"3", "0.8", "5"}


def test_mutants_are_of_the_paths_that_are_asked_for():
    of_file = drawn(ROOT, 10_000, 0, ["service/geodesy.py"])
    assert {mutant.file for mutant in of_file} == {"service/geodesy.py"}
    of_folder = drawn(ROOT, 10_000, 0, ["service/lenses", "service/geodesy.py"])
    assert {mutant.file.rpartition("/")[0] for mutant in of_folder} == {"service/lenses", "service"}
    assert len(of_folder) > len(of_file) > 10


def measured(seconds: dict[str, float]) -> Coverage:
    return Coverage(None, {}, "before", seconds)  # type: ignore[arg-type]


def test_tests_of_the_cheapest_files_come_first_each_files_in_their_order():
    seconds = {"tests/a.py::one": 3.0, "tests/a.py::two": 0.5, "tests/b.py::one": 1.0, "tests/b.py::two": 1.5}
    chosen = ["tests/b.py::two", "tests/a.py::two", "tests/b.py::one"]
    assert measured(seconds).cheapest_first(chosen) == ["tests/a.py::two", "tests/b.py::one", "tests/b.py::two"]
    # A whole file costs what all of its tests do; a new one nothing that is known.
    whole = ["tests/a.py", "tests/b.py::one", "tests/c.py"]
    assert measured(seconds).cheapest_first(whole) == ["tests/c.py", "tests/b.py::one", "tests/a.py"]


def test_a_line_is_found_where_it_was_when_it_was_measured(monkeypatch: pytest.MonkeyPatch):
    answers = {"diff": "toy.py\n", "ls-tree": "100644 blob 0\ttoy.py\n"}
    texts = {"before": "a\nb\nc\nd\n", "HEAD": "new\na\nb\nchanged\nd\n"}
    monkeypatch.setattr(
        mutation_run, "_git", lambda command, *rest: answers.get(command) or texts[rest[0].partition(":")[0]]
    )
    mutants = [replace(MUTANTS[0], line=line) for line in range(1, 6)]
    assert [measured({}).line(mutant) for mutant in mutants] == [None, 1, 2, None, 4]
    monkeypatch.setattr(mutation_run, "_git", lambda command, *rest: "")
    assert measured({}).line(mutants[2]) == 3
