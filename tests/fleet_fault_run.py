"""The fault run of a fleet: its parts are killed while clients work; nothing accepted may be lost or done twice.

    python tests/fleet_fault_run.py [--jobs 200] [--seed 0]

nginx before two fronts, PostgreSQL, and Ray with two replicas, all on loopback. At random moments replicas, fronts and
Ray's head get SIGKILL and are started again, as Compose or Kubernetes do; PostgreSQL is restarted, and for some
seconds no replica can write to its cache. Clients are those of `fault_run`. Prints what became of the jobs, and how
long the service accepted no photo, as JSON; exits with 1 if anything is wrong. Needs the extras `ray` and `postgres`.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path

import httpx
from fault_run import ENDED, Outcome, follow, submit
from gateway import behind_nginx, free_port
from postgres_server import Server
from small_room import write_room

HERE = Path(__file__).parent
TROUBLES = {"replica": 10, "front": 5, "head": 2, "database": 2, "full disk": 1}
AGAIN = (502, 503, 504)
"""Answers after which a client tries again: of fronts, and of nginx while no front is there."""


@dataclass
class Part:
    """A process that is started again whenever it ends, as a supervisor does."""

    command: list[str]
    environment: dict[str, str]
    log: Path
    process: subprocess.Popen | None = None
    starts: int = 0
    wanted: bool = True
    lock: threading.Lock = field(default_factory=threading.Lock)
    folder: Path | None = None
    """Where it runs."""

    def start(self) -> None:
        with self.lock, self.log.open("ab") as log:
            if self.wanted and (self.process is None or self.process.poll() is not None):
                self.process = subprocess.Popen(
                    self.command, env=self.environment, stdout=log, stderr=log, start_new_session=True, cwd=self.folder
                )
                self.starts += 1

    def running(self) -> bool:
        return self.process is not None and self.process.poll() is None

    def end(self) -> None:
        """Let it end, and don't start it again."""
        assert self.process
        self.wanted = False
        self.process.terminate()
        self.process.wait(90)

    def kill(self) -> None:
        """Kill it with all that it started."""
        if self.process:
            with suppress(ProcessLookupError):
                os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()


def environment_of(tree: Path, ray: Path) -> dict[str, str]:
    """Return the environment of a release's processes: those of the tree, with `ray` as the cluster's folder."""
    paths = os.pathsep.join((str(HERE), str(tree)))
    environment = os.environ | {"PYTHONPATH": paths, "RAY_AUTH_TOKEN": secrets.token_hex(32)}
    return environment | {"RAY_AUTH_MODE": "token", "RAY_TMPDIR": str(ray), "RAY_DISABLE_IMPORT_WARNING": "1"}


def head_command(port: int) -> list[str]:
    """Return what runs a Ray cluster of two cores."""
    ray = [str(Path(sys.executable).parent / "ray"), "start", "--head", "--block", f"--port={port}"]
    ray += ["--node-ip-address=127.0.0.1", "--num-cpus=2", "--include-dashboard=false"]
    return [*ray, "--object-store-memory=200000000", "--disable-usage-stats"]


