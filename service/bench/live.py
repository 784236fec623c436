"""`splatfix bench live`: live sessions with a service, at a camera's rate, over a WebSocket and a poor link.

The frames are rendered and encoded before (`live_film`). The service is another process, on processors of its own where
the system can do that; so what the clients take is apart. True poses stay here.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.request import ProxyHandler, build_opener

import numpy as np

from service.bench.live_film import FILM, FilmConfig, Shot, make_film
from service.bench.live_odometry import displayed, odometry_figures, with_odometry
from service.bench.pose_metrics import COARSE, FINE, Units, errors, units_of
from service.client import Client, ServiceError
from service.errors import SceneNotFound
from service.live_client import Live, LiveAnswer, LiveClosed
from service.loaded_scene import LoadedScene
from service.operating_system import keep_to_cores
from service.pose.features.scene_focus import centre_depth
from service.scene_formats import load_scene
from service.types import Intrinsics, Pose


@dataclass(frozen=True, slots=True)
class LinkConfig:
    """The way from the camera to the service."""

    delay_s: float = 0.04
    spread_s: float = 0.02
    """The delay is uniform within this much of `delay_s`; frames keep their order."""
    loss: float = 0.01
    """Share of frames that never arrive."""


LINK = LinkConfig()


@dataclass(slots=True)
class SessionLog:
    """What a client sent and received."""

    shots: Sequence[Shot]
    sent_at: dict[int, float] = field(default_factory=dict)
    """By the frame's id: seconds since the film's start at which it was handed to the socket."""
    shot_of: dict[int, int] = field(default_factory=dict)
    answers: dict[int, LiveAnswer] = field(default_factory=dict)
    """By the frame's id."""
    heard_at: dict[int, float] = field(default_factory=dict)
    hints: list[dict[str, Any]] = field(default_factory=list)


def run(
    folder: Path,
    *,
    seconds: float = 40.0,
    sessions: int = 1,
    cores: int = 1,
    seed: int = 0,
    withheld: bool = False,
    odometry: bool = True,
    cache_dir: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
    config: FilmConfig = FILM,
    link: LinkConfig = LINK,
) -> dict[str, Any]:
    """Return the object that `--json` writes: figures of each session, and of the service. Raises SceneError.

    The service runs on `cores` processors; with `withheld` it isn't given the camera's intrinsics. With `odometry`
    frames bring a device's, in metres that the scene knows nothing of.
    """
    film, camera, units = _filmed(folder, seconds, seed, odometry, cache_dir, progress, config)
    with _service(folder, cores, cache_dir) as (url, scene):
        _warm_up(url, scene, film, camera)
        before = _cpu_s(url)
        began, own = time.perf_counter(), time.process_time()
        logs = play(film, url, scene, sessions, None if withheld else camera, seed, link)
        wall_s, own_s = time.perf_counter() - began, time.process_time() - own
        server_s = _cpu_s(url) - before
    return {
        "scene": scene,
        "seed": seed,
        "frames": len(film),
        "cores": cores,
        "intrinsics": "withheld" if withheld else "given",
        "service_cpu_share": server_s / wall_s,
        "service_cpu_ms_a_frame": 1e3 * server_s / max(1, sum(len(one.answers) for one in logs)),
        "clients_cpu_share": own_s / wall_s,
        "odometry": odometry,
        "sessions": [figures(one, units, camera) for one in logs],
    }


def _filmed(
    folder: Path,
    seconds: float,
    seed: int,
    odometry: bool,
    cache_dir: Path | None,
    progress: Callable[[int, int], None] | None,
    config: FilmConfig,
) -> tuple[Sequence[Shot], Intrinsics, Units]:
    """Render a walk through a scene, which isn't kept in memory; return its frames, their camera, and the units."""
    loaded = LoadedScene.of(load_scene(folder), cache_dir=cache_dir)
    training = [named.camera for named in loaded.scene.cameras]
    if len(training) < 2:
        raise SceneNotFound("a walk needs a scene with two training cameras or more.", where=str(folder))
    units = units_of(training, lambda camera: centre_depth(loaded.rasterizer, camera))
    wide = training[0].intrinsics
    focal = 640 * wide.fx / wide.width
    camera = Intrinsics(640, 480, focal, focal, 320.0, 240.0)
    stations = [camera.pose for camera in training]
    film = make_film(stations, camera, loaded.rasterizer, units, seconds, seed, progress, config)
    if odometry:
        up = -np.sum([pose.world_from_camera[:3, 1] for pose in stations], 0)
        film = with_odometry(film, units, up / np.linalg.norm(up), seed)
    return film, camera, units


