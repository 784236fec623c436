"""service/client.py: against a running service with scripted estimators, and against broken connections."""

from __future__ import annotations

import ast
import asyncio
import io
import json
import sys
import threading
import time
from collections.abc import AsyncIterator
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace

import httpx
import numpy as np
import pytest
from api_server import ROOT, create_app, fake_estimators, photo, serving, settings, until_ready
from fake_service import FakeService, records
from stand_ins import make_scene

from service import client as client_module
from service.client import AsyncClient, Client, Intrinsics, Job, Pose, Prior, Record, ServiceError
from service.web.key_file import add_key

SOURCE = Path(client_module.__file__).read_text("utf-8")


@pytest.fixture(scope="module")
def keyed(tmp_path_factory):
    """(address, key) of a service with keys."""
    file = tmp_path_factory.mktemp("keys") / "keys.json"
    key = add_key(file, "tester", "admin")
    with fake_estimators(), serving(create_app(settings(keys_file=file), {"room": make_scene()})) as http:
        until_ready(http)
        yield str(http.base_url), key


def test_it_is_one_file_for_python_3_10():
    tree = ast.parse(SOURCE, feature_version=(3, 10))
    imported = {alias.name for n in ast.walk(tree) if isinstance(n, ast.Import) for alias in n.names}
    named = {(n.module, a.name) for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) for a in n.names}
    modules = imported | {str(module) for module, _ in named}
    assert {m.split(".")[0] for m in modules} <= {"httpx", "numpy", *sys.stdlib_module_names}
    # What the standard library has only since 3.11.
    newer = {"tomllib", "StrEnum", "Self", "UTC", "assert_never", "TaskGroup", "ExceptionGroup", "timeout", "batched"}
    assert not newer & ({name for _, name in named} | modules)
    assert not newer & {n.attr for n in ast.walk(tree) if isinstance(n, ast.Attribute)}
    # And numpy since 1.22, which Ubuntu 22.04 has beside Python 3.10.
    assert {n.attr for n in ast.walk(tree) if isinstance(n, ast.Attribute) and ast.unparse(n.value) == "np"} <= {
        *("array", "asarray", "diag", "eye", "float64", "load", "ndarray"),
    }


def test_a_photo_is_localized_with_a_key(keyed):
    url, key = keyed
    steps: list[Record] = []
    with Client(url, key + "\n", use_proxy=False) as service:  # a file's last line break
        result = service.localize(photo(), scene="room", seed=3, on_record=steps.append)
        assert result.pose.world_from_camera.shape == (4, 4)
        assert [step.index for step in steps] == list(range(len(steps)))
        assert np.allclose(steps[-1].pose.world_from_camera, result.pose.world_from_camera)
        newest = service.jobs(limit=1)[0]
        assert (newest.state, newest.result) == ("succeeded", None)
        assert service.job(newest.id).answer().raw == result.raw
        assert service.job(newest.id).raw["seed"] == 3
        with pytest.raises(ServiceError) as raised:  # a photo of noise
            service.export(newest.id, "tum")
        assert (raised.value.code, raised.value.status) == ("no_pose", 409)
        assert service.scene("room").raw["training_cameras"] is not None
        assert [scene.id for scene in service.scenes()] == ["room"]


def test_links_and_keys_are_made_and_revoked(keyed):
    url, key = keyed
    ends = datetime(2031, 1, 31, 12, tzinfo=UTC)
    with Client(url, key, use_proxy=False) as service:
        assert (service.own_key().name, service.own_key().role) == ("tester", "admin")
        made = service.add_key("robot 7", scenes=["room", "lab-*"], rate="600/minute", expires=ends)
        with Client(url, made, use_proxy=False) as robot:
            own = robot.own_key()
            assert (own.name, own.role, own.scenes, own.expires) == ("robot 7", "localize", ("room", "lab-*"), ends)
            assert own.raw["rate"] == "600/minute"
            job = robot.submit(photo(), scene="room")
            link = robot.share(job.id, expires_in_s=60)
            assert httpx.get(f"{link}/job").json()["job"]["id"] == job.id
            assert [known.name for known in service.all_keys()] == ["tester", "robot 7"]
            service.remove_key("robot 7")
            with pytest.raises(ServiceError) as raised:
                robot.own_key()
            assert raised.value.code == "unauthorized"
        assert httpx.get(f"{link}/job").status_code == 404

    async def same() -> list[str | None]:
        async with AsyncClient(url, key, use_proxy=False) as service:
            await service.add_key("other", "read")
            names = [(await service.own_key()).name, *(known.name for known in await service.all_keys())]
            await service.remove_key("other")
            assert "/shared/" in await service.share((await service.jobs(limit=1))[0].id)
            return names

    assert asyncio.run(same()) == ["tester", "tester", "other"]


