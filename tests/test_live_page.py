"""The live page in a real browser, whose camera plays a walk through a room that was rendered before."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from api_server import create_app, until
from axe_playwright_python.sync_playwright import Axe
from browsing import NEEDS_CHROMIUM, PATIENCE_MS, is_ready, launched, opened, served
from gateway import free_port
from playwright.sync_api import Browser, Page, expect
from small_room import FOCAL, pose_at, write_room

from service.geometry import moved, pose_distance
from service.loaded_scene import LoadedScene
from service.photos.images import encode_image
from service.types import Camera, Intrinsics, Pose
from service.web.settings import Settings

pytestmark = NEEDS_CHROMIUM
LENS = Intrinsics(640, 480, 2 * FOCAL, 2 * FOCAL, 320.0, 240.0)
TILT = np.array([0.15, 0.0, 0.0, 0.0, 0.0, 0.0])


def walk() -> list[Pose]:
    """To and fro, so that the film, which is repeated, has no jump."""
    return [moved(pose_at(1.0 + 0.25 * np.sin(2 * np.pi * k / 120), 0.1), TILT) for k in range(120)]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_room(tmp_path_factory.mktemp("scenes") / "room")


@pytest.fixture(scope="module")
def film(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """As Chromium's fake camera plays it: JPEGs, one after another."""
    renderer = LoadedScene.load(scene).rasterizer
    frames = [encode_image(renderer.render([Camera(LENS, pose)])[0].rgb, quality=95) for pose in walk()]
    file = tmp_path_factory.mktemp("film") / "walk.mjpeg"
    file.write_bytes(b"".join(frames))
    return file


@pytest.fixture(scope="module")
def url(scene: Path, scene_cache: Path) -> Iterator[str]:
    port = free_port()
    with served(create_app(Settings(scenes=[scene], port=port, cache_dir=scene_cache, viewer=False)), port) as url:
        until(lambda: is_ready(url), 240)
        yield url


@pytest.fixture(scope="module")
def browser(film: Path) -> Iterator[Browser]:
    camera = "--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream"
    with launched(*camera, f"--use-file-for-fake-video-capture={film}") as browser:
        yield browser


@pytest.fixture
def page(browser: Browser, url: str) -> Iterator[Page]:
    page = opened(browser, f"{url}/live", 1280, 800)
    troubles: list[str] = []
    page.on("pageerror", lambda error: troubles.append(str(error)))
    yield page
    page.close()
    assert not troubles


def test_the_camera_is_where_the_page_says(page: Page) -> None:
    answers: list[dict] = []
    page.on("websocket", lambda socket: socket.on("framereceived", lambda text: answers.append(json.loads(text))))
    page.get_by_role("button", name="Start camera").click()
    expect(page.locator(".verdict .badge")).to_have_text("Localized")
    expect(page.locator(".stack .above")).to_be_visible()
    localized: list[dict] = []
    deadline = time.monotonic() + PATIENCE_MS / 1000
    while len(localized) <= 10:
        assert time.monotonic() < deadline, f"{len(localized)} of {len(answers)} answers are localized"
        page.wait_for_timeout(200)  # events come meanwhile
        localized = [answer for answer in answers if answer.get("status") == "localized"]
    truth = walk()
    for answer in localized:
        pose = Pose(np.array(answer["world_from_camera"]))
        # Which frame of the film it was isn't known; that the pose is one of the walk's is.
        turned, shifted = min((pose_distance(pose, at) for at in truth), key=lambda error: error[1])
        assert turned < 1.0  # seen: 0.2
        assert shifted < 0.03
    # The lens was not told.
    assert localized[-1]["intrinsics"]["fx"] == pytest.approx(LENS.fx, rel=0.02)
    expect(page.get_by_text("Poses per second")).to_be_visible()
    page.get_by_role("button", name="Stop").click()
    expect(page.locator(".verdict .badge")).to_have_text("Off")


def test_a_restart_of_the_service_is_survived(browser: Browser, scene: Path, scene_cache: Path, tmp_path: Path) -> None:
    port, folders = free_port(), {"scenes": [scene], "cache_dir": scene_cache, "data_dir": tmp_path}
    settings = {**folders, "viewer": False}
    with served(create_app(Settings(port=port, **settings)), port) as url:
        until(lambda: is_ready(url), 240)
        page = opened(browser, f"{url}/live", 390, 844)
        page.get_by_role("button", name="Start camera").click()
        expect(page.locator(".verdict .badge")).to_have_text("Localized")
    expect(page.locator(".verdict .badge")).to_have_text("Connecting")
    with served(create_app(Settings(port=port, **settings)), port):
        expect(page.locator(".verdict .badge")).to_have_text("Localized")
        # Nothing is wider than a phone's screen.
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        page.close()


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_the_page_is_accessible(page: Page, theme) -> None:
    page.emulate_media(color_scheme=theme)
    page.get_by_role("button", name="Start camera").click()
    expect(page.locator(".verdict .badge")).to_have_text("Localized")
    found = Axe().run(page)
    assert found.violations_count == 0, found.generate_report()