def play(
    film: Sequence[Shot], url: str, scene: str, sessions: int, camera: Intrinsics | None, seed: int,
    link: LinkConfig = LINK,
) -> list[SessionLog]:  # fmt: skip
    """Send a film in several sessions at once, each through a link of its own; return what each heard."""
    logs = [SessionLog(film) for _ in range(sessions)]
    rngs = np.random.default_rng(seed).spawn(sessions)
    given = None if camera is None else _as_sent(camera)
    threads = [
        threading.Thread(target=_session, args=(one, url, scene, given, rng, link))
        for one, rng in zip(logs, rngs, strict=True)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return logs


def _session(
    log: SessionLog,
    url: str,
    scene: str,
    intrinsics: dict[str, float] | None,
    rng: np.random.Generator,
    link: LinkConfig,
) -> None:
    # Not metric: a scene's scale would be known from its manifest.
    odometry = None if log.shots[0].odom is None else {"metric": False}
    with Live(url, scene, intrinsics=intrinsics, odometry=odometry, proxy=None) as live:
        start = time.perf_counter()
        listener = threading.Thread(target=_listen, args=(log, live, start))
        listener.start()
        arrives = 0.0
        for number, shot in enumerate(log.shots):
            delay = link.delay_s + rng.uniform(-link.spread_s, link.spread_s)
            if rng.random() < link.loss:
                continue
            arrives = max(arrives, shot.time_s + delay)
            time.sleep(max(0.0, start + arrives - time.perf_counter()))
            odom = None if shot.odom is None else shot.odom.world_from_camera.tolist()
            frame_id = live.send(shot.jpeg, shot.time_s, odom_from_camera=odom)
            log.sent_at[frame_id], log.shot_of[frame_id] = time.perf_counter() - start, number
        time.sleep(1.0)  # for the last answers
        live.close()
        listener.join()


def _listen(log: SessionLog, live: Live, start: float) -> None:
    with suppress(LiveClosed):
        while True:
            answer = live.answer()
            assert answer is not None
            log.answers[answer.id] = answer
            log.heard_at[answer.id] = time.perf_counter() - start
            if live.hint and log.hints[-1:] != [live.hint]:
                log.hints.append(live.hint)


# ------------------------------------------------------------------ the service


@contextmanager
def _service(folder: Path, cores: int, cache_dir: Path | None) -> Iterator[tuple[str, str]]:
    """Serve a scene in another process on so many processors; yield its URL and the scene's id."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    url = f"http://127.0.0.1:{port}"
    with TemporaryDirectory(prefix="splatfix-") as data:
        settings = {"DATA_DIR": data, "KEYS_FILE": str(Path(data) / "keys.json"), "VIEWER": "false"}
        if cache_dir:
            settings["CACHE_DIR"] = str(cache_dir)
        environment = os.environ | {f"SPLATFIX_{name}": value for name, value in settings.items()}
        command = [sys.executable, "-m", "service", "serve", str(folder), "--port", str(port)]
        process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL)
        try:
            keep_to_cores(process.pid, cores)
            yield url, _ready_scene(url)
        finally:
            process.terminate()
            process.wait()


def _ready_scene(url: str, timeout_s: float = 300.0) -> str:
    """Wait until the service listens and its scene is prepared; return the scene's id."""
    until = time.monotonic() + timeout_s
    while True:
        try:
            with Client(url) as client:
                (scene,) = client.scenes()
                client.wait_until_ready(scene.id, timeout_s=timeout_s)
            return scene.id
        except ServiceError as error:
            if error.code != "unreachable" or time.monotonic() > until:
                raise
            time.sleep(0.2)


def _warm_up(url: str, scene: str, film: Sequence[Shot], camera: Intrinsics) -> None:
    """Have some frames tracked, and the whole gate run: a process compiles and allocates at the first."""
    with Live(url, scene, intrinsics=_as_sent(camera), proxy=None) as live:
        tracked = 0
        for number in range(600):
            live.send(film[0].jpeg, number / 15)
            answer = live.answer(30.0)
            tracked += answer is not None and answer.mode == "tracking"
            if tracked > 30:
                return
            time.sleep(0.05)


def _as_sent(camera: Intrinsics) -> dict[str, float]:
    return {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}


def _cpu_s(url: str) -> float:
    """Return the processor time that the service has taken so far."""
    with build_opener(ProxyHandler({})).open(f"{url}/metrics", timeout=10) as answer:
        lines = answer.read().decode().splitlines()
    return float(next(line.split()[1] for line in lines if line.startswith("process_cpu_seconds_total")))


# ------------------------------------------------------------------ figures


def figures(log: SessionLog, units: Units, camera: Intrinsics) -> dict[str, Any]:
    """Return a session's figures.

    used_per_s: answered frames for each second in which frames came, beside the dark. right: of all frames that the
    scene can explain, lost and dropped ones included, those with a pose within 1 degree and 0.01 units. back_s: from
    the arrival of the first frame after an interruption to the first `localized` answer. With odometry a frame without
    an answer has the pose that the client knows by its odometry; `odometry_figures` has more.
    """
    shots, answers = log.shots, log.answers
    explained = [n for n, shot in enumerate(shots) if shot.truth is not None]
    answered = {log.shot_of[i]: answer for i, answer in answers.items()}
    off = {n: _errors(a, shots[n].truth, units) for n, a in answered.items() if a.world_from_camera}
    more = {}
    if shots[0].odom is not None:
        shown = displayed(shots, answers, log.heard_at)
        kept = {n: pose for n, pose in enumerate(shown) if pose is not None and n not in off}
        off |= {n: errors(pose, truth, units) for n, pose in kept.items() if (truth := shots[n].truth) is not None}
        more = odometry_figures(shots, answers, log.shot_of, shown, camera, units)
    tracked = [a for a in answers.values() if a.mode == "tracking"]
    times = [a.waited_ms + a.used_ms for a in tracked] or [np.nan]
    localized = {n for n, a in answered.items() if a.status == "localized"}
    used = [n for n in answered if shots[n].truth is not None]
    right = [n for n in explained if n in off and _within(off[n], FINE)]
    own = [n for n in right if n in answered]
    parts = {shot.part: [n for n in explained if shots[n].part == shot.part] for shot in shots if shot.truth}
    fps = 1 / np.median(np.diff([shot.time_s for shot in shots]))
    return {
        "sent": len(log.sent_at),
        "used_per_s": fps * len(used) / len(explained),
        "arrival_to_answer_ms_p50": float(np.percentile(times, 50)),
        "arrival_to_answer_ms_p95": float(np.percentile(times, 95)),
        "right": len(right) / len(explained),
        "right_of_answered": len(own) / max(1, len(used)),
        "localized": len(localized) / len(explained),
        "wrong_localized": sum(n in localized and not _within(error, COARSE) for n, error in off.items()),
        "right_by_part": {part: sum(n in set(right) for n in ns) / len(ns) for part, ns in parts.items()},
        "back_s": {part: _back_s(log, part, localized) for part in ("steady", "blurred", "jumped", "unlocked")},
        "hints": log.hints,
        **more,
    }


def _errors(answer: LiveAnswer, truth: Pose | None, units: Units) -> tuple[float, float]:
    """Return the errors in degrees and normalized units; infinite where the scene can't explain the frame."""
    if truth is None:
        return np.inf, np.inf
    return errors(Pose(np.array(answer.world_from_camera)), truth, units)


def _within(error: tuple[float, float], bounds: tuple[float, float]) -> bool:
    return error[0] <= bounds[0] and error[1] <= bounds[1]


def _back_s(log: SessionLog, part: str, localized: set[int]) -> float | None:
    """Return the time from the first frame's arrival in a part to the first localized answer; None: there is none."""
    ids = [i for i, n in log.shot_of.items() if log.shots[n].part == part]
    found = [log.heard_at[i] for i in ids if log.shot_of[i] in localized and i in log.heard_at]
    return min(found) - log.sent_at[ids[0]] if found else None
