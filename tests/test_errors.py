"""Every error that the API says it may give is given, by every operation that says so; and no other is."""

from __future__ import annotations

import base64
import json
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace

import httpx
import pytest
from api_server import (
    PROBLEM,
    assert_as_shown,
    assert_problem,
    create_app,
    documented,
    fake_estimators,
    finished,
    operations,
    photo,
    post,
    serving,
    settings,
    until,
)
from stand_ins import TURNED, make_scene
from test_scenes import TRANSFORMS, ply

import service.jobs.photo_store
import service.scene_manager.scene_store
import service.web.key_file
import service.web.routes.keys
from service.codec import encode
from service.errors import BadInput, DeviceMemoryFull, SceneError, SplatfixError
from service.estimators import ESTIMATORS
from service.loaded_scene import LoadedScene
from service.scene_manager.entry import Entry
from service.web.api_keys import KeyRing
from service.web.key_file import add_key
from service.web.schemas.error_examples import EXAMPLES

OPERATIONS = {operation["operationId"]: (method, path, operation) for method, path, operation in operations()}
PAIRS = [
    (name, code)
    for name, (_, _, operation) in OPERATIONS.items()
    for codes in documented(operation).values()
    for code in sorted(codes)
]
EYE = [[float(i == j) for j in range(4)] for i in range(4)]
NO_FOCAL = {"width": 96, "height": 64, "fx": 0, "fy": 80, "cx": 48, "cy": 32}
ANCHOR = {"latitude": 1, "longitude": 2, "height": 3, "enu_from_world": EYE}


# ------------------------------------------------------------------ services in trouble


@pytest.fixture(scope="module")
def stepping() -> Iterator:
    with fake_estimators() as plugin:
        yield plugin


def write_scenes(folder: Path) -> None:
    """One that is well, and one for each thing that can be wrong; all but `plain` have a place on Earth."""
    broken = {"torn": ply(9)[:-1], "odd": b"ply\nformat ascii 1.0\nelement face 0\nend_header\n"}
    for name in ("good", "plain", "away", "slow", "fat", *broken):
        (folder / name).mkdir(parents=True)
        (folder / name / "scene.ply").write_bytes(broken.get(name) or ply(20_000 if name == "fat" else 50))
        (folder / name / "transforms.json").write_text(json.dumps(TRANSFORMS))
        if name != "plain":
            (folder / name / "scene.json").write_text(json.dumps({"geo_anchor": ANCHOR}))


@pytest.fixture(scope="module")
def troubled(stepping, tmp_path_factory) -> Iterator[SimpleNamespace]:
    """A service of which each part is in a state that some error tells of; with jobs of all kinds."""
    folder = tmp_path_factory.mktemp("troubled")
    write_scenes(folder / "scenes")
    with pytest.MonkeyPatch.context() as patch:
        load = LoadedScene.load.__func__

        def held(cls, path: Path, **options) -> LoadedScene:
            while path.name == "slow" and not stop:
                until(lambda: stop, 100)
            return load(cls, path, **options)

        stop: list[bool] = []
        patch.setattr(LoadedScene, "load", classmethod(held))
        # None is tried again meanwhile.
        patch.setattr("service.scene_manager.entry.RETRY_S", 1e6)
        patch.setattr("service.scene_manager.entry.MAX_RETRY_S", 1e6)
        size = LoadedScene.load(folder / "scenes" / "good").nbytes
        changes = {
            **{"scenes": [folder / "scenes"], "cache_dir": None, "data_dir": folder / "data", "queue_size": 50},
            **{"preload": ["good", "plain", "torn", "odd", "fat"], "scene_memory_bytes": int(5 * size)},
            **{"rate_limit": "", "photo_grace_s": 0, "workers": 3, "shutdown_s": 0},
        }
        app = create_app(settings(**changes))
        with serving(app) as client:
            until(lambda: not client.get("/readyz").json()["pending"], 100)
            client.post("/scenes/away/unload")
            client.post("/scenes/slow/load")
            done = post(client, scene="good").json()
            waiting = post(client, prefer="", scene="good", options={"steps": 10**6, "pause_s": 0.1}).json()
            until(lambda: client.get(f"/jobs/{waiting['id']}").json()["records"] >= 1)
            yield SimpleNamespace(
                client=client, app=app, done=done["id"], running=waiting["id"], patch=patch, folder=folder
            )
            stop.append(True)
            stepping.GO_ON.set()
    stepping.GO_ON.clear()


