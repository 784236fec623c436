"""A real server on real sockets for tests of the API; only the engine's parts are small stand-ins."""

from __future__ import annotations

import importlib
import io
import json
import re
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import ModuleType

import httpx
import numpy as np
import pytest
import uvicorn
from fastapi import FastAPI
from PIL import Image

import service.estimators
from service.interfaces import Features, Frame, Matcher, Rasterizer
from service.localize import LoadedScene
from service.types import Camera, GaussianScene, Intrinsics, NamedCamera, Pose, SceneInfo
from service.web.app import create_app
from service.web.settings import Settings

ROOT = Path(__file__).parents[1]
PHOTO = Intrinsics(96, 64, 80.0, 80.0, 48.0, 32.0)
HALF = 0.5**0.5
TURNED = np.array([[0.0, -1.0, 0.0, 1.0], [1.0, 0.0, 0.0, 2.0], [0.0, 0.0, 1.0, 3.0], [0.0, 0.0, 0.0, 1.0]])
"""A camera at (1, 2, 3), turned by 90 degrees about z."""


class FlatRasterizer(Rasterizer):
    """Every picture is mid-grey."""

    name = "flat"
    nbytes = 1000

    def trained_at(self, long_side_px):
        return self

    def render(self, cameras, **options):
        sizes = [(c.intrinsics.height, c.intrinsics.width) for c in cameras]
        flat = [np.full(size, 0.5, np.float32) for size in sizes]
        return [Frame(np.stack([f, f, f], 2), f, f, f) for f in flat]


class BlindMatcher(Matcher):
    """Sees nothing."""

    name = "blind"

    def extract(self, rgb, limit):
        return Features(*(np.zeros(s, np.float32) for s in ((0, 2), (0,), (0, 64))))

    def match(self, a, b):
        return np.zeros((0, 2), np.int32)


def make_scene(name: str = "room", count: int = 5) -> LoadedScene:
    rng = np.random.default_rng(0)
    camera = Camera(PHOTO, Pose(TURNED))
    scene = GaussianScene(
        means=rng.normal(size=(count, 3)).astype(np.float32),
        quats=np.tile(np.array([[HALF, 0, 0, HALF]], np.float32), (count, 1)),
        scales=np.tile(np.array([[0.3, 0.2, 0.1]], np.float32), (count, 1)),
        opacities=np.linspace(0.1, 1.0, count, dtype=np.float32),
        sh=np.zeros((count, 1, 3), np.float32),
        info=SceneInfo(name, name.title(), "ab" * 32, "ply"),
        cameras=(NamedCamera("images/a.jpg", camera),),
    )
    return LoadedScene(scene, FlatRasterizer(), BlindMatcher())


@contextmanager
def serving(app: FastAPI) -> Iterator[httpx.Client]:
    listener = socket.create_server(("127.0.0.1", 0))
    config = uvicorn.Config(app, log_level="critical", ws="websockets-sansio", timeout_graceful_shutdown=1)
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    url = f"http://127.0.0.1:{listener.getsockname()[1]}"
    try:
        hooks = {"response": [assert_documented]}
        with httpx.Client(base_url=url, timeout=20, trust_env=False, event_hooks=hooks) as client:
            until(lambda: server.started)
            yield client
    finally:
        server.should_exit = True
        thread.join()
        listener.close()


def until(condition, seconds: float = 20) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited for too long"
        time.sleep(0.005)


@contextmanager
def fake_estimators() -> Iterator[ModuleType]:
    """The estimators of tests/fake_estimators, registered as any: by lying in the package's folder."""
    with pytest.MonkeyPatch.context() as patch:
        folder, paths = str(ROOT / "tests" / "fake_estimators"), list(service.estimators.__path__)
        if folder not in paths:  # fixtures of two modules may hold it at once
            patch.setattr(service.estimators, "__path__", [*paths, folder])
        yield importlib.import_module("service.estimators.stepping")


@contextmanager
def ready_service(**changes) -> Iterator[httpx.Client]:
    with serving(create_app(settings(**changes), {"room": make_scene()})) as client:
        until(lambda: client.get("/readyz").status_code == 200)
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
            found.append((fields["event"], fields["id"], json.loads(fields["data"])))
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
