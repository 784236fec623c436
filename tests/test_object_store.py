"""What every object store promises, a folder and a bucket; scenes and photos that several fronts have there."""

from __future__ import annotations

import os
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from api_server import create_app, post, serving, settings, until, until_ready
from object_stores import S3, address_of
from stand_ins import make_scene
from test_registration import complete
from test_scenes import ply
from test_store_contracts import upload

from service.disk_cache import evict
from service.errors import BackendMissing, BadInput, CorruptScene, SceneInUse, SceneNotFound, StorageFailed
from service.object_store import ObjectStore, open_objects
from service.registration.registration_file import RegistrationFile
from service.scene_formats import side_file
from service.scene_formats.remote_scene import RemoteFile, RemoteScene
from service.scene_manager.anchor_store import Anchor, FileAnchorStore
from service.scene_manager.object_scene_store import ObjectSceneStore
from service.web.catalogue_watch import CatalogueWatch


@pytest.fixture(params=["folder", S3])
def address(request, tmp_path) -> str:
    return address_of(request.param, request, tmp_path)


@pytest.fixture
def objects(address) -> ObjectStore:
    store = open_objects(address)
    assert isinstance(store, ObjectStore)
    return store


def test_an_object_is_put_read_replaced_and_deleted(objects, tmp_path):
    assert objects.get("a/b.json") is None
    objects.put("a/b.json", b"one")
    objects.put("a/c/d", b"")
    objects.put("ab/e", b"other")
    assert (objects.get("a/b.json"), objects.get("a/c/d")) == (b"one", b"")
    before = objects.versions("a/")
    assert before.keys() == {"a/b.json", "a/c/d"}
    assert objects.versions("a/") == before
    objects.put("a/b.json", b"two")
    after = objects.versions("a/")
    assert (objects.get("a/b.json"), after["a/c/d"]) == (b"two", before["a/c/d"])
    assert after["a/b.json"] != before["a/b.json"]
    for _ in range(2):
        objects.delete("a/b.json")
    assert objects.versions("a/").keys() == {"a/c/d"}
    assert objects.versions("none/") == {}


def test_files_come_back_as_they_were(objects, tmp_path):
    data = bytes(range(256)) * 50_000  # 12.8 MB: several pieces
    (tmp_path / "sent").write_bytes(data)
    objects.put_file("files/x", tmp_path / "sent")
    assert objects.get_file("files/x", tmp_path / "got")
    assert (tmp_path / "got").read_bytes() == data
    assert not objects.get_file("files/y", tmp_path / "none")


def test_of_several_that_create_an_object_one_does(objects):
    barrier = threading.Barrier(6)

    def create(number: int) -> bool:
        barrier.wait()
        return objects.create("scenes/one.json", f"{number}".encode())

    with ThreadPoolExecutor(6) as pool:
        made = list(pool.map(create, range(6)))
    assert sum(made) == 1
    assert objects.get("scenes/one.json") == f"{made.index(True)}".encode()


def test_what_cannot_be_used_is_refused(tmp_path, monkeypatch):
    with pytest.raises(BadInput, match="no absolute path"):
        open_objects("relative/folder")
    (tmp_path / "file").touch()
    with pytest.raises(StorageFailed, match="object store"):
        open_objects(str(tmp_path / "file"))
    monkeypatch.setitem(sys.modules, "service.s3_objects", None)
    with pytest.raises(BackendMissing, match="obstore"):
        open_objects("s3://not-installed")


@pytest.mark.ci
def test_a_bucket_that_is_not_there_is_a_storage_failure(s3):
    store = open_objects("s3://no-such-bucket")
    for ask in (lambda: store.put("k", b""), lambda: store.versions("a/")):
        with pytest.raises(StorageFailed, match="object store"):
            ask()


# ------------------------------------------------------------------ scenes


@pytest.fixture
def fronts(address, tmp_path) -> list[ObjectSceneStore]:
    folders = [tmp_path / name for name in ("first", "second")]
    return [ObjectSceneStore([], address, f / "cache", f / "incoming", 10**6) for f in folders]


