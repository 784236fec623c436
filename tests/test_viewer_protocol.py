"""The viewer as a browser meets it: real sessions on a real viser server, spoken to over its socket."""

from __future__ import annotations

import base64
import gc
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import fake_service
import httpx
import numpy as np
import pytest
import viser
import zstandard
from fake_browser import CAMERA, FakeBrowser
from fake_service import EXACT_RGB, FakeService, records, render_rgb, threads, until

from service.client import Client, ServiceError
from service.geometry import transformed
from service.results import Reason, Status
from service.types import IntrinsicsCorrection
from viewer import camera_views, job_display, step_display, viewer_server, viser_internals
from viewer import comparison_images as images
from viewer.job_stream import JobStream
from viewer.replay import replay_html
from viewer.requested_page import requested_page
from viewer.scene_cache import SceneCache
from viewer.shared_data import SharedData
from viewer.viewer_server import Viewer

LAST_NODES = {"/splats/splats", "/candidates/cloud", "/match vectors/points"}
"""What is drawn of a job when nothing else waits."""


@pytest.fixture
def fake() -> FakeService:
    return FakeService()


@pytest.fixture
def viewer(fake: FakeService) -> Iterator[Viewer]:
    viewer = Viewer(lambda _: Client("http://fake", transport=fake.transport), "127.0.0.1", 0)
    yield viewer
    viewer.stop()


def _shared(viewer: Viewer) -> SharedData:
    """What the browsers without a token share."""
    return viewer._shared._taken[""][0]


def _browser(viewer: Viewer, path: str = "/") -> FakeBrowser:
    return FakeBrowser(viewer.server.get_port(), path)


def test_a_finished_job_is_shown_by_its_address(fake: FakeService, viewer: Viewer) -> None:
    fake.job("old", 4, finished=True)
    fake.job("new", 2)
    with _browser(viewer, "/jobs/old") as browser:
        browser.wait(lambda: "localized" in browser.text() and browser.widget("step")["max"] == 3, "the answer")
        browser.wait(lambda: "without view-dependent colour" in browser.text(), "the scene's line")
        assert "300 splats" in browser.text()
        names = (
            {"/splats/splats", "/training cameras/cameras"}
            | {f"/trajectory/{n}" for n in ("path", "steps", "initial", "current", "final")}
            | {"/candidates/candidates", "/candidates/cloud", "/match vectors/vectors", "/match vectors/points"}
        )
        browser.wait(lambda: names <= set(browser.nodes), "the nodes")
        assert browser.nodes["/trajectory/final"]["props"]["color"] == [60, 180, 90]
        assert browser.nodes["/trajectory/current"]["props"]["_image_data"]
        assert not browser.nodes["/trajectory/initial"]["props"]["_image_data"]
        assert browser.widget("follow newest job")["value"] is False
        browser.wait(lambda: "old" in browser.widget("job")["value"], "the job's line in the list")


def test_a_job_that_is_not_listed_any_more_is_named(fake: FakeService, viewer: Viewer) -> None:
    fake.job("oldest", 2, finished=True)
    for number in range(60):  # 50 are listed
        fake.job(f"job{number}", 1, finished=True)
    fake.listed = 50
    with _browser(viewer, "/jobs/oldest?zone=Nowhere/Land") as browser:
        browser.wait(lambda: len(browser.widget("job")["options"]) == 51, "the list")
        browser.wait(lambda: "oldest" in browser.widget("job")["value"], "the job's line in the list")
        browser.set("job", browser.widget("job")["options"][1])
        browser.wait(lambda: "job59" in browser.widget("job")["value"], "the newest job")


def test_a_job_is_shown_when_its_scene_is_loaded(fake: FakeService, viewer: Viewer) -> None:
    fake.job("one", 2, finished=True)
    fake.scenes, fake.unloaded = [], True
    with _browser(viewer, "/jobs/one") as browser:
        browser.wait(lambda: "HTTP 503" in browser.text() or "loading" in browser.text(), "the reason")
        fake.scenes, fake.unloaded = ["ball"], False
        browser.wait(lambda: "localized" in browser.text() and "/trajectory/final" in browser.nodes, "the job")


