"""On what splatfix runs: tries whether its dependencies can be installed, and writes the table in docs/platforms.md.

    python tests/platforms_run.py resolve    with a network and uv: docs/results/platforms/resolved.json
    python tests/platforms_run.py write      the table in docs/platforms.md and the line in README.md

A machine's own file in that folder is made by `splatfix bench device --json docs/results/platforms/NAME.json`.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from release_checks import own_version

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "results" / "platforms"
PLATFORMS = {
    ("Linux", "x86_64"): ("Linux, x86-64", "x86_64-manylinux_2_28"),
    ("Linux", "aarch64"): ("Linux, ARM (aarch64)", "aarch64-manylinux_2_28"),
    ("Darwin", "arm64"): ("macOS, Apple silicon", "aarch64-apple-darwin"),
    ("Darwin", "x86_64"): ("macOS, Intel", "x86_64-apple-darwin"),
    ("Windows", "AMD64"): ("Windows, x86-64", "x86_64-pc-windows-msvc"),
    ("Windows", "ARM64"): ("Windows, ARM", "aarch64-pc-windows-msvc"),
}
"""By what Python says of a machine: its name in the table, and uv's name."""
DEVICES = {"CPU": (), "NVIDIA GPU": ("gpu",)}
"""By the extras that it takes."""
NO_GPU = ("Darwin",)
PYTHONS = ("3.11", "3.12", "3.13")
MARKS = "<!-- platforms: by tests/platforms_run.py -->", "<!-- end of platforms -->"


def resolve() -> dict[str, Any]:
    """Ask uv whether wheels of all dependencies exist, in the versions of constraints.txt; nothing is installed."""
    found = {}
    for system, machine in PLATFORMS:
        for device, extras in DEVICES.items():
            if system in NO_GPU and extras:
                continue
            found[f"{system} {machine} {device}"] = {
                python: resolved(PLATFORMS[system, machine][1], python, extras) for python in PYTHONS
            }
    date = datetime.now(UTC).date().isoformat()
    return {"bench": "resolve", "date": date, "splatfix": own_version(ROOT), "found": found}


def resolved(platform: str, python: str, extras: tuple[str, ...]) -> str:
    """Why no set of wheels fits; empty if one does."""
    command = ["uv", "pip", "compile", "--quiet", "--only-binary", ":all:", "--python-platform", platform]
    command += ["--python-version", python, "--constraint", "constraints.txt", "pyproject.toml"]
    command += [part for extra in extras for part in ("--extra", extra)]
    # PyTorch's wheels are for macOS 14; uv assumes 13.
    environment = os.environ | {"MACOSX_DEPLOYMENT_TARGET": "14.0"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    if not done.returncode:
        return ""
    lacking = re.search(r"(?:Because|Wheels are (?:available|required) for) `?([\w-]+)", done.stderr)
    return f"no wheel of {lacking[1]}" if lacking else done.stderr.strip().splitlines()[0]


def states(folder: Path) -> Iterator[tuple[str, str, str, str]]:
    """Yield platform, device, state (run, emulated, resolved only, not possible) and what the results say of it."""
    results = [json.loads(file.read_text("utf-8")) for file in sorted(folder.glob("*.json"))]
    trials = {result["bench"]: result for result in results if result["bench"] == "resolve"}
    for (system, machine), (name, _) in PLATFORMS.items():
        for device in DEVICES:
            key = f"{system} {machine} {device}"
            runs = [each for each in results if each["bench"] == "device" and ran_on(each) == key]
            real = [each for each in runs if not each["emulated"]]
            if runs:
                newest = max(real or runs, key=lambda each: each["date"])
                yield name, device, "run" if real else "emulated", told_run(newest)
            elif key in trials.get("resolve", {}).get("found", {}):
                yield name, device, *told_trial(trials["resolve"], key)


def ran_on(result: dict[str, Any]) -> str:
    """The row that a result of `bench device` belongs to: a GPU counts if it rendered."""
    device = "CPU" if result["renderer"] == "cpu" else "NVIDIA GPU"
    return f"{result['system']} {result['machine']} {device}"


def told_run(result: dict[str, Any]) -> str:
    found, versions = result["photos"]["given"], result["versions"]
    good = f"{found['localized']} of {found['queries']} demo photos localized, {found['false_localized']} wrongly"
    where = result["gpu"] if result["renderer"] != "cpu" else result["processor"].split(", load")[0]
    return f"{result['date']}, {versions['splatfix']}, Python {versions['python']}: {good}; {where}"


def told_trial(trial: dict[str, Any], key: str) -> tuple[str, str]:
    reasons = trial["found"][key]
    good = [python for python, reason in reasons.items() if not reason]
    when = f"{trial['date']}, {trial['splatfix']}"
    if good:
        return "resolved only", f"{when}, Python {', '.join(good)}"
    return "not possible", f"{when}: {next(iter(reasons.values()))}"


def table(folder: Path) -> str:
    lines = ["| platform | device | state | date, version, what |", "| --- | --- | --- | --- |"]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in states(folder))])


def line(folder: Path) -> str:
    """What README says."""
    by_state: dict[str, list[str]] = {}
    for platform, device, state, _ in states(folder):
        by_state.setdefault(state, []).append(platform if device == "CPU" else f"{platform} with an {device}")
    parts = [
        f"{state}: {'; '.join(by_state[state])}" for state in ("run", "emulated", "resolved only") if state in by_state
    ]
    return "\n".join(f"- {part}" for part in parts)


def with_part(text: str, part: str) -> str:
    """The text with what is between the marks replaced."""
    before, rest = text.split(MARKS[0])
    return f"{before}{MARKS[0]}\n\n{part}\n\n{MARKS[1]}{rest.split(MARKS[1])[1]}"


PLACES = {ROOT / "docs" / "platforms.md": table, ROOT / "README.md": line}


def main() -> int:
    match sys.argv[1:]:
        case ["resolve"]:
            (RESULTS / "resolved.json").write_text(json.dumps(resolve(), indent=1) + "\n", "utf-8")
        case ["write"]:
            for path, made in PLACES.items():
                path.write_text(with_part(path.read_text("utf-8"), made(RESULTS)), "utf-8")
        case _:
            print(__doc__)
            return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
