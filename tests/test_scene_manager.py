"""Which scenes are loaded, held, dropped and given to whom, decision by decision, without loading any."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fake_service import until

from service.errors import (
    BadInput,
    CorruptScene,
    SceneInUse,
    SceneNotFound,
    SceneNotReady,
    SceneTooLarge,
    SceneUnloaded,
    SplatfixError,
)
from service.scene_manager import entry as entry_module
from service.scene_manager import manager as module
from service.scene_manager.entry import Entry
from service.scene_manager.manager import Acquired, Scenes
from service.scene_manager.status import AUTO, SceneNote

SIZE = 100


class Clock:
    now = 1000.0

    def monotonic(self) -> float:
        self.now += 0.001
        return self.now


class Loaded:
    """A scene in memory; what is torn can't be loaded."""

    def __init__(self, path: Path) -> None:
        self.name, self.nbytes, self.made = path.name, SIZE, []
        self.warnings, self.grows = (), lambda: None
        self.rasterizer, self.skipped_rasterizers = SimpleNamespace(name="cpu"), ""
        info = SimpleNamespace(origin_in_world=(10.0, 0.0, 0.0))
        self.scene = SimpleNamespace(
            info=info, count=3, sh_degree=2, cameras=(), means=np.arange(303.0).reshape(101, 3)
        )

    def usable(self, estimator: str) -> None:
        self.made.append(("a part", estimator))

    def prepare(self, estimator: str) -> None:
        self.grows()
        self.made.append(("all", estimator))

    def prepared(self, estimator: str) -> None:
        return None


