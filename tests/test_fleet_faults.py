"""A short fault run of a fleet (`fleet_fault_run`): each kind of process is killed once while clients work."""

from __future__ import annotations

import shutil
from importlib.util import find_spec

import pytest
from fleet_fault_run import run
from postgres_server import programs

pytestmark = [
    pytest.mark.ci,
    pytest.mark.timeout(400),
    pytest.mark.skipif(
        not (find_spec("ray") and find_spec("psycopg") and programs() and shutil.which("nginx")),
        reason="needs Ray, psycopg, PostgreSQL and nginx",
    ),
]


def test_a_fleet_loses_nothing_while_its_parts_are_killed() -> None:
    troubles = {"replica": 1, "front": 1, "head": 1, "database": 1}
    report = run(12, seed=0, troubles=troubles)
    assert report["wrong"] == []
    assert report["accepted"] == 12
    assert report["troubles"] == troubles
    assert set(report["states"]) <= {"succeeded", "cancelled"}
    # What ended was started again.
    assert report["starts"][0] == 2
    assert sum(report["starts"][1:]) >= 3
