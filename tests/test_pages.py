"""The start page in a real browser, with the demo scene: from a photo that is dropped to the pose that is read."""

from __future__ import annotations

import base64
import io
import json
import re
import threading
import time
from collections.abc import Iterator
from contextlib import nullcontext
from csv import DictReader
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Literal
from zipfile import ZipFile

import numpy as np
import pytest
from api_server import create_app
from axe_playwright_python.sync_playwright import Axe
from browsing import HTTP, NEEDS_CHROMIUM, PATIENCE_MS, is_ready, launched, opened, serious, served, share_key, sign_in
from gateway import behind_nginx, free_port
from PIL import Image
from playwright.sync_api import Browser, Page, Route, expect
from small_room import INTRINSICS, pose_at, write_room

from service.coverage.calibration import Calibration
from service.coverage.coverage_map import CoverageMap, Trial
from service.coverage.measurement import Measurement
from service.geometry import look_at, rotation_from_quat
from service.labels import REASONS, TABLES
from service.loaded_scene import LoadedScene
from service.localize import Cancelled
from service.results import Status
from service.types import Pose
from service.web.api_keys import KeyRing
from service.web.key_file import Role, add_key, read_keys
from service.web.settings import Settings

pytestmark = NEEDS_CHROMIUM
STUDIO = Path(__file__).parents[1] / "scenes" / "studio"
PHOTO = STUDIO / "photos" / "photo_00.jpg"
FOG = Image.linear_gradient("L").resize((320, 240)).convert("RGB")
"""A photo that shows nothing."""


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory, scene_cache: Path) -> Iterator[str]:
    port = free_port()
    room = write_room(tmp_path_factory.mktemp("scenes") / "room")
    settings = Settings(scenes=[STUDIO, room], port=port, cache_dir=scene_cache)
    with served(create_app(settings), port) as url:
        until(lambda: is_ready(url), 240)  # kernels may be compiled
        yield url


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with launched() as browser:
        yield browser


@pytest.fixture
def page(browser: Browser, url: str) -> Iterator[Page]:
    page = opened(browser, f"{url}/", 1200, 900)
    troubles: list[str] = []
    page.on("pageerror", lambda error: troubles.append(str(error)))
    yield page
    page.close()
    assert not troubles


def until(condition, seconds: float = 90) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.05)


def drop(page: Page, data: bytes, name: str, *, paste: bool = False) -> None:
    """Drop a file on the page, as the mouse does, or paste it."""
    drop_all(page, {name: data}, paste=paste)


def drop_all(page: Page, files: dict[str, bytes], *, paste: bool = False) -> None:
    page.evaluate(
        """([files, paste]) => {
            const dataTransfer = new DataTransfer();
            for (const [name, base64] of files) {
                const bytes = Uint8Array.from(atob(base64), letter => letter.charCodeAt(0));
                dataTransfer.items.add(new File([bytes], name, { type: "image/jpeg" }));
            }
            const over = type => new DragEvent(type, { dataTransfer, bubbles: true, cancelable: true });
            const pasted = new ClipboardEvent("paste", { clipboardData: dataTransfer, bubbles: true });
            for (const event of paste ? [pasted] : [over("dragover"), over("drop")]) {
                document.querySelector("main").dispatchEvent(event);
            }
        }""",
        [[[name, base64.b64encode(data).decode()] for name, data in files.items()], paste],
    )


def posted(url: str, photo: bytes, fields: dict) -> dict:
    """Localize a photo by the API alone."""
    wait = {"Prefer": "wait=60"}
    answer = HTTP.post(f"{url}/localize", files={"photo": photo}, data=fields, headers=wait, timeout=90)
    return answer.json()


def jpeg(image: Image.Image) -> bytes:
    file = io.BytesIO()
    image.save(file, "JPEG")
    return file.getvalue()


def job_of(page: Page, url: str) -> dict:
    return HTTP.get(f"{url}/jobs/{page.url.rpartition('/')[2]}").json()


def written(page: Page, title: str) -> str:
    """The text of one spelling of the pose."""
    row = page.locator("details.pose").filter(has_text=title)
    if row.get_attribute("open") is None:
        row.locator("summary").click()
    return row.locator("pre").inner_text()


def truth_of(photo: Path) -> np.ndarray:
    truths = json.loads((STUDIO / "truth.json").read_text())
    return np.array(next(t["world_from_camera"] for t in truths if t["photo"] == photo.name))


def fact(page: Page, name: str) -> str:
    return page.locator(".facts div").filter(has_text=name).locator("dd").inner_text()


def numbers(text: str) -> np.ndarray:
    return np.array(text.split(), np.float64)


def test_a_dropped_photo_gets_its_pose(page: Page, url: str) -> None:
    page.get_by_role("radio").first.wait_for()
    expect(page.locator(".card:has(:checked)")).to_contain_text("Studio")
    drop(page, PHOTO.read_bytes(), PHOTO.name)
    page.locator(".badge.localized").wait_for()
    job = job_of(page, url)
    pose = job["result"]["pose"]
    # Nine decimals are written.
    there = numbers(written(page, "World from camera, OpenCV")).reshape(4, 4)
    np.testing.assert_allclose(there, pose["world_from_camera"]["matrix"], atol=6e-10)
    opengl = numbers(written(page, "World from camera, OpenGL")).reshape(4, 4)
    np.testing.assert_allclose(opengl, pose["opengl"]["world_from_camera"]["matrix"], atol=6e-10)
    back = numbers(written(page, "Camera from world")).reshape(4, 4)
    np.testing.assert_allclose(back @ there, np.eye(4), atol=1e-7)
    # Against the truth, not only against the API.
    assert np.linalg.norm(there[:3, 3] - truth_of(PHOTO)[:3, 3]) < 0.05
    # The lines for other programs say what the service's own files say.
    for title, kind, line in (("COLMAP", "colmap", 2), ("TUM", "tum", 0)):
        theirs = HTTP.get(f"{url}{job['links']['export']}/{kind}").text.splitlines()[line].split()
        ours = written(page, title).split()
        words = slice(0, -1) if kind == "colmap" else slice(0, None)
        np.testing.assert_allclose(np.float64(ours[words]), np.float64(theirs[words]), atol=1e-6)
        assert kind == "tum" or ours[-1] == theirs[-1] == PHOTO.name


def test_a_pasted_photo_that_shows_nothing_is_refused_with_reason_and_hint(page: Page, url: str) -> None:
    page.get_by_role("radio").first.wait_for()
    drop(page, jpeg(FOG), "fog.jpg", paste=True)
    page.locator(".badge.not_localized").wait_for()
    result = job_of(page, url)["result"]
    lead = page.locator(".lead")
    expect(lead).to_contain_text(
        f"{REASONS[result['reason']]}. {result['search_summary']} {result['hint']}".replace("  ", " ")
    )
    assert not identifiers(page)
    expect(page.get_by_text("Best guess only")).to_be_visible()
    expect(page.get_by_role("button", name="COLMAP", exact=True)).to_have_count(0)
    _audit(page)


