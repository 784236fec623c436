"""What a front does about the jobs of others, and what a replica does for it; with stand-ins for stores and engine."""

from __future__ import annotations

import asyncio
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from memory_stores import MemoryJobStore, MemoryPhotoStore
from test_store_contracts import FAILURE, NONE, new_job, record

from service.errors import CorruptScene, SceneNotFound, StorageFailed
from service.jobs import left_over_photos, shared_jobs
from service.jobs.engine import HeldScenes
from service.jobs.left_over_photos import LeftOverPhotos
from service.jobs.live_job import LiveJob
from service.jobs.model import Batch, Ending, JobSpec, StoredJob
from service.jobs.replica import Replica, _portable, _streamed
from service.jobs.shared_jobs import SharedJobs
from service.scene_manager.status import AUTO, SceneReadiness, SceneStatus, StoredScene


class Clock:
    """A monotonic clock that goes when it is told."""

    def __init__(self) -> None:
        self.now = 1000.0

    def monotonic(self) -> float:
        return self.now


class Engine:
    """Notes what it is told."""

    def __init__(self) -> None:
        self.cancelled: list[str] = []
        self.released: list[str] = []
        self.known = ["s"]

    def cancel(self, task_id: str) -> None:
        self.cancelled.append(task_id)

    def release(self, token: str) -> None:
        self.released.append(token)

    def scenes(self) -> list[str]:
        return self.known

    def scene(self, scene_id: str | None) -> None:
        if scene_id not in self.known:
            raise SceneNotFound("unknown.", where="scene")


@pytest.fixture
def front(monkeypatch: pytest.MonkeyPatch) -> Any:
    """One front's view of a store that others use, too."""
    clock, store, engine = Clock(), MemoryJobStore(), Engine()
    monkeypatch.setattr(shared_jobs, "time", clock)
    worker: Any = SimpleNamespace(live={}, busy=Counter(), running=set(), lost=None, noted=[])
    worker.note_storage = worker.noted.append
    withdrawn: list[str] = []
    queue = SimpleNamespace(idle=lambda: made.idle, withdraw=lambda live: withdrawn.append(live.id))
    taken: list[str] = []
    watch = SimpleNamespace(wait=lambda seconds: set(), close=lambda: None)
    shared: Any = SharedJobs(watch, store, engine, queue, worker, lambda job: taken.append(job.id))  # type: ignore[arg-type]
    made = SimpleNamespace(
        clock=clock, store=store, engine=engine, worker=worker, shared=shared, taken=taken, withdrawn=withdrawn, idle=2
    )
    return made


def accepted(front: Any, name: str = "j", **changes: Any) -> StoredJob:
    return front.store.accept(new_job(name, **changes))


# ------------------------------------------------------------------ following jobs of others


def test_a_followed_job_goes_on_as_in_the_store(front):
    job = accepted(front)
    live = front.shared.follow(job)
    assert (live.attempt, live.records, live.ended.is_set()) == (0, [], False)
    front.store.claim(job, 9e9)
    front.store.append("j", 1, Batch(0, (record("match"), record("refine", 1))))
    front.shared._look({"j"})
    assert (live.attempt, [r.step.stage for r in live.records]) == (1, ["match", "refine"])
    front.store.append("j", 1, Batch(2, (record("verify", 2),)))
    front.clock.now += 0.9
    front.shared._look({"other"})
    assert len(live.records) == 2
    front.clock.now += 0.1  # once a second it is looked at all
    front.shared._look({"other"})
    assert len(live.records) == 3
    # The attempt was lost: another begins without its records.
    front.store.requeue("j", 1)
    front.store.claim(front.store.get("j"), 9e9)
    front.shared._look({"j"})
    assert (live.attempt, live.records) == (2, [])
    assert front.shared.follow(job) is live
    front.store.finish("j", 2, NONE, Ending("failed", failure=FAILURE), None)
    front.shared._look({"j"})
    assert live.ended.is_set()
    assert front.shared.adopt("j") is None


def test_a_job_that_is_deleted_has_ended_for_those_who_follow(front):
    live = front.shared.follow(accepted(front))
    front.store.end_queued(front.store.get("j"), Ending("cancelled"), None)
    front.store.delete("j")
    front.shared._look({"j"})
    assert live.ended.is_set()
    assert front.shared.adopt("j") is None


def test_an_adopted_job_is_not_followed_any_more(front):
    live = front.shared.follow(accepted(front))
    assert front.shared.adopt("j") is live
    assert front.shared.adopt("j") is None


