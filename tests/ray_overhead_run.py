"""What the Ray engine costs a photo: the demo photos by the embedded engine and by Ray, in turn.

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python tests/ray_overhead_run.py [--rounds 3]

Both engines hold the scene, localize and let go on a thread, as a job's worker does, and libraries use one thread each,
as in `splatfix serve`. Prints JSON: the medians in milliseconds, that of the differences photo by photo, and where
Ray's time goes: to hold the scene, in the replica, and on the way (the rest of the call: sending photo, records and
answer). Needs the extra `ray`; the load of the machine is printed, too.
"""

from __future__ import annotations

import argparse
import json
import os
import pickle
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from service.jobs.embedded_engine import EmbeddedEngine, EngineConfig
from service.jobs.engine import Engine, HeldScenes, LocalizeTask
from service.jobs.ray_engine import RayConfig, RayEngine
from service.photos.images import read_query
from service.results import StageTiming
from service.scene_manager.status import StoredScene
from service.types import Query

STUDIO = Path(__file__).parents[1] / "scenes" / "studio"
CONFIG = EngineConfig("view_index")


@dataclass
class Times:
    """Seconds."""

    hold: float
    localize: float
    inside: float
    """In the engine's own process, by the estimate's stages."""
    cpu: float
    """Of that on the processor: another load of the machine doesn't change it much."""

    @property
    def total(self) -> float:
        return self.hold + self.localize


def task(held: HeldScenes, photo: Query) -> LocalizeTask:
    return LocalizeTask("t", held.token, "view_index", {}, 7, None, photo, StageTiming("decode", 0.0, 0.0))


def timed(engine: Engine, photo: Query) -> Times:
    began = time.perf_counter()
    held = engine.hold("studio")
    then = time.perf_counter()
    answer = engine.localize(task(held, photo), lambda record, shown: None)
    ended = time.perf_counter()
    engine.release(held.token)
    stages = answer.result.estimate.timings
    inside, cpu = sum(stage.wall_s for stage in stages), sum(stage.cpu_s for stage in stages)
    return Times(then - began, ended - then, inside, cpu)


def run(rounds: int) -> dict:
    engines: list[Engine] = [EmbeddedEngine(CONFIG), RayEngine(CONFIG, RayConfig(replicas=1))]
    for engine in engines:
        engine.add(StoredScene("studio", STUDIO), required=True)
        engine.start()
        while not engine.readiness().ready or engine.scene("studio").state != "ready":
            time.sleep(0.1)
    photos = [read_query(path.read_bytes()) for path in sorted(STUDIO.glob("photos/*.jpg"))]
    with ThreadPoolExecutor(1) as worker:

        def times(engine: Engine) -> list[Times]:
            worker.submit(timed, engine, photos[0]).result()  # compiles, and warms the caches after the other engine
            return [worker.submit(timed, engine, photo).result() for photo in photos]

        found = [pair for _ in range(rounds) for pair in zip(*map(times, engines), strict=True)]
    held = engines[1].hold("studio")
    sent = [pickle.dumps(task(held, photo), 5) for photo in photos]
    for engine in engines:
        engine.close()

    def ms(values) -> float:
        return round(1000 * median(values), 1)

    return {
        "photos": len(found),
        "embedded_ms": ms(own.total for own, _ in found),
        "ray_ms": ms(other.total for _, other in found),
        "difference_ms": ms(other.total - own.total for own, other in found),
        "hold_ms": ms(other.hold for _, other in found),
        "least_difference_ms": ms(_least(found, rounds)),
        "inside_ms": [ms(pair[k].inside for pair in found) for k in range(2)],
        "inside_cpu_ms": [ms(pair[k].cpu for pair in found) for k in range(2)],
        "on_the_way_ms": ms((other.localize - other.inside) - (own.localize - own.inside) for own, other in found),
        "task_bytes": round(median(map(len, sent))),
        "load": os.getloadavg(),
    }


def _least(found: list[tuple[Times, Times]], rounds: int) -> list[float]:
    """Return for each photo the difference of the fastest of its rounds: what another load of the machine leaves."""
    count = len(found) // rounds
    return [
        min(other.total for _, other in found[k::count]) - min(own.total for own, _ in found[k::count])
        for k in range(count)
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    rounds = parser.parse_args().rounds
    if os.environ.get("OPENBLAS_NUM_THREADS") != "1":  # its threads spin for a while after each use
        parser.error("set OMP_NUM_THREADS and OPENBLAS_NUM_THREADS to 1, as `splatfix serve` does.")
    print(json.dumps(run(rounds), indent=1))


if __name__ == "__main__":
    main()
