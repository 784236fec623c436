"""`/scenes/{id}/registration`: from jobs and points to results in metres; revisions, undo, and jobs under way."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from api_server import create_app, fake_estimators, finished, post, serving, settings, until
from registration_layouts import layout, planted
from test_scenes import TRANSFORMS, ply

from service.codec import encode
from service.geodesy import geographic
from service.geometry import look_at, quat_from_rotation
from service.registration.registration_file import FILE, RegistrationFile
from service.results import Status
from service.types import GeoAnchor, Pose

LENGTH = {"from_in_world": [0, 0, 0], "to_in_world": [0, 2, 0], "metres": 3.0}
PATH = "/scenes/hall/registration"


@pytest.fixture(scope="module")
def service(tmp_path_factory) -> Iterator[SimpleNamespace]:
    folder = tmp_path_factory.mktemp("registered")
    scene = folder / "hall"
    scene.mkdir()
    (scene / "scene.ply").write_bytes(ply(50))
    (scene / "transforms.json").write_text(json.dumps(TRANSFORMS))
    with fake_estimators() as stepping:
        app = create_app(settings(scenes=[scene], cache_dir=None, data_dir=folder / "data", queue_size=50))
        with serving(app) as client:
            until(lambda: client.get("/readyz").json()["ready"], 100)
            yield SimpleNamespace(client=client, app=app, scene=scene, stepping=stepping)
            stepping.GO_ON.set()
    stepping.GO_ON.clear()


@pytest.fixture(autouse=True)
def unregistered(service) -> Iterator[None]:
    yield
    (service.scene / FILE).unlink(missing_ok=True)


def job_at(service: SimpleNamespace, pose: Pose, seed: int) -> str:
    """Return a job that is on record as having found a pose."""
    job = post(service.client, scene="hall", seed=str(seed)).json()["id"]
    store = service.app.state.app_state.jobs._store
    result = store.result(job)
    verdict = replace(result.estimate.verdict, status=Status.LOCALIZED, covariance=np.eye(6) * 1e-8)
    changed = replace(result, estimate=replace(result.estimate, pose=pose, verdict=verdict))
    with store._database.transaction() as writer:
        writer.execute("UPDATE jobs SET result = ?, status = 'localized' WHERE id = ?", (encode(changed), job))
    return job


def test_photos_of_jobs_put_the_scene_on_earth(service):
    rng = np.random.default_rng(5)
    truth, places = planted(rng), layout("around", 6, rng)
    inverse = np.linalg.inv(truth.matrix)
    photos = []
    for number, place in enumerate(places):
        in_enu = look_at(place, place + rng.normal(size=3), np.array([0.0, 0.0, 1.0]))
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = truth.rotation.T @ in_enu.world_from_camera[:3, :3], (inverse @ [*place, 1])[:3]
        anchor = GeoAnchor(47.0, 8.0, 400.0, np.eye(4))
        (latitude, longitude, height), _ = geographic(anchor, in_enu)
        w, x, y, z = quat_from_rotation(in_enu.world_from_camera[:3, :3])
        position = {"latitude": latitude, "longitude": longitude, "height": height}
        photos.append({"job": job_at(service, Pose(matrix), number), **position, "qw": w, "qx": x, "qy": y, "qz": z})
    photos[2]["height"] += 20
    answer = service.client.post(PATH, json={"photos": photos})
    assert answer.status_code == 201, answer.text
    told = answer.json()
    assert (told["revision"], told["frame"], told["applies"]) == (1, "enu", True)
    assert told["determined"] == ["scale", "up", "heading", "position"]
    assert [r["used"] for r in told["residuals"]] == [number != 2 for number in range(6)]
    assert told["metres_per_unit"] == pytest.approx(truth.scale, rel=1e-4)
    assert service.client.get(PATH).json() == told
    # A job from now on is placed by it, one from before isn't.
    job = post(service.client, scene="hall", seed="77").json()
    placed = job["result"]["registered"]
    assert placed["revision"] == 1
    pose = Pose(np.array(job["result"]["pose"]["world_from_camera"]["matrix"]))
    latitude, longitude, height = geographic(GeoAnchor(47.0, 8.0, 400.0, truth.matrix), pose)[0]
    on_earth = job["result"]["geopose"]["position"]
    assert on_earth["lat"] == pytest.approx(latitude, abs=1e-7)
    assert on_earth["lon"] == pytest.approx(longitude, abs=1e-7)
    assert on_earth["h"] == pytest.approx(height, abs=1e-2)
    assert service.client.get(f"/jobs/{photos[0]['job']}").json()["result"]["registered"] is None


def test_revisions_are_undone_and_running_jobs_keep_theirs(service):
    client = service.client
    assert client.post(PATH, json={"lengths": [LENGTH]}).json()["revision"] == 1
    index = client.get("/scenes/hall").json()["sha256"]
    running = post(client, prefer="", scene="hall", options={"steps": 10**6, "pause_s": 0.05}).json()["id"]
    until(lambda: client.get(f"/jobs/{running}").json()["records"] > 0)
    second = client.post(PATH, json={"lengths": [{**LENGTH, "metres": 4.0}]}).json()
    assert (second["revision"], second["metres_per_unit"]) == (2, pytest.approx(2.0))
    assert client.get("/scenes/hall").json()["metres_per_unit"] == pytest.approx(2.0)
    service.stepping.GO_ON.set()
    client.delete(f"/jobs/{running}")
    finished(client, f"/jobs/{running}")
    service.stepping.GO_ON.clear()
    assert client.delete(PATH).json()["revision"] == 1
    assert client.delete(PATH).json() is None
    assert client.get(PATH).status_code == 404
    assert client.post(PATH, json={"lengths": [LENGTH]}).json()["revision"] == 3
    # No index is made again: the digest is the scene's alone.
    assert client.get("/scenes/hall").json()["sha256"] == index


def test_a_job_keeps_the_revision_that_it_was_accepted_with(service):
    engine = service.app.state.app_state.engine
    service.client.post(PATH, json={"lengths": [LENGTH]})
    held = engine.hold("hall")
    service.client.post(PATH, json={"lengths": [LENGTH]})
    try:
        assert [r.revision for r in engine._held[held.token].registrations] == [1]
    finally:
        engine.release(held.token)


def test_photos_of_another_scene_or_without_a_pose_are_refused(service):
    job = post(service.client, scene="hall", seed="5").json()["id"]
    answer = service.client.post(PATH, json={"photos": [{"job": job, "x": 0, "y": 0, "z": 0}]})
    assert answer.status_code == 400
    assert "must be of a single photo that was localized" in answer.json()["detail"]


def test_a_registration_of_another_version_of_the_scene_is_not_used(service):
    service.client.post(PATH, json={"lengths": [LENGTH]})
    file = RegistrationFile(service.scene)
    file.add(replace(file.current(), scene_sha256="0" * 64))
    assert service.client.get(PATH).json()["applies"] is False
    assert post(service.client, scene="hall", seed="9").json()["result"]["registered"] is None
