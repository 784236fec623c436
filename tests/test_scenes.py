"""Scenes at run time: loaded, dropped, uploaded; and the files that make a second start quick."""

from __future__ import annotations

import io
import json
import os
import threading
import zipfile
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import httpx
import numpy as np
import pytest
import torch
from api_server import (
    assert_problem,
    at_each_front,
    create_app,
    finished,
    post,
    scene_files,
    serving,
    settings,
    traces_of_uploads,
    until,
    until_ready,
)
from stand_ins import make_scene
from two_fronts import FRONTS

from service import searched_scene
from service.errors import BadInput, CorruptScene, InvalidRequest, UnsupportedFormat
from service.loaded_scene import LoadedScene
from service.render import pack
from service.render.cpu import CpuRasterizer
from service.scene_formats import load_scene
from service.scene_formats.cache import mapped_scene
from service.scene_manager.entry import Entry
from service.scene_manager.manager import Scenes
from service.scene_manager.scene_store import FolderSceneStore, named_scenes
from service.scene_manager.warm_up import overview
from service.types import GaussianScene, GeoAnchor


def write_ply(path: Path, scene: GaussianScene) -> None:
    """As a trainer writes it: values before activation."""
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
    names += [f"scale_{k}" for k in range(3)] + [f"rot_{k}" for k in range(4)]
    opacity = np.clip(scene.opacities, 0.01, 0.99)
    columns = [scene.means, scene.sh[:, 0], np.log(opacity / (1 - opacity))[:, None], np.log(scene.scales), scene.quats]
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {scene.count}\n"
    head += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    path.write_bytes(head.encode() + np.concatenate(columns, 1).astype("<f4").tobytes())


def ply(count: int = 50) -> bytes:
    file = Path("/dev/shm" if Path("/dev/shm").is_dir() else "/tmp") / f"splatfix-{threading.get_ident()}.ply"
    try:
        write_ply(file, make_scene(count=count).scene)
        return file.read_bytes()
    finally:
        file.unlink()