def test_without_a_key_every_error_has_its_code(keyed):
    url, key = keyed
    for none in (None, "", " "):
        with Client(url, none, use_proxy=False) as service, pytest.raises(ServiceError) as raised:
            service.scenes()
        assert (raised.value.code, raised.value.status) == ("unauthorized", 401)
    with Client(url, key, use_proxy=False) as service:
        for call, code, status in (
            (lambda: service.localize(photo(), scene="nowhere"), "scene_not_found", 404),
            (lambda: service.job("nothing"), "job_not_found", 404),
            (lambda: list(service.follow("nothing")), "job_not_found", 404),
            (lambda: service.submit(b"no photo", scene="room"), "invalid_image", 422),
        ):
            with pytest.raises(ServiceError) as raised:
                call()
            assert (raised.value.code, raised.value.status) == (code, status)
            assert str(raised.value)
    with pytest.raises(ValueError, match="printable ASCII"):
        Client(url, "schlüssel")


def test_a_client_that_another_thread_closes_says_so(keyed):
    """Be it before a request, or in the middle of a stream."""
    url, key = keyed
    service = Client(url, key, use_proxy=False)
    job = service.submit(photo(), scene="room", options={"steps": 10**6, "pause_s": 0.05})
    codes: list[str] = []

    def follow() -> None:
        try:
            for _ in service.events(job.id):
                begun.set()
        except ServiceError as error:
            codes.append(error.code)

    begun = threading.Event()
    follower = threading.Thread(target=follow)
    follower.start()
    assert begun.wait(20)
    service.close()
    with pytest.raises(ServiceError) as raised:
        service.scenes()
    follower.join(20)
    assert (raised.value.code, codes) == ("closed", ["closed"])
    with Client(url, key, use_proxy=False) as other:
        other.cancel(job.id)


def test_a_service_without_keys_needs_none(shared):
    with Client(str(shared.base_url), use_proxy=False) as service:
        frames = service.localize([photo(), photo(), photo()], scene="room", times_s=[0, 0.5, 1]).frames
        assert [frame.time_s for frame in frames] == [0, 0.5, 1]
        assert frames[2].pose.world_from_camera.shape == (4, 4)


def test_fields_are_sent_as_the_service_reads_them(shared):
    camera = Intrinsics(96, 64, 80.0, 80.0, 48.0, 32.0)
    prior = Prior(Pose(np.eye(4)), sigma_deg=5, sigma_units=0.5)
    with Client(str(shared.base_url), use_proxy=False) as service:
        job = service.submit(photo(), scene="room", intrinsics=camera, prior=prior, truth=Pose(np.eye(4)))
        raw = service.wait(job.id).raw
    told = raw["prior_region"]["covariance"]["matrix"]
    assert np.allclose(np.diag(told), [np.radians(5) ** 2] * 3 + [0.25] * 3)
    assert np.array_equal(raw["truth"]["world_from_camera"]["matrix"], np.eye(4))
    assert Intrinsics.parse(raw["photo"]["intrinsics"]) == camera


def test_the_coroutines_do_the_same(shared):
    async def run() -> None:
        async with AsyncClient(str(shared.base_url), use_proxy=False) as service:
            steps: list[Record] = []
            result = await service.localize(photo(), scene="room", on_record=steps.append)
            assert steps
            assert np.allclose(steps[-1].pose.world_from_camera, result.pose.world_from_camera)
            job = await service.submit(photo(), scene="room")
            assert (await service.wait(job.id)).ended
            with pytest.raises(ServiceError) as raised:
                await service.scene("nowhere")
            assert raised.value.code == "scene_not_found"

    asyncio.run(run())


