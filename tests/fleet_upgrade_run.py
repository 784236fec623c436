"""The upgrade run of a fleet: release N-1 to N under load, and back; no request may fail.

    python tests/fleet_upgrade_run.py [--engine ray] [--old REVISION] [--told]

nginx before two fronts, and PostgreSQL, all on loopback; with `--engine ray` replicas on a Ray cluster of each release.
Clients localize with idempotency keys, follow jobs, read, upload scenes and open live sessions, and never try again
but where docs/api.md says so: a stream that ended early is resumed, a live session that the service closed is opened
anew. Meanwhile one front after another is replaced as docs/scale.md says, by release N, and then back.

Release N-1 is the revision `--old`, HEAD unless given. Release N is the present tree with what a release may add:
another version, a migration, and a field more in stored specs, records and results, which N-1 doesn't know.
With `--told` nginx is told before a front ends, as for a release whose fronts don't wait for requests on their way.
Prints what failed as JSON; exits with 1 if anything did. Needs the extra `postgres`, and `ray` for its engine.
"""

from __future__ import annotations

import argparse
import io
import json
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import threading
import time
from collections import Counter
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path

import httpx
from fault_run import PHOTO, Outcome, check_order
from fleet_fault_run import Part, copy_logs, environment_of, head_command, reckon
from fleet_front import EMBEDDED
from gateway import Gateway, free_port
from postgres_server import Server
from small_room import write_room

from service.live_client import Live, LiveClosed

HERE = Path(__file__).parent
GOING_AWAY = 1012
"""The code of a live session whose service is restarted."""


ADDED = {
    "service/__init__.py": (r'__version__ = ".*"', '__version__ = "99.0"'),
    "service/jobs/postgres_store.py": (
        r'(database.migrate\("jobs", \(.*)\)\)',
        r"""\1, *_first("ALTER TABLE jobs ADD COLUMN later TEXT NOT NULL DEFAULT ''")))""",
    ),
    "service/jobs/model.py": (r"(    times_s: .*\n)", r"""\1    later_spec: str = "?"\n"""),
    "service/results.py": (r"(    (?:index: int = 0|scene_ranking: .*)\n)", r"""\1    later_value: str = "?"\n"""),
}
"""What release N has beside the present tree: a pattern for each file, and what takes its place."""


def earlier_release(revision: str, folder: Path) -> Path:
    """Write a revision's files; return their folder."""
    archive = subprocess.run(["git", "archive", revision], cwd=HERE.parent, check=True, capture_output=True).stdout
    with tarfile.open(fileobj=io.BytesIO(archive)) as files:
        files.extractall(folder, filter="data")
    return folder


def next_release(folder: Path) -> Path:
    """Write the present package `service` with what a release may add; return its folder."""
    shutil.copytree(HERE.parent / "service", folder / "service", ignore=shutil.ignore_patterns("__pycache__"))
    for name, (pattern, text) in ADDED.items():
        changed, times = re.subn(pattern, text, (folder / name).read_text())
        assert times, f"{name} has no {pattern}"
        (folder / name).write_text(changed)
    return folder


@dataclass
class Release:
    """A tree of files, and what runs of it."""

    name: str
    tree: Path
    fronts: list[Part] = field(default_factory=list)
    ports: list[int] = field(default_factory=list)
    head: Part | None = None
    ray: str = EMBEDDED
    """The address of its cluster."""
    environment: dict[str, str] = field(default_factory=dict)


class Fleet:
    """All processes, in a folder; `url` is nginx's."""

    def __init__(self, folder: Path, engine: str, told: bool, stack: ExitStack) -> None:
        self.folder, self.engine, self.told = folder, engine, told
        write_room(folder / "room", cameras=2)
        (folder / "postgres").mkdir()
        database = Server(folder / "postgres")
        database.start()
        stack.callback(database.stop, "immediate")
        self.address, self._numbers = database.database(), count()
        self.steps: list[dict] = []
        """What was done when, for the report."""
        self._began, self._parts = time.monotonic(), []
        stack.callback(self._kill)

    def _kill(self) -> None:
        for part in reversed(self._parts):
            part.kill()

    def begin(self, release: Release, stack: ExitStack) -> None:
        """Start the first release, and nginx before it."""
        self.start_cluster(release)
        for _ in range(2):
            self.start_front(release)
        self.gateway = Gateway(release.ports, self.folder / "nginx")
        stack.callback(self.gateway.close)
        self.url = self.gateway.url

    def replace(self, old: Release, new: Release) -> None:
        """Replace the fronts of a release one by one, with a Ray cluster of the new one's own."""
        self.start_cluster(new)
        while old.fronts:
            self.start_front(new)
            self.gateway.take([*old.ports, *new.ports])
            self.end_front(old, [*old.ports[1:], *new.ports])
        if old.head:
            old.head.kill()

    def start_cluster(self, release: Release) -> None:
        number = next(self._numbers)
        release.environment = environment_of(release.tree, self.folder / f"r{number}")
        if self.engine == EMBEDDED:
            return
        release.ray = f"127.0.0.1:{free_port()}"
        command = head_command(int(release.ray.split(":")[1]))
        release.head = self._started(release, command, f"head{number}")

    def start_front(self, release: Release) -> None:
        """Start a front, and wait until it is ready."""
        began, port = time.monotonic(), free_port()
        command = [sys.executable, str(HERE / "fleet_front.py"), self.address, release.ray, str(port), str(self.folder)]
        part = self._started(release, command, f"front{port}-{release.name}")
        await_ready(f"http://127.0.0.1:{port}", part)
        release.fronts.append(part)
        release.ports.append(port)
        self._note("started", release, began)

    def end_front(self, release: Release, left: list[int]) -> None:
        """End a front by SIGTERM; nginx goes on asking it until then, unless it is told."""
        part, began = release.fronts.pop(0), time.monotonic()
        release.ports.pop(0)
        if self.told:
            self.gateway.take(left)
        part.end()
        self._note("ended", release, began)
        self.gateway.take(left)

    def _started(self, release: Release, command: list[str], name: str) -> Part:
        part = Part(command, release.environment, self.folder / f"{name}.log", folder=release.tree)
        self._parts.append(part)
        part.start()
        return part

    def _note(self, what: str, release: Release, began: float) -> None:
        now = time.monotonic()
        at, took = round(began - self._began, 1), round(now - began, 1)
        self.steps.append({"at_s": at, "what": f"a front of {release.name} {what}", "took_s": took})


