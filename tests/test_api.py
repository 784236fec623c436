"""The HTTP API over a real server and real sockets; only the engine's parts are small stand-ins."""

from __future__ import annotations

import base64
import gzip
import hashlib
import io
import json
import socket
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import yaml
from api_server import (
    ROOT,
    assert_problem,
    at_each_front,
    create_app,
    events,
    finished,
    operations,
    photo,
    post,
    serving,
    settings,
    until,
    until_ready,
)
from PIL import Image
from stand_ins import HALF, PHOTO, TURNED, BlindMatcher, make_scene
from two_fronts import FRONTS, THROUGH_A_GATEWAY

import service.estimators
from service.loaded_scene import LoadedScene
from service.types import Camera, GaussianScene, Intrinsics, NamedCamera, Pose, SceneInfo
from service.web import hints
from service.web.schemas import resources
from service.web.schemas.job_spec import job_spec, read_fields
from service.web.schemas.request_body import parsed_json
from service.web.schemas.requests import FIELD_ERRORS, LocalizeFields
from service.web.settings import Settings

# ------------------------------------------------------------------ the life of a job


def test_a_photo_becomes_a_job_becomes_a_result(shared):
    accepted = post(shared, prefer="", seed="7", options={"steps": 4})
    assert accepted.status_code == 202
    path = accepted.headers["location"]
    assert path == f"/jobs/{accepted.json()['id']}" == accepted.json()["links"]["self"]
    job = finished(shared, path)
    assert job["state"] == "succeeded"
    assert job["error"] is None
    assert (job["records"], job["options"], job["seed"]) == (4, {"steps": 4}, 7)
    result = job["result"]
    # Nothing matches grey: the gate, which is the real one, must say so, and that is no error.
    assert (result["status"], result["reason"]) == ("not_localized", "few_features")
    assert result["hint"]
    assert [t["stage"] for t in result["timings"]] == ["decode", "step", "verify"]
    assert result["scene"] == {"id": "room", "sha256": "ab" * 32}
    assert (result["estimator"], result["matcher"], result["rasterizer"]) == ("stepping", "blind", "flat")
    assert result["intrinsics_source"] == "guessed"
    assert result["warnings"]
    assert {"splatfix", "numpy", "numba", "torch"} <= result["versions"].keys()


def test_the_pose_is_right_in_every_spelling(shared):
    pose = post(shared).json()["result"]["pose"]
    assert pose["position"] == [1, 2, 3]
    assert pose["world_from_camera"]["matrix"] == TURNED.tolist()
    # By hand: a quarter turn about z; the inverse turns back; OpenGL's y and z axes point the other way.
    assert np.allclose(pose["world_from_camera"]["quaternion_wxyz"], [HALF, 0, 0, HALF])
    assert np.allclose(pose["camera_from_world"]["quaternion_wxyz"], [HALF, 0, 0, -HALF])
    assert np.allclose(pose["camera_from_world"]["translation"], [-2, 1, -3])
    opengl = np.array(pose["opengl"]["world_from_camera"]["matrix"])
    assert np.allclose(opengl, TURNED * [1, -1, -1, 1])
    assert np.allclose(pose["opengl"]["camera_from_world"]["matrix"], np.linalg.inv(opengl))


def test_json_and_form_are_the_same_request(shared):
    given = {"width": 96, "height": 64, "fx": 80, "fy": 80, "cx": 48, "cy": 32}
    fields = {"scene": "room", "intrinsics": given, "seed": 3, "budget_s": 5, "options": {"steps": 2}}
    body = {"photo": base64.b64encode(photo()).decode(), **fields}
    by_json = shared.post("/localize", json=body, headers={"Prefer": "wait=20"}).json()
    by_form = post(shared, **fields).json()
    for job in (by_json, by_form):
        for name in ("id", "created", "started", "finished", "links", "photo"):
            job.pop(name)
        job["result"].pop("timings")
    assert by_json == by_form
    assert by_form["result"]["intrinsics_source"] == "given"


@pytest.mark.parametrize("form", ["data:image/jpeg;base64,{}", "lines", "url", "unpadded"])
def test_a_photo_is_taken_in_every_form_of_base64(shared, form):
    data = photo()
    text = base64.b64encode(data).decode()
    if form == "lines":  # RFC 2045, as Android's default
        text = base64.encodebytes(data).decode()
    elif form == "url":
        text = base64.urlsafe_b64encode(data).decode()
        assert text != base64.b64encode(data).decode()
    else:
        text = form.format(text) if "{" in form else text.rstrip("=")
    answer = shared.post("/localize", json={"photo": text, "scene": "room"}, headers={"Prefer": "wait=20"})
    assert (answer.status_code, answer.json()["state"]) == (200, "succeeded")


def test_a_packed_body_is_refused_by_the_name_of_its_encoding(shared):
    answer = shared.post(
        "/localize",
        content=gzip.compress(b"{}"),
        headers={"Content-Type": "application/json", "Content-Encoding": "gzip"},
    )
    assert answer.status_code == 415
    assert "Content-Encoding 'gzip'" in answer.json()["detail"]


def test_a_quaternion_of_another_length_is_told_where_it_is(shared):
    answer = post(shared, prior={"position": [0, 0, 0], "quaternion_wxyz": [0, 0, 0, 0]})
    assert (answer.status_code, answer.json()["where"]) == (422, "prior.quaternion_wxyz")


@pytest.mark.parametrize("path", ["/livez", "/readyz", "/", "/scenes", "/scenes/room/thumbnail.jpg"])
def test_head_has_the_head_of_get_and_no_body(shared, path):
    got, head = shared.get(path), shared.head(path)
    assert (head.status_code, head.content) == (got.status_code, b"")
    assert head.headers["content-type"] == got.headers["content-type"]
    assert head.headers["content-length"] == got.headers["content-length"]