def test_both_clients_have_the_same_methods():
    public = [{name for name in vars(kind) if not name.startswith("_")} for kind in (Client, AsyncClient)]
    assert public[0] == public[1]


TURNED = Pose(np.array([[0.0, -1.0, 0.0, 1.0], [1.0, 0.0, 0.0, 2.0], [0.0, 0.0, 1.0, 3.0], [0.0, 0.0, 0.0, 1.0]]))
LENS = Intrinsics(96, 64, 80.0, 81.0, 48.0, 32.0)
SIZE = {"width": 96, "height": 64, "fx": 80.0, "fy": 81.0, "cx": 48.0, "cy": 32.0}
PLACED = {"pose": {"world_from_camera": TURNED.world_from_camera.tolist()}}


@pytest.mark.parametrize(
    ("name", "arguments", "options", "sent"),
    [
        ("job", ("j",), {}, ("GET", "/jobs/j", b"")),
        ("jobs", (), {"scene": "s", "limit": 3}, ("GET", "/jobs?scene=s&limit=3", b"")),
        ("cancel", ("j",), {}, ("DELETE", "/jobs/j", b"")),
        ("trace", ("j",), {}, ("GET", "/jobs/j/trace", b"")),
        ("photo", ("j",), {}, ("GET", "/jobs/j/photo", b"")),
        ("step_render", ("j", 4), {}, ("GET", "/jobs/j/iterations/4/render.jpg?camera=pose", b"")),
        ("step_render", ("j",), {"camera": "m"}, ("GET", "/jobs/j/iterations/last/render.jpg?camera=m", b"")),
        ("export", ("j", "colmap"), {"name": "a.jpg"}, ("GET", "/jobs/j/export/colmap?name=a.jpg", b"")),
        ("scenes", (), {}, ("GET", "/scenes", b"")),
        ("scene", ("s",), {}, ("GET", "/scenes/s", b"")),
        ("load_scene", ("s",), {}, ("POST", "/scenes/s/load", b"")),
        ("unload_scene", ("s",), {}, ("POST", "/scenes/s/unload", b"")),
        ("delete_scene", ("s",), {}, ("DELETE", "/scenes/s", b"")),
        ("coverage", ("s",), {}, ("GET", "/scenes/s/coverage", b"")),
        ("coverage", ("s",), {"measure": True}, ("POST", "/scenes/s/coverage", b"")),
        ("cancel_coverage", ("s",), {}, ("DELETE", "/scenes/s/coverage", b"")),
        ("anchors", ("s",), {}, ("GET", "/scenes/s/anchors", b"")),
        ("put_anchor", ("s", "a b/c", (1, 2, 3)), {},
         ("PUT", "/scenes/s/anchors/a%20b%2Fc", {"position": [1.0, 2.0, 3.0]})),
        ("delete_anchor", ("s", "a"), {}, ("DELETE", "/scenes/s/anchors/a", b"")),
        ("splats", ("s", 9), {}, ("GET", "/scenes/s/splats?max=9", b"")),
        ("render", ("s", TURNED), {}, ("POST", "/scenes/s/render", PLACED | {"format": "jpeg"})),
        ("render", ("s", TURNED, LENS), {"kind": "png"},
         ("POST", "/scenes/s/render", PLACED | {"format": "png", "intrinsics": SIZE})),
        ("depth", ("s", TURNED), {}, ("POST", "/scenes/s/render", PLACED | {"format": "depth"})),
    ],
)  # fmt: skip
def test_either_client_sends_what_the_api_documents_and_reads_its_answer(name, arguments, options, sent):
    answers, seen = documents(), []

    def answer(request: httpx.Request) -> httpx.Response:
        seen.append((request.method, request.url.raw_path.decode(), json.loads(request.content or b"null") or b""))
        found = answers[name]
        return httpx.Response(200, content=found) if isinstance(found, bytes) else httpx.Response(200, json=found)

    async def asynchronous():
        async with AsyncClient("http://fake", transport=httpx.MockTransport(answer)) as service:
            return await getattr(service, name)(*arguments, **options)

    with Client("http://fake", transport=httpx.MockTransport(answer)) as service:
        values = [getattr(service, name)(*arguments, **options), asyncio.run(asynchronous())]
    assert seen == [sent, sent]
    for value in values:
        if name in ("job", "cancel"):
            assert (value.id, value.state) == ("j", "running")
        elif name == "jobs":
            assert [job.id for job in value] == ["j"]
        elif name == "scenes":
            assert [scene.id for scene in value] == ["ball"]
        elif name in ("scene", "load_scene", "unload_scene"):
            assert value.id == "ball"
        elif name in ("anchors", "depth"):
            assert np.array_equal(value["door"] if name == "anchors" else value, [1.0, 2.0, 3.0])
        elif name in ("put_anchor", "delete_anchor", "delete_scene"):
            assert value is None
        else:
            assert value == (answers[name].decode() if name == "export" else answers[name])


