"""The mutation run: small faults are put into the code one by one, and the tests shall notice them.

    python tests/mutation_run.py --out mutants.jsonl [--seed 0] [--count 60] [--workers 2] [--limit-s 600]
        [--measured FOLDER] [--select "not browser and not ci"] [PATH ...]

Each of `--count` mutants, drawn by the seed from every file of service/ and viewer/ (or from the paths), all kinds
alike, is applied in a copy of the last commit, and the tests that run its line are started until one fails: those of
files that name the module first, of these the cheapest. Which those are, and how long each takes, is measured first by
one run of all tests (some ten minutes) and kept in the folder `--measured`, for other seeds and later commits: lines
are found again where a file has changed since, and a test file that has changed runs as a whole. Compiled kernels and
processes of their own can't be measured, and what an import runs is measured in the test that happened to import it:
these have the test files that name the module or run any of its lines, then those of the modules that import it, then
all. A failing test counts if it passes without the mutant; one that does not end within the limit has not noticed
anything.

The output has a line of JSON for each mutant; a run that was stopped goes on where it was. A mutant that changes
nothing that anybody could see is marked by hand: `"equivalent": "why"` in its line. Prints the sums.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import json
import os
import queue
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import zip_longest
from pathlib import Path
from typing import Any

from coverage import CoverageData
from mutations import KINDS, Mutant, mutants_of

ROOT = Path(__file__).parents[1]
LIMIT = "time limit"


def drawn(root: Path, count: int, seed: int, paths: Sequence[str] = ("service", "viewer")) -> list[Mutant]:
    """Return mutants of files and folders by chance, the kinds in turn; of a longer list the first are the same."""
    files = (f for p in paths for f in (sorted((root / p).rglob("*.py")) if (root / p).is_dir() else [root / p]))
    found = [m for file in files for m in mutants_of(str(file.relative_to(root)), file.read_bytes())]
    by_kind = [[mutant for mutant in found if mutant.kind == kind] for kind in KINDS]
    for mutants in by_kind:
        random.Random(seed).shuffle(mutants)
    in_turn = (mutant for row in zip_longest(*by_kind) for mutant in row if mutant)
    return [mutant for mutant, _ in zip(in_turn, range(count), strict=False)]


# ------------------------------------------------------------------ which tests run a line


@dataclass(frozen=True)
class Coverage:
    """Which tests run a line, by the measured contexts `file::test|phase`."""

    data: CoverageData
    names: dict[str, str]
    """Path in the repository -> path in the data."""
    commit: str
    """What was measured."""
    seconds: dict[str, float]
    """Of each test, with the fixtures that it was the first to need."""

    @classmethod
    def read(cls, folder: Path) -> Coverage:
        data = CoverageData(str(folder / "contexts.coverage"))
        data.read()
        names = {re.sub(r"^.*?/(?=(service|viewer)/)", "", name): name for name in data.measured_files()}
        seconds = {}
        for case in ET.parse(folder / "seconds.xml").iter("testcase"):
            module, _, classes = case.attrib["classname"].removeprefix("tests.").partition(".")
            parts = [f"tests/{module}.py", *filter(None, classes.split(".")), case.attrib["name"]]
            seconds["::".join(parts)] = float(case.attrib["time"])
        return cls(data, names, (folder / "commit").read_text().strip(), seconds)

    @cached_property
    def changed(self) -> set[str]:
        """The test files that aren't what was measured."""
        return set(_git("diff", "--name-only", self.commit, "HEAD", "--", "tests").split())

    def line(self, mutant: Mutant) -> int | None:
        """Return the line of a mutant when it was measured, None if it was another."""
        if not _git("diff", "--name-only", self.commit, "HEAD", "--", mutant.file):
            return mutant.line
        if not _git("ls-tree", self.commit, "--", mutant.file):
            return None
        before, after = (_git("show", f"{at}:{mutant.file}").splitlines() for at in (self.commit, "HEAD"))
        for i, j, count in difflib.SequenceMatcher(None, before, after, autojunk=False).get_matching_blocks():
            if j < mutant.line <= j + count:
                return mutant.line - j + i
        return None

    def tests(self, mutant: Mutant) -> list[str]:
        """Return the tests that run the line; all tests of a file that has changed or whose fixture runs it."""
        found = set()
        for context in self.data.contexts_by_lineno(self.names.get(mutant.file, "")).get(self.line(mutant) or -1, []):
            test, _, phase = context.partition("|")
            if test:
                file = test.split("::")[0]
                found.add(test if phase == "run" and file not in self.changed else file)
        return sorted(test for test in found if "::" not in test or test.split("::")[0] not in found)

    def files(self, source: str) -> set[str]:
        """Return the test files that run any line of a source file."""
        contexts = self.data.contexts_by_lineno(self.names.get(source, "")).values()
        return {test.split("::")[0] for tests in contexts for test in tests if test}

    def cheapest_first(self, tests: Iterable[str]) -> list[str]:
        """Return tests by file, the files that take the least time first; a file's tests keep their order."""
        of_files: dict[str, list[str]] = defaultdict(list)
        for test in tests:
            of_files[test.split("::")[0]].append(test)
        whole: dict[str, float] = defaultdict(float)
        for test, seconds in self.seconds.items():
            whole[test.split("::")[0]] += seconds
        cost = {
            file: sum(whole[file] if each == file else self.seconds.get(each, 0.0) for each in chosen)
            for file, chosen in of_files.items()
        }
        order = {test: i for i, test in enumerate(self.seconds)}
        files = sorted(cost, key=cost.__getitem__)
        return [test for file in files for test in sorted(of_files[file], key=lambda test: order.get(test, -1))]


