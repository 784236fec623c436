"""The viewer without a browser: what it reads, what it draws, what it tells viser; live, and for several people."""

from __future__ import annotations

import base64
import re
import time
from collections.abc import Iterator
from dataclasses import replace
from zoneinfo import ZoneInfo

import cv2
import fake_service
import httpx
import numpy as np
import pytest
from fake_service import PHOTO, FakeService, orbit, records, render_rgb, threads, until
from hypothesis import given
from hypothesis import strategies as st

from service.client import Client, Event, EventParser, ServiceError, parse_record
from service.geometry import look_at, project, transformed
from service.results import IterationRecord, MatchVectors, Reason, Status
from service.scene_manager.splat_sample import importance, packed_splats
from service.types import Camera, Intrinsics, Pose
from service.web.schemas.conversion import record_out
from viewer import camera_views, charts, colours, frusta, job_stream, match_geometry, service_lists
from viewer import comparison_images as images
from viewer.job_stream import JobStream
from viewer.layers.axes_layer import round_length
from viewer.layers.splat_layer import full_covariances
from viewer.panel_html import headline_html, job_label, record_html, scene_html
from viewer.picking import first_surface
from viewer.playback import Playback
from viewer.service_lists import ServiceLists
from viewer.service_values import Job, JobOutcome, ListedJob, Splats, parse_splats, record_of
from viewer.shared_data import SharedByToken, SharedData

# ---------------------------------------------------------------- what the service says


@pytest.mark.parametrize("record", [*records(2), replace(records(1)[0], matches=None, candidates=None, loss=None)])
def test_records_survive_the_wire(record: IterationRecord) -> None:
    back = record_of(parse_record(record_out(record).model_dump(mode="json"), 1))
    np.testing.assert_array_equal(back.pose.world_from_camera, record.pose.world_from_camera)
    for name in ("stage", "index", "elapsed_s", "loss", "num_matches", "num_inliers", "step_deg", "step_units"):
        assert getattr(back, name) == getattr(record, name)
    for name, parts in (
        ("matches", ("photo_px", "render_px", "inlier")),
        ("candidates", ("world_from_camera", "scores")),
    ):
        ours, theirs = getattr(back, name), getattr(record, name)
        assert (ours is None) == (theirs is None)
        for part in parts if theirs is not None else ():
            np.testing.assert_array_equal(getattr(ours, part), getattr(theirs, part))
            assert getattr(ours, part).dtype == getattr(theirs, part).dtype


def test_splats_are_read_as_the_service_packs_them() -> None:
    scene = fake_service.scene(40)
    splats = parse_splats(packed_splats(scene, 25))
    best = np.argsort(-importance(scene), kind="stable")[:25]
    assert splats.total == 40
    np.testing.assert_array_equal(splats.centres, scene.means[best])
    full = full_covariances(splats.covariances)
    np.testing.assert_array_equal(full, full.transpose(0, 2, 1))
    # Isotropic in the fake scene: 0.05^2 on the diagonal; 1e-9 seen.
    np.testing.assert_allclose(full, np.tile(0.05**2 * np.eye(3), (25, 1, 1)), atol=1e-8)
    assert np.all(splats.rgba[:, 3] == round(0.9 * 255))
    with pytest.raises(ValueError, match="bytes for 25 splats"):
        parse_splats(packed_splats(scene, 25)[:-1])


def test_server_sent_events() -> None:
    # Comments, several data lines, an event without data (dropped) and one without a name: as the standard has it.
    text = ": ping\n\nevent: record\nid: 0\ndata: one\ndata: two\n\nevent: empty\n\ndata:  spaced\n\n"
    assert list(filter(None, map(EventParser().line, text.split("\n")))) == [
        Event(""),
        Event("record", "0", "one\ntwo"),
        Event("message", "", " spaced"),
    ]


def test_errors_name_the_path_and_the_status() -> None:
    service = Client("http://fake", transport=FakeService().transport)
    with pytest.raises(ServiceError, match=r"^/jobs/nope answered HTTP 404.$") as raised:
        service.job("nope")
    assert raised.value.status == 404
    refused = httpx.MockTransport(lambda request: (_ for _ in ()).throw(httpx.ConnectError("refused")))
    with pytest.raises(ServiceError, match="refused") as raised:
        Client("http://fake", transport=refused).jobs()
    assert raised.value.status is None


# ---------------------------------------------------------------- which record is shown


@given(st.lists(st.one_of(st.sampled_from(["toggle", "tick", "grow"]), st.integers(-50, 50)), max_size=40))
def test_playback_stays_within_the_records(moves: list[str | int]) -> None:
    playback, count = Playback(), 0
    for move in moves:
        if move == "grow":
            count += 3
            playback.set_count(count)
        elif isinstance(move, int):
            playback.go(move) if move % 2 else playback.step(move)
        else:
            getattr(playback, move)()
        assert 0 <= playback.index <= max(0, count - 1)
        assert not (playback.playing and count < 2)


def test_of_an_attempt_with_fewer_records_the_last_one_is_shown() -> None:
    playback = Playback()
    playback.set_count(6)
    playback.go(4)
    playback.set_count(3)
    assert (playback.index, playback.live) == (2, False)
    playback.set_count(0)
    assert playback.index == 0


def test_playback_follows_a_live_job_until_someone_looks_back() -> None:
    playback = Playback()
    playback.set_count(5)
    assert playback.index == 4
    playback.step(-2)
    playback.set_count(8)
    assert playback.index == 2
    playback.go(7)
    playback.set_count(9)
    assert playback.index == 8


def test_play_starts_over_at_the_end_and_stops_there() -> None:
    playback = Playback()
    playback.set_count(3)
    playback.toggle()
    seen = [playback.index]
    while playback.playing:
        playback.tick()
        seen.append(playback.index)
    assert seen == [0, 1, 2]


# ---------------------------------------------------------------- what is drawn