def documents() -> dict[str, object]:
    """Return what a service answers to each method of the clients."""
    fake, depth = FakeService(), io.BytesIO()
    job = fake.job("j", 2).out().model_dump(mode="json")
    scene = httpx.Client(transport=fake.transport, base_url="http://fake").get("/scenes").json()["scenes"][0]
    np.save(depth, np.array([1.0, 2.0, 3.0]))
    return {
        **dict.fromkeys(("job", "cancel"), job), "jobs": {"jobs": [job]}, "trace": {"iterations": []},
        **dict.fromkeys(("photo", "step_render", "render", "splats", "export"), b"bytes"),
        **dict.fromkeys(("scene", "load_scene", "unload_scene"), scene), "scenes": {"scenes": [scene]},
        "coverage": {"state": "none"}, "cancel_coverage": {"state": "none"},
        "anchors": {"anchors": [{"name": "door", "position": [1, 2, 3]}]},
        **dict.fromkeys(("put_anchor", "delete_anchor", "delete_scene"), b""), "depth": depth.getvalue(),
    }  # fmt: skip


@pytest.mark.parametrize(
    ("states", "code"),
    [
        (["loading", "loading", "ready"], None),
        (["loading"] * 9, "timeout"),
        (["loading", "unloaded"], "scene_unloaded"),
        (["loading", "failed"], "corrupt_scene"),
    ],
)
def test_either_client_waits_until_a_scene_is_ready_or_never_will_be(states, code, monkeypatch):
    document, slept = documents()["scene"], []
    assert isinstance(document, dict)
    clock = SimpleNamespace(monotonic=lambda: time.monotonic() + sum(slept), sleep=slept.append)
    monkeypatch.setattr(client_module, "time", clock)

    async def sleep(seconds: float) -> None:
        slept.append(seconds)

    def transport() -> httpx.MockTransport:
        left = iter(states)

        def answer(request: httpx.Request) -> httpx.Response:
            state = next(left)
            problem = {"code": "corrupt_scene", "detail": "broken", "status": 422, "where": "", "hint": ""}
            return httpx.Response(
                200, json=document | {"state": state, "error": problem if state == "failed" else None}
            )

        return httpx.MockTransport(answer)

    async def asynchronous():
        monkeypatch.setattr(client_module, "asyncio", SimpleNamespace(sleep=sleep))
        async with AsyncClient("http://fake", transport=transport()) as service:
            return await service.wait_until_ready("ball", timeout_s=1.4)

    calls = [
        lambda: Client("http://fake", transport=transport()).wait_until_ready("ball", timeout_s=1.4),
        lambda: asyncio.run(asynchronous()),
    ]
    for call in calls:
        slept.clear()
        if code is None:
            assert call().state == "ready"
        else:
            with pytest.raises(ServiceError) as raised:
                call()
            assert raised.value.code == code
        # Half a second between two looks; the last of nine that are too many comes after 1.5 s.
        assert slept == [0.5] * {None: 2, "timeout": 3}.get(code, 1)


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(client_module, "_RECONNECT_S", 0.01)


def cut_once(fake: FakeService, job, after: int) -> list[str]:
    """Make the first stream of a job's events end early; return the list of what later ones resume after."""
    whole, resumed = job.events, []

    def events():
        resumed.append("")
        for count, chunk in enumerate(whole()):
            if len(resumed) == 1 and count == after:
                raise httpx.ReadError("cut")
            yield chunk

    job.events = events
    return resumed