def test_head_of_a_stream_ends(shared):
    job = post(shared).json()
    assert shared.head(job["links"]["events"]).headers["content-type"].startswith("text/event-stream")


def test_prefer_wait_answers_at_once_or_accepts(client, stepping):
    done = post(client, prefer="respond-async, wait=20")
    assert (done.status_code, done.json()["state"]) == (200, "succeeded")
    assert done.headers["preference-applied"] == "wait=20"
    began = time.monotonic()
    held = post(client, prefer="wait=1", options={"hold": True})
    assert (held.status_code, held.json()["state"]) == (202, "running")
    assert 0.9 < time.monotonic() - began < 5


def test_the_truth_is_kept_with_the_job_and_reaches_no_estimator(shared):
    truth = {"world_from_camera": np.eye(4).tolist(), "convention": "opengl"}
    job = post(shared, truth=truth).json()
    assert job["prior"] is None
    told = np.array(job["truth"]["world_from_camera"]["matrix"])
    assert np.allclose(told, np.diag([1.0, -1, -1, 1]), atol=1e-12)
    # The stand-in answers with its prior, else with the scene's camera.
    assert np.allclose(job["result"]["pose"]["world_from_camera"]["matrix"], TURNED, atol=1e-6)
    assert post(shared).json()["truth"] is None


def test_the_prior_reaches_the_estimator_in_every_spelling(shared):
    opengl = TURNED * [1, -1, -1, 1]
    spellings = [
        {"world_from_camera": TURNED.tolist()},
        {"camera_from_world": np.linalg.inv(TURNED).tolist()},
        {"position": [1, 2, 3], "quaternion_wxyz": [HALF, 0, 0, HALF]},
        {"world_from_camera": opengl.tolist(), "convention": "opengl"},
        {"camera_from_world": np.linalg.inv(opengl).tolist(), "convention": "opengl"},
    ]
    for prior in spellings:
        job = post(shared, prior=prior).json()
        # 1e-12: the same numbers by another way.
        assert np.allclose(job["prior"]["world_from_camera"]["matrix"], TURNED, atol=1e-12)
        assert job["prior_region"] is None


def test_a_job_tells_its_region(shared):
    box = [[-1.0, -2.0, -3.0], [1.0, 2.0, 3.0]]
    job = post(shared, prior={"box": box}).json()
    assert job["prior"] is None
    assert job["prior_region"] == {"box": box, "covariance": None}
    guess = {"world_from_camera": TURNED.tolist()}
    covariance = post(shared, prior=guess | {"sigma_deg": 2, "sigma_units": 0.5}).json()["prior_region"]["covariance"]
    assert np.allclose(covariance["matrix"], np.diag(np.r_[np.full(3, np.radians(2)), np.full(3, 0.5)] ** 2))
    again = post(shared, prior=guess | {"covariance": covariance["matrix"]}).json()
    assert again["prior_region"]["covariance"] == covariance


def test_readings_of_a_device_reach_the_photo_and_what_the_scene_can_not_use_is_said(shared):
    """The stand-in's scene says which way is up, and not where on Earth it is."""
    gps, heading = {"latitude": 47.3, "longitude": 8.5, "sigma_m": 5}, {"degrees": 120}
    job = post(shared, gps=gps, heading=heading).json()
    said = [warning for warning in job["result"]["warnings"] if "not used" in warning]
    assert [warning.split(" was")[0] for warning in said] == ["the GPS position", "the heading"]
    by_exif = post(shared, gps="exif").json()["result"]["warnings"]
    assert any("no position in its EXIF data" in warning for warning in by_exif)
    assert not any("EXIF" in warning for warning in post(shared).json()["result"]["warnings"])


def test_events_come_live_from_the_first_and_end_with_the_result(client, stepping):
    path = post(client, prefer="", options={"hold": True}).headers["location"]
    with client.stream("GET", f"{path}/events") as stream:
        assert stream.headers["content-type"].startswith("text/event-stream")
        chunks = stream.iter_text()
        first = events(next(chunks))
        assert [(name, number) for name, number, _ in first] == [("record", "1.0")]
        assert client.get(path).json()["state"] == "running"
        stepping.GO_ON.set()
        seen = first + events("".join(chunks))
    assert [(name, number) for name, number, _ in seen] == [
        ("record", "1.0"), ("record", "1.1"), ("record", "1.2"), ("result", "end"),
    ]  # fmt: skip
    late = client.get(f"{path}/events")
    assert events(late.text) == seen
    resumed = client.get(f"{path}/events", headers={"Last-Event-ID": "1.1"})
    assert events(resumed.text) == seen[2:]
    trace = client.get(f"{path}/trace").json()
    assert trace["records"] == [data for name, _, data in seen if name == "record"]
    matches = trace["records"][0]["matches"]
    assert (matches["photo_px"], matches["inlier"]) == ([[1.5, 2.5], [3.5, 4.5]], [True, False])


def test_a_quiet_stream_is_kept_alive(client, stepping, monkeypatch):
    monkeypatch.setattr("fastapi.routing._PING_INTERVAL", 0.1)
    path = post(client, prefer="", options={"hold": True}).headers["location"]
    with client.stream("GET", f"{path}/events") as stream:
        told = ""
        for chunk in stream.iter_text():
            told += chunk
            if told.count(": ping") == 2:
                stepping.GO_ON.set()
            if "id: end" in told:
                break
    assert [number for _, number, _ in events(told)] == ["1.0", "1.1", "1.2", "end"]