@given(st.floats(0, 1), st.floats(0.1, 3), st.integers(40, 900), st.integers(40, 900))
def test_frusta_project_onto_the_corners_of_their_images(share: float, depth: float, width: int, height: int) -> None:
    k = Intrinsics(width, height, 300.0, 320.0, 0.4 * width, 0.6 * height)
    pose = orbit(share)
    segments = frusta.frustum_edges(frusta.stack_poses([pose]), [k], depth)
    rim = segments[4:, 0]  # the first four edges lead from the apex to the corners
    in_camera = transformed(pose.camera_from_world, rim)
    np.testing.assert_allclose(in_camera[:, 2], depth, rtol=1e-5)
    corners = [(0, 0), (width, 0), (width, height), (0, height)]
    np.testing.assert_allclose(project(in_camera, k), corners, atol=2e-2)  # float32 points: 4e-3 px seen
    np.testing.assert_allclose(segments[:4, 0], np.tile(pose.position_in_world, (4, 1)), atol=1e-6)


def test_no_poses_give_empty_drawings() -> None:
    assert frusta.frustum_edges(frusta.stack_poses([]), [], 1.0).shape == (0, 2, 3)
    assert colours.score_colours(np.zeros(0)).shape == (0, 3)


@given(st.floats(0.3, 3), st.floats(-3, 3))
def test_looking_through_a_camera_shows_its_whole_image(aspect: float, roll: float) -> None:
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]]
    pose = replace(orbit(0.2), world_from_camera=orbit(0.2).world_from_camera @ turn)
    scene = camera_views.scene_extent(
        np.zeros((0, 3), np.float32), [Camera(PHOTO, orbit(s)) for s in (0.0, 0.3, 0.6)], (0.0, 0.0, 1.0)
    )
    view = camera_views.view_through(Camera(PHOTO, pose), scene, aspect)
    forward = view.look_at - view.position
    forward /= np.linalg.norm(forward)
    np.testing.assert_allclose(forward, pose.axis_in_world, atol=1e-9)
    # The browser's camera: y towards up, made orthogonal to the viewing direction. Its roll is the photo's.
    up = view.up - (view.up @ forward) * forward
    np.testing.assert_allclose(up / np.linalg.norm(up), -pose.world_from_camera[:3, 1], atol=1e-6)
    assert np.linalg.norm(view.up) == pytest.approx(1)
    # In units of the viewport's half height the image's corners lie within it, and touch it on one side.
    reach = np.tan(view.fov_rad / 2)
    x, y = 0.5 * PHOTO.width / PHOTO.fx / reach / aspect, 0.5 * PHOTO.height / PHOTO.fy / reach
    assert max(x, y) == pytest.approx(1, abs=1e-9)


@pytest.mark.parametrize("wall", [None, 0.9])
@given(share=st.floats(0, 1))
def test_over_the_shoulder_the_whole_frustum_is_seen_and_no_wall_between(share: float, wall: float | None) -> None:
    pose = orbit(share)
    scene = camera_views.scene_extent(
        np.zeros((0, 3), np.float32), [Camera(PHOTO, orbit(s)) for s in (0.0, 0.3, 0.6)], None
    )
    across = np.random.default_rng(0).uniform(-1, 1, (5000 if wall else 0, 2))
    centres = transformed(pose.world_from_camera, np.column_stack([across, np.full(len(across), -(wall or 0))]))
    view = camera_views.view_from_behind(pose, scene, centres.astype(np.float32))
    distance = -(view.position - pose.position_in_world) @ pose.axis_in_world
    assert distance < (wall or 2)
    seen = look_at(view.position, view.look_at, view.up)
    focal = 50 / np.tan(view.fov_rad / 2)
    corners = frusta.frustum_edges(frusta.stack_poses([pose]), [PHOTO], scene.frustum_depth).reshape(-1, 3)
    in_view = transformed(seen.camera_from_world, corners)
    assert in_view[:, 2].min() > 1.15 * scene.frustum_depth  # the near plane
    px = project(in_view, Intrinsics(100, 100, focal, focal, 50, 50))
    assert px.min() > 5
    assert px.max() < 95


def test_extent_ignores_floaters_and_survives_an_empty_scene() -> None:
    points = np.random.default_rng(0).normal(size=(1000, 3)).astype(np.float32)
    points[:20] *= 1000
    found = camera_views.scene_extent(points, [], None)
    assert found.radius < 4  # the 90 % quantile of a normal cloud is 2.5
    np.testing.assert_array_equal(found.up, [0, 0, 1])
    assert camera_views.scene_extent(np.zeros((0, 3), np.float32), [], None).radius == 1.0


