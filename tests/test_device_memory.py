"""The GPU memory budget that jobs share, and what the GPU's renderer does where memory is short; without a GPU."""

from __future__ import annotations

import threading
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from test_rasterizers import make_camera, make_scene, same

import service.matchers.xfeat_on_gpu as xfeat_on_gpu
import service.render.gsplat_cuda as gsplat_cuda
from service.device_memory import FREE_SHARE, DeviceMemory
from service.errors import DeviceMemoryFull
from service.jobs.embedded_engine import EmbeddedEngine, EngineConfig
from service.matchers import MATCHERS
from service.render.gsplat_cuda import CAMERAS_AT_ONCE, GsplatRasterizer
from service.web.problems import problem_of
from service.web.settings import Settings


def in_thread(memory: DeviceMemory, wanted: float) -> tuple[threading.Event, threading.Event, threading.Thread]:
    """A call that takes so much until it is let go: (has it, let go, thread)."""
    has, let_go = threading.Event(), threading.Event()

    def call() -> None:
        with memory.taken(wanted):
            has.set()
            let_go.wait(5)

    thread = threading.Thread(target=call)
    thread.start()
    return has, let_go, thread


def test_calls_wait_until_they_fit_and_in_their_order():
    memory = DeviceMemory()
    memory.set_budget(100)
    first, large, small = (in_thread(memory, wanted) for wanted in (60, 50, 10))
    assert first[0].wait(5)
    # 50 more are too much, and 10 would fit, but came later.
    assert not large[0].wait(0.05)
    assert not small[0].wait(0.05)
    first[1].set()
    assert large[0].wait(5)
    assert small[0].wait(5)
    for _, let_go, thread in (large, small):
        let_go.set()
        thread.join(5)


def test_more_than_the_budget_is_taken_alone():
    memory = DeviceMemory()
    memory.set_budget(100)
    first = in_thread(memory, 1)
    assert first[0].wait(5)
    larger = in_thread(memory, float("inf"))
    assert not larger[0].wait(0.05)
    first[1].set()
    assert larger[0].wait(5)
    larger[1].set()
    for _, _, thread in (first, larger):
        thread.join(5)
    with memory.taken(1):  # all was given back, after an error, too
        pass
    with pytest.raises(ZeroDivisionError), memory.taken(1):
        raise ZeroDivisionError
    with memory.taken(100):
        pass


def test_the_budget_is_what_was_set_else_a_share_of_what_is_free():
    memory = DeviceMemory()
    assert memory.budget_bytes == float("inf")
    memory.note_free(1000)
    assert memory.budget_bytes == FREE_SHARE * 1000
    memory.set_budget(10)
    assert memory.budget_bytes == 10


@pytest.fixture
def memory(monkeypatch: pytest.MonkeyPatch) -> DeviceMemory:
    found = DeviceMemory()
    for module in (gsplat_cuda, xfeat_on_gpu):
        monkeypatch.setattr(module, "DEVICE_MEMORY", found)
    return found


class Counting:
    """gsplat's stand-in, which keeps how many cameras each call had, and has room for so many of them."""

    def __init__(self, room: int = 1000) -> None:
        pytest.importorskip("gsplat", reason="gsplat is not installed")
        from gsplat_on_cpu import kernels

        self.true, self.room, self.calls = kernels(), room, []

    def rasterization(self, *args: Any, **kwargs: Any) -> Any:
        self.calls.append(len(kwargs["viewmats"]))
        if len(kwargs["viewmats"]) > self.room:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 1 GiB. GPU 0 has less.")
        return self.true.rasterization(*args, **kwargs)

    def put(self, scene: Any) -> GsplatRasterizer:
        return GsplatRasterizer(scene, torch.device("cpu"), self.true._replace(rasterization=self.rasterization))


@pytest.fixture(scope="module")
def scene():
    return make_scene(200, 1)


CAMERAS = [make_camera(32, 24, seed=seed) for seed in range(5)]


@pytest.mark.ci
def test_five_poses_are_one_call_and_equal_five_calls(scene, memory):
    counting = Counting()
    rasterizer = counting.put(scene)
    together = rasterizer.render(CAMERAS)
    assert counting.calls == [5]
    alone = [rasterizer.render([camera])[0] for camera in CAMERAS]
    assert all(same(a, b) for a, b in zip(together, alone, strict=True))
    counting.calls.clear()
    d_rgb = [np.full((24, 32, 3), np.float32(1 + k)) for k in range(5)]
    gradients = rasterizer.pose_gradients(CAMERAS, d_rgb)
    assert counting.calls == [5]
    for gradient, camera, each in zip(gradients, CAMERAS, d_rgb, strict=True):
        assert gradient == pytest.approx(rasterizer.pose_gradient(camera, each), rel=1e-5)
    # Of several sizes one by one.
    mixed = [CAMERAS[0], make_camera(40, 24)]
    d_rgb[1] = np.ones((24, 40, 3), np.float32)
    assert rasterizer.pose_gradients(mixed, d_rgb[:2])[1] == pytest.approx(
        rasterizer.pose_gradient(mixed[1], d_rgb[1]), rel=1e-6
    )


