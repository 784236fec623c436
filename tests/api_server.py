"""A real server on real sockets for tests of the API; only the engine's parts are small stand-ins."""

from __future__ import annotations

import importlib
import io
import json
import os
import re
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import httpx
import numpy as np
import pytest
import uvicorn
from fastapi import FastAPI
from PIL import Image
from stand_ins import FileEvent, make_scene, packed, set_up_engine
from subprocess_engine import SubprocessEngine
from two_fronts import FRONTS, KEYS, THROUGH_A_GATEWAY, Made, relay_to, two_fronts

import service.estimators
import service.web.app
from service.jobs.embedded_engine import EmbeddedEngine
from service.jobs.engine import Engine
from service.loaded_scene import LoadedScene
from service.web.api_keys import KeyRing
from service.web.schemas.error_examples import EXAMPLES
from service.web.settings import Settings

ROOT = Path(__file__).parents[1]
T = TypeVar("T")
ESTIMATORS = str(ROOT / "tests" / "fake_estimators")
IN_SUBPROCESS = os.environ.get("SPLATFIX_TEST_ENGINE") == "subprocess"
"""Run all tests of the API on the engine of `subprocess_engine`; by hand, since each server takes seconds to start."""
NOT_IN_A_SUBPROCESS = {
    "test_a_scene_still_loading_is_not_ready": "holds a matcher by an event of the test's process",
    "test_a_bug_in_a_route_is_a_problem_document_without_details": "breaks a rasterizer in the test's process",
    "test_a_stopped_service_finishes_or_puts_back_what_runs": "lets a job go on from the test's process",
    "test_the_api_measures_in_the_background_and_tells_what_went_wrong": "measures in the test's process",
    "test_errors.py": "brings parts of the service into states by changing them in the test's process",
}
"""Tests of the API, or files of them, that reach around HTTP into the engine, and how."""
_FOLDER = tempfile.TemporaryDirectory(prefix="splatfix-go-on-")
GO_ON = FileEvent(Path(_FOLDER.name) / "set")
"""Held jobs wait for it, in whatever process they run."""


def create_app(
    settings: Settings,
    scenes: Mapping[str, LoadedScene] | None = None,
    keys: KeyRing | None = None,
    *,
    subprocess: bool = IN_SUBPROCESS,
) -> FastAPI:
    """Make the service's app, with scenes that are in memory already."""
    if subprocess:
        set_up = partial(set_up_engine, {name: packed(scene) for name, scene in (scenes or {}).items()}, GO_ON)
        engine: Engine = SubprocessEngine(settings.engine_config, set_up)
    else:
        engine = EmbeddedEngine(settings.engine_config)
        for scene_id, loaded in (scenes or {}).items():
            engine.add_loaded(scene_id, loaded)
    app = service.web.app.create_app(settings, engine, keys)
    if THROUGH_A_GATEWAY:
        fake = ESTIMATORS in service.estimators.__path__
        small = {name: packed(scene) for name, scene in (scenes or {}).items()}
        app.state.made = Made(settings, small, keys, GO_ON if fake or small else None)
    return app


def with_viewer_at(port: int, app: FastAPI, keys: KeyRing | None = None) -> FastAPI:
    """Give an app, which has these keys, a viewer that the test stands in for."""
    app.include_router(relay_to(port, keys).router)
    if hasattr(app.state, "made"):
        app.state.made = replace(app.state.made, viewer_port=port)
    return app


