"""The start page and the viewer in Firefox, with the demo scene. Needs Debian's firefox-esr and xvfb."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from api_server import create_app, until
from browsing import HTTP, entrance, is_ready, served
from firefox import FIREFOX, XVFB, Page, firefox
from gateway import free_port
from PIL import Image

from service.web.settings import Settings

pytestmark = [
    pytest.mark.browser,
    pytest.mark.timeout(300),
    pytest.mark.skipif(not (FIREFOX and XVFB), reason="there is no firefox, or no Xvfb, on this machine"),
]
STUDIO = Path(__file__).parents[1] / "scenes" / "studio"


@pytest.fixture(scope="module")
def url(scene_cache: Path) -> Iterator[str]:
    port = free_port()
    with served(create_app(Settings(scenes=[STUDIO], port=port, cache_dir=scene_cache)), port) as url:
        until(lambda: is_ready(url), 240)
        yield url


@pytest.fixture
def page(tmp_path: Path) -> Iterator[Page]:
    with firefox(tmp_path) as page:
        yield page


CANVAS = "document.querySelector('canvas').getBoundingClientRect()"


def test_a_photo_is_localized_and_seen_in_the_viewer(page: Page, url: str) -> None:
    page.open(entrance(url))
    page.wait_for("document.querySelectorAll('input[name=scene]').length")
    page.choose_file("#photo", STUDIO / "photos" / "photo_00.jpg")
    page.wait_for("document.querySelector('.badge.localized') !== null")
    page.wait_for("[...document.querySelectorAll('.stack img')].every(image => image.naturalWidth > 0)")
    job = page.tell("location.hash").rpartition("/")[2]
    position = HTTP.get(f"{url}/jobs/{job}").json()["result"]["pose"]["position"]
    shown = page.tell("document.querySelector('details.pose pre').textContent").split()
    assert np.allclose([float(shown[i]) for i in (3, 7, 11)], position, atol=1e-8)  # of the 4x4, row by row
    page.open(f"{url}/viewer/jobs/{job}/")
    page.wait_for("document.body.innerText.includes('localized')")
    until(lambda: colours_in_3d(page) > 15)


def colours_in_3d(page: Page) -> float:
    """How much the colours differ in the middle of the 3D view: 0 for a blank canvas."""
    width, height = int(page.tell(f"{CANVAS}.width")), int(page.tell(f"{CANVAS}.height"))
    shot = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"), float)
    middle = shot[height // 4 : 3 * height // 4, width // 4 : 3 * width // 4]
    return float(middle.std((0, 1)).mean())