def test_an_ambiguous_photo_tells_the_other_places(page: Page, url: str) -> None:
    job = posted(url, PHOTO.read_bytes(), {"scene": "studio"})
    other = {"probability": 0.42, "pose": job["result"]["pose"] | {"position": [1.0, -2.5, 0.125]}}
    job["result"] |= {"status": "uncertain", "reason": "ambiguous", "hint": "Show more.", "alternatives": [other]}
    page.route(f"{url}/jobs/{job['id']}", lambda route: route.fulfill(json=job))
    page.goto(f"{url}/#/jobs/{job['id']}")
    expect(page.get_by_text("Other possible positions")).to_contain_text("1.000, -2.500, 0.125 (42 %)")
    _audit(page)


def test_the_answer_can_be_copied_and_taken_along(page: Page, url: str, tmp_path: Path) -> None:
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    job = posted(url, PHOTO.read_bytes(), {"scene": "studio"})
    page.goto(f"{url}/#/jobs/{job['id']}")
    page.get_by_role("button", name="Copy World from camera, OpenCV axes").click()
    page.get_by_text("Copied", exact=True).wait_for()
    copied = numbers(page.evaluate("navigator.clipboard.readText()")).reshape(4, 4)
    np.testing.assert_allclose(copied, job["result"]["pose"]["world_from_camera"]["matrix"], atol=6e-10)
    for link, kind in (("JSON", "self"), ("Trace", "trace")):
        with page.expect_download() as waited:
            page.get_by_role("link", name=link, exact=True).click()
        taken = json.loads(waited.value.path().read_text())
        assert taken == HTTP.get(f"{url}{job['links'][kind]}").json()
    with page.expect_download() as waited:
        page.get_by_role("link", name="nerfstudio", exact=True).click()
    opengl = json.loads(waited.value.path().read_text())["transform_matrix"]
    np.testing.assert_allclose(opengl, job["result"]["pose"]["opengl"]["world_from_camera"]["matrix"], atol=1e-12)
    with page.expect_download() as waited:
        page.get_by_role("button", name="COLMAP", exact=True).click()
    images, _ = _colmap_texts(waited.value.path().read_bytes(), tmp_path)
    # A sequence has the poses of all frames that were localized, which are given from the camera to the world.
    frame = {"name": "a b.jpg", "status": "localized", "world_from_camera": job["result"]["pose"]["world_from_camera"]}
    job["result"]["frames"] = [frame, frame | {"status": "uncertain"}]
    texts = page.evaluate("async job => await (await import('/ui/tables.js')).colmapModel([job]).text()", job)
    one, of_sequence = (_image_lines(text.partition("QW QX")[2].partition("POINT3D_ID")[0]) for text in (images, texts))
    assert (len(one), [line[9] for line in of_sequence]) == (1, ["a_b.jpg"])
    np.testing.assert_allclose(np.float64(of_sequence[0][:9]), np.float64(one[0][:9]), atol=1e-12)


def test_who_has_no_photo_can_try_a_view_of_the_scene(page: Page) -> None:
    page.get_by_role("radio", name="room").check()
    page.get_by_role("button", name="Try a view of the scene").click()
    page.locator(".badge.localized").wait_for()
    # The picture's pose was sent as the truth; 0.002 seen.
    assert float(fact(page, "Rotation error").rstrip("°")) < 0.1


def test_a_running_job_can_be_watched_and_cancelled(page: Page) -> None:
    page.get_by_role("radio", name="room").check()
    page.get_by_text("Intrinsics, prior, estimator").click()
    page.get_by_role("combobox").first.select_option("mc_do")
    page.get_by_label(re.compile("^hypotheses")).fill("4096")
    page.get_by_label("refinement steps").fill("10000")
    page.set_input_files("#photo", PHOTO)
    expect(page.locator(".line")).to_contain_text("step 1")
    expect(page.get_by_role("link", name="Watch in viewer")).to_have_attribute("href", re.compile("/viewer/jobs/"))
    _audit(page)
    page.get_by_role("button", name="Cancel").click()
    page.locator(".badge.cancelled").wait_for()


def test_the_viewer_shows_how_the_pose_was_found(page: Page, url: str) -> None:
    # In a small scene: software GL draws the studio in seconds a frame.
    page.set_viewport_size({"width": 900, "height": 620})
    pose = {"world_from_camera": pose_at(0.3, 0.1).world_from_camera.tolist()}
    wanted = {"pose": pose, "intrinsics": INTRINSICS, "format": "png"}
    photo = HTTP.post(f"{url}/scenes/room/render", json=wanted).content
    fields = {"scene": "room", "intrinsics": json.dumps(INTRINSICS), "truth": json.dumps(pose)}
    job = posted(url, photo, fields)
    page.goto(f"{url}/#/jobs/{job['id']}")
    page.get_by_role("link", name="Open in viewer").click()
    page.get_by_text("localized", exact=True).wait_for()
    page.get_by_text("agree").first.wait_for()
    # The last step is the gate's; its matches come from the step that made them.
    page.get_by_text("with the matches of step").wait_for()
    step = page.get_by_role("slider").first
    last = int(step.get_attribute("aria-valuenow") or "")
    picture = page.locator("img[src^='blob:']").first
    seen = {picture.get_attribute("src")}
    page.get_by_role("tab", name="match vectors").click()
    figures = [page.locator("figcaption").first.inner_text()]
    page.get_by_role("tab", name="curves").click()
    page.get_by_text("position error").last.wait_for()  # the curve's title
    marks = [page.locator("svg[aria-label='loss by step'] path[stroke='#fff']").get_attribute("d")]
    page.keyboard.press("p")
    page.keyboard.press("p")
    page.keyboard.press("p")
    expect(step).to_have_attribute("aria-valuenow", str(last - 3))
    mark = page.locator("svg[aria-label='loss by step'] path[stroke='#fff']")
    expect(mark).not_to_have_attribute("d", marks[0] or "")
    page.get_by_role("tab", name="match vectors").click()
    expect(page.locator("figcaption").first).not_to_have_text(figures[0])
    page.get_by_role("tab", name="photo and render").click()
    until(lambda: picture.get_attribute("src") not in seen)


def test_photo_and_render_are_blended_under_the_slider(page: Page) -> None:
    page.set_input_files("#photo", PHOTO)
    slider = page.get_by_role("slider")
    above = page.locator(".stack .above")
    assert above.evaluate("image => image.decode().then(() => image.naturalWidth)") == 640
    assert above.evaluate("image => getComputedStyle(image).opacity") == "0.5"
    slider.press("End")
    assert above.evaluate("image => getComputedStyle(image).opacity") == "1"
    page.get_by_role("button", name="Photo", exact=True).click()
    assert above.evaluate("image => getComputedStyle(image).opacity") == "0"


