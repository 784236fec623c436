"""A key sees its own scenes and jobs, and nothing of others, route by route. See docs/security.md."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace

import httpx
import pytest
import websockets.sync.client
from api_server import (
    assert_problem,
    at_each_front,
    create_app,
    fake_estimators,
    photo,
    serving,
    settings,
    until,
    until_ready,
    with_viewer_at,
)
from fake_browser import FakeBrowser
from fastapi import FastAPI
from fastapi.routing import iter_route_contexts
from stand_ins import make_scene
from starlette.routing import Mount, WebSocketRoute
from test_lenses import viewpoint
from websockets.exceptions import InvalidStatus
from websockets.sync.server import serve

from service.client import Client
from service.lenses.lens_estimate import LensEstimate
from service.lenses.lens_key import LensKey
from service.scene_manager.status import SceneNote
from service.web.api_keys import KeyRing
from service.web.key_file import KeyLimits, add_key
from viewer.viewer_server import Viewer

# Every route has a decision; what is missing here fails the test.
NOTHING = """
GET /  GET /live  GET /client.js  GET /ui/x  GET /ui/labels.js  GET /docs  GET /docs/swagger-ui-bundle.js
GET /openapi.json  GET /key  GET /capabilities  GET /version  GET /livez  POST /tokens  GET /viewer-run
GET /docs/swagger-ui.css
"""
"""Shows no scene and no job."""
ADMIN = """
PUT /scenes/{scene_id}  DELETE /scenes/{scene_id}  POST /scenes/{scene_id}/load  POST /scenes/{scene_id}/unload
PUT /scenes/{scene_id}/anchors/{name}  DELETE /scenes/{scene_id}/anchors/{name}  POST /scenes/{scene_id}/coverage
DELETE /scenes/{scene_id}/coverage  POST /scenes/{scene_id}/registration  DELETE /scenes/{scene_id}/registration
GET /keys  PUT /keys/{name}  DELETE /keys/{name}
"""
"""Refused, whatever is named: admin keys have all scenes."""
SCENE = """
GET /scenes/{scene_id}  GET /scenes/{scene_id}/thumbnail.jpg  GET /scenes/{scene_id}/splats
POST /scenes/{scene_id}/render  GET /scenes/{scene_id}/anchors  GET /scenes/{scene_id}/coverage
GET /scenes/{scene_id}/registration  WEBSOCKET /scenes/{scene_id}/live
"""
"""Another scene is answered like one that isn't there."""
JOB = """
GET /jobs/{job_id}  DELETE /jobs/{job_id}  GET /jobs/{job_id}/events  GET /jobs/{job_id}/photo
GET /jobs/{job_id}/trace  GET /jobs/{job_id}/iterations/{index}/render.jpg  GET /jobs/{job_id}/export/{format}
POST /jobs/{job_id}/share
"""
"""Another key's job is answered like one that isn't there."""
OWN = "GET /jobs  GET /scenes  GET /lenses  DELETE /lenses  DELETE /lenses/{lens_id}  GET /metrics  GET /readyz"
"""Shows what the key may see."""
BODY = "POST /localize  POST /geopose"
"""The request names a scene."""
LINK = """
GET /shared/{token}  GET /shared/{token}/job  GET /shared/{token}/photo  GET /shared/{token}/trace
GET /shared/{token}/iterations/{index}/render.jpg
"""
"""Shows one job to whoever has its link: tests/test_shared.py."""
VIEWER = "GET /viewer  GET /viewer/{path}  WEBSOCKET /viewer  WEBSOCKET /viewer/{path}"
"""The viewer asks in the name of its browser's user."""
KINDS = {"nothing": NOTHING, "admin": ADMIN, "scene": SCENE, "job": JOB, "own": OWN, "body": BODY, "link": LINK}
KINDS["viewer"] = VIEWER


def decisions() -> dict[str, str]:
    """Decision of each route, "METHOD path"."""
    found = {}
    for kind, text in KINDS.items():
        words = text.split()
        found |= {f"{method} {path}": kind for method, path in zip(words[::2], words[1::2], strict=True)}
    return found