class FakeEngine:
    """Knows scenes, and which of them are in use."""

    def __init__(self) -> None:
        self.ids: set[str] = set()
        self.used: set[str] = set()
        self.loaded: list[str] = []

    def add(self, scene) -> None:
        self.ids.add(scene.id)

    def load(self, scene_id: str) -> None:
        self.loaded.append(scene_id)

    def remove(self, scene_id: str) -> None:
        if scene_id not in self.ids:
            raise SceneNotFound("unknown.")
        if scene_id in self.used:
            raise SceneInUse("in use.")
        self.ids.remove(scene_id)


def test_what_one_front_adds_and_deletes_the_others_see(fronts):
    first, second = fronts
    engine = FakeEngine()
    watch = CatalogueWatch(second, engine)  # type: ignore[arg-type]
    upload(first, "house", ply())
    watch.look()
    assert (engine.ids, engine.loaded) == ({"house"}, ["house"])
    (seen,) = second.scenes()
    assert not seen.path.exists()  # fetched when it is loaded
    seen.remote.fetch(seen.path)
    assert (seen.path / "scene.ply").read_bytes() == ply()
    engine.used = {"house"}
    first.delete("house")
    watch.look()
    assert (second.scenes(), engine.ids) == ([], {"house"})
    engine.used = set()
    watch.look()
    assert engine.ids == set()
    upload(second, "house", ply())
    watch.look()  # its own: whoever uploads tells the engine
    assert engine.ids == set()
    assert [scene.id for scene in first.refresh()[0]] == ["house"]
    assert first.refresh() == ([], [])


def test_a_scene_that_is_replaced_is_another(fronts, objects):
    first, second = fronts
    upload(first, "house", ply())
    (before,), _ = second.refresh()
    first.delete("house")
    assert objects.versions("uploads/") == {}
    upload(first, "house", ply())
    (after,), gone = second.refresh()
    assert (after.id, gone) == ("house", [])
    assert after.path != before.path


def test_a_damaged_or_lost_file_is_found_by_its_hash(fronts, objects):
    first, second = fronts
    remote = upload(first, "house", ply()).remote
    second.refresh()
    seen = second.find("house")
    (file,) = remote.files
    objects.put(remote.key(file), ply()[:-1] + b"!")
    with pytest.raises(CorruptScene, match=r"scene\.ply is damaged"):
        seen.remote.fetch(seen.path)
    objects.delete(remote.key(file))
    with pytest.raises(CorruptScene, match=r"scene\.ply is lost"):
        seen.remote.fetch(seen.path)
    assert not [path for path in seen.path.rglob("*") if path.is_file()]


def test_an_entry_that_cannot_be_read_hides_no_other(fronts, objects):
    first, second = fronts
    upload(first, "house", ply())
    objects.put("scenes/barn.json", b"{")
    objects.put("scenes/evil.json", b'{"prefix": "uploads/e/", "files": [{"path": "../x", "sha256": "", "bytes": 1}]}')
    second.refresh()
    assert [scene.id for scene in second.scenes()] == ["house"]


@pytest.mark.parametrize("path", ["../x", "/x", "a/../../x", "", "c:/x", "a\\x"])
def test_a_file_stays_in_its_scenes_folder(path):
    with pytest.raises(CorruptScene, match="out of the scene"):
        RemoteFile(path, "", 0)


def test_the_cache_of_fetched_scenes_is_bounded(fronts, tmp_path):
    first, second = fronts
    for name in ("a", "b"):
        upload(first, name, ply())
    second.refresh()
    for age, scene in zip((200, 100), second.scenes(), strict=True):
        scene.remote.fetch(scene.path)
        past = time.time() - age
        os.utime(scene.path, (past, past))
    assert evict(tmp_path / "second" / "cache", len(ply()) + 10) == 1
    one, two = second.scenes()
    assert (one.path.exists(), two.path.exists()) == (False, True)
    one.remote.fetch(one.path)
    assert (one.path / "scene.ply").read_bytes() == ply()


