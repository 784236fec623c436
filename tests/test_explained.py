"""docs/results-explained.md and docs/scenes.md have all reasons, statuses and keys of the code, and no others."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import re

from api_server import ROOT

from service.results import Reason, Status
from service.scene_formats.manifest import MANIFEST, Manifest, read_manifest

RESULTS = (ROOT / "docs" / "results-explained.md").read_text("utf-8")
SCENES = (ROOT / "docs" / "scenes.md").read_text("utf-8")


def first_cells(text: str, head: str) -> list[str]:
    """The names in the first column of the table whose head begins so."""
    table = text.split(f"| {head} |", 1)[1].split("\n\n", 1)[0]
    return [name for cell in re.findall(r"^\| (`[^|]*`) \|", table, re.M) for name in re.findall(r"`(\w+)`", cell)]


def test_every_reason_and_status_is_explained():
    assert first_cells(RESULTS, "`reason`") == [reason.value for reason in Reason]
    assert sorted(first_cells(RESULTS, "`status`")) == sorted(status.value for status in Status)


def test_every_key_of_the_manifest_is_explained():
    keys = first_cells(SCENES.split("## The manifest")[1], "key")
    assert sorted(keys) == sorted(field.name for field in dataclasses.fields(Manifest))


def test_the_example_manifest_is_read_whole(tmp_path):
    (tmp_path / MANIFEST).write_text(SCENES.split("```json\n")[1].split("```")[0])
    manifest = read_manifest(tmp_path)
    assert all(getattr(manifest, field.name) is not None for field in dataclasses.fields(Manifest))
    anchor = first_cells(SCENES.split("`geo_anchor` is an object")[1], "key")
    assert set(anchor) == {"latitude", "longitude", "height", "enu_from_world"}


def test_the_covariance_in_metres_is_what_the_page_says():
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(RESULTS.split("```python\n")[1].split("```")[0], {})
    assert f"```text\n{printed.getvalue()}```" in RESULTS
