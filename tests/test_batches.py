"""Renders of many poses in one call: who asks for them, and that what comes out is what single renders lead to."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace

import numpy as np
import pytest
from small_room import INTRINSICS, pose_at, write_room

from service.estimators import ambiguity_check, mc_do, pnerf, search_state, view_index
from service.estimators.search_config import SEARCH
from service.geometry import moved
from service.interfaces import Frame, Rasterizer, RenderTally, Tools
from service.matchers import MATCHERS
from service.pose.absolute_pose.pnp import AbsolutePose
from service.pose.features.image_sizes import sized
from service.pose.features.rendered_views import ViewRenderer, camera_of, to_uint8
from service.pose.features.scene_focus import focus_of_scene
from service.pose.retrieval.free_views import free_view_cameras
from service.pose.retrieval.index import ViewIndex
from service.pose.retrieval.index_builder import IndexBuilder
from service.render.cpu import CpuRasterizer
from service.render.render_counter import Counted
from service.scene_formats import load_scene
from service.types import NO_CORRECTION, Camera, GaussianScene, Intrinsics, Query

LENS = Intrinsics(**INTRINSICS).resized(160, 120)
TRUTH = pose_at(0.4, 0.1)


class InBatches(CpuRasterizer):
    """The CPU's renderer, as if it were one that renders six cameras best; keeps how many each call had."""

    def __init__(self, scene: GaussianScene) -> None:
        super().__init__(scene)
        self.calls: list[int] = []

    @property
    def cameras_at_once(self) -> int:
        return 6

    def render(self, cameras: Sequence[Camera], *rest, **named) -> list[Frame]:
        self.calls.append(len(cameras))
        return super().render(cameras, *rest, **named)

    def pose_gradients(self, cameras, d_rgb):
        self.calls.append(-len(cameras))
        return super().pose_gradients(cameras, d_rgb)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> GaussianScene:
    return load_scene(write_room(tmp_path_factory.mktemp("room")))


@pytest.fixture(scope="module")
def index(scene: GaussianScene) -> ViewIndex:
    cameras = [Camera(LENS, named.camera.pose) for named in scene.cameras[:8]]
    return IndexBuilder(cameras, tools_of(CpuRasterizer(scene))).whole()


def tools_of(rasterizer: Rasterizer, prepared: object = None) -> Tools:
    matcher = MATCHERS.load("sift").create()
    return Tools(rasterizer.scene, rasterizer, matcher, np.random.default_rng(0), prepared)  # type: ignore[attr-defined]


def query_of(scene: GaussianScene, **options) -> Query:
    (frame,) = CpuRasterizer(scene).render([Camera(LENS, TRUTH)])
    return Query(to_uint8(frame.rgb), LENS, "given", LENS, **options)


def test_an_index_is_rendered_in_batches(scene, index):
    batched = InBatches(scene)
    again = IndexBuilder([view.camera for view in index.views], tools_of(batched)).whole()
    assert batched.calls[:2] == [6, 2]
    for a, b in zip(index.views, again.views, strict=True):
        assert np.array_equal(a.features.descriptors, b.features.descriptors)
        assert np.array_equal(a.points_in_world, b.points_in_world)
    assert np.array_equal(index.corners.descriptors, again.corners.descriptors)
    assert index.like_its_mirror_image == again.like_its_mirror_image


def test_free_views_are_chosen_from_renders_in_batches(scene, index, monkeypatch):
    monkeypatch.setattr("service.pose.retrieval.free_views.lod_proxy", lambda scene, rasterizer, rng: rasterizer)
    batched = InBatches(scene)
    found = [free_view_cameras(scene, rasterizer, index.views[:1]) for rasterizer in (CpuRasterizer(scene), batched)]
    one_by_one, together = ([camera.pose.world_from_camera.tolist() for camera in each] for each in found)
    assert batched.calls == [6] * 7  # 6 views, and 7 candidates for each
    assert one_by_one == together


def records_of(run, rasterizer: Rasterizer, prepared: object, query: Query, options: object) -> list:
    return list(run(query, tools_of(rasterizer, prepared), options))


def test_the_supplements_hypotheses_are_rendered_in_batches(scene, index):
    options = mc_do.Options(hypotheses=8, rounds=0, iterations=0, refinement_steps=0, hypothesis_px=128)
    query, found = query_of(scene, prior=moved(TRUTH, np.full(6, 0.05))), []
    batched = InBatches(scene)
    for rasterizer in (CpuRasterizer(scene), batched):
        prepared = mc_do.Prepared(focus_of_scene(scene, CpuRasterizer(scene)), rasterizer, (TRUTH,))
        found.append(records_of(mc_do.run, rasterizer, prepared, query, options))
    assert batched.calls[0] == 6
    assert_same_records(*found)