def test_cancelling_a_running_job_takes_effect_at_its_next_record(client, stepping):
    path = post(client, prefer="", options={"hold": True}).headers["location"]
    until(lambda: client.get(path).json()["records"] >= 1)
    assert client.delete(path).json()["state"] == "running"
    stepping.GO_ON.set()
    job = finished(client, path)
    assert (job["state"], job["records"], job["result"], job["error"]) == ("cancelled", 1, None, None)
    assert [name for name, _, _ in events(client.get(f"{path}/events").text)] == ["record", "error"]
    assert client.delete(path).json()["state"] == "cancelled"


def test_a_full_queue_refuses_and_a_cancelled_job_makes_room(client, stepping):
    running = [post(client, prefer="", options={"hold": True}).headers["location"] for _ in range(FRONTS)]
    until(lambda: all(client.get(path).json()["state"] == "running" for path in running))
    waiting = [post(client, prefer="").headers["location"] for _ in range(2 * FRONTS)]
    for refused in at_each_front(lambda: post(client, prefer="")):
        assert (refused.status_code, refused.json()["code"]) == (503, "queue_full")
        assert int(refused.headers["retry-after"]) > 0
    listed = client.get("/jobs").json()
    assert (listed["queued"], listed["running"]) == (2 * FRONTS, FRONTS)
    assert [job["links"]["self"] for job in listed["jobs"]] == [*waiting[::-1], *running[::-1]]
    assert client.delete(waiting[0]).json()["state"] == "cancelled"
    # At once where the job was queued; which of two fronts is asked isn't known, and the other one may have to be told.
    until(lambda: post(client, prefer="").status_code == 202, 5 * (FRONTS - 1))
    stepping.GO_ON.set()
    assert finished(client, waiting[1])["state"] == "succeeded"


def test_many_at_once_are_served_or_refused_and_nothing_else(stepping):
    with serving(create_app(settings(workers=2, queue_size=8, rate_limit=""), {"room": make_scene()})) as client:
        until_ready(client)
        with ThreadPoolExecutor(16) as senders:
            answers = list(senders.map(lambda seed: post(client, prefer="", seed=str(seed)), range(100)))
        # 200: on a busy machine a job is sometimes done before its answer is written.
        assert {a.status_code for a in answers} <= {200, 202, 503}, [
            a.text for a in answers if a.status_code not in (200, 202, 503)
        ]
        accepted = {a.json()["id"]: a.json()["seed"] for a in answers if a.status_code != 503}
        assert len(accepted) >= 10
        until(lambda: all(job["finished"] for job in client.get("/jobs").json()["jobs"]))
        ended = {job_id: client.get(f"/jobs/{job_id}").json() for job_id in accepted}
        assert {k: job["result"]["seed"] for k, job in ended.items()} == accepted


@pytest.mark.parametrize(("fail", "code"), [("fault", "estimator_fault"), ("bug", "internal_error")])
def test_a_failing_estimator_fails_its_job_only(shared, fail, code, caplog):
    job = post(shared, options={"fail": fail}).json()
    assert (job["state"], job["error"]["code"], job["records"]) == ("failed", code, 1)
    assert "secret" not in json.dumps(job)
    assert f"job {job['id']} failed" in caplog.text or THROUGH_A_GATEWAY  # then it is the log of another process
    assert post(shared).json()["state"] == "succeeded"


def test_old_finished_jobs_are_forgotten(stepping):
    with serving(create_app(settings(keep_jobs=2), {"room": make_scene()})) as client:
        paths = [post(client).json()["links"]["self"] for _ in range(4)]
        until(lambda: len(client.get("/jobs").json()["jobs"]) == 2)
        assert [client.get(path).status_code for path in paths] == [404, 404, 200, 200]


def test_the_list_of_jobs_has_pages_and_filters(stepping):
    scenes = {name: make_scene(name) for name in ("attic", "cellar")}
    with serving(create_app(settings(), scenes)) as client:
        until_ready(client)
        made = [post(client, scene=("attic", "cellar")[k % 2], seed=str(k)).json()["id"] for k in range(5)]
        failed = post(client, photo(size=(64, 48)), scene="attic", options={"fail": "bug"}).json()

        def listed(**query) -> list[str]:
            return [job["id"] for job in client.get("/jobs", params=query).json()["jobs"]]

        assert listed() == [failed["id"], *made[::-1]]
        assert listed(scene="cellar") == [made[3], made[1]]
        assert listed(state="failed") == [failed["id"]]
        assert listed(status="not_localized", scene="attic") == [made[4], made[2], made[0]]
        assert listed(photo=hashlib.sha256(photo()).hexdigest()) == made[::-1]
        assert listed(photo="0" * 64) == []
        assert_problem(client.get("/jobs", params={"state": "lost"}), 400, "invalid_request", "query.state")
        seen, path = [], "/jobs?scene=attic&limit=2"
        while path:
            page = client.get(path).json()
            assert len(page["jobs"]) <= 2
            seen += [job["id"] for job in page["jobs"]]
            path = page["next"]
        assert seen == listed(scene="attic")


# ------------------------------------------------------------------ pictures and scenes


def test_the_photo_is_upright_and_the_render_has_its_size(shared):
    turned = Image.Exif()
    turned[0x0112] = 6  # turn right by 90 degrees to see it upright
    job = post(shared, photo(exif=turned)).json()
    path = job["links"]["self"]
    pictures = [f"{path}/photo", f"{path}/iterations/0/render.jpg", f"{path}/iterations/last/render.jpg"]
    for picture in pictures:
        answer = shared.get(picture)
        assert answer.headers["content-type"] == "image/jpeg"
        assert Image.open(io.BytesIO(answer.content)).size == (64, 96)
    matched = shared.get(f"{path}/iterations/0/render.jpg", params={"camera": "matches"})
    assert Image.open(io.BytesIO(matched.content)).size == (96, 64)
    assert shared.get(f"{path}/iterations/3/render.jpg").json()["code"] == "record_not_found"
    assert shared.get(f"{path}/iterations/-1/render.jpg").status_code == 400


