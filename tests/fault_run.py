"""The fault run: a service is killed again and again while clients work; nothing accepted may be lost or done twice.

    python tests/fault_run.py [--jobs 200] [--kills 20] [--seed 0]

Clients send photos with idempotency keys until they are accepted, follow jobs and cancel some; others leave in the
middle of an upload or of a stream. The service gets SIGKILL at random moments and is started again; once its disk is
full for some seconds. Prints what became of the jobs as JSON; exits with 1 if anything is wrong.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import random
import signal
import socket
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Collection
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import httpx
import numpy as np
from PIL import Image

ENDED = ("succeeded", "failed", "cancelled", "interrupted")
HERE = Path(__file__).parent


@dataclass
class Service:
    """One that is started again after each kill."""

    data_dir: Path
    port: int
    process: subprocess.Popen | None = None
    kills: int = 0

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def start(self) -> None:
        environment = os.environ | {"PYTHONPATH": f"{HERE}{os.pathsep}{HERE.parent}"}
        command = [sys.executable, str(HERE / "fault_server.py"), str(self.data_dir), str(self.port)]
        self.process = subprocess.Popen(command, env=environment)
        deadline = time.monotonic() + 180  # the machine may be busy
        while time.monotonic() < deadline:
            with suppress(httpx.HTTPError):
                if httpx.get(f"{self.url}/livez", trust_env=False).status_code == 200:
                    return
            time.sleep(0.1)
        raise TimeoutError("the service does not start")

    def kill(self) -> None:
        assert self.process
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()
        self.kills += 1

    def signal(self, number: int) -> None:
        assert self.process
        self.process.send_signal(number)


@dataclass
class Outcome:
    accepted: dict[int, str] = field(default_factory=dict)
    """Job ids by seed, as the clients were told."""
    told: Counter = field(default_factory=Counter)
    """Status codes."""
    wrong: list[str] = field(default_factory=list)
    streams: int = 0
    """Followed to the end."""
    dropped_uploads: int = 0
    dropped_streams: int = 0


def photo() -> bytes:
    file = io.BytesIO()
    Image.fromarray(np.random.default_rng(1).integers(0, 256, (64, 96, 3), np.uint8)).save(file, "JPEG")
    return file.getvalue()


PHOTO = photo()


def submit(url: str, seed: int, outcome: Outcome, again: Collection[int] = (503,)) -> None:
    """Send until it is accepted; always with the same key. `again`: answers after which it is sent again."""
    options = json.dumps({"steps": 12, "pause_s": 0.06})
    while True:
        try:
            answer = httpx.post(
                f"{url}/localize",
                files={"photo": ("p.jpg", PHOTO)},
                data={"seed": str(seed), "options": options},
                headers={"Idempotency-Key": f"job-{seed}"},
                timeout=20,
                trust_env=False,
            )
        except httpx.HTTPError:
            time.sleep(0.2)
            continue
        outcome.told[answer.status_code] += 1
        if answer.status_code in (200, 202):
            outcome.accepted[seed] = answer.json()["id"]
            return
        if answer.status_code not in again:
            outcome.wrong.append(f"seed {seed}: {answer.status_code} {answer.text[:200]}")
            return
        time.sleep(0.3)


def follow(url: str, job_id: str, outcome: Outcome, *, leave: bool) -> None:
    """Read a job's events to the end, through restarts; or leave after the first."""
    last, seen, deadline = "", [], time.monotonic() + 300
    while time.monotonic() < deadline:
        with suppress(httpx.HTTPError):
            headers = {"Last-Event-ID": last}
            with httpx.stream("GET", f"{url}/jobs/{job_id}/events", headers=headers, timeout=30, trust_env=False) as s:
                for line in s.iter_lines():
                    if not line.startswith("id: "):
                        continue
                    last = line.removeprefix("id: ")
                    seen.append(last)
                    if leave:
                        outcome.dropped_streams += 1
                        return
                    if last == "end":
                        check_order(job_id, seen, outcome)
                        outcome.streams += 1
                        return
        time.sleep(0.2)
    outcome.wrong.append(f"{job_id}: its stream never ended")


def check_order(job_id: str, seen: list[str], outcome: Outcome) -> None:
    """Each id once, attempts rising, and within an attempt one after the other."""
    numbers = [tuple(map(int, number.split("."))) for number in seen[:-1]]
    for before, after in pairwise(numbers):
        if not (after[0] > before[0] and after[1] == 0) and after != (before[0], before[1] + 1):
            outcome.wrong.append(f"{job_id}: event {after} after {before}")


def leave_while_uploading(port: int, outcome: Outcome, stop: threading.Event) -> None:
    head = b"POST /localize HTTP/1.1\r\nHost: localhost\r\nContent-Type: multipart/form-data; boundary=x\r\n"
    while not stop.wait(0.5):
        with suppress(OSError), socket.create_connection(("127.0.0.1", port), 2) as connection:
            connection.sendall(head + b"Content-Length: 100000\r\n\r\n--x\r\n")
            time.sleep(0.05)
            outcome.dropped_uploads += 1


