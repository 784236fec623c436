"""Two fronts on one database and one object store, with keys, behind nginx that takes them in turn."""

from __future__ import annotations

import json
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import httpx
import pytest
from api_server import create_app, events, finished, operations, photo, post, serving, settings, until, until_ready
from gateway import behind_nginx
from stand_ins import make_scene
from test_scenes import TRANSFORMS, archive, ply

from service.live_client import Live, LiveClosed
from service.web.key_file import KeyLimits, add_key

pytestmark = pytest.mark.ci


class Fleet:
    """The address of nginx, the fronts behind it, and a key of each role."""

    def __init__(self, url: str, fronts: list[httpx.Client], keys: dict[str, str]) -> None:
        self.url, self.fronts, self.keys = url, fronts, keys

    def client(self, key: str = "localize", **options) -> httpx.Client:
        headers = {"Authorization": f"Bearer {self.keys[key]}"} if key else {}
        return httpx.Client(base_url=self.url, headers=headers, timeout=30, trust_env=False, **options)


@pytest.fixture(scope="module")
def fleet(postgres, plugins, tmp_path_factory) -> Iterator[Fleet]:
    folder: Path = tmp_path_factory.mktemp("fleet")
    file = folder / "keys.json"
    keys = {role: add_key(file, role, role) for role in ("read", "localize", "admin")}
    keys["slow"] = add_key(file, "slow", "localize", KeyLimits(rate="3/hour"))
    shared = {"database": postgres.database(), "object_store": str(folder / "objects"), "keys_file": file}
    shared |= {"rate_limit": "", "workers": 2, "queue_size": 50, "live_sessions_of_client": 2}
    operations()  # before there are other threads: FastAPI silences warnings meanwhile, which is not safe beside them
    with ExitStack() as stack:
        fronts = []
        for number in range(2):
            chosen = settings(**shared, data_dir=folder / f"data{number}", cache_dir=folder / f"cache{number}")
            fronts.append(stack.enter_context(serving(create_app(chosen, {"room": make_scene()}))))
        for front in fronts:
            until_ready(front)
        url = stack.enter_context(behind_nginx([front.base_url.port for front in fronts], folder / "nginx"))
        yield Fleet(url, fronts, keys)


def test_requests_reach_both_fronts(fleet):
    """Each front counts its own requests."""

    def counted() -> list[str]:
        headers = {"Authorization": f"Bearer {fleet.keys['read']}"}
        told = [front.get("/metrics", headers=headers).text for front in fleet.fronts]
        wanted = 'splatfix_requests_total{method="GET",route="/key"'
        return [next(line for line in text.splitlines() if line.startswith(wanted)) for text in told]

    with fleet.client("read") as client:
        for _ in range(4):
            assert client.get("/key").status_code == 200
    for line in counted():
        assert float(line.split()[-1]) >= 2, line


def test_a_browsers_session_holds_at_both_fronts(fleet):
    with fleet.client("") as browser:
        assert browser.get("/scenes").status_code == 401
        entered = browser.get("/", params={"key": fleet.keys["localize"]})
        assert entered.status_code == 303
        assert [browser.get("/scenes").status_code for _ in range(4)] == [200] * 4


def test_a_share_link_opens_at_both_fronts(fleet):
    with fleet.client() as client, fleet.client("") as anybody:
        job = post(client, options={"steps": 2}, keep_photo="true").json()
        link = client.post(f"/jobs/{job['id']}/share", json={"expires_in_s": 60}).json()["link"]
        assert [anybody.get(f"{link}/{what}").status_code for what in ("job", "photo", "trace", "job")] == [200] * 4


def test_a_rate_is_that_of_both_fronts_together(fleet):
    with fleet.client("slow") as client:
        statuses = [client.post("/localize", files={"photo": b""}).status_code for _ in range(5)]
    assert statuses == [422] * 3 + [429] * 2


def test_one_of_many_equal_requests_is_a_job(fleet):
    with fleet.client() as client:

        def send(_: int) -> str:
            files = {"photo": ("p.jpg", photo(), "image/jpeg")}
            answer = client.post("/localize", files=files, headers={"Idempotency-Key": "one", "Prefer": "wait=20"})
            return answer.json()["id"]

        with ThreadPoolExecutor(4) as pool:
            assert len(set(pool.map(send, range(6)))) == 1


