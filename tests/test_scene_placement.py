"""Where scenes go: the table's decisions, and the coordinator that carries them out, on replicas of this test."""

from __future__ import annotations

import asyncio
import threading
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from service.bench.fleet_simulation import FleetModel, FleetSimulation
from service.errors import (
    BadInput,
    CorruptScene,
    SceneInUse,
    SceneNotFound,
    SceneNotReady,
    SceneTooLarge,
    SceneUnloaded,
)
from service.jobs.embedded_engine import EngineConfig
from service.jobs.engine import HeldScenes
from service.jobs.placement import Choice, Placement, PlacementConfig
from service.jobs.replica import Replica
from service.jobs.scene_coordinator import SceneCoordinator
from service.scene_manager.status import AUTO, SceneReadiness, SceneStatus, StoredScene

MB = 1_000_000


def placement(budget: int | None = None, replicas: str = "ab", **sizes: int) -> Placement:
    made = Placement(PlacementConfig(budget, service_s=0.1, load_s=1.0, load_bytes_per_s=100 * MB))
    for name in replicas:
        made.add_replica(name)
    for scene, size in sizes.items():
        made.expect(scene, size)
    return made


def run_job(table: Placement, *scenes: str, keep: bool = False) -> Choice:
    choice = table.choose(scenes)
    assert choice is not None
    table.take(choice, scenes)
    for scene in choice.load:
        table.loaded(choice.replica, scene, table.size(scene))
    if not keep:
        table.release(choice.replica, scenes)
    return choice


def test_a_job_goes_where_its_scene_is():
    table = placement()
    assert run_job(table, "x") == Choice("a", ("x",), ())
    assert run_job(table, "y").load == ("y",)
    assert {run_job(table, "x") for _ in range(20)} == {Choice("a", (), ())}


def test_a_long_queue_is_worth_another_copy_and_a_short_one_is_not():
    """A load takes 1 s and counts twice, a job takes 0.1 s: the copy pays with more than twenty jobs before it."""
    table = placement()
    run_job(table, "x")
    choices = [run_job(table, "x", keep=True) for _ in range(24)]
    assert [choice.load for choice in choices] == [()] * 21 + [("x",)] + [()] * 2
    assert {choice.replica for choice in choices[:21]} == {"a"}
    assert {choice.replica for choice in choices[21:]} == {"b"}


def test_a_crowded_scene_gets_a_copy_beside_and_a_burst_does_not():
    table = placement(250, x=100, y=100, z=100)
    run_job(table, "x")
    held = []
    for _ in range(12):  # a burst
        held.append(run_job(table, "x", keep=True).replica)
        assert table.extra_copy("x") is None
    extra = None
    for _ in range(30):  # as many wait all the time
        table.release(held.pop(0), ("x",))
        held.append(run_job(table, "x", keep=True).replica)
        if extra := table.extra_copy("x"):
            break
    assert extra == Choice("b", ("x",), ())
    table.take(extra, ("x",))
    assert table.extra_copy("x") is None  # one at a time
    table.loaded("b", "x", 100)
    table.release("b", ("x",))
    assert [run_job(table, "x", keep=True).replica for _ in range(8)] == ["b"] * 8  # until both have as many


@pytest.mark.parametrize(("megabytes", "jobs"), [(0, 40), (100, 60), (300, 100)])
def test_a_copy_costs_two_seconds_and_reading_twice_and_a_job_a_tenth_of_one(megabytes, jobs):
    table = Placement(PlacementConfig())
    for name in "ab":
        table.add_replica(name)
    table.expect("x", megabytes * MB)
    run_job(table, "x")
    # The last of these jobs finds as many before it as would take the time of a copy.
    choices = [run_job(table, "x", keep=True) for _ in range(jobs + 2)]
    assert [bool(choice.load) for choice in choices] == [False] * (jobs + 1) + [True]


def test_an_only_copy_is_missed_as_long_as_its_load_would_be_a_tenth_of_the_jobs_since():
    """Loading 100 MB takes two seconds, which are twenty jobs: as much as a tenth of 200 jobs."""
    table = placement(x=100 * MB, y=0)
    run_job(table, "x")
    for _ in range(199):
        run_job(table, "y")
    assert table._is_missed("x")
    run_job(table, "y")
    assert not table._is_missed("x")
    table.take(Choice("b" if "x" in table.scenes("a") else "a", ("x",), ()), ("x",))
    assert not table._is_missed("x")  # there is another