TRANSFORMS = {
    **{"camera_model": "OPENCV", "fl_x": 80, "fl_y": 80, "cx": 48, "cy": 32, "w": 96, "h": 64},
    "frames": [{"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}],
}


@pytest.fixture
def folder(tmp_path) -> Path:
    """Three scenes."""
    for name in ("attic", "cellar", "hall"):
        (tmp_path / "scenes" / name).mkdir(parents=True)
        (tmp_path / "scenes" / name / "scene.ply").write_bytes(ply())
        (tmp_path / "scenes" / name / "transforms.json").write_text(json.dumps(TRANSFORMS))
    return tmp_path / "scenes"


def test_a_photo_is_looked_for_in_several_scenes(folder, stepping):
    with service_on(folder) as client:
        for name in ("attic", "cellar", "hall"):
            at_each_front(lambda name=name: client.post(f"/scenes/{name}/load"))
        until(lambda: states_are(client, attic="ready", cellar="ready", hall="ready"), 120)
        for asked, expected in (("auto", {"attic", "cellar", "hall"}), (["hall", "attic", "hall"], {"hall", "attic"})):
            job = post(client, scene=asked).json()
            assert (job["state"], job["requested_scene"]) == ("succeeded", asked)
            assert {each["id"] for each in job["result"]["scene_ranking"]} == expected
            assert job["scene"] == job["result"]["scene"]["id"] in expected
            assert job["result"]["status"] == "not_localized"  # the stand-ins see nothing
            assert [t["stage"] for t in job["result"]["timings"]][:2] == ["decode", "scene_ranking"]
        one = post(client, scene=["cellar"]).json()
        assert (one["scene"], one["result"]["scene_ranking"]) == ("cellar", [])
        assert_problem(post(client, scene=["hall", "pantry"]), 404, "scene_not_found", "scene")
        assert_problem(post(client, scene=[]), 400, "invalid_request")
        at_each_front(lambda: client.post("/scenes/cellar/unload"))
        until(lambda: states_are(client, attic="ready", cellar="unloaded", hall="ready"))
        job = post(client, scene="auto").json()
        assert {each["id"] for each in job["result"]["scene_ranking"]} == {"attic", "hall"}
        assert all(scene["jobs"] == 0 for scene in client.get("/scenes").json()["scenes"])


def test_no_scene_is_called_auto(tmp_path):
    (tmp_path / "auto").mkdir()
    (tmp_path / "auto" / "scene.ply").write_bytes(ply())
    with pytest.raises(BadInput, match="means all scenes"):
        named_scenes([tmp_path])


def test_scenes_of_one_name_get_ids_of_their_own(tmp_path):
    folders = [tmp_path / floor / "kitchen" for floor in ("first", "second", "attic/second")]
    for folder in folders:
        folder.mkdir(parents=True)
        (folder / "scene.ply").write_bytes(ply())
    named = named_scenes([*folders, folders[0]])  # one is given twice
    assert [(scene.id, scene.path) for scene in named] == list(
        zip(("kitchen", "second-kitchen", "second-kitchen-2"), folders, strict=True)
    )


def test_a_file_that_cannot_be_read_leaves_the_one_that_can(tmp_path):
    (tmp_path / "scene.ply").write_bytes(ply())
    (tmp_path / "biker.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n")
    assert load_scene(tmp_path).info.format == "ply"
    (tmp_path / "second.ply").write_bytes(ply())
    with pytest.raises(CorruptScene, match=r'"file": "scene\.ply"'):
        load_scene(tmp_path)


def service_on(folder: Path, **changes):
    return serving(create_app(settings(scenes=[folder], cache_dir=folder.parent / "cache", **changes)))


def states(client: httpx.Client) -> dict[str, str]:
    return {scene["id"]: scene["state"] for scene in client.get("/scenes").json()["scenes"]}


def states_are(client: httpx.Client, **expected: str) -> bool:
    """Return whether each front has its scenes in these states."""
    return all(found == expected for found in at_each_front(lambda: states(client)))


def ready(client: httpx.Client) -> None:
    until_ready(client)


# ------------------------------------------------------------------ in and out of memory


def test_only_what_is_preloaded_is_awaited_and_the_rest_comes_when_asked_for(stepping, folder):
    with service_on(folder, preload=["hall"]) as client:
        ready(client)
        assert states_are(client, attic="unloaded", cellar="unloaded", hall="ready")
        # A photo waits for its scene; a render of it doesn't.
        refused = client.get("/scenes/cellar/thumbnail.jpg")
        assert_problem(refused, 503, "scene_not_ready", "scene")
        assert refused.headers["retry-after"]
        assert post(client, scene="attic").json()["state"] == "succeeded"
        until(lambda: states(client)["attic"] == "ready")


def test_an_unknown_scene_to_preload_stops_the_start(folder, stepping):
    with pytest.raises(Exception, match="unknown scene"):
        create_app(settings(scenes=[folder], preload=["roof"]))


def test_the_scene_not_asked_for_longest_makes_room(stepping, folder):
    size = LoadedScene.load(folder / "attic").nbytes
    with service_on(folder, preload=["attic", "cellar"], scene_memory_bytes=int(2.5 * size)) as client:
        ready(client)
        for scene in ("attic", "hall"):  # cellar is not asked for
            answers = at_each_front(lambda scene=scene: post(client, scene=scene))
            assert {answer.json()["state"] for answer in answers} == {"succeeded"}
        until(lambda: states_are(client, attic="ready", cellar="unloaded", hall="ready"), 120)
        for scenes in at_each_front(lambda: client.get("/scenes").json()["scenes"]):
            told = {scene["id"]: scene["memory_bytes"] for scene in scenes}
            assert told == {"attic": size, "cellar": None, "hall": size}


@pytest.mark.parametrize("unexpected", [False, True])
def test_a_scene_that_fails_to_load_is_logged_and_a_bug_with_its_traceback(folder, monkeypatch, caplog, unexpected):
    (folder / "attic" / "scene.ply").unlink()
    if unexpected:
        monkeypatch.setattr(LoadedScene, "load", lambda *_, **__: {}["a bug"])
    scenes, entry = Scenes("view_index", None), Entry("attic", folder / "attic", required=True)
    scenes.add(entry)
    with caplog.at_level("ERROR"):
        scenes.start()
        until(lambda: entry.state == "failed")
        scenes.close()
    (logged,) = [record for record in caplog.records if "attic" in record.getMessage()]
    assert bool(logged.exc_info) is unexpected
    # Clients learn neither the operator's folders nor the bug.
    told = entry.status().failure
    assert told is not None
    assert (told.code, told.where) == (("internal_error", "") if unexpected else ("scene_not_found", "attic"))
    assert str(folder) not in told.message
    assert "a bug" not in told.message


def test_unloading_waits_for_the_jobs_and_lets_no_new_one_in(stepping, folder):
    with service_on(folder, preload=["attic"]) as client:
        ready(client)
        count, hold = 2 * FRONTS, {"hold": True}
        held = [post(client, prefer="", scene="attic", options=hold).headers["location"] for _ in range(count)]
        for answer in at_each_front(lambda: client.post("/scenes/attic/unload")):
            assert (answer.status_code, answer.json()["state"], answer.json()["jobs"]) == (202, "unloading", 2)
        for refused in at_each_front(lambda: post(client, scene="attic")):
            assert_problem(refused, 409, "scene_unloaded", "scene")
        stepping.GO_ON.set()
        assert [finished(client, path)["state"] for path in held] == ["succeeded"] * count
        until(lambda: states_are(client, attic="unloaded", cellar="unloaded", hall="unloaded"))
        for refused in at_each_front(lambda: post(client, scene="attic")):
            assert_problem(refused, 409, "scene_unloaded")
        for answer in at_each_front(lambda: client.post("/scenes/attic/load")):
            assert answer.json()["state"] == "loading"
        until(lambda: states_are(client, attic="ready", cellar="unloaded", hall="unloaded"), 120)
        assert post(client, scene="attic").json()["state"] == "succeeded"


def test_a_scene_without_a_file_cannot_be_unloaded(shared):
    assert_problem(shared.post("/scenes/room/unload"), 422, "bad_input", "scene")
    assert_problem(shared.delete("/scenes/room"), 409, "scene_in_use", "scene")
    assert_problem(shared.post("/scenes/none/load"), 404, "scene_not_found")


def test_a_restart_brings_back_a_scene_that_a_waiting_job_needs(stepping, folder, tmp_path):
    import shutil

    with service_on(folder, preload=["attic"], data_dir=tmp_path / "first") as client:
        ready(client)
        path = post(client, prefer="", scene="attic", options={"hold": True}).headers["location"]
        until(lambda: client.get(path).json()["records"] >= 1)
        shutil.copytree(tmp_path / "first", tmp_path / "copy")
        stepping.GO_ON.set()
    with service_on(folder, preload=["hall"], data_dir=tmp_path / "copy") as client:
        assert finished(client, path)["state"] == "succeeded"
        until(lambda: states(client)["attic"] == "ready")


# ------------------------------------------------------------------ uploads


def archive(**files: bytes | str) -> bytes:
    """A ZIP; `__` in a name stands for a slash, `_dot_` for a dot."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as opened:
        for name, content in files.items():
            opened.writestr(name.replace("__", "/").replace("_dot_", "."), content)
    return buffer.getvalue()


@pytest.fixture
def uploading(stepping, tmp_path):
    with serving(create_app(settings(data_dir=tmp_path / "data"), {"room": make_scene()})) as client:
        ready(client)
        yield client, tmp_path / "data"


def test_an_uploaded_scene_is_used_kept_and_deleted(uploading, stepping, tmp_path):
    client, data = uploading
    packed = archive(
        house__scene_dot_ply=ply(), house__transforms_dot_json=json.dumps(TRANSFORMS), house__notes_dot_txt="x"
    )
    made = client.put("/scenes/house", content=packed)
    assert made.status_code == 201
    until(lambda: states(client)["house"] == "ready", 120)
    assert scene_files(data, "house") == ["scene.ply", "transforms.json"]
    held = post(client, prefer="", scene="house", options={"hold": True}).headers["location"]
    assert_problem(client.delete("/scenes/house"), 409, "scene_in_use", "scene")
    stepping.GO_ON.set()
    assert finished(client, held)["state"] == "succeeded"
    assert_problem(client.put("/scenes/house", content=packed), 409, "scene_exists", "scene")
    assert client.delete("/scenes/house").status_code == 204
    assert not traces_of_uploads(data)
    assert client.put("/scenes/house", content=ply()).status_code == 201


def test_uploaded_scenes_are_there_after_a_restart(stepping, tmp_path):
    for _ in range(2):
        with serving(create_app(settings(data_dir=tmp_path), {"room": make_scene()})) as client:
            if "house" not in states(client):
                assert client.put("/scenes/house", content=ply()).status_code == 201
    assert scene_files(tmp_path, "house") == ["scene.ply"]


BOMB = archive(scene_dot_ply=b"ply\n" + b"0" * 5_000_000)


@pytest.mark.parametrize(
    ("content", "query", "status", "code"),
    [
        (b"?", "", 422, "unsupported_format"),
        (b"", "", 422, "corrupt_scene"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex 9\n", "", 422, "corrupt_scene"),
        (b"x", "?file=scene.exe", 400, "invalid_request"),
        (b"x", "?file=../../evil", 400, "invalid_request"),
        (archive(readme_dot_txt="x"), "", 422, "unsupported_format"),
        (archive(scene_dot_ply=b"ply"), "", 422, "corrupt_scene"),
        (archive(a_dot_ply=b"ply", b_dot_ply=b"ply"), "", 422, "corrupt_scene"),
        (BOMB, "", 422, "corrupt_scene"),
        (BOMB[:-30], "", 422, "unsupported_format"),
    ],
)  # fmt: skip
def test_what_is_no_scene_leaves_nothing(stepping, tmp_path, content, query, status, code):
    data = tmp_path / "data"
    app = create_app(settings(data_dir=data, max_scene_bytes=1_000_000), {"room": make_scene()})
    with serving(app) as client:
        assert_problem(client.put(f"/scenes/house{query}", content=content), status, code)
        assert list(states(client)) == ["room"]
        assert not traces_of_uploads(data)


@pytest.mark.parametrize("name", ["..", ".incoming", "a.b", "-x", "a%2Fb", "%2e%2e", "x" * 65, "a b", "é"])
def test_a_scenes_name_cannot_leave_the_folder(uploading, name):
    client, data = uploading
    before = sorted(data.rglob("*"))
    assert client.put(f"/scenes/{name}", content=ply()).status_code in (400, 404, 405)
    assert sorted(data.rglob("*")) == before


@pytest.mark.parametrize("name", ["../evil.ply", "/evil.ply", "a/../../evil.ply", "sparse/0/../../../evil.bin"])
def test_an_archives_names_cannot_leave_the_folder(uploading, name):
    client, data = uploading
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as opened:
        opened.writestr("scene.ply", ply())
        opened.writestr(name, b"evil")
    client.put("/scenes/house", content=buffer.getvalue())
    assert not [p for p in data.rglob("*") if p.name.startswith("evil")]
    assert not (data.parent / "evil.ply").exists()


@pytest.mark.parametrize(("length", "kept"), [(255, True), (256, False)])
def test_names_in_an_archive_may_be_as_long_as_those_of_files(tmp_path, length, kept):
    store = FolderSceneStore([], tmp_path, 10**6)
    # Two bytes a letter: file systems count bytes.
    name = f"{'é' * ((length - 4) // 2)}{'e' * (length % 2)}.ply"
    assert len(name.encode()) == length
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as opened:
        opened.writestr(name, ply())
    with (
        store.draft("house") as draft,
        nullcontext() if kept else pytest.raises(UnsupportedFormat, match="no scene file"),
    ):
        draft.write(buffer.getvalue())
        draft.commit("house.zip")
    assert [file.name for file in tmp_path.glob("house/*")] == [name] * kept


def test_an_archive_that_is_called_a_ply_is_unpacked(tmp_path):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as opened:
        opened.writestr("room.ply", ply())
    with FolderSceneStore([], tmp_path, 10**6).draft("house") as draft:
        draft.write(buffer.getvalue())
        draft.commit("house.ply")
    assert [file.name for file in tmp_path.glob("house/*.ply")] == ["room.ply"]


def test_a_scenes_name_has_at_most_64_characters(tmp_path):
    store = FolderSceneStore([], tmp_path, 10**6)
    for name in ("x", "x" * 64):
        with store.draft(name) as draft:
            draft.write(ply())
            draft.commit("scene.ply")
    assert [scene.id for scene in store.scenes()] == ["x", "x" * 64]
    for name in ("", "x" * 65):
        with pytest.raises(InvalidRequest, match="1 to 64"):
            store.draft(name)


# ------------------------------------------------------------------ mapped files


def test_a_second_load_maps_the_same_scene(folder, tmp_path):
    path, cache = folder / "attic", tmp_path / "cache2"
    manifest = {
        "up": [0, 0, 1],
        "geo_anchor": {"latitude": 1, "longitude": 2, "height": 3, "enu_from_world": np.eye(4).tolist()},
    }
    (path / "scene.json").write_text(json.dumps(manifest))
    read, first, second = load_scene(path), mapped_scene(path, cache), mapped_scene(path, cache)
    assert isinstance(second.means.base, np.memmap)
    for scene in (first, second):
        for name in ("means", "quats", "scales", "opacities", "sh"):
            assert np.array_equal(getattr(scene, name), getattr(read, name))
        assert isinstance(scene.info.geo_anchor, GeoAnchor)
        assert np.array_equal(scene.info.geo_anchor.enu_from_world, np.eye(4))
        assert (scene.info.sha256, scene.info.up_in_world) == (read.info.sha256, read.info.up_in_world)
        assert scene.cameras[0].name == read.cameras[0].name
        assert np.array_equal(
            scene.cameras[0].camera.pose.world_from_camera, read.cameras[0].camera.pose.world_from_camera
        )
    # It is rendered as the one that was read.
    pictures = [
        loaded.rasterizer.render([overview(loaded, 64)])[0].rgb for loaded in map(LoadedScene.of, (read, second))
    ]
    assert np.array_equal(*pictures)


def test_a_second_load_looks_at_no_gaussian(folder, tmp_path, monkeypatch):
    path, cache = folder / "attic", tmp_path / "cache2"
    # Without every second one; their opacities are what a scene without floaters differs in.
    odd = np.arange(50) % 2 == 1

    def without(scene: GaussianScene) -> GaussianScene:
        return replace(scene, opacities=np.where(odd, np.float32(0), scene.opacities))

    monkeypatch.setattr(searched_scene, "without_floaters", without)
    read = load_scene(path)
    expected = CpuRasterizer(without(read))
    camera = overview(LoadedScene.of(read), 64)
    (picture,) = expected.render([camera])
    LoadedScene.load(path, cache_dir=cache)
    monkeypatch.setattr(searched_scene, "without_floaters", None)
    monkeypatch.setattr(pack, "pack", None)
    loaded = LoadedScene.load(path, cache_dir=cache)
    assert np.array_equal(loaded.searched.opacities > 0, ~odd)
    assert np.array_equal(loaded.scene.opacities, read.opacities)
    for name in ("order", "geometry", "sh", "spheres", "chunk_spheres"):
        mapped = getattr(loaded.rasterizer.packed, name)
        assert isinstance(mapped.base, np.memmap)
        assert np.array_equal(mapped, getattr(expected.packed, name))
    assert np.array_equal(loaded.rasterizer.render([camera])[0].rgb, picture.rgb)
    # Gradients write into none of what is mapped.
    gradients = loaded.rasterizer.scene_gradients(camera, np.ones_like(picture.rgb))
    assert np.array_equal(gradients.index % 2, np.zeros(len(gradients.index)))


@pytest.mark.parametrize("garbage", [b"", b"\x93NUMPY garbage", "half", "another"])
def test_a_damaged_packed_scene_is_packed_again(folder, tmp_path, garbage):
    path, cache = folder / "attic", tmp_path / "cache2"
    LoadedScene.load(path, cache_dir=cache)
    (file,) = (cache / "scenes").glob("*/packed-*/sh.npy")
    (opacities,) = (cache / "scenes").glob("*/searched-*/opacities.npy")
    written = file.read_bytes()
    if garbage == "another":  # whole files, of another scene
        np.save(file, np.zeros(16, np.float32))
        np.save(opacities, np.zeros(3, np.float32))
    else:
        file.write_bytes(written[: len(written) // 2] if garbage == "half" else garbage)
        opacities.write_bytes(b"" if garbage == "half" else garbage)
    loaded = LoadedScene.load(path, cache_dir=cache)
    assert loaded.searched is loaded.scene
    assert np.array_equal(loaded.rasterizer.packed.sh, CpuRasterizer(load_scene(path)).packed.sh)
    assert file.read_bytes() == written
    # One folder of each, no drafts.
    folders = [entry.name.split("-")[0] for entry in file.parents[1].iterdir() if entry.is_dir()]
    assert sorted(folders) == ["packed", "searched"]


def test_a_file_replaced_by_one_of_its_size_and_time_is_read(folder, tmp_path):
    path, cache = folder / "attic", tmp_path / "cache2"
    mapped_scene(path, cache)
    file = path / "scene.ply"
    stat, other = file.stat(), file.read_bytes()[:-4] + np.float32(0.5).tobytes()
    (path / "new").write_bytes(other)
    os.utime(path / "new", ns=(stat.st_atime_ns, stat.st_mtime_ns))
    (path / "new").replace(file)
    assert (file.stat().st_size, file.stat().st_mtime_ns) == (stat.st_size, stat.st_mtime_ns)
    assert mapped_scene(path, cache).info.sha256 == load_scene(path).info.sha256


def test_a_changed_or_damaged_scene_is_read_anew(folder, tmp_path):
    path, cache = folder / "attic", tmp_path / "cache2"
    mapped_scene(path, cache)
    (kept,) = (cache / "scenes").iterdir()
    (kept / "sh.npy").write_bytes(b"\x93NUMPY garbage")
    (kept / "of another version.npy").touch()
    repaired = mapped_scene(path, cache)
    assert (repaired.count, repaired.sh.shape) == (50, (50, 1, 3))
    assert isinstance(repaired.means.base, np.memmap)  # the next start is quick again
    assert [file.name for file in (cache / "scenes").glob("*/*another*")] == []
    assert [entry.name for entry in (cache / "scenes").iterdir()] == [kept.name]
    (path / "scene.ply").write_bytes(ply(60))
    assert mapped_scene(path, cache).count == 60


def test_a_mapped_file_is_never_unpickled(folder, tmp_path):
    path, cache = folder / "attic", tmp_path / "cache2"
    mapped_scene(path, cache)
    (kept,) = (cache / "scenes").iterdir()
    np.save(kept / "sh.npy", np.array([{"evil": 1}], dtype=object), allow_pickle=True)
    assert mapped_scene(path, cache).sh.shape == (50, 1, 3)


def zipped(files: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as opened:
        for name, data in files.items():
            opened.writestr(name, data)
    return buffer.getvalue()


@pytest.mark.parametrize(
    "files",
    [
        {"room/": b"", "room/scene.ply": ply(), "__MACOSX/room/._scene.ply": b"\0\5\26\7", "room/.DS_Store": b"Bud1"},
        {"scene.ply": ply(), "._scene.ply": b"\0\5\26\7"},
        {"room\\scene.ply": ply(), "room\\transforms.json": b'{"frames": []}'},
        {"out/point_cloud/iteration_30000/point_cloud.ply": ply(), "out/cameras.json": b"[]", "out/cfg_args": b"()"},
        {"point_cloud/iteration_7/point_cloud.ply": ply()},
    ],
    ids=["Finder", "AppleDouble", "PowerShell", "Inria", "Inria without a top"],
)
def test_archives_as_programs_make_them(tmp_path, files):
    store = FolderSceneStore([], tmp_path, 10**6)
    with store.draft("room") as draft:
        draft.write(zipped(files))
        stored = draft.commit("scene.ply")
    assert load_scene(stored.path).count == load_scene(next(stored.path.rglob("*.ply"))).count
    assert not list(stored.path.rglob(".*"))


def test_a_scene_file_that_is_a_zip_is_no_archive(tmp_path):
    sog = (Path(__file__).parent / "data" / "formats" / "v2.sog").read_bytes()
    store = FolderSceneStore([], tmp_path, 10**6)
    for scene_id, name, stored_as in (("a", "room.sog", "scene.sog"), ("b", "scene.ply", "meta.json")):
        with store.draft(scene_id) as draft:
            draft.write(sog)
            stored = draft.commit(name)
        assert (stored.path / stored_as).is_file()
        assert load_scene(stored.path).count == 300


@pytest.mark.ci
def test_checkpoints_are_uploaded_only_where_that_is_allowed(tmp_path):
    splats = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh0": (1, 3)}
    file = io.BytesIO()
    torch.save({"splats": {name: torch.ones(9, *shape) for name, shape in splats.items()}}, file)
    for allowed in (False, True):
        store = FolderSceneStore([], tmp_path / str(allowed), 10**6, allow_checkpoints=allowed)
        with store.draft("room") as draft:
            draft.write(file.getvalue())
            if allowed:
                assert load_scene(draft.commit("ckpt_1.pt").path).count == 9
            else:
                with pytest.raises(UnsupportedFormat, match="can't be uploaded") as caught:
                    draft.commit("ckpt_1.pt")
                assert "upload_checkpoints" in caught.value.hint
                assert store.scenes() == []
