"""Metrics of the service in Prometheus text format, as `/metrics` returns them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Histogram,
    PlatformCollector,
    ProcessCollector,
    generate_latest,
)
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_LATEST
from prometheus_client.registry import Collector

from service.jobs.model import StoredJob

METRICS_TYPE = CONTENT_TYPE_LATEST
# From a rendered thumbnail to the longest searches.
_SECONDS = (0.005, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 30, 60, 120)

# Finest around the time between two frames of a camera.
_FRAME_SECONDS = (0.005, 0.01, 0.02, 0.03, 0.045, 0.06, 0.08, 0.12, 0.2, 0.5, 1, 2)

_MOST_VALUES = 100
_OTHERS = "(others)"

GaugeValues = Mapping[tuple[str, ...], float]
"""Values of a gauge by the values of its labels."""


class Metrics:
    """Counters, histograms and gauges of one app."""

    def __init__(self) -> None:
        # Not the global registry: tests run several apps in one process.
        self._registry = registry = CollectorRegistry()
        ProcessCollector(registry=registry)
        PlatformCollector(registry=registry)
        counter = partial(Counter, registry=registry)
        seconds = partial(Histogram, buckets=_SECONDS, registry=registry)
        self._requests = counter("splatfix_requests", "HTTP requests", ["method", "route", "status"])
        self._request_s = seconds(
            "splatfix_request_seconds", "Time from a request to the end of its response", ["route"]
        )
        self._jobs = counter("splatfix_jobs", "Finished jobs", ["estimator", "state", "status"])
        self._by_key = counter("splatfix_jobs_by_key", "Finished jobs by API key and scene", ["key", "scene", "state"])
        self._seconds_by_key = counter(
            "splatfix_job_seconds_by_key", "Time of workers by API key and scene", ["key", "scene"]
        )
        self._keys, self._scenes = _Bounded(), _Bounded()
        self._wait_s = seconds("splatfix_job_wait_seconds", "Time of a job from acceptance to start")
        self._job_s = seconds("splatfix_job_seconds", "Time of a job from start to end", ["estimator"])
        self._stage_s = seconds("splatfix_stage_seconds", "Time of a job by stage", ["estimator", "stage"])
        self._renders = counter("splatfix_renders", "Renders made by jobs", ["estimator"])
        self._render_s = seconds(
            "splatfix_render_seconds", "Time to render an image for a client, including its wait", ["scene"]
        )
        self._live_frames = counter("splatfix_live_frames", "Frames of live sessions", ["outcome"])
        self._live_s = Histogram(
            "splatfix_live_answer_seconds",
            "Time from a frame's arrival to its answer, by the session's mode",
            ["mode"],
            buckets=_FRAME_SECONDS,
            registry=registry,
        )
        self._live_closed = counter("splatfix_live_closed", "Live sessions that ended, by close code", ["code"])

    def request(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count a request that was answered. `route` is the path with its parameters' names."""
        # Clients can invent methods: each would be a time series of its own.
        self._requests.labels(method if method in _METHODS else "other", route, status).inc()
        self._request_s.labels(route).observe(seconds)

    def started(self, waited_s: float) -> None:
        """Count a job that started, and its time in the queue."""
        self._wait_s.observe(waited_s)

    def ended(self, job: StoredJob, seconds: float | None) -> None:
        """Count a job that ended, `seconds` after its start; None if it never started."""
        self._jobs.labels(job.estimator, job.state, job.status or "none").inc()
        key, scene = self._keys.label(_key_name(job.client)), self._scenes.label(job.scene)
        self._by_key.labels(key, scene, job.state).inc()
        if seconds is not None:
            self._job_s.labels(job.estimator).observe(seconds)
            self._seconds_by_key.labels(key, scene).inc(seconds)

    def stage(self, estimator: str, stage: str, seconds: float) -> None:
        """Count the time that a job spent on a stage."""
        self._stage_s.labels(estimator, stage).observe(seconds)

    def renders(self, estimator: str, count: int) -> None:
        """Count the renders of a job."""
        self._renders.labels(estimator).inc(count)

    def rendered(self, scene: str, seconds: float) -> None:
        """Count an image that was rendered for a client."""
        self._render_s.labels(self._scenes.label(scene)).observe(seconds)

    def live_frame(self, mode: str, status: str, seconds: float, dropped: int) -> None:
        """Count a frame of a live session that was answered, and those dropped before it."""
        self._live_frames.labels(status).inc()
        self._live_s.labels(mode).observe(seconds)
        if dropped:
            self._live_frames.labels("dropped").inc(dropped)

    def live_closed(self, code: int) -> None:
        """Count a live session that ended."""
        self._live_closed.labels(str(code)).inc()

    def gauge(self, name: str, text: str, labels: tuple[str, ...], read: Callable[[], GaugeValues]) -> None:
        """Add a gauge whose values are read at each scrape."""
        self._registry.register(_Gauge(f"splatfix_{name}", text, labels, read))

    def exposition(self) -> bytes:
        """Return all metrics in Prometheus text format."""
        return generate_latest(self._registry)

    def exposition_of(self, client: str, sees: Callable[[str], bool]) -> bytes:
        """Return what one key may see, in the same format: its own jobs, and the scenes that `sees` is true of."""
        return generate_latest(_Seen(self._registry, _key_name(client), sees))


_METHODS = ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS")


class _Seen(Collector):
    """The samples of a registry that are of a scene that may be seen, and if they are of a key, of one's own."""

    def __init__(self, registry: CollectorRegistry, key: str, sees: Callable[[str], bool]) -> None:
        self._registry, self._key, self._sees = registry, key, sees

    def collect(self) -> Iterator[Metric]:
        for family in self._registry.collect():
            family.samples = [sample for sample in family.samples if self._shows(sample.labels)]
            if family.samples:
                yield family

    def _shows(self, labels: Mapping[str, str]) -> bool:
        of_scene = "scene" in labels and labels["scene"] != _OTHERS and self._sees(labels["scene"])
        return of_scene and labels.get("key", self._key) == self._key


class _Bounded:
    """The values of a label: the first ones by name, all later ones together, since each is a time series for ever."""

    def __init__(self) -> None:
        self._known: set[str] = set()

    def label(self, value: str) -> str:
        if len(self._known) < _MOST_VALUES:
            self._known.add(value)
        return value if value in self._known else _OTHERS


def _key_name(client: str) -> str:
    """Return the name of the key that a client is; the same for all clients without a key."""
    # Of `key:NAME:ID`. Addresses would be a value each.
    return client.split(":")[1] if client.startswith("key:") else "none"


class _Gauge:
    """A collector: prometheus_client calls `collect` at each scrape."""

    def __init__(self, name: str, text: str, labels: tuple[str, ...], read: Callable[[], GaugeValues]) -> None:
        self._name, self._text, self._labels, self._read = name, text, labels, read

    def describe(self) -> list[GaugeMetricFamily]:
        return [GaugeMetricFamily(self._name, self._text, labels=self._labels)]

    def collect(self) -> Iterator[GaugeMetricFamily]:
        family = GaugeMetricFamily(self._name, self._text, labels=self._labels)
        for labels, value in self._read().items():
            family.add_metric(labels, value)
        yield family