def test_a_scene_is_crowded_beyond_five_jobs_in_a_mean_of_some_ten():
    """Ten jobs before each from now on: the mean is 10 (1 - 0.9^n), which is beyond 5 at the seventh."""
    table = Placement(PlacementConfig())
    for name in "ab":
        table.add_replica(name)
    run_job(table, "x")
    for _ in range(11):
        run_job(table, "x", keep=True)
    table._queues.clear()
    extra = []
    for _ in range(7):
        table.release("a", ("x",))
        run_job(table, "x", keep=True)
        extra.append(table.extra_copy("x") is not None)
    assert extra == [False] * 6 + [True]


def test_what_was_used_longest_ago_makes_room():
    table = placement(250, "a", w=100, x=100, y=100, z=100)
    run_job(table, "w")
    run_job(table, "x")
    run_job(table, "w")
    assert run_job(table, "y") == Choice("a", ("y",), ("x",))


def test_scenes_in_use_stay_and_the_job_waits():
    table = placement(250, "a", w=100, x=100, y=100)
    first, second = run_job(table, "w", keep=True), run_job(table, "x", keep=True)
    assert table.choose(("y",)) is None
    assert table.choose(("w",)) is not None
    table.release(second.replica, ("x",))
    assert table.choose(("y",)) == Choice("a", ("y",), ("x",))
    table.release(first.replica, ("w",))


def test_scenes_that_are_needed_together_come_together():
    table = placement(250, w=100, x=100, y=100)
    run_job(table, "w")
    run_job(table, "x")
    choice = run_job(table, "w", "x", "x")
    assert set(table.scenes(choice.replica)) >= {"w", "x"}
    assert not table.could_hold(("w", "x", "y"))
    assert placement(300, w=100, x=100, y=100).could_hold(("w", "x", "y"))


def test_what_a_scene_really_takes_counts():
    table = placement(250, "a", w=100, x=100)
    run_job(table, "w")
    choice = table.choose(("x",))
    table.take(choice, ("x",))
    assert table.loaded("a", "x", 240) == ("w",)
    assert list(table.scenes("a")) == ["x"]
    table.dropped("a", "x")
    assert table.size("x") == 240


def test_each_byte_of_the_budget_counts():
    for budget, dropped in ((300, ()), (299, ("v",)), (200, ("v",)), (199, ("v", "w")), (100, ("v", "w")), (99, None)):
        table = placement(None, "a", v=100, w=100, x=100)
        run_job(table, "v")
        run_job(table, "w")
        table._config = PlacementConfig(budget)
        choice = table.choose(("x",))
        assert (choice and choice.drop) == dropped, budget


def test_where_the_likely_replicas_are_full_any_other_may_have_room():
    """Ten replicas, of which the one with most jobs is the only one whose scene leaves room."""
    table = placement(100, "abcdefghij", small=1, x=99, **{f"s{k}": 100 for k in range(9)})
    busy = [run_job(table, "small", keep=True).replica for _ in range(3)]
    assert len(set(busy)) == 1
    for k in range(9):
        run_job(table, f"s{k}", keep=True)
    assert table.choose(("x",)) == Choice(busy[0], ("x",), ())


def test_nothing_is_left_of_a_replica_that_is_gone():
    table = placement()
    choice = run_job(table, "x", keep=True)
    table.remove_replica(choice.replica)
    table.release(choice.replica, ("x",))
    assert table.copies("x") == {}
    assert run_job(table, "x").replica == "b"


def test_the_budget_holds_and_loads_are_few_whatever_is_asked_for():
    """Bursts of 12 for one of 8 scenes, room for 3 in each of 2 replicas: 200 requests, 4 of a burst at a time."""
    table = placement(3 * MB, **{f"s{k}": MB for k in range(8)})
    rng = np.random.default_rng(0)
    requests = [f"s{scene}" for scene in rng.integers(0, 8, 17) for _ in range(12)][:200]
    held: list[tuple[str, str]] = []
    loads, there, found = 0, 0, 0
    for scene in requests:
        was_there = set(table.copies(scene))
        choice = run_job(table, scene, keep=True)
        held.append((choice.replica, scene))
        loads += len(choice.load)
        there += bool(was_there)
        found += choice.replica in was_there
        for name in table.replicas():
            assert sum(copy.bytes for copy in table.scenes(name).values()) <= 3 * MB
        assert all(scene in table.scenes(name) for name, scene in held)  # in use: never dropped
        if len(held) > 4:
            table.release(held[0][0], (held[0][1],))
            del held[0]
    assert found >= 0.9 * there  # seen: all
    assert loads <= 1.2 * fewest_loads(requests, 6)  # seen: 9, of 9