def test_up_comes_from_the_scene_else_from_its_cameras() -> None:
    cameras = [Camera(PHOTO, orbit(s)) for s in (0, 0.25, 0.5, 0.75)]
    nothing = np.zeros((0, 3), np.float32)
    np.testing.assert_allclose(camera_views.scene_extent(nothing, cameras, None).up, [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(camera_views.scene_extent(nothing, cameras, (0.0, -2.0, 0.0)).up, [0, -1, 0], atol=1e-9)


def test_two_cameras_or_more_are_the_size_of_a_scene() -> None:
    centres = np.full((50, 3), np.float32(7.0))
    for count, middle, radius in ((2, [5, 0, 0], 1.0), (3, [6, 0, 0], 2.0)):
        places = np.array([[4.0, 0, 0], [6.0, 0, 0], [8.0, 0, 0]])[:count]
        cameras = [Camera(PHOTO, Pose(np.block([[np.eye(3), at[:, None]], [np.zeros(3), 1.0]]))) for at in places]
        found = camera_views.scene_extent(centres, cameras, None)
        np.testing.assert_allclose(found.centre, middle)
        assert found.radius == pytest.approx(radius)
        assert found.frustum_depth == pytest.approx(0.08 * found.radius)
    # One alone has no size.
    np.testing.assert_allclose(camera_views.scene_extent(centres, cameras[:1], None).centre, [7, 7, 7])


@pytest.mark.parametrize(("leans", "about_scenes"), [(0.06, True), (0.04, False)])
def test_a_camera_that_looks_straight_down_is_orbited_about_its_own_upright(leans: float, about_scenes: bool) -> None:
    """Where the scene's upright is within some 3 degrees of the viewing direction, it would be of no use."""
    scene = camera_views.SceneExtent(np.zeros(3), 2.0, np.array([0.0, 0.0, 1.0]), 0.1)
    sine = np.sqrt(1 - leans**2)
    pose = look_at(np.zeros(3), np.array([leans, 0, -sine]), scene.up)
    found = camera_views.view_through(Camera(PHOTO, pose), scene, 1.5)
    assert found.up == pytest.approx([0, 0, 1] if about_scenes else [sine, 0, leans], abs=1e-9)


def test_a_flight_is_a_smooth_step_between_two_views() -> None:
    x, y, z = np.eye(3)
    a, b = camera_views.Viewpoint(2 * x, 3 * y, z, 1.0), camera_views.Viewpoint(6 * x, y + 4 * z, y, 0.5)
    for share, s in ((0.0, 0.0), (0.25, 5 / 32), (0.5, 0.5), (1.0, 1.0)):  # 3 s^2 - 2 s^3
        found = camera_views.interpolate_views(a, b, share)
        assert found.position == pytest.approx((2 + 4 * s) * x)
        assert found.look_at == pytest.approx((3 - 2 * s) * y + 4 * s * z)
        assert found.up == pytest.approx((1 - s) * z + s * y)
        assert found.fov_rad == pytest.approx(1 - 0.5 * s)


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (0.6, 0.0, 0.8)])
def test_without_cameras_a_scene_is_seen_whole_from_a_little_above(up: tuple[float, float, float]) -> None:
    scene = camera_views.SceneExtent(np.array([10.0, 20.0, 30.0]), 4.0, np.array(up), frustum_depth=0.3)
    view = camera_views.initial_view(scene, [])
    away = view.position - scene.centre
    np.testing.assert_array_equal(view.look_at, scene.centre)
    np.testing.assert_array_equal(view.up, up)
    # Two and a half radii away, half as far up as to the side.
    assert np.linalg.norm(away) == pytest.approx(10.0)
    assert away @ np.array(up) == pytest.approx(10 * 0.5 / np.sqrt(1.25), rel=1e-6)
    assert np.arctan(4.0 / 10.0) < view.fov_rad / 2 < np.arctan(1.0)  # nine tenths of the scene fill the picture