def test_pnerfs_hypotheses_descend_in_batches(scene):
    options = pnerf.Options(hypotheses=7, steps=2, long_side_px=48)
    query, found = query_of(scene, prior=moved(TRUTH, np.full(6, 0.02))), []
    batched = InBatches(scene)
    for rasterizer in (CpuRasterizer(scene), batched):
        focus = focus_of_scene(scene, CpuRasterizer(scene))
        found.append(records_of(pnerf.run, rasterizer, focus, query, options))
    assert batched.calls == [6, -6, 1, -1] * 2
    assert_same_records(*found)


def assert_same_records(one_by_one: list, batched: list) -> None:
    assert len(one_by_one) == len(batched) > 2
    for a, b in zip(one_by_one, batched, strict=True):
        assert (a.stage, a.loss, a.num_matches, a.num_inliers) == (b.stage, b.loss, b.num_matches, b.num_inliers)
        assert np.array_equal(a.pose.world_from_camera, b.pose.world_from_camera)


def test_sampled_poses_and_free_views_are_rendered_in_batches(scene, index, monkeypatch):
    """A stage that ends early has not rendered more than the batch it was in."""

    def matched(views, *rest, **named):
        return list(views)
        yield

    monkeypatch.setattr(view_index, "_match_and_refine", matched)
    batched = InBatches(scene)
    state = search_state.SearchState.of(query_of(scene), tools_of(batched, index), SEARCH)
    variant = view_index.ImageVariant(160)
    stage = view_index._sample_poses(variant, state)
    next(stage)
    assert batched.calls == [6]
    for _ in range(6):
        next(stage)
    assert batched.calls == [6, 2]
    batched.calls.clear()
    cameras = [view.camera for view in index.views]
    untried = view_index.deque(range(8))
    stage = view_index._search_free_views(cameras, np.ones(8), untried, variant, state)
    next(stage)
    with pytest.raises(StopIteration) as end:
        next(stage)
    assert [view.camera for view in end.value.value] == cameras
    assert batched.calls == [6, 2]
    assert not untried


def test_first_renders_of_several_candidates_are_made_in_one_call(scene, index):
    """Refinement takes them from there; with a renderer of single images nothing is rendered before it is needed."""
    candidates = [AbsolutePose(moved(TRUTH, np.full(6, 0.01 * k)), np.ones(20, bool), NO_CORRECTION) for k in range(3)]
    for make, calls in ((InBatches, [3]), (CpuRasterizer, [])):
        rasterizer = make(scene)
        tally = RenderTally()
        tools = tools_of(rasterizer, index)
        tools = Tools(scene, Counted(rasterizer, tally), tools.matcher, tools.rng, index)
        state = search_state.SearchState.of(query_of(scene), tools, SEARCH)
        answer = SimpleNamespace(refined=SimpleNamespace(correction=NO_CORRECTION))
        taken = ambiguity_check.rendered_ahead(state, candidates, answer)  # type: ignore[arg-type]
        first = next(taken)
        assert first is candidates[0]
        assert getattr(rasterizer, "calls", []) == calls
        assert tally.count == sum(calls)
        camera = camera_of(state.images.query, first.pose, SEARCH.refinement.first_render_px)
        rendered = state.renderer.near(camera)
        (alone,) = CpuRasterizer(scene).render([camera])
        assert np.array_equal(rendered.frame.rgb, alone.rgb)
        assert getattr(rasterizer, "calls", []) == calls


def test_a_render_ahead_is_used_for_its_own_camera_only(scene):
    rasterizer = InBatches(scene)
    renderer = ViewRenderer(rasterizer)
    here, there = (Camera(LENS, moved(TRUTH, np.full(6, step))) for step in (0.0, 0.1))
    renderer.render_ahead([here])
    assert renderer.render(here) is renderer.render(here)
    assert rasterizer.calls == [1]
    smaller = Camera(sized(LENS, 80), here.pose)
    for other in (there, smaller):
        assert renderer.render(other).camera is other
    assert rasterizer.calls == [1, 1, 1]


def test_batches_ask_for_no_item_before_its_batch():
    from service.pose.features.rendered_views import in_batches

    asked = []
    batches = in_batches((asked.append(k) or k for k in range(5)), 2)
    assert next(batches) == [0, 1]
    assert asked == [0, 1]
    assert list(batches) == [[2, 3], [4]]