def test_a_job_that_nobody_listens_to_is_followed_for_five_seconds(front):
    live = front.shared.follow(accepted(front))
    front.clock.now += 5.0
    front.shared._look(set())
    assert "j" in front.shared._followed
    live._listeners.add(lambda: None)
    front.clock.now += 9.0
    front.shared._look(set())
    live._listeners.clear()
    front.clock.now += 4.9
    front.shared._look(set())
    assert "j" in front.shared._followed
    front.clock.now += 1.1
    front.shared._look(set())
    assert "j" not in front.shared._followed
    assert front.shared._heard == {}


def test_closing_ends_what_is_followed(front):
    live = front.shared.follow(accepted(front))
    closed: list[bool] = []
    front.shared._watch.close = lambda: closed.append(True)
    front.shared.close()
    assert closed == [True]
    assert live.ended.is_set()


def test_the_listening_goes_on_after_any_error(front):
    """It ends with the service; what fails is noted where it is the store's."""
    failures: list[Exception] = [StorageFailed("full."), SceneNotFound("x.", where="scene"), ValueError("a bug")]
    paused: list[float] = []

    def wait(seconds: float) -> set[str]:
        assert seconds == 1.0
        if failures:
            raise failures.pop(0)
        front.shared._closing.set()
        return set()

    front.shared._watch.wait = wait
    front.shared._closing.wait = paused.append
    front.shared._run()
    assert [str(error) for error in front.worker.noted] == ["full."]
    assert paused == [1.0, 1.0]


# ------------------------------------------------------------------ own jobs that others change


def own(front: Any, *, held: str | None = None) -> tuple[StoredJob, LiveJob]:
    job = accepted(front)
    live = front.worker.live[job.id] = LiveJob(job.id, job.scene, None, held and SimpleNamespace(token=held))  # type: ignore[arg-type]
    return job, live


def test_a_job_that_is_not_ours_any_more_is_let_go_and_followed(front):
    _, live = own(front, held="token")
    front.worker.lost(live)
    assert front.withdrawn == ["j"]
    assert front.worker.live == {}
    assert front.engine.released == ["token"]
    assert (live.held, live.photo, live.shown) == (None, None, None)
    assert front.shared.adopt("j") is live
    front.worker.lost(LiveJob("j", "s"))
    assert front.engine.released == ["token"]


def test_a_job_that_waits_here_and_was_made_elsewhere_is_let_go(front):
    job, live = own(front)
    front.shared._check_own(live)
    assert front.worker.live
    front.store.claim(job, 9e9)
    live.begin(1)
    front.shared._check_own(live)
    assert front.worker.live  # the attempt is ours
    live.begin(0)
    front.shared._look({"j"})
    assert not front.worker.live
    assert front.shared._followed["j"].attempt == 1


@pytest.mark.parametrize("end", ["ended", "deleted"])
def test_a_job_that_waits_here_and_has_ended_elsewhere_is_let_go(front, end):
    job, live = own(front)
    front.store.end_queued(job, Ending("cancelled"), None)
    if end == "deleted":
        front.store.delete("j")
    front.shared._look({"j"})
    assert not front.worker.live
    assert live.ended.is_set()


def test_a_job_that_was_cancelled_elsewhere_is_cancelled_once_here(front):
    job, live = own(front)
    front.store.claim(job, 9e9)
    live.begin(1)
    front.store.request_cancel("j")
    for _ in range(2):
        front.shared._check_own(live)
    assert live.cancelled.is_set()
    assert front.engine.cancelled == ["j.1"]


@pytest.mark.parametrize(("running", "cancelled"), [({("j", 1)}, ["j.1"]), (set(), []), ({("j", 2)}, [])])
def test_an_attempt_that_runs_here_ends_where_another_front_makes_the_next(front, running, cancelled):
    job, live = own(front)
    front.store.claim(job, 9e9)
    live.begin(1)
    front.worker.busy["j"], front.worker.running = 1, running
    front.shared._check_own(live)
    assert front.engine.cancelled == []
    front.store.requeue("j", 1)
    front.store.claim(front.store.get("j"), 9e9)
    front.shared._check_own(live)
    assert front.engine.cancelled == cancelled
    assert front.worker.live  # whoever is at it finds out by itself
    front.worker.live.clear()
    front.worker.busy.clear()
    front.shared._check_own(live)  # it has ended meanwhile
    assert front.withdrawn == []


# ------------------------------------------------------------------ taking what waits