class Fleet:
    """All processes, in a folder; `url` is nginx's."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self.folder = folder
        write_room(folder / "room", cameras=2)
        at = folder / "postgres"
        at.mkdir()
        self.database = Server(at)
        self.database.start()
        stack.callback(self.database.stop, "immediate")
        self.address, head, ports = self.database.database(), free_port(), [free_port(), free_port()]
        environment = environment_of(HERE.parent, folder / "ray")
        self.head = Part(head_command(head), environment, folder / "head.log")
        front = [sys.executable, str(HERE / "fleet_front.py"), self.address, f"127.0.0.1:{head}"]
        self.fronts = [
            Part([*front, str(port), str(folder)], environment, folder / f"front{port}.log") for port in ports
        ]
        self.parts = [self.head, *self.fronts]
        self._ended = threading.Event()
        stack.callback(self.close)
        self._supervisor = threading.Thread(target=self._supervise)
        self._supervisor.start()
        self.url = stack.enter_context(behind_nginx(ports, folder / "nginx"))

    def _supervise(self) -> None:
        while not self._ended.wait(0.5):
            for part in self.parts:
                part.start()

    def close(self) -> None:
        self._ended.set()
        self._supervisor.join()
        for part in reversed(self.parts):
            part.kill()
        for pid in replicas(self.folder):  # of a head that was killed
            os.kill(pid, signal.SIGKILL)

    def await_ready(self, seconds: float = 240) -> None:
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            with suppress(httpx.HTTPError):
                if httpx.get(f"{self.url}/readyz", trust_env=False, timeout=10).status_code == 200:
                    return
            time.sleep(0.3)
        raise TimeoutError("the fleet does not become ready")

    def disturb(self, kind: str, rng: random.Random) -> None:
        if kind == "replica":
            deadline = time.monotonic() + 60
            while not (found := replicas(self.folder)) and time.monotonic() < deadline:
                time.sleep(0.1)
            os.kill(rng.choice(found), signal.SIGKILL)
        elif kind == "front":
            rng.choice(self.fronts).kill()
        elif kind == "head":
            self.head.kill()
        elif kind == "database":
            self.database.stop()
            self.database.start()
        else:
            (self.folder / "full").touch()
            for pid in replicas(self.folder):  # the next ones have to read the scene, and can't keep it
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            time.sleep(15)
            (self.folder / "full").unlink()


def replicas(folder: Path) -> list[int]:
    """Return the ids of the processes that are replicas of the cluster `ray` in a folder."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            of_this_run = str(folder / "ray").encode() in (process / "environ").read_bytes()
            if of_this_run and (process / "cmdline").read_bytes().startswith(b"ray::Replica"):
                found.append(int(process.name))
    return sorted(found)


def client(url: str, seeds: list[int], outcome: Outcome, rng: random.Random) -> None:
    for seed in seeds:
        submit(url, seed, outcome, AGAIN)
        job_id = outcome.accepted.get(seed)
        fate = rng.random()
        if job_id is not None and fate < 0.1:
            with suppress(httpx.HTTPError):
                httpx.delete(f"{url}/jobs/{job_id}", timeout=10, trust_env=False)
        elif job_id is not None and fate < 0.4:
            follow(url, job_id, outcome, leave=fate < 0.15)


def trouble(
    fleet: Fleet,
    troubles: Mapping[str, int],
    rng: random.Random,
    done: threading.Event,
    made: list[tuple[float, str]],
) -> None:
    """Do what may happen to a fleet, each kind so often, in a random order."""
    kinds = [kind for kind, count in troubles.items() for _ in range(count)]
    rng.shuffle(kinds)
    for kind in kinds:
        if done.wait(rng.uniform(2.0, 8.0)):
            return
        made.append((time.monotonic(), kind))
        fleet.disturb(kind, rng)


def watch(url: str, done: threading.Event, up: list[tuple[float, bool]]) -> None:
    """Note once in a while whether the service is ready for photos."""
    while not done.wait(0.25):
        ready = False
        with suppress(httpx.HTTPError):
            ready = httpx.get(f"{url}/readyz", timeout=5, trust_env=False).status_code == 200
        up.append((time.monotonic(), ready))


def outages(up: list[tuple[float, bool]], made: list[tuple[float, str]]) -> dict[str, list[float]]:
    """Return how long the service wasn't ready each time, in seconds, by what happened last before."""
    found: dict[str, list[float]] = {}
    since = None
    for moment, ready in up:
        if not ready and since is None:
            since = moment
        elif ready and since is not None:
            cause = next((kind for at, kind in reversed(made) if at <= since + 1), "nothing")
            found.setdefault(cause, []).append(round(moment - since, 1))
            since = None
    return found


