"""The viewer run: live jobs for half an hour before two browsers; the memory of service and pages must stay flat.

    python tests/viewer_run.py [--minutes 30] [--every 10]

One page has the viewer open and follows the newest job all the time. The other one sends a photo from the start page,
reads the verdict, opens the job in the viewer, steps back and forth, and returns. Measures the memory of the service,
of its viewer and of both pages after each round; prints the medians of each quarter of the run as JSON; exits with 1
if anything is larger in the last quarter than in the second one by more than `MAY_GROW` and `BUT_AT_LEAST`.

Of a page its objects are judged, what they have outside the heap (pictures, buffers), its DOM nodes and its listeners:
every few rounds a heap snapshot tells what there is by kind. The heap as a whole is printed too, but Chromium goes on
compiling a page's functions as they are used more often, which has an end but takes longer than half an hour.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import httpx
import numpy as np
from browsing import launched, opened
from gateway import free_port
from playwright.sync_api import CDPSession, Page
from small_room import INTRINSICS, pose_at, write_room

HERE = Path(__file__).parent
MAY_GROW = 1.05
BUT_AT_LEAST = 1.0
"""A megabyte, a file: less than that comes and goes (a page of 18 MB has a list of 110 jobs instead of 50)."""

SNAPSHOT_EVERY = 5
"""Rounds."""
NOT_JUDGED = {"heap MB", "code MB"}


@contextmanager
def service(folder: Path) -> Iterator[tuple[str, int]]:
    """A service with a small room, for people: with its viewer. Gives its URL and process id."""
    port = free_port()
    environment = os.environ | {"PYTHONPATH": str(HERE.parent), "SPLATFIX_DATA_DIR": str(folder / "data")}
    room = write_room(folder / "room")
    command = [sys.executable, "-m", "service", "serve", str(room), "--port", str(port)]
    with (folder / "log").open("wb") as log:
        process = subprocess.Popen(command, env=environment, stderr=log, stdout=log)
    url = f"http://127.0.0.1:{port}"
    try:
        deadline = time.monotonic() + 300  # kernels may be compiled, and the machine be busy
        while not _ready(url):
            if time.monotonic() > deadline or process.poll() is not None:
                raise RuntimeError(f"the service does not start:\n{(folder / 'log').read_text()}")
            time.sleep(0.2)
        yield url, process.pid
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(30)


def _ready(url: str) -> bool:
    with suppress(httpx.HTTPError):
        return httpx.get(f"{url}/readyz", trust_env=False).status_code == 200
    return False


def child_of(parent: int, words: str) -> int:
    """Return the child process whose command line has these words."""
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            if int(stat.read_text().rpartition(")")[2].split()[1]) != parent:
                continue
            if words in (stat.parent / "cmdline").read_text().replace("\0", " "):
                return int(stat.parent.name)
    raise LookupError(f"process {parent} has no child '{words}'")


def of_process(pid: int) -> dict[str, float]:
    lines = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    files = len(list(Path(f"/proc/{pid}/fd").iterdir()))
    return {"MB": int(lines["VmRSS"].split()[0]) / 1000, "threads": int(lines["Threads"]), "files": files}


def of_page(session: CDPSession) -> dict[str, float]:
    """After a collection: else it is a sawtooth."""
    session.send("HeapProfiler.collectGarbage")
    found = {m["name"]: m["value"] for m in session.send("Performance.getMetrics")["metrics"]}
    return {"heap MB": found["JSHeapUsedSize"] / 1e6, "nodes": found["Nodes"], "listeners": found["JSEventListeners"]}


def by_kind(session: CDPSession) -> dict[str, float]:
    """Return what the page holds, in MB: objects, what these have outside the heap, and what the browser compiled."""
    chunks: list[str] = []
    take = lambda event: chunks.append(event["chunk"])  # noqa: E731
    session.on("HeapProfiler.addHeapSnapshotChunk", take)
    session.send("HeapProfiler.takeHeapSnapshot", {"reportProgress": False})
    session.remove_listener("HeapProfiler.addHeapSnapshotChunk", take)
    snapshot = json.loads("".join(chunks))
    meta = snapshot["snapshot"]["meta"]
    nodes = np.array(snapshot["nodes"]).reshape(-1, len(meta["node_fields"]))
    kind, size = (nodes[:, meta["node_fields"].index(field)] for field in ("type", "self_size"))
    kinds = meta["node_types"][meta["node_fields"].index("type")]
    found = {name: float(size[kind == k].sum()) / 1e6 for k, name in enumerate(kinds)}
    print(json.dumps(found), file=sys.stderr, flush=True)
    code, native = found["code"], found["native"]
    return {"objects MB": sum(found.values()) - code - native, "native MB": native, "code MB": code}


def watched(page: Page) -> CDPSession:
    session = page.context.new_cdp_session(page)
    session.send("Performance.enable")
    return session


def photo(url: str, angle: float) -> bytes:
    """A photo of the room."""
    pose = {"world_from_camera": pose_at(angle, 0.1).world_from_camera.tolist()}
    wanted = {"pose": pose, "intrinsics": INTRINSICS, "format": "jpeg"}
    return httpx.post(f"{url}/scenes/room/render", json=wanted, trust_env=False, timeout=60).content


def one_round(page: Page, url: str, angle: float) -> None:
    """What a visitor does, from the start page and back to it."""
    page.goto(f"{url}/#/")
    page.get_by_role("radio").first.wait_for()
    file = {"name": "photo.jpg", "mimeType": "image/jpeg", "buffer": photo(url, angle)}
    page.set_input_files("#photo", file)
    page.locator(".verdict .badge").wait_for()
    page.get_by_role("link", name="Open in viewer").click()
    page.get_by_text("agree").first.wait_for()
    for key in "ppnnp":
        page.keyboard.press(key)
        page.wait_for_timeout(100)
    page.go_back()
    page.locator(".verdict .badge").wait_for()


def samples(minutes: float, every: float) -> dict[str, list[dict[str, float]]]:
    """Run; return what was measured after each round."""
    with tempfile.TemporaryDirectory() as folder, service(Path(folder)) as (url, pid), launched() as browser:
        viewer = child_of(pid, "-m viewer")
        follower, visitor = opened(browser, f"{url}/viewer/", 900, 600), opened(browser, f"{url}/", 900, 600)
        visitor.set_default_timeout(300_000)
        sessions = {"page that follows": watched(follower), "page that visits": watched(visitor)}
        taken: dict[str, list[dict[str, float]]] = {}
        end = time.monotonic() + 60 * minutes
        for k in range(10**6):
            began = time.monotonic()
            if began > end:
                break
            one_round(visitor, url, float(np.random.default_rng(k).uniform(0, 6.28)))
            measured = {"service": of_process(pid), "viewer": of_process(viewer)}
            measured |= {name: of_page(session) for name, session in sessions.items()}
            if k % SNAPSHOT_EVERY == 0:
                for name, session in sessions.items():
                    measured[name] |= by_kind(session)
            print(json.dumps({"round": k, **measured}), file=sys.stderr, flush=True)
            for name, figures in measured.items():
                taken.setdefault(name, []).append(figures)
            time.sleep(max(0.0, began + every - time.monotonic()))
        return taken


def quarters(values: list[float]) -> list[float]:
    return [round(float(np.median(part)), 1) for part in np.array_split(values, 4)]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=30)
    parser.add_argument("--every", type=float, default=10, help="seconds from one job to the next (default: 10)")
    arguments = parser.parse_args()
    taken = samples(arguments.minutes, arguments.every)
    if len(taken["service"]) < 8 * SNAPSHOT_EVERY:
        print(f"only {len(taken['service'])} rounds: too few to say anything")
        return 1
    table = {
        who: {what: quarters([s[what] for s in series if what in s]) for what in series[0]}
        for who, series in taken.items()
    }
    grown = [
        f"{who}: {what} {second:g} -> {last:g}"
        for who, figures in table.items()
        for what, (_, second, _, last) in figures.items()
        if what not in NOT_JUDGED and last > second * MAY_GROW and last > second + BUT_AT_LEAST
    ]
    print(json.dumps({"jobs": len(taken["service"]), "quarters": table, "grown": grown}, indent=2))
    return 1 if grown else 0


if __name__ == "__main__":
    sys.exit(main())