def fewest_loads(requests: list[str], room: int) -> int:
    """Return how many loads the best sequence has that knows all requests (Belady), with one memory for so many."""
    there: set[str] = set()
    loads = 0
    for number, scene in enumerate(requests):
        if scene in there:
            continue
        loads += 1
        if len(there) == room:
            later = requests[number:]
            there.remove(max(there, key=lambda other: later.index(other) if other in later else len(later)))
        there.add(scene)
    return loads


# ------------------------------------------------------------------ the coordinator


class Lost(Exception): ...


class Method:
    def __init__(self, function) -> None:
        self._function = function

    def remote(self, *arguments):
        return asyncio.ensure_future(self._function(*arguments))


class FakeReplica:
    """Counts loads; each takes until `go_on` is set."""

    def __init__(self) -> None:
        self.scenes: set[str] = set()
        self.loads: list[str] = []
        self.held: dict[str, tuple[str, ...]] = {}
        self.dead, self.size, self.go_on = False, 100, asyncio.Event()
        self.go_on.set()
        self.answer = asyncio.Event()
        self.answer.set()

    def __getattr__(self, name: str) -> Method:
        async def call(*arguments):
            if self.dead:
                raise Lost
            found = await getattr(self, f"_{name}")(*arguments)
            if self.dead:
                raise Lost
            return found

        return Method(call)

    async def _built_in(self) -> list[SceneStatus]:
        return []

    async def _ping(self) -> int:
        return 1

    async def _readiness(self) -> SceneReadiness:
        return SceneReadiness(True, (), (), ("fake",), ())

    async def _prepared(self, scene_id: str) -> None: ...

    async def _ask(self, name: str, scene_id: str) -> SceneStatus:
        return SceneStatus(scene_id, "ready", memory_bytes=100)

    async def _drop(self, ids) -> None:
        assert not {i for held in self.held.values() for i in held} & set(ids), "dropped in use"
        self.scenes -= set(ids)

    async def _hold(self, token, drop, stored, ids):
        await self._drop(drop)
        fresh = [scene.id for scene in stored if scene.id not in self.scenes]
        self.scenes |= set(fresh)
        self.loads += fresh
        await self.go_on.wait()
        if "torn" in ids:
            self.scenes.discard("torn")
            return CorruptScene("it is torn.", where="scene"), [SceneStatus("torn", "failed")]
        self.held[token] = tuple(ids)
        statuses = [SceneStatus(i, "ready", memory_bytes=100) for i in ids]
        return HeldScenes(token, tuple(ids), (0.0, 0.0, 0.0)), statuses

    async def _release(self, token: str, ids) -> list[SceneStatus]:
        self.held.pop(token, None)  # one that no job has used isn't held here
        statuses = [SceneStatus(i, "ready", memory_bytes=self.size) for i in ids if i in self.scenes]
        await self.answer.wait()
        return statuses


class Fleet:
    def __init__(self, budget: int | None) -> None:
        self.replicas: list[FakeReplica] = []
        self.coordinator = SceneCoordinator(self._spawn, (Lost,), PlacementConfig(budget), lambda scene: 100)

    def _spawn(self) -> FakeReplica:
        self.replicas.append(FakeReplica())
        return self.replicas[-1]

    @property
    def loads(self) -> list[str]:
        return [scene for replica in self.replicas for scene in replica.loads]


def with_fleet(check, budget: int | None = 250, replicas: int = 2, scenes: str = "wxyz") -> None:
    async def run() -> None:
        fleet = Fleet(budget)
        for name in [*scenes, "torn"]:
            await fleet.coordinator.add(StoredScene(name, Path(name)), False)
        await fleet.coordinator.start(replicas)
        await check(fleet, fleet.coordinator)
        for task in tuple(fleet.coordinator._tasks):
            task.cancel()

    asyncio.run(run())