@contextmanager
def serving(app: FastAPI) -> Iterator[httpx.Client]:
    """Serve an app, or two of what it was made of behind nginx, where that is asked for."""
    if hasattr(app.state, "made"):
        with two_fronts(app) as url, _client(url) as client:
            yield client
        return
    listener = socket.create_server(("127.0.0.1", 0))
    # Longer than the client keeps a connection: else one may be closed as the next request is sent on it.
    config = uvicorn.Config(
        app, log_level="critical", ws="websockets-sansio", timeout_graceful_shutdown=1, timeout_keep_alive=8
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    url = f"http://127.0.0.1:{listener.getsockname()[1]}"
    try:
        with _client(url) as client:
            until(lambda: server.started)
            yield client
    finally:
        server.should_exit = True
        thread.join()
        listener.close()


def _client(url: str) -> httpx.Client:
    hooks = {"response": [assert_documented]}
    seconds = 90 if IN_SUBPROCESS or THROUGH_A_GATEWAY else 20  # the first request may wait for a child's imports
    return httpx.Client(base_url=url, timeout=seconds, trust_env=False, event_hooks=hooks)


def until(condition, seconds: float = 20) -> None:
    """Wait until the condition holds. It is mostly a request, so asking often costs more than what is waited for."""
    began = time.monotonic()
    while not condition():
        waited = time.monotonic() - began
        assert waited < seconds, "waited for too long"
        time.sleep(min(max(0.005, waited / 8), 0.05))


def at_each_front(ask: Callable[[], T]) -> list[T]:
    """Call what sends one request, once for each front: behind a gateway they answer in turn."""
    return [ask() for _ in range(FRONTS)]


def key_of(client: httpx.Client) -> str:
    """Return the key that a program needs to ask as the test's client does; empty unless it goes through a gateway."""
    return KEYS.get(client.base_url.port or 0, "")


def key_line(client: httpx.Client) -> str:
    """Return the line with the key for a request that a test writes itself; empty unless it goes through a gateway."""
    key = key_of(client)
    return f"Authorization: Bearer {key}\r\n" if key else ""


def photo_files(data: Path) -> list[str]:
    """Return the names of the files of photos that a service keeps in its folder, or two in their object store."""
    folder = data / "objects" / "photos" if THROUGH_A_GATEWAY else data / "photos"
    return [path.name for path in folder.iterdir()]


def scene_files(data: Path, scene_id: str) -> list[str]:
    """Return the names of the files of a scene that was uploaded to a service, or to two."""
    entry, folder = data / "objects" / "scenes" / f"{scene_id}.json", data / "scenes" / scene_id
    if THROUGH_A_GATEWAY:
        return (
            sorted(file["path"] for file in json.loads(entry.read_text())["value"]["files"]) if entry.exists() else []
        )
    return sorted(path.name for path in folder.iterdir()) if folder.exists() else []


def traces_of_uploads(data: Path) -> list[Path]:
    """Return all that uploads of scenes have left on disk, of whole ones and of others."""
    if THROUGH_A_GATEWAY:  # an object store has no folders: an empty one is nothing
        places = [data / "objects" / "scenes", data / "objects" / "uploads", *data.glob("front*/incoming")]
        return [path for place in places for path in place.rglob("*") if path.is_file()]
    places = [data / "scenes", data / "scenes" / ".incoming"]
    return [path for place in places for path in place.iterdir() if path not in places]


def assert_as_shown(problem: dict[str, Any]) -> None:
    """The text of an error is that of its example in openapi.yaml, but for names, numbers and lists of names."""
    shown = EXAMPLES[problem["code"]].model_dump()
    for field in ("detail", "where", "hint"):
        assert _without_values(problem[field]) == _without_values(shown[field]), field


def _without_values(text: str) -> str:
    for pattern, stands in (
        (r"can't run here: .*", "can't run here: REASON"),
        (r"'[^' ]*'", "'NAME'"),
        ("/scenes/[^/]+/", "/scenes/NAME/"),
        (r"\b[0-9a-f]{16}\b", "ID"),
        (r"(known|it has): [^.]+", r"\1: NAMES"),
        (r"\d+/(second|hour)", "RATE"),
        (r"limit [^)]+", "limit SIZE"),
        (r"\d+(\.\d+)?", "NUMBER"),
    ):
        text = re.sub(pattern, stands, text)
    return text


def until_ready(client: httpx.Client) -> None:
    """Wait until the scenes are loaded and prepared, which takes long where other processes use the CPU."""
    until(lambda: {answer.status_code for answer in at_each_front(lambda: client.get("/readyz"))} == {200}, 120)


@contextmanager
def fake_estimators() -> Iterator[ModuleType]:
    """The estimators of tests/fake_estimators, registered as any: by lying in the package's folder."""
    with pytest.MonkeyPatch.context() as patch:
        paths = list(service.estimators.__path__)
        if ESTIMATORS not in paths:  # fixtures of two modules may hold it at once
            patch.setattr(service.estimators, "__path__", [*paths, ESTIMATORS])
        stepping = importlib.import_module("service.estimators.stepping")
        patch.setattr(stepping, "GO_ON", GO_ON)
        yield stepping


@contextmanager
def ready_service(**changes) -> Iterator[httpx.Client]:
    with serving(create_app(settings(**changes), {"room": make_scene()})) as client:
        until_ready(client)
        yield client


def settings(**changes) -> Settings:
    return Settings(**{"viewer": False, "estimator": "stepping", "workers": 1, "queue_size": 2, **changes})


def photo(kind: str = "jpeg", size: tuple[int, int] = (96, 64), **save) -> bytes:
    pixels = np.random.default_rng(1).integers(0, 256, (*size[::-1], 3), np.uint8)
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, kind, **save)
    return file.getvalue()


