"""Share links: one job, read-only, to whoever has the link, until it expires."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator
from types import SimpleNamespace

import pytest
from api_server import assert_problem, create_app, fake_estimators, finished, post, serving, settings, until
from stand_ins import make_scene

from service.web.api_keys import KeyRing
from service.web.key_file import add_key, remove_key
from service.web.shared_state import LocalState


@pytest.fixture(scope="module")
def service() -> Iterator[SimpleNamespace]:
    with fake_estimators() as stepping, serving(app := create_app(settings(), {"room": make_scene()})) as client:
        until(lambda: client.get("/readyz").json()["ready"], 100)
        stepping.GO_ON.set()
        job = post(client, keep_photo="true", seed="1").json()["id"]
        finished(client, f"/jobs/{job}")
        yield SimpleNamespace(client=client, app=app, job=job, other=post(client, seed="2").json()["id"])
        stepping.GO_ON.clear()


def link_of(service: SimpleNamespace, **wanted) -> str:
    answer = service.client.post(f"/jobs/{service.job}/share", json=wanted)
    assert answer.status_code == 201
    return answer.json()["link"]


def test_a_link_shows_its_job_with_photo_steps_and_renders(service):
    link = link_of(service)
    answer = service.client.get(f"{link}/job").json()
    assert answer["job"]["id"] == service.job
    links = answer["job"]["links"]
    for name, kind in (("photo", "image/jpeg"), ("render", "image/jpeg"), ("trace", "application/json")):
        shown = service.client.get(links[name])
        assert shown.status_code == 200, name
        assert shown.headers["content-type"] == kind
        assert links[name].startswith(link)
    assert [links[name] for name in ("events", "export", "viewer")] == ["", "", ""]
    step = service.client.get(f"{link}/iterations/0/render.jpg")
    assert step.headers["content-type"] == "image/jpeg"
    assert "shared.js" in service.client.get(link).text


def test_a_link_that_is_forged_or_expired_shows_nothing(service):
    link = link_of(service)
    token = link.rpartition("/")[2]
    claim, _, signature = token.partition(".")
    read = json.loads(base64.urlsafe_b64decode(claim + "=="))
    other = base64.urlsafe_b64encode(json.dumps({**read, "job": service.other}).encode()).decode().rstrip("=")
    keys = service.app.state.app_state.keys
    for forged in (claim, f"{claim}.", f"{claim}.{signature[:-1]}", "x", f"ä.{signature}"):
        assert keys.shared_job(forged) is None
    for refused in (f"{other}.{signature}", keys.share_token(service.job, -0.1, None)):
        for path in ("job", "photo", "trace", "iterations/last/render.jpg"):
            assert_problem(service.client.get(f"/shared/{refused}/{path}"), 404, "job_not_found", "link")


def test_nobody_else_may_frame_the_page_unless_the_operator_says_so(service):
    headers = service.client.get(link_of(service)).headers
    assert "frame-ancestors 'none'" in headers["content-security-policy"]
    sites = ["https://a.example", "https://b.example"]
    with serving(create_app(settings(scenes=[], embed_origins=sites))) as client:
        headers, others = client.get("/shared/x").headers, client.get("/").headers
    assert "frame-ancestors https://a.example https://b.example" in headers["content-security-policy"]
    assert "x-frame-options" not in headers
    # Other pages stay as they were.
    assert others["x-frame-options"] == "SAMEORIGIN"


def test_a_link_ends_with_the_key_that_made_it_and_outlives_a_restart(tmp_path):
    file = tmp_path / "keys.json"
    key = add_key(file, "ann", "localize")
    ring = KeyRing(file)
    ring.keep_sessions(LocalState(tmp_path / "sessions.key").secret())
    ann = ring.caller(key)
    token, unowned = ring.share_token("one", 60, ann), ring.share_token("two", 60, None)
    again = KeyRing(file)
    assert again.shared_job(token) is None  # another secret
    again.keep_sessions(LocalState(tmp_path / "sessions.key").secret())
    assert (again.shared_job(token), again.shared_job(unowned)) == ("one", "two")
    remove_key(file, "ann")
    assert again.shared_job(token) is None
    add_key(file, "ann", "localize")  # another key of that name
    assert again.shared_job(token) is None


def test_no_token_passes_for_one_of_the_other_kind(tmp_path):
    file = tmp_path / "keys.json"
    key = add_key(file, "ann", "admin")
    ring = KeyRing(file)
    ann = ring.caller(key)
    assert ann
    made = {
        "session": ring.token(ann, 60),
        "shared": ring.share_token("one", 60, ann),
        "viewer": ring.viewer_token(ann),
    }
    read = {"session": ring.bearer, "shared": ring.shared_job, "viewer": ring.viewer_bearer}
    for kind, token in made.items():
        for other, accept in read.items():
            assert (accept(token) is None) is (kind != other), (kind, other)


def test_with_keys_a_link_needs_none_and_opens_nothing_else(tmp_path):
    file = tmp_path / "keys.json"
    key = add_key(file, "ann", "localize")
    reader = add_key(file, "bob", "read")
    with fake_estimators() as stepping, serving(create_app(settings(keys_file=file), {"room": make_scene()})) as client:
        until(lambda: client.get("/readyz").json()["ready"], 100)
        stepping.GO_ON.set()
        client.headers["Authorization"] = f"Bearer {key}"
        job = post(client).json()["id"]
        finished(client, f"/jobs/{job}")
        made = client.post(f"/jobs/{job}/share", json={})
        refused = client.post(f"/jobs/{job}/share", json={}, headers={"Authorization": f"Bearer {reader}"})
        assert_problem(refused, 403, "forbidden")
        del client.headers["Authorization"]
        assert client.get(f"{made.json()['link']}/job").json()["job"]["id"] == job
        for path in (f"/jobs/{job}", "/jobs", "/scenes"):
            assert client.get(path, headers={"Authorization": f"Bearer {made.json()['token']}"}).status_code == 401
        stepping.GO_ON.clear()