def test_without_a_job_the_scene_is_shown_and_the_first_job_is_followed(fake: FakeService, viewer: Viewer) -> None:
    with _browser(viewer) as browser:
        browser.wait(lambda: "/splats/splats" in browser.nodes and "no job" in browser.text(), "the empty scene")
        job = fake.job("first", 1)
        browser.wait(lambda: "/trajectory/current" in browser.nodes, "the new job")
        assert "running" in browser.text()
        assert "/trajectory/final" not in browser.nodes
        for record in records(6)[1:]:
            job.add(record)
        browser.wait(lambda: browser.widget("step")["value"] == 5, "the newest step")
        job.finish(Status.NOT_LOCALIZED, Reason.FEW_FEATURES)
        browser.wait(lambda: "Almost no texture" in browser.text() and "sharper" in browser.text(), "reason and hint")
        browser.wait(lambda: "/trajectory/final" in browser.nodes, "the final camera")
        fake.job("second", 2, finished=True)
        browser.wait(lambda: "second" in browser.widget("job")["value"], "the next job, by itself")
        browser.wait(lambda: browser.widget("step")["max"] == 1, "its steps")


def test_cameras_that_one_looks_through_are_cut_away_and_the_scene_is_not(fake: FakeService, viewer: Viewer) -> None:
    """The planes between which a browser draws, against the fake scene: cameras on a circle, a ball inside."""
    fake.job("j", 3, finished=True)
    with _browser(viewer, "/jobs/j") as browser:
        browser.wait(lambda: {"/training cameras/cameras", "/trajectory/final"} <= set(browser.nodes), "the cameras")
        said = {m["type"]: m for frame in browser.frames for m in frame if m["type"].startswith("SetCamera")}
        near, far = said["SetCameraNearMessage"]["near"], said["SetCameraFarMessage"]["far"]
        final = browser.nodes["/trajectory/final"]["props"]
    # viser draws a pyramid with the volume of one of the base `scale` squared and the height `scale`.
    half_height = np.tan(final["fov"] / 2)
    depth = final["scale"] / np.cbrt(half_height**2 * final["aspect"] / 3)
    assert depth < near
    everything = fake_service.scene()
    for named in everything.cameras:
        seen = transformed(named.camera.pose.camera_from_world, everything.means)[:, 2]
        assert near < 0.25 * seen.min()
        assert far > 100 * seen.max()  # backgrounds are far away


def _render_shown(browser: FakeBrowser) -> np.ndarray | None:
    """The colour of the render in the picture: low and to the right, where the fake matches have no lines."""
    image = next(w for w in browser.widgets.values() if w["type"] == "GuiImageMessage")
    if image["_data"] is None:
        return None
    picture = images.decode(bytes(image["_data"]))
    return picture[int(0.95 * picture.shape[0]), int(0.93 * picture.shape[1])].astype(int)


def test_steps_change_picture_pose_and_numbers(fake: FakeService, viewer: Viewer) -> None:
    fake.job("j", 5, finished=True)
    with _browser(viewer, "/jobs/j") as browser:

        def shows(rgb: tuple[int, int, int]) -> bool:
            shown = _render_shown(browser)
            return shown is not None and bool(np.abs(shown - rgb).max() < 6)  # two rounds of JPEG: 3 seen

        browser.wait(lambda: shows(render_rgb(4, matched=True)), "the last picture")
        for label, value, index in (("step", 1, 1), ("", "next ▶", 2), ("", "◀ previous", 1), ("step", 0, 0)):
            browser.set(label, value)
            browser.wait(lambda k=index: f">{100 + k}<" in browser.text(), f"the numbers of step {index}")
            browser.wait(lambda k=index: shows(render_rgb(k, matched=True)), f"the picture of step {index}")
            assert browser.widget("step")["value"] == index
            there = records(5)[index].pose.position_in_world
            browser.wait(
                lambda there=there: np.allclose(browser.nodes["/trajectory/current"]["position"], there, atol=1e-6),
                "the camera",
            )
        browser.set("match lines", False)
        browser.wait(lambda: shows(render_rgb(0, matched=False)), "the render at the pose")
        browser.set("compare", "difference")
        browser.wait(lambda: "doubled" in browser.text(), "the difference")
        browser.set("compare", "checker")
        browser.wait(lambda: "alternating tiles" in browser.text(), "the checkerboard")
        browser.set("compare", "flicker")
        browser.wait(lambda: browser.text().count("data:image/jpeg") == 2, "both pictures in turn")
        assert browser.widget("match lines")["visible"] is False
        browser.set("compare", "blend")
        browser.wait(lambda: browser.widget("render opacity")["visible"], "the blend")
        browser.set("render opacity", 1.0)
        browser.wait(lambda: shows(render_rgb(0, matched=False)), "nothing but the render")
        browser.set("render opacity", 0.0)
        browser.wait(lambda: shows((120, 160, 200)), "nothing but the photo")


