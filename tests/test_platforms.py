"""The table of platforms tells what the result files have, no more."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import platforms_run as platforms
import pytest


@pytest.mark.parametrize("path", platforms.PLACES, ids=lambda path: path.name)
def test_the_documents_have_what_the_results_say(path):
    text = path.read_text("utf-8")
    assert platforms.with_part(text, platforms.PLACES[path](platforms.RESULTS)) == text


def test_the_files_are_of_machines_and_of_one_trial():
    kinds = [json.loads(file.read_text("utf-8"))["bench"] for file in platforms.RESULTS.iterdir()]
    assert kinds.count("resolve") == 1
    assert set(kinds) == {"resolve", "device"}


@dataclass
class Results:
    folder: Path
    count: int = field(default=0)

    def device(self, **changed):
        found = {"localized": 15, "queries": 16, "false_localized": 1}
        result = {"bench": "device", "date": "2026-01-01", "emulated": False, "system": "Linux", "machine": "aarch64"}
        result |= {"processor": "Cortex, 4 cores (asimd), load 1.0", "renderer": "cpu", "gpu": "Orin"}
        result |= {"versions": {"splatfix": "0.2.0", "python": "3.12.1"}, "photos": {"given": found}}
        self.write(result | changed)

    def write(self, result):
        self.count += 1
        (self.folder / f"{self.count}.json").write_text(json.dumps(result), "utf-8")

    def rows(self):
        return list(platforms.states(self.folder))


@pytest.fixture
def results(tmp_path):
    return Results(tmp_path)


def test_without_results_nothing_is_claimed(results):
    assert results.rows() == []
    assert platforms.line(results.folder) == ""


def test_a_real_run_counts_more_than_an_emulated_one_and_the_newest_is_told(results):
    results.device(emulated=True, date="2026-03-01")
    ((name, device, state, what),) = results.rows()
    assert (name, device, state) == ("Linux, ARM (aarch64)", "CPU", "emulated")
    results.device()
    results.device(date="2026-02-01")
    ((_, _, state, what),) = results.rows()
    assert state == "run"
    assert (
        what == "2026-02-01, 0.2.0, Python 3.12.1: 15 of 16 demo photos localized, 1 wrongly; Cortex, 4 cores (asimd)"
    )


def test_a_gpu_has_run_only_where_it_rendered(results):
    results.device()
    assert [row[1] for row in results.rows()] == ["CPU"]
    results.device(renderer="gsplat_cuda")
    assert [row[1:3] for row in results.rows()] == [("CPU", "run"), ("NVIDIA GPU", "run")]
    assert results.rows()[1][3].endswith("; Orin")
    assert platforms.line(results.folder) == "- run: Linux, ARM (aarch64); Linux, ARM (aarch64) with an NVIDIA GPU"


def test_what_only_resolves_is_called_so(results):
    found = {"Windows AMD64 CPU": {"3.11": "no wheel of a", "3.12": ""}, "Windows ARM64 CPU": {"3.11": "no wheel of b"}}
    results.write({"bench": "resolve", "date": "2026-01-01", "splatfix": "0.2.0", "found": found})
    assert results.rows() == [
        ("Windows, x86-64", "CPU", "resolved only", "2026-01-01, 0.2.0, Python 3.12"),
        ("Windows, ARM", "CPU", "not possible", "2026-01-01, 0.2.0: no wheel of b"),
    ]
    assert platforms.line(results.folder) == "- resolved only: Windows, x86-64"


def test_a_resolution_that_fails_names_the_package(monkeypatch):
    class Done:
        returncode = 1
        stderr = "error: No solution\n  cause: Because numba==0.68 has no wheels with a matching platform tag"

    monkeypatch.setattr(platforms.subprocess, "run", lambda *_, **__: Done)
    assert platforms.resolved("x", "3.12", ()) == "no wheel of numba"