def test_the_curl_line_sends_the_very_same_request(page: Page, url: str) -> None:
    page.get_by_text("Intrinsics, prior, estimator").click()
    page.get_by_label("candidates").fill("3")
    page.get_by_label("Seed").fill("7")
    page.get_by_label("fx").fill("5e2")
    for name, value in (("fy", "500"), ("cx", "320"), ("cy", "240"), ("width", "640"), ("height", "480")):
        page.get_by_label(name, exact=True).fill(value)
    truth = page.get_by_role("group", name="True pose")
    truth.get_by_label("Matrix").fill(", ".join(map(str, np.array(truth_of(PHOTO)).flat)))
    page.set_input_files("#photo", PHOTO)
    page.locator(".verdict .badge").wait_for()
    job = job_of(page, url)
    there = np.array(job["result"]["pose"]["position"])
    error = np.linalg.norm(there - truth_of(PHOTO)[:3, 3])
    # Three digits are written.
    assert float(fact(page, "Position error").split()[0]) == pytest.approx(error, rel=6e-3)
    assert (job["seed"], job["options"]) == (7, {"candidates": 3})
    assert job["result"]["intrinsics"]["fx"] == 500
    sent = page.locator("pre.curl").inner_text()
    assert "-F 'seed=7'" in sent
    assert """-F 'options={"candidates":3}'""" in sent
    page.reload()  # what this tab remembers is gone: now it is told from the job
    page.locator(".verdict .badge").wait_for()
    told = page.locator("pre.curl").inner_text()
    assert """'options={"candidates":3}'""" in told
    assert '"fx":500' in told


def test_what_is_no_photo_is_told_and_the_page_goes_on(page: Page) -> None:
    page.get_by_role("radio").first.wait_for()
    drop(page, b"not a photo", "notes.jpg")
    expect(page.get_by_role("alert")).to_contain_text("photo")
    drop(page, PHOTO.read_bytes(), PHOTO.name)
    page.locator(".badge.localized").wait_for()


def test_jobs_are_listed_filtered_and_compared(page: Page, url: str) -> None:
    for seed in (1, 2):
        assert posted(url, PHOTO.read_bytes(), {"seed": seed, "scene": "studio"})["status"] == "localized"
    page.get_by_role("link", name="History").click()
    rows = page.locator("tbody tr")
    rows.nth(1).wait_for()
    page.get_by_label("Outcome").select_option("interrupted")
    page.get_by_text("No jobs match").wait_for()
    page.get_by_label("Outcome").select_option("localized")
    for i in range(2):
        rows.nth(i).get_by_role("checkbox").check()
    page.get_by_role("button", name="Compare two").click()
    page.get_by_role("heading", name="Comparison").wait_for()
    # Another seed of the same method: next to nothing lies between the poses, and it is said in metres.
    expect(page.get_by_text("apart.")).to_contain_text(" m apart")
    expect(page.get_by_role("row", name="seed")).to_contain_text("2")
    assert page.locator(".stack").count() == 2


def test_the_api_page_needs_no_other_server(page: Page, url: str) -> None:
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.goto(f"{url}/docs")
    page.get_by_text("Post a photo to").wait_for()
    page.get_by_text("/localize", exact=True).first.wait_for()
    assert [address for address in asked if not address.startswith((f"{url}/", "data:", "blob:"))] == []
    assert not serious(page)  # Swagger UI's headings and landmarks are moderate findings
    for path in ("/localize", "/scenes/{scene_id}/render"):
        operation = page.locator(".opblock").filter(has=page.get_by_text(path, exact=True))
        operation.locator(".opblock-summary-control").click()
        operation.get_by_role("button", name="Try it out").click()
        operation.get_by_role("button", name="Execute").wait_for()
    assert not serious(page)
    page.get_by_role("link", name="Start page").click()
    page.get_by_role("radio").first.wait_for()


def test_a_scene_is_added_unloaded_loaded_and_deleted(page: Page, url: str, tmp_path: Path) -> None:
    file = tmp_path / "my attic.ply"
    file.write_bytes(next(write_room(tmp_path / "room").glob("*.ply")).read_bytes())
    page.set_input_files("#scenefile", file)
    expect(page.get_by_role("radio", name="my_attic")).to_be_checked()
    card = page.locator(".card").filter(has=page.get_by_role("radio", name="my_attic"))
    card.get_by_role("button", name="Unload").click()
    expect(card).to_contain_text("Unloaded")
    card.get_by_role("button", name="Load", exact=False).click()
    expect(card).to_contain_text("MB in memory")
    _audit(page)
    # The operator's own scenes can't be deleted.
    expect(page.get_by_role("button", name="Delete")).to_have_count(1)
    page.once("dialog", lambda dialog: dialog.accept())
    card.get_by_role("button", name="Delete").click()
    expect(card).to_have_count(0)
    assert HTTP.get(f"{url}/scenes/my_attic").status_code == 404


NAMES_OF_BOX = """() => {
    window.told = "";
    new MutationObserver(() => { window.told += document.querySelector(".sendbox")?.innerText ?? ""; })
        .observe(document.querySelector("#main"), { childList: true, subtree: true });
}"""
"""Keep what an upload's box says, however short it is shown."""


def test_photos_that_are_dropped_with_a_scene_are_looked_for_in_it(page: Page, url: str, tmp_path: Path) -> None:
    page.get_by_role("radio", name="Studio").check()
    scene = next(write_room(tmp_path / "room").glob("*.ply")).read_bytes()
    other = (STUDIO / "photos" / "photo_01.jpg").read_bytes()
    expect(page.locator(".drop")).to_contain_text("HEIC")
    expect(page.locator("#drophint")).to_contain_text("HEIC")
    shown = page.evaluate(
        "import('./ui/dom.js').then(({ length }) => [0.9999, 1.2, -1].map(value => length(value, null)))"
    )
    assert shown == ["1 unit", "1.2 units", "-1 units"]
    page.evaluate(NAMES_OF_BOX)
    drop_all(page, {"one.jpg": PHOTO.read_bytes(), "cellar.ply": scene, "two.jpg": other})
    rows = page.locator("tbody tr")
    assert "2 photos wait for this scene: one.jpg, two.jpg" in page.evaluate("window.told")
    for name in ("one.jpg", "two.jpg"):
        expect(rows.filter(has_text=name)).to_contain_text("cellar")
        expect(rows.filter(has_text=name).locator(".badge")).to_have_text(re.compile("not localized|uncertain"))
    # Where the scene doesn't come, its photos stay where they are.
    page.get_by_role("link", name="Localize").click()
    before = HTTP.get(f"{url}/jobs").json()["jobs"][0]["id"]
    drop_all(page, {"three.jpg": PHOTO.read_bytes(), "junk.ply": b"not a scene"})
    expect(page.get_by_role("alert")).to_contain_text("ply")
    assert HTTP.get(f"{url}/jobs").json()["jobs"][0]["id"] == before
    HTTP.delete(f"{url}/scenes/cellar")


def test_a_dropped_file_that_is_no_scene_is_refused(page: Page, url: str) -> None:
    page.get_by_role("radio").first.wait_for()
    drop(page, b"not a scene", "junk.ply")
    expect(page.get_by_role("alert")).to_contain_text("ply")
    assert HTTP.get(f"{url}/scenes/junk").status_code == 404