def on_scene(s: SimpleNamespace, scene: str) -> str:
    """Return the ended job, as if it had been on another scene."""
    # In a transaction of its own: inside of the service's nobody would see it before that ends.
    with s.app.state.app_state.jobs._store._database.transaction() as writer:
        writer.execute("UPDATE jobs SET scene = ? WHERE id = ?", (scene, s.done))
    return s.done


SCENES = {
    "scene_not_found": "none", "scene_unloaded": "away", "corrupt_scene": "torn", "unsupported_format": "odd",
    "scene_not_ready": "slow", "scene_too_large": "fat",
}  # fmt: skip


def send_photo(s: SimpleNamespace, data: bytes | None = None, **fields) -> httpx.Response:
    return post(s.client, data, prefer="", **{"scene": "good", **fields})


def geopose(
    s: SimpleNamespace, scene: str = "good", image: bytes | None = None, prior: dict | None = None, **reading
) -> httpx.Response:
    shot = {"imageBytes": base64.b64encode(photo() if image is None else image).decode(), **reading}
    known = {"geopose": {"position": {"lat": 0, "lon": 0, "h": 0}, "quaternion": prior}}
    request = {"sensorReadings": {"cameraReadings": [shot]}, "priorPoses": [known] if prior else []}
    return s.client.post(f"/geopose?scene={scene}", json=request)


def render(s: SimpleNamespace, scene: str = "good", **changes) -> httpx.Response:
    return s.client.post(f"/scenes/{scene}/render", json={"pose": {"world_from_camera": TURNED.tolist()}, **changes})


def twice(s: SimpleNamespace) -> httpx.Response:
    def keyed(seed: str) -> httpx.Response:
        files, headers = {"photo": photo()}, {"Idempotency-Key": "a"}
        return s.client.post("/localize", files=files, data={"scene": "good", "seed": seed}, headers=headers)

    keyed("1")
    return keyed("2")


def full(*_: object) -> None:
    raise OSError(28, "No space left on device")


def undeletable(path: Path, ignore_errors: bool = False) -> None:
    if not ignore_errors:
        full()


def with_full_gpu(send: Callable[[], httpx.Response]) -> httpx.Response:
    def refuse(*_: object) -> bytes:
        raise DeviceMemoryFull("the GPU has too little memory left.", where="render")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("service.jobs.embedded_engine.scene_images.picture", refuse)
        return send()


def with_full_disk(s: SimpleNamespace, send: Callable[[], httpx.Response]) -> httpx.Response:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(service.jobs.photo_store, "write_durably", full)
        patch.setattr(service.scene_manager.scene_store.os, "fsync", full)
        patch.setattr(service.scene_manager.scene_store.shutil, "rmtree", undeletable)
        app_state = s.app.state.app_state
        writers = [store._database._writer for store in (app_state.jobs._store, app_state.lenses)]
        for writer in writers:
            (pages,) = writer.execute("PRAGMA page_count").fetchone()
            writer.execute(f"PRAGMA max_page_count = {pages}")
            writer.execute("PRAGMA query_only = 1")
        try:
            return send()
        finally:
            for writer in writers:
                writer.execute("PRAGMA query_only = 0")
                writer.execute("PRAGMA max_page_count = 1000000")


def with_keys(s: SimpleNamespace, send: Callable[[], httpx.Response], *, unwritable: bool = False) -> httpx.Response:
    """As on a service with keys, which this one is not; `unwritable`: their file can't be written."""
    file = s.folder / "keys.json"
    if not file.exists():
        add_key(file, "boss", "admin")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(service.web.routes.keys, "_require_keys", lambda _: None)
        patch.setattr(s.app.state.app_state.keys, "_path", file)
        if unwritable:
            patch.setattr(service.web.key_file, "write_private", full)
        answer = send()
    file.unlink()
    return answer


def uploaded(s: SimpleNamespace) -> str:
    if "extra" not in {scene["id"] for scene in s.client.get("/scenes").json()["scenes"]}:
        assert s.client.put("/scenes/extra", content=ply()).status_code == 201
    return "/scenes/extra"


def delete_with_full_disk(s: SimpleNamespace) -> httpx.Response:
    path = uploaded(s)
    return with_full_disk(s, lambda: s.client.delete(path))


def delete_in_use(s: SimpleNamespace) -> httpx.Response:
    path = uploaded(s)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(s.app.state.app_state.engine._manager.entry("extra"), "jobs", 2)
        return s.client.delete(path)