def test_events_of_a_job_come_from_whichever_front_is_asked(fleet):
    with fleet.client() as client:
        job = post(client, prefer="", options={"steps": 8, "pause_s": 0.15}).json()
        told: list[str] = []
        # Each request is answered by the other front than the one before.
        while "end" not in told:
            headers = {"Last-Event-ID": told[-1]} if told else {}
            with client.stream("GET", job["links"]["events"], headers=headers) as stream:
                for line in stream.iter_lines():
                    if line.startswith("id: "):
                        told.append(line.removeprefix("id: "))
                        if len(told) % 3 == 0:
                            break
        assert told == [*(f"1.{k}" for k in range(8)), "end"]
        with client.stream("GET", job["links"]["events"]) as stream:
            assert len(events("".join(stream.iter_text()))) == 9


def test_a_job_is_cancelled_by_whichever_front_is_asked(fleet, stepping):
    with fleet.client() as client:
        jobs = [post(client, prefer="", options={"hold": True}).json()["links"]["self"] for _ in range(2)]
        until(lambda: all(client.get(job).json()["records"] for job in jobs))
        for job in jobs:
            client.delete(job)
        stepping.GO_ON.set()
        assert [finished(client, job)["state"] for job in jobs] == ["cancelled"] * 2


def test_a_clients_live_sessions_count_at_both_fronts(fleet):
    def open_session() -> Live:
        return Live(fleet.url, "room", key=fleet.keys["localize"], proxy=None)

    with open_session(), open_session(), pytest.raises(LiveClosed, match="for this key reached: 2"):
        open_session()
    with open_session():
        pass


def test_an_uploaded_scene_is_there_at_both_fronts_until_it_is_deleted(fleet, stepping):
    with fleet.client("admin") as client:
        headers = {"Authorization": f"Bearer {fleet.keys['admin']}"}

        def answers(path: str) -> list[int]:
            return [front.get(path, headers=headers).status_code for front in fleet.fronts]

        # At once, whichever front is asked: not only once it has looked for what others have added.
        house = archive(scene_dot_ply=ply(), transforms_dot_json=json.dumps(TRANSFORMS))
        assert client.put("/scenes/house", content=house).status_code == 201
        assert answers("/scenes/house/anchors") == answers("/scenes/house") == [200, 200]
        # Each front loads it: who waits until it is ready must not be told by the other one that nobody has asked.
        states = {front.get("/scenes/house", headers=headers).json()["state"] for front in fleet.fronts}
        assert states <= {"loading", "preparing", "ready"}
        assert [client.put("/scenes/house", content=ply()).status_code for _ in fleet.fronts] == [409, 409]
        held = post(client, prefer="", scene="house", options={"hold": True}).json()["links"]["self"]
        assert [client.delete("/scenes/house").status_code for _ in fleet.fronts] == [409, 409]
        stepping.GO_ON.set()
        assert finished(client, held)["state"] == "succeeded"
        until(lambda: client.delete("/scenes/house").status_code == 204)
        assert answers("/scenes/house") == [404, 404]


def test_a_key_that_is_made_at_one_front_opens_the_other(fleet):
    with fleet.client("admin") as client:
        made = client.put("/keys/guest", json={"role": "read"}).json()["key"]
        guest = {"Authorization": f"Bearer {made}"}
        assert [front.get("/scenes", headers=guest).status_code for front in fleet.fronts] == [200, 200]
        assert client.delete("/keys/guest").status_code == 204
        assert [front.get("/scenes", headers=guest).status_code for front in fleet.fronts] == [401, 401]


def test_the_largest_answers_and_photos_pass(fleet):
    with fleet.client() as client:
        job = post(client, photo("png", (1200, 900)), options={"steps": 2}, keep_photo="true").json()
        assert job["state"] == "succeeded"
        assert client.get(job["links"]["photo"]).headers["content-type"] == "image/jpeg"
        assert json.loads(client.get("/openapi.json").text)["openapi"]
