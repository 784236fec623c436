"""A fleet of replicas, simulated event by event: what scenes, memory and failures do to latency.

The decisions are `service.jobs.placement`'s own; time is not slept but jumped over. A replica is one core: it makes one
job after the other, and beside them one load after the other. Jobs arrive at random (Poisson) and ask for scenes by
Zipf's law; replicas die at random, and their jobs are made again elsewhere.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from service.jobs.placement import Placement, PlacementConfig


@dataclass(frozen=True, slots=True)
class FleetModel:
    """What is simulated; times in seconds."""

    replicas: int
    scenes: int
    jobs: int = 5000
    """To simulate, beginning with full memories; the first fifth, until copies have settled, isn't counted."""
    utilization: float = 0.6
    """Share of the replicas' time that jobs take: sets how often they arrive."""
    zipf: float = 1.0
    """A scene's share of the jobs falls with this power of its rank."""
    scenes_in_memory: int = 20
    """Of each replica."""
    service_s: float = 0.11
    """A job: the median of the demo photos on the machine of docs/scale.md, exponentially distributed around it."""
    load_s: float = 4.0
    """A load with its preparation, from the cache: as measured with the demo scene."""
    failures_per_hour: float = 0.0
    """Of each replica."""
    restart_s: float = 5.0
    """Until another replica takes the place of one that died."""
    seed: int = 0


@dataclass(frozen=True, slots=True)
class FleetFigures:
    """What came of it; latencies from arrival to end, in seconds."""

    p50_s: float
    p95_s: float
    p99_s: float
    loads_per_job: float
    found_share: float
    """Of the jobs whose scene was in some memory: those that went there."""
    busy_share: float
    """Of the replicas' time."""
    repeated: int
    """Attempts that were lost with their replica."""
    ended: int


@dataclass(slots=True)
class _Job:
    number: int
    scene: str
    arrived: float
    service_s: float


@dataclass(slots=True)
class _Core:
    waiting: deque[_Job] = field(default_factory=deque)
    running: _Job | None = None
    loads_until: float = 0.0
    awaited: dict[str, list[_Job]] = field(default_factory=dict)
    """Jobs that wait for a load."""


_SIZE = 1_000_000
"""Bytes of a scene; all are of one size."""


