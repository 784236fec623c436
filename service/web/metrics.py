"""Metrics of the service in Prometheus text format, as `/metrics` returns them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

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

METRICS_TYPE = CONTENT_TYPE_LATEST
# From a rendered thumbnail to the longest searches.
_SECONDS = (0.005, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 30, 60, 120)

_FRAME_SECONDS = (0.005, 0.01, 0.02, 0.03, 0.045, 0.06, 0.08, 0.12, 0.2, 0.5, 1, 2)

GaugeValues = Mapping[tuple[str, ...], float]
"""Values of a gauge by the values of its labels."""


class Metrics:
    """Counters, histograms and gauges of one app."""

    def __init__(self) -> None:
        # Not the global registry: tests run several apps in one process.
        self._registry = registry = CollectorRegistry()
        ProcessCollector(registry=registry)
        PlatformCollector(registry=registry)
        self._requests = Counter("splatfix_requests", "HTTP requests", ["method", "route", "status"], registry=registry)
        self._request_s = Histogram(
            "splatfix_request_seconds",
            "Time from a request to the end of its response",
            ["route"],
            buckets=_SECONDS,
            registry=registry,
        )
        self._jobs = Counter("splatfix_jobs", "Finished jobs", ["estimator", "state", "status"], registry=registry)
        self._wait_s = Histogram(
            "splatfix_job_wait_seconds", "Time of a job from acceptance to start", buckets=_SECONDS, registry=registry
        )
        self._job_s = Histogram(
            "splatfix_job_seconds",
            "Time of a job from start to end",
            ["estimator"],
            buckets=_SECONDS,
            registry=registry,
        )
        self._stage_s = Histogram(
            "splatfix_stage_seconds",
            "Time of a job by stage",
            ["estimator", "stage"],
            buckets=_SECONDS,
            registry=registry,
        )
        self._renders = Counter("splatfix_renders", "Renders made by jobs", ["estimator"], registry=registry)
        self._render_s = Histogram(
            "splatfix_render_seconds",
            "Time to render an image for a client, including its wait",
            ["scene"],
            buckets=_SECONDS,
            registry=registry,
        )

        self._live_frames = Counter("splatfix_live_frames", "Frames of live sessions", ["outcome"], registry=registry)
        self._live_s = Histogram(
            "splatfix_live_answer_seconds",
            "Time from a frame's arrival to its answer, by the session's mode",
            ["mode"],
            buckets=_FRAME_SECONDS,
            registry=registry,
        )
        self._live_closed = Counter(
            "splatfix_live_closed", "Live sessions that ended, by close code", ["code"], registry=registry
        )

    def request(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count a request that was answered. `route` is the path with its parameters' names."""
        # Clients can invent methods: each would be a time series of its own.
        self._requests.labels(method if method in _METHODS else "other", route, status).inc()
        self._request_s.labels(route).observe(seconds)

    def started(self, waited_s: float) -> None:
        """Count a job that started, and its time in the queue."""
        self._wait_s.observe(waited_s)

    def ended(self, estimator: str, state: str, status: str | None, seconds: float | None) -> None:
        """Count a job that ended. `status` is its result's; `seconds` since its start, None if it never started."""
        self._jobs.labels(estimator, state, status or "none").inc()
        if seconds is not None:
            self._job_s.labels(estimator).observe(seconds)

    def stage(self, estimator: str, stage: str, seconds: float) -> None:
        """Count the time that a job spent on a stage."""
        self._stage_s.labels(estimator, stage).observe(seconds)

    def renders(self, estimator: str, count: int) -> None:
        """Count the renders of a job."""
        self._renders.labels(estimator).inc(count)

    def rendered(self, scene: str, seconds: float) -> None:
        """Count an image that was rendered for a client."""
        self._render_s.labels(scene).observe(seconds)

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

    def exposition_of(self, sees: Callable[[str], bool]) -> bytes:
        """Return the metrics of those scenes alone that `sees` is true of, in Prometheus text format."""
        return generate_latest(_ScenesAlone(self._registry, sees))


_METHODS = ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS")


class _ScenesAlone(Collector):
    """The samples of a registry that have a scene's name as a label, of scenes that may be seen."""

    def __init__(self, registry: CollectorRegistry, sees: Callable[[str], bool]) -> None:
        self._registry, self._sees = registry, sees

    def collect(self) -> Iterator[Metric]:
        for family in self._registry.collect():
            seen = [s for s in family.samples if "scene" in s.labels and self._sees(s.labels["scene"])]
            if seen:
                family.samples = seen
                yield family


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