def failing_geopose(s: SimpleNamespace, **options) -> httpx.Response:
    """GeoPoseProtocol has no options: the estimator gets them behind its back."""
    import service.estimators.stepping as plugin  # type: ignore[import-not-found]

    with pytest.MonkeyPatch.context() as patch:
        run = plugin.run
        patch.setattr(plugin, "run", lambda query, tools, _: run(query, tools, plugin.Options(**options)))
        return geopose(s)


def impatient_geopose(s: SimpleNamespace) -> httpx.Response:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(s.app.state.app_state.settings, "max_wait_s", 0.3)
        return failing_geopose(s, steps=10**6, pause_s=0.1)


def interrupted_geopose(s: SimpleNamespace) -> httpx.Response:
    """The scene is gone when the job starts."""
    from service.errors import Interrupted

    with pytest.MonkeyPatch.context() as patch:

        def gone(*_: object) -> None:
            raise Interrupted("told to.")

        patch.setattr(s.app.state.app_state.engine, "localize", gone)
        return geopose(s)


LENGTH = {"from_in_world": [0, 0, 0], "to_in_world": [1, 0, 0], "metres": 2}


def register(s: SimpleNamespace, scene: str = "good", **places) -> httpx.Response:
    return s.client.post(f"/scenes/{scene}/registration", json=places or {"lengths": [LENGTH]})


def damaged_registration(s: SimpleNamespace, method: str) -> httpx.Response:
    path = s.folder / "scenes" / "good" / "registration.json"
    path.write_text("{")
    try:
        return s.client.request(method, "/scenes/good/registration")
    finally:
        path.unlink()


POINT = {"position": [1, 2, 3]}


def damaged_anchors(s: SimpleNamespace, method: str, path: str) -> httpx.Response:
    file = s.folder / "scenes" / "good" / "anchors.json"
    file.write_text("{")
    try:
        return s.client.request(method, f"/scenes/good/anchors{path}", json=POINT if method == "PUT" else None)
    finally:
        file.unlink()


def delete_anchor_with_full_disk(s: SimpleNamespace) -> httpx.Response:
    assert s.client.put("/scenes/good/anchors/a", json=POINT).status_code == 200
    refused = with_full_disk(s, lambda: s.client.delete("/scenes/good/anchors/a"))
    (s.folder / "scenes" / "good" / "anchors.json").unlink()
    return refused


def undo_with_full_disk(s: SimpleNamespace) -> httpx.Response:
    assert register(s).status_code == 201
    refused = with_full_disk(s, lambda: s.client.delete("/scenes/good/registration"))
    (s.folder / "scenes" / "good" / "registration.json").unlink()
    return refused


