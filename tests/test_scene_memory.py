"""Scenes under a memory limit, and scenes that fail to load: who waits, who is dropped, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import httpx
import numpy as np
import pytest
from api_server import (
    assert_problem,
    at_each_front,
    create_app,
    finished,
    post,
    serving,
    settings,
    until,
    until_ready,
)
from test_scenes import TRANSFORMS, ply, states_are
from two_fronts import FRONTS, THROUGH_A_GATEWAY

from service.errors import SceneTooLarge, SplatfixError
from service.loaded_scene import LoadedScene
from service.scene_formats.size_estimate import estimated_bytes
from service.scene_manager import entry as entries
from service.scene_manager.entry import Entry
from service.scene_manager.manager import Acquired, Scenes
from service.scene_manager.memory_limit import MemoryLimit


def scene_folder(path: Path, count: int = 50) -> Path:
    path.mkdir(parents=True)
    (path / "scene.ply").write_bytes(ply(count))
    (path / "transforms.json").write_text(json.dumps(TRANSFORMS))
    return path


@pytest.fixture
def folder(tmp_path) -> Path:
    """Three small scenes, and a large one."""
    for name in ("attic", "cellar", "hall"):
        scene_folder(tmp_path / "scenes" / name)
    scene_folder(tmp_path / "scenes" / "tower", 5000)
    return tmp_path / "scenes"


@pytest.fixture
def size(folder) -> int:
    return LoadedScene.load(folder / "attic").nbytes


def service_on(folder: Path, **changes):
    return serving(create_app(settings(scenes=[folder], cache_dir=folder.parent / "cache", **changes)))


def states(client: httpx.Client) -> dict[str, str]:
    return {scene["id"]: scene["state"] for scene in client.get("/scenes").json()["scenes"]}


def test_a_photo_waits_until_the_scene_in_use_makes_room(stepping, folder, size):
    with service_on(folder, preload=["attic"], scene_memory_bytes=int(1.5 * size), workers=2) as client:
        until_ready(client)

        def sent(scene: str = "hall", **fields) -> list[str]:
            answers = at_each_front(lambda: post(client, prefer="", scene=scene, **fields))
            assert {answer.status_code for answer in answers} == {202}
            return [answer.headers["location"] for answer in answers]

        held, waiting, cancelled = sent("attic", options={"hold": True}), sent(), sent()
        late = sent(deadline_s=0.2)
        assert {client.delete(path).status_code for path in cancelled} <= {200, 202, 204}
        for ended in (finished(client, path) for path in late):
            assert (ended["state"], ended["error"]["code"]) == ("failed", "deadline_exceeded")
        assert [scenes["attic"] for scenes in at_each_front(lambda: states(client))] == ["ready"] * FRONTS
        assert [client.get(path).json()["state"] for path in waiting] == ["queued"] * FRONTS
        stepping.GO_ON.set()
        assert {finished(client, path)["state"] for path in [*held, *waiting]} == {"succeeded"}
        until(lambda: all(scenes["hall"] == "ready" for scenes in at_each_front(lambda: states(client))))
        assert states_are(client, attic="unloaded", cellar="unloaded", hall="ready", tower="unloaded")
        # Nobody holds a scene any more: neither who was cancelled nor who was late.
        for told in at_each_front(lambda: client.get("/scenes").json()["scenes"]):
            assert all(scene["jobs"] == 0 for scene in told)


def test_a_scene_that_never_fits_is_refused_and_drops_no_other(stepping, folder, size):
    with service_on(folder, preload=["attic", "cellar"], scene_memory_bytes=int(2.5 * size)) as client:
        until_ready(client)
        assert_problem(post(client, scene="tower"), 409, "scene_too_large", "scene")
        together = post(client, scene=["attic", "cellar", "hall"])
        assert_problem(together, 409, "scene_too_large", "scene")
        assert "the 3 scenes take" in together.json()["detail"]
        assert {answer.status_code for answer in at_each_front(lambda: client.post("/scenes/tower/load"))} == {202}
        until(lambda: all(scenes["tower"] == "failed" for scenes in at_each_front(lambda: states(client))))
        assert states_are(client, attic="ready", cellar="ready", hall="unloaded", tower="failed")


def test_of_a_preload_list_that_is_too_long_the_first_ones_stay(stepping, folder, size, caplog):
    with service_on(folder, preload=["attic", "cellar", "hall"], scene_memory_bytes=int(2.5 * size)) as client:
        until_ready(client)
        assert states_are(client, attic="ready", cellar="ready", hall="unloaded", tower="unloaded")
        assert "hall is not preloaded" in caplog.text or THROUGH_A_GATEWAY  # then it is the log of another process
        assert post(client, scene="hall").json()["state"] == "succeeded"


def test_auto_loads_what_fits_and_says_what_it_left_out(stepping, folder, size):
    with service_on(folder, preload=["attic"], scene_memory_bytes=int(2.5 * size)) as client:
        until_ready(client)
        result = post(client, scene="auto").json()["result"]
        searched = {each["id"] for each in result["scene_ranking"]}
        assert len(searched) == 2
        assert "attic" in searched
        (told,) = [text for text in result["warnings"] if "not searched" in text]
        assert all(name in told for name in {"cellar", "hall", "tower"} - searched)


def test_a_failed_load_is_tried_again_by_a_later_request(stepping, folder, monkeypatch):
    whole = (folder / "hall" / "scene.ply").read_bytes()
    (folder / "hall" / "scene.ply").write_bytes(whole[:-100])
    with service_on(folder, preload=["attic"]) as client:
        until_ready(client)
        assert post(client, scene="hall").json()["error"]["code"] == "corrupt_scene"
        # Read once, and not by each request.
        assert_problem(post(client, scene="hall"), 422, "corrupt_scene")
        (folder / "hall" / "scene.ply").write_bytes(whole)
        assert_problem(post(client, scene="hall"), 422, "corrupt_scene")
        monkeypatch.setattr(entries.time, "monotonic", lambda now=entries.time.monotonic: now() + entries.RETRY_S)
        assert post(client, scene="hall").json()["state"] == "succeeded"


def test_a_service_whose_only_scene_failed_gets_ready_by_itself(stepping, folder, monkeypatch):
    """An orchestrator sends no requests to a service that isn't ready."""
    monkeypatch.setattr(entries, "RETRY_S", 0.1)
    monkeypatch.setattr("service.scene_manager.manager._GRACE_S", 0.1)
    whole = (folder / "hall" / "scene.ply").read_bytes()
    (folder / "hall" / "scene.ply").write_bytes(whole[:-100])
    with serving(create_app(settings(scenes=[folder / "hall"], cache_dir=folder.parent / "cache"))) as client:
        until(lambda: client.get("/readyz").json()["failed"])
        assert client.get("/readyz").status_code == 503
        (folder / "hall" / "scene.ply").write_bytes(whole)
        until(lambda: client.get("/readyz").status_code == 200)