class Manager:
    """Scenes whose thread goes on when it is told."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, names: str, memory: int | None, **options: Any) -> None:
        self.clock, self.loads, self.warmed, self.evicted = Clock(), [], [], []
        self.sizes: dict[str, int] = {}
        self.grows: Callable[[], None] = lambda: None
        monkeypatch.setattr(module, "time", self.clock)
        monkeypatch.setattr(entry_module, "time", self.clock)
        monkeypatch.setattr(entry_module, "estimated_bytes", lambda path: SIZE)
        monkeypatch.setattr(module, "LoadedScene", SimpleNamespace(load=self._load))
        monkeypatch.setattr(module, "warm_up", lambda loaded, estimator: self.warmed.append((loaded.name, estimator)))
        monkeypatch.setattr(module, "evict", lambda *given: self.evicted.append(given))
        self.scenes: Any = Scenes("view_index", options.pop("cache", None), memory_bytes=memory, **options)
        for name in names:
            self.scenes.add(Entry(name, Path(f"/scenes/{name}")))

    def _load(self, path: Path, **tools: Any) -> Loaded:
        self.loads.append(path.name)
        if path.name == "torn":
            raise CorruptScene("it is torn.", where=f"{path}/scene.ply")
        if path.name == "bug":
            raise ValueError("a bug")
        loaded = Loaded(path)
        loaded.grows = self.grows
        loaded.nbytes = self.sizes.get(path.name, SIZE)
        return loaded

    def entry(self, name: str) -> Entry:
        return self.scenes.entry(name)

    def work(self) -> list[str]:
        """Load what is requested and fits; return what was."""
        before = len(self.loads)
        next_one = self.scenes._next

        def until_nothing_fits() -> Entry | None:
            for entry in self.scenes.entries():
                if entry.is_due:
                    self.scenes._request(entry)
            for entry in list(self.scenes._in_order()):
                if self.scenes._makes_room(entry):
                    self.scenes._requested.remove(entry)
                    return entry
            return None

        self.scenes._next = until_nothing_fits
        self.scenes._work()
        self.scenes._next = next_one
        return self.loads[before:]

    def hold(self, name: str) -> Acquired:
        with pytest.raises(SceneNotReady):
            self.scenes.acquire(name)
        self.work()
        return self.scenes.acquire(name)

    def states(self) -> dict[str, str]:
        return {entry.id: entry.state for entry in self.scenes.entries()}


@pytest.fixture
def make(monkeypatch: pytest.MonkeyPatch) -> Any:
    return lambda names="abc", memory=None, **options: Manager(monkeypatch, names, memory, **options)


def test_a_scene_is_loaded_when_it_is_asked_for_and_prepared_once(make):
    of = make(cache=Path("/cache"), cache_bytes=7)
    with pytest.raises(SceneNotReady, match="is loading"):
        of.scenes.get("a")
    with pytest.raises(SceneNotReady):
        of.scenes.get("a")
    assert of.work() == ["a"]
    assert of.states() == {"a": "ready", "b": "unloaded", "c": "unloaded"}
    loaded = of.scenes.get("a")
    assert loaded.made == [("a part", "view_index"), ("all", "view_index")]
    assert of.warmed == [("a", "view_index")]
    assert of.evicted == [(Path("/cache"), 7)]
    assert of.entry("a").measured_bytes == SIZE
    assert of.scenes.id_of(loaded) == "a"
    assert of.scenes.id_of(Loaded(Path("x"))) is None
    assert of.work() == []
    for options in ({"cache": Path("/cache")}, {"cache_bytes": 7}):
        other = make("a", **options)
        other.hold("a")
        assert other.evicted == []


def test_the_thread_loads_at_once_what_is_asked_for_and_ends_when_it_is_told(make):
    """Without being woken it would look again after five seconds."""
    of = make("ab")
    of.entry("b").required = True
    of.scenes.start()
    for name in ("b", "a"):  # the first one is required
        if name == "a":
            with pytest.raises(SceneNotReady):
                of.scenes.get(name)
        until(lambda name=name: of.states()[name] == "ready", name, 2)
    began = time.perf_counter()
    of.scenes.close()
    assert not of.scenes._thread.is_alive()
    assert time.perf_counter() - began < 2
    # A scene that fails while the process ends is no news.
    of.scenes._requested.append(of.entry("a"))
    assert of.scenes._next() is None


def test_names_are_of_scenes(make):
    with pytest.raises(SceneNotFound, match="name a scene"):
        make().entry(None)
    with pytest.raises(SceneNotFound, match="unknown scene 'x'"):
        make().entry("x")
    assert make("a").entry(None).id == "a"
    assert make().scenes.contents("a") is None


def test_contents_are_in_the_world(make):
    of = make("a")
    of.hold("a")
    bounds = of.scenes.contents("a").bounds_in_world
    # Hundredths of 0, 3, ... 300, ten units further along x.
    assert bounds.tolist() == [[13.0, 4.0, 5.0], [307.0, 298.0, 299.0]]
    of.entry("a").loaded.scene.count = 0
    assert of.scenes.contents("a").bounds_in_world is None


def test_held_scenes_stay_and_idle_ones_make_room(make):
    of = make(memory=2 * SIZE)
    a = of.hold("a")
    of.scenes.release(of.hold("b").scenes)
    of.hold("c")
    assert of.states() == {"a": "ready", "b": "unloaded", "c": "ready"}
    with pytest.raises(SceneNotReady):
        of.scenes.acquire("b")
    assert of.work() == []  # both are in use
    assert of.states()["b"] == "loading"
    of.scenes.release(a.scenes)
    assert of.work() == ["b"]
    assert of.states() == {"a": "unloaded", "b": "ready", "c": "ready"}
    assert [of.entry(name).jobs for name in "abc"] == [0, 0, 1]


def test_all_or_none_of_several_scenes_are_held(make):
    of = make()
    of.hold("a")
    with pytest.raises(SceneNotReady):
        of.scenes.acquire(["a", "b"])
    assert of.entry("a").jobs == 1
    of.work()
    held = of.scenes.acquire(["b", "a", "b"])
    assert (held.ids, held.left_out) == (("b", "a"), ())
    assert [of.entry(name).jobs for name in "ab"] == [2, 1]


def test_auto_holds_what_fits_and_tells_what_it_left_out(make):
    of = make("ab", memory=SIZE)
    of.hold("a")
    held = of.scenes.acquire(AUTO)
    assert (held.ids, held.left_out) == (("a",), ("b",))
    none = make("a")
    none.entry("a").wanted = False
    with pytest.raises(SceneNotFound, match="no scene can be searched"):
        none.scenes.acquire(AUTO)


def test_what_can_never_fit_is_refused_at_once(make):
    of = make("ab", memory=SIZE)
    with pytest.raises(SceneTooLarge):
        of.scenes.acquire(["a", "b"])
    told: list[Any] = []
    of.scenes.acquire_later(["a", "b"], told.append)
    assert isinstance(told[0], SceneTooLarge)


def test_a_failed_scene_is_told_without_its_folder_and_tried_again_later(make, caplog):
    of = make(("torn", "bug"))
    for name, shown, bug in (("torn", "torn/scene.ply", False), ("bug", None, True)):
        caplog.clear()
        with pytest.raises(SceneNotReady):
            of.scenes.get(name)
        with caplog.at_level(logging.ERROR):
            assert of.work() == [name]
        assert bool(caplog.records[-1].exc_info) is bug
        with pytest.raises((CorruptScene, ValueError)) as caught:
            of.scenes.get(name)
        assert of.work() == []
        if shown:
            assert caught.value.where == shown
    for pause_s in (5, 10, 20, 40, 80, 160, 300, 300):
        of.clock.now = of.entry("torn").retry_at - 0.1
        with pytest.raises(CorruptScene):
            of.scenes.get("torn")
        of.clock.now += 0.2
        with pytest.raises(SceneNotReady):
            of.scenes.get("torn")
        assert of.entry("torn").error is None
        assert of.work() == ["torn"]
        following = {5: 10, 10: 20, 20: 40, 40: 80, 80: 160}.get(pause_s, 300)
        assert of.entry("torn").retry_at - of.clock.now == pytest.approx(following, abs=0.1)
    # An operator's request doesn't wait, and what loads begins at five seconds again.
    of.scenes.load(of.entry("torn"))
    assert of.work() == ["torn"]


def test_who_waits_for_a_failed_scene_is_told_and_auto_goes_on_without_it(make):
    of, told = make(("a", "torn")), []
    of.scenes.acquire_later(["a", "torn"], told.append)
    of.scenes.acquire_later(AUTO, told.append)
    of.scenes.acquire_later("torn", told.append)
    assert told == []
    of.work()
    assert sorted(type(each).__name__ for each in told) == ["Acquired", "CorruptScene", "CorruptScene"]
    auto = next(each for each in told if isinstance(each, Acquired))
    assert (auto.ids, auto.left_out) == (("a",), ("torn",))
    assert of.entry("a").jobs == 1
    assert of.scenes._waiting == []


def test_the_first_in_line_gets_its_scenes_first_and_they_stay(make):
    of, told = make("abcd", memory=2 * SIZE), []
    for name in "ab":
        of.scenes.release(of.hold(name).scenes)
    with pytest.raises(SceneNotReady):
        of.scenes.get("d")
    of.scenes.acquire_later(["a", "c"], told.append)
    assert [entry.id for entry in of.scenes._in_order()] == ["c", "d"]
    of.work()
    assert told[0].ids == ("a", "c")
    assert of.states() == {"a": "ready", "b": "unloaded", "c": "ready", "d": "loading"}


def test_unloading_waits_for_jobs_and_lets_no_new_one_in(make):
    of = make("ab")
    a = of.hold("a")
    of.scenes.unload(of.entry("a"))
    assert of.states()["a"] == "unloading"
    with pytest.raises(SceneUnloaded):
        of.scenes.acquire("a")
    of.scenes.load(of.entry("a"))  # thought better of
    assert of.states()["a"] == "ready"
    of.scenes.unload(of.entry("a"))
    of.scenes.release(a.scenes)
    assert (of.states()["a"], of.entry("a").loaded) == ("unloaded", None)
    of.scenes.load(of.entry("a"))
    assert of.work() == ["a"]
    of.scenes.unload(of.entry("a"))
    assert of.states()["a"] == "unloaded"  # nobody uses it
    # One that is on its way isn't loaded.
    with pytest.raises(SceneNotReady):
        of.scenes.get("b")
    of.scenes.unload(of.entry("b"))
    assert of.work() == []
    assert of.states()["b"] == "unloaded"
    of.scenes.add(Entry("given", None, "ready", Loaded(Path("given"))))  # type: ignore[arg-type]
    with pytest.raises(BadInput):
        of.scenes.unload(of.entry("given"))


def test_who_waits_for_a_scene_that_is_unloaded_or_removed_is_told(make):
    of, told = make("ab"), []
    of.scenes.acquire_later("a", told.append)
    of.scenes.acquire_later("b", told.append)
    of.scenes.unload(of.entry("a"))
    of.scenes.remove("b")
    assert [type(each) for each in told] == [SceneUnloaded, SceneNotFound]
    assert of.work() == []


def test_a_scene_in_use_is_not_removed_and_one_of_its_name_may_replace_it(make):
    of = make("a")
    a = of.hold("a")
    with pytest.raises(SceneInUse, match="1 jobs"):
        of.scenes.remove("a")
    of.scenes.add(Entry("a", Path("/elsewhere/a")))
    of.scenes.release(a.scenes)  # of the one before
    assert of.entry("a").jobs == 0
    of.scenes.remove("a")
    assert of.scenes.entries() == []


def test_required_scenes_are_awaited_and_tried_again_unasked(make):
    of = make(())
    for name in ("a", "torn"):
        of.scenes.add(Entry(name, Path(f"/scenes/{name}"), required=True))
    for entry in of.scenes.entries():
        of.scenes._request(entry)
    ready = of.scenes.readiness()
    assert (ready.ready, [str(note) for note in ready.pending]) == (
        False,
        [str(SceneNote(i, "loading")) for i in ("a", "torn")],
    )
    assert of.work() == ["a", "torn"]
    ready = of.scenes.readiness()
    assert (ready.ready, len(ready.pending), len(ready.failed)) == (True, 0, 1)
    assert ready.rasterizers == ("cpu",)
    assert ready.skipped_rasterizers == ()
    assert of.work() == []
    of.clock.now += 5.0
    assert of.work() == ["torn"]
    of.entry("torn").wanted = False
    of.clock.now += 100.0
    assert of.work() == []


def test_a_service_whose_scenes_all_failed_or_were_unloaded_is_not_ready(make):
    of = make(("torn",))
    assert of.scenes.readiness().ready
    with pytest.raises(SceneNotReady):
        of.scenes.get("torn")
    of.work()
    assert not of.scenes.readiness().ready
    gone = make("a")
    gone.scenes.unload(gone.entry("a"))
    assert not gone.scenes.readiness().ready


def test_of_a_preload_list_that_is_too_long_the_first_ones_stay(make, caplog):
    of = make((), memory=2 * SIZE)
    for name in "abc":
        of.scenes.add(Entry(name, Path(f"/scenes/{name}"), required=True))
        of.scenes._request(of.entry(name))
    with caplog.at_level(logging.WARNING):
        assert of.work() == ["a", "b"]
    assert "scene c is not preloaded" in caplog.text
    assert of.states() == {"a": "ready", "b": "ready", "c": "unloaded"}
    assert not of.entry("c").awaited
    # Asked for, it makes room as any other.
    with pytest.raises(SceneNotReady):
        of.scenes.get("c")
    assert of.work() == ["c"]
    assert of.states()["a"] == "unloaded"


def test_a_scene_that_takes_more_than_its_header_told_drops_others(make):
    of = make("ab", memory=250)
    of.scenes.release(of.hold("a").scenes)
    of.sizes["b"] = 200
    of.hold("b")
    assert of.states() == {"a": "unloaded", "b": "ready"}
    assert of.entry("b").measured_bytes == 200


def test_a_scene_that_was_unloaded_while_it_was_loaded_goes(make, monkeypatch):
    of = make("a")
    with pytest.raises(SceneNotReady):
        of.scenes.get("a")
    monkeypatch.setattr(module, "warm_up", lambda loaded, estimator: setattr(of.entry("a"), "wanted", False))
    of.work()
    assert (of.states()["a"], of.entry("a").loaded) == ("unloaded", None)


def test_a_scene_is_ready_and_stays_while_its_index_grows(make):
    """Jobs use it, none of them, nor memory that another scene needs, drops it before it is whole."""
    of = make("ab", memory=SIZE)
    a, seen = of.entry("a"), []

    def while_it_grows() -> None:
        of.grows = lambda: None
        assert of.scenes.readiness().ready
        held = of.scenes.acquire("a")
        of.scenes.release(held.scenes)
        with pytest.raises(SceneNotReady):
            of.scenes.get("b")
        assert not of.scenes._makes_room(of.entry("b"))
        seen.append((a.state, a.is_idle, a.loaded is not None))

    of.grows = while_it_grows
    a.required = True
    with pytest.raises(SceneNotReady):
        of.scenes.get("a")
    assert of.work() == ["a", "b"]
    assert seen[0] == ("ready", False, True)
    assert of.states() == {"a": "unloaded", "b": "ready"}  # it went once it was whole


@pytest.mark.parametrize("again", [False, True])
def test_a_scene_that_is_unloaded_while_its_index_grows_goes_when_that_is_whole(make, again):
    of = make("a")
    entry, states = of.entry("a"), []

    def unload() -> None:
        of.scenes.unload(entry)
        states.append((entry.state, entry.loaded is not None))
        if again:
            of.scenes.load(entry)

    of.grows = unload
    with pytest.raises(SceneNotReady):
        of.scenes.get("a")
    of.work()
    assert states == [("unloading", True)]
    assert (entry.state, entry.loaded is not None) == (("ready", True) if again else ("unloaded", False))


def test_a_scene_whose_index_can_not_be_built_has_failed(make):
    of = make("a")

    def fail() -> None:
        raise MemoryError("full")

    of.grows = fail
    with pytest.raises(SceneNotReady):
        of.scenes.get("a")
    of.work()
    assert (of.states()["a"], of.entry("a").is_growing) == ("failed", False)


def test_entries_tell_what_they_are(make):
    of = make("a")
    entry = of.entry("a")
    assert (entry.is_idle, entry.memory_bytes, entry.expected_bytes()) == (False, 0, SIZE)
    held = of.hold("a")
    assert (entry.is_idle, entry.memory_bytes) == (False, SIZE)
    of.scenes.release(held.scenes)
    assert entry.is_idle
    status = entry.status()
    assert (status.state, status.gaussians, status.sh_degree, status.memory_bytes) == ("ready", 3, 2, SIZE)
    assert Entry("x", None).expected_bytes() == 0
    assert not Entry("x", None, "ready", Loaded(Path("x"))).is_idle  # type: ignore[arg-type]
    failed = Entry("x", Path("x"))
    failed.failed(CorruptScene("torn.", where="x"))
    assert failed.status().state == "failed"
    assert isinstance(failed.error, SplatfixError)
