"""A large scene's view index in parts: what each part is, who waits for the whole, and which scene stays meanwhile."""

from __future__ import annotations

import threading
from dataclasses import replace
from functools import partialmethod
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from small_room import INTRINSICS, pose_at, write_room

from service.geometry import pose_distance
from service.interfaces import Tools
from service.loaded_scene import DEFAULT_ESTIMATOR, LoadedScene
from service.localize import Cancelled, Request, localize
from service.matchers import MATCHERS
from service.pose.features.rendered_views import to_uint8
from service.pose.retrieval.index import ViewIndex, WholeIndex
from service.pose.retrieval.index_builder import IndexBuilder, PartsConfig
from service.pose.retrieval.viewpoints import index_cameras
from service.results import Status
from service.scene_manager import entry as entry_module
from service.scene_manager.entry import Entry
from service.scene_manager.status import IndexStatus
from service.types import Camera, Intrinsics, Pose, Query

LENS = Intrinsics(**INTRINSICS)
PARTS = PartsConfig(first_views=2, min_views=12)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> LoadedScene:
    return LoadedScene.load(write_room(tmp_path_factory.mktemp("room") / "room", cameras=12))


def tools(room: LoadedScene) -> Tools[None]:
    return Tools(room.scene, room.rasterizer, MATCHERS.load("sift").create(), np.random.default_rng(0), None)


@pytest.fixture(scope="module")
def cameras(room: LoadedScene) -> list[Camera]:
    return index_cameras(room.scene, room.rasterizer, np.random.default_rng(0))


def test_an_index_of_many_views_grows_by_doubling_and_ends_as_if_built_at_once(room, cameras) -> None:
    published: list[int] = []

    class Watched(WholeIndex):
        def publish(self, part: ViewIndex) -> ViewIndex:
            published.append(len(part.views))
            return super().publish(part)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("service.pose.retrieval.index_builder.WholeIndex", Watched)
        part = IndexBuilder(cameras, tools(room)).first_part(lambda index: replace(index, is_cut=True), PARTS)
        assert part.whole is not None
        assert (len(part.views), part.whole.planned_views, part.is_cut) == (2, 12, False)
        assert part.repeats_itself  # as long as nobody looked
        assert part.whole.so_far() is part
        whole = part.whole.result()
    assert whole is not None
    assert published == [2, 4, 8]
    assert (len(whole.views), whole.whole, whole.is_cut) == (12, None, True)
    assert part.whole.so_far() is whole
    assert part.whole.result() is whole
    at_once = IndexBuilder(cameras, tools(room)).whole()
    assert (whole.repeats_itself, whole.like_its_mirror_image) == (False, False)
    assert (at_once.repeats_itself, at_once.like_its_mirror_image) == (False, False)
    assert np.array_equal(whole.corners.descriptors, at_once.corners.descriptors)
    for grown, own in zip(whole.views, at_once.views, strict=True):
        assert np.array_equal(grown.features.descriptors, own.features.descriptors)
        assert np.array_equal(grown.points_in_world, own.points_in_world)


def test_an_index_of_few_views_is_built_at_once(room, cameras) -> None:
    few = IndexBuilder(cameras[:11], tools(room)).first_part(lambda index: replace(index, is_cut=True), PARTS)
    assert (len(few.views), few.whole, few.is_cut) == (11, None, True)


def test_one_thread_builds_and_others_wait_for_it() -> None:
    going_on, building = threading.Event(), threading.Event()
    built: list[int] = []

    def build(publish) -> ViewIndex:
        building.set()
        assert going_on.wait(20)
        built.append(1)
        return SimpleNamespace(views=[1, 2])  # type: ignore[return-value]

    index = WholeIndex(2, build)
    assert index.so_far() is None
    thread = threading.Thread(target=index.result)
    thread.start()
    assert building.wait(20)
    assert index.result(0.01) is None
    going_on.set()
    assert index.result(20.0) is index.result()
    thread.join()
    assert built == [1]


def test_where_building_fails_the_next_one_who_needs_the_index_builds_it() -> None:
    outcomes = iter([MemoryError("full"), SimpleNamespace(views=[])])

    def build(publish) -> ViewIndex:
        outcome = next(outcomes)
        if isinstance(outcome, Exception):
            raise outcome
        return outcome  # type: ignore[return-value]

    index = WholeIndex(2, build)
    with pytest.raises(MemoryError):
        index.result()
    assert index.result(1.0) is not None


# ------------------------------------------------------------------ photos


