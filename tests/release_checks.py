"""What has to hold of a release: each check returns what is wrong, one line each."""

from __future__ import annotations

import re
import tarfile
import zipfile
from collections.abc import Iterator, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement

PACKAGES = ("service", "viewer", "splatfix")
DEMO = "scenes/studio/"
DEMO_IN_WHEEL = "splatfix/demo/studio/"
DEMO_PARTS = ("scene.compressed.ply", "scene.json", "transforms.json", "truth.json", "photos/")
MAX_WHEEL_BYTES = 12_000_000
"""9.2 million were seen; what is larger holds something that nobody meant."""
SDIST_PARTS = (*PACKAGES, "docs", "docker", "scenes", "pyproject.toml", "constraints.txt", "openapi.yaml", ".gitignore")
SDIST_PARTS += ("README.md", "LICENSE", "CHANGELOG.md", "CONTRIBUTING.md", "CITATION.cff")
OPERATIONS = ("get", "put", "post", "patch", "delete")


def version_problems(root: Path, final: bool) -> list[str]:
    """Compare the places that have the version; of a `final` release the changelog has the date."""
    files = ("CHANGELOG.md", "CITATION.cff", "docker/Dockerfile", "openapi.yaml")
    read = {name: (root / name).read_text("utf-8") for name in files}
    version = own_version(root)
    found = {
        "CHANGELOG.md": first(r"^## (\S+) \(", read["CHANGELOG.md"]),
        "CITATION.cff": first(r"^version: (\S+)", read["CITATION.cff"]),
        "docker/Dockerfile": first(r"^ARG VERSION=(\S+)", read["docker/Dockerfile"]),
        "openapi.yaml": first(r"^  version: (\S+)", read["openapi.yaml"]),
    }
    wrong = [f"{name}: version {other or 'none'}, not {version}" for name, other in found.items() if other != version]
    date = first(r"^## \S+ \((.*)\)", read["CHANGELOG.md"])
    if final and not re.fullmatch(r"20\d\d-\d\d-\d\d", date):
        wrong.append(f"CHANGELOG.md: '{date}' is no date (YYYY-MM-DD)")
    return wrong


def own_version(root: Path) -> str:
    return first(r'^__version__ = "(.+)"', (root / "service" / "__init__.py").read_text("utf-8"))


def first(pattern: str, text: str) -> str:
    found = re.search(pattern, text, re.M)
    return found[1] if found else ""


def changes(root: Path) -> str:
    """The newest section of the changelog."""
    return re.split(r"^## ", (root / "CHANGELOG.md").read_text("utf-8"), flags=re.M)[1]


def wheel_problems(wheel: Path, tracked: Mapping[str, bytes], version: str) -> list[str]:
    """Compare a wheel with the tracked files: all of the packages' and the demo's, nothing else, byte for byte."""
    expected = {name: data for name, data in tracked.items() if name.split("/")[0] in PACKAGES}
    for name, data in tracked.items():
        if name.startswith(DEMO) and name.removeprefix(DEMO).startswith(DEMO_PARTS):
            expected[DEMO_IN_WHEEL + name.removeprefix(DEMO)] = data
    with zipfile.ZipFile(wheel) as archive:
        held = {name: archive.read(name) for name in archive.namelist()}
    info = f"splatfix-{version}.dist-info/"
    facts = {name.removeprefix(info): data.decode() for name, data in held.items() if name.startswith(info)}
    wrong = differences(wheel, {name: data for name, data in held.items() if not name.startswith(info)}, expected)
    if facts.get("licenses/LICENSE", "").encode() != tracked["LICENSE"]:
        wrong.append(f"{wheel.name}: has no LICENSE, or another")
    if "License-Expression: Apache-2.0\n" not in facts.get("METADATA", ""):
        wrong.append(f"{wheel.name}: its metadata don't name the licence")
    if "splatfix = splatfix:main" not in facts.get("entry_points.txt", ""):
        wrong.append(f"{wheel.name}: has no command 'splatfix'")
    if wheel.stat().st_size > MAX_WHEEL_BYTES:
        wrong.append(f"{wheel.name}: {wheel.stat().st_size} bytes, more than {MAX_WHEEL_BYTES}")
    return wrong