# (operation, code) -> what provokes it; what is alike in all operations comes further down.
PROVOKED: dict[tuple[str, str], Callable[[SimpleNamespace], httpx.Response]] = {
    ("localize_photo", "invalid_request"): lambda s: send_photo(s, seed="x"),
    ("localize_photo", "bad_request"): lambda s: s.client.post(
        "/localize", content=b"x", headers={"Content-Type": "multipart/form-data"}
    ),
    ("localize_photo", "unsupported_media_type"): lambda s: s.client.post(
        "/localize", content=photo(), headers={"Content-Type": "image/jpeg"}
    ),
    ("localize_photo", "invalid_image"): lambda s: send_photo(s, b"x"),
    ("localize_photo", "invalid_intrinsics"): lambda s: send_photo(s, intrinsics=NO_FOCAL),
    ("localize_photo", "invalid_prior"): lambda s: send_photo(s, prior={"world_from_camera": [*EYE[:3], [1, 0, 0, 1]]}),
    ("localize_photo", "invalid_accuracy"): lambda s: send_photo(s, accuracy={"metres": 0.1}),
    ("localize_photo", "invalid_options"): lambda s: send_photo(s, options={"topk": 1}),
    ("localize_photo", "unknown_name"): lambda s: send_photo(s, estimator="magic"),
    ("localize_photo", "backend_missing"): lambda s: send_photo(s, estimator="absent"),
    ("localize_photo", "idempotency_conflict"): twice,
    ("localize_photo", "storage_failed"): lambda s: with_full_disk(s, lambda: send_photo(s)),
    ("geopose", "invalid_request"): lambda s: s.client.post("/geopose", json={}),
    ("geopose", "bad_request"): lambda s: s.client.post(
        "/geopose", content=b"\xff", headers={"Content-Type": "application/json"}
    ),
    ("geopose", "no_geo_anchor"): lambda s: geopose(s, "plain"),
    ("geopose", "invalid_image"): lambda s: geopose(s, image=b"x"),
    ("geopose", "invalid_intrinsics"): lambda s: geopose(s, params={"model": "MAGIC", "modelParams": [1]}),
    ("geopose", "invalid_prior"): lambda s: geopose(s, prior={"x": 1, "y": 1, "z": 0, "w": 0}),
    ("geopose", "no_pose"): geopose,
    ("geopose", "deadline_exceeded"): impatient_geopose,
    ("geopose", "estimator_fault"): lambda s: failing_geopose(s, steps=0),
    ("geopose", "interrupted"): interrupted_geopose,
    ("geopose", "storage_failed"): lambda s: with_full_disk(s, lambda: geopose(s)),
    ("list_jobs", "invalid_request"): lambda s: s.client.get("/jobs?limit=0"),
    ("cancel_job", "invalid_request"): lambda s: s.client.delete(f"/jobs/{s.done}?purge=perhaps"),
    ("cancel_job", "job_not_ready"): lambda s: s.client.delete(f"/jobs/{s.running}?purge=true"),
    ("cancel_job", "storage_failed"): lambda s: with_full_disk(s, lambda: s.client.delete(f"/jobs/{s.running}")),
    ("job_photo", "invalid_request"): lambda s: s.client.get(f"/jobs/{s.done}/photo?undistorted=perhaps"),
    ("job_photo", "photo_gone"): lambda s: s.client.get(f"/jobs/{s.done}/photo"),
    ("job_photo", "job_not_ready"): lambda s: s.client.get(f"/jobs/{recovered(s)}/photo"),
    ("job_render", "invalid_request"): lambda s: s.client.get(f"/jobs/{s.done}/iterations/x/render.jpg"),
    ("job_render", "record_not_found"): lambda s: s.client.get(f"/jobs/{s.done}/iterations/99/render.jpg"),
    ("job_render", "job_not_ready"): lambda s: s.client.get(f"/jobs/{s.running}/iterations/99/render.jpg"),
    ("export_pose", "invalid_request"): lambda s: s.client.get(f"/jobs/{s.done}/export/dwg"),
    ("export_pose", "job_not_ready"): lambda s: s.client.get(f"/jobs/{s.running}/export/tum"),
    ("export_pose", "no_pose"): lambda s: s.client.get(f"/jobs/{s.done}/export/tum"),
    ("export_pose", "no_geo_anchor"): lambda s: s.client.get(f"/jobs/{localized(s)}/export/geopose"),
    ("share_job", "invalid_request"): lambda s: s.client.post(f"/jobs/{s.done}/share", json={"expires_in_s": 0}),
    ("share_job", "bad_request"): lambda s: s.client.post(
        f"/jobs/{s.done}/share", content=b"\xff", headers={"Content-Type": "application/json"}
    ),
    ("share_job", "job_not_found"): lambda s: s.client.post("/jobs/none/share", json={}),
    ("get_scene", "scene_not_found"): lambda s: s.client.get("/scenes/none"),
    ("load_scene", "scene_not_found"): lambda s: s.client.post("/scenes/none/load"),
    ("unload_scene", "scene_not_found"): lambda s: s.client.post("/scenes/none/unload"),
    ("unload_scene", "bad_input"): lambda s: fileless(s).client.post("/scenes/hall/unload"),
    ("delete_scene", "scene_not_found"): lambda s: s.client.delete("/scenes/none"),
    ("delete_scene", "scene_in_use"): delete_in_use,
    ("delete_scene", "storage_failed"): delete_with_full_disk,
    ("upload_scene", "invalid_request"): lambda s: s.client.put("/scenes/new?file=a.exe", content=b"x"),
    ("upload_scene", "scene_exists"): lambda s: s.client.put("/scenes/good", content=ply()),
    ("upload_scene", "corrupt_scene"): lambda s: s.client.put("/scenes/new", content=b"ply\n"),
    ("upload_scene", "unsupported_format"): lambda s: s.client.put("/scenes/new", content=b"?"),
    ("upload_scene", "storage_failed"): lambda s: with_full_disk(s, lambda: s.client.put("/scenes/new", content=ply())),
    ("scene_splats", "invalid_request"): lambda s: s.client.get("/scenes/good/splats?max=0"),
    ("render_scene", "invalid_request"): lambda s: s.client.post("/scenes/good/render", json={}),
    ("render_scene", "bad_request"): lambda s: s.client.post(
        "/scenes/good/render", content=b"\xff", headers={"Content-Type": "application/json"}
    ),
    ("render_scene", "invalid_intrinsics"): lambda s: render(s, intrinsics={}),
    ("render_scene", "invalid_prior"): lambda s: render(s, pose={}),
    ("render_scene", "device_memory_full"): lambda s: with_full_gpu(lambda: render(s)),
    ("register_scene", "invalid_request"): lambda s: register(s, photos=[]),
    ("register_scene", "bad_request"): lambda s: s.client.post(
        "/scenes/good/registration", content=b"\xff", headers={"Content-Type": "application/json"}
    ),
    ("register_scene", "bad_input"): lambda s: register(fileless(s), "hall"),
    ("register_scene", "job_not_found"): lambda s: register(s, photos=[{"job": "none", "x": 0, "y": 0, "z": 0}]),
    ("register_scene", "job_not_ready"): lambda s: register(s, photos=[{"job": s.running, "x": 0, "y": 0, "z": 0}]),
    ("register_scene", "registration_failed"): lambda s: register(
        s, points=[{"in_world": [0, 0, 0], "x": 1, "y": 2, "z": 3}] * 4
    ),
    ("register_scene", "storage_failed"): lambda s: with_full_disk(s, lambda: register(s)),
    ("get_registration", "scene_not_found"): lambda s: s.client.get("/scenes/none/registration"),
    ("get_registration", "registration_not_found"): lambda s: s.client.get("/scenes/good/registration"),
    ("get_registration", "corrupt_scene"): lambda s: damaged_registration(s, "GET"),
    ("get_coverage", "scene_not_found"): lambda s: s.client.get("/scenes/none/coverage"),
    ("cancel_coverage", "scene_not_found"): lambda s: s.client.delete("/scenes/none/coverage"),
    ("list_anchors", "scene_not_found"): lambda s: s.client.get("/scenes/none/anchors"),
    ("list_anchors", "corrupt_scene"): lambda s: damaged_anchors(s, "GET", ""),
    ("put_anchor", "invalid_request"): lambda s: s.client.put("/scenes/good/anchors/a", json={"position": [1]}),
    ("put_anchor", "bad_request"): lambda s: s.client.put(
        "/scenes/good/anchors/a", content=b"\xff", headers={"Content-Type": "application/json"}
    ),
    ("put_anchor", "scene_not_found"): lambda s: s.client.put("/scenes/none/anchors/a", json=POINT),
    ("put_anchor", "bad_input"): lambda s: fileless(s).client.put("/scenes/hall/anchors/a", json=POINT),
    ("put_anchor", "corrupt_scene"): lambda s: damaged_anchors(s, "PUT", "/a"),
    ("put_anchor", "storage_failed"): lambda s: with_full_disk(
        s, lambda: s.client.put("/scenes/good/anchors/a", json=POINT)
    ),
    ("delete_anchor", "invalid_request"): lambda s: s.client.delete(f"/scenes/good/anchors/{65 * 'a'}"),
    ("delete_anchor", "scene_not_found"): lambda s: s.client.delete("/scenes/none/anchors/a"),
    ("delete_anchor", "anchor_not_found"): lambda s: s.client.delete("/scenes/good/anchors/none"),
    ("delete_anchor", "corrupt_scene"): lambda s: damaged_anchors(s, "DELETE", "/a"),
    ("delete_anchor", "storage_failed"): delete_anchor_with_full_disk,
    ("undo_registration", "scene_not_found"): lambda s: s.client.delete("/scenes/none/registration"),
    ("undo_registration", "registration_not_found"): lambda s: s.client.delete("/scenes/good/registration"),
    ("undo_registration", "corrupt_scene"): lambda s: damaged_registration(s, "DELETE"),
    ("undo_registration", "storage_failed"): undo_with_full_disk,
    ("delete_lens", "lens_not_found"): lambda s: s.client.delete("/lenses/0123456789abcdef"),
    ("delete_lens", "storage_failed"): lambda s: with_full_disk(s, lambda: s.client.delete("/lenses/0")),
    ("delete_lenses", "storage_failed"): lambda s: with_full_disk(s, lambda: s.client.delete("/lenses")),
    ("list_keys", "no_keys"): lambda s: s.client.get("/keys"),
    ("add_key", "invalid_request"): lambda s: s.client.put("/keys/robot", json={"role": "god"}),
    ("add_key", "bad_request"): lambda s: s.client.put(
        "/keys/robot", content=b"\xff", headers={"Content-Type": "application/json"}
    ),
    ("add_key", "no_keys"): lambda s: s.client.put("/keys/robot", json={}),
    ("add_key", "storage_failed"): lambda s: with_keys(
        s, lambda: s.client.put("/keys/robot", json={}), unwritable=True
    ),
    ("remove_key", "invalid_request"): lambda s: s.client.delete("/keys/a:b"),
    ("remove_key", "key_not_found"): lambda s: with_keys(s, lambda: s.client.delete("/keys/robot")),
    ("remove_key", "no_keys"): lambda s: s.client.delete("/keys/robot"),
    ("remove_key", "storage_failed"): lambda s: with_keys(s, lambda: s.client.delete("/keys/boss"), unwritable=True),
    ("make_token", "no_keys"): lambda s: s.client.post("/tokens"),
}
for _code, _scene in SCENES.items():
    PROVOKED |= {
        ("localize_photo", _code): lambda s, scene=_scene: send_photo(s, scene=scene),
        ("geopose", _code): lambda s, scene=_scene: geopose(s, scene),
        ("job_render", _code): lambda s, scene=_scene: s.client.get(
            f"/jobs/{on_scene(s, scene)}/iterations/0/render.jpg"
        ),
        ("scene_thumbnail", _code): lambda s, scene=_scene: s.client.get(f"/scenes/{scene}/thumbnail.jpg"),
        ("scene_splats", _code): lambda s, scene=_scene: s.client.get(f"/scenes/{scene}/splats"),
        ("render_scene", _code): lambda s, scene=_scene: render(s, scene),
        ("register_scene", _code): lambda s, scene=_scene: register(s, scene),
        ("measure_coverage", _code): lambda s, scene=_scene: s.client.post(f"/scenes/{scene}/coverage"),
    }
