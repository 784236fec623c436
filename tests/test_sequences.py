"""Several photos, or a video, in one job: what comes in, what is refused, what is told. The engine is a stand-in."""

from __future__ import annotations

import json

import pytest
from api_server import assert_problem, events, finished, photo, post, ready_service
from test_video import written


def send(client, files: list[tuple[str, bytes]], prefer: str = "wait=20", **fields):
    texts = {k: v if isinstance(v, str) else json.dumps(v) for k, v in fields.items()}
    parts = [("photo", (name, data, "image/jpeg")) for name, data in files]
    return client.post("/localize", files=parts, data=texts, headers={"Prefer": prefer} if prefer else {})


def photos(count: int, **changes) -> list[tuple[str, bytes]]:
    return [(f"{i}.jpg", photo(**changes)) for i in range(count)]


def test_several_photos_are_one_job_with_an_answer_and_an_event_each(client):
    job = send(client, photos(4), times_s=[0.5, 1.0, 1.25, 7.0], options={"steps": 3}).json()
    frames = job["result"]["frames"]
    assert job["photo"]["name"] == "0.jpg and 3 more"
    assert [f["name"] for f in frames] == ["0.jpg", "1.jpg", "2.jpg", "3.jpg"]
    assert [f["time_s"] for f in frames] == [0.5, 1.0, 1.25, 7.0]
    assert {f["status"] for f in frames} == {"not_localized"}  # the scene is one grey
    assert job["result"]["status"] == "not_localized"
    assert "4 of 4 photos were not localized." in job["result"]["warnings"]
    told = events(client.get(job["links"]["events"]).text)
    assert [(event, data["index"]) for event, _, data in told[:-1]] == [("record", i) for i in range(4)]
    assert [data["frame"] for _, _, data in told[:-1]] == frames
    assert told[-1][0] == "result"
    assert job["records"] == 4
    assert client.get(job["links"]["photo"]).content.startswith(b"\xff\xd8")
    assert client.get(job["links"]["render"]).content.startswith(b"\xff\xd8")


def test_a_video_is_one_job(client):
    job = send(client, [("walk.mp4", written("mp4", "mp4v", 6, size=(96, 64)))], every="2").json()
    frames = job["result"]["frames"]
    assert [f["name"] for f in frames] == ["frame 0", "frame 2", "frame 4"]
    assert [f["time_s"] for f in frames] == pytest.approx([0.0, 0.08, 0.16])
    assert (job["photo"]["name"], job["photo"]["intrinsics"]["width"]) == ("walk.mp4", 96)


def test_a_single_photo_has_no_frames(client):
    job = post(client).json()
    assert (job["result"]["frames"], job["result"]["scene_ranking"]) == (None, [])
    _, _, record = events(client.get(job["links"]["events"]).text)[0]
    assert record["frame"] is None


def test_the_same_photos_with_the_same_key_are_the_same_job(client):
    key = {"Idempotency-Key": "k"}
    parts = [("photo", (name, data, "image/jpeg")) for name, data in photos(2)]
    first, again = (client.post("/localize", files=parts, headers=key).json() for _ in range(2))
    assert first["id"] == again["id"]
    other = [("photo", (name, data, "image/jpeg")) for name, data in photos(3)]
    assert_problem(client.post("/localize", files=other, headers=key), 422, "idempotency_conflict")


def test_cancelling_ends_between_two_photos(client, stepping):
    job = send(client, photos(3), prefer="", options={"hold": True}).json()
    client.delete(job["links"]["self"])
    stepping.GO_ON.set()
    assert finished(client, job["links"]["self"])["state"] == "cancelled"


def test_what_is_wrong_is_told_at_once(client):
    odd = [*photos(2), ("odd.jpg", photo(size=(64, 96)))]
    assert_problem(send(client, odd), 422, "invalid_image", "photo.2")
    torn = [*photos(2), ("torn.jpg", b"GIF89a")]
    assert_problem(send(client, torn), 422, "invalid_image", "photo.2")
    film = written("mp4", "mp4v", 3)
    assert_problem(send(client, [*photos(1), ("v.mp4", film)]), 400, "invalid_request", "photo.1")
    assert_problem(send(client, [("v.mp4", film)], times_s=[0, 1]), 400, "invalid_request", "times_s")
    assert_problem(send(client, photos(3), times_s=[0, 1]), 400, "invalid_request", "times_s")
    assert_problem(send(client, photos(2), times_s=[1, 1]), 400, "invalid_request", "times_s")
    assert_problem(send(client, photos(1), every="2"), 400, "invalid_request", "every")
    assert_problem(send(client, photos(2), every="0"), 400, "invalid_request", "every")
    truth = {"position": [0, 0, 0], "quaternion_wxyz": [1, 0, 0, 0]}
    assert_problem(send(client, photos(2), truth=truth), 422, "invalid_prior", "truth")
    assert_problem(send(client, photos(2), scene="auto"), 400, "invalid_request", "scene")
    assert_problem(send(client, [("v.mp4", film)], scene=["room"]), 400, "invalid_request", "scene")
    assert_problem(send(client, [("a.zip", b"PK\x03\x04" + bytes(50))]), 422, "invalid_image", "photo")
    assert_problem(send(client, [("v.mp4", film[: len(film) // 2])]), 422, "invalid_image", "photo")


def test_only_so_many(stepping):
    with ready_service(max_frames=3) as client:
        assert len(send(client, photos(3)).json()["result"]["frames"]) == 3
        assert send(client, photos(4)).status_code == 400
        film = [("v.avi", written("avi", "MJPG", 7, size=(96, 64)))]
        assert_problem(send(client, film, every="2"), 422, "invalid_image", "photo")
        assert len(send(client, film, every="3").json()["result"]["frames"]) == 3