def test_a_render_that_may_still_come_is_not_ready(client, stepping):
    path = post(client, prefer="", options={"hold": True}).headers["location"]
    answer = client.get(f"{path}/iterations/2/render.jpg")
    assert (answer.status_code, answer.json()["code"]) == (409, "job_not_ready")


@pytest.mark.parametrize("wanted", ["png", "jpeg", "depth"])
def test_a_scene_is_rendered_from_any_pose(shared, wanted):
    pose = {"world_from_camera": TURNED.tolist()}
    intrinsics = {"width": 40, "height": 30, "fx": 30, "fy": 30, "cx": 20, "cy": 15}
    body = {"pose": pose, "intrinsics": intrinsics, "format": wanted}
    answer = shared.post("/scenes/room/render", json=body)
    assert answer.status_code == 200
    if wanted == "depth":
        depth = np.load(io.BytesIO(answer.content), allow_pickle=False)
        assert (depth.dtype, depth.shape, depth[3, 4]) == (np.dtype("<f4"), (30, 40), 0.5)
    else:
        assert answer.headers["content-type"] == f"image/{wanted}"
        image = Image.open(io.BytesIO(answer.content))
        assert (image.size, image.format) == ((40, 30), wanted.upper())
        assert image.getpixel((3, 4)) == (128, 128, 128)


def test_the_rendered_camera_is_the_one_that_was_asked_for(stepping):
    """A scene of one Gaussian before the camera, rendered for real: it appears where it projects to."""
    one = GaussianScene(
        means=np.array([[0.4, 0.0, 2.0]], np.float32),
        quats=np.array([[1, 0, 0, 0]], np.float32),
        scales=np.full((1, 3), 0.05, np.float32),
        opacities=np.ones(1, np.float32),
        sh=np.full((1, 1, 3), 1.7, np.float32),
        info=SceneInfo("dot", "Dot", "ab" * 32, "ply"),
        cameras=(NamedCamera("a.jpg", Camera(Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0), Pose(TURNED))),),
    )
    with serving(create_app(settings(), {"dot": LoadedScene.of(one)})) as client:
        moved = np.eye(4)
        moved[2, 3] = -1.0  # one unit back: the depth is 3
        for pose in ({"world_from_camera": moved.tolist()}, {"position": [0, 0, -1], "quaternion_wxyz": [1, 0, 0, 0]}):
            answer = client.post("/scenes/dot/render", json={"pose": pose, "format": "depth"})
            depth = np.load(io.BytesIO(answer.content))
            rows, columns = np.nonzero(depth)
            # The first training camera's lens is taken: x = 320 + 500 * 0.4 / 3. The centre of the
            # visible disc is that within a pixel.
            assert abs(columns.mean() + 0.5 - 386.7) < 1
            assert abs(rows.mean() + 0.5 - 240) < 1
            assert depth.max() == pytest.approx(3.0, abs=1e-3)


GIVEN = {"world_from_camera": TURNED.tolist()}
DOUBLED = {"world_from_camera": np.diag([2, 2, 2, 1]).tolist()}
TINY = {"width": 9, "height": 9, "fx": 1, "fy": 1, "cx": 1, "cy": 1}
BENT = TINY | {"model": "OPENCV", "distortion": [0, 0, 0, 0]}
HUGE = TINY | {"width": 90_000, "height": 90_000}


@pytest.mark.parametrize(
    ("body", "status", "code", "where"),
    [
        ({}, 400, "invalid_request", "body.pose"),
        ({"pose": {}}, 422, "invalid_prior", "pose"),
        ({"pose": DOUBLED}, 422, "invalid_prior", "pose.world_from_camera"),
        ({"pose": GIVEN, "format": "gif"}, 400, "invalid_request", "body.format"),
        ({"pose": GIVEN, "intrinsics": {}}, 422, "invalid_intrinsics", "intrinsics.width"),
        ({"pose": GIVEN, "intrinsics": HUGE}, 422, "invalid_intrinsics", "intrinsics"),
        ({"pose": GIVEN, "intrinsics": BENT}, 422, "invalid_intrinsics", "intrinsics.model"),
    ],
)
def test_a_bad_render_request_is_told(shared, body, status, code, where):
    assert_problem(shared.post("/scenes/room/render", json=body), status, code, where)


def test_a_pose_is_exported_only_if_there_is_one(client, stepping):
    nothing = post(client).json()["links"]["export"]  # grey: not localized
    assert_problem(client.get(f"{nothing}/colmap"), 409, "no_pose", "job")
    assert_problem(client.get(f"{nothing}/dwg"), 400, "invalid_request", "path.format")
    held = post(client, prefer="", options={"hold": True}).json()["links"]["export"]
    assert_problem(client.get(f"{held}/tum"), 409, "job_not_ready", "job")


def test_a_thumbnail_shows_the_scene_small(shared):
    answer = shared.get(shared.get("/scenes/room").json()["links"]["thumbnail"])
    assert answer.headers["content-type"] == "image/jpeg"
    picture = Image.open(io.BytesIO(answer.content))
    assert picture.size == (PHOTO.width, PHOTO.height)  # of the only training camera, which is small enough
    assert np.abs(np.asarray(picture, float) - 127.5).max() < 2
    assert shared.get("/scenes/nowhere/thumbnail.jpg").json()["code"] == "scene_not_found"