@pytest.fixture
def growing(room: LoadedScene, monkeypatch: pytest.MonkeyPatch) -> LoadedScene:
    """The room with the first two views of its index."""
    monkeypatch.setattr(IndexBuilder, "first_part", partialmethod(IndexBuilder.first_part, config=PARTS))
    loaded = LoadedScene.of(room.scene)
    assert len(loaded.usable(DEFAULT_ESTIMATOR).views) == 2
    return loaded


def photo_at(room: LoadedScene, pose: Pose) -> Query:
    (frame,) = room.rasterizer.render([Camera(LENS, pose)])
    return Query(to_uint8(frame.rgb), LENS, "given", LENS)


def seen_and_unseen(loaded: LoadedScene) -> tuple[Pose, Pose]:
    """Return a pose near the first view, and one that none of the first views sees anything of."""
    axes = np.stack([view.camera.pose.axis_in_world for view in loaded.usable(DEFAULT_ESTIMATOR).views])
    # Not towards the middle of a wall: what lies in one plane says little of the lens.
    around = [pose_at(np.radians(angle), 0.05) for angle in range(15, 360, 30)]
    alike = np.array([(axes @ pose.axis_in_world).max() for pose in around])
    assert alike.min() < np.cos(np.radians(75))
    return around[int(np.argmax(alike))], around[int(np.argmin(alike))]


def test_a_photo_is_localized_by_the_first_views_and_the_answer_says_so(growing: LoadedScene) -> None:
    near, _ = seen_and_unseen(growing)
    found = localize(photo_at(growing, near), growing)
    assert found.verdict.status is Status.LOCALIZED
    assert max(pose_distance(found.pose, near)) < 0.2
    assert "await_index" not in {record.stage for record in found.records}
    assert any("2 of 12 views were searched" in warning for warning in found.warnings)
    assert len(growing.prepared(DEFAULT_ESTIMATOR).views) == 2
    growing.prepare(DEFAULT_ESTIMATOR)
    again = localize(photo_at(growing, near), growing)
    assert not any("views were searched" in warning for warning in again.warnings)


def test_a_photo_that_the_first_views_do_not_show_is_found_in_the_whole_index(growing: LoadedScene) -> None:
    _, unseen = seen_and_unseen(growing)
    found = localize(photo_at(growing, unseen), growing)
    assert found.verdict.status is Status.LOCALIZED
    assert max(pose_distance(found.pose, unseen)) < 0.2
    stages = [record.stage for record in found.records]
    # What takes long isn't tried in a part of the index.
    before = stages[: stages.index("await_index")]
    assert not {"retrieve_free_views", "sample_poses"} & set(before)
    assert not any("views were searched" in warning for warning in found.warnings)
    assert len(growing.prepared(DEFAULT_ESTIMATOR).views) == 12
    assert growing.prepare(DEFAULT_ESTIMATOR) is growing.prepared(DEFAULT_ESTIMATOR)


def test_a_job_that_waits_for_the_index_can_be_cancelled_and_ends_with_its_budget(growing: LoadedScene) -> None:
    _, unseen = seen_and_unseen(growing)
    whole = growing.usable(DEFAULT_ESTIMATOR).whole
    with whole._building:  # as the thread does that builds
        cancel = threading.Event()

        def cancel_then(record) -> None:
            if record.stage == "await_index":
                cancel.set()

        with pytest.raises(Cancelled):
            localize(photo_at(growing, unseen), growing, Request(cancel=cancel), cancel_then)
        short = localize(photo_at(growing, unseen), growing, Request(budget_s=3.0))
    assert short.budget_exhausted
    assert short.records[-1].stage == "await_index"
    assert short.verdict.status is not Status.LOCALIZED


def test_an_estimator_without_preparation_has_none(room: LoadedScene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.loaded_scene.ESTIMATORS.load", lambda name: SimpleNamespace())
    assert (room.usable("bare"), room.prepare("bare"), room.prepared("bare")) == (None, None, None)


# ------------------------------------------------------------------ the scene's status


def test_a_scene_tells_how_far_its_index_is(growing: LoadedScene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(entry_module, "estimated_bytes", lambda path: 1)
    entry = Entry("room", Path("room"), state="ready", loaded=growing)
    assert entry.status().index == IndexStatus(2, 12)
    growing.warnings += ("one",)
    growing.prepare(DEFAULT_ESTIMATOR)
    status = entry.status()
    assert (status.index, status.warnings) == (IndexStatus(12, 12), ("one",))
    bare = Entry("bare", Path("room"), state="preparing", loaded=LoadedScene.of(growing.scene))
    assert bare.status().index is None