def test_layers_can_be_hidden_and_stay_hidden(fake: FakeService, viewer: Viewer) -> None:
    job = fake.job("j", 2)
    with _browser(viewer, "/jobs/j") as browser:
        browser.wait(lambda: "/trajectory/current" in browser.nodes, "the job")
        (client,) = viewer.server.get_clients().values()
        shown = lambda: {n: h.visible for n, h in client.scene._handle_from_node_name.items()}  # noqa: E731
        browser.set("full-quality render when still", False)  # it would hide the splats
        browser.set("trajectory", False)
        browser.set("training cameras", False)
        browser.wait(lambda: not shown()["/trajectory/current"] and not shown()["/training cameras/cameras"], "hiding")
        job.add(records(3)[2])
        browser.wait(lambda: browser.widget("step")["value"] == 2, "the next record")
        browser.wait(lambda: not any(v for n, v in shown().items() if n.startswith("/trajectory/")), "still hidden")
        browser.wait(lambda: shown()["/splats/splats"], "the splats")


def test_nothing_grows_however_long_a_job_is(fake: FakeService, viewer: Viewer) -> None:
    job = fake.job("long", 5)
    with _browser(viewer, "/jobs/long") as browser:
        browser.wait(lambda: browser.widget("step")["max"] == 4 and "agree" in browser.text(), "the start")
        (client,) = viewer.server.get_clients().values()
        count = lambda: (len(client.scene._handle_from_node_name), len(browser.widgets))  # noqa: E731
        browser.wait(lambda: set(browser.nodes) >= LAST_NODES, "the 3D")
        until(lambda: _nothing_more_comes(browser), "the end of the start")
        before = count()
        for record in records(80)[5:]:
            job.add(record)
        browser.wait(lambda: browser.widget("step")["value"] == 79 and ">179<" in browser.text(), "80 steps")
        until(lambda: _nothing_more_comes(browser), "the end of the last step")
        assert count() == before


def test_browsers_do_not_disturb_one_another_and_leave_nothing(fake: FakeService, viewer: Viewer) -> None:
    fake.job("one", 3)
    fake.job("two", 6)
    names = ("job-one", "job-two", "browser-0", "browser-1")
    with _browser(viewer, "/jobs/one") as first, _browser(viewer, "/jobs/two") as second:
        first.wait(lambda: first.widget("step")["value"] == 2 and "agree" in first.text(), "the first job")
        second.wait(lambda: second.widget("step")["value"] == 5 and "agree" in second.text(), "the second job")
        second.set("step", 1)
        second.wait(lambda: ">101<" in second.text(), "the second browser's step")
        assert first.widget("step")["value"] == 2
        assert all(threads(name) for name in names)
    until(lambda: not any(threads(name) for name in names), "the end of all threads")
    assert not viewer._sessions
    until(lambda: len(viewer._shared) == 0, "the end of what its browsers shared")


def test_what_a_browser_showed_is_freed_when_another_one_leaves(fake: FakeService, viewer: Viewer) -> None:
    """Widgets form cycles, which Python by itself collects some time."""
    fake.job("j", 2)
    left: list[weakref.ref] = []
    gc.disable()
    try:
        for number in range(8):  # while the next one leaves, a thread may still hold the first one's
            with _browser(viewer, "/jobs/j") as browser:
                browser.wait(lambda: "agree" in browser.text(), "the job")
                left.extend(weakref.ref(session) for session, _ in viewer._sessions.values())
            until(lambda name=f"browser-{number}": not viewer._sessions and not threads(name), "the end")
            if len(left) > 1 and left[0]() is None:
                break
        assert left[0]() is None
    finally:
        gc.enable()


def test_a_chosen_job_is_kept_when_another_one_comes(fake: FakeService, viewer: Viewer) -> None:
    fake.job("aaa", 2, finished=True)
    fake.job("bbb", 3, finished=True)
    with _browser(viewer) as browser:
        browser.wait(
            lambda: "bbb" in browser.widget("job")["value"] and browser.widget("step")["max"] == 2, "the newest"
        )
        label = next(o for o in browser.widget("job")["options"] if "aaa" in o)
        browser.set("job", label)
        browser.wait(lambda: browser.widget("step")["max"] == 1, "the chosen job")
        assert browser.widget("follow newest job")["value"] is False
        fake.job("ccc", 5)
        browser.wait(lambda: any("ccc" in o for o in browser.widget("job")["options"]), "the new job in the list")
        assert browser.widget("job")["value"] == label
        browser.set("follow newest job", True)
        browser.wait(lambda: browser.widget("step")["max"] == 4, "the newest job again")


