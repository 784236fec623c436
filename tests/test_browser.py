"""The viewer in a real browser, through the relay: what a person sees and clicks. Needs Debian's chromium."""

from __future__ import annotations

import io
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from browsing import NEEDS_CHROMIUM, PATIENCE_MS, launched, opened, serious, served
from fake_service import FakeService, coverage_map, records
from fastapi import FastAPI
from fastapi.staticfiles import StaticFiles
from PIL import Image
from playwright.sync_api import Browser, Page, expect

from service.client import Client
from service.scene_manager.status import CoverageStatus
from service.web.api_keys import KeyRing
from service.web.pages import PAGES
from service.web.viewer_relay import Relay
from viewer.viewer_server import Viewer

pytestmark = NEEDS_CHROMIUM


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with launched() as browser:
        yield browser


@pytest.fixture
def fake() -> FakeService:
    return FakeService()


@pytest.fixture
def url(fake: FakeService) -> Iterator[str]:
    """A service that has nothing but the relay to a viewer of the fake service."""
    viewer = Viewer(lambda _: Client("http://fake", transport=fake.transport), "127.0.0.1", 0)
    relay = Relay(fake.upstream(viewer.server.get_port()), KeyRing(None))
    relay_only = FastAPI()
    relay_only.include_router(relay.router)
    relay_only.mount("/ui", StaticFiles(directory=PAGES))
    relay_only.add_api_route("/readyz", lambda: {"pending": fake.pending})
    relay_only.router.add_event_handler("shutdown", relay.close)
    with served(relay_only) as url:
        yield f"{url}/viewer"
    viewer.stop()


def test_an_open_page_loads_itself_anew_for_another_run_of_the_viewer(
    browser: Browser, fake: FakeService, url: str
) -> None:
    page = browser.new_page()
    page.set_default_timeout(PATIENCE_MS)
    # viser's empty page is covered until the panel is there, which may be before this test looks for the first time.
    page.add_init_script("""new MutationObserver(() => {
        const shown = [...document.querySelectorAll("[role=status]")];
        window.wasCovered ||= shown.some(element => element.textContent.includes("Loading the viewer"));
    }).observe(document, { childList: true, subtree: true })""")
    page.goto(f"{url}/")
    page.locator("[data-splatfix]").first.wait_for()
    expect(page.get_by_role("status").filter(has_text="Loading the viewer")).to_have_count(0)
    assert page.evaluate("window.wasCovered")
    page.evaluate("window.old = true")
    for _ in range(2):  # asked twice, once of a viewer of another front that runs for longer
        fake.viewer_started -= 1000.0
        page.wait_for_event("response", lambda response: response.url.endswith("/viewer-run"))
    assert page.evaluate("window.old")
    expect(page.locator(".splatfix-lost")).to_have_count(0)
    fake.viewer_started, fake.pending = time.monotonic(), ["scene ball: loading"]
    expect(page.locator(".splatfix-lost")).to_contain_text("scene ball: loading")
    fake.pending = []
    page.wait_for_function("!window.old")
    page.get_by_text("no job", exact=True).wait_for()
    expect(page.locator(".splatfix-lost")).to_have_count(0)
    page.close()


def test_a_replay_file_plays_from_disk(browser: Browser, fake: FakeService, url: str, tmp_path: Path) -> None:
    fake.job("saved", 4, finished=True)
    page = opened(browser, f"{url}/jobs/saved/")
    wait_for_step(page, 3)
    with page.expect_download() as waited:
        page.get_by_role("button", name="save as replay file").click()
    assert waited.value.suggested_filename == "splatfix-saved.html"
    waited.value.save_as(tmp_path / "replay.html")
    page.close()
    page = opened(browser, (tmp_path / "replay.html").as_uri())
    troubles: list[str] = []
    page.on("request", lambda request: troubles.append(request.url) if request.url.startswith("http") else None)
    wait_for_splats(page)
    assert "holiday" in page.title()
    seen: set[bytes] = set()
    deadline = time.monotonic() + PATIENCE_MS / 1000
    while len(seen) < 3:  # it plays: 4 steps with renders of 4 colours
        seen.add(page.locator("canvas").first.screenshot())
        assert time.monotonic() < deadline, "nothing moves"
    assert not troubles
    page.close()


