"""The load run: four times more photos than the service can localize, for three minutes, on two cores.

    python tests/load_run.py [--minutes 3] [--times 4] [--scene scenes/studio]

The service, as `splatfix serve` starts it, gets one core; what sends gets another one, in both parts of the run: first
two photos at a time, so that the worker is never idle (that is the rate that can be served), then at four times that
rate, whatever the answers. Prints the figures and what was promised as JSON; exits with 1 if a promise was broken.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from datetime import datetime
from itertools import cycle, islice
from pathlib import Path
from statistics import fmean, quantiles

import httpx

HERE = Path(__file__).parent
QUEUE_SIZE = 32


@dataclass
class Seen:
    """By the one who sends."""

    answers: Counter = field(default_factory=Counter)
    without_retry_after: int = 0
    lost: Counter = field(default_factory=Counter)
    """Requests without an answer, by what happened."""
    accepted: list[str] = field(default_factory=list)
    health_s: list[float] = field(default_factory=list)
    memory: list[tuple[float, int]] = field(default_factory=list)
    """Seconds since the start of the load, resident bytes."""
    cpu: list[tuple[float, float]] = field(default_factory=list)
    """Seconds since 1970, seconds of CPU that the service has had."""


def encoded(photo: Path) -> tuple[bytes, str]:
    """Return a form's body and type: made once, since making it costs the sender more than sending it."""
    request = httpx.Request("POST", "http://x", files={"photo": (photo.name, photo.read_bytes(), "image/jpeg")})
    return request.read(), request.headers["content-type"]


def pinned(core: int) -> None:
    os.sched_setaffinity(0, {core})


def start(scene: Path, folder: Path, core: int) -> tuple[subprocess.Popen, str]:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    environment = os.environ | {
        **{"PYTHONPATH": str(HERE.parent), "SPLATFIX_VIEWER": "false", "SPLATFIX_QUEUE_SIZE": str(QUEUE_SIZE)},
        **{"SPLATFIX_DATA_DIR": str(folder), "SPLATFIX_RATE_LIMIT": "", "SPLATFIX_KEYS_FILE": str(folder / "none")},
    }
    command = [sys.executable, "-m", "service", "serve", str(scene), "--port", str(port)]
    with (folder / "log").open("w") as log:
        process = subprocess.Popen(
            command, env=environment, preexec_fn=lambda: pinned(core), stdout=log, stderr=log, cwd=HERE.parent
        )
    return process, f"http://127.0.0.1:{port}"


async def ready(client: httpx.AsyncClient) -> None:
    deadline = time.monotonic() + 300
    while time.monotonic() < deadline:
        try:
            if (await client.get("/readyz")).status_code == 200:
                return
        except httpx.TransportError:
            pass
        await asyncio.sleep(0.5)
    raise TimeoutError("the service does not become ready")


async def send(client: httpx.AsyncClient, body: tuple[bytes, str], seen: Seen, prefer: str = "") -> None:
    headers = {"Content-Type": body[1], **({"Prefer": prefer} if prefer else {})}
    try:
        answer = await client.post("/localize", content=body[0], headers=headers)
    except httpx.TransportError as error:
        seen.lost[type(error).__name__] += 1
        return
    seen.answers[answer.status_code] += 1
    if answer.status_code in (200, 202):
        seen.accepted.append(answer.json()["id"])
    elif answer.status_code in (429, 503) and not answer.headers.get("retry-after", "").isdecimal():
        seen.without_retry_after += 1


async def capacity(client: httpx.AsyncClient, bodies: list, seconds: float, pid: int) -> tuple[float, float]:
    """Return the jobs per second that are done while two are always there, and the CPU time of each."""
    seen, endless = Seen(), cycle(bodies)

    async def one_after_another(until: float) -> None:
        while time.monotonic() < until:
            await send(client, next(endless), seen, "wait=60")

    for duration in (5.0, seconds):  # the first ones warm up
        seen.accepted.clear()
        began, cpu_s = time.monotonic(), used(pid)
        await asyncio.gather(*(one_after_another(began + duration) for _ in range(2)))
        took = time.monotonic() - began
    return len(seen.accepted) / took, (used(pid) - cpu_s) / len(seen.accepted)


async def load(client: httpx.AsyncClient, bodies: list, rate: float, seconds: float, pid: int) -> Seen:
    seen, began = Seen(), time.monotonic()
    watching = asyncio.create_task(watch(client, seen, began, pid))
    async with asyncio.TaskGroup() as group:
        for number, body in enumerate(islice(cycle(bodies), int(rate * seconds))):
            await asyncio.sleep(max(0.0, began + number / rate - time.monotonic()))
            group.create_task(send(client, body, seen))
    watching.cancel()
    return seen


async def watch(client: httpx.AsyncClient, seen: Seen, began: float, pid: int) -> None:
    async with httpx.AsyncClient(base_url=client.base_url, timeout=10, trust_env=False) as other:
        while True:
            for path in ("/livez", "/readyz"):
                asked = time.monotonic()
                answer = await other.get(path)
                seen.health_s.append(time.monotonic() - asked if answer.status_code == 200 else float("inf"))
            seen.memory.append((time.monotonic() - began, resident(pid)))
            seen.cpu.append((time.time(), used(pid)))
            await asyncio.sleep(0.2)


def resident(pid: int) -> int:
    text = Path(f"/proc/{pid}/status").read_text()
    return 1024 * int(text[text.index("VmRSS:") + 6 :].split(maxsplit=1)[0])