def test_a_load_is_made_once_for_all_who_wait():
    async def check(fleet: Fleet, coordinator: SceneCoordinator) -> None:
        for replica in fleet.replicas:
            replica.go_on.clear()
        waiting = [asyncio.ensure_future(coordinator.hold_later("f", "x")) for _ in range(8)]
        await asyncio.sleep(0.01)
        for replica in fleet.replicas:
            replica.go_on.set()
        held = await asyncio.gather(*waiting)
        assert fleet.loads == ["x"]
        assert len({found.held.token for found in held}) == 8
        assert (await coordinator.scene("x")).jobs == 8
        with pytest.raises(SceneInUse):
            await coordinator.remove("x")
        for found in held:
            await coordinator.release(found.held.token)
        listed, _ = await asyncio.gather(coordinator.scenes(), coordinator.remove("x"))
        assert "x" in {scene.id for scene in listed}  # as they were when they were asked for
        assert fleet.replicas[0].scenes == set()
        with pytest.raises(SceneNotFound):
            await coordinator.hold("f", "x")

    with_fleet(check)


def test_a_scene_in_memory_is_held_without_its_replica():
    async def check(fleet: Fleet, coordinator: SceneCoordinator) -> None:
        await coordinator.release((await coordinator.hold_later("f", "x")).held.token)
        (replica,) = fleet.replicas
        replica.go_on.clear()
        held = await asyncio.wait_for(coordinator.hold("f", "x"), 5)
        assert (await coordinator.scene("x")).jobs == 1
        with pytest.raises(SceneInUse):
            await coordinator.remove("x")
        assert replica.held == {}
        await coordinator.release(held.held.token)
        assert [coordinator._placement.jobs(name) for name in coordinator._placement.replicas()] == [0]

    with_fleet(check, replicas=1)


def test_what_a_scene_has_grown_to_is_known_once_it_is_released():
    async def check(fleet: Fleet, coordinator: SceneCoordinator) -> None:
        for name in "xy":
            await coordinator.release((await coordinator.hold_later("f", name)).held.token)
        (replica,) = fleet.replicas
        assert replica.scenes == {"x", "y"}
        replica.size = 140
        held = await coordinator.hold("f", "x")
        await coordinator.release(held.held.token)
        await asyncio.sleep(0.01)
        assert replica.scenes == {"x"}  # 140 and 100 are more than 230

    with_fleet(check, budget=230, replicas=1)


def test_a_scene_that_is_dropped_before_its_release_is_answered_stays_dropped():
    async def check(fleet: Fleet, coordinator: SceneCoordinator) -> None:
        (replica,) = fleet.replicas
        held = await coordinator.hold_later("f", "x")
        replica.answer.clear()
        releasing = asyncio.ensure_future(coordinator.release(held.held.token))
        await asyncio.sleep(0.01)
        await asyncio.wait_for(coordinator.hold_later("f", "z"), 5)
        assert replica.scenes == {"z"}
        replica.answer.set()
        await releasing
        assert coordinator._placement.copies("x") == {}

    with_fleet(check, budget=150, replicas=1)


def test_a_job_holds_in_its_replica_what_it_was_promised(monkeypatch):
    """Calls of the coordinator and of a front may overtake each other."""

    async def check() -> None:
        replica = Replica(EngineConfig("view_index"))
        task, promised = FakeTask(id="t", held="promised"), HeldScenes("promised", ("x",), (0.0, 0.0, 0.0))
        await replica.release("promised", ("x",))  # before the job has come
        messages = replica.localize(task, promised)  # pyright: ignore[reportArgumentType]
        assert await anext(messages) == ([("first",)], None)
        engine.go_on.set()
        await asyncio.sleep(0.02)  # the job ends while its first record is sent
        assert [message async for message in messages] == [([], "of own")]
        assert engine.released == ["own"]
        held, _ = await replica.hold("kept", (), (), ("x",))
        assert isinstance(held, HeldScenes)
        assert held.token == "kept"
        messages = replica.localize(replace(task, held="kept"), held)  # pyright: ignore[reportArgumentType]
        await anext(messages)
        await replica.release("kept", ("x",))
        assert engine.cancelled == ["t"]
        assert engine.released == ["own", "own"]
        await replica.drop(("x",))  # while it is used, by a front that was taken to have ended: it stays
        engine.loads = True  # again, since its files have changed
        late = asyncio.ensure_future(anext(replica.localize(task, promised)))  # pyright: ignore[reportArgumentType]
        await asyncio.sleep(0.02)
        assert not late.done()
        engine.take(CorruptScene("it is torn.", where="scene"))
        with pytest.raises(CorruptScene):
            await late
        assert replica._held == {}

    engine = FakeEngine()
    monkeypatch.setattr("service.jobs.replica.EmbeddedEngine", lambda config: engine)
    asyncio.run(check())