def step_shown(page: Page) -> str:
    return page.get_by_role("slider").first.get_attribute("aria-valuenow") or ""


def compare(page: Page, mode: str) -> None:
    page.get_by_label("compare", exact=True).click()
    page.get_by_role("option", name=mode, exact=True).click()


def wait_for_step(page: Page, index: int) -> None:
    # The slider's thumb and, from the fake records, the number of matches.
    page.get_by_text(str(100 + index), exact=True).wait_for()
    assert step_shown(page) == str(index)


def picture(page: Page) -> str:
    """The address of the photo beside the render: another one for another picture."""
    return page.locator("img[src^='blob:']").first.get_attribute("src") or ""


def wait_for_other_picture(page: Page, old: str) -> None:
    deadline = time.monotonic() + PATIENCE_MS / 1000
    while picture(page) == old:
        assert time.monotonic() < deadline, "the picture did not change"
        page.wait_for_timeout(50)


def colours_in_3d(page: Page) -> float:
    """How much the colours differ in the middle of the 3D: 0 for a blank canvas."""
    shot = np.asarray(Image.open(io.BytesIO(page.locator("canvas").first.screenshot())).convert("RGB"), float)
    height, width = shot.shape[:2]
    middle = shot[height // 4 : -height // 4, width // 4 : -width // 4]
    return float(middle.std((0, 1)).mean())


def wait_for_splats(page: Page) -> None:
    deadline = time.monotonic() + PATIENCE_MS / 1000
    while (spread := colours_in_3d(page)) < 15:  # 50 seen; 8 with a single splat
        assert time.monotonic() < deadline, f"the 3D is blank: {spread}"
        page.wait_for_timeout(100)


def test_an_old_job_opens_by_its_address_and_can_be_stepped_through(
    browser: Browser, fake: FakeService, url: str
) -> None:
    fake.job("older", 4, finished=True)
    fake.job("newer", 2, finished=True)
    page = opened(browser, f"{url}/jobs/older/")
    page.get_by_text("localized", exact=True).wait_for()
    page.get_by_text("15 agree").wait_for()
    wait_for_step(page, 3)
    assert page.title() == "splatfix viewer"
    wait_for_splats(page)
    first = picture(page)
    page.get_by_role("button", name="previous").click()
    wait_for_step(page, 2)
    wait_for_other_picture(page, first)
    second = picture(page)
    compare(page, "difference")
    page.get_by_text("doubled").wait_for()
    wait_for_other_picture(page, second)
    compare(page, "flicker")
    above = page.locator(".splatfix-flicker img").last
    for opacity in ("1", "0", "1"):
        expect(above).to_have_css("opacity", opacity)
    compare(page, "side by side")
    expect(page.locator("img[src^='blob:']").first).to_be_visible()
    expect(above).not_to_be_visible()
    page.close()


@pytest.mark.parametrize(("width", "height"), [(1280, 800), (390, 844)])
def test_the_3d_view_has_most_of_the_window(
    browser: Browser, fake: FakeService, url: str, width: int, height: int
) -> None:
    fake.job("one", 3, finished=True)
    page = opened(browser, f"{url}/jobs/one/", width, height)
    page.get_by_text("localized", exact=True).wait_for()
    box = page.locator("canvas").first.bounding_box()
    assert box
    assert box["width"] >= 0.6 * width
    page.wait_for_timeout(500)  # what has appeared is named with the next frame
    assert not serious(page)
    for tab in ("match vectors", "curves") if width > 1000 else ():
        page.get_by_role("tab", name=tab).click()
        page.wait_for_timeout(500)
        assert not serious(page)
    page.close()


def test_on_a_phone_the_panel_is_a_sheet_that_folds(browser: Browser, fake: FakeService, url: str) -> None:
    fake.job("one", 3, finished=True)
    page = opened(browser, f"{url}/jobs/one/", 390, 844)
    page.get_by_text("localized", exact=True).wait_for()
    page.locator(".mantine-Notification-closeButton").click()  # that there is no GPU
    expect(page.locator(".mantine-Notification-closeButton")).to_have_count(0)
    assert share_of_3d(page) > 0.5
    assert page.evaluate("document.elementFromPoint(5, innerHeight - 5).tagName") != "CANVAS", "as wide as the screen"
    page.get_by_text("splatfix", exact=True).click()
    expect(page.get_by_text("localized", exact=True)).not_to_be_visible()
    assert share_of_3d(page) > 0.85
    page.close()


def share_of_3d(page: Page) -> float:
    """The share of the window in which the 3D view can be touched."""
    return page.evaluate(
        """() => {
            const parts = [...Array(20).keys()].map(i => (i + 0.5) / 20);
            const at = (x, y) => document.elementFromPoint(x * innerWidth, y * innerHeight)?.tagName === "CANVAS";
            return parts.flatMap(y => parts.map(x => at(x, y))).filter(Boolean).length / 400;
        }"""
    )


def test_the_plan_view_shows_coverage_with_its_legend(browser: Browser, fake: FakeService, url: str) -> None:
    fake.job("one", 3, finished=True)
    fake.coverage = CoverageStatus("ready", found=coverage_map())
    page = opened(browser, f"{url}/", 1280, 800)
    page.get_by_text("localized", exact=True).wait_for()
    page.get_by_role("checkbox", name="plan view").check()
    page.get_by_role("checkbox", name="coverage").check()
    page.get_by_text("found: 90 % and more").wait_for()
    expect(page.get_by_role("checkbox", name="floor plan")).to_be_checked()
    expect(page.get_by_role("checkbox", name="poses of all jobs")).to_be_checked()
    expect(page.get_by_role("checkbox", name="splats")).not_to_be_checked()
    assert not serious(page)
    page.get_by_role("checkbox", name="plan view").uncheck()
    expect(page.get_by_role("checkbox", name="floor plan")).not_to_be_checked()
    page.close()


def test_a_clicked_point_is_offered_to_be_named(browser: Browser, fake: FakeService, url: str) -> None:
    page = opened(browser, f"{url}/", 1280, 800)
    page.get_by_text("A ball:").wait_for()
    page.get_by_role("checkbox", name="name a point").check()
    link = page.get_by_text("Name the point")
    for _ in range(10):  # the first clicks may come before the scene
        page.mouse.click(420, 400)
        page.wait_for_timeout(500)
        if link.count():
            break
    assert "./#/scenes/ball?point=" in (link.get_attribute("data-splatfix") or "")
    page.close()


def test_a_new_job_is_followed_while_it_runs(browser: Browser, fake: FakeService, url: str) -> None:
    page = opened(browser, f"{url}/")
    page.get_by_text("no job", exact=True).wait_for()
    job = fake.job("live", 1)
    page.get_by_text("running", exact=True).wait_for()
    for record in records(6)[1:]:
        job.add(record)
    wait_for_step(page, 5)
    job.finish()
    page.get_by_text("localized", exact=True).wait_for()
    page.close()


def test_two_pages_show_two_jobs(browser: Browser, fake: FakeService, url: str) -> None:
    fake.job("one", 3, finished=True)
    fake.job("two", 5, finished=True)
    one, two = opened(browser, f"{url}/jobs/one/"), opened(browser, f"{url}/jobs/two/")
    wait_for_step(one, 2)
    wait_for_step(two, 4)
    pictures = picture(one), picture(two)
    two.get_by_role("button", name="previous").click()
    wait_for_step(two, 3)
    wait_for_other_picture(two, pictures[1])
    assert (step_shown(one), picture(one)) == ("2", pictures[0])
    one.close()
    two.close()