def test_what_waits_elsewhere_is_taken_at_the_second_look_by_idle_workers(front):
    for name in "abc":
        accepted(front, name)
    accepted(front, "unknown", scene="t")
    front.worker.live["a"] = LiveJob("a", "s")
    front.shared._look(set())
    assert front.taken == []
    front.clock.now += 1.0
    front.idle = 1
    front.shared._look(set())
    assert front.taken == ["b"]
    front.clock.now += 0.9
    front.shared._look(set())
    assert front.taken == ["b"]
    front.idle = 0
    front.clock.now += 0.1
    front.shared._look(set())
    front.idle = 9
    front.clock.now += 1.0
    front.shared._look(set())
    assert front.taken == ["b"]  # looked at anew
    front.clock.now += 1.0
    front.shared._look(set())
    assert front.taken == ["b", "b", "c"]


@pytest.mark.parametrize(
    ("asked", "known", "knows"),
    [
        ("s", ["s"], True),
        ("t", ["s"], False),
        (("s", "t"), ["s", "t"], True),
        (("s", "t"), ["s"], False),
        (AUTO, ["x"], True),
        (AUTO, [], False),
    ],
)
def test_only_jobs_whose_scenes_are_known_are_taken(front, asked, known, knows):
    front.engine.known = known
    scene = asked if isinstance(asked, str) and asked != AUTO else "s"
    job = accepted(front, scene=scene, spec=replace(JobSpec("e"), scene=asked))
    assert front.shared.knows_scenes(job) is knows


# ------------------------------------------------------------------ photos that are left over


def test_photos_that_crashes_have_left_are_deleted_at_the_second_look(monkeypatch):
    clock, store, photos = Clock(), MemoryJobStore(), MemoryPhotoStore()
    clock.now = 0.0
    monkeypatch.setattr(left_over_photos, "time", clock)
    jobs = {name: store.accept(new_job(name)) for name in ("queued", "running", "ended", "shown")}
    store.claim(jobs["running"], 9e9)
    for name in ("ended", "shown"):
        store.end_queued(jobs[name], Ending("cancelled"), None)
    for name in ("queued", "running", "ended", "none"):
        photos.accept(name, b"photo")
    photos.accept("shown", b"photo")
    photos.discard_original("shown", b"jpeg")
    left = LeftOverPhotos(store, photos)
    left.delete_old()
    assert photos.ids() == {"queued", "running", "ended", "none", "shown"}
    photos.accept("later", b"photo")
    clock.now = 599.0
    left.delete_old()
    assert photos.ids() == {"queued", "running", "ended", "none", "shown", "later"}
    clock.now = 600.0
    left.delete_old()
    assert photos.ids() == {"queued", "running", "shown", "later"}
    clock.now = 1200.0
    left.delete_old()
    assert photos.ids() == {"queued", "running", "shown"}
    # At the start nobody else uses the stores.
    photos.accept("none", b"photo")
    LeftOverPhotos(store, photos).delete()
    assert photos.ids() == {"queued", "running", "shown"}
    assert photos.with_original() == {"queued", "running"}


# ------------------------------------------------------------------ a replica