# A photo waits for its scene.
del PROVOKED["localize_photo", "scene_not_ready"]
for _name in ("get_job", "cancel_job", "job_events", "job_photo", "job_trace", "job_render", "export_pose"):
    PROVOKED[_name, "job_not_found"] = lambda s, name=_name: plainly(s.client, name, job="none")


def plainly(client: httpx.Client, name: str, job: str = "x", **headers: str) -> httpx.Response:
    """Ask for something that would be well, as far as the address goes."""
    method, pattern, _ = OPERATIONS[name]
    path = pattern.pattern.replace("[^/]+", "{}")
    fills = ("0",) if path.startswith("/scenes") else (job, "0" if "iterations" in path else "tum")
    path = path.format(*(("good", "a") if path.startswith("/scenes") else fills))
    return client.request(method, path, headers=headers)


def recovered(s: SimpleNamespace) -> str:
    """A job after a restart, whose scene isn't there yet."""
    from service.jobs.live_job import LiveJob

    s.app.state.app_state.jobs._live[s.done] = LiveJob(s.done, "slow")
    s.client.event_hooks["response"].append(lambda _: s.app.state.app_state.jobs._live.pop(s.done, None))
    return s.done


def localized(s: SimpleNamespace) -> str:
    store = s.app.state.app_state.jobs._store
    writer, result = store._database._writer, store.result(s.done)
    writer.execute("UPDATE jobs SET status = 'localized' WHERE id = ?", (s.done,))
    writer.execute("UPDATE jobs SET result = ? WHERE id = ?", (encode(replace(result, geo_anchor=None)), s.done))
    s.client.event_hooks["response"].append(
        lambda _: writer.execute("UPDATE jobs SET status = 'not_localized' WHERE id = ?", (s.done,))
    )
    return s.done