def test_splats_are_the_most_important_in_the_documented_layout(shared):
    data = shared.get("/scenes/room/splats", params={"max": 2}).content
    start = 4 + int.from_bytes(data[:4], "little")
    header = json.loads(data[4:start])
    assert header == {"scene": "room", "sha256": "ab" * 32, "count": 2, "total": 5}
    assert len(data) == start + 40 * 2
    floats = np.frombuffer(data, "<f4", 18, start)
    rgba = np.frombuffer(data, np.uint8, 8, start + 72).reshape(2, 4)
    # All have the same shape and colour: opacity over squared distance from the camera at (1, 2, 3) decides.
    scene = make_scene().scene
    distance = np.linalg.norm(scene.means - [1, 2, 3], axis=1)
    best = np.argsort(-scene.opacities / distance**2)[:2]
    assert np.array_equal(floats[:6].reshape(2, 3), scene.means[best])
    assert np.array_equal(rgba[:, 3], np.rint(scene.opacities[best] * 255))
    assert np.all(rgba[:, :3] == 128)  # SH of 0 is mid-grey
    # By hand: a quarter turn about z swaps the axes of 0.3 and 0.2. 1e-6: float32.
    assert np.allclose(floats[6:12], [0.04, 0, 0, 0.09, 0, 0.01], atol=1e-6)


def test_scenes_are_described(shared):
    (summary,) = shared.get("/scenes").json()["scenes"]
    assert (summary["id"], summary["name"], summary["state"]) == ("room", "Room", "ready")
    assert (summary["gaussians"], summary["sh_degree"], summary["cameras"]) == (5, 0, 1)
    (camera,) = shared.get("/scenes/room").json()["training_cameras"]
    assert (camera["name"], camera["world_from_camera"]) == ("images/a.jpg", TURNED.tolist())


def test_the_only_scene_needs_no_name_but_one_of_two_does(stepping):
    scenes = {name: make_scene(name) for name in ("attic", "cellar")}
    with serving(create_app(settings(), scenes)) as client:
        until_ready(client)
        assert post(client, scene="cellar").json()["result"]["scene"]["id"] == "cellar"
        unnamed = post(client)
        assert (unnamed.status_code, unnamed.json()["code"]) == (404, "scene_not_found")
        assert "attic, cellar" in unnamed.json()["detail"]


def test_a_service_without_a_usable_scene_says_what_to_do(stepping):
    with serving(create_app(settings())) as client:
        told = client.get("/readyz")
        assert (told.status_code, told.json()["pending"]) == (503, [])
        assert "SPLATFIX_SCENES" in told.json()["failed"][0]


def test_a_corrupt_scene_is_told_and_harms_no_other(stepping, tmp_path):
    for name, text in (("torn", b"ply\nformat binary_little_endian 1.0\nelement vertex 9\n"), ("odd", b"?")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "scene.ply").write_bytes(text)
    with serving(create_app(settings(scenes=[tmp_path], cache_dir=tmp_path))) as client:
        until(lambda: not client.get("/readyz").json()["pending"], 120)
        ready = client.get("/readyz")
        assert (ready.status_code, len(ready.json()["failed"])) == (503, 2)
        # Each with what to do.
        assert "Copy or export the file again." in next(text for text in ready.json()["failed"] if "torn" in text)
        assert "GET /capabilities lists" in next(text for text in ready.json()["failed"] if "odd" in text)
        states = {s["id"]: (s["state"], s["error"]["code"]) for s in client.get("/scenes").json()["scenes"]}
        assert states == {"torn": ("failed", "corrupt_scene"), "odd": ("failed", "unsupported_format")}
        for name, code in (("torn", "corrupt_scene"), ("odd", "unsupported_format")):
            refused = post(client, scene=name)
            assert (refused.status_code, refused.json()["code"]) == (422, code)
            assert client.get(f"/scenes/{name}/splats").status_code == 422
        assert client.get("/livez").status_code == 200


def test_a_scene_still_loading_is_not_ready(stepping):
    scene = make_scene()
    scene.matcher = HeldMatcher()
    with serving(create_app(settings(), {"room": scene})) as client:
        until(scene.matcher.asked.is_set)
        ready = client.get("/readyz")
        assert (ready.status_code, ready.json()["pending"]) == (503, ["scene room: preparing"])
        assert client.get("/livez").status_code == 200
        scene.matcher.go_on.set()
        until_ready(client)


class HeldMatcher(BlindMatcher):
    def __init__(self):
        self.asked, self.go_on = threading.Event(), threading.Event()

    def extract(self, rgb, limit):
        self.asked.set()
        assert self.go_on.wait(20)
        return super().extract(rgb, limit)


# ------------------------------------------------------------------ errors


def bomb() -> bytes:
    """A PNG of 100 megapixels in a few kilobytes."""
    file = io.BytesIO()
    Image.new("1", (10_000, 10_000)).save(file, "png")
    return file.getvalue()