def used(pid: int) -> float:
    """Return the CPU time of a process with its threads."""
    words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


async def jobs_of(client: httpx.AsyncClient, accepted: set[str]) -> list[dict]:
    """Wait for the accepted jobs' end and return them."""
    while (listed := (await client.get("/jobs?limit=1")).json())["queued"] + listed["running"]:
        await asyncio.sleep(0.5)
    path, found = "/jobs?limit=500", []
    while path:
        page = (await client.get(path)).json()
        found += [job for job in page["jobs"] if job["id"] in accepted]
        path = page["next"]
    return found


def between(job: dict, first: str, last: str) -> float:
    return (datetime.fromisoformat(job[last]) - datetime.fromisoformat(job[first])).total_seconds()


def judged(seen: Seen, jobs: list[dict], free: tuple[float, float], rate: float, seconds: float) -> dict:
    free_rate, free_cpu_s = free
    ended = sorted(datetime.fromisoformat(job["finished"]).timestamp() for job in jobs)
    begun = datetime.fromisoformat(min(job["created"] for job in jobs)).timestamp()
    # From when the queue is full until the load ends.
    steady = [at for at in ended if begun + seconds / 6 <= at <= begun + seconds]
    loaded_rate = len(steady) / (seconds * 5 / 6)
    cpu = [used_s for at, used_s in seen.cpu if begun + seconds / 6 <= at <= begun + seconds]
    loaded_cpu_s = (cpu[-1] - cpu[0]) / len(steady)
    latencies = [between(job, "created", "finished") for job in jobs]
    bound_s = (QUEUE_SIZE + 2) / loaded_rate
    minute = seconds / 3
    first = fmean(m for t, m in seen.memory if minute - 5 <= t <= minute + 5)
    last = fmean(m for t, m in seen.memory if t >= seconds - 10)
    health = quantiles(seen.health_s, n=100)
    refused = sum(count for status, count in seen.answers.items() if status in (429, 503))
    figures = {
        "free_rate_per_s": free_rate,
        "sent_per_s": rate,
        "sent": sum(seen.answers.values()) + sum(seen.lost.values()),
        "answers": {str(status): count for status, count in sorted(seen.answers.items())},
        "lost": dict(seen.lost),
        "accepted": len(seen.accepted),
        "states": dict(Counter(job["state"] for job in jobs)),
        "statuses": dict(Counter(str(job["status"]) for job in jobs)),
        "loaded_rate_per_s": loaded_rate,
        "loaded_over_free": loaded_rate / free_rate,
        # What doesn't depend on who else uses the machine: the core is the service's limit in both parts.
        "cpu_ms_per_job": {"free": 1e3 * free_cpu_s, "loaded": 1e3 * loaded_cpu_s, "ratio": free_cpu_s / loaded_cpu_s},
        "latency_s": {"median": quantiles(latencies, n=2)[0], "max": max(latencies), "bound": bound_s},
        "health_ms": {"median": 1e3 * health[49], "p99": 1e3 * health[98], "max": 1e3 * max(seen.health_s)},
        "memory_mb": {"minute_1": first / 1e6, "minute_3": last / 1e6, "growth": last / first - 1},
    }
    promises = {
        "only accepted or told when to come again": set(seen.answers) <= {200, 202, 429, 503},
        "every refusal has Retry-After": refused > 0 and not seen.without_retry_after,
        "every request has an answer": not seen.lost,
        "every accepted job succeeded": len(jobs) == len(seen.accepted)
        and all(job["state"] == "succeeded" for job in jobs),
        # 1.3: photos differ in how long they take.
        "latency is bounded by the queue": max(latencies) <= 1.3 * bound_s,
        "health in 100 ms (p99)": health[98] < 0.1,
        "memory grows by less than 5 %": last / first < 1.05,
        "throughput within 15 %": abs(loaded_rate / free_rate - 1) <= 0.15,
    }
    return {**figures, "promises": promises}


async def measured(process: subprocess.Popen, url: str, arguments: argparse.Namespace) -> dict:
    bodies = [encoded(photo) for photo in sorted((arguments.scene / "photos").glob("*.jpg"))]
    limits = httpx.Limits(max_connections=200, max_keepalive_connections=50)
    async with httpx.AsyncClient(base_url=url, timeout=120, trust_env=False, limits=limits) as client:
        await ready(client)
        free = await capacity(client, bodies, 20 * arguments.minutes, process.pid)
        seconds, rate = 60 * arguments.minutes, arguments.times * free[0]
        seen = await load(client, bodies, rate, seconds, process.pid)
        jobs = await jobs_of(client, set(seen.accepted))
    return judged(seen, jobs, free, rate, seconds)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=3.0)
    parser.add_argument("--times", type=float, default=4.0, help="the rate that can be served")
    parser.add_argument("--scene", type=Path, default=HERE.parent / "scenes" / "studio")
    arguments = parser.parse_args()
    cores = sorted(os.sched_getaffinity(0))
    if len(cores) < 2:
        parser.error("two cores are needed: one for the service, one for what sends")
    pinned(cores[1])
    with tempfile.TemporaryDirectory() as folder:
        process, url = start(arguments.scene, Path(folder), cores[0])
        try:
            report = asyncio.run(measured(process, url, arguments))
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait()
    print(json.dumps(report, indent=1))
    return 0 if all(report["promises"].values()) else 1


if __name__ == "__main__":
    raise SystemExit(main())