def post(client: httpx.Client, data: bytes | None = None, prefer: str = "wait=20", **fields) -> httpx.Response:
    """Send a form; fields that aren't text go as JSON."""
    texts = {k: v if isinstance(v, str) else json.dumps(v) for k, v in fields.items()}
    files = {"photo": ("p.jpg", photo() if data is None else data, "image/jpeg")}
    return client.post("/localize", files=files, data=texts, headers={"Prefer": prefer} if prefer else {})


def finished(client: httpx.Client, path: str) -> dict:
    until(lambda: client.get(path).json()["finished"])
    return client.get(path).json()


def events(text: str) -> list[tuple[str, str, dict]]:
    """(event, id, data) of a server-sent event stream."""
    found = []
    for block in text.split("\n\n"):
        fields = dict(line.split(": ", 1) for line in block.splitlines() if not line.startswith(":"))
        if fields:
            found.append((fields["event"], fields.get("id", ""), json.loads(fields["data"])))
    return found


@cache
def operations() -> list[tuple[str, re.Pattern[str], dict]]:
    """Method, path and description of each documented operation."""
    found = create_app(Settings(scenes=[], viewer=False)).openapi()["paths"]
    return [
        (method.upper(), re.compile(re.sub(r"\{\w+\}", "[^/]+", path)), operation)
        for path, methods in found.items()
        for method, operation in methods.items()
    ]


def documented(operation: dict) -> dict[str, set[str]]:
    """Return the codes that an operation says it may give, by status."""
    contents = {status: r.get("content", {}) for status, r in operation["responses"].items()}
    return {
        status: set(content["application/problem+json"]["examples"])
        for status, content in contents.items()
        if "application/problem+json" in content
    }


def assert_documented(answer: httpx.Response) -> None:
    """Every error that any test meets must be in the API's description."""
    if answer.headers.get("content-type") != "application/problem+json":
        return
    answer.read()
    request, problem = answer.request, answer.json()
    for method, path, operation in operations():
        if request.method == method and path.fullmatch(request.url.path):
            told = documented(operation).get(str(problem["status"]), set())
            assert problem["code"] in told, f"{operation['operationId']} does not tell of {problem}"


PROBLEM = {"type", "title", "status", "detail", "instance", "code", "where", "hint"}


def assert_problem(answer: httpx.Response, status: int, code: str, where: str | None = None) -> None:
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    problem = answer.json()
    assert problem.keys() == PROBLEM
    assert (problem["status"], problem["code"]) == (status, code), problem
    assert problem["instance"] == answer.request.url.path
    assert problem["detail"]
    if where is not None:
        assert problem["where"] == where, problem
