"""The keys of a running service, over HTTP: made, listed and revoked by administrators, and told in the log."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import httpx
import pytest
from api_server import assert_problem, create_app, serving, settings, until
from stand_ins import make_scene

from service.web.api_keys import KeyRing
from service.web.key_file import KeyLimits, add_key, read_keys


@dataclass
class Site:
    client: httpx.Client
    file: Path
    ring: KeyRing
    boss: str

    def ask(self, method: str, path: str, key: str = "", **sent) -> httpx.Response:
        headers = {"Authorization": f"Bearer {key or self.boss}", **sent.pop("headers", {})}
        return self.client.request(method, path, headers=headers, **sent)


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Iterator[Site]:
    file = tmp_path_factory.mktemp("keys") / "keys.json"
    boss = add_key(file, "boss", "admin")
    ring = KeyRing(file)
    app = create_app(settings(keys_file=file, estimator="view_index"), {"room": make_scene()}, ring)
    with serving(app) as client:
        yield Site(client, file, ring, boss)


def test_a_key_is_made_shown_once_used_and_revoked(site):
    ends = datetime.now(UTC).replace(microsecond=0) + timedelta(days=1)
    wanted = {"role": "read", "scenes": ["ro*"], "rate": "5/minute", "queue_share": 0.25, "expires": ends.isoformat()}
    answer = site.ask("PUT", "/keys/robot-7", json=wanted)
    assert answer.status_code == 201
    made = answer.json()
    key = made.pop("key")
    assert datetime.fromisoformat(made["expires"]) == ends
    assert {name: made[name] for name in wanted if name != "expires"} | {"expires": wanted["expires"]} == wanted
    assert (made["name"], made["expired"], made["temporary"]) == ("robot-7", False, False)
    stored = next(known for known in read_keys(site.file) if known.name == "robot-7")
    assert stored.limits == KeyLimits(("ro*",), "5/minute", 0.25, ends.timestamp())
    # Nowhere but in that answer.
    listed = site.ask("GET", "/keys")
    assert made in listed.json()["keys"]
    assert key not in listed.text + site.file.read_text()

    assert site.ask("GET", "/scenes", key).status_code == 200
    own = site.ask("GET", "/key", key).json()
    assert own == {name: made[name] for name in ("name", "role", "scenes", "rate", "queue_share", "expires")}
    cookie = site.client.get("/", params={"key": key}).headers["set-cookie"].partition(";")[0]
    assert site.client.get("/key", headers={"Cookie": cookie}).json()["name"] == "robot-7"

    assert site.ask("DELETE", "/keys/robot-7").status_code == 204
    # At once, with its session.
    assert_problem(site.ask("GET", "/scenes", key), 401, "unauthorized")
    assert_problem(site.client.get("/key", headers={"Cookie": cookie}), 401, "unauthorized")
    assert_problem(site.ask("DELETE", "/keys/robot-7"), 404, "key_not_found")


def test_what_can_not_be_a_key_is_refused_with_its_reason(site):
    for name, body, where, said in (
        ("boss", {}, "name", "already exists"),
        ("a:b", {}, "path.name", "match"),
        ("x", {"role": "admin", "scenes": ["room"]}, "scenes", "all scenes"),
        ("x", {"scenes": []}, "scenes", "needs a scene"),
        ("x", {"scenes": ["a b"]}, "scenes", "pattern"),
        ("x", {"rate": "often"}, "rate", "no rate"),
        ("x", {"queue_share": 2}, "queue_share", "less than or equal to 1"),
        ("x", {"expires": "2031-01-01T00:00:00"}, "expires", "timezone"),
        ("x", {"expires_in": 3}, "expires_in", "unknown field"),
    ):
        refused = site.ask("PUT", f"/keys/{name}", json=body)
        assert_problem(refused, 400, "invalid_request")
        problem = refused.json()
        assert where in problem["where"], problem
        assert said in problem["detail"], problem
        assert problem["hint"]
    assert_problem(site.ask("DELETE", "/keys/boss"), 400, "invalid_request", "path.name")
    assert [key.name for key in read_keys(site.file)] == ["boss"]


def test_a_key_for_one_run_is_listed_and_revoked(site):
    key = site.ring.make_temporary("start", "admin")
    assert {"name": "start", "temporary": True}.items() <= site.ask("GET", "/keys").json()["keys"][-1].items()
    assert_problem(site.ask("PUT", "/keys/start", json={}), 400, "invalid_request", "name")
    assert site.ask("DELETE", "/keys/start").status_code == 204
    assert_problem(site.ask("GET", "/keys", key), 401, "unauthorized")


def test_other_sites_can_not_make_keys_with_a_visitors_session(site):
    cookie = site.client.get("/", params={"key": site.boss}).headers["set-cookie"]
    assert "SameSite=lax" in cookie
    session = {"Cookie": cookie.partition(";")[0]}
    own = f"http://{site.client.base_url.netloc.decode()}"
    for method, path in (("PUT", "/keys/mallory"), ("DELETE", "/keys/boss")):
        for origin in ("https://evil.example", "null"):
            refused = site.client.request(method, path, json={}, headers={**session, "Origin": origin})
            assert_problem(refused, 403, "forbidden", "header.origin")
    assert site.client.put("/keys/mine", json={}, headers={**session, "Origin": own}).status_code == 201
    assert site.ask("DELETE", "/keys/mine").status_code == 204


def test_each_act_of_an_admin_is_told_in_the_log(site, caplog):
    caplog.set_level(logging.INFO, "service.audit")
    reader = site.ask("PUT", "/keys/reader one", json={"role": "read"}).json()["key"]
    site.ask("GET", "/keys")
    site.ask("POST", "/scenes/room/unload", reader)
    site.ask("POST", "/scenes/none/load")
    site.client.cookies.clear()
    site.client.delete("/keys/boss")  # without a key: the log of requests has it
    site.ask("DELETE", "/keys/reader one")

    def lines() -> list[str]:
        told = [record.getMessage() for record in caplog.records if record.name == "service.audit"]
        return [line for line in told if "/keys/mine" not in line]  # of the test before, whose answer came first

    until(lambda: len(lines()) >= 4)  # each is written after its answer
    told = lines()
    caller = site.ring.caller(site.boss)
    assert caller
    boss = f"key 'boss' ({caller.id}) from 127.0.0.1:"
    assert told[0] == f"{boss} PUT /keys/reader%20one 201"
    assert told[1].startswith("key 'reader one' (")
    assert told[1].endswith("POST /scenes/room/unload 403")
    assert told[2:] == [f"{boss} POST /scenes/none/load 404", f"{boss} DELETE /keys/reader%20one 204"]
    assert not any(key in "".join(told) for key in (site.boss, reader))


def test_a_service_without_keys_makes_none_over_http(shared):
    """Whoever came first could lock the others out."""
    for method, path in (("GET", "/keys"), ("PUT", "/keys/me"), ("DELETE", "/keys/me")):
        assert_problem(shared.request(method, path, json={}), 409, "no_keys")
    assert shared.get("/key").json() == {
        "name": None, "role": "admin", "scenes": None, "rate": None, "queue_share": None, "expires": None
    }  # fmt: skip