def test_a_job_is_run_again_and_deleted_from_the_history(page: Page, url: str) -> None:
    job = posted(url, PHOTO.read_bytes(), {"scene": "studio", "seed": 11})
    page.goto(f"{url}/#/jobs")
    row = page.locator("tbody tr").filter(has=page.locator(f"a[href='#/jobs/{job['id']}']"))
    row.get_by_role("button", name="Run again").click()
    page.locator(".verdict .badge.localized").wait_for()
    again = job_of(page, url)
    assert (again["id"] != job["id"], again["seed"]) == (True, 11)
    np.testing.assert_allclose(again["result"]["pose"]["position"], job["result"]["pose"]["position"], atol=0.05)
    page.goto(f"{url}/#/jobs")
    page.once("dialog", lambda dialog: dialog.accept())
    row.get_by_role("button", name="Delete").click()
    expect(row).to_have_count(0)
    assert HTTP.get(f"{url}/jobs/{job['id']}").status_code == 404


def test_a_pose_becomes_the_prior_of_the_next_photo(page: Page, url: str) -> None:
    job = posted(url, PHOTO.read_bytes(), {"scene": "studio"})
    page.goto(f"{url}/#/jobs/{job['id']}")
    page.get_by_role("link", name="Another photo with this pose as prior").click()
    expect(page.locator(".note:not(.readers)")).to_contain_text("a prior")
    page.set_input_files("#photo", PHOTO)
    page.locator(".verdict .badge").wait_for()
    prior = job_of(page, url)["prior"]["world_from_camera"]["matrix"]
    np.testing.assert_allclose(prior, job["result"]["pose"]["world_from_camera"]["matrix"], atol=1e-9)
    page.get_by_role("link", name="Localize").click()
    page.get_by_role("button", name="Remove").click()
    expect(page.locator(".note:not(.readers)")).to_be_hidden()


def test_a_job_that_is_not_there_is_told(page: Page, url: str) -> None:
    page.goto(f"{url}/#/jobs/nothing")
    expect(page.get_by_role("alert")).to_contain_text("job 'nothing' not found")


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_no_view_has_an_accessibility_finding(page: Page, url: str, scheme: Literal["light", "dark"]) -> None:
    page.emulate_media(color_scheme=scheme)
    page.get_by_role("radio").first.wait_for()
    page.get_by_text("Intrinsics, prior, estimator").click()
    page.get_by_label("Seed").wait_for()
    _audit(page)
    page.set_input_files("#photo", PHOTO)
    page.locator(".verdict .badge").wait_for()
    first = page.url.rpartition("/")[2]
    _audit(page)
    page.goto(f"{url}/#/jobs")
    page.locator("tbody tr").first.wait_for()
    _audit(page)
    page.goto(f"{url}/#/compare/{first}/{first}")
    page.locator(".stack").nth(1).wait_for()
    _audit(page)


def _audit(page: Page) -> None:
    page.evaluate("Promise.all(document.getAnimations().map(animation => animation.finished))")
    found = Axe().run(page)
    assert not found.violations_count, found.generate_report()


def test_the_whole_way_goes_by_keyboard(page: Page) -> None:
    page.get_by_role("radio").first.wait_for()
    focused: list[str] = []
    for _ in range(10):  # with keys there is a link to them
        page.keyboard.press("Tab")
        focused.append(
            page.evaluate(
                "document.activeElement.id || document.activeElement.name || document.activeElement.textContent"
            )
        )
    assert focused[0] == "splatfix"
    assert {"Localize", "History", "photo", "scene"} <= set(focused)
    with page.expect_file_chooser() as waited:
        page.locator("#photo").focus()
        page.keyboard.press("Enter")
    waited.value.set_files(PHOTO)
    page.locator(".badge.localized").wait_for()
    assert page.evaluate("document.activeElement.id") == "main"
    above, slider = page.locator(".stack .above"), page.get_by_role("slider")
    for _ in range(30):
        page.keyboard.press("Tab")
        if slider.evaluate("slider => slider === document.activeElement"):
            break
    page.keyboard.press("Home")
    expect(above).to_have_css("opacity", "0")


def test_a_service_with_keys_asks_for_one(browser: Browser, tmp_path: Path) -> None:
    keys, port = KeyRing(tmp_path / "keys.json"), free_port()
    key = keys.make_temporary("tester", "localize")
    with served(create_app(Settings(scenes=[], port=port, viewer=False, data_dir=tmp_path), keys=keys), port) as url:
        page = opened(browser, f"{url}/#/jobs")
        page.get_by_label("API key").fill("sfx_wrong")
        page.get_by_role("button", name="Sign in").click()
        expect(page.get_by_role("alert")).to_contain_text("not valid")
        assert "sfx_wrong" not in page.url
        _audit(page)
        page.get_by_label("API key").fill(key)
        page.get_by_label("API key").press("Enter")
        page.get_by_text("No jobs match").wait_for()  # what was asked for
        assert key not in page.url
        page.get_by_role("link", name="Localize").click()
        page.get_by_text("No scenes yet").wait_for()
        page.goto(f"{url}/?key=sfx_wrong")
        expect(page.get_by_role("alert")).to_contain_text("not valid")
        assert "sfx_wrong" not in page.url
        page.close()


def test_keys_are_made_shown_once_and_revoked_by_admins(browser: Browser, tmp_path: Path) -> None:
    file, port = tmp_path / "keys.json", free_port()
    boss, guest = add_key(file, "boss", "admin"), add_key(file, "guest", "localize")
    app = create_app(Settings(scenes=[], port=port, viewer=False, data_dir=tmp_path / "data", keys_file=file))
    with served(app, port) as url:
        page = opened(browser, f"{url}/?key={guest}")
        page.get_by_text("No scenes yet").wait_for()
        expect(page.get_by_role("link", name="Keys")).to_be_hidden()
        page.goto(f"{url}/#/keys")
        expect(page.get_by_role("alert")).to_contain_text("role is localize")
        page.close()
        page = opened(browser, f"{url}/?key={boss}")
        page.on("dialog", lambda dialog: dialog.accept())
        page.get_by_role("link", name="Keys").click()
        expect(page.get_by_role("row", name="boss")).to_contain_text("your key")
        page.get_by_role("textbox", name="Name").fill("robot 7")
        page.get_by_role("textbox", name="Scenes").fill("lab, floor-*")
        page.get_by_role("textbox", name="Rate limit").fill("600/minute")
        page.get_by_label("Share of the queue").fill("25")
        page.get_by_role("combobox", name="Ends").select_option("30")
        _audit(page)
        page.get_by_role("button", name="Make key").click()
        key = page.locator(".newkey").inner_text()
        row = page.get_by_role("row", name="robot 7")
        for told in ("lab, floor-*", "600/minute", "25 %"):
            expect(row).to_contain_text(told)
        made = next(known for known in read_keys(file) if known.name == "robot 7")
        assert abs((made.limits.expires or 0) - time.time() - 30 * 86_400) < 60
        assert HTTP.get(f"{url}/key", headers={"Authorization": f"Bearer {key}"}).json()["scenes"] == [
            "lab",
            "floor-*",
        ]
        _audit(page)
        for width in (1280, 390):
            page.set_viewport_size({"width": width, "height": 844})
            assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        # A name that is taken is told, and what was typed stays.
        page.get_by_role("textbox", name="Name").fill("guest")
        page.get_by_role("button", name="Make key").click()
        expect(page.get_by_role("alert")).to_contain_text("already exists")
        assert page.get_by_role("textbox", name="Name").input_value() == "guest"
        page.reload()
        row.wait_for()
        assert key not in page.content()
        page.get_by_role("button", name="Revoke robot 7").click()
        expect(row).to_have_count(0)
        assert {known.name for known in read_keys(file)} == {"boss", "guest"}
        page.close()