def reckon(address: str, outcome: Outcome, asked: int) -> dict:
    """Wait for the end of all jobs and compare what was promised with what there is."""
    import psycopg  # pyright: ignore[reportMissingImports]

    query = "SELECT id, state, attempt, result IS NOT NULL, failure IS NOT NULL, spec, idempotency_key FROM jobs"
    deadline, rows = time.monotonic() + 240, []
    with psycopg.connect(address, autocommit=True) as database:
        while time.monotonic() < deadline:
            rows = database.execute(query).fetchall()
            if all(state in ENDED for _, state, *_ in rows):
                break
            time.sleep(0.5)
        events = database.execute("SELECT job, attempt, count(*), max(seq) FROM events GROUP BY 1, 2").fetchall()
    wrong, jobs = outcome.wrong, {row[0]: row for row in rows}
    keys = Counter(key for *_, key in rows)
    wrong += [f"key {key} has {count} jobs" for key, count in keys.items() if count > 1]
    if len(outcome.accepted) != asked:
        wrong.append(f"{asked - len(outcome.accepted)} requests were never accepted")
    for seed, job_id in outcome.accepted.items():
        if job_id not in jobs or jobs[job_id][1] not in ENDED:
            wrong.append(f"{job_id} is lost: {jobs.get(job_id)}")
            continue
        _, state, _, has_result, has_failure, _, key = jobs[job_id]
        if key != f"job-{seed}" or has_result != (state == "succeeded"):
            wrong.append(f"{job_id} ({key}) is {state}, with a result: {has_result}")
        elif state in ("failed", "interrupted") and not has_failure:
            wrong.append(f"{job_id} is {state} without a reason")
    for job_id, attempt, count, last in events:
        _, state, latest, *_ = jobs[job_id]
        if state == "succeeded" and (attempt, count, last) != (latest, 12, 11):
            wrong.append(f"{job_id}: {count} records of attempt {attempt} up to {last}; the last attempt is {latest}")
    return {
        "asked": asked,
        "accepted": len(outcome.accepted),
        "states": dict(Counter(state for _, state, *_ in rows)),
        "attempts": dict(sorted(Counter(attempt for _, _, attempt, *_ in rows).items())),
        "answers": {str(code): count for code, count in sorted(outcome.told.items())},
        "streams_followed_to_the_end": outcome.streams,
        "streams_left": outcome.dropped_streams,
        "wrong": wrong,
    }


def copy_logs(source: Path, target: Path) -> None:
    target.mkdir(parents=True, exist_ok=True)
    for log in source.glob("*.log"):
        shutil.copy(log, target)


def run(jobs: int, seed: int, troubles: Mapping[str, int] = TROUBLES, logs: Path | None = None) -> dict:
    """Return what became of the jobs; `wrong` is empty if nothing was lost or done twice."""
    began, done, outcome = time.monotonic(), threading.Event(), Outcome()
    made: list[tuple[float, str]] = []
    up: list[tuple[float, bool]] = []
    # A short path: those of Ray's sockets must have fewer than 108 letters.
    with tempfile.TemporaryDirectory(prefix="f", ignore_cleanup_errors=True) as temporary, ExitStack() as stack:
        folder = Path(temporary)
        folder.chmod(0o755)
        if logs:
            stack.callback(copy_logs, folder, logs)
        fleet = Fleet(folder, stack)
        fleet.await_ready()
        helpers = [threading.Thread(target=watch, args=(fleet.url, done, up))]
        helpers += [threading.Thread(target=trouble, args=(fleet, troubles, random.Random(seed), done, made))]
        for thread in helpers:
            thread.start()
        try:
            with ThreadPoolExecutor(6) as clients:
                for k in range(6):
                    seeds = list(range(k, jobs, 6))
                    clients.submit(client, fleet.url, seeds, outcome, random.Random(k)).add_done_callback(
                        lambda f: outcome.wrong.append(repr(f.exception())) if f.exception() else None
                    )
            helpers[1].join()  # what is planned happens, though the clients may be done
            fleet.await_ready()
            report = reckon(fleet.address, outcome, jobs)
        finally:
            done.set()
            for thread in helpers:
                thread.join()
        report |= {"troubles": dict(Counter(kind for _, kind in made)), "not_ready_s": outages(up, made)}
        return report | {"starts": [part.starts for part in fleet.parts], "seconds": round(time.monotonic() - began)}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--logs", type=Path, help="Copy the processes' logs to this folder.")
    arguments = parser.parse_args()
    report = run(arguments.jobs, arguments.seed, logs=arguments.logs)
    print(json.dumps(report, indent=1))
    return 1 if report["wrong"] else 0


if __name__ == "__main__":
    raise SystemExit(main())