@dataclass
class FakeTask:
    id: str
    held: str


class FakeEngine:
    """Its jobs have one record, and end when they may."""

    def __init__(self) -> None:
        self.loads = False
        self.released: list[str] = []
        self.cancelled: list[str] = []
        self.go_on = threading.Event()

    def start(self) -> None: ...

    def scenes(self) -> list[SceneStatus]:
        return []

    def hold_later(self, asked: str, take) -> None:
        self.take = take
        if not self.loads:
            take(HeldScenes("own", (asked,), (0.0, 0.0, 0.0)))

    def localize(self, task: FakeTask, on_record) -> str:
        on_record("first")
        assert self.go_on.wait(5)
        return f"of {task.held}"

    def release(self, token: str) -> None:
        self.released.append(token)

    def cancel(self, task_id: str) -> None:
        self.cancelled.append(task_id)

    def unload(self, scene_id: str) -> None: ...

    def remove(self, scene_id: str) -> None:
        raise SceneInUse("a job uses it.", where="scene")


def test_fronts_that_start_at_once_share_replicas(monkeypatch):
    async def check(fleet: Fleet, coordinator: SceneCoordinator) -> None:
        go_on = asyncio.Event()
        built: list[FakeReplica] = []

        async def built_in(self: FakeReplica) -> list[SceneStatus]:
            built.append(self)
            if len(built) == 2:
                raise Lost
            await go_on.wait()
            return []

        monkeypatch.setattr(FakeReplica, "_built_in", built_in)
        first, second = (asyncio.ensure_future(coordinator.start(3)) for _ in range(2))
        with pytest.raises(Lost):
            await first
        assert len(fleet.replicas) == 3
        third = asyncio.ensure_future(coordinator.start(3))  # instead of the one that has ended
        await asyncio.sleep(0.01)
        go_on.set()
        await third
        await asyncio.gather(second, return_exceptions=True)
        assert len(fleet.replicas) == 4
        assert len(coordinator._replicas) == 3

    with_fleet(check, replicas=0)


def test_a_load_that_nobody_waits_for_any_more_leaves_a_scene_that_may_go():
    async def check(fleet: Fleet, coordinator: SceneCoordinator) -> None:
        (replica,) = fleet.replicas
        replica.go_on.clear()
        waiting = asyncio.ensure_future(coordinator.hold_later("f", "x"))
        await asyncio.sleep(0.01)
        waiting.cancel()
        with pytest.raises(asyncio.CancelledError):
            await waiting
        replica.go_on.set()
        await asyncio.sleep(0.02)
        assert replica.held == {}
        assert (await coordinator.scene("x")).jobs == 0
        for name in "yzy":  # it makes room for others
            await coordinator.hold_later("f", name)
        assert replica.scenes == {"y", "z"}

    with_fleet(check, replicas=1)


def test_a_load_that_fails_leaves_nothing_and_is_told_to_all():
    async def check(fleet: Fleet, coordinator: SceneCoordinator) -> None:
        waiting = [coordinator.hold_later("f", "torn") for _ in range(3)]
        assert all(isinstance(e, CorruptScene) for e in await asyncio.gather(*waiting, return_exceptions=True))
        assert coordinator._placement.copies("torn") == {}
        assert [coordinator._placement.jobs(name) for name in coordinator._placement.replicas()] == [0, 0]
        loads = fleet.loads.copy()
        for ask in (coordinator.hold_later, coordinator.hold):
            with pytest.raises(CorruptScene):  # not loaded again by each request
                await ask("f", "torn")
        assert fleet.loads == loads
        with pytest.raises(CorruptScene):
            await coordinator.where("torn")
        assert (await coordinator.scene("torn")).state == "failed"
        held = await coordinator.hold_later("f", AUTO)
        assert "torn" not in held.held.ids

    with_fleet(check)