@pytest.mark.parametrize("role", ["read", "localize", "admin"])
def test_a_key_is_offered_what_it_may_do(browser: Browser, tmp_path: Path, role: Role) -> None:
    keys, port = KeyRing(tmp_path / "keys.json"), free_port()
    key = keys.make_temporary("visitor", role)
    room = write_room(tmp_path / "room")
    settings = Settings(scenes=[room], port=port, viewer=False, cache_dir=None, data_dir=tmp_path)
    with served(create_app(settings, keys=keys), port) as url:
        page = opened(browser, f"{url}/?key={key}")
        page.get_by_role("radio").wait_for()
        expect(page.get_by_text("Your key shows results")).to_be_visible(visible=role == "read")
        expect(page.get_by_text("Choose photos")).to_be_visible(visible=role != "read")
        for name in ("Unload", "Add a scene"):
            expect(page.get_by_text(name)).to_be_visible(visible=role == "admin")
        page.get_by_role("link", name="Plan and coverage").click()
        page.get_by_role("img", name="Plan of the scene").wait_for()
        expect(page.get_by_text("Measure coverage")).to_be_visible(visible=role == "admin")
        page.close()


def test_several_photos_get_a_table_that_is_exported(page: Page, url: str, tmp_path: Path) -> None:
    page.get_by_role("radio", name="Studio").check()
    photos = sorted((STUDIO / "photos").glob("*.jpg"))[:3]
    drop_all(page, {p.name: p.read_bytes() for p in photos} | {"fog.jpg": jpeg(FOG), "notes.jpg": b"not a photo"})
    expect(page.get_by_role("progressbar")).to_have_attribute("max", "5")
    expect(page.locator("tbody .badge.localized")).to_have_count(3)
    row = page.get_by_role("row").filter(has_text="notes.jpg")
    expect(row).to_contain_text("photo")  # why it was refused
    row = page.get_by_role("row").filter(has_text="fog.jpg")
    expect(row.locator("summary")).to_be_visible()
    expect(row.get_by_role("cell").nth(5)).to_have_text("–")  # no best guess as its position
    expect(page.get_by_role("status").first).to_contain_text("3 of 5 photos localized.")
    expect(page.get_by_role("progressbar")).to_be_hidden()
    expect(page.locator(".maps a")).to_have_count(3)
    expect(page.get_by_role("link", name="History")).to_have_attribute("aria-current", "page")
    expect(page.get_by_role("link", name="Plan and coverage")).to_have_attribute("href", "#/scenes/studio")
    page.set_viewport_size({"width": 1280, "height": 800})
    table = page.locator(".scroll")
    assert table.evaluate("box => box.scrollWidth <= box.clientWidth")
    assert not identifiers(page)
    expect(page.get_by_role("button", name="COLMAP: 3 localized")).to_be_enabled()
    _audit(page)
    csv, frames = _saved(page, "CSV").decode(), json.loads(_saved(page, "nerfstudio"))["frames"]
    images, cameras = _colmap_texts(_saved(page, "COLMAP"), tmp_path)
    assert len(csv.splitlines()) == 5
    lines = {values["photo"]: values for values in DictReader(io.StringIO(csv))}
    assert not any(lines["fog.jpg"][name] for name in ("x", "y", "z", "qw", "qx", "qy", "qz"))
    for photo in photos:
        values, truth = lines[photo.name], truth_of(photo)
        assert np.linalg.norm([float(values[k]) - truth[i, 3] for i, k in enumerate("xyz")]) < 0.05
        # world_from_camera, the quaternion's scalar first
        turned = rotation_from_quat(np.array([float(values[f"q{k}"]) for k in "wxyz"]))
        assert np.trace(turned.T @ truth[:3, :3]) > 1 + 2 * np.cos(0.02)
        assert max(len(values[k].lstrip("-0.").replace(".", "")) for k in ("x", "y", "z", "score")) <= 9
    posed = _image_lines(images)
    assert [line[-1] for line in posed] == [p.name for p in photos]
    assert len(cameras.splitlines()) == 4
    for photo, line, frame in zip(photos, posed, frames, strict=True):
        truth = truth_of(photo)
        there = np.array(frame["transform_matrix"])[:3, 3]
        assert np.linalg.norm(there - truth[:3, 3]) < 0.05
        quaternion, translation = np.float64(line[1:5]), np.float64(line[5:8])
        np.testing.assert_allclose(-rotation_from_quat(quaternion).T @ translation, there, atol=1e-6)
    page.get_by_label("Order").select_option("worst")
    expect(page.locator("tbody tr").first).to_contain_text("notes.jpg")
    _opened_again(page, url)
    page.get_by_label("Outcome").select_option("uncertain")
    expect(page.locator("tbody tr")).to_have_count(0)


def _image_lines(images: str) -> list[list[str]]:
    """Return the fields of an images.txt's lines with ten."""
    return [line.split() for line in images.splitlines() if not line.startswith("#") and len(line.split()) == 10]


def identifiers(page: Page) -> list[str]:
    """Return names of the API that people read on the page, opened or not; not in what is copied to programs."""
    texts = page.locator("main").evaluate(
        """main => {
            const copy = main.cloneNode(true);
            copy.querySelectorAll("pre, .photo, .verdict, option[value='']").forEach(element => element.remove());
            return copy.textContent;
        }"""
    )
    names = {name for table in TABLES.values() for name, words in table.items() if name != words.lower()}
    return [name for name in re.findall(r"[a-z]+_[a-z_]+", texts) if name in names]


def _opened_again(page: Page, url: str) -> None:
    """Load the table of four jobs anew, with the service's answers held back at first; then leave it and come back."""
    held: list[Route] = []
    page.route(f"{url}/jobs/*", lambda route: held.append(route))
    page.reload()  # the jobs and their order stand in the address
    expect(page.locator("tbody .badge.loading")).to_have_count(4)
    expect(page.get_by_role("status").first).to_have_text("Loading 4 photos…")
    expect(page.get_by_role("button", name="CSV")).to_be_disabled()
    until(lambda: page.evaluate("true") and len(held) == 4)  # all at once
    page.unroute(f"{url}/jobs/*")  # which lets them go on
    expect(page.locator("tbody .badge.localized")).to_have_count(3)
    expect(page.locator("tbody tr").first).to_contain_text("fog.jpg")
    page.locator("tbody a").first.click()
    page.locator(".verdict").wait_for()
    for here in ("Localize", "History"):
        page.get_by_role("link", name="Back to the 4 photos").or_(
            page.get_by_role("link", name="4 photos in studio")
        ).click()
        expect(page.locator("tbody tr").first).to_contain_text("fog.jpg")
        page.get_by_role("navigation").get_by_role("link", name=here).click()
    page.get_by_role("link", name="4 photos in studio").click()
    page.locator("tbody").get_by_role("link", name="viewer").first.click()
    page.get_by_role("link", name="Back to the 4 photos").click()
    expect(page.locator("tbody .badge.localized")).to_have_count(3)