def await_ready(url: str, part: Part | None = None, seconds: float = 240) -> None:
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        assert part is None or part.running(), part.log.read_text()[-3000:]
        with suppress(httpx.HTTPError):
            if httpx.get(f"{url}/readyz", trust_env=False, timeout=10).status_code == 200:
                return
        time.sleep(0.2)
    raise TimeoutError(f"{url} does not become ready")


class Load:
    """Clients that never try again; what fails is in `outcome.wrong`."""

    def __init__(self, url: str, scene: bytes, outcome: Outcome, uploads: bool) -> None:
        self.url, self._scene, self.outcome = url, scene, outcome
        self.requests, self.resumed, self.reopened = Counter(), 0, 0
        self.slowest: dict[str, float] = {}
        self._seeds, self._ended, self._lock = count(), threading.Event(), threading.Lock()
        loops = [
            self._localize,
            self._localize,
            self._read,
            self._describe,
            self._watch,
            *([self._upload] if uploads else []),
        ]
        self._threads = [threading.Thread(target=self._repeat, args=(loop,)) for loop in [*loops, self._live]]
        for thread in self._threads:
            thread.start()

    def end(self) -> None:
        self._ended.set()
        for thread in self._threads:
            thread.join()

    def _repeat(self, loop) -> None:
        began = time.monotonic()
        while not self._ended.is_set():
            try:
                loop()
            except Exception as error:
                at = time.monotonic() - began
                self.outcome.wrong.append(f"{at:.1f} s: {loop.__name__}: {type(error).__name__} {error}")
                time.sleep(0.2)

    def _ask(self, method: str, path: str, *wanted: int, **options) -> httpx.Response:
        """Send one request, with a connection of its own. Raises AssertionError for another answer than is wanted."""
        began = time.monotonic()
        answer = httpx.request(method, f"{self.url}{path}", timeout=30, trust_env=False, **options)
        self._count(f"{method} {re.sub('[0-9a-f]{16}|up[0-9]+', '*', path)}", time.monotonic() - began)
        assert answer.status_code in wanted, f"{method} {path}: {answer.status_code} {answer.text[:300]}"
        return answer

    def _count(self, kind: str, took_s: float) -> None:
        with self._lock:
            self.requests[kind] += 1
            self.slowest[kind] = max(self.slowest.get(kind, 0.0), round(took_s, 2))

    def _localize(self, pause_s: float = 0.06, prefer: str = "") -> str:
        seed = next(self._seeds)
        sent = {
            "files": {"photo": ("p.jpg", PHOTO)},
            "data": {"scene": "room", "seed": str(seed), "options": json.dumps({"steps": 12, "pause_s": pause_s})},
            "headers": {"Idempotency-Key": f"job-{seed}", "Prefer": prefer or "wait=0"},
        }
        job = self._ask("POST", "/localize", 200, 202, **sent).json()
        self.outcome.accepted[seed] = job["id"]
        if seed % 3 == 0:  # as a client does that heard no answer
            again = self._ask("POST", "/localize", 200, 202, **sent).json()
            assert again["id"] == job["id"], f"key job-{seed} made {job['id']} and {again['id']}"
        deadline = time.monotonic() + 120
        while not self._ask("GET", f"/jobs/{job['id']}", 200).json()["finished"]:
            assert time.monotonic() < deadline, f"{job['id']} does not end"
            time.sleep(0.3)
        return job["id"]

    def _read(self) -> None:
        for path in ("/scenes", "/scenes/room", "/jobs?limit=5", "/readyz", "/scenes/room/thumbnail.jpg"):
            self._ask("GET", path, 200)
        time.sleep(0.1)

    def _describe(self) -> None:
        self._ask("GET", "/capabilities", 200)  # takes seconds in a front that has just begun
        self._ended.wait(3)

    def _watch(self) -> None:
        """Follow a job of some seconds to its end; begin again after each stream that ended early."""
        seed, pause_s = next(self._seeds), 0.4
        data = {"scene": "room", "seed": str(seed), "options": json.dumps({"steps": 12, "pause_s": pause_s})}
        headers = {"Idempotency-Key": f"job-{seed}"}
        answer = self._ask(
            "POST", "/localize", 202, files={"photo": ("p.jpg", PHOTO)}, data=data, headers=headers
        ).json()
        self.outcome.accepted[seed] = answer["id"]
        seen: list[str] = []
        deadline = time.monotonic() + 120
        while not seen or seen[-1] != "end":
            assert time.monotonic() < deadline, f"{answer['id']}: its stream never ended"
            seen += self._stream(answer["id"], seen[-1] if seen else "")
        check_order(answer["id"], seen, self.outcome)
        self.outcome.streams += 1

    def _stream(self, job_id: str, last: str) -> list[str]:
        """Return the ids that come until the stream ends. Raises where it breaks."""
        self._count("GET /jobs/*/events", 0.0)
        self.resumed += bool(last)
        address, headers = f"{self.url}/jobs/{job_id}/events", {"Last-Event-ID": last}
        with httpx.stream("GET", address, headers=headers, timeout=30, trust_env=False) as stream:
            assert stream.status_code == 200, f"events: {stream.status_code}"
            return [line.removeprefix("id: ") for line in stream.iter_lines() if line.startswith("id: ")]

    def _upload(self) -> None:
        """Upload a scene slowly, use it and delete it."""
        name = f"up{next(self._seeds)}x"
        size = len(self._scene) // 8 + 1

        def parts():
            for first in range(0, len(self._scene), size):
                time.sleep(0.2)
                yield self._scene[first : first + size]

        self._ask("PUT", f"/scenes/{name}", 201, content=parts())
        time.sleep(2.5)  # until all fronts know it
        self._ask("GET", f"/scenes/{name}", 200)
        self._ask("DELETE", f"/scenes/{name}", 204)

    def _live(self) -> None:
        """Open a session, send some frames and close it."""
        began = time.monotonic()
        try:
            with Live(self.url, "room", proxy=None) as live:
                self._count("WS /scenes/room/live", time.monotonic() - began)
                live.send(PHOTO)
                live.answer(10)
                self._ended.wait(1)
        except LiveClosed as closed:
            if closed.code != GOING_AWAY:
                raise
            self.reopened += 1  # by the next turn