def test_a_scene_that_fails_is_tried_again_after_5_seconds_then_10_and_300_at_most(monkeypatch):
    async def check(fleet: Fleet, coordinator: SceneCoordinator) -> None:
        for number, pause_s in enumerate((5, 10, 20, 40, 80, 160, 300, 300)):
            with pytest.raises(CorruptScene):
                await coordinator.hold_later("f", "torn")
            clock.now += pause_s - 0.01
            with pytest.raises(CorruptScene):
                await coordinator.hold_later("f", "torn")
            assert fleet.loads.count("torn") == number + 1
            clock.now += 0.01
        # One that is asked for by an operator is tried at once.
        await coordinator.load("torn")
        await asyncio.sleep(0.02)
        assert fleet.loads.count("torn") == 9

    clock = SimpleNamespace(now=1000.0, monotonic=lambda: clock.now)
    monkeypatch.setattr("service.jobs.fleet_scenes.time", clock)
    with_fleet(check)


def test_a_scene_is_asked_for_where_the_fewest_jobs_are():
    async def check(fleet: Fleet, coordinator: SceneCoordinator) -> None:
        with pytest.raises(SceneNotReady):
            await coordinator.where("x")
        await asyncio.sleep(0.02)
        assert fleet.loads == ["x"]  # it is loaded because it was asked for
        assert (await coordinator.scene("x")).jobs == 0  # and held by nobody
        first = await coordinator.where("x")
        await coordinator.hold_later("f", "x")
        (other,) = (name for name, handle in coordinator._replicas.items() if handle is not first)
        coordinator._placement.loaded(other, "x", 100)
        assert await coordinator.where("x") is not first
        await coordinator.unload("x")
        with pytest.raises(SceneUnloaded):
            await coordinator.where("x")

    with_fleet(check)


def test_a_scene_without_a_file_stays_in_memory(monkeypatch):
    async def check(fleet: Fleet, coordinator: SceneCoordinator) -> None:
        (replica,) = fleet.replicas
        for name in ("b", "w", "x", "b", "y"):
            await coordinator.release((await coordinator.hold_later("f", name)).held.token)
        assert replica.scenes == {"b", "y"}
        with pytest.raises(BadInput):
            await coordinator.unload("b")

    async def built_in(self: FakeReplica) -> list[SceneStatus]:
        self.scenes.add("b")
        return [SceneStatus("b", "ready", memory_bytes=100)]

    monkeypatch.setattr(FakeReplica, "_built_in", built_in)
    with_fleet(check, replicas=1)


def test_a_file_of_the_same_name_replaces_a_scene():
    async def check(fleet: Fleet, coordinator: SceneCoordinator) -> None:
        (replica,) = fleet.replicas
        await coordinator.release((await coordinator.hold_later("f", "x")).held.token)
        await coordinator.add(StoredScene("x", Path("x")), False)
        assert replica.scenes == {"x"}
        await coordinator.add(StoredScene("x", Path("elsewhere")), False)
        assert replica.scenes == set()
        assert (await coordinator.scene("x")).state == "unloaded"

    with_fleet(check, replicas=1)


def test_who_needs_a_scene_waits_until_others_let_go():
    async def check(fleet: Fleet, coordinator: SceneCoordinator) -> None:
        first = await coordinator.hold_later("f", ["w", "x"])
        waiting = asyncio.ensure_future(coordinator.hold_later("f", "y"))
        await asyncio.sleep(0.02)
        assert not waiting.done()
        await coordinator.release(first.held.token)
        assert (await waiting).held.ids == ("y",)
        with pytest.raises(SceneTooLarge):
            await coordinator.hold_later("f", ["w", "x", "y"])

    with_fleet(check, replicas=1)


@pytest.mark.parametrize(("act", "error"), [("unload", SceneUnloaded), ("remove", SceneNotFound)])
def test_who_waits_for_a_scene_that_is_unloaded_or_removed_is_told(act, error):
    async def check(fleet: Fleet, coordinator: SceneCoordinator) -> None:
        await coordinator.hold_later("f", ["w", "x"])
        waiting = asyncio.ensure_future(coordinator.hold_later("f", "y"))
        await asyncio.sleep(0.01)
        await getattr(coordinator, act)("y")
        with pytest.raises(error):
            await asyncio.wait_for(waiting, 2)

    with_fleet(check, replicas=1)


