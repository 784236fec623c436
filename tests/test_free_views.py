"""Views beside the index: where they stand, and that photos which no view of the index is like are found by them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small_room import FOCAL, HEIGHT, SIZE, WIDTH, pose_at, write_room

from service.estimators.search_config import SEARCH
from service.geometry import look_at, pose_distance, project, transformed
from service.interfaces import Features
from service.loaded_scene import LoadedScene
from service.localize import Request, localize
from service.pose.features.rendered_views import View, to_uint8
from service.pose.matching.match_stages import MATCHING, match_candidates
from service.pose.retrieval.free_views import FREE_VIEWS, FreeViews, free_view_cameras
from service.pose.retrieval.view_files import read_views, write_views
from service.results import Status
from service.types import Camera, Intrinsics, Pose, Query

LENS = Intrinsics(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
CLOSE_UP = look_at(np.array([1.45, -0.2, 0.35]), np.array([2.0, 0.4, 0.55]), np.array([0.0, 0.0, 1.0]))
"""Before a wall that the cameras see from four times as far away, at an angle."""


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> LoadedScene:
    folder = tmp_path_factory.mktemp("room")
    return LoadedScene.load(write_room(folder / "room", cameras=10), cache_dir=folder / "cache")


def photo_at(room: LoadedScene, pose: Pose) -> Query:
    return Query(to_uint8(room.rasterizer.render([Camera(LENS, pose)])[0].rgb), LENS, "given", LENS)


def test_they_stand_in_the_room_and_are_the_same_each_time(room: LoadedScene) -> None:
    views = room.prepare("view_index").views
    few = replace(FREE_VIEWS, views_per_index_view=2)
    cameras = free_view_cameras(room.scene, room.rasterizer, views, config=few)
    again = free_view_cameras(room.scene, room.rasterizer, views, config=few)
    positions = np.array([camera.pose.position_in_world for camera in cameras])
    assert 8 <= len(cameras) <= 2 * len(views)
    assert np.all(np.abs(positions) < SIZE / 2)
    assert [c.pose.world_from_camera.tobytes() for c in cameras] == [c.pose.world_from_camera.tobytes() for c in again]
    # Upright, as the cameras are.
    assert all(camera.pose.world_from_camera[2, 1] < 0 for camera in cameras)


@pytest.mark.ci
def test_they_are_rendered_only_for_a_photo_that_needs_them_which_is_found(
    room: LoadedScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    index = room.prepare("view_index")
    seen = localize(photo_at(room, pose_at(0.3, 0.1)), room)
    assert seen.verdict.status is Status.LOCALIZED
    assert index.free_views._views is None

    close_up = photo_at(room, CLOSE_UP)
    without = localize(close_up, room, Request(config=replace(SEARCH, free_views=0)))
    assert without.verdict.status is Status.NOT_LOCALIZED
    assert index.free_views._views is None

    found = localize(close_up, room)
    assert found.verdict.status is Status.LOCALIZED
    assert {record.stage for record in found.records} >= {"retrieve_more_views", "retrieve_free_views"}
    degrees, units = pose_distance(found.pose, CLOSE_UP)
    assert degrees < 0.2
    assert units < 0.01

    made = index.free_views._views
    localize(close_up, room)
    assert index.free_views._views is made

    # Whoever loads the scene again reads them: nothing is rendered for them.
    monkeypatch.setattr("service.pose.retrieval.free_views.free_view_cameras", refuse)
    loaded_again = LoadedScene(room.scene, room.rasterizer, room.matcher, cache_dir=room.cache_dir)
    assert localize(close_up, loaded_again).pose.world_from_camera.tobytes() == found.pose.world_from_camera.tobytes()
    read = loaded_again.prepare("view_index").free_views._views
    assert read is not None
    for own, other in zip(made, read, strict=True):
        assert own.camera.pose.world_from_camera.tobytes() == other.camera.pose.world_from_camera.tobytes()
        assert np.array_equal(own.features.descriptors, other.features.descriptors)


def refuse(*_: object) -> None:
    raise AssertionError("rendered, not read")


def test_damaged_or_unwritable_files_cost_no_photo(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    view = View(
        Camera(LENS, CLOSE_UP),
        Features(*(np.ones(s, np.float32) for s in ((1, 2), 1, (1, 4)))),
        np.ones((1, 3), np.float32),
    )
    path = tmp_path / "views"
    write_views(path, [view], {})
    for damaged in (b"", b"no array"):
        (path / "counts.npy").write_bytes(damaged)
        assert read_views(path) is None
    write_views(path, [view], {"more": np.array(3)})
    views, stored = read_views(path) or ((), {})
    assert (len(views), views[0].camera.intrinsics, stored["more"]) == (1, LENS, 3)
    # A folder that is a file: nothing can be written there.
    FreeViews()._store(path / "more.npy" / "below", [view])
    assert "not stored" in caplog.text


class ByRow:
    """A matcher of features that belong together by their row."""

    name = "by row"

    def match(self, photo: Features, view: Features) -> np.ndarray:
        return np.stack([view.descriptors[:, 0].astype(int), np.arange(len(view.descriptors))], 1)


def test_chance_matches_of_other_views_never_veto_a_single_view() -> None:
    """40 of 300 matches with one view agree, and 42 of 2700 with all nine: a share that chance reaches."""
    rng = np.random.default_rng(0)
    truth = Pose(np.eye(4))
    points = np.stack([*rng.uniform(-1, 1, (2, 3000)), rng.uniform(2, 4, 3000)], 1)
    px = rng.uniform(0, [WIDTH, HEIGHT], (3000, 2))
    right = [*range(40), 300, 600]
    px[right] = project(transformed(np.eye(4), points[right]), LENS)
    photo = Features(px.astype(np.float32), np.ones(3000, np.float32), np.zeros((3000, 1), np.float32))
    views = [
        View(
            Camera(LENS, truth),
            Features(np.zeros((300, 2), np.float32), np.ones(300, np.float32), rows[:, None].astype(np.float32)),
            points[rows].astype(np.float32),
        )
        for rows in np.arange(2700).reshape(9, 300)
    ]
    images: Any = SimpleNamespace(query=Query(np.zeros((HEIGHT, WIDTH, 3), np.uint8), LENS, "given", LENS))
    images.matcher = ByRow()
    steps = match_candidates(photo, views, images, 4.0, MATCHING)
    records = []
    while True:
        try:
            records.append(next(steps))
        except StopIteration as end:
            found = end.value
            break
    assert records[-1].stage == "match_pooled"
    assert found is not None
    assert len(found.inlier) == 300
    assert 40 <= found.num_inliers < 50
    assert not MATCHING.may_be_chance(found)
    assert pose_distance(found.pose, truth)[1] < 0.05