GOOD = {"width": 96, "height": 64, "fx": 80, "fy": 80, "cx": 48, "cy": 32}
SHEARED = [[1, 0.2, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
AT_TWO = {"position": [2, 2, 2], "quaternion_wxyz": [1, 0, 0, 0]}
LOPSIDED = (np.eye(6) + np.eye(6, k=1)).tolist()
MIRRORED = [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
NAN = '{"width": 96, "height": 64, "fx": NaN, "fy": 80, "cx": 48, "cy": 32}'

BAD_FIELDS = [
    ({"scene": "attic"}, 404, "scene_not_found", "scene"),
    ({"estimator": "magic"}, 422, "unknown_name", "estimators"),
    ({"estimator": "../view_index"}, 422, "unknown_name", "estimators"),
    ({"estimator": "absent"}, 501, "backend_missing", "estimators"),
    ({"options": {"stpes": 3}}, 422, "invalid_options", "options.stpes"),
    ({"options": {"steps": "many"}}, 422, "invalid_options", "options.steps"),
    ({"options": "[]"}, 422, "invalid_options", "options"),
    ({"options": "{"}, 422, "invalid_options", "options"),
    ({"intrinsics": GOOD | {"fx": 0}}, 422, "invalid_intrinsics", "intrinsics.fx"),
    ({"intrinsics": GOOD | {"fy": -80}}, 422, "invalid_intrinsics", "intrinsics.fy"),
    ({"intrinsics": NAN}, 422, "invalid_intrinsics", "intrinsics.fx"),
    ({"intrinsics": NAN.replace("96", "NaN")}, 422, "invalid_intrinsics", "intrinsics.width"),
    ({"intrinsics": GOOD | {"fx": 10**400}}, 422, "invalid_intrinsics", "intrinsics.fx"),
    ({"intrinsics": GOOD | {"width": 97}}, 422, "invalid_intrinsics", "intrinsics"),
    ({"intrinsics": GOOD | {"width": 64, "height": 96}}, 422, "invalid_intrinsics", "intrinsics"),
    ({"intrinsics": {"fx": 80}}, 422, "invalid_intrinsics", "intrinsics.width"),
    ({"intrinsics": "[1, 2"}, 422, "invalid_intrinsics", "intrinsics"),
    ({"intrinsics": "[" * 100_000}, 422, "invalid_intrinsics", "intrinsics"),
    ({"prior": {"world_from_camera": SHEARED}}, 422, "invalid_prior", "prior.world_from_camera"),
    ({"prior": {"camera_from_world": MIRRORED}}, 422, "invalid_prior", "prior.camera_from_world"),
    ({"prior": {"world_from_camera": [[1]]}}, 422, "invalid_prior", None),
    ({"prior": '{"position": [0, 0, NaN], "quaternion_wxyz": [1, 0, 0, 0]}'}, 422, "invalid_prior", "prior.position"),
    ({"prior": {"position": [0] * 3, "quaternion_wxyz": [2, 0, 0, 0]}}, 422, "invalid_prior", "prior.quaternion_wxyz"),
    ({"prior": {"position": [0, 0, 0]}}, 422, "invalid_prior", "prior"),
    ({"prior": {}}, 422, "invalid_prior", "prior"),
    ({"prior": {"box": [[0, 0, 0]]}}, 422, "invalid_prior", "prior.box"),
    ({"prior": {"box": [[0, 0, 0], [1, 1, -1]]}}, 422, "invalid_prior", "prior.box"),
    ({"prior": AT_TWO | {"box": [[0, 0, 0], [1, 1, 1]]}}, 422, "invalid_prior", "prior.box"),
    ({"prior": AT_TWO | {"box": [[0, 0, 0], [9, 9, 9]], "sigma_deg": 1}}, 422, "invalid_prior", "prior.sigma_deg"),
    ({"prior": {"sigma_deg": 1, "sigma_units": 1}}, 422, "invalid_prior", "prior"),
    ({"prior": AT_TWO | {"sigma_deg": 1}}, 422, "invalid_prior", "prior.sigma_deg"),
    ({"prior": AT_TWO | {"sigma_deg": 0, "sigma_units": 1}}, 422, "invalid_prior", "prior.sigma_deg"),
    ({"prior": AT_TWO | {"covariance": [[0] * 6] * 6}}, 422, "invalid_prior", "prior.covariance"),
    ({"prior": AT_TWO | {"covariance": LOPSIDED}}, 422, "invalid_prior", "prior.covariance"),
    ({"truth": {"box": [[0, 0, 0], [1, 1, 1]]}}, 422, "invalid_prior", "truth.box"),
    ({"truth": {"world_from_camera": SHEARED}}, 422, "invalid_prior", "truth.world_from_camera"),
    ({"prior": {"convention": "blender"}}, 422, "invalid_prior", "prior.convention"),
    ({"up_in_camera": {"direction": [0, 0, 0]}}, 422, "invalid_prior", "up_in_camera.direction"),
    ({"up_in_camera": {"direction": [0, -1]}}, 422, "invalid_prior", "up_in_camera.direction"),
    ({"up_in_camera": {"direction": [0, -1, 0], "sigma_deg": 0}}, 422, "invalid_prior", "up_in_camera.sigma_deg"),
    ({"gps": {"latitude": 91, "longitude": 8, "sigma_m": 5}}, 422, "invalid_prior", "gps.latitude"),
    ({"gps": {"latitude": 47, "longitude": 8}}, 422, "invalid_prior", "gps.sigma_m"),
    ({"gps": "here"}, 422, "invalid_prior", "gps"),
    ({"heading": {"degrees": 120, "sigma_deg": 0}}, 422, "invalid_prior", "heading.sigma_deg"),
    ({"accuracy": {"metres": 0.1}}, 422, "invalid_accuracy", "accuracy.metres"),
    ({"accuracy": {"metres": 0.1, "share": 0.1}}, 422, "invalid_accuracy", "accuracy.share"),
    ({"accuracy": {"deg": 0}}, 422, "invalid_accuracy", "accuracy.deg"),
    ({"accuracy": {"cm": 3}}, 422, "invalid_accuracy", "accuracy.cm"),
    ({"accuracy": "{"}, 422, "invalid_accuracy", "accuracy"),
    ({"seed": "x"}, 400, "invalid_request", "seed"),
    ({"seed": "-1"}, 400, "invalid_request", "seed"),
    ({"seed": str(2**63)}, 400, "invalid_request", "seed"),
    ({"budget_s": "0"}, 400, "invalid_request", "budget_s"),
    ({"budget_s": "nan"}, 400, "invalid_request", "budget_s"),
    ({"budget_s": "inf"}, 400, "invalid_request", "budget_s"),
    ({"sced": "3"}, 400, "invalid_request", "sced"),
]  # fmt: skip


def test_a_refusal_names_what_is_allowed_with_an_example_that_is_right(shared):
    """Each example is read from the text of a refusal and sent."""
    wrong = {
        **{"seed": "x", "budget_s": "0", "deadline_s": "0", "camera_id": "/", "every": "0", "keep_photo": "maybe"},
        **{"options": "{", "prior": {"pose": 1}, "truth": {"pose": 1}, "intrinsics": {"fov": 60}, "times_s": "[1]"},
        "accuracy": {"cm": 3},
        **{"up_in_camera": {"down": 1}, "gps": {"lat": 1}, "heading": {"north": 1}},
    }
    assert wrong.keys() <= hints.EXAMPLES.keys()
    for field, value in wrong.items():
        problem = post(shared, **{field: value}).json()
        assert problem["where"].partition(".")[0] == field
        named, _, example = problem["hint"].partition("Example: ")[2].partition("=")
        assert named == field, problem
        read = read_fields({field: parsed_json(example, field) if field in FIELD_ERRORS else example})
        assert getattr(read, field) is not None
    for field, known in (("prior", "world_from_camera"), ("truth", "quaternion_wxyz"), ("intrinsics", "trust")):
        assert known in post(shared, **{field: wrong[field]}).json()["detail"] + hints.hint_for("", field)
    assert "sigma_deg" in post(shared, prior={"pose": 1}).json()["detail"]
    assert "covariance" not in post(shared, truth={"pose": 1}).json()["detail"]  # a prior's only


def test_the_examples_of_hints_are_right():
    fields = read_fields(hints.EXAMPLES)
    assert fields.model_fields_set == set(hints.EXAMPLES)
    assert set(hints.EXAMPLES) == set(LocalizeFields.model_fields)
    job_spec(fields.model_copy(update={"estimator": "view_index"}))


@pytest.mark.parametrize("estimator", ["icomma", "inerf", "inerf_dagger", "pnerf"])
def test_an_estimator_that_needs_a_prior_is_refused_without_one(shared, estimator):
    before = shared.get("/jobs").json()
    answer = post(shared, estimator=estimator)
    assert_problem(answer, 422, "invalid_prior", "prior")
    assert estimator in answer.json()["detail"]
    assert shared.get("/jobs").json() == before
    listed = {e["name"]: e["needs_prior"] for e in shared.get("/capabilities").json()["estimators"]}
    assert (listed[estimator], listed["view_index"]) == (True, False)


@pytest.mark.parametrize(("fields", "status", "code", "where"), BAD_FIELDS)
def test_a_bad_field_is_refused_before_anything_is_queued(shared, fields, status, code, where):
    before = shared.get("/jobs").json()
    assert_problem(post(shared, **fields), status, code, where)
    assert shared.get("/jobs").json() == before


BAD_PHOTOS = {
    "no image": b"hello",
    "empty": b"",
    "truncated JPEG": photo()[:600],
    "truncated PNG": photo("png")[:600],
    "JPEG header only": photo()[:3],
    "bomb": bomb(),
    "too small": photo(size=(8, 8)),
}


@pytest.mark.parametrize("name", BAD_PHOTOS)
def test_a_bad_photo_is_refused_at_once(shared, name):
    assert_problem(post(shared, BAD_PHOTOS[name]), 422, "invalid_image", "photo")
    assert post(shared).json()["state"] == "succeeded"


def test_a_request_that_cannot_be_read_is_refused(shared):
    def send(content, kind="application/json"):
        return shared.post("/localize", content=content, headers={"Content-Type": kind})

    assert_problem(send("{"), 400, "invalid_request", "body")
    assert_problem(send(b"\xff\xfe"), 400, "invalid_request", "body")
    assert_problem(send("[]"), 400, "invalid_request", "body")
    assert_problem(send("{}"), 400, "invalid_request", "photo")
    assert_problem(send('{"photo": "%%%"}'), 400, "invalid_request", "photo")
    assert_problem(send('{"photo": 3}'), 400, "invalid_request", "photo")
    assert_problem(send(photo(), "image/jpeg"), 415, "unsupported_media_type")
    assert_problem(send("x=1", "application/x-www-form-urlencoded"), 415, "unsupported_media_type")
    assert_problem(send(photo(), "multipart/form-data"), 400, "bad_request")
    assert_problem(send(photo(), "multipart/form-data; boundary=x"), 400, "bad_request")
    assert_problem(shared.post("/localize", files={"scene": b"room"}), 400, "invalid_request", "photo")
    twice = [("scene", (None, "room")), ("scene", (None, "room")), ("photo", ("p", photo()))]
    assert_problem(shared.post("/localize", files=twice), 400, "invalid_request", "scene")


def test_a_client_that_leaves_in_the_middle_is_no_failure(shared, caplog):
    head = (
        b"POST /localize HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 999\r\n\r\n{"
    )
    with socket.create_connection((shared.base_url.host, shared.base_url.port)) as connection:
        connection.sendall(head)
    before = time.monotonic()
    while time.monotonic() - before < 0.3:
        assert shared.get("/livez").status_code == 200
    assert "Exception" not in caplog.text


def test_http_errors_are_problem_documents(shared):
    assert_problem(shared.get("/nowhere"), 404, "not_found")
    assert_problem(shared.get("/jobs/none"), 404, "job_not_found", "job")
    assert_problem(shared.get("/jobs/none/events"), 404, "job_not_found", "job")
    assert_problem(shared.delete("/jobs/none"), 404, "job_not_found", "job")
    assert_problem(shared.get("/scenes/none"), 404, "scene_not_found", "scene")
    assert_problem(shared.get("/scenes/room/splats?max=0"), 400, "invalid_request", "query.max")
    refused = shared.put("/localize")
    assert_problem(refused, 405, "method_not_allowed")
    assert refused.headers["allow"] == "POST"


def test_a_body_too_large_is_refused_announced_or_not(stepping):
    with serving(create_app(settings(max_upload_bytes=1000), {"room": make_scene()})) as client:
        kind = {"Content-Type": "application/json"}
        large = b" " * 1_500_000
        assert_problem(client.post("/localize", content=large, headers=kind), 413, "content_too_large")
        assert_problem(client.put("/nowhere", content=large), 413, "content_too_large")
        chunks = (large[:100_000] for _ in range(15))
        assert_problem(client.post("/localize", content=chunks, headers=kind), 413, "content_too_large")
        # Below the body's limit, which leaves room for base64, but above the photo's.
        refused = post(client, photo() + b" " * 1000)
        assert_problem(refused, 413, "content_too_large")
        assert refused.json()["detail"] == "Upload too large (limit 1 kB)."
        assert client.get("/livez").status_code == 200


def test_the_limit_of_uploads_depends_on_who_is_served():
    assert settings().upload_limit == 1_000_000_000
    assert settings(host="0.0.0.0").upload_limit == 50_000_000
    assert settings(host="0.0.0.0", max_upload_bytes=7).upload_limit == 7


def test_a_bug_in_a_route_is_a_problem_document_without_details(stepping, caplog):
    scene = make_scene()
    with serving(create_app(settings(), {"room": scene})) as client:
        job = post(client).json()
        scene.rasterizer.render = None  # type: ignore[assignment]
        answer = client.get(job["links"]["render"])
        assert_problem(answer, 500, "internal_error")
        assert "NoneType" not in answer.text


def test_an_unknown_default_estimator_is_told_at_start():
    with pytest.raises(service.errors.UnknownName, match="magic"):
        create_app(settings(estimator="magic"))


# ------------------------------------------------------------------ the surroundings


@pytest.mark.parametrize("stripped", [True, False])
def test_links_carry_the_sub_path_of_a_proxy(shared, stripped):
    prefix = "/maps/fix"
    path = "/localize" if stripped else f"{prefix}/localize"
    headers = {"X-Forwarded-Prefix": prefix, "Prefer": "wait=20"}
    answer = shared.post(path, files={"photo": photo()}, headers=headers)
    job = answer.json()
    assert answer.headers["location"] == f"{prefix}/jobs/{job['id']}"
    assert all(link.startswith(f"{prefix}/") for link in job["links"].values())
    assert shared.get(job["links"]["events"], headers=headers).status_code == 200
    assert 'src="docs/swagger-ui-bundle.js"' in shared.get(f"{prefix}/docs", headers=headers).text  # relative
    missing = shared.get(f"{prefix}/jobs/x", headers=headers)
    assert_problem(missing, 404, "job_not_found")


def test_a_prefix_that_is_no_path_is_ignored(shared):
    for prefix in ("//evil.example", "/a/../b", "/a b", "javascript:x", "/<script>"):
        (scene,) = shared.get("/scenes", headers={"X-Forwarded-Prefix": prefix}).json()["scenes"]
        assert scene["links"]["self"] == "/scenes/room"


def test_the_sub_path_may_be_set(stepping):
    with serving(create_app(settings(root_path="/fix"), {"room": make_scene()})) as client:
        for path in ("/scenes", "/fix/scenes"):
            assert client.get(path).json()["scenes"][0]["links"]["self"] == "/fix/scenes/room"


def test_capabilities_tell_what_can_be_chosen(shared):
    told = shared.get("/capabilities").json()
    estimators = {e["name"]: e for e in told["estimators"]}
    assert estimators["stepping"]["default"]
    steps = estimators["stepping"]["options_schema"]["properties"]["steps"]
    assert (steps["type"], steps["description"]) == ("integer", "Records to yield.")
    assert {"cpu"} <= {r["name"] for r in told["rasterizers"]}
    assert {"xfeat", "sift"} <= {m["name"] for m in told["matchers"]}
    assert {"ply", "splat", "compressed_ply"} <= {f["name"] for f in told["scene_formats"]}
    assert all(e["available"] == (e["reason"] is None) for e in told["estimators"])


@pytest.mark.parametrize("name", ["xfeat", "sift"])
def test_the_matcher_that_is_set_is_the_default(name):
    told = resources.capabilities(settings(estimator="view_index", matcher=name))
    assert [matcher.name for matcher in told.matchers if matcher.default] == [name]


def test_the_start_page_and_the_docs_are_there(shared):
    page = shared.get("/")
    assert page.headers["content-type"].startswith("text/html")
    assert 'href="viewer/"' in page.text  # relative: right under any sub-path
    assert "http" not in shared.get("/docs").text  # no file of another server: that would need the internet
    assert shared.get("/version").json()["splatfix"] == service.__version__


def test_openapi_yaml_is_fresh():
    """Write it anew with `splatfix openapi > openapi.yaml`."""
    app = create_app(Settings(scenes=[], viewer=False))
    assert yaml.safe_load((ROOT / "openapi.yaml").read_text("utf-8")) == app.openapi()


@pytest.mark.parametrize(("lister", "parameter"), [("list_jobs", "job_id"), ("list_scenes", "scene_id")])
def test_every_operation_on_a_listed_thing_is_linked_from_the_list(lister, parameter):
    described = {operation["operationId"]: operation for _, _, operation in operations()}
    takes = {
        name
        for name, operation in described.items()
        if any((one["in"], one["name"]) == ("path", parameter) for one in operation.get("parameters", []))
    }
    # An upload makes a scene that isn't in the list.
    assert set(described[lister]["responses"]["200"]["links"]) == takes - {"upload_scene"}