def _git(*arguments: str) -> str:
    return subprocess.run(["git", *arguments], cwd=ROOT, check=True, capture_output=True, text=True).stdout


def measure(copy: Copy, workers: int, folder: Path) -> None:
    """Run all tests once and write which of them run which line, how long each takes, and of which commit."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "contexts.coverage").unlink(missing_ok=True)
    command = ["-n", str(workers), "--dist=loadfile", "--cov", "--cov-context=test", "--cov-report="]
    command.append(f"--junitxml={(folder / 'seconds.xml').absolute()}")
    done = copy.pytest(command, 3600, COVERAGE_FILE=str((folder / "contexts.coverage").absolute()))
    if done.returncode != 0:
        print(f"some tests fail before anything is changed:\n{done.stdout[-3000:]}", file=sys.stderr)
    (folder / "commit").write_text(_git("rev-parse", "HEAD"))


def stages(mutant: Mutant, coverage: Coverage, copy: Path) -> Iterator[list[str]]:
    """Yield what to run, one after the other until something fails."""
    near = {str(path) for path in naming(mutant.file, copy) if path.parts[0] == "tests"}
    tests = set() if runs_at_import(mutant.line, (copy / mutant.file).read_bytes()) else set(coverage.tests(mutant))
    if tests:
        added = near & coverage.changed
        tests = {test for test in tests if test.split("::")[0] not in added} | added
        # Those of files that name the module are likely to notice, and collecting few files is quick.
        likely = {test for test in tests if test.split("::")[0] in near}
        yield coverage.cheapest_first(likely)
        yield coverage.cheapest_first(tests - likely)
        return
    near |= coverage.files(mutant.file)
    importing = {t for p in naming(mutant.file, copy) if p.parts[0] != "tests" for t in coverage.files(str(p))}
    # What only an import runs, such as a default in a model of the API, may show anywhere.
    everything = {f"tests/{path.name}" for path in (copy / "tests").glob("test_*.py")}
    for files in (near, importing - near, everything - near - importing):
        yield coverage.cheapest_first(files & everything)


def runs_at_import(line: int, source: bytes) -> bool:
    """Whether a line is in no function's body."""
    functions = (n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef))
    return not any(each.body[0].lineno <= line <= (each.end_lineno or 0) for each in functions)


def naming(file: str, copy: Path) -> list[Path]:
    """Return the files of tests and source that name the module of a file."""
    module = file.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
    package, _, name = module.rpartition(".")
    named = re.compile(rf"\b{re.escape(module)}\b|from {re.escape(package)} import .*\b{name}\b")
    paths = [*(copy / "tests").glob("test_*.py"), *(copy / "service").rglob("*.py"), *(copy / "viewer").rglob("*.py")]
    return [path.relative_to(copy) for path in paths if named.search(path.read_text("utf-8"))]


# ------------------------------------------------------------------ applying a mutant