class FleetSimulation:
    """One run of a model."""

    def __init__(self, model: FleetModel) -> None:
        self._model, self._rng = model, np.random.default_rng(model.seed)
        budget = model.scenes_in_memory * _SIZE
        load_s = model.load_s - _SIZE / PlacementConfig().load_bytes_per_s
        self._table = Placement(PlacementConfig(budget, service_s=model.service_s, load_s=load_s))
        self._cores: dict[str, _Core] = {}
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._turn: deque[_Job] = deque()
        """Jobs that no replica has room for."""
        self._now, self._count, self._started = 0.0, 0, 0
        self._ends: dict[int, float] = {}
        self._loads = self._there = self._found = self._repeated = 0
        self._busy_s = 0.0

    def run(self) -> FleetFigures:
        """Simulate until all jobs have ended."""
        model = self._model
        for scene in range(model.scenes):
            self._table.expect(f"s{scene}", _SIZE)
        for _ in range(model.replicas):
            self._add_replica()
        self._fill()
        weights = 1.0 / np.arange(1, model.scenes + 1) ** model.zipf
        wanted = self._rng.choice(model.scenes, model.jobs, p=weights / weights.sum())
        gaps = self._rng.exponential(model.service_s / (model.replicas * model.utilization), model.jobs)
        times = np.cumsum(gaps)
        jobs = [
            _Job(number, f"s{scene}", float(at), float(took))
            for number, (scene, at, took) in enumerate(
                zip(wanted, times, self._rng.exponential(model.service_s, model.jobs), strict=True)
            )
        ]
        for job in jobs:
            self._at(job.arrived, lambda job=job: self._arrive(job))
        if model.failures_per_hour:
            self._plan_failure()
        while len(self._ends) < model.jobs:
            self._now, _, act = heapq.heappop(self._events)
            act()
        return self._figures(jobs)

    def _fill(self) -> None:
        """Load the most popular scenes, one each in turn, until all memories are full: as after hours of service."""
        names = sorted(self._cores)
        room = min(self._model.scenes, self._model.replicas * self._model.scenes_in_memory)
        for scene in reversed(range(room)):
            self._table.loaded(names[scene % len(names)], f"s{scene}", _SIZE)

    # ------------------------------------------------------------------ events

    def _at(self, time_s: float, act: Callable[[], None]) -> None:
        self._count += 1  # events at one time happen in the order in which they were planned
        heapq.heappush(self._events, (time_s, self._count, act))

    def _arrive(self, job: _Job) -> None:
        if self._turn or not self._place(job):
            self._turn.append(job)

    def _serve_waiting(self) -> None:
        """Place the jobs that no replica had room for, in their order, up to the first that still has to wait."""
        while self._turn and self._place(self._turn[0]):
            self._turn.popleft()

    def _place(self, job: _Job) -> bool:
        """Give a job to a replica; return False if none has room for its scene."""
        there = self._table.copies(job.scene)
        choice = self._table.choose((job.scene,))
        if choice is None:
            return False
        if job.number >= self._model.jobs // 5:
            self._there += bool(there)
            self._found += choice.replica in there
            self._loads += len(choice.load)
        self._table.take(choice, (job.scene,))
        core = self._cores[choice.replica]
        if choice.load:
            self._load(choice.replica, core, job.scene)
        extra = self._table.extra_copy(job.scene)
        if extra:
            self._table.take(extra, (job.scene,))
            self._load(extra.replica, self._cores[extra.replica], job.scene, beside=True)
            self._loads += job.number >= self._model.jobs // 5
        if job.scene in core.awaited:
            core.awaited[job.scene].append(job)
        else:
            core.waiting.append(job)
            self._go_on(choice.replica, core)
        return True

    def _load(self, name: str, core: _Core, scene: str, *, beside: bool = False) -> None:
        """Plan the end of a load; of one beside the jobs, with the place that it takes in the table."""
        core.awaited[scene] = []
        core.loads_until = max(core.loads_until, self._now) + self._model.load_s
        self._at(core.loads_until, lambda: self._loaded(name, core, scene, beside))

    def _loaded(self, name: str, core: _Core, scene: str, beside: bool) -> None:
        if self._cores.get(name) is not core:
            return  # it died meanwhile
        self._table.loaded(name, scene, _SIZE)
        if beside:
            self._table.release(name, (scene,))
        core.waiting.extend(core.awaited.pop(scene))
        self._go_on(name, core)

    def _go_on(self, name: str, core: _Core) -> None:
        """Let a replica begin its next job, if it has none under way."""
        if core.running is None and core.waiting:
            job = core.running = core.waiting.popleft()
            self._at(self._now + job.service_s, lambda: self._end(name, core, job))

    def _end(self, name: str, core: _Core, job: _Job) -> None:
        if core.running is not job or self._cores.get(name) is not core:
            return
        core.running = None
        self._busy_s += job.service_s
        self._ends[job.number] = self._now
        self._table.release(name, (job.scene,))
        self._go_on(name, core)
        self._serve_waiting()

    def _add_replica(self) -> None:
        self._started += 1
        name = f"r{self._started:05}"
        self._table.add_replica(name)
        self._cores[name] = _Core()

    def _plan_failure(self) -> None:
        rate = self._model.failures_per_hour * self._model.replicas / 3600
        self._at(self._now + float(self._rng.exponential(1 / rate)), self._fail)

    def _fail(self) -> None:
        """Let a replica die; its jobs arrive anew, and another one starts after a while."""
        self._plan_failure()
        if not self._cores:
            return
        name = sorted(self._cores)[int(self._rng.integers(len(self._cores)))]
        core = self._cores.pop(name)
        self._table.remove_replica(name)
        lost = [*([core.running] if core.running else []), *core.waiting]
        lost += [job for jobs in core.awaited.values() for job in jobs]
        self._repeated += len(lost)
        self._at(self._now + self._model.restart_s, self._restart)
        for job in lost:
            self._arrive(job)

    def _restart(self) -> None:
        self._add_replica()
        self._serve_waiting()

    def _figures(self, jobs: list[_Job]) -> FleetFigures:
        counted = jobs[len(jobs) // 5 :]
        took = np.array([self._ends[job.number] - job.arrived for job in counted])
        p50, p95, p99 = (float(value) for value in np.quantile(took, [0.5, 0.95, 0.99]))
        return FleetFigures(
            *(p50, p95, p99),
            loads_per_job=self._loads / len(counted),
            found_share=self._found / self._there if self._there else 1.0,
            busy_share=self._busy_s / (self._model.replicas * self._now),
            repeated=self._repeated,
            ended=len(self._ends),
        )


FLEETS = (
    FleetModel(2, 8, scenes_in_memory=4),
    FleetModel(10, 10),
    FleetModel(10, 100),
    FleetModel(10, 200),
    FleetModel(10, 1000),
    FleetModel(100, 1000, jobs=20_000),
    FleetModel(100, 10_000, jobs=20_000),
    FleetModel(100, 1000, jobs=20_000, failures_per_hour=20.0),
)
"""What `splatfix bench fleet` prints a row for."""


def run(progress: Callable[[FleetModel], object] = lambda model: None) -> list[tuple[FleetModel, FleetFigures]]:
    """Simulate each of FLEETS; `progress` is called before each."""
    rows = []
    for model in FLEETS:
        progress(model)
        rows.append((model, FleetSimulation(model).run()))
    return rows