def test_registrations_and_anchors_of_a_scene_are_shared(fronts, tmp_path, monkeypatch):
    first, second = fronts
    monkeypatch.setattr(side_file, "_REFRESH_S", 0.0)
    upload(first, "house", ply())
    second.refresh()
    files = [RegistrationFile(s.path, None, s.remote) for s in (f.find("house") for f in fronts)]
    added = files[0].add(complete())
    assert files[1].current().revision == added.revision == 1
    assert files[1].add(complete()).revision == 2
    assert files[0].current().revision == 2
    anchors = [FileAnchorStore(front.find, None) for front in fronts]
    anchors[1].put("house", Anchor("door", np.array([1.0, 2.0, 3.0])))
    assert [anchor.name for anchor in anchors[0].anchors("house")] == ["door"]
    anchors[0].delete("house", "door")
    assert anchors[1].anchors("house") == ()


def test_what_a_front_writes_it_reads_at_once_and_adds_to_what_others_wrote(fronts, monkeypatch):
    monkeypatch.setattr(side_file, "_REFRESH_S", 600.0)
    first, second = fronts
    upload(first, "house", ply())
    second.refresh()
    files = [RegistrationFile(s.path, None, s.remote) for s in (f.find("house") for f in fronts)]
    assert [file.current() for file in files] == [None, None]
    files[0].add(complete())
    assert files[0].current().revision == 1
    assert files[1].add(complete()).revision == 2


def test_a_copy_is_used_while_the_object_store_is_away(fronts, monkeypatch, caplog):
    first, second = fronts
    monkeypatch.setattr(side_file, "_REFRESH_S", 0.0)
    upload(first, "house", ply())
    second.refresh()
    seen = second.find("house")
    file = RegistrationFile(seen.path, None, seen.remote)
    file.add(complete())
    assert file.current()

    def away(self, key):
        raise StorageFailed("away.")

    monkeypatch.setattr(type(seen.remote.store), "get", away)
    assert file.current()
    assert "may be outdated" in caplog.text


@pytest.mark.ci
def test_a_scene_that_is_uploaded_at_one_front_is_used_at_the_other(address, stepping, tmp_path):
    """Each with a cache of its own, as on two machines."""

    def app(name: str):
        return create_app(settings(object_store=address, cache_dir=tmp_path / name), {"room": make_scene()})

    # FastAPI filters warnings while it makes routes, which a thread of another front would undo.
    apps = app("first"), app("second")
    with serving(apps[0]) as first, serving(apps[1]) as second:
        for client in (first, second):
            until_ready(client)
        assert first.put("/scenes/house", content=ply()).status_code == 201
        began = time.monotonic()
        until(lambda: second.get("/scenes/house").status_code == 200)
        assert time.monotonic() - began < 5
        assert second.post("/scenes/house/load").status_code == 202
        fetched = tmp_path / "second" / "fetched-scenes"
        until(lambda: [path.read_bytes() for path in fetched.rglob("scene.ply")] == [ply()])
        answer = post(second, scene="room", options={"steps": 2})
        assert answer.json()["state"] == "succeeded", answer.text
        assert second.get(answer.json()["links"]["photo"]).status_code == 200
        assert first.delete("/scenes/house").status_code == 204
        until(lambda: second.get("/scenes/house").status_code == 404)
        stepping.GO_ON.set()


@pytest.mark.ci
def test_doctor_examines_the_object_store(address):
    from service.cli.fleet_findings import fleet_findings

    found = list(fleet_findings(settings(object_store=address)))
    assert (found[0].subject, found[0].ok) == ("object store", True)
    # The tests' server speaks plain HTTP.
    assert [f.subject for f in found[1:]] == (["object store's privacy"] if address.startswith("s3:") else [])
    lost = list(fleet_findings(settings(object_store="relative")))
    assert [(f.subject, f.ok) for f in lost] == [("object store", False)]


def test_a_scenes_description_can_be_sent_to_another_process():
    import pickle

    remote = RemoteScene("/mnt/x", "uploads/a-1/", (RemoteFile("scene.ply", "0", 1),))
    assert pickle.loads(pickle.dumps(remote)) == remote
    assert Path(remote.key(remote.files[0])) == Path("uploads/a-1/files/0")
