"""What `make release-check` would notice: each kind of mistake, planted."""

from __future__ import annotations

import io
import re
import tarfile
import zipfile

import pytest
import release_checks as checks
from api_server import ROOT
from test_docs import check_line

TRACKED = {
    "LICENSE": b"Apache",
    "pyproject.toml": b"[project]",
    "service/__init__.py": b"",
    "viewer/__init__.py": b"",
    "splatfix/__init__.py": b"",
    "tests/test_a.py": b"",
    "scenes/studio/scene.json": b"{}",
    "scenes/studio/build.py": b"",
}
INFO = "splatfix-1.0.dist-info/"
WHEEL = {
    "service/__init__.py": b"",
    "viewer/__init__.py": b"",
    "splatfix/__init__.py": b"",
    "splatfix/demo/studio/scene.json": b"{}",
    INFO + "METADATA": b"Name: splatfix\nLicense-Expression: Apache-2.0\n",
    INFO + "entry_points.txt": b"[console_scripts]\nsplatfix = splatfix:main\n",
    INFO + "licenses/LICENSE": b"Apache",
}
SDIST = {name: TRACKED[name] for name in list(TRACKED)[:5]}


def wheel_of(path, files):
    with zipfile.ZipFile(path / "a.whl", "w") as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return checks.wheel_problems(path / "a.whl", TRACKED, "1.0")


def sdist_of(path, files):
    with tarfile.open(path / "a.tar.gz", "w:gz") as archive:
        for name, data in files.items():
            member = tarfile.TarInfo("splatfix-1.0/" + name)
            member.size = len(data)
            archive.addfile(member, io.BytesIO(data))
    return checks.sdist_problems(path / "a.tar.gz", TRACKED, "1.0")


def test_whole_archives_are_clean(tmp_path):
    assert wheel_of(tmp_path, WHEEL) == []
    assert sdist_of(tmp_path, SDIST) == []


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"tests/test_a.py": b""}, "tests/test_a.py is not a tracked file"),
        ({"service/notes.txt": b""}, "service/notes.txt is not a tracked file"),
        ({"splatfix/demo/studio/build.py": b""}, "build.py is not a tracked file"),
        ({"viewer/__init__.py": None}, "viewer/__init__.py is missing"),
        ({"splatfix/demo/studio/scene.json": None}, "scene.json is missing"),
        ({"service/__init__.py": b"x"}, "service/__init__.py differs"),
        ({INFO + "licenses/LICENSE": None}, "no LICENSE"),
        ({INFO + "METADATA": b"Name: splatfix\n"}, "licence"),
        ({INFO + "entry_points.txt": b""}, "no command"),
    ],
)
def test_a_wheel_with_a_mistake_is_noticed(tmp_path, change, problem):
    files = {name: data for name, data in (WHEEL | change).items() if data is not None}
    (found,) = wheel_of(tmp_path, files)
    assert problem in found


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"tests/test_a.py": b""}, "tests/test_a.py is not meant"),
        ({"service/notes.txt": b""}, "service/notes.txt is not a tracked file"),
        ({"LICENSE": None}, "LICENSE is missing"),
        ({"service/__init__.py": b"x"}, "service/__init__.py differs"),
    ],
)
def test_a_source_archive_with_a_mistake_is_noticed(tmp_path, change, problem):
    (found,) = sdist_of(tmp_path, {name: data for name, data in (SDIST | change).items() if data is not None})
    assert problem in found


def api(fields, kinds=("a", "b"), path="/scenes", parameter="limit"):
    models = {"Scene": {"properties": {name: {"type": "string"} for name in fields}}, "Kind": {"enum": list(kinds)}}
    operation = {"get": {"parameters": [{"name": parameter, "in": "query"}]}}
    return {"paths": {path: operation}, "components": {"schemas": models}}


@pytest.mark.parametrize(
    ("new", "gone"),
    [
        (api(["id"]), ["Scene: name"]),
        (api(["id", "name"], kinds=["a"]), ["Kind: b"]),
        (api(["id", "name"], parameter="count"), ["GET /scenes: limit"]),
        (api(["id", "name"], path="/rooms"), ["operation: GET /scenes"]),
        (api(["id", "name", "more"]), []),
    ],
)
def test_what_the_api_lost_must_be_told(new, gone):
    old = api(["id", "name"])
    assert checks.removed_from_api(old, new) == gone
    assert len(checks.untold_removals(old, new, "nothing of it: name b limit")) == len(gone)
    told = ", ".join(f"`{each.split(': ')[1]}`" for each in gone)
    assert checks.untold_removals(old, new, told) == []


def test_the_versions_of_this_repository_agree():
    assert checks.version_problems(ROOT, final=False) == []


def test_an_old_version_is_noticed_and_a_final_one_needs_a_date(tmp_path):
    for name in ("service/__init__.py", "CHANGELOG.md", "CITATION.cff", "docker/Dockerfile", "openapi.yaml"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text((ROOT / name).read_text("utf-8"), "utf-8")
    for name in ("CHANGELOG.md", "CITATION.cff", "docker/Dockerfile", "openapi.yaml"):
        text = (tmp_path / name).read_text("utf-8")
        (tmp_path / name).write_text(text.replace(checks.own_version(ROOT), "9.9.9", 1), "utf-8")
    changelog = (tmp_path / "CHANGELOG.md").read_text("utf-8")
    (tmp_path / "CHANGELOG.md").write_text(
        re.sub(r"^## .*", "## 9.9.9 (soon)", changelog, count=1, flags=re.M), "utf-8"
    )
    found = "\n".join(checks.version_problems(tmp_path, final=True))
    assert len(found.splitlines()) == 5
    assert "'soon' is no date" in found


def test_licences_are_read_of_all_that_a_package_needs(monkeypatch):
    facts = {"ours": ("MIT", ["theirs>1", "other; extra == 'x'"]), "theirs": ("LGPL-3.0-only", ["bad"])}
    facts |= {"bad": ("GPL-3.0-only", []), "other": ("AGPL-3.0-only", [])}

    class Distribution:
        def __init__(self, name):
            from email.message import Message

            self.metadata = Message()
            self.metadata["License-Expression"] = facts[name][0]

    monkeypatch.setattr(checks.metadata, "distribution", Distribution)
    monkeypatch.setattr(checks.metadata, "requires", lambda name: facts[name][1])
    assert checks.licence_problems("ours") == ["bad: GPL-3.0-only"]


def test_the_command_lines_of_the_windows_script_exist():
    lines = re.findall(
        r"^ *environment\\Scripts\\(splatfix)\.exe (.*?) \|\|", (ROOT / "windows/start.cmd").read_text(), re.M
    )
    assert len(lines) == 2
    for program, arguments in lines:
        check_line(f"{program} {arguments.replace('%~1', 'scene')}")