def test_buttons_move_the_camera(fake: FakeService, viewer: Viewer) -> None:
    fake.job("j", 3, finished=True)
    with _browser(viewer, "/jobs/j") as browser:
        browser.wait(lambda: browser.widget("step")["value"] == 2 and "15 agree" in browser.text(), "the job")
        assert not browser.widget("look through this camera")["disabled"]
        browser.set("step", 1)
        browser.wait(lambda: ">101<" in browser.text(), "step 1")
        (client,) = viewer.server.get_clients().values()
        browser.set("look through this camera", True)
        there = records(3)[1].pose.position_in_world
        browser.wait(lambda: np.allclose(client.camera.position, there, atol=1e-6), "looking through")
        browser.set("fly to result", True)
        ball = _shared(viewer).scenes.get("ball")
        goal = camera_views.view_from_behind(records(3)[-1].pose, ball.extent, ball.splats.centres)
        # viser leaves out changes below 1e-5 of the value.
        browser.wait(lambda: np.allclose(client.camera.position, goal.position, atol=1e-4), "arrival")
        browser.wait(lambda: np.allclose(client.camera.look_at, goal.look_at, atol=1e-4), "looking there")


def test_a_job_is_looked_at_where_it_is_however_long_its_scene_takes(
    fake: FakeService, viewer: Viewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(job_display, "FOLLOW_AFTER_OPEN_S", 0.0)
    job = fake.job("j")
    fake.loading_s = 0.5
    with _browser(viewer, "/jobs/j") as browser:
        until(lambda: "/scenes/ball/splats" in fake.asked, "the scene is being loaded")
        for record in records(3):
            job.add(record)
        job.finish()
        browser.wait(lambda: browser.widget("step")["value"] == 2 and "15 agree" in browser.text(), "the last step")
        (client,) = viewer.server.get_clients().values()
        ball = _shared(viewer).scenes.get("ball")
        there = camera_views.view_from_behind(records(3)[-1].pose, ball.extent, ball.splats.centres).position
        assert np.allclose(client.camera.position, there, atol=1e-4)


def _click(browser: FakeBrowser, origin: np.ndarray, direction: np.ndarray) -> None:
    browser.send(
        type="ScenePointerMessage",
        event_type="click",
        ray_origin=list(map(float, origin)),
        ray_direction=list(map(float, direction)),
        screen_pos=[[0.5, 0.5]],
        modifier=None,
    )


def test_a_camera_is_drawn_with_the_lens_that_its_step_found(fake: FakeService, viewer: Viewer) -> None:
    job = fake.job("j", 1)
    job.add(replace(records(2)[1], correction=IntrinsicsCorrection(focal_factor=2.0)))
    job.finish()
    with _browser(viewer, "/jobs/j") as browser:
        browser.wait(lambda: browser.widget("step")["value"] == 1 and "agree" in browser.text(), "the last step")
        for index, focal in ((0, 80.0), (1, 160.0)):
            browser.set("step", index)
            seen = 2 * np.arctan(32 / focal)
            browser.wait(lambda seen=seen: _fov(browser) == pytest.approx(seen), f"step {index}")
        browser.set("look through this camera", True)
        (client,) = viewer.server.get_clients().values()
        fitted = 2 * np.arctan(48 / 160 / (800 / 600))  # the photo is wider than the browser: its width fits
        browser.wait(lambda: client.camera.fov == pytest.approx(fitted), "its view")


def _fov(browser: FakeBrowser) -> float | None:
    node = browser.nodes.get("/trajectory/current")
    return node and node["props"]["fov"]


def test_a_click_on_a_frustum_jumps_there(fake: FakeService, viewer: Viewer) -> None:
    fake.job("j", 5, finished=True)
    with _browser(viewer, "/jobs/j") as browser:
        browser.wait(lambda: browser.widget("step")["value"] == 4 and "agree" in browser.text(), "the last step")
        pose = records(5)[0].pose
        _click(browser, pose.position_in_world - 2 * pose.axis_in_world, pose.axis_in_world)
        browser.wait(lambda: browser.widget("step")["value"] == 0, "the clicked step")
        (client,) = viewer.server.get_clients().values()
        browser.set("trajectory", False)
        camera = fake.scene.cameras[6].camera.pose
        _click(browser, camera.position_in_world - camera.axis_in_world, camera.axis_in_world)
        there = camera.position_in_world
        browser.wait(lambda: np.allclose(client.camera.position, there, atol=1e-6), "the clicked training camera")


def test_the_photo_lies_over_the_view_through_its_camera_only(fake: FakeService, viewer: Viewer) -> None:
    fake.job("j", 3, finished=True)
    shown = lambda: images.decode(bytes(browser.background["rgb_data"])).astype(float)  # noqa: E731
    middle = lambda: shown()[200:400, 300:500].reshape(-1, 3)  # noqa: E731
    is_colour = lambda rgb: len(middle()) > 0 and np.abs(middle().mean(0) - rgb).max() < 4  # noqa: E731
    with _browser(viewer, "/jobs/j") as browser:
        browser.wait(lambda: _background(browser) == "exact", "the view from behind")
        assert not browser.widget("photo opacity")["visible"]
        browser.set("look through this camera", True)
        browser.wait(lambda: browser.widget("photo opacity")["visible"] and is_colour((150, 110, 180)), "both, half")
        # The photo's own aspect, 3:2 in a view of 4:3: above and below it there is the render alone.
        assert np.abs(shown()[:20].mean((0, 1)) - EXACT_RGB).max() < 4
        browser.set("photo opacity", 1.0)
        browser.wait(lambda: is_colour((120, 160, 200)), "the photo alone")
        browser.send(**CAMERA)
        browser.wait(lambda: is_colour(EXACT_RGB), "another view")


def test_two_clicks_measure_a_distance_and_a_view_becomes_a_prior(fake: FakeService, viewer: Viewer) -> None:
    fake.job("j", 2, finished=True)
    with _browser(viewer, "/jobs/j") as browser:
        browser.wait(lambda: "/splats/splats" in browser.nodes, "the scene")
        centres = _shared(viewer).scenes.get("ball").splats.centres[:2].astype(float)
        browser.set("measure distances", True)
        browser.set("axes and scale", True)
        for centre in centres:
            _click(browser, centre + np.array([0, 0, 1e-3]), np.array([0, 0, -1.0]))
        browser.wait(lambda: "/measured distance/length" in browser.nodes, "a distance")
        told = browser.nodes["/measured distance/length"]["props"]["text"]
        assert re.fullmatch(r"[\d.]+ units", told)
        browser.wait(lambda: browser.nodes["/axes and scale/up"], "the axes")
        browser.set("use this view as prior", True)
        browser.wait(lambda: "scene=ball" in browser.text(), "a link")
        assert "data-splatfix='./#/?prior=" in browser.text()


def test_matches_can_be_coloured_by_residual_and_are_carried_on(fake: FakeService, viewer: Viewer) -> None:
    job = fake.job("j", 2)
    job.add(replace(records(3)[2], matches=None))
    job.finish()
    with _browser(viewer, "/jobs/j") as browser:
        browser.wait(lambda: "with the matches of step 1" in browser.text(), "matches at a step that has none")
        browser.set("colour matches by", "residual")
        browser.wait(lambda: "off by" in browser.text() and "median" in browser.text(), "residuals")
        browser.wait(lambda: "between two, on average" in browser.text(), "the angles")
        assert "lengths:" in browser.text()


def test_errors_are_shown_where_the_truth_is_known(fake: FakeService, viewer: Viewer) -> None:
    job = fake.job("j", 3)
    job.truth = records(3)[2].pose
    job.finish()
    with _browser(viewer, "/jobs/j") as browser:
        browser.wait(lambda: "position error" in browser.text(), "the curve")
        browser.wait(lambda: "/trajectory/truth" in browser.nodes, "the true camera")
        browser.wait(lambda: "rotation error" in browser.text(), "the numbers")


def test_without_the_photo_the_render_is_shown(fake: FakeService, viewer: Viewer) -> None:
    fake.photos_kept = False
    fake.job("j", 3, finished=True)
    with _browser(viewer, "/jobs/j") as browser:
        browser.wait(lambda: "photo was deleted" in browser.text(), "the message")
        image = next(w for w in browser.widgets.values() if w["type"] == "GuiImageMessage")
        shown = images.decode(bytes(image["_data"])).mean((0, 1))
        assert np.abs(shown - render_rgb(2, matched=False)).max() < 6
        assert "verified" in browser.text()
        browser.wait(lambda: "between two, on average" in browser.text(), "the angles")


def test_the_view_at_rest_is_rendered_by_the_service(fake: FakeService, viewer: Viewer) -> None:
    with _browser(viewer) as browser:
        browser.wait(lambda: _background(browser) == "exact", "the exact picture")
        (client,) = viewer.server.get_clients().values()
        until(lambda: _nothing_more_comes(browser), "the job's own 3D")
        splats = client.scene._handle_from_node_name["/splats/splats"]
        assert not splats.visible
        asked = fake.renders[-1]
        width, focal = asked["intrinsics"]["width"], asked["intrinsics"]["fy"]
        assert (width, asked["intrinsics"]["height"]) == (800, 600)
        assert focal == pytest.approx(300 / np.tan(0.5 * client.camera.fov))
        there = np.array(asked["pose"]["world_from_camera"])[:3, 3]
        np.testing.assert_allclose(there, client.camera.position, atol=1e-9)
        browser.send(**{**CAMERA, "position": [5.0, 0.0, 0.0]})
        browser.wait(lambda: splats.visible, "the splats while it moves")
        browser.wait(lambda: not splats.visible and np.allclose(_rendered_from(fake), [5, 0, 0]), "the next picture")
        browser.set("full-quality render when still", False)
        browser.wait(lambda: splats.visible and _background(browser) == "ground", "the splats")


def _rendered_from(fake: FakeService) -> np.ndarray:
    return np.array(fake.renders[-1]["pose"]["world_from_camera"])[:3, 3]


def _nothing_more_comes(browser: FakeBrowser) -> bool:
    count = len(browser.frames)
    time.sleep(0.6)  # longer than the view must rest before it is rendered
    return len(browser.frames) == count


def _background(browser: FakeBrowser) -> str:
    """What lies behind the scene."""
    data = browser.background["rgb_data"]
    picture = images.decode(bytes(data)) if data else np.zeros((1, 1, 3))
    return "exact" if np.abs(picture.mean((0, 1)) - EXACT_RGB).max() < 4 else "ground"


def test_a_view_that_was_set_from_here_is_rendered_at_once_and_its_echo_changes_nothing(
    fake: FakeService, viewer: Viewer
) -> None:
    fake.job("j", 3, finished=True)
    with _browser(viewer, "/jobs/j") as browser:
        browser.wait(lambda: _background(browser) == "exact" and "/splats/splats" in browser.nodes, "both")
        first = next(k for k, frame in enumerate(browser.frames) if any(m.get("rgb_data") for m in frame[1:]))
        sent = next(
            k for k, frame in enumerate(browser.frames) if any(m.get("name") == "/splats/splats" for m in frame)
        )
        assert first <= sent
        (client,) = viewer.server.get_clients().values()
        browser.wait(lambda: not client.scene._handle_from_node_name["/splats/splats"].visible, "the view at rest")
        until(lambda: _nothing_more_comes(browser), "the job's own 3D")
        camera, count = client.camera, len(fake.renders)
        moved = {n: [float(x) for x in getattr(camera, n)] for n in ("wxyz", "position", "look_at", "up_direction")}
        browser.send(**{**CAMERA, **moved, "fov": camera.fov, "near": camera.near, "far": camera.far})
        browser.set("step", 0)
        browser.wait(lambda: ">100<" in browser.text(), "what is sent after")
        assert _background(browser) == "exact"
        assert [r for r in fake.renders[count:] if r["format"] != "depth"] == []


def test_a_browser_without_a_gpu_gets_no_splats_but_pictures_while_it_moves(fake: FakeService, viewer: Viewer) -> None:
    fake.job("j", 3, finished=True)
    with _browser(viewer, "/jobs/j?gl=software") as browser:
        browser.wait(lambda: "verified" in browser.text() and _background(browser) == "exact", "the job")
        assert browser.widget("splats")["value"] is False
        browser.wait(lambda: "300 Gaussians, drawn by the service" in browser.text(), "the scene's line")
        count = len(fake.renders)
        for x in np.linspace(4, 5, 20).tolist():
            browser.send(**{**CAMERA, "position": [x, 0.0, 0.0]})
            time.sleep(0.02)
        assert _background(browser) == "exact"
        assert any(r["intrinsics"]["width"] == 480 for r in fake.renders[count:]), "small while it moves"
        browser.wait(
            lambda: np.allclose(_rendered_from(fake), [5, 0, 0]) and fake.renders[-1]["intrinsics"]["width"] == 800,
            "the view at rest",
        )
        assert "/splats/splats" not in browser.nodes
        browser.set("splats", True)
        browser.wait(lambda: "/splats/splats" in browser.nodes and "300 splats" in browser.text(), "the splats")


def test_a_step_comes_as_widgets_first_and_only_what_changed(
    fake: FakeService, viewer: Viewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Where the CPU is busy, viser may wake too late to send in two messages what was set 20 ms apart.
    monkeypatch.setattr(step_display, "_MESSAGE_GAP_S", 0.5)
    fake.job("j", 5, finished=True)
    with _browser(viewer, "/jobs/j") as browser:
        place = lambda: browser.nodes["/trajectory/current"]["position"]  # noqa: E731
        there = [r.pose.position_in_world for r in records(5)]
        browser.wait(lambda: np.allclose(place(), there[4], atol=1e-6) and _background(browser) == "exact", "the end")
        browser.wait(lambda: set(browser.nodes) >= LAST_NODES, "the job's own 3D")
        (client,) = viewer.server.get_clients().values()
        browser.wait(lambda: not client.scene._handle_from_node_name["/splats/splats"].visible, "the view at rest")
        until(lambda: _nothing_more_comes(browser), "the end of the start")
        before = len(browser.frames)
        browser.set("step", 2)
        browser.wait(lambda: np.allclose(place(), there[2], atol=1e-6), "the camera of the step")
        frames = browser.frames[before:]
        of_3d = [[m for m in frame if "name" in m] for frame in frames]
        first = next(k for k, messages in enumerate(of_3d) if messages)
        said = [m["updates"] for frame in frames[:first] for m in frame if m["type"] == "GuiUpdateMessage"]
        assert any(">102<" in u.get("content", "") for u in said), "the numbers wait for no 3D"
        assert any("_data" in u for u in said), "nor does the picture"
        names = {m["name"] for messages in of_3d for m in messages}
        assert "/trajectory/current" in names
        assert not names & {
            "/candidates/cloud",
            "/candidates/candidates",
            "/splats/splats",
            "/training cameras/cameras",
        }


def test_what_the_next_step_needs_is_at_hand(fake: FakeService, viewer: Viewer) -> None:
    fake.job("j", 5, finished=True)
    with _browser(viewer, "/jobs/j") as browser:
        browser.wait(lambda: browser.widget("step")["value"] == 4 and "agree" in browser.text(), "the job")
        until(lambda: "/jobs/j/iterations/3/render.jpg" in fake.asked, "the render of the step before")
        browser.set("step", 3)
        until(lambda: "/jobs/j/iterations/2/render.jpg" in fake.asked, "and again")
        assert fake.asked.count("/jobs/j/iterations/3/render.jpg") == 1


def test_of_several_photos_only_the_step_whose_photo_is_kept_is_compared_with_it(
    fake: FakeService, viewer: Viewer
) -> None:
    job = fake.job("walk", 3)
    job.walk = [Status.LOCALIZED, Status.LOCALIZED, Status.UNCERTAIN]
    job.finish()

    def texture() -> np.ndarray:
        return images.decode(bytes(browser.nodes["/trajectory/current"]["props"]["_image_data"])).mean((0, 1))

    with _browser(viewer, "/jobs/walk") as browser:
        for step, told, colour in (
            (2, "only the photo of step 1 is kept", render_rgb(2, matched=False)),
            (1, "photo, and the render", (120, 160, 200)),
            (0, "only the photo of step 1 is kept", render_rgb(0, matched=False)),
        ):
            browser.wait(lambda: browser.widget("step")["max"] == 2, "the job")
            browser.set("step", step)
            browser.wait(lambda told=told: told in browser.text(), "what is shown")
            browser.wait(lambda colour=colour: np.abs(texture() - colour).max() < 6, "the picture in the camera")


def test_a_replay_has_the_splats_and_every_step(fake: FakeService) -> None:
    fake.job("saved", 3, finished=True)
    service = Client("http://fake", transport=fake.transport)
    stream = JobStream(service, "saved")
    stream.start()
    until(lambda: stream.complete, "the job")
    page = replay_html(stream, SceneCache(service).get("ball"))
    match = re.search(r'__VISER_EMBED_DATA__="([^"]+)"', page)
    assert match is not None
    data = base64.b64decode(match[1])
    said = zstandard.ZstdDecompressor().decompressobj().decompress(data[data.index(b"\x28\xb5\x2f\xfd") :])
    assert said.count(b"GaussianSplatsMessage") == 1
    assert all(f"step {k} of 2".encode() in said for k in range(3))


def test_a_scene_can_be_looked_at_without_a_job(fake: FakeService, viewer: Viewer) -> None:
    fake.job("j", 3, finished=True)
    fake.scenes = ["ball", "copy"]
    with _browser(viewer) as browser:
        browser.wait(lambda: "/trajectory/final" in browser.nodes, "the newest job")
        browser.wait(lambda: browser.widget("scene")["options"] == ["ball", "copy"], "the scenes")
        browser.set("scene", "copy")
        browser.wait(lambda: "no job" in browser.text() and "/trajectory/final" not in browser.nodes, "the bare scene")
        assert browser.widget("step")["disabled"]
        assert browser.widget("follow newest job")["value"] is False


def test_play_has_the_chosen_speed(fake: FakeService, viewer: Viewer) -> None:
    fake.job("j", 8, finished=True)
    with _browser(viewer, "/jobs/j") as browser:
        browser.wait(lambda: browser.widget("step")["value"] == 7 and "agree" in browser.text(), "the job")
        browser.set("steps per second", "20")
        began = time.monotonic()
        browser.set("", "play / pause")
        browser.wait(lambda: browser.widget("step")["value"] < 7, "the start")
        browser.wait(lambda: browser.widget("step")["value"] == 7, "the end")
        assert 0.2 < time.monotonic() - began < 3  # 7 steps in 0.35 s, drawing aside; at 2 a second it would be 3.5 s


def test_an_unknown_job_is_reported(viewer: Viewer) -> None:
    with _browser(viewer, "/jobs/unknown") as browser:
        browser.wait(lambda: "Job unknown not found or expired." in browser.text(), "the message")


@pytest.mark.parametrize("forbidden", [True, False])
def test_no_browser_can_open_a_public_tunnel(
    fake: FakeService, monkeypatch: pytest.MonkeyPatch, *, forbidden: bool
) -> None:
    asked = threading.Event()
    monkeypatch.setattr(viser.ViserServer, "request_share_url", lambda *_, **__: asked.set())
    if not forbidden:  # shows that the message is the right one: without the ban it has its effect
        monkeypatch.setattr(viewer_server, "disable_public_tunnels", lambda server: None)
    viewer = Viewer(lambda _: Client("http://fake", transport=fake.transport), "127.0.0.1", 0)
    try:
        with _browser(viewer) as browser:
            browser.send(type="ShareUrlRequest")
            browser.wait(lambda: "no job" in browser.text(), "what is sent after")
            assert asked.wait(0.3) is not forbidden
    finally:
        viewer.stop()


def test_a_viser_that_hides_its_tunnel_is_refused() -> None:
    stopped = threading.Event()
    other: Any = object.__new__(viser.ViserServer)
    other._websock_server, other.stop = SimpleNamespace(_handlers={}), stopped.set
    with pytest.raises(RuntimeError, match="tunnel"):
        viser_internals.disable_public_tunnels(other)
    assert stopped.is_set()


def test_a_viewer_that_stops_takes_leave_of_its_browsers(fake: FakeService) -> None:
    """viser reports them as gone while it stops, which ends their sessions."""
    viewer, gone = Viewer(lambda _: Client("http://fake", transport=fake.transport), "127.0.0.1", 0), threading.Event()
    viewer.server.on_client_disconnect(lambda client: gone.set())
    with _browser(viewer) as browser:
        browser.wait(lambda: "no job" in browser.text(), "the page")
        viewer.stop()
        assert gone.is_set()
        assert not viewer.server.get_clients()
        assert not viewer._sessions


def test_a_taken_port_is_an_error(viewer: Viewer, fake: FakeService) -> None:
    with pytest.raises(OSError, match="is taken"):
        Viewer(lambda _: Client("http://fake", transport=fake.transport), "127.0.0.1", viewer.server.get_port())


@pytest.mark.parametrize(
    ("path", "job"),
    [("/jobs/abc", "abc"), ("/jobs/abc/", "abc"), ("/jobs/abc?x=1", "abc"), ("/", None), ("/jobs/", None)]
    + [(p, None) for p in ("/jobs/../etc", "/jobs/a/b", "/jobs/%2e%2e", "/x/jobs/abc", "/jobs/" + 65 * "a")],
)
def test_only_plain_ids_are_taken_from_an_address(path: str, job: str | None) -> None:
    assert requested_page(path).job_id == job


def test_an_unknown_path_means_the_newest_job(viewer: Viewer) -> None:
    assert viser_internals.requested_path(viewer.server, 12345) == "/"


def test_a_missing_image_is_reported_and_the_rest_is_shown(
    fake: FakeService, viewer: Viewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake.job("j", 3, finished=True)
    monkeypatch.setattr(JobStream, "render", _refused)
    with _browser(viewer, "/jobs/j") as browser:
        browser.wait(lambda: "no image: The scene is loading." in browser.text(), "the message")
        browser.set("step", 1)
        browser.wait(lambda: ">101<" in browser.text(), "the numbers")
        assert "verified" in browser.text()


def _refused(*_: object, **__: object) -> np.ndarray:
    raise ServiceError("scene_not_ready", "The scene is loading.", status=503)


def test_the_program_serves_until_sigterm(fake: FakeService) -> None:
    with closing(socket.create_server(("127.0.0.1", 0))) as free:
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "viewer", "--service", "http://127.0.0.1:9", "--port", str(port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as child:
        try:
            until(lambda: child.poll() is not None or _answers(port), "an answer", 60)
            with FakeBrowser(port) as browser:
                browser.wait(lambda: browser.widget("follow newest job"), "the widgets")
                child.send_signal(signal.SIGTERM)
                child.wait(10)
        finally:
            child.kill()
        assert child.stdout is not None
        assert child.stderr is not None
        assert child.returncode == 0
        assert child.stdout.read() == ""
        assert "Traceback" not in child.stderr.read()


def _answers(port: int) -> bool:
    try:
        return httpx.get(f"http://127.0.0.1:{port}/", trust_env=False).status_code == 200
    except httpx.ConnectError:
        return False