def fileless(s: SimpleNamespace) -> SimpleNamespace:
    engine = s.app.state.app_state.engine
    engine._manager.add(Entry("hall", None, loaded=make_scene("hall"), state="ready"))
    return s


# Code -> the operation whose answer its example shows; the other examples are compared where they come up.
SHOWN = {code: "localize_photo" for name, code in PROVOKED if name == "localize_photo"} | {
    **dict.fromkeys(("deadline_exceeded", "estimator_fault"), "geopose"),
    **dict.fromkeys(("job_not_ready", "no_pose", "no_geo_anchor"), "export_pose"),
    **{"photo_gone": "job_photo", "record_not_found": "job_render", "job_not_found": "get_job"},
    **{"scene_not_found": "get_scene", "bad_input": "unload_scene", "scene_in_use": "delete_scene"},
    **{
        "scene_not_ready": "render_scene",
        "device_memory_full": "render_scene",
        "scene_exists": "upload_scene",
        "no_keys": "make_token",
        "lens_not_found": "delete_lens",
        "key_not_found": "remove_key",
        "anchor_not_found": "delete_anchor",
        "registration_failed": "register_scene",
        "registration_not_found": "get_registration",
        "interrupted": "see test_durable",
    },
}

LIKE_ALL = ("unauthorized", "forbidden", "internal_error", "content_too_large", "rate_limited", "queue_full")
SPECIFIC = [pair for pair in PAIRS if pair[1] not in (*LIKE_ALL, "request_timeout")]


