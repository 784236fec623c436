"""The parts of `splatfix bench gpu` that time: localization by stage, several jobs at a time, the view index."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import count

import numpy as np

from service.bench.gpu_runner import Row
from service.bench.gpu_shared import Shared
from service.interfaces import Tools
from service.loaded_scene import DEFAULT_ESTIMATOR, LoadedScene
from service.pose.retrieval.stored_index import prepared_index


def latency(shared: Shared) -> Iterator[Row]:
    """Yield for each renderer the milliseconds of a photo: of all of it, and by stage.

    From the photo's bytes to the verdict, one photo at a time; medians over all photos and repeats. A stage's median is
    over the photos that came to it. The first localization isn't counted.
    """
    for renderer, loaded in shared.both:
        shared.localize(shared.photos[0], loaded)
        whole: list[float] = []
        stages: dict[str, list[float]] = defaultdict(list)
        for photo in shared.photos * shared.work.repeats:
            began = time.perf_counter()
            estimate = shared.localize(photo, loaded)
            whole.append(1e3 * (time.perf_counter() - began))
            spent = {timing.stage: 1e3 * timing.wall_s for timing in estimate.timings}
            # Before the first record's clock: reading the photo.
            spent["decode"] = whole[-1] - sum(spent.values())
            for stage, ms in spent.items():
                stages[stage].append(ms)
        yield {
            "renderer": renderer,
            "localizations": len(whole),
            "ms_p50": float(np.median(whole)),
            "ms_p95": float(np.percentile(whole, 95)),
            "stages_ms_p50": {stage: float(np.median(times)) for stage, times in stages.items()},
            "stages_count": {stage: len(times) for stage, times in stages.items()},
        }


def throughput(shared: Shared) -> Iterator[Row]:
    """Yield for each renderer and number of jobs at a time the jobs that end in a second.

    Each job is a thread's, as in the service, and localizes the next of the photos.
    """
    for renderer, loaded in shared.both:
        loaded.prepare(DEFAULT_ESTIMATOR)
        for at_a_time in shared.work.at_a_time:
            jobs, seconds = _localize_for(shared, loaded, at_a_time, shared.work.throughput_s)
            yield {"renderer": renderer, "at_a_time": at_a_time, "jobs": jobs, "jobs_per_s": jobs / seconds}


def _localize_for(shared: Shared, loaded: LoadedScene, at_a_time: int, seconds: float) -> tuple[int, float]:
    """Localize photos until the time is over and the jobs begun have ended; return their number and the time taken."""
    numbers, began = count(), time.perf_counter()

    def work(_: int) -> int:
        done = 0
        # At least one, so that a slow renderer has a rate, too.
        while not done or time.perf_counter() - began < seconds:
            shared.localize(shared.photos[next(numbers) % len(shared.photos)], loaded)
            done += 1
        return done

    with ThreadPoolExecutor(at_a_time) as threads:
        jobs = sum(threads.map(work, range(at_a_time)))
    return jobs, time.perf_counter() - began


def index(shared: Shared) -> Iterator[Row]:
    """Yield for each renderer the time of making the view index, and of its renders alone, all in one call."""
    for renderer, loaded in shared.both:
        tools = Tools(loaded.scene, loaded.rasterizer, loaded.matcher, np.random.default_rng(0), None)
        began = time.perf_counter()
        made = prepared_index(tools, None)
        seconds = time.perf_counter() - began
        cameras = [view.camera for view in made.views]
        began = time.perf_counter()
        loaded.rasterizer.render(cameras)
        render_s = time.perf_counter() - began
        yield {
            "renderer": renderer,
            "views": len(cameras),
            "seconds": seconds,
            "views_per_s": len(cameras) / seconds,
            "renders_per_s": len(cameras) / render_s,
        }