def test_the_rest_of_a_batch_is_cancelled_while_its_scene_is_prepared(page: Page, url: str) -> None:
    """The service's answers are altered: its scenes are ready long since."""
    scenes = HTTP.get(f"{url}/scenes").json()
    for scene in scenes["scenes"]:
        scene["state"] = "preparing"
    job = posted(url, PHOTO.read_bytes(), {"scene": "studio"}) | {"result": None, "finished": None}
    jobs, cancelled = (
        {name: job | {"id": name, "state": state} for name, state in (("a", "running"), ("b", "queued"))},
        [],
    )

    def answer(route: Route) -> None:
        name = route.request.url.rpartition("/")[2]
        if route.request.method == "DELETE":
            cancelled.append(name)
            jobs[name] |= {"state": "cancelled"}
        route.fulfill(json=jobs[name])

    page.route(f"{url}/scenes", lambda route: route.fulfill(json=scenes))
    page.route(re.compile("/jobs/[ab]$"), answer)
    page.goto(f"{url}/#/batch/a,b")
    expect(page.locator("tbody tr").first.locator(".badge")).to_have_text("preparing the scene")
    expect(page.locator("tbody tr").last.locator(".badge")).to_have_text("queued")
    expect(page.get_by_role("status").first).to_contain_text("Preparing the scene")
    page.get_by_role("button", name="Cancel the rest").click()
    expect(page.locator("tbody .badge.cancelled")).to_have_count(2)
    assert sorted(cancelled) == ["a", "b"]


def test_a_scene_card_shows_how_far_the_view_index_is(page: Page, url: str) -> None:
    """The service's answers are altered: its scenes are small, and their indexes whole at once."""
    listed = HTTP.get(f"{url}/scenes").json()
    studio = next(scene for scene in listed["scenes"] if scene["id"] == "studio")
    studio["index"] = {"views": 256, "planned_views": 1503}
    page.route(f"{url}/scenes", lambda route: route.fulfill(json=listed))
    page.goto(f"{url}/#/")
    page.reload()
    card = page.locator(".card").filter(has_text="Studio")
    expect(card).to_contain_text("View index: 256 of 1,503 views")
    expect(card.get_by_role("progressbar", name="View index of Studio")).to_have_attribute("value", "256")
    assert not serious(page)
    # It is asked for again until it is whole.
    studio["index"]["views"] = 1503
    expect(card).not_to_contain_text("View index")
    expect(card.get_by_role("progressbar")).to_have_count(0)


def _saved(page: Page, name: str) -> bytes:
    with page.expect_download() as waited:
        page.get_by_role("button", name=name).click()
    return waited.value.path().read_bytes()


def _colmap_texts(archive: bytes, folder: Path) -> tuple[str, str]:
    """Return images.txt and cameras.txt of a model, which COLMAP itself reads, where it is installed."""
    with ZipFile(io.BytesIO(archive)) as files:
        assert files.testzip() is None  # checksums
        files.extractall(folder)
    images, cameras, points = ((folder / f"{name}.txt").read_text() for name in ("images", "cameras", "points3D"))
    assert points.splitlines()[-1] == "# Number of points: 0"
    if find_spec("pycolmap"):
        pycolmap = import_module("pycolmap")
        read = pycolmap.Reconstruction(str(folder))
        assert (read.num_images(), read.num_points3D()) == (len(_image_lines(images)), 0)
    return images, cameras


def test_the_chosen_scene_stays_chosen(page: Page, url: str) -> None:
    page.get_by_role("radio", name="room").check()
    page.goto(f"{url}/#/jobs")
    page.reload()
    page.get_by_role("link", name="Localize").click()
    expect(page.get_by_role("radio", name="room")).to_be_checked()


def test_a_photo_for_any_scene_finds_its_own(page: Page, url: str) -> None:
    page.get_by_role("radio", name="Any scene").check()
    page.set_input_files("#photo", PHOTO)
    page.locator(".badge.localized").wait_for()
    assert job_of(page, url)["scene"] == "studio"


def test_a_photo_waits_for_its_scene(page: Page, url: str) -> None:
    room = HTTP.get(f"{url}/scenes/room").json()
    loading, sent = room | {"state": "loading", "gaussians": None}, []
    page.route(f"{url}/scenes/room", lambda route: route.fulfill(json=loading))
    page.route(f"{url}/localize", lambda route: (sent.append(1), route.continue_()))
    page.get_by_role("radio", name="room").check()
    page.set_input_files("#photo", PHOTO)
    expect(page.locator(".sendbox")).to_contain_text("the scene is loading")
    assert not sent
    page.unroute(f"{url}/scenes/room")
    page.locator(".verdict .badge").wait_for()
    assert sent


def test_a_photo_for_a_scene_that_is_not_in_memory_loads_it(page: Page, url: str) -> None:
    page.get_by_role("radio", name="room").check()
    HTTP.post(f"{url}/scenes/room/unload").raise_for_status()
    until(lambda: HTTP.get(f"{url}/scenes/room").json()["state"] == "unloaded")
    page.set_input_files("#photo", PHOTO)
    expect(page.locator(".sendbox")).to_contain_text("Waiting: the scene is loading")
    page.wait_for_url("**/#/jobs/*", timeout=2 * PATIENCE_MS)
    assert job_of(page, url)["scene"] == "room"
    # For the tests after this one; asked more than once, since a front that didn't get the photo hasn't loaded it.
    until(lambda: all(HTTP.post(f"{url}/scenes/room/load").json()["state"] == "ready" for _ in range(4)), 200)


def test_a_job_without_a_step_says_whether_it_waits_or_runs(page: Page, url: str) -> None:
    job = posted(url, PHOTO.read_bytes(), {"scene": "studio"}) | {"result": None, "finished": None}
    states = ["queued"]
    page.route(f"{url}/jobs/{job['id']}", lambda route: route.fulfill(json=job | {"state": states[-1]}))
    page.route(f"{url}/jobs/{job['id']}/events", lambda route: None)  # no answer
    page.goto(f"{url}/#/jobs/{job['id']}")
    line = page.locator(".line")
    expect(line).to_have_text("Queued")
    states.append("running")
    expect(line).to_have_text("Running")
    page.unroute_all(behavior="ignoreErrors")