@dataclass(frozen=True, slots=True)
class Copy:
    """A copy of the last commit, with code caches of its own."""

    folder: Path
    select: str = ""
    """Of the tests those that pytest's `-m` selects."""

    @classmethod
    def make(cls, folder: Path, select: str = "") -> Copy:
        folder.mkdir()
        archive = subprocess.run(["git", "archive", "HEAD"], cwd=ROOT, check=True, capture_output=True).stdout
        subprocess.run(["tar", "-x"], cwd=folder, input=archive, check=True)
        copy = cls(folder, select)
        warm = [sys.executable, "-m", "service", "doctor", "--warm"]
        subprocess.run(warm, cwd=folder, env=copy.environment, check=True, stdout=subprocess.DEVNULL)
        return copy

    @property
    def environment(self) -> dict[str, str]:
        return os.environ | {"SPLATFIX_CACHE_DIR": str(self.folder / ".cache"), "PYTHONPATH": str(self.folder)}

    def pytest(self, arguments: Sequence[str], limit_s: float, **environment: str) -> subprocess.CompletedProcess[str]:
        """Run tests; what takes longer has return code -1. A test may have to compile changed kernels first."""
        options = ["-p", "no:cacheprovider", "--timeout=240", "-m", self.select]
        command = [sys.executable, "-m", "pytest", *options, *arguments]
        with tempfile.TemporaryFile("w+") as output:
            process = subprocess.Popen(
                command,
                cwd=self.folder,
                env=self.environment | environment,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
            try:
                code = process.wait(limit_s)
            except subprocess.TimeoutExpired:
                code = -1
            finally:
                _end_group(process)
            output.seek(0)
            return subprocess.CompletedProcess(command, code, output.read())

    def first_failure(self, tests: Sequence[str], limit_s: float) -> tuple[str, str] | None:
        """Return the test that fails first and its error, or "time limit", or None if all pass."""
        listed = self.folder / ".tests"
        listed.write_text("\n".join(tests))
        done = self.pytest(["-x", f"@{listed}"], limit_s)
        if done.returncode in (0, 5):  # 5: there was no test
            return None
        if done.returncode == -1:
            return LIMIT, ""
        failed = re.search(r"^(?:FAILED|ERROR) (tests/.+?)(?: - .*)?$", done.stdout, re.M)
        error = re.search(r"^E   +(.*)$", done.stdout, re.M)
        return failed[1] if failed else f"exit code {done.returncode}", error[1][:200] if error else ""


def _end_group(process: subprocess.Popen) -> None:
    """End a run and the servers that it left behind."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def judged(mutant: Mutant, copy: Copy, coverage: Coverage, limit_s: float) -> dict[str, Any]:
    """Apply a mutant, run its tests, and take it back."""
    path = copy.folder / mutant.file
    source, times = path.read_bytes(), path.stat()
    begun, failed, tests = time.monotonic(), None, []
    try:
        path.write_bytes(mutant.applied(source))
        for tests in stages(mutant, coverage, copy.folder):
            left_s = limit_s - (time.monotonic() - begun)
            failed = copy.first_failure(tests, max(left_s, 1)) if tests else None
            if failed:
                break
    finally:
        path.write_bytes(source)
        os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))  # compiled kernels are found by it
    by, error = failed or (None, "")
    again = [by] if by and by.startswith("tests/") else tests
    flaky = by not in (None, LIMIT) and (copy.first_failure(again, limit_s) or (None,))[0] == by
    return {
        **{name: getattr(mutant, name) for name in ("file", "line", "column", "kind", "before", "after")},
        "noticed": by not in (None, LIMIT) and not flaky,
        "by": by,
        "error": error,
        "flaky": flaky,
        "covered": bool(coverage.tests(mutant)),
        "seconds": round(time.monotonic() - begun, 1),
        "equivalent": None,
    }


# ------------------------------------------------------------------ the run


def judge_all(
    todo: Sequence[Mutant], workers: int, limit_s: float, out: Path, folder_measured: Path, select: str
) -> None:
    """Judge mutants, several at a time, and add their lines to the output."""
    with tempfile.TemporaryDirectory() as folder, out.open("a") as lines, ThreadPoolExecutor(workers) as pool:
        copies = list(pool.map(lambda i: Copy.make(Path(folder, str(i)), select), range(workers)))
        if not (folder_measured / "commit").exists():
            measure(copies[0], workers, folder_measured)
        coverage = Coverage.read(folder_measured)
        idle: queue.SimpleQueue[Copy] = queue.SimpleQueue()
        for copy in copies:
            idle.put(copy)

        def judge(mutant: Mutant) -> None:
            copy = idle.get()
            try:
                row = judged(mutant, copy, coverage, limit_s)
            finally:
                idle.put(copy)
            lines.write(json.dumps(row) + "\n")
            lines.flush()

        for judging in [pool.submit(judge, mutant) for mutant in todo]:
            judging.result()


def rows_of(out: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in out.read_text().splitlines()] if out.exists() else []


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--limit-s", type=float, default=600)
    parser.add_argument("--measured", type=Path, help="by default beside the output")
    parser.add_argument("--select", default="", help="of the tests only those: an expression as of pytest's -m")
    parser.add_argument("paths", nargs="*", default=["service", "viewer"])
    asked = parser.parse_args()
    done = {tuple(row[name] for name in ("file", "line", "column", "before", "after")) for row in rows_of(asked.out)}
    todo = [mutant for mutant in drawn(ROOT, asked.count, asked.seed, asked.paths) if mutant.key not in done]
    folder = asked.measured or asked.out.with_suffix(".measured")
    judge_all(todo, asked.workers, asked.limit_s, asked.out, folder, asked.select)
    counted = [row for row in rows_of(asked.out) if not row["equivalent"]]
    missed = [f"{row['file']}:{row['line']} {row['before']} -> {row['after']}" for row in counted if not row["noticed"]]
    print(json.dumps({"mutants": len(counted), "noticed": len(counted) - len(missed), "missed": missed}, indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
