"""What operators see at `/metrics`, in Prometheus's form. The only file with prometheus_client."""

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
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.exposition import CONTENT_TYPE_LATEST

METRICS_TYPE = CONTENT_TYPE_LATEST
_SECONDS = (0.005, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 30, 60, 120)

Reading = Mapping[tuple[str, ...], float]
"""Values by labels."""


class Metrics:
    """One registry per app, so that several apps in a process don't mix."""

    def __init__(self) -> None:
        self._registry = registry = CollectorRegistry()
        ProcessCollector(registry=registry)
        PlatformCollector(registry=registry)
        self._requests = Counter("splatfix_requests", "HTTP requests", ["method", "route", "status"], registry=registry)
        self._request_s = Histogram(
            "splatfix_request_seconds", "Until the answer's end", ["route"], buckets=_SECONDS, registry=registry
        )
        self._jobs = Counter("splatfix_jobs", "Jobs that ended", ["estimator", "state", "status"], registry=registry)
        self._wait_s = Histogram(
            "splatfix_job_wait_seconds", "From acceptance to start", buckets=_SECONDS, registry=registry
        )
        self._job_s = Histogram(
            "splatfix_job_seconds", "From start to end", ["estimator"], buckets=_SECONDS, registry=registry
        )
        self._stage_s = Histogram(
            "splatfix_stage_seconds", "Of a job, by stage", ["estimator", "stage"], buckets=_SECONDS, registry=registry
        )
        self._renders = Counter("splatfix_renders", "Renders that jobs made", ["estimator"], registry=registry)
        self._render_s = Histogram(
            "splatfix_render_seconds",
            "Pictures for looking at, with their wait",
            ["scene"],
            buckets=_SECONDS,
            registry=registry,
        )

    def request(self, method: str, route: str, status: int, seconds: float) -> None:
        self._requests.labels(method if method in _METHODS else "other", route, status).inc()
        self._request_s.labels(route).observe(seconds)

    def started(self, waited_s: float) -> None:
        self._wait_s.observe(waited_s)

    def ended(self, estimator: str, state: str, status: str | None, seconds: float | None) -> None:
        """`status` is the result's; `seconds` since the start, None for a job that never started."""
        self._jobs.labels(estimator, state, status or "none").inc()
        if seconds is not None:
            self._job_s.labels(estimator).observe(seconds)

    def stage(self, estimator: str, stage: str, seconds: float) -> None:
        self._stage_s.labels(estimator, stage).observe(seconds)

    def renders(self, estimator: str, count: int) -> None:
        self._renders.labels(estimator).inc(count)

    def rendered(self, scene: str, seconds: float) -> None:
        self._render_s.labels(scene).observe(seconds)

    def gauge(self, name: str, text: str, labels: tuple[str, ...], read: Callable[[], Reading]) -> None:
        """Show values that are read when somebody asks."""
        self._registry.register(_Gauge(f"splatfix_{name}", text, labels, read))

    def exposition(self) -> bytes:
        return generate_latest(self._registry)


_METHODS = ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS")


class _Gauge:
    def __init__(self, name: str, text: str, labels: tuple[str, ...], read: Callable[[], Reading]) -> None:
        self._name, self._text, self._labels, self._read = name, text, labels, read

    def describe(self) -> list[GaugeMetricFamily]:
        return [GaugeMetricFamily(self._name, self._text, labels=self._labels)]

    def collect(self) -> Iterator[GaugeMetricFamily]:
        family = GaugeMetricFamily(self._name, self._text, labels=self._labels)
        for labels, value in self._read().items():
            family.add_metric(labels, value)
        yield family