def test_an_upload_tells_the_share_that_is_sent(page: Page) -> None:
    """Of the module that applications load, too; the service refuses what it gets."""
    told = page.evaluate(
        """async () => {
            const { Client } = await import("./client.js"), shares = [];
            const file = new File([new Uint8Array(2e7)], "junk.txt"), onProgress = share => shares.push(share);
            const code = await new Client().uploadScene("junk", file, { onProgress }).catch(error => error.code);
            return { shares, code };
        }"""
    )
    assert told["code"] == "invalid_request"
    assert told["shares"] == sorted(told["shares"])
    assert 0 < told["shares"][0] <= told["shares"][-1] == 1


def test_a_sequences_photo_is_the_one_of_the_shown_pose(page: Page, url: str) -> None:
    """While the job runs the same address has its first photo."""
    job = posted(url, PHOTO.read_bytes(), {"scene": "studio"})
    page.goto(f"{url}/#/jobs/{job['id']}")
    shown = page.locator(".stack .below").get_attribute("src") or ""
    assert shown != job["links"]["photo"]
    assert HTTP.get(f"{url}{shown}").status_code == 200


@pytest.mark.parametrize("nginx", [False, True], ids=["direct", "nginx"])
@pytest.mark.parametrize("keys", [True, False], ids=["keys", "open"])
def test_a_page_and_a_viewer_live_on_after_a_restart(
    browser: Browser, tmp_path: Path, scene_cache: Path, keys: bool, nginx: bool
) -> None:
    port, room = free_port(), write_room(tmp_path / "room")
    key = add_key(tmp_path / "keys.json", "tester", "localize") if keys else ""
    chosen = Settings(
        scenes=[room],
        port=port,
        cache_dir=scene_cache,
        data_dir=tmp_path / "data",
        keys_file=tmp_path / "keys.json",
        shutdown_s=0,
    )
    front = behind_nginx([port], tmp_path / "nginx") if nginx else nullcontext(f"http://127.0.0.1:{port}")
    with front as url:
        _restarted(browser, chosen, url, key)


def _restarted(browser: Browser, settings: Settings, url: str, key: str) -> None:
    """Open a page and a viewer of a job that runs, end the service, and start it again. Without a key it needs none."""
    port = settings.port
    slow = {"estimator": "mc_do", "options": json.dumps({"hypotheses": 4096, "refinement_steps": 10000})}
    with served(create_app(settings), port):
        until(lambda: is_ready(url), 240)
        share_key(url, port)
        context = browser.new_context(viewport={"width": 1000, "height": 700})
        sign_in(context, url)
        page, viewer = context.new_page(), context.new_page()
        page.bring_to_front()
        page.goto(f"{url}/#/key" if key else f"{url}/")
        if key:
            page.get_by_label("API key").fill(key)
            page.get_by_label("API key").press("Enter")
        page.get_by_role("radio").wait_for()
        asked: dict = {"files": {"photo": PHOTO.read_bytes()}}
        asked |= {"headers": {"Authorization": f"Bearer {key}"}} if key else {}
        job = HTTP.post(f"{url}/localize", data=slow, timeout=90, **asked).json()
        opened_s = _opened(page, viewer, url, job["id"])
        viewer.evaluate("window.old = true")
    lost = page.get_by_role("alert")
    expect(lost).to_contain_text("Reconnecting")
    viewer.bring_to_front()
    expect(viewer.locator(".splatfix-lost")).to_contain_text("Reconnecting")
    with served(create_app(settings), port):
        until(lambda: is_ready(url), 240)
        ready = time.monotonic()
        viewer.wait_for_function("!window.old", timeout=PATIENCE_MS)
        expect(viewer.locator(".splatfix-lost")).to_have_count(0)
        viewer.get_by_text("running", exact=True).wait_for(timeout=PATIENCE_MS)
        page.bring_to_front()
        expect(lost).to_be_hidden()
        expect(page.locator(".line")).to_contain_text("step ")
        took_s = time.monotonic() - ready
        stages = page.locator(".stages li").all_inner_texts()
        assert len(stages) == len(set(stages))
        # Machines that draw slowly need longer to open both at all, and a page looks for the service once a second.
        assert took_s < 5 or took_s < 1 + max(opened_s, _opened(page, viewer, url, job["id"]))
        page.bring_to_front()
        page.get_by_role("button", name="Cancel").click()
        page.locator(".badge.cancelled").wait_for()
        context.close()


def _opened(page: Page, viewer: Page, url: str, job_id: str) -> float:
    """Seconds until a page and a viewer show a job that runs."""
    began = time.monotonic()
    for tab, address in ((page, f"{url}/#/jobs/{job_id}"), (viewer, f"{url}/viewer/jobs/{job_id}/")):
        tab.goto("about:blank")
        tab.bring_to_front()
        tab.goto(address)
        if tab is page:
            expect(page.locator(".line")).to_contain_text("step ")
    viewer.get_by_text("running", exact=True).wait_for(timeout=PATIENCE_MS)
    return time.monotonic() - began


def test_no_view_is_wider_than_a_phone(browser: Browser, url: str) -> None:
    context = browser.new_context(viewport={"width": 360, "height": 740}, has_touch=True, is_mobile=True)
    sign_in(context, url)
    page = context.new_page()
    page.set_default_timeout(PATIENCE_MS)
    page.goto(f"{url}/")
    page.get_by_role("radio").first.wait_for()
    expect(page.get_by_label("Take a photo")).to_have_attribute("capture", "environment")
    page.get_by_text("Intrinsics, prior, estimator").click()
    page.get_by_label("Seed").wait_for()
    assert _overflow(page) <= 0
    page.set_input_files("#photo", PHOTO)
    page.locator(".verdict .badge").wait_for()
    assert _overflow(page) <= 0
    page.goto(f"{url}/#/jobs")
    page.locator("tbody tr").first.wait_for()
    assert _overflow(page) <= 0
    context.close()


def _overflow(page: Page) -> int:
    return page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth")