@pytest.mark.ci
def test_calls_are_as_large_as_the_budget_allows(scene, memory):
    counting = Counting()
    rasterizer = counting.put(scene)
    assert rasterizer.cameras_at_once == CAMERAS_AT_ONCE
    passes = gsplat_cuda.RAY_BYTES * gsplat_cuda.RAYS_AT_ONCE
    one = rasterizer._bytes_per_camera(32 * 24)
    # 250 bytes and 4 coefficients in 3 colours of 4 bytes for a Gaussian, 60 for a pixel.
    assert one == 200 * (250 + 4 * 3 * 4) + 60 * 32 * 24
    memory.set_budget(int((passes + 2.5 * one) / gsplat_cuda.BUDGET_SHARE))
    expected = rasterizer.render(CAMERAS)
    assert counting.calls == [2, 2, 1]
    memory.set_budget(1)
    assert rasterizer.cameras_at_once == 1
    assert all(same(a, b) for a, b in zip(expected, rasterizer.render(CAMERAS), strict=True))
    assert counting.calls[3:] == [1] * 5


@pytest.mark.ci
def test_a_call_without_memory_is_made_again_in_parts(scene, memory):
    full, counting = Counting(room=2), Counting()
    found = full.put(scene).render(CAMERAS)
    assert full.calls == [5, 2, 3, 1, 2]
    assert all(same(a, b) for a, b in zip(found, counting.put(scene).render(CAMERAS), strict=True))


def test_a_render_without_memory_is_an_error_that_says_what_helps(scene, memory):
    full = Counting(room=0)
    rasterizer = full.put(scene)
    camera = CAMERAS[0]
    ones = np.ones((24, 32, 3), np.float32)
    with pytest.raises(DeviceMemoryFull, match=r"too little memory left .*Unload scenes") as refused:
        rasterizer.render(CAMERAS[:2])
    assert full.calls == [2, 1, 1]  # together, then one alone, then that in smaller passes
    assert refused.value.code == "device_memory_full"
    assert problem_of(refused.value, "/").status == 503
    for gradient in (rasterizer.pose_gradient, rasterizer.scene_gradients):
        with pytest.raises(DeviceMemoryFull):
            gradient(camera, ones)
    full.room = 1
    rasterizer.render([camera])  # there is memory again


def test_the_median_depth_is_the_same_in_smaller_passes(scene, memory, monkeypatch):
    rasterizer = Counting().put(scene)
    whole = rasterizer.render(CAMERAS[:2])
    monkeypatch.setattr(gsplat_cuda, "RAYS_AT_ONCE", 100)
    assert all(same(a, b) for a, b in zip(whole, rasterizer.render(CAMERAS[:2]), strict=True))


def test_a_setting_is_the_budget(monkeypatch):
    told = []
    monkeypatch.setattr("service.jobs.embedded_engine.DEVICE_MEMORY", SimpleNamespace(set_budget=told.append))
    config = Settings(scenes=[], gpu_memory_bytes=12).engine_config
    EmbeddedEngine(replace(config, cache_dir=None)).close()
    EmbeddedEngine(EngineConfig()).close()
    assert told == [12, None]


@pytest.mark.ci
def test_features_of_renders_are_those_of_their_pixels(scene, memory, monkeypatch):
    """The GPU's matcher on the CPU: several renders at once, and halves of them where memory is short."""
    matcher = MATCHERS.load("xfeat").create_on("cpu")
    frames = Counting().put(make_scene(400, 0)).render([make_camera(96, 64, seed=seed) for seed in range(3)])
    alone = [matcher.extract(frame.device_rgb.numpy(), 100) for frame in frames]
    sizes, room, described = [], [3], matcher._described

    def limited(images):
        sizes.append(len(images))
        if len(images) > room[0]:
            raise torch.OutOfMemoryError
        return described(images)

    monkeypatch.setattr(matcher, "_described", limited)
    for most, calls in ((3, [3]), (2, [3, 1, 2])):
        sizes.clear()
        room[0] = most
        together = matcher.extract_rendered(frames, 100)
        assert sizes == calls
        for a, b in zip(alone, together, strict=True):
            assert len(a.scores) > 10
            assert np.array_equal(a.points_px, b.points_px)
            assert np.abs(a.descriptors - b.descriptors).max() < 1e-5
    room[0] = 0
    with pytest.raises(DeviceMemoryFull, match="for features"):
        matcher.extract_rendered(frames, 100)