def sdist_problems(sdist: Path, tracked: Mapping[str, bytes], version: str) -> list[str]:
    """Compare a source archive with the tracked files: no tests, nothing untracked, all that the wheel is made of."""
    with tarfile.open(sdist) as archive:
        files = [member for member in archive.getmembers() if member.isfile()]
        held = {member.name.removeprefix(f"splatfix-{version}/"): archive.extractfile(member) for member in files}
        held = {name: file.read() for name, file in held.items() if file and name != "PKG-INFO"}
    wrong = [f"{sdist.name}: {name} is not meant for it" for name in held if name.split("/")[0] not in SDIST_PARTS]
    needed = {n: d for n, d in tracked.items() if n.split("/")[0] in PACKAGES or n in ("LICENSE", "pyproject.toml")}
    return wrong + differences(sdist, held, needed | {name: tracked[name] for name in held if name in tracked})


def differences(file: Path, held: Mapping[str, bytes], expected: Mapping[str, bytes]) -> list[str]:
    wrong = [f"{file.name}: {name} is missing" for name in sorted(expected.keys() - held.keys())]
    wrong += [f"{file.name}: {name} is not a tracked file" for name in sorted(held.keys() - expected.keys())]
    both = sorted(held.keys() & expected.keys())
    return wrong + [
        f"{file.name}: {name} differs from the tracked file" for name in both if held[name] != expected[name]
    ]


def api_names(api: Mapping[str, Any]) -> set[tuple[str, str]]:
    """(where, name) of what clients rely on: operations, their parameters, and the models' fields and enumerations."""
    names: set[tuple[str, str]] = set()
    for path, operations in api["paths"].items():
        for method in operations.keys() & set(OPERATIONS):
            names.add(("operation", f"{method.upper()} {path}"))
            parameters = operations[method].get("parameters", [])
            names |= {(f"{method.upper()} {path}", each.get("name", "")) for each in parameters}
    for model, schema in api["components"]["schemas"].items():
        names |= {(model, name) for name in _names_in(schema)}
    return names


def _names_in(schema: Any) -> Iterator[str]:
    if isinstance(schema, list):
        for each in schema:
            yield from _names_in(each)
    if not isinstance(schema, dict):
        return
    yield from map(str, schema.get("enum", ()))
    if isinstance(fields := schema.get("properties"), dict):
        yield from fields
        yield from _names_in(list(fields.values()))
    yield from _names_in([value for key, value in schema.items() if key not in ("properties", "example", "examples")])


def removed_from_api(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """What clients of the old API miss: 'where: name'. Of a model that is gone, its fields that are nowhere else."""
    before, after = api_names(old), api_names(new)
    models, anywhere = {where for where, _ in after}, {name for _, name in after}
    gone = ((where, name) for where, name in before - after if where in models or name not in anywhere)
    return sorted(f"{where}: {name}" for where, name in gone)


def untold_removals(old: Mapping[str, Any], new: Mapping[str, Any], told: str) -> list[str]:
    """Removals whose name the text of the changelog doesn't have in backticks."""
    quoted = {name.strip() for span in re.findall(r"`([^`]+)`", told) for name in re.split(r"[,.]", span)}
    gone = removed_from_api(old, new)
    return [f"CHANGELOG.md: doesn't tell that {each} is gone" for each in gone if each.split(": ")[1] not in quoted]


def licence_problems(distribution: str) -> list[str]:
    """Of the packages that a distribution needs on this machine, those under the GPL or AGPL; the LGPL is allowed."""
    licences: dict[str, str] = {}
    _collect_licences(distribution, frozenset(), licences)
    foreign = r"(?<![L\w])A?GPL|(?<!Lesser )General Public"
    return [f"{name}: {text}" for name, text in sorted(licences.items()) if re.search(foreign, text)]


def _collect_licences(name: str, extras: frozenset[str], licences: dict[str, str]) -> None:
    if name in licences:
        return
    facts = metadata.distribution(name).metadata
    listed = [text for text in facts.get_all("Classifier") or () if text.startswith("License")]
    licences[name] = facts.get("License-Expression") or "; ".join(listed) or (facts.get("License") or "unknown")[:50]
    for text in metadata.requires(name) or ():
        needed = Requirement(text)
        if needed.marker is None or any(needed.marker.evaluate({"extra": extra}) for extra in extras or {""}):
            _collect_licences(needed.name, frozenset(needed.extras), licences)