@pytest.mark.parametrize(("name", "code"), SPECIFIC, ids=lambda value: str(value))
def test_an_operation_gives_the_error_that_it_tells_of(troubled, name, code):
    hooks = list(troubled.client.event_hooks["response"])
    try:
        answer = PROVOKED[name, code](troubled)
    finally:
        troubled.client.event_hooks["response"] = hooks
        on_scene(troubled, "good")
    assert_problem(answer, EXAMPLES[code].status, code)
    method, pattern, _ = OPERATIONS[name]
    assert answer.request.method == method
    assert pattern.fullmatch(answer.request.url.path)
    if name == SHOWN[code]:
        assert_as_shown(answer.json())


def test_nothing_is_provoked_that_is_not_told():
    assert PROVOKED.keys() == set(SPECIFIC)


# ------------------------------------------------------------------ alike in all operations


def telling(code: str) -> list[str]:
    return [name for name, told in PAIRS if told == code]


def test_the_gate_stops_every_operation(stepping, tmp_path):
    key = add_key(tmp_path / "keys.json", "reader", "read")
    app = create_app(settings(keys_file=tmp_path / "keys.json"), {"good": make_scene("good")})
    with serving(app) as client:
        assert set(telling("unauthorized")) == set(OPERATIONS)
        for name in OPERATIONS:
            assert_problem(plainly(client, name, Authorization="Bearer wrong"), 401, "unauthorized")
        assert_as_shown(plainly(client, "list_jobs").json())
        assert_as_shown(plainly(client, "localize_photo", Authorization=f"Bearer {key}").json())
    with serving(create_app(settings(), {"good": make_scene("good")})) as client:
        assert set(telling("forbidden")) == set(OPERATIONS)
        for name in OPERATIONS:
            assert_problem(plainly(client, name, Host="evil.example"), 403, "forbidden", "header.host")


def test_a_bug_in_any_operation_is_told_without_details(stepping):
    app = create_app(settings(), {"good": make_scene("good")})
    assert set(telling("internal_error")) == set(OPERATIONS) - {"live", "get_version", "get_own_key"}
    with serving(app) as client:
        app_state = app.state.app_state
        del app.state.app_state
        for name in telling("internal_error"):
            # The queue's state is asked for before anything else; that it fails is no less a bug.
            answer = plainly(client, name)
            assert_problem(answer, 500, "internal_error")
            assert_as_shown(answer.json())
            assert "app_state" not in answer.text
        app.state.app_state = app_state


WRITING = {name for name, (method, _, _) in OPERATIONS.items() if method != "GET"}


def test_limits_hold_for_every_operation_that_changes_something(stepping):
    for code in ("content_too_large", "rate_limited", "queue_full"):
        assert set(telling(code)) == WRITING
    with serving(create_app(settings(rate_limit="1/hour"), {"good": make_scene("good")})) as client:
        client.post("/tokens")
        for name in WRITING:
            answer = plainly(client, name)
            assert_problem(answer, 429, "rate_limited")
            assert_as_shown(answer.json())
            assert int(answer.headers["retry-after"]) > 0
    with serving(create_app(settings(max_uploads=1, rate_limit=""), {"good": make_scene("good")})) as client:
        for name in WRITING:
            status, problem = of_head(client, name, f"Content-Length: {10**13}")
            assert (status, problem["code"]) == (413, "content_too_large")
            assert_as_shown(problem)
        with upload_under_way(client):
            for name in WRITING:
                answer = plainly(client, name)
                assert_problem(answer, 503, "queue_full")
                assert int(answer.headers["retry-after"]) > 0


def test_a_body_that_does_not_come_is_given_up(stepping):
    changes = {"upload_s": 0.01, "max_upload_bytes": 1, "max_scene_bytes": 1000, "rate_limit": ""}
    with serving(create_app(settings(**changes), {"good": make_scene("good")})) as client:
        for name in telling("request_timeout"):
            kind = "multipart/form-data; boundary=x" if name == "localize_photo" else "application/json"
            status, problem = of_head(client, name, f"Content-Type: {kind}\r\nContent-Length: 100", scene="new")
            assert (name, status, problem["code"]) == (name, 408, "request_timeout")
            assert_as_shown(problem)