def routes(app: FastAPI) -> Iterator[str]:
    """ "METHOD path" of each route, as the router has it."""
    for found in iter_route_contexts(app.routes):
        path = (found.path or "").replace(":path}", "}")
        if isinstance(found.original_route, Mount):
            yield f"GET {path}/x"
        elif isinstance(found.original_route, WebSocketRoute):
            yield f"WEBSOCKET {path}"
        else:
            yield from (f"{method} {path}" for method in sorted(found.methods or ()) if method != "HEAD")


class Upstream:
    """A viewer that keeps the tokens that sockets are opened with."""

    def __init__(self) -> None:
        self.tokens: list[str] = []
        self._server = serve(self._answer, "127.0.0.1", 0)
        self.port = self._server.socket.getsockname()[1]
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def _answer(self, socket) -> None:
        self.tokens.append(socket.request.headers.get("Authorization", "").removeprefix("Bearer "))
        socket.send("here")

    def close(self) -> None:
        self._server.shutdown()


@dataclass
class Site:
    """A service with the scenes `room` and `vault`, a job and a lens of each of two keys."""

    app: FastAPI
    client: httpx.Client
    keys: dict[str, str]
    jobs: dict[str, str]
    lenses: dict[str, str]
    viewer: Upstream

    def ask(self, who: str, method: str, path: str, **sent) -> httpx.Response:
        return self.client.request(method, path, headers={"Authorization": f"Bearer {self.keys[who]}"}, **sent)


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Iterator[Site]:
    file, viewer = tmp_path_factory.mktemp("keys") / "keys.json", Upstream()
    keys = {name: add_key(file, name, "localize", KeyLimits(scenes=(name,))) for name in ("room", "vault")}
    keys["admin"] = add_key(file, "boss", "admin")
    ring = KeyRing(file)
    with fake_estimators() as stepping:
        app = create_app(settings(keys_file=file, rate_limit=""), {n: make_scene(n) for n in ("room", "vault")}, ring)
        with serving(with_viewer_at(viewer.port, app, ring)) as client:
            until_ready(client)
            stepping.GO_ON.set()
            made = Site(app, client, keys, {}, {}, viewer)
            for who in ("room", "vault"):
                sent = {"files": {"photo": photo()}, "data": {"scene": who, "keep_photo": "true"}}
                job = made.ask(who, "POST", "/localize", **sent).json()["id"]
                until(lambda who=who, job=job: made.ask(who, "GET", f"/jobs/{job}").json()["finished"])
                made.jobs[who] = job
                owner = ring.caller(keys[who])
                assert owner
                lens = LensKey(owner.client, f"camera of {who}", "", "", "", None, None, 1.0, 1.5, is_video=False)
                seen = LensEstimate((0.0, 0.0, 0.0, 0.0), (0.01, 0.01, 0.01, 0.01), 5, 5, viewpoint(0.0))
                app.state.app_state.lenses.change(lens, lambda _, seen=seen: seen)
                made.lenses[who] = lens.id
            yield made
    viewer.close()


def test_every_route_has_a_decision(site):
    assert sorted(routes(site.app)) == sorted(decisions())


def filled(path: str, **values: str) -> str:
    given = {"name": "door", "index": "0", "format": "tum", "lens_id": "none", **values}
    for name, value in given.items():
        path = path.replace(f"{{{name}}}", value)
    assert "{" not in path
    return path


BODIES = {
    "POST /scenes/{scene_id}/render": {"pose": {"position": [0, 0, 0], "quaternion_wxyz": [1, 0, 0, 0]}},
    "POST /jobs/{job_id}/share": {},
}
EXPECTED = {"GET /scenes/{scene_id}/registration": 404, "POST /jobs/{job_id}/share": 201}
"""Of one's own; the others answer 200."""


def without(answer: httpx.Response, *names: str) -> tuple[int, str]:
    """Status and text of an answer, with a word in the place of the names that were asked for."""
    text = answer.text
    for name in names:
        text = text.replace(name, "ASKED")
    return answer.status_code, text


def test_lenses_are_seen_and_deleted_by_their_own_key(site):
    foreign, own = site.lenses["vault"], site.lenses["room"]
    assert [lens["id"] for lens in site.ask("room", "GET", "/lenses").json()["lenses"]] == [own]
    answers = {lens: site.ask("room", "DELETE", f"/lenses/{lens}") for lens in (foreign, "0" * 16)}
    assert_problem(answers[foreign], 404, "lens_not_found")
    assert without(answers[foreign], foreign) == without(answers["0" * 16], "0" * 16)
    assert site.ask("room", "DELETE", "/lenses").json()["deleted"] == 1
    assert [lens["id"] for lens in site.ask("admin", "GET", "/lenses").json()["lenses"]] == [foreign]


