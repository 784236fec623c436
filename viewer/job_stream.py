"""A job's records as they arrive, with the images that belong to them, shared by all browsers that show the job."""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict
from collections.abc import Callable

import numpy as np
from jaxtyping import UInt8

from service import client as api
from service.client import Client, ServiceError
from service.results import IterationRecord
from viewer.comparison_images import decode
from viewer.match_geometry import BackprojectedMatches, backproject_matches
from viewer.service_values import Job, api_camera, job_of, record_of

log = logging.getLogger(__name__)

_IMAGES_KEPT = 64
"""Renders, and backprojected matches, of one job; an image at 1280 px takes 4 MB."""
_RETRY_S = 2.0

Listener = Callable[[], None]


class JobStream:
    """One job, followed by a background thread until it has ended.

    `records` is only ever appended to, and replaced by an empty list when the job is tried again, as after a crash of
    the service; it may be read from any thread. Listeners are called on the background thread after each change.
    """

    def __init__(self, client: Client, job_id: str) -> None:
        self.id = job_id
        self.attempt = 0
        """The attempt whose records these are; 0 before the first record."""
        self.records: list[IterationRecord] = []
        self.job: Job | None = None
        """As it was when the stream began, then as it ended; None before the first answer."""
        self.error = ""
        """Why no records arrive, as a sentence; empty while the stream works."""
        self.listeners: set[Listener] = set()
        self.complete = False
        """Whether all records and the outcome have arrived."""
        self._client = client
        self._stop = threading.Event()
        self._photo: UInt8[np.ndarray, "h w 3"] | None = None
        self._photo_requested = False
        self._renders: OrderedDict[tuple[int, bool], UInt8[np.ndarray, "h w 3"]] = OrderedDict()
        self._backprojected: OrderedDict[int, BackprojectedMatches] = OrderedDict()
        self._lock = threading.Lock()

    def start(self) -> None:
        """Start the background thread."""
        threading.Thread(target=self._follow, name=f"job-{self.id}", daemon=True).start()

    def stop(self) -> None:
        """End the background thread at the next event or ping of the service."""
        self._stop.set()

    def photo(self) -> UInt8[np.ndarray, "h w 3"] | None:
        """Return the job's photo, requested once; None if it was deleted after the job.

        Raises ServiceError, ValueError.
        """
        if not self._photo_requested:
            try:
                self._photo = decode(self._client.photo(self.id))
            except ServiceError as error:
                # Other errors may pass, and the photo is requested again.
                if error.status not in (404, 410):
                    raise
            self._photo_requested = True
        return self._photo

    def render(self, index: int, *, matched: bool) -> UInt8[np.ndarray, "h w 3"]:
        """Return the render of record `index`, from the cache or the service.

        `matched`: from the camera that the record's matches refer to instead of the record's pose.
        Raises ServiceError, ValueError.
        """
        key = index, matched
        with self._lock:
            if key in self._renders:
                self._renders.move_to_end(key)
                return self._renders[key]
        # Outside the lock: a request takes long, and two of the same image do no harm.
        image = decode(self._client.step_render(self.id, index, camera="matches" if matched else "pose"))
        with self._lock:
            self._renders[key] = image
            if len(self._renders) > _IMAGES_KEPT:
                self._renders.popitem(last=False)
        return image

    def matches(self, index: int) -> BackprojectedMatches | None:
        """Return the matches of record `index`, or else of the last record before it that has some.

        Raises ServiceError, ValueError.
        """
        record = next((r for r in reversed(self.records[: index + 1]) if r.matches is not None), None)
        if record is None or record.matches is None or self.job is None:
            return None
        with self._lock:
            if record.index in self._backprojected:
                return self._backprojected[record.index]
        depth = self._client.depth(self.job.scene, *api_camera(record.matches.render_camera))
        found = backproject_matches(record.matches, depth, record.index)
        with self._lock:
            self._backprojected[record.index] = found
            if len(self._backprojected) > _IMAGES_KEPT:
                self._backprojected.popitem(last=False)
        return found

    def _follow(self) -> None:
        while not self._stop.is_set() and not self.complete:
            try:
                self.job, self.error = job_of(self._client.job(self.id)), ""
                self._notify()
                for event in self._client.events(self.id):
                    if self._stop.is_set():
                        return
                    self._append(event.value())
            except (ServiceError, ValueError, KeyError) as error:
                gone = isinstance(error, ServiceError) and error.status == 404
                log.warning("job %s: %s", self.id, error)
                self.error = f"Job {self.id} not found or expired." if gone else str(error)
                self._notify()
                if gone:
                    return
                self._stop.wait(_RETRY_S)

    def _append(self, value: api.Record | api.Job | None) -> None:
        if value is None:  # a ping, or the end of an attempt
            return
        if isinstance(value, api.Job):
            self.job, self.complete = job_of(value), True
            if self.job.photo_step is not None:
                self._photo_requested = False  # while the job ran, the service returned the photo of another step
        else:
            record = record_of(value)
            if value.attempt != self.attempt:
                self._restart(value.attempt)
            if record.index != len(self.records):  # a stream that was resumed repeats the records from the first on
                return
            self.records.append(record)
        self._notify()

    def _restart(self, attempt: int) -> None:
        """Forget the records of the attempt before, and the images that belong to them."""
        with self._lock:
            self._renders.clear()
            self._backprojected.clear()
        self.attempt, self.records = attempt, []

    def _notify(self) -> None:
        # A copy, since another thread may add or remove one meanwhile.
        for listener in tuple(self.listeners):
            listener()


class JobStreams:
    """The streams of all jobs that some browser shows: one stream a job, which ends with its last listener."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._streams: dict[str, JobStream] = {}
        self._lock = threading.Lock()

    def follow(self, job_id: str, listener: Listener) -> JobStream:
        """Return the job's stream, started if it is new, and call `listener` at each change until `leave`."""
        with self._lock:
            stream = self._streams.get(job_id) or JobStream(self._client, job_id)
            stream.listeners.add(listener)
            if job_id not in self._streams:
                self._streams[job_id] = stream
                stream.start()
            return stream

    def leave(self, stream: JobStream, listener: Listener) -> None:
        """Remove a listener; without listeners the stream is stopped and its data are dropped."""
        with self._lock:
            stream.listeners.discard(listener)
            if not stream.listeners and self._streams.get(stream.id) is stream:
                stream.stop()
                del self._streams[stream.id]

    def close(self) -> None:
        """Stop all streams."""
        with self._lock:
            for stream in self._streams.values():
                stream.stop()

    def __len__(self) -> int:
        return len(self._streams)
