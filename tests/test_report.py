"""`splatfix report`: what is in the ZIP, what isn't, and what is said where the service lacks something."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path

import pytest
from api_server import finished, key_of, post
from PIL import Image
from typer.testing import CliRunner

from service.cli import diagnostics
from service.cli.app import app
from service.cli.diagnostics import Finding
from service.client import Client, ServiceError
from service.errors import InvalidRequest


@pytest.fixture(autouse=True)
def examined(monkeypatch) -> None:
    """Examining the machine takes seconds, and is tested elsewhere."""
    home = Finding("keys", True, f"in {Path.home()}/keys.json")
    monkeypatch.setattr(diagnostics, "findings", lambda: iter([home]))
    monkeypatch.setenv("NO_PROXY", "*")


def reported(job: str, url: str, *options: str, key: str = "sfx_secret") -> dict[str, bytes]:
    done = CliRunner().invoke(app, ["report", job, "--url", url, *options], env={"SPLATFIX_KEY": key})
    if done.exception:
        raise done.exception
    name = options[options.index("--out") + 1]
    with zipfile.ZipFile(name) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def test_a_report_has_the_job_its_trace_and_the_machine_but_no_key_and_no_photo(shared, tmp_path, monkeypatch):
    job = finished(shared, post(shared, prefer="", options={"steps": 3}).headers["location"])
    url, out, key = str(shared.base_url), str(tmp_path / "report.zip"), key_of(shared) or "sfx_secret"
    parts = reported(job["id"], url, "--out", out, key=key)
    assert json.loads(parts["job.json"])["result"] == job["result"]
    assert len(json.loads(parts["trace.json"])["records"]) == 3
    assert json.loads(parts["scene.json"])["id"] == job["scene"]
    assert Image.open(io.BytesIO(parts["render.jpg"])).format == "JPEG"
    assert b"in ~/keys.json" in parts["doctor.txt"]
    assert job["id"].encode() in parts["README.txt"]
    assert not {"photo.jpg", "missing.txt"} & parts.keys()
    assert not any(key.encode() in part for part in parts.values())
    with_photo = reported(job["id"], url, "--out", out, "--photo", key=key)
    # Deleted after the job, as this service is set: the report says so.
    assert "photo.jpg" in with_photo or b"photo.jpg: " in with_photo["missing.txt"]

    def refused(*_: object) -> bytes:
        raise ServiceError("x", "not now")

    for name in ("trace", "photo"):
        monkeypatch.setattr(Client, name, refused)
    with_gaps = reported(job["id"], url, "--out", out, "--photo", key=key)
    assert with_gaps["missing.txt"] == b"trace.json: not now\nphoto.jpg: not now"
    assert with_gaps.keys() == with_photo.keys() - {"trace.json", "photo.jpg"} | {"missing.txt"}


def test_an_unknown_job_or_no_service_is_one_error_and_no_file(shared, tmp_path):
    out = tmp_path / "report.zip"
    with pytest.raises(InvalidRequest, match="nope"):
        reported("nope", str(shared.base_url), "--out", str(out), key=key_of(shared))
    with pytest.raises(InvalidRequest, match=r"127\.0\.0\.1:9"):
        reported("nope", "http://127.0.0.1:9", "--out", str(out))
    assert not out.exists()