def of_kind(*kinds: str) -> list[str]:
    return [route for route, kind in decisions().items() if kind in kinds and not route.startswith("WEBSOCKET")]


@pytest.mark.parametrize("route", of_kind("scene"))
def test_another_scene_is_not_there(site, route):
    method, path = route.split()
    sent = {"json": BODIES[route]} if route in BODIES else {}
    answers = {name: site.ask("room", method, filled(path, scene_id=name), **sent) for name in ("vault", "cellar")}
    assert_problem(answers["vault"], 404, "scene_not_found")
    assert without(answers["vault"], "vault") == without(answers["cellar"], "cellar")
    own = site.ask("room", method, filled(path, scene_id="room"), **sent)
    assert own.status_code == EXPECTED.get(route, 200), own.text
    if own.status_code == 404:
        assert own.json()["code"] != "scene_not_found"


@pytest.mark.parametrize("route", of_kind("job"))
def test_another_keys_job_is_not_there(site, route):
    method, path = route.split()
    sent = {"json": BODIES[route]} if route in BODIES else {}
    foreign, none = site.jobs["vault"], "0123456789abcdef"
    answers = {job: site.ask("room", method, filled(path, job_id=job), **sent) for job in (foreign, none)}
    assert_problem(answers[foreign], 404, "job_not_found")
    assert without(answers[foreign], foreign) == without(answers[none], none)
    for who, job in (("room", site.jobs["room"]), ("admin", foreign)):
        own = site.ask(who, method, filled(path, job_id=job), **sent)
        assert own.status_code == EXPECTED.get(route, 409 if path.endswith("{format}") else 200), own.text


@pytest.mark.parametrize("route", of_kind("admin"))
def test_what_admins_do_is_refused_whatever_is_named(site, route):
    method, path = route.split()
    answers = {n: site.ask("room", method, filled(path, scene_id=n), json={}) for n in ("room", "vault", "cellar")}
    assert {answer.status_code for answer in answers.values()} == {403}
    assert len({without(answer, name) for name, answer in answers.items()}) == 1


@pytest.mark.parametrize("route", of_kind("nothing", "own"))
def test_lists_show_nothing_of_others(site, route):
    method, path = route.split()
    answer = site.ask("room", method, filled(path))
    for secret in ("vault", site.jobs["vault"], "boss"):
        assert secret not in answer.text
    if path in ("/jobs", "/scenes", "/metrics"):
        assert "room" in answer.text
        seen = site.ask("admin", method, path).text
        assert "room" in seen
        assert "vault" in seen


def test_metrics_are_of_ones_own_scenes_and_jobs(site):
    def samples(who: str) -> set[str]:
        texts = at_each_front(lambda: site.ask(who, "GET", "/metrics").text)
        lines = [line for text in texts for line in text.splitlines()]
        return {line.rpartition(" ")[0] for line in lines if not line.startswith("#")}

    own = 'splatfix_jobs_by_key_total{key="room",scene="room",state="succeeded"}'
    foreign = 'splatfix_jobs_by_key_total{key="vault",scene="vault",state="succeeded"}'
    assert {own, foreign} <= samples("admin")
    seen = samples("room")
    assert own in seen
    assert all('scene="room"' in sample for sample in seen)
    assert not any('key="' in sample and 'key="room"' not in sample for sample in seen)


def test_filters_and_counts_are_of_ones_own(site):
    found = site.ask("room", "GET", "/jobs", params={"scene": "vault"}).json()
    assert (found["jobs"], found["queued"], found["running"]) == ([], 0, 0)
    assert [job["id"] for job in site.ask("room", "GET", "/jobs").json()["jobs"]] == [site.jobs["room"]]
    assert {job["id"] for job in site.ask("admin", "GET", "/jobs").json()["jobs"]} >= set(site.jobs.values())