def test_the_time_between_two_attempts_doubles_and_success_resets_it(monkeypatch):
    now = 100.0
    monkeypatch.setattr(entries.time, "monotonic", lambda: now)
    one = Entry("a", None)
    waits = []
    for _ in range(9):
        one.failed(ValueError("torn"))
        waits.append(one.retry_at - now)
    assert waits == [5, 10, 20, 40, 80, 160, 300, 300, 300]


def test_who_needs_several_scenes_gets_them_though_others_want_all_the_memory(folder, size, plugins):
    """Each pair needs all there is: loaded one by one in turn, they would drop each other's for ever."""
    scenes = Scenes("stepping", None, memory_bytes=int(2.5 * size))
    for name in ("attic", "cellar", "hall"):
        scenes.add(Entry(name, folder / name))
    answers: list[tuple[str, Acquired | SplatfixError]] = []

    def take(pair: str, found: Acquired | SplatfixError) -> None:
        answers.append((pair, found))
        if isinstance(found, Acquired):
            scenes.release(found.scenes)

    for pair in ("attic cellar", "cellar hall", "hall attic", "attic cellar"):
        scenes.acquire_later(pair.split(), lambda found, pair=pair: take(pair, found))
    scenes.start()
    try:
        until(lambda: len(answers) == 4, 60)
    finally:
        scenes.close()
    scenes._thread.join(30)
    assert not scenes._thread.is_alive()
    assert all(isinstance(found, Acquired) and " ".join(found.ids) == pair for pair, found in answers)
    assert all(entry.jobs == 0 for entry in scenes.entries())


@pytest.mark.parametrize("suffix", ["ply", "splat"])
def test_the_header_tells_what_a_scene_takes(folder, suffix):
    path = folder / "tower"
    if suffix == "splat":
        (path / "scene.ply").unlink()
        np.zeros((5000, 32), np.uint8).tofile(path / "scene.splat")
        assert estimated_bytes(path) == 5000 * 2 * 56
    else:
        assert estimated_bytes(path) == pytest.approx(LoadedScene.load(path).nbytes, rel=0.02)
    assert estimated_bytes(folder / "none") is None


def test_nothing_is_dropped_in_vain():
    class Loaded:
        nbytes = 10

    used = [Entry(str(i), Path("x"), "ready", Loaded(), used=float(i)) for i in range(3)]  # type: ignore[arg-type]
    used[0].jobs = 1
    limit, new = MemoryLimit(30), Entry("new", Path("x"))
    assert limit.to_drop(new, 10, used) == [used[1]]
    assert limit.to_drop(new, 20, used) == [used[1], used[2]]
    assert limit.to_drop(new, 21, used) is None
    assert limit.to_drop(new, 10, used, kept=("1",)) == [used[2]]
    assert MemoryLimit(40).to_drop(new, 10, used) == []
    assert MemoryLimit(None).to_drop(new, 10**12, used) == []
    with pytest.raises(SceneTooLarge, match="scene 'new' takes"):
        limit.require(new, 31)
    limit.require(new, 30)


def test_photos_of_more_scenes_than_fit_are_all_answered(stepping, tmp_path):
    for i in range(6):
        scene_folder(tmp_path / "scenes" / f"s{i:02}")
    size = LoadedScene.load(tmp_path / "scenes" / "s00").nbytes
    limits = {"scene_memory_bytes": int(2.5 * size), "queue_size": 100, "rate_limit": ""}
    with service_on(tmp_path / "scenes", **limits) as client:
        until_ready(client)
        sent = [post(client, prefer="", scene=f"s{(5 * i) % 6:02}", seed=i) for i in range(15)]
        assert {answer.status_code for answer in sent} == {202}
        ended = [finished(client, answer.headers["location"]) for answer in sent]
        assert {job["state"] for job in ended} == {"succeeded"}
        assert [job["scene"] for job in ended] == [f"s{(5 * i) % 6:02}" for i in range(15)]
        assert sum(state == "ready" for state in states(client).values()) <= 2