def test_a_replica_that_dies_is_replaced_and_its_jobs_go_elsewhere():
    async def check(fleet: Fleet, coordinator: SceneCoordinator) -> None:
        first = await coordinator.hold_later("f", "x")
        dead = next(r for r in fleet.replicas if r.scenes)
        dead.go_on.clear()
        waiting = asyncio.ensure_future(coordinator.hold_later("f", "x"))
        await asyncio.sleep(0.01)
        dead.dead = True
        dead.go_on.set()
        again = await waiting
        assert again.replica != first.replica
        await asyncio.sleep(0.01)
        assert len(fleet.replicas) == 3
        assert (await coordinator.scene("x")).jobs == 1  # the first one's hold is gone with its replica
        await coordinator.release(first.held.token)
        assert (await coordinator.scene("x")).jobs == 1

    with_fleet(check)


def test_an_unloaded_scene_goes_with_its_last_job_and_stays_away():
    async def check(fleet: Fleet, coordinator: SceneCoordinator) -> None:
        held = await coordinator.hold_later("f", "x")
        assert (await coordinator.unload("x")).state == "unloading"
        with pytest.raises(SceneUnloaded):
            await coordinator.hold("f", "x")
        await coordinator.release(held.held.token)
        assert (await coordinator.scene("x")).state == "unloaded"
        assert fleet.replicas[0].scenes == set()
        await coordinator.load("x")
        await asyncio.sleep(0.02)
        assert (await coordinator.hold("f", "x")).held.ids == ("x",)

    with_fleet(check)


def test_nobody_waits_for_a_required_scene_that_is_unloaded_while_it_loads():
    async def check(fleet: Fleet, coordinator: SceneCoordinator) -> None:
        await coordinator.release((await coordinator.hold_later("f", "x")).held.token)
        for replica in fleet.replicas:
            replica.go_on.clear()
        await coordinator.add(StoredScene("late", Path("late")), True)
        await coordinator.start(2)
        readiness = await coordinator.readiness()
        assert (readiness.ready, [note.scene for note in readiness.pending]) == (False, ["late"])
        await coordinator.unload("late")
        readiness = await coordinator.readiness()
        assert (readiness.ready, readiness.pending) == (True, ())

    with_fleet(check)


def test_what_a_dead_front_held_is_let_go(monkeypatch):
    async def check(fleet: Fleet, coordinator: SceneCoordinator) -> None:
        await coordinator.hold_later("dead", "x")
        alive = await coordinator.hold_later("alive", "x")
        for _ in range(20):
            await asyncio.sleep(0.02)
            await coordinator.heard("alive")
        assert (await coordinator.scene("x")).jobs == 1
        assert [ids for replica in fleet.replicas for ids in replica.held.values()] == [("x",)]
        await coordinator.release(alive.held.token)

    monkeypatch.setattr("service.jobs.scene_coordinator._WATCH_S", 0.05)
    monkeypatch.setattr("service.jobs.scene_holds._FRONT_S", 0.2)
    with_fleet(check)


# ------------------------------------------------------------------ the simulation


def test_one_replica_waits_as_queueing_theory_says():
    """M/M/1 at a load of 0.6: a job takes 1/(1 - 0.6) = 2.5 service times on average, the median is ln 2 of that."""
    found = FleetSimulation(FleetModel(1, 1, jobs=30_000, service_s=0.1)).run()
    assert found.busy_share == pytest.approx(0.6, abs=0.02)
    assert found.p50_s == pytest.approx(0.25 * np.log(2), rel=0.1)  # seen: 0.176 of 0.173
    assert found.p95_s == pytest.approx(0.25 * np.log(20), rel=0.1)
    assert (found.loads_per_job, found.found_share, found.ended) == (0, 1, 30_000)


def test_every_simulated_job_ends_whatever_dies():
    found = FleetSimulation(FleetModel(4, 40, jobs=3000, scenes_in_memory=12, failures_per_hour=200.0)).run()
    assert found.ended == 3000
    assert found.repeated > 0
    assert found.loads_per_job > 0