def of_head(client: httpx.Client, name: str, lines: str, scene: str = "good") -> tuple[int, dict]:
    """Send the head of a request and no body; return the answer's status and problem."""
    method, pattern, _ = OPERATIONS[name]
    path = pattern.pattern.replace("[^/]+", scene if name == "upload_scene" else "good")
    with socket.create_connection((client.base_url.host, client.base_url.port)) as connection:
        connection.settimeout(20)
        connection.sendall(f"{method} {path} HTTP/1.1\r\nHost: 127.0.0.1\r\n{lines}\r\n\r\n".encode())
        answer = b""
        while not answer.endswith(b"}"):
            answer += connection.recv(65536)
    head, _, body = answer.partition(b"\r\n\r\n")
    problem = json.loads(body)
    assert problem.keys() == PROBLEM
    return int(head.split()[1]), problem


@contextmanager
def upload_under_way(client: httpx.Client) -> Iterator[None]:
    head = "POST /localize HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\nContent-Length: 99\r\n"
    with socket.create_connection((client.base_url.host, client.base_url.port)) as connection:
        connection.sendall(f"{head}\r\n{{".encode())
        connection.settimeout(0.5)
        with pytest.raises(TimeoutError):  # no answer: it waits for the rest
            connection.recv(1)
        yield


# ------------------------------------------------------------------ the catalogue itself


def test_every_error_has_an_example_and_each_example_its_error():
    def below(kind: type) -> set[type]:
        return {kind}.union(*(below(sub) for sub in kind.__subclasses__()))

    bases = {SplatfixError, SceneError}  # never raised themselves
    ours = {kind.code for kind in below(SplatfixError) - bases if kind.__module__ == "service.errors"}
    http = {
        *("bad_request", "not_found", "method_not_allowed", "request_timeout", "content_too_large"),
        *("unsupported_media_type", "unavailable", "internal_error"),
    }
    assert set(EXAMPLES) == ours | http
    assert BadInput.code in EXAMPLES


def test_no_error_is_without_a_hint():
    assert not [code for code, problem in EXAMPLES.items() if not problem.hint]


def test_the_names_in_the_examples_are_real():
    named = EXAMPLES["unknown_name"].detail.rpartition("known: ")[2].rstrip(".").split(", ")
    assert set(named) == set(ESTIMATORS.names()) - {"absent", "stepping"}
    named = EXAMPLES["invalid_options"].detail.rpartition("it has: ")[2].rstrip(".").split(", ")
    assert named == sorted(field.name for field in fields(ESTIMATORS.load("view_index").Options))


def test_a_full_queue_is_shown_as_it_is(troubled, monkeypatch):
    jobs = troubled.app.state.app_state.jobs
    monkeypatch.setattr(jobs._queue, "full", lambda: True)
    answer = send_photo(troubled)
    assert_problem(answer, 503, "queue_full")
    assert_as_shown(answer.json())


def test_the_document_shows_the_examples():
    shown = create_app(settings(estimator="view_index")).openapi()["components"]["examples"]
    assert {code: example["value"] for code, example in shown.items()} == {
        code: problem.model_dump() for code, problem in EXAMPLES.items()
    }


def test_what_belongs_to_no_operation_is_a_problem_document_too(shared):
    unknown, wrong = shared.get("/nowhere"), shared.put("/localize")
    assert_problem(unknown, 404, "not_found")
    assert_problem(wrong, 405, "method_not_allowed")
    assert_as_shown(unknown.json())
    assert_as_shown(wrong.json())
    refused = shared.patch("/jobs/x")
    assert_problem(refused, 405, "method_not_allowed")
    assert refused.headers["allow"] == "DELETE, GET"


def test_a_viewer_that_is_gone_is_told(stepping):
    from service.web.viewer_relay import Relay

    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    app = create_app(settings(), {"good": make_scene("good")})
    app.include_router(Relay(SimpleNamespace(port=port), KeyRing(None)).router)
    with serving(app) as client:
        answer = client.get("/viewer/")
        assert_problem(answer, 503, "unavailable")
        assert_as_shown(answer.json())
        assert answer.headers["retry-after"]


JOB_ERRORS = {
    "estimator_fault": {"options": {"fail": "fault"}},
    "internal_error": {"options": {"fail": "bug"}},
    "deadline_exceeded": {"deadline_s": 1e-6},
}


@pytest.mark.parametrize("code", JOB_ERRORS)
def test_a_jobs_own_error_is_one_of_the_catalogue(troubled, code):
    """`interrupted` and the scenes' errors: see test_durable."""
    job = send_photo(troubled, **JOB_ERRORS[code]).json()
    error = finished(troubled.client, job["links"]["self"])["error"]
    assert (error["code"], error["status"]) == (code, EXAMPLES[code].status)