def test_a_scenes_coverage_is_measured_and_drawn(browser: Browser, url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a map that is known: one of two places is found in all directions, the other in none. The map's plan is
    turned by 180 degrees against that of the scene's cameras."""
    go_on = threading.Event()

    def measured(loaded: LoadedScene, how: Measurement) -> CoverageMap:
        assert how.progress
        assert how.partial
        how.partial(mapped(loaded, trials[:3]))
        how.progress(3, 10)
        while not go_on.wait(0.05):
            if how.cancel.is_set():
                raise Cancelled
        return mapped(loaded, trials * 9)

    def mapped(loaded: LoadedScene, trials: list[Trial]) -> CoverageMap:
        places = np.array([[0.0, 0.0, 0.0], [20.0, 0.0, 0.0]])
        shape = np.ones((2, 4), bool)
        return CoverageMap(
            loaded.scene.info.sha256, np.diag([-1.0, -1, 1]), 0.5, places, np.arange(4) * np.pi / 2, shape, shape * 0.1,
            tuple(trials), (), Calibration(), 1.0,
        )  # fmt: skip

    def hold(route: Route) -> None:
        held.append(route)

    held: list[Route] = []
    cameras = [(x, level_at(x, 90 * k)) for k in range(4) for x in (0, 20)]
    trials = [Trial(pose, Status.LOCALIZED, x == 0, 0.1, 0.01, 0.1) for x, pose in cameras]
    monkeypatch.setattr("service.scene_manager.scene_coverage.measured_coverage", measured)
    for scheme in ("light", "dark"):
        page = browser.new_page(viewport={"width": 390, "height": 844}, color_scheme=scheme)  # type: ignore[arg-type]
        page.set_default_timeout(PATIENCE_MS)
        page.goto(f"{url}/")
        if scheme == "light":
            page.route("**/anchors", hold)
        page.get_by_role("link", name="Plan and coverage of room").click()
        if scheme == "light":
            expect(page.get_by_text("Not measured yet")).to_be_visible()
            # The page is drawn again between press and release, when jobs and anchors come.
            expect(page.locator("image.ground")).to_be_attached()
            page.locator("svg.plan").evaluate("svg => { svg.dataset.first = ''; }")
            page.get_by_role("button", name="Measure coverage").hover()
            page.mouse.down()
            page.wait_for_timeout(100)
            held[0].continue_()
            expect(page.locator("svg.plan[data-first]")).to_have_count(0)
            page.mouse.up()
            expect(page.get_by_text("3 of 10 test renders")).to_contain_text("s left")
            # Two renders at x = 0, one at 20, which is to the left: the plan is turned.
            expect(page.locator("circle.tried.found")).to_have_count(2)
            places = [page.locator(f"circle.tried.{kind}").first.get_attribute("cx") for kind in ("found", "missed")]
            assert float(places[0] or 0) > float(places[1] or 0)
            expect(page.get_by_role("list", name="Legend")).to_contain_text("tried: not found")
            _audit(page)
            page.get_by_role("button", name="Cancel").click()
            page.get_by_role("button", name="Measure coverage").click()
            expect(page.get_by_text("3 of 10 test renders")).to_be_visible()
            go_on.set()
        expect(page.get_by_text("upper bound: not calibrated")).to_be_visible()
        assert page.locator("path.cell").count() == 8
        assert page.locator("path.cell.sure").count() == page.locator("path.cell.rare").count() == 4
        places = [box_of(page, kind)["x"] for kind in ("sure", "rare")]
        assert places[0] > places[1]
        expect(page.locator("image.ground")).to_have_attribute("href", re.compile("^data:image/png"))
        assert page.locator("line.camera").count() == 24
        legend = page.get_by_role("list", name="Legend")
        for kind, drawn in (("sure", 1), ("rare", 1), ("usual", 0), ("blind", 0), ("camera", 1), ("anchor", 0)):
            expect(legend.locator(f".swatch.{kind}")).to_have_count(drawn)
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        _audit(page)
        page.close()


def level_at(x: float, degrees: float) -> Pose:
    """A level camera at (x, 0, 0) with a heading."""
    angle = np.radians(degrees)
    at = np.array([x, 0.0, 0.0])
    axis = np.array([np.cos(angle), np.sin(angle), 0.0])
    return look_at(at, at + axis, np.array([0.0, 0.0, 1.0]))


def box_of(page: Page, kind: str) -> dict:
    cell = page.locator(f"path.cell.{kind}").first
    for _ in range(100):  # the plan is drawn anew now and then, and what is replaced has no box
        if box := cell.bounding_box():
            return dict(box)
        page.wait_for_timeout(50)
    raise AssertionError(f"no {kind} cell is drawn")


def test_a_picked_point_is_named_shown_and_deleted(browser: Browser, url: str) -> None:
    page = opened(browser, f"{url}/#/scenes/room?point=0.5,-0.25,1", 390, 844)
    page.get_by_label("Name of the picked point").fill("lamp")
    _audit(page)
    page.get_by_role("button", name="Save").click()
    expect(page.locator(".anchors li")).to_contain_text("lamp 0.5, -0.25, 1")
    expect(page.locator("svg.plan text").filter(has_text="lamp")).to_have_count(1)
    expect(page.get_by_label("Name of the picked point")).to_have_count(0)
    kept = HTTP.get(f"{url}/scenes/room/anchors").json()
    assert kept == {"anchors": [{"name": "lamp", "position": [0.5, -0.25, 1.0]}]}
    assert _overflow(page) <= 0
    page.get_by_role("button", name="Delete lamp").click()
    expect(page.locator(".anchors li")).to_have_count(0)
    assert HTTP.get(f"{url}/scenes/room/anchors").json() == {"anchors": []}
    page.close()


LOADED = "[...document.images].every(image => image.complete && image.naturalWidth > 0)"


def test_a_scene_is_registered_by_anchors_and_that_undone(browser: Browser, url: str) -> None:
    """With a length of 3 m between points that are 2 units apart; the same API takes coordinates and a floor."""
    places = {"left": [0, 0, 0], "right": [2, 0, 0], "far": [0, 2, 0]}
    for name, position in places.items():
        HTTP.put(f"{url}/scenes/room/anchors/{name}", json={"position": position}).raise_for_status()
    page = opened(browser, f"{url}/#/scenes/room")
    page.get_by_text("Not registered").wait_for()
    page.get_by_text("Register by anchors").click()
    page.get_by_label("Coordinates of left").fill("here")
    page.get_by_role("button", name="Register").click()
    expect(page.get_by_role("alert")).to_contain_text("coordinates of left must be three numbers")
    page.get_by_label("Coordinates of left").fill("")
    page.get_by_role("button", name="Add a length").click()
    page.get_by_label("From", exact=True).select_option("left")
    page.get_by_label("To", exact=True).select_option("right")
    page.get_by_label("Length in metres").fill("3")
    _audit(page)
    page.get_by_role("button", name="Register").click()
    expect(page.get_by_text("Metres per unit")).to_be_visible()
    found = HTTP.get(f"{url}/scenes/room/registration").json()
    assert found["metres_per_unit"] == pytest.approx(1.5)
    page.get_by_role("button", name="Undo registration").click()
    page.get_by_text("Not registered").wait_for()
    for name in places:
        HTTP.delete(f"{url}/scenes/room/anchors/{name}")
    page.close()


def test_a_job_is_shared_by_a_link(browser: Browser, page: Page, url: str) -> None:
    page.set_input_files("#photo", PHOTO)
    page.locator(".verdict .badge").wait_for()
    page.get_by_role("button", name="Share link").click()
    link = page.locator(".curl a")
    expect(link).to_contain_text(f"{url}/shared/")
    _audit(page)
    address = link.inner_text()
    for scheme in ("light", "dark"):
        stranger = browser.new_context(viewport={"width": 390, "height": 844}, color_scheme=scheme)  # type: ignore[arg-type]
        shared = stranger.new_page()
        shared.set_default_timeout(PATIENCE_MS)
        shared.goto(address)
        expect(shared.locator(".badge.localized")).to_be_visible()
        expect(shared.locator(".stack img")).to_have_count(2)
        expect(shared.get_by_label("Step", exact=True)).to_be_visible()
        until(lambda shared=shared: shared.evaluate(LOADED))
        assert _overflow(shared) <= 0
        _audit(shared)
        stranger.close()
    page.goto(f"{url}/shared/nothing")
    expect(page.get_by_role("alert")).to_contain_text("the link is not valid")