def test_a_photo_is_looked_for_in_ones_own_scenes(site):
    def send(scene: str | None) -> httpx.Response:
        data = {} if scene is None else {"scene": scene}
        return site.ask("room", "POST", "/localize", files={"photo": photo()}, data=data)

    for scene in ("vault", "room,vault"):
        refused = send(scene)
        assert_problem(refused, 404, "scene_not_found")
        assert without(refused, "vault") == without(send(scene.replace("vault", "cellar")), "cellar")
    for scene in (None, "auto", "room"):
        assert send(scene).json()["scene"] == "room"
    image = {"sensorReadings": {"cameraReadings": [{"imageBytes": "AAAA"}]}}
    refused = {s: site.ask("room", "POST", "/geopose", params={"scene": s}, json=image) for s in ("vault", "cellar")}
    assert without(refused["vault"], "vault") == without(refused["cellar"], "cellar")


def test_a_live_session_is_for_ones_own_scenes(site):
    def opened(who: str, scene: str) -> int:
        url = f"ws://{site.client.base_url.host}:{site.client.base_url.port}/scenes/{scene}/live"
        header = {"Authorization": f"Bearer {site.keys[who]}"}
        try:
            with websockets.sync.client.connect(url, additional_headers=header, proxy=None):
                return 101
        except InvalidStatus as error:
            return error.response.status_code

    assert (opened("room", "vault"), opened("room", "cellar"), opened("room", "room")) == (404, 404, 101)
    assert opened("admin", "vault") == 101


def test_the_viewer_asks_in_the_name_of_its_user(site):
    base = f"ws://{site.client.base_url.host}:{site.client.base_url.port}"
    for who in ("room", "vault", "room"):
        header = {"Authorization": f"Bearer {site.keys[who]}"}
        with websockets.sync.client.connect(f"{base}/viewer/", additional_headers=header, proxy=None) as socket:
            socket.recv()
    room, vault, again = site.viewer.tokens
    assert room == again != vault  # browsers of one key share what was requested
    for token, scene in ((room, "room"), (vault, "vault")):
        seen = site.client.get("/scenes", headers={"Authorization": f"Bearer {token}"}).json()["scenes"]
        assert [found["id"] for found in seen] == [scene]
    # It is good for nothing that needs no header.
    assert_problem(site.client.get("/jobs", headers={"Cookie": f"splatfix_session={room}"}), 401, "unauthorized")


@pytest.mark.ci
def test_the_viewer_shows_what_its_user_may_see(site):
    """viser and all: two users of one viewer, each through the relay with a key of their own."""
    url = str(site.client.base_url)
    viewer = Viewer(lambda token: Client(url, token, use_proxy=False), "127.0.0.1", 0)
    ring = site.app.state.app_state.keys
    app = create_app(settings(estimator="view_index"), keys=ring)
    try:
        with serving(with_viewer_at(viewer.server.get_port(), app, ring)) as front, ExitStack() as opened:
            # The job of `vault` is asked for by both.
            path = f"/viewer/jobs/{site.jobs['vault']}"
            seen = {
                who: opened.enter_context(FakeBrowser(front.base_url.port or 0, path, site.keys[who]))
                for who in ("room", "vault")
            }
            for who, browser in seen.items():
                browser.wait(lambda who=who, at=browser: list(at.widget("scene")["options"]) == [who], "its scene", 60)
            seen["room"].wait(lambda: "not found or expired" in seen["room"].text(), "the foreign job's error", 60)
            seen["vault"].wait(lambda: "/splats/splats" in seen["vault"].nodes, "its own job's scene", 60)
            assert not any(name.startswith("/splats") for name in seen["room"].nodes)
            assert "vault" not in str(seen["room"].widgets).replace(site.jobs["vault"], "")
    finally:
        viewer.stop()


def test_readiness_names_no_scene_to_others(site, monkeypatch):
    state = site.app.state.app_state
    found = state.engine.readiness()
    broken = replace(found, failed=tuple(SceneNote(scene, "damaged") for scene in ("room", "vault")))
    monkeypatch.setattr(state.engine, "readiness", lambda: broken)
    hidden = "a scene that this key may not use"
    assert site.ask("room", "GET", "/readyz").json()["failed"] == ["scene room: damaged", hidden]
    assert site.client.get("/readyz").json()["failed"] == [hidden, hidden]
    assert site.ask("admin", "GET", "/readyz").json()["failed"] == ["scene room: damaged", "scene vault: damaged"]