class ReplicaEngine(Engine):
    """An engine whose scenes are ready at the third look."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[tuple[str, Any]] = []
        self.there = {"w": SceneStatus("w", "ready")}
        self.looks = 0
        self.found: Any = HeldScenes("own", ("x",), (0.0, 0.0, 0.0))

    def readiness(self) -> SceneReadiness:
        self.looks += 1
        return SceneReadiness(True, ("w",) if self.looks < 3 else (), (), (), ())  # type: ignore[arg-type]

    def scenes(self) -> list[SceneStatus]:  # type: ignore[override]
        return list(self.there.values())

    def scene(self, scene_id: str | None) -> SceneStatus:  # type: ignore[override]
        self.looks += 1
        return SceneStatus("x", ("loading", "preparing", "ready")[min(self.looks, 2)])

    def add(self, scene: StoredScene) -> None:
        self.calls.append(("add", scene.id))
        self.there[scene.id] = SceneStatus(scene.id, "ready")

    def load(self, scene_id: str) -> None:
        self.calls.append(("load", scene_id))

    def unload(self, scene_id: str) -> None:
        if scene_id not in self.there:
            raise SceneNotFound("unknown.", where="scene")
        self.calls.append(("unload", scene_id))

    def remove(self, scene_id: str) -> None:
        del self.there[scene_id]

    def hold_later(self, asked: Any, take: Any) -> None:
        self.calls.append(("hold", asked))
        take(self.found)


@pytest.fixture
def replica() -> Any:
    made: Any = Replica.__new__(Replica)
    made._engine, made._held, made._frames = ReplicaEngine(), {}, {}
    return made


def test_a_replica_waits_until_its_scenes_are_prepared(replica):
    assert [status.id for status in asyncio.run(replica.built_in())] == ["w"]
    assert replica._engine.looks == 3
    replica._engine.looks = -1
    asyncio.run(replica.prepared("x"))
    assert replica._engine.looks == 2


def test_a_replica_drops_loads_and_holds_what_it_is_told(replica):
    stored = [StoredScene(name, Path(name)) for name in ("w", "x")]
    found, statuses = asyncio.run(replica.hold("t", ["gone"], stored, ("x",)))
    assert replica._engine.calls == [("load", "w"), ("add", "x"), ("load", "x"), ("hold", "x")]
    assert ((found.token, found.ids), [status.id for status in statuses]) == (("t", ("x",)), ["x"])
    replica._engine.calls.clear()
    replica._engine.found = CorruptScene("it is torn.", where="scene")
    found, _ = asyncio.run(replica.hold("u", ["x"], [], ("w", "y")))
    assert replica._engine.calls == [("unload", "x"), ("hold", ("w", "y"))]
    assert isinstance(found, CorruptScene)
    assert set(replica._held) == {"t"}
    assert set(replica._engine.there) == {"w"}


def test_letting_go_of_scenes_ends_what_runs_with_them(replica):
    async def run() -> None:
        await replica.hold("token", [], [], ("x",))
        replica._held["token"].attempts.add("j.1")
        assert [status.id for status in await replica.release("token", ("w",))] == ["w"]
        assert await replica.release("other", ("y",)) == []  # isn't known: without effect
        await replica.cancel("k.1")

    asyncio.run(run())
    assert (replica._engine.cancelled, replica._engine.released) == (["j.1", "k.1"], ["own"])
    assert replica._held == {}


def test_attempts_are_noted_while_they_run(replica):
    noted: list[Any] = []

    def localize(task: Any, put: Any) -> str:
        noted.append((task.held, replica._held["token"].attempts.copy()))
        put("a record", "a photo")
        return "the answer"

    async def run() -> list[Any]:
        await replica.hold("token", [], [], ("x",))
        task = HeldTask("token", "j.1")
        return [message async for message in replica.localize(task, held("token"))]

    replica._engine.localize = localize
    assert asyncio.run(run()) == [([("a record", "a photo")], "the answer")]
    assert noted == [("own", {"j.1"})]
    assert replica._held["token"].attempts == set()
    assert replica._engine.released == []


def test_a_live_session_gets_its_frames_and_ends(replica):
    def live(task: Any, next_frame: Any, tell: Any) -> None:
        while (frame := next_frame()) is not None:
            tell(f"answer to {frame} with {task.held}")

    async def run() -> list[Any]:
        await replica.hold("token", [], [], ("x",))
        heard, left = [], ["a", "b", None]
        async for message in replica.live("session", HeldTask("token"), held("token")):
            heard.append(message)
            if message[0] == "frame?":
                await replica.frame("session", left.pop(0))
        await replica.frame("session", None)  # is over: without effect
        return heard

    replica._engine.live = live
    asked = ("frame?", None)
    assert asyncio.run(run()) == [
        asked, ("record", "answer to a with own"), asked, ("record", "answer to b with own"), asked, ("answer", None)
    ]  # fmt: skip
    assert replica._frames == {}


def held(token: str) -> HeldScenes:
    return HeldScenes(token, ("x",), (0.0, 0.0, 0.0))


@dataclass
class HeldTask:
    held: str
    id: str = ""


class Awkward(Exception):
    """Can't be copied."""

    def __init__(self, a: int, b: int) -> None:
        super().__init__("awkward")


def test_errors_of_a_replica_can_be_sent(replica):
    error = SceneNotFound("unknown.", where="scene")
    assert (type(_portable(error)), str(_portable(error))) == (SceneNotFound, str(error))
    assert repr(_portable(Awkward(1, 2))) == "RuntimeError('Awkward: awkward')"

    def fail(*_: object) -> None:
        raise Awkward(1, 2)

    async def streamed() -> None:
        async for _ in _streamed(fail):
            pass

    replica._engine.fail = fail
    for call in (streamed(), replica.ask("fail")):
        with pytest.raises(RuntimeError, match="awkward"):
            asyncio.run(call)  # type: ignore[arg-type]
    replica._engine.sum = lambda a, b: a + b
    assert asyncio.run(replica.ask("sum", 1, 2)) == 3