def client(service: Service, seeds: list[int], outcome: Outcome, rng: random.Random) -> None:
    for seed in seeds:
        submit(service.url, seed, outcome)
        job_id = outcome.accepted.get(seed)
        if job_id is None:
            continue
        fate = rng.random()
        if fate < 0.1:
            with suppress(httpx.HTTPError):
                httpx.delete(f"{service.url}/jobs/{job_id}", timeout=10, trust_env=False)
        elif fate < 0.35:
            follow(service.url, job_id, outcome, leave=fate < 0.15)


def trouble(service: Service, kills: int, rng: random.Random, done: threading.Event) -> None:
    """Kill at random moments; fill the disk once, halfway."""
    for number in range(kills):
        done.wait(rng.uniform(0.3, 3.0))
        if number == kills // 2:
            service.signal(signal.SIGUSR1)
            time.sleep(3)
            service.signal(signal.SIGUSR2)
        service.kill()
        service.start()


def reckon(service: Service, outcome: Outcome, asked: int) -> dict:
    """Wait for the end of all jobs and compare what was promised with what there is."""
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        listed = httpx.get(f"{service.url}/jobs?limit=500", trust_env=False).json()
        if listed["queued"] == listed["running"] == 0:
            break
        time.sleep(0.5)
    jobs = {job["id"]: httpx.get(f"{service.url}/jobs/{job['id']}", trust_env=False).json() for job in listed["jobs"]}
    wrong = outcome.wrong
    states = Counter(jobs[job_id]["state"] if job_id in jobs else "lost" for job_id in outcome.accepted.values())
    if len(outcome.accepted) != asked:
        wrong.append(f"{asked - len(outcome.accepted)} requests were never accepted")
    for seed, job_id in outcome.accepted.items():
        job = jobs.get(job_id)
        if job is None or job["state"] not in ENDED:
            wrong.append(f"{job_id} is lost: {job and job['state']}")
        elif job["seed"] != seed or (job["result"] and job["result"]["seed"] != seed):
            wrong.append(f"{job_id} has the result of another")
        elif (job["result"] is None) == (job["state"] == "succeeded"):
            wrong.append(f"{job_id} is {job['state']} with result {job['result']}")
        elif job["state"] in ("failed", "interrupted") and not job["error"]:
            wrong.append(f"{job_id} is {job['state']} without a reason")
    wrong += on_disk(service.data_dir, jobs)
    return {
        "asked": asked,
        "accepted": len(outcome.accepted),
        "jobs": len(jobs),
        "states": dict(states),
        "attempts": dict(Counter(job["attempt"] for job in jobs.values())),
        "kills": service.kills,
        "answers": {str(code): count for code, count in outcome.told.items()},
        "streams_followed_to_the_end": outcome.streams,
        "streams_left": outcome.dropped_streams,
        "uploads_left": outcome.dropped_uploads,
        "wrong": wrong,
    }


def on_disk(data_dir: Path, jobs: dict[str, dict]) -> list[str]:
    """Look into the file itself."""
    wrong = []
    with sqlite3.connect(f"file:{data_dir / 'jobs.sqlite'}?mode=ro", uri=True) as database:
        if database.execute("PRAGMA integrity_check").fetchone() != ("ok",):
            wrong.append("the database is damaged")
        keys = database.execute("SELECT idempotency_key, count(*) FROM jobs GROUP BY 1 HAVING count(*) > 1").fetchall()
        wrong += [f"key {key} has {count} jobs" for key, count in keys]
        rows = database.execute("SELECT job, attempt, count(*), max(seq) FROM events GROUP BY 1, 2").fetchall()
    for job_id, attempt, count, last in rows:
        job = jobs.get(job_id)
        if job and job["state"] == "succeeded" and (attempt, count, last) != (job["attempt"], 12, 11):
            wrong.append(f"{job_id}: {count} records of attempt {attempt} up to {last}")
    left = [path.name for path in (data_dir / "photos").glob("*.upload")]
    return [*wrong, *(f"photo {name} is left" for name in left)]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=200)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    rng, began = random.Random(arguments.seed), time.monotonic()
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    with tempfile.TemporaryDirectory() as folder:
        service, outcome, done = Service(Path(folder), port), Outcome(), threading.Event()
        service.start()
        try:
            noise = threading.Thread(target=leave_while_uploading, args=(port, outcome, done))
            killer = threading.Thread(target=trouble, args=(service, arguments.kills, rng, done))
            noise.start()
            killer.start()
            with ThreadPoolExecutor(6) as clients:
                for k in range(6):
                    seeds = list(range(k, arguments.jobs, 6))
                    clients.submit(client, service, seeds, outcome, random.Random(k)).add_done_callback(
                        lambda f: outcome.wrong.append(repr(f.exception())) if f.exception() else None
                    )
            killer.join()
            done.set()
            noise.join()
            report = reckon(service, outcome, arguments.jobs) | {"seconds": round(time.monotonic() - began)}
        finally:
            service.kill()
    print(json.dumps(report, indent=1))
    return 1 if report["wrong"] else 0


if __name__ == "__main__":
    raise SystemExit(main())
