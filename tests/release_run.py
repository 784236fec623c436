"""A dry run of a release, by hand: `make release-check`. Uploads nothing; leaves what would be uploaded in dist/.

    python tests/release_run.py [--final] [--since REF] [--out FOLDER]

Checks that versions agree and the changelog tells what the API lost, builds source archive and wheel (the wheel from
the archive), compares both with the tracked files, localizes a photo with the wheel alone, outside of the source tree,
checks licences and the image's file, and packs the ZIP for Windows. Exit code 1 if anything is wrong.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tarfile
import tempfile
import venv
import zipfile
from collections.abc import Iterator
from pathlib import Path

import yaml
from release_checks import (
    changes,
    licence_problems,
    own_version,
    removed_from_api,
    sdist_problems,
    untold_removals,
    version_problems,
    wheel_problems,
)

ROOT = Path(__file__).parents[1]
HADOLINT = Path(sys.executable).with_name("hadolint")


def main() -> int:
    parser = argparse.ArgumentParser(description="Dry run of a release.")
    parser.add_argument("--final", action="store_true", help="also: a clean working tree, a date in the changelog")
    parser.add_argument("--since", default="", help="last release; by default its tag, else where the changelog began")
    parser.add_argument("--out", type=Path, default=ROOT / "dist")
    given = parser.parse_args()
    wrong = 0
    for name, problems in checks(given.final, given.since, given.out.resolve()):
        print(f"{'FAIL' if problems else 'ok  '} {name}", *problems, sep="\n       ", flush=True)
        wrong += len(problems)
    print(f"{wrong} problems" if wrong else f"clean: {given.out}")
    return int(wrong > 0)


def checks(final: bool, since: str, out: Path) -> Iterator[tuple[str, list[str]]]:
    """Yield each check's name and what is wrong, as it is made."""
    version = own_version(ROOT)
    yield f"version {version}", version_problems(ROOT, final)
    changed = ran("git", "status", "--porcelain").splitlines() if final else []
    yield "working tree", [f"not committed: {line}" for line in changed]
    since = since or last_release(version)
    old, new = (yaml.safe_load(text) for text in (ran("git", "show", f"{since}:openapi.yaml"), described_api()))
    on_file = yaml.safe_load((ROOT / "openapi.yaml").read_text("utf-8"))
    gone = removed_from_api(old, new)
    print(f"     API since {since}: {len(gone)} names gone; `git diff {since} -- openapi.yaml`")
    yield "openapi.yaml", [] if on_file == new else ["openapi.yaml: run `splatfix openapi > openapi.yaml`"]
    yield "removals told", untold_removals(old, new, changes(ROOT))
    yield "licences", licence_problems("splatfix")
    linted = subprocess.run([HADOLINT, ROOT / "docker" / "Dockerfile"], capture_output=True, text=True, check=False)
    yield "docker/Dockerfile", linted.stdout.splitlines() if linted.returncode else []
    sdist, wheel = built(version, out)
    tracked = {name: (ROOT / name).read_bytes() for name in ran("git", "ls-files").splitlines()}
    print(f"     {sdist.name} {sdist.stat().st_size / 1e6:.1f} MB, {wheel.name} {wheel.stat().st_size / 1e6:.1f} MB")
    yield "source archive", sdist_problems(sdist, tracked, version)
    yield "wheel", wheel_problems(wheel, tracked, version)
    yield "localizes from the wheel", tried(wheel)
    yield f"ZIP for Windows, {windows_zip(version, wheel, out).name}", []


def ran(*command: object) -> str:
    parts = [str(part) for part in command]
    return subprocess.run(parts, check=True, capture_output=True, text=True, encoding="utf-8", cwd=ROOT).stdout


def last_release(version: str) -> str:
    """The newest tag of another version; without tags the commit before the one that began this changelog section."""
    tags = [tag for tag in ran("git", "tag", "--list", "v*", "--sort=-creatordate").split() if tag != f"v{version}"]
    if tags:
        return tags[0]
    began = ran("git", "log", "--format=%h", f"-S## {version} ", "--", "CHANGELOG.md").split()
    return began[-1] + "^"


def described_api() -> str:
    return ran(sys.executable, "-m", "splatfix", "openapi")


def built(version: str, out: Path) -> tuple[Path, Path]:
    """Build the source archive, and the wheel from that alone; return both."""
    for old in out.glob(f"splatfix-{version}*"):
        old.unlink()
    ran(sys.executable, "-m", "hatchling", "build", "-t", "sdist", "-d", out)
    sdist, wheel = out / f"splatfix-{version}.tar.gz", out / f"splatfix-{version}-py3-none-any.whl"
    with tempfile.TemporaryDirectory() as folder:
        with tarfile.open(sdist) as archive:
            archive.extractall(folder, filter="data")
        source = Path(folder) / f"splatfix-{version}"
        subprocess.run([sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", out], check=True, cwd=source)
    return sdist, wheel


def tried(wheel: Path) -> list[str]:
    """Localize a photo of the bundled scene with the wheel, whose dependencies are those of this environment."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        venv.create(folder / "venv", with_pip=False)
        site = next((folder / "venv").glob("lib/python*/site-packages"))
        packages = [path for path in sys.path if Path(path).name == "site-packages"]  # not where this program itself is
        (site / "dependencies.pth").write_text("\n".join(packages), "utf-8")
        with zipfile.ZipFile(wheel) as archive:
            archive.extractall(site)
        demo = site / "splatfix" / "demo" / "studio"
        environment = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "SPLATFIX"))}
        command = [folder / "venv" / "bin" / "python", "-P", "-m", "splatfix", "localize", "--fail", "--scene", demo]
        done = subprocess.run(
            [*command, demo / "photos" / "photo_00.jpg"],
            cwd=folder,
            env=environment | {"SPLATFIX_CACHE_DIR": str(folder / "cache")},
            capture_output=True,
            text=True,
            check=False,
        )
        print(f"     {done.stdout.strip().replace(str(site), '')}")
        return done.stderr.splitlines()[-5:] if done.returncode else []


def windows_zip(version: str, wheel: Path, out: Path) -> Path:
    """Pack the wheel and start.cmd, for those who have no terminal open."""
    path, folder = out / f"splatfix-{version}-windows.zip", f"splatfix-{version}"
    # cmd.exe misreads labels in files without carriage returns.
    script = re.sub(r"\r?\n", "\r\n", (ROOT / "windows" / "start.cmd").read_text("utf-8"))
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(f"{folder}/start.cmd", script)
        archive.write(wheel, f"{folder}/{wheel.name}")
        archive.write(ROOT / "constraints.txt", f"{folder}/constraints.txt")
        archive.write(ROOT / "LICENSE", f"{folder}/LICENSE.txt")
    return path


if __name__ == "__main__":
    sys.exit(main())