@pytest.mark.parametrize(("width", "height"), [(300, 400), (400, 300), (200, 200), (64, 900)])
def test_match_lines_end_where_the_matches_are(width: int, height: int) -> None:
    # Black pictures, each with one white pixel; the match between them must be drawn from the one to the other.
    photo, render = np.zeros((height, width, 3), np.uint8), np.zeros((height // 2, width // 2, 3), np.uint8)
    at_photo, at_render = (width // 3, height // 4), (width // 4, height // 5)
    photo[at_photo[1], at_photo[0]] = 255
    render[at_render[1], at_render[0]] = 255
    camera = Camera(Intrinsics(width // 2, height // 2, 100, 100, width / 4, height / 4), orbit(0))
    pixels = [np.float32([p]) + np.float32(0.5) for p in (at_photo, at_render)]
    spots = [_centre(images.side_by_side(photo * a, render * (1 - a)), 30) for a in (1, 0)]
    plain = images.side_by_side(photo * 0, render * 0)
    lined = images.side_by_side(photo * 0, render * 0, match_view(*pixels, camera), np.uint8([colours.INLIER_COLOUR]))
    drawn = np.abs(lined.astype(int) - plain).max(-1) > 100
    rows, columns = np.nonzero(drawn)
    for x, y in spots:
        nearest = np.hypot(columns + 0.5 - x, rows + 0.5 - y).min()
        assert nearest < 3, (x, y)  # the dot's radius is 4
        # A dot is opaque, the line through it isn't.
        inked = (lined == colours.INLIER_COLOUR).all(-1)
        dot = inked[round(y) - 6 : round(y) + 7, round(x) - 6 : round(x) + 7]
        at = np.argwhere(dot).mean(0) + 0.5 - 6 + [round(y), round(x)]
        assert np.abs(at - (y, x)).max() < 1
        assert dot.sum() == pytest.approx(np.pi * 3.3**2, rel=0.15)
    # And nowhere beyond: the line lies in the box that the two ends span, but for the dots.
    (x0, y0), (x1, y1) = np.min(spots, 0) - 6, np.max(spots, 0) + 6
    assert columns.min() > x0
    assert columns.max() < x1
    assert rows.min() > y0
    assert rows.max() < y1


def _centre(picture: np.ndarray, above: int) -> np.ndarray:
    """The centre of what is bright, left out the window's grey ground."""
    weight = picture[..., 0].astype(float) * (picture[..., 0] != 36) * (picture[..., 0] > above)
    rows, columns = np.nonzero(weight)
    return np.array(
        [
            np.average(columns + 0.5, weights=weight[rows, columns]),
            np.average(rows + 0.5, weights=weight[rows, columns]),
        ]
    )


def match_view(photo_px: np.ndarray, render_px: np.ndarray, camera: Camera) -> match_geometry.MatchView:
    """Matches that all agree, as they are seen by the camera that they refer to."""
    found = MatchVectors(photo_px, render_px, np.ones(len(photo_px), bool), camera)
    depth = np.ones((camera.intrinsics.height, camera.intrinsics.width), np.float32)
    return match_geometry.matches_at_pose(match_geometry.backproject_matches(found, depth, 0), camera, 0)


def test_colours_tell_inliers_and_residuals() -> None:
    camera = Camera(Intrinsics(800, 600, 800, 800, 400, 300), orbit(0))
    px = np.float32([[400, 300]] * 4)
    view = match_view(px, px + np.float32([[0.1, 0], [5, 0], [300, 0], [9999, 0]]), camera)
    view = replace(view, inlier=np.array([True, False, True, True]))
    (green, red, *_), by_residual = (
        colours.match_colours(view, "inlier"),
        colours.match_colours(view, "residual"),
    )
    assert green.tolist() == list(colours.INLIER_COLOUR)
    assert red.tolist() == list(colours.OUTLIER_COLOUR)
    assert by_residual[0].tolist() == list(colours.INLIER_COLOUR)  # below half a pixel
    assert by_residual[2].tolist() == list(colours.OUTLIER_COLOUR)  # beyond 50
    assert by_residual[1][0] > 200  # 5 px: in the middle, yellow
    assert by_residual[1][1] > 200
    assert colours.match_colours(replace(view, residual_px=np.full(4, np.nan)), "residual")[0].tolist() == [150] * 3


def test_overlays_compare_pixel_by_pixel() -> None:
    photo, render = np.full((30, 40, 3), 100, np.uint8), np.full((15, 20, 3), 180, np.uint8)
    inside = (100, 400)
    assert images.overlay("blend", photo, render, 0.25)[inside].tolist() == [120, 120, 120]
    assert images.overlay("difference", photo, render)[inside].tolist() == [160, 160, 160]
    assert images.overlay("difference", photo, photo)[inside].max() == 0
    assert images.overlay("difference", photo * 0, render + 70)[inside].max() == 255  # doubled, not wrapped round
    tiles = images.overlay("checker", photo, render)[40::80, 40::80, 0]  # one pixel of each of 10 x 7 tiles
    expected = np.where(np.indices(tiles.shape).sum(0) % 2 == 0, 100, 180)
    np.testing.assert_array_equal(tiles, expected)
    both = re.findall(r"base64,([^']+)", images.flicker_html(photo, render))
    assert [images.decode(base64.b64decode(data))[5, 5, 0] for data in both] == [100, 180]


def extent_of(picture: np.ndarray, colour: tuple[int, int, int]) -> tuple[int, int, int, int]:
    """Left, top, and width and height of what has a colour."""
    rows, columns = np.nonzero((picture == colour).all(2))
    return int(columns.min()), int(rows.min()), int(np.ptp(columns)) + 1, int(np.ptp(rows)) + 1


@pytest.mark.parametrize(
    ("photo", "render", "places"),
    [
        # (height, width), and left, top, width, height in a picture of 800 pixels and at most 1160: 8 lie between.
        ((60, 90), (60, 90), [(0, 0, 800, 533), (0, 541, 800, 533)]),
        ((100, 95), (40, 80), [(126, 0, 547, 576), (0, 584, 800, 400)]),
        ((100, 90), (100, 90), [(141, 0, 518, 576), (141, 584, 518, 576)]),
        ((100, 80), (100, 80), [(0, 0, 396, 495), (404, 0, 396, 495)]),
        ((100, 20), (90, 30), [(86, 0, 232, 1160), (326, 0, 387, 1160)]),
    ],
)
def test_photo_and_render_are_as_large_as_fits_with_a_gap_between(
    photo: tuple[int, int], render: tuple[int, int], places: list[tuple[int, int, int, int]]
) -> None:
    red, blue = (200, 20, 20), (20, 20, 200)
    pair = images.side_by_side(np.full((*photo, 3), red, np.uint8), np.full((*render, 3), blue, np.uint8))
    assert [extent_of(pair, colour) for colour in (red, blue)] == [pytest.approx(place, abs=1) for place in places]
    assert pair.shape == (max(top + height for _, top, _, height in places), 800, 3)


def test_a_composed_image_is_in_the_middle() -> None:
    photo = np.full((100, 30, 3), (200, 20, 20), np.uint8)
    left, top, width, height = extent_of(images.overlay("blend", photo, photo), (200, 20, 20))
    assert (left, top, width, height) == (226, 0, 348, 1160)
    assert extent_of(images.overlay("blend", photo[:20], photo[:20]), (200, 20, 20)) == (0, 0, 800, 533)


def test_a_photo_over_a_render_is_mixed_by_its_opacity() -> None:
    camera = Camera(PHOTO, orbit(0))
    dark, light = (np.full((PHOTO.height, PHOTO.width, 3), value, np.uint8) for value in (40, 200))
    for opacity, mixed in ((0.0, 40), (0.25, 80), (1.0, 200)):
        assert images.with_photo(dark, camera, light, camera, opacity)[32, 48].tolist() == [mixed] * 3


@pytest.mark.parametrize(
    ("render_px", "drawn"),
    [((0, 0), True), ((0.5, 0.5), True), ((89.5, 59.5), True), ((90, 30), False), ((45, 60), False),
     ((-0.1, 30), False), ((45, -0.1), False), ((np.nan, np.nan), False)],
)  # fmt: skip
def test_a_match_outside_of_the_render_has_no_line(render_px: tuple[float, float], drawn: bool) -> None:
    camera = Camera(Intrinsics(90, 60, 80.0, 80.0, 45.0, 30.0), orbit(0))
    view = match_view(np.float32([[45, 30]]), np.float32([[45, 30]]), camera)
    view = replace(view, render_px=np.array([render_px], np.float64))
    grey = np.full((60, 90, 3), 90, np.uint8)
    white = np.full((1, 3), 255, np.uint8)
    bare = images.side_by_side(grey, grey)
    assert bool((images.side_by_side(grey, grey, view, white) != bare).any()) is drawn
    assert np.array_equal(images.side_by_side(grey, grey, view, None), bare)
    assert np.array_equal(images.side_by_side(grey, grey, None, white), bare)


@pytest.mark.parametrize(("count", "opacity"), [(1, 0.692), (50, 0.5), (300, 0.357)])
def test_lines_are_the_more_translucent_the_more_there_are_and_end_in_dots(count: int, opacity: float) -> None:
    """All the same: 0.3, and 0.4 more for a single one, half of that with fifty."""
    black, white = np.zeros((100, 200, 3), np.uint8), np.full((count, 3), 255, np.uint8)
    segments = np.tile(np.array([[20.5, 50.5], [180.5, 50.5]]), (count, 1, 1))
    drawn = images._draw_lines(black, segments, white)
    assert drawn[50, 100].tolist() == [pytest.approx(255 * opacity, abs=3)] * 3
    # Centred on the pixels that the ends lie in: two wide there, nothing three rows away.
    assert drawn[[47, 53], 100].max() == 0
    dots = np.argwhere((drawn == 255).all(2))
    for middle in ((50, 20), (50, 180)):
        offsets = dots[np.abs(dots - middle).max(1) < 10] - middle
        assert np.array_equal(offsets.min(0), [-3, -3])
        assert np.array_equal(offsets.max(0), [3, 3])
        assert [0, 0] in offsets.tolist()
        assert [3, 3] not in offsets.tolist()
    assert not black.any()


def test_dots_at_the_edge_are_cut() -> None:
    image = np.zeros((20, 30, 3), np.uint8)
    images._draw_dots(image, np.array([[0.2, 0.2], [29.8, 19.8], [-40.0, 5.0]]), np.full((3, 3), 9, np.uint8))
    expected = images._DOT_OFFSETS
    corner = {(int(r), int(c)) for r, c in expected if r >= 0 and c >= 0}
    assert set(map(tuple, np.argwhere(image[:10, :15, 0]).tolist())) == corner
    other = {(int(r) + 19, int(c) + 29) for r, c in expected if r <= 0 and c <= 0}
    assert {(r + 10, c + 15) for r, c in map(tuple, np.argwhere(image[10:, 15:, 0]).tolist())} == other
    assert int((image[..., 0] > 0).sum()) == len(corner) + len(other)


@pytest.mark.parametrize(("length", "arrow"), [(1.4, False), (1.6, True), (2.9, True), (3900, True), (4100, False)])
def test_vectors_too_short_or_endless_are_dots(length: float, arrow: bool) -> None:
    """At twice the photo's pixels: arrows are longer than 3 and shorter than 8000."""
    camera = Camera(Intrinsics(400, 300, 300.0, 300.0, 200.0, 150.0), orbit(0))
    at = np.array([[200.0, 150.0]])
    view = replace(match_view(np.float32(at), np.float32(at), camera), vectors_px=np.array([[length, 0.0]]))
    ink = np.array([(250, 10, 10)], np.uint8)
    black = np.zeros((300, 400, 3), np.uint8)
    picture = images.match_vectors_image(black, view, ink)[..., 0].astype(int)
    alone = images.match_vectors_image(black, replace(view, vectors_px=np.array([[0.0, 0.0]])), ink)[..., 0].astype(int)
    assert 20 < (alone > 200).sum() < 60  # a dot of 3 pixels' radius
    assert bool((picture != alone).any()) is arrow


def test_arrows_go_from_the_renders_point_to_the_photos() -> None:
    camera = Camera(Intrinsics(400, 300, 300, 300, 200, 150), orbit(0))
    view = match_view(np.float32([[300, 100]]), np.float32([[100, 200]]), camera)
    picture = images.match_vectors_image(np.zeros((150, 200, 3), np.uint8), view, np.uint8([colours.INLIER_COLOUR]))
    rows, columns = np.nonzero(picture[..., 1] > 150)  # 800 wide: all at twice the photo's pixels
    assert (columns.min(), columns.max()) == (pytest.approx(200, abs=4), pytest.approx(600, abs=4))
    assert (rows.min(), rows.max()) == (pytest.approx(200, abs=8), pytest.approx(400, abs=4))
    at_photo, at_render = (np.hypot(columns - x, rows - y) < 14 for x, y in ((600, 200), (200, 400)))
    assert at_photo.sum() > 2 * at_render.sum()  # the dot and the arrow's tip


def test_decoding_and_scaling() -> None:
    image = images.decode(fake_service.jpeg((200, 100, 50)))
    assert np.abs(image.reshape(-1, 3).mean(0) - [200, 100, 50]).max() < 3  # RGB, not BGR
    assert images.shrink(image, 48).shape == (32, 48, 3)
    for garbage in (b"", b"not an image"):
        with pytest.raises(ValueError, match="not an image"):
            images.decode(garbage)


def test_better_scores_are_brighter() -> None:
    ramp = colours.score_colours(np.linspace(-3, 5, 50))
    lightness = cv2.cvtColor(ramp[None], cv2.COLOR_RGB2LAB)[0, :, 0].astype(int)
    assert np.all(np.diff(lightness) >= 0)
    assert lightness[-1] - lightness[0] > 100
    assert np.array_equal(
        colours.score_colours(np.array([2.0, 2.0])),
        colours.score_colours(np.array([0.0, 1.0]))[[1, 1]],
    )


def test_texts_escape_what_others_wrote() -> None:
    answer = JobOutcome("not_localized", "few_features", "Take it <sharper>.", 0.1, 3)
    job = Job("1", "succeeded", "<s>", "2026-01-01T00:00:00Z", "view_index", "<b>x</b>.jpg", PHOTO, None, answer)
    text = headline_html(job, 4, "")
    assert "not localized" in text
    assert ">Almost no texture in the photo</span>, score 0.10, 3 inliers" in text
    assert "title='view_index'>Search of the whole scene<" in text
    assert "title='match'>Match with a view<" in record_html(replace(records(1)[0], stage="match"))
    assert "Take it &lt;sharper&gt;." in text
    for html in (text, headline_html(job, 0, "<i>"), scene_html("<b>", 1, 2, 3)):
        assert not {"<b>", "<s>", "<i>", "<sharper>"} & {html[m:n] for m in range(len(html)) for n in (m + 3, m + 9)}
    assert "–" in record_html(replace(records(1)[0], loss=None))


def test_lengths_are_in_metres_where_the_scene_has_a_scale() -> None:
    record = replace(records(1)[0], step_units=0.5)
    assert "position step, units</div><div style='white-space:nowrap'>0.5<" in record_html(record)
    assert "position step, m</div><div style='white-space:nowrap'>1.25<" in record_html(record, None, 2.5)
    assert "position error, m" in charts.curves_html(records(3), records(3)[2].pose, 1, 2.5)


def test_a_jobs_time_is_that_of_the_browsers_zone() -> None:
    job = ListedJob("0123456789", "running", "hall", "2026-01-31T23:30:00Z", None)
    assert job_label(job, ZoneInfo("Asia/Tokyo")) == "2026-02-01 08:30:00 · hall · running · 01234567"
    assert job_label(job, ZoneInfo("America/New_York")).startswith("2026-01-31 18:30:00")


# ---------------------------------------------------------------- what matches say


@given(st.floats(0, 1), st.floats(0.5, 9), st.floats(0.2, 0.4))
def test_lifted_matches_come_back_to_their_pixels(share: float, depth: float, turn: float) -> None:
    camera = Camera(Intrinsics(200, 100, 150.0, 160.0, 90.0, 55.0), orbit(share))
    px = np.random.default_rng(0).uniform([1, 1], [199, 99], (50, 2)).astype(np.float32)
    z = np.full((100, 200), depth, np.float32)
    z[:, :50] = 0  # nothing opaque there
    found = match_geometry.backproject_matches(MatchVectors(px, px, np.ones(50, bool), camera), z, 3)
    known = px[:, 0] >= 50
    assert np.array_equal(np.isfinite(found.points_in_world).all(1), known)
    in_camera = transformed(camera.pose.camera_from_world, found.points_in_world[known])
    np.testing.assert_allclose(in_camera[:, 2], depth, rtol=1e-6)
    np.testing.assert_allclose(project(in_camera, camera.intrinsics), px[known], atol=1e-3)
    # Seen from another pose by another step, residuals are what the renderer's own projection says.
    other = orbit(share + turn)
    view = match_geometry.matches_at_pose(found, Camera(PHOTO, other), 7)
    assert view.carried_from == 3
    there = transformed(other.camera_from_world, found.points_in_world[known])
    before = there[:, 2] > 0
    expected = np.linalg.norm(project(there[before], PHOTO) - px[known][before], axis=1)
    np.testing.assert_allclose(view.residual_px[known][before], expected, rtol=1e-6, atol=1e-6)
    assert np.isnan(view.residual_px[~known]).all()
    # The line in 3D ends where the photo has the point, at the point's depth.
    ends = transformed(other.camera_from_world, view.segments[:, 1].astype(np.float64))
    # In scene units, as near the camera plane a rounding error covers many pixels; float32 points: 6e-7 seen.
    off = (project(ends, PHOTO) - px[view.drawn]) * ends[:, 2:] / [PHOTO.fx, PHOTO.fy]
    np.testing.assert_allclose(off, 0, atol=2e-6)
    np.testing.assert_allclose(ends[:, 2], there[before][:, 2], rtol=0, atol=2e-6)


def test_vectors_of_a_shift_are_parallel_and_of_a_roll_interwoven() -> None:
    camera = Camera(PHOTO, orbit(0))
    grid = np.stack(np.meshgrid(np.linspace(8, 88, 9), np.linspace(8, 56, 7)), -1).reshape(-1, 2).astype(np.float32)
    middle = np.float32([PHOTO.cx, PHOTO.cy])
    rolled = (grid - middle) @ np.float32([[0.9, -0.3], [0.3, 0.9]]) + middle
    for photo_px, angle in ((grid + np.float32([7, -3]), 0.0), (rolled, 90.0)):
        view = match_view(photo_px, grid, camera)
        found = match_geometry.mean_angle_deg(view.vectors_px)
        assert found == pytest.approx(angle, abs=4)  # the grid is wider than high: 88 seen
    view = match_view(grid + np.float32([7, -3]), grid, camera)
    np.testing.assert_allclose(view.vectors_px, np.tile([7, -3], (63, 1)), atol=1e-4)
    counts = match_geometry.direction_histogram(view.vectors_px, 24)
    assert counts[round(np.degrees(np.arctan2(-3, 7)) / 15) % 24] == 63
    assert match_geometry.mean_angle_deg(np.zeros((5, 2))) is None


def test_pose_errors_are_those_of_a_known_motion() -> None:
    turn = np.radians(0.001)
    motion = np.eye(4)
    motion[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    motion[:3, 3] = [0.3, 0, 0.4]
    pose = orbit(0.3)
    moved = replace(pose, world_from_camera=pose.world_from_camera @ motion)
    assert match_geometry.pose_error(moved, pose) == pytest.approx((0.001, 0.5), rel=1e-6)
    half = replace(pose, world_from_camera=pose.world_from_camera @ np.diag([-1.0, 1, -1, 1]))
    assert match_geometry.pose_error(half, pose)[0] == pytest.approx(180)


def test_charts_have_gaps_where_nothing_is_known_and_marks_of_stages() -> None:
    shown = [replace(r, loss=None if r.index == 3 else r.loss, num_matches=None) for r in records(6)]
    drawn = charts.curves_html(shown, shown[-1].pose, 2)
    titles = ("loss", "rotation step", "position step, units", "matches and inliers", "rotation error")
    assert all(title in drawn for title in titles)
    loss = drawn.split("</svg>")[0]
    # Scene3D `retrieve` has one value, `refine` those of the steps 1, 2, 4 and 5: a line begins anew after the gap.
    assert re.findall(r"<path d='(M[^']*)' fill='none'", loss)[1].count("M") == 2
    assert loss.count("<title>Search among the scene&#x27;s views</title>") == 1
    assert loss.count("<title>Refine the pose by pixels</title>") == 1
    assert re.findall(r"<title>step (\d): ([^<]*)</title>", loss) == [
        (str(k), f"{1 / (k + 1):.4g}") for k in (0, 1, 2, 4, 5)
    ]
    assert "nan" not in drawn + charts.stages_html(shown, 2)
    assert "nothing to plot" in charts.curves_html([], None, 0)
    assert "no matches" in charts.vectors_html(None)


def test_a_click_takes_the_nearest_frustum_on_its_ray() -> None:
    poses = frusta.stack_poses([orbit(0.0), orbit(0.5), orbit(0.25)])
    eye = np.array([10.0, 0.0, 1.0])
    hit = frusta.hit_frustum(eye, np.array([-2.0, 0, 0]), poses, 0.3)
    assert hit == 0  # the one at the other side is on the ray, too, but farther
    assert frusta.hit_frustum(eye, np.array([1.0, 0, 0]), poses, 0.3) is None  # behind
    assert frusta.hit_frustum(eye, np.array([0.0, 1, 0]), poses, 0.3) is None
    assert frusta.hit_frustum(eye, np.array([-2.0, 0, 0]), poses[:0], 0.3) is None
    # However near it is, within six tenths of its depth of the ray.
    pose = orbit(0.0)
    for aside, expected in ((0.17, 0), (0.19, None)):
        beside = pose.position_in_world - 0.5 * pose.axis_in_world + aside * pose.world_from_camera[:3, 0]
        assert frusta.hit_frustum(beside, pose.axis_in_world, poses[:1], 0.3) == expected


# ---------------------------------------------------------------- following jobs


def test_a_stream_begins_anew_when_the_job_is_tried_again() -> None:
    fake = FakeService()
    job = fake.job("a", steps=3)
    stream = JobStream(Client("http://fake", transport=fake.transport), "a")
    stream.start()
    until(lambda: len(stream.records) == 3, "the first attempt")
    first = stream.records
    job.restart()
    for record in records(2, seed=1):
        job.add(record)
    until(lambda: stream.attempt == 2 and len(stream.records) == 2, "the second attempt")
    job.finish()
    until(lambda: stream.complete, "the end")
    assert [record.index for record in stream.records] == [0, 1]
    assert len(first) == 3  # who reads the old list isn't disturbed


def test_a_stream_follows_a_job_to_its_end() -> None:
    fake = FakeService()
    job = fake.job("a", 2)
    stream = JobStream(Client("http://fake", transport=fake.transport), "a")
    stream.start()
    until(lambda: len(stream.records) == 2, "what there was before")
    job.add(records(3)[2])
    until(lambda: len(stream.records) == 3, "what came then")
    assert stream.job is not None
    assert stream.job.outcome is None
    job.finish(Status.UNCERTAIN, Reason.FEW_INLIERS)
    until(lambda: stream.complete, "the end")
    assert stream.job.outcome is not None
    assert (stream.job.outcome.status, stream.job.outcome.inliers) == ("uncertain", 212)
    assert stream.job.outcome.hint
    until(lambda: not threads("job-a"), "the thread's end")


def test_a_job_without_records_is_told_of_as_soon_as_it_is_known() -> None:
    fake = FakeService()
    job = fake.job("e")
    stream = JobStream(Client("http://fake", transport=fake.transport), "e")
    heard: list[bool] = []
    stream.listeners.add(lambda: heard.append(stream.job is not None and not stream.records))
    stream.start()
    until(lambda: heard == [True], "the job")
    stream.stop()
    job.add(records(1)[0])


def test_a_broken_stream_is_taken_up_again_without_repeats(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(job_stream, "_RETRY_S", 0.05)
    fake = FakeService()
    job = fake.job("b", 4)
    whole, breaks = job.events, iter([True, False])

    def events() -> Iterator[bytes]:
        broken = next(breaks)
        for count, chunk in enumerate(whole()):
            if broken and count == 2:
                raise httpx.ReadError("cut")
            yield chunk

    monkeypatch.setattr(job, "events", events)
    stream = JobStream(Client("http://fake", transport=fake.transport), "b")
    errors: list[str] = []
    stream.listeners.add(lambda: errors.append(stream.error))
    stream.start()
    job.finish()
    until(lambda: stream.complete, "the end")
    assert any("cut" in e for e in errors)
    assert [r.index for r in stream.records] == [0, 1, 2, 3]
    assert stream.error == ""


def test_a_job_that_is_gone_is_reported_and_not_requested_again() -> None:
    fake = FakeService()
    stream = JobStream(Client("http://fake", transport=fake.transport), "gone")
    stream.start()
    until(lambda: stream.error and not threads("job-gone"), "the thread's end")
    assert stream.error == "Job gone not found or expired."
    assert fake.asked == ["/jobs/gone"]


@pytest.mark.parametrize("lists", [True, False])
def test_between_polls_and_between_retries_there_is_a_pause(lists: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    pause = 0.05
    monkeypatch.setattr(service_lists, "_POLL_S", pause)
    monkeypatch.setattr(job_stream, "_RETRY_S", pause)
    asked: list[float] = []

    def answer(request: httpx.Request) -> httpx.Response:
        if request.url.path != "/scenes":
            asked.append(time.monotonic())
        return httpx.Response(200, json={"jobs": [], "scenes": []}) if lists else httpx.Response(503)

    client = Client("http://fake", transport=httpx.MockTransport(answer))
    polled, stream = ServiceLists(client), JobStream(client, "d")
    polled.add_listener(lambda: None)
    (polled if lists else stream).start()
    until(lambda: len(asked) >= 4, "three pauses")
    polled.close()
    stream.stop()
    assert np.diff(asked).min() > 0.9 * pause


def test_a_stream_is_shared_and_ends_with_its_last_listener() -> None:
    fake = FakeService()
    fake.job("c", 1)
    shared = SharedData(Client("http://fake", transport=fake.transport))

    def one() -> None: ...
    def two() -> None: ...

    stream = shared.streams.follow("c", one)
    assert shared.streams.follow("c", two) is stream
    shared.streams.leave(stream, one)
    assert threads("job-c")
    shared.streams.leave(stream, two)
    until(lambda: not threads("job-c"), "the thread's end")
    assert shared.streams.follow("c", one) is not stream
    shared.close()


def test_data_are_shared_between_browsers_of_one_user_alone() -> None:
    fakes = {"ann": FakeService(), "bob": FakeService()}
    before = set(threads("job-list"))
    shared = SharedByToken(lambda token: Client("http://fake", transport=fakes[token].transport))
    first, second, bobs = shared.take("ann"), shared.take("ann"), shared.take("bob")
    assert first is second is not bobs
    bobs.scenes.get("ball")
    assert not fakes["ann"].asked
    assert len(set(threads("job-list")) - before) == 2
    shared.give_back("ann")
    assert shared.take("ann") is first
    for token in ("ann", "ann", "bob"):
        shared.give_back(token)
    assert len(shared) == 0
    until(lambda: not set(threads("job-list")) - before, "the threads' end")
    assert shared.take("ann") is not first
    shared.give_back("ann")


def test_pictures_and_scenes_are_fetched_once() -> None:
    fake = FakeService()
    fake.job("d", 3)
    shared = SharedData(Client("http://fake", transport=fake.transport))
    assert shared.scenes.get("ball") is shared.scenes.get("ball")
    stream = JobStream(shared.client, "d")
    pose, matched = stream.render(1, matched=False), stream.render(1, matched=True)
    for image, is_matched in ((pose, False), (matched, True)):
        # JPEG: 2 seen.
        assert np.abs(image.reshape(-1, 3).mean(0) - render_rgb(1, matched=is_matched)).max() < 4
    assert stream.render(1, matched=False) is pose
    photo = stream.photo()
    assert photo is not None
    assert stream.photo() is photo
    assert len(fake.asked) == len(set(fake.asked)) + 1  # the two renders have the same path


# ---------------------------------------------------------------- the photo over the view, points of the scene


VIEW = Camera(
    Intrinsics(400, 300, 250.0, 250.0, 200.0, 150.0), look_at(np.zeros(3), np.array([0.2, 0.1, 1]), -np.eye(3)[1])
)
LENS = Intrinsics(200, 120, 180.0, 190.0, 90.0, 65.0)


def dots(size: Intrinsics, pixels: np.ndarray) -> np.ndarray:
    """Black with a white dot around each pixel."""
    rows, columns = np.indices((size.height, size.width)) + 0.5
    near = [np.hypot(columns - x, rows - y) < 2.5 for x, y in pixels]
    return np.repeat(255 * np.any(near, 0).astype(np.uint8)[..., None], 3, 2)


def dot_in(image: np.ndarray) -> np.ndarray:
    """The centre of the only white dot."""
    rows, columns = np.nonzero(image[..., 0] > 128)
    return np.array([columns.mean(), rows.mean()]) + 0.5


@pytest.mark.parametrize("point", [(0.3, 0.2, 1.0), (-0.1, 0.0, 1.0), (0.4, -0.1, 1.0)])
def test_a_photo_over_a_view_shows_each_point_where_the_view_has_it(point: tuple[float, float, float]) -> None:
    camera = Camera(LENS, look_at(np.zeros(3), np.array([0.1, 0.0, 1.0]), np.array([0.3, -1.0, 0.0])))
    seen = [
        project(transformed(np.linalg.inv(c.pose.world_from_camera), np.array([point])), c.intrinsics)
        for c in (camera, VIEW)
    ]
    photo, below = dots(LENS, seen[0]), np.zeros((300, 400, 3), np.uint8)
    np.testing.assert_allclose(dot_in(images.with_photo(below, VIEW, photo, camera, 1.0)), seen[1][0], atol=0.5)
    white = np.full_like(below, 200)
    assert (images.with_photo(white, VIEW, photo, camera, 0.0) == 200).all()
    half = images.with_photo(white, VIEW, np.zeros_like(photo), camera, 0.5)
    assert set(np.unique(half[150:160, 200:210])) == {100}


@pytest.mark.parametrize("k1", [-0.2, 0.15])
def test_the_distortion_that_a_step_estimates_is_removed_from_the_photo(k1: float) -> None:
    x, y = 0.35, -0.22
    bent = 1 + k1 * (x * x + y * y)
    taken = dots(LENS, np.array([[LENS.fx * x * bent + LENS.cx, LENS.fy * y * bent + LENS.cy]]))
    straight = [LENS.fx * x + LENS.cx, LENS.fy * y + LENS.cy]
    np.testing.assert_allclose(dot_in(images.undistorted(taken, LENS, k1)), straight, atol=0.5)


def test_a_click_hits_the_first_surface_that_is_opaque() -> None:
    grid = np.stack(np.meshgrid(np.arange(-1, 1.01, 0.1), np.arange(-1, 1.01, 0.1)), -1).reshape(-1, 2)
    at = lambda z: np.c_[grid, np.full(len(grid), z)]  # noqa: E731
    flat = np.tile([0.01, 0, 0, 0.01, 0, 1e-8], (len(grid), 1))
    walls = [(1.0, 20), (3.0, 250), (4.0, 250)]  # the first is haze
    rgba = np.concatenate([np.tile([0, 0, 0, alpha], (len(grid), 1)) for _, alpha in walls]).astype(np.uint8)
    centres = np.concatenate([at(z) for z, _ in walls]).astype(np.float32)
    splats = Splats(centres, np.tile(flat, (3, 1)).astype(np.float32), rgba, len(rgba))
    for direction in ([0, 0, 1.0], [0.1, -0.2, 1.0]):
        hit = first_surface(np.zeros(3), np.array(direction), splats)
        assert hit is not None
        np.testing.assert_allclose(hit, 3 * np.array(direction), atol=1e-2)
    assert first_surface(np.zeros(3), np.array([0, 0, -1.0]), splats) is None
    assert first_surface(np.zeros(3), np.array([1.0, 0, 0.1]), splats) is None


@pytest.mark.parametrize(("limit", "length"), [(0.99, 0.5), (1.0, 1.0), (4.9, 2.0), (73.0, 50.0), (0.002, 0.002)])
def test_the_scale_is_a_round_length(limit: float, length: float) -> None:
    assert round_length(limit) == pytest.approx(length)