def test_a_lost_connection_is_taken_up_again(quick):
    fake = FakeService()
    job = fake.job("b", 4, finished=True)
    streams = cut_once(fake, job, 2)
    with Client("http://fake", transport=fake.transport) as service:
        *steps, last = service.follow("b")
    assert len(streams) == 2
    assert {step.index for step in steps if isinstance(step, Record)} == {0, 1, 2, 3}
    assert isinstance(last, Job)
    assert last.answer().localized


def test_a_resumed_stream_tells_the_last_event_that_came(quick):
    asked: list[str] = []
    fake = FakeService()
    job = fake.job("b", 2, finished=True)

    def answer(request: httpx.Request) -> httpx.Response:
        asked.append(request.headers.get("last-event-id", ""))
        chunks = list(job.events())
        return httpx.Response(200, content=b"".join(chunks[:2] if len(asked) == 1 else chunks[2:]))

    with Client("http://fake", transport=httpx.MockTransport(answer)) as service:
        *steps, last = service.follow("b")
    assert asked == ["", "1.0"]
    assert [step.index for step in steps if isinstance(step, Record)] == [0, 1]
    assert isinstance(last, Job)


def test_a_full_queue_is_tried_again_as_the_same_request(quick):
    keys: list[str] = []
    accepted = FakeService().job("a", 1).out().model_dump(mode="json")

    def answer(request: httpx.Request) -> httpx.Response:
        keys.append(request.headers["idempotency-key"])
        if len(keys) < 3:
            problem = {"code": "queue_full", "detail": "full.", "where": "", "hint": ""}
            return httpx.Response(503, json=problem, headers={"Retry-After": "0"})
        return httpx.Response(202, json=accepted)

    with Client("http://fake", transport=httpx.MockTransport(answer)) as service:
        assert service.submit(b"x", timeout_s=5).id == "a"
        assert len(set(keys)) == 1
        keys.clear()
        with pytest.raises(ServiceError, match="full") as raised:
            service.submit(b"x", timeout_s=-1)
    assert (raised.value.code, raised.value.retry_after_s) == ("queue_full", 0)


def test_what_is_no_service_is_told(quick):
    page = httpx.MockTransport(lambda request: httpx.Response(200, text="<html>"))
    with pytest.raises(ServiceError, match="address of a splatfix service") as raised:
        Client("http://fake", transport=page).scenes()
    assert raised.value.code == "http_error"
    down = httpx.MockTransport(lambda request: httpx.Response(502, text="Bad Gateway"))
    with pytest.raises(ServiceError, match="HTTP 502") as raised:
        Client("http://fake", transport=down).localize(b"x", timeout_s=0.05)
    assert raised.value.code == "unreachable"


def test_waiting_ends_and_the_job_goes_on():
    fake = FakeService()
    fake.job("a", 1)  # runs, and sends pings
    with Client("http://fake", transport=fake.transport) as service, pytest.raises(ServiceError) as raised:
        service.wait("a", timeout_s=0.3)
    assert raised.value.code == "timeout"


def test_an_async_stream_is_parsed_as_it_comes(quick):
    job = FakeService().job("a", 2, finished=True)

    async def chunks() -> AsyncIterator[bytes]:
        for chunk in job.events():
            yield chunk

    transport = httpx.MockTransport(lambda request: httpx.Response(200, content=chunks()))

    async def run() -> list:
        async with AsyncClient("http://fake", transport=transport) as service:
            return [item async for item in service.follow("a")]

    *steps, last = asyncio.run(run())
    assert [step.index for step in steps] == [0, 1]
    assert np.allclose(steps[1].pose.world_from_camera, records(2)[1].pose.world_from_camera)
    assert last.answer().score == 0.93


def test_a_point_is_projected_where_frames_md_says():
    taken = json.loads((ROOT / "scenes" / "studio" / "truth.json").read_text())[0]
    camera = Intrinsics(**{name: taken["intrinsics"][name] for name in ("width", "height", "fx", "fy", "cx", "cy")})
    pixel = Pose(np.array(taken["world_from_camera"])).project([2.42, 1.96, 0.847], camera)
    assert np.allclose(pixel, [366.7, 350.4], atol=0.05)