def run(engine: str, old: str, *, told: bool, hold_s: float = 5.0, logs: Path | None = None) -> dict:
    """Return what was asked and what failed; `wrong` is empty if nothing did."""
    outcome, began = Outcome(), time.monotonic()
    # A short path: those of Ray's sockets must have fewer than 108 letters.
    with tempfile.TemporaryDirectory(prefix="u", ignore_cleanup_errors=True) as temporary, ExitStack() as stack:
        folder = Path(temporary)
        folder.chmod(0o755)
        if logs:
            stack.callback(copy_logs, folder, logs)
        before = Release("N-1", earlier_release(old, folder / "old"))
        after = Release("N", next_release(folder / "new"))
        fleet = Fleet(folder, engine, told, stack)
        fleet.begin(before, stack)
        uploads = (before.tree / "service" / "object_store.py").exists()
        load = Load(fleet.url, (folder / "room" / "scene.ply").read_bytes(), outcome, uploads)
        try:
            for first, second in ((before, after), (after, before)):
                time.sleep(hold_s)
                fleet.replace(first, second)
            time.sleep(hold_s)
        finally:
            load.end()
        report = reckon(fleet.address, outcome, len(outcome.accepted))
    return {
        "engine": engine,
        "old": old,
        "requests": load.requests.total(),
        "by_kind": dict(sorted(load.requests.items())),
        "slowest_s": dict(sorted(load.slowest.items())),
        "streams_resumed": load.resumed,
        "live_sessions_reopened": load.reopened,
        "steps": fleet.steps,
        **report,
        "seconds": round(time.monotonic() - began),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--engine", choices=(EMBEDDED, "ray"), default="ray")
    parser.add_argument("--old", default="HEAD", help="The revision of release N-1.")
    parser.add_argument("--told", action="store_true", help="Tell nginx before a front ends.")
    parser.add_argument("--logs", type=Path, help="Copy the processes' logs to this folder.")
    arguments = parser.parse_args()
    report = run(arguments.engine, arguments.old, told=arguments.told, logs=arguments.logs)
    print(json.dumps(report, indent=1))
    return 1 if report["wrong"] else 0


if __name__ == "__main__":
    raise SystemExit(main())
