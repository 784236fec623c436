"""The engine on a Ray cluster of this machine: what its contract (test_engine_contract.py) leaves open."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from api_server import GO_ON, events, finished, post, serving, settings, until, until_ready
from stand_ins import make_scene, packed, set_up_engine
from test_engine_contract import SLOW, query, ray_engine

from service.errors import SceneError
from service.jobs.embedded_engine import EmbeddedEngine, EngineConfig
from service.jobs.engine import EngineAnswer, EngineLost, HeldScenes, LocalizeTask
from service.photos.images import read_query
from service.results import StageTiming
from service.scene_manager.status import StoredScene
from service.web.app import create_app

pytestmark = pytest.mark.ci

CONFIG = EngineConfig("stepping", matcher="sift", rasterizer="cpu")
STUDIO = Path(__file__).parents[1] / "scenes" / "studio"


@pytest.fixture(scope="module")
def engine(plugins) -> Iterator:
    """Two replicas, each with `room`."""
    made = ray_engine(
        CONFIG,
        partial(set_up_engine, {"room": packed(make_scene())}, GO_ON),
    )
    made.start()
    yield made
    made.close()


@pytest.fixture
def service(engine, stepping) -> Iterator:
    """The API, which leaves the cluster running for the next test."""
    app = create_app(settings(crashes=2), engine)
    engine.close = lambda: None
    with serving(app) as client:
        until_ready(client)
        yield client
    del engine.close
    stepping.GO_ON.set()


def task(held: HeldScenes, name: str, **options) -> LocalizeTask:
    return LocalizeTask(name, held.token, "stepping", options, 7, None, query(), StageTiming("decode", 0.5, 0.25))


def pid_of(engine, replica) -> int:
    import ray

    return ray.get(replica.ping.remote())


def replicas(engine) -> list[str]:
    return sorted(engine._ask("heard", "a test"))


def test_a_replica_that_dies_costs_an_attempt_and_another_makes_the_next(engine, service):
    job = post(service, prefer="", options=SLOW).json()
    until(lambda: service.get(job["links"]["self"]).json()["records"] >= 2)
    before = replicas(engine)
    (running,) = engine._running.values()
    with service.stream("GET", job["links"]["events"], timeout=60) as stream:
        os.kill(pid_of(engine, running), signal.SIGKILL)
        told = events("".join(stream.iter_text()))
    restart = [name for name, _, _ in told].index("restarted")
    assert told[restart][2] == {"attempt": 2}
    assert [number for _, number, _ in told[restart + 1 :]] == [*(f"2.{k}" for k in range(20)), "end"]
    assert finished(service, job["links"]["self"])["state"] == "succeeded"
    until(lambda: len(replicas(engine)) == 2, 60)  # another one is started in its place
    assert replicas(engine) != before


def test_a_cancel_takes_effect_within_one_step(engine, service):
    job = post(service, prefer="", options={"steps": 200, "pause_s": 0.05}).json()
    until(lambda: service.get(job["links"]["self"]).json()["records"] >= 2)
    began = time.monotonic()
    records = service.delete(job["links"]["self"]).json()["records"]
    done = finished(service, job["links"]["self"])
    assert done["state"] == "cancelled"
    assert done["records"] <= records + 2
    assert time.monotonic() - began < 2
    until(lambda: engine.scene("room").jobs == 0)  # what it held is free


def test_jobs_are_spread_over_the_replicas(engine, service):
    GO_ON.clear()
    held = [engine.hold("room") for _ in range(4)]
    assert sorted(engine._ask("heard", "a test").values()) == [2, 2]
    for one in held:
        engine.release(one.token)
    until(lambda: not any(engine._ask("heard", "a test").values()))
    assert sorted(engine._ask("heard", "a test").values()) == [0, 0]


def test_without_its_coordinator_the_engine_is_started_again(engine, service):
    import ray

    before = replicas(engine)
    lost = engine._coordinator
    ray.kill(lost)
    with suppress(SceneError):  # unless the heartbeat has found out first
        engine.scenes()
    until(lambda: engine._coordinator is not lost, 60)
    until(lambda: service.get("/readyz").status_code == 200, 60)
    assert len(replicas(engine)) == len(before)
    job = post(service, prefer="wait=30", options={"steps": 3}).json()
    assert job["state"] == "succeeded"


def test_what_waits_for_a_cluster_that_is_left_ends_at_once(engine, service, monkeypatch):
    """As after a kill of its head; Ray raises SystemExit in the threads that wait, which would end those of workers."""
    from ray.exceptions import RayError

    from service.jobs.ray_calls import stream

    job = post(service, prefer="", options={"steps": 200, "pause_s": 0.1}).json()
    until(lambda: service.get(job["links"]["self"]).json()["records"] >= 2)
    (running,) = engine._running.values()
    before, connect, seen = engine._coordinator, engine._connect, []
    held = engine.hold("room")
    records = stream(
        engine._held[held.token].replica.localize, task(held, "between two records", steps=200, pause_s=0.1), held
    )
    next(records)

    def lost() -> None:
        monkeypatch.setattr(engine, "_connect", connect)
        raise RayError("the cluster does not know this process.")

    def call(ask) -> None:
        try:
            while True:
                ask()
        except BaseException as error:
            seen.append(error)

    monkeypatch.setattr(engine, "_connect", lost)
    asks = [partial(engine._call_replica, running, "readiness"), partial(engine._ask, "scenes")]
    threads = [threading.Thread(target=call, args=(ask,), daemon=True) for ask in asks * 2]
    for thread in threads:
        thread.start()
    engine._connect_again(before, RayError("lost"))  # leaves the cluster, and starts another
    until(lambda: len(seen) == len(threads), 5)
    assert [error for error in seen if not isinstance(error, Exception)] == []
    with pytest.raises(EngineLost):  # Ray would end the process
        next(records)
    engine.release(held.token)
    until(lambda: service.get(job["links"]["self"]).json()["attempt"] == 2, 30)
    service.delete(job["links"]["self"])
    finished(service, job["links"]["self"])


def test_nobody_joins_the_cluster_without_its_token(engine):
    import ray

    code = f"import ray; ray.init(address={ray.get_runtime_context().gcs_address!r}); print('joined')"
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | {"RAY_AUTH_TOKEN": "0" * 64}, capture_output=True, text=True
    )
    assert "joined" not in done.stdout
    assert "AuthenticationError" in done.stderr


def test_the_demo_photos_are_localized_as_by_the_embedded_engine(engine):
    own = EmbeddedEngine(CONFIG)
    for one in (own, engine):
        one.add(StoredScene("studio", STUDIO))
    own.start()
    held = [_held(one) for one in (own, engine)]
    for name in sorted(STUDIO.glob("photos/*.jpg"))[:2]:
        photo = read_query(name.read_bytes())
        answers = [_localized(one, photo, token) for one, token in zip((own, engine), held, strict=True)]
        first, second = (answer.result.estimate for answer in answers)
        assert np.array_equal(first.pose.world_from_camera, second.pose.world_from_camera)
        assert first.verdict.score == second.verdict.score
        assert np.array_equal(first.verdict.covariance, second.verdict.covariance)
        assert (first.intrinsics, first.renders, first.warnings) == (second.intrinsics, second.renders, second.warnings)
    engine.release(held[1].token)
    until(lambda: engine.scene("studio").jobs == 0)  # the coordinator hears of it a little later
    engine.remove("studio")
    own.close()


def _held(engine) -> HeldScenes:
    found: list = []
    engine.hold_later("studio", found.append)
    until(lambda: found, 90)
    until(lambda: engine.scene("studio").state == "ready", 90)
    return found[0]


def _localized(engine, photo, held: HeldScenes) -> EngineAnswer:
    made = LocalizeTask("t", held.token, "view_index", {}, 7, None, photo, StageTiming("decode", 0.5, 0.25))
    return engine.localize(made, lambda record, shown: None)
