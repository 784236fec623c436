"""The service's lists of jobs and of scenes, polled while a browser is connected."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

from service.client import Client, ServiceError
from viewer.service_values import ListedJob, listed_job_of

log = logging.getLogger(__name__)

_POLL_S = 0.5
_JOBS_LISTED = 50

Listener = Callable[[], None]


class ServiceLists:
    """Polls on one background thread, never in viser's pool of callbacks, which long requests would exhaust."""

    def __init__(self, client: Client) -> None:
        self.jobs: tuple[ListedJob, ...] | None = None
        """Newest first; up to date while there are listeners; None before the first answer."""
        self.scenes: tuple[str, ...] = ()
        """Ids of the scenes in the service's memory."""
        self._client = client
        self._listeners: set[Listener] = set()
        self._has_listeners = threading.Event()
        self._closed = threading.Event()
        self._lock = threading.Lock()

    def start(self) -> None:
        """Start the background thread."""
        threading.Thread(target=self._poll, name="job-list", daemon=True).start()

    def close(self) -> None:
        """End the background thread at its next poll."""
        with self._lock:
            self._closed.set()
            self._has_listeners.set()

    def add_listener(self, listener: Listener) -> None:
        """Call `listener` on the background thread whenever one of the lists has changed, until `remove_listener`."""
        with self._lock:
            self._listeners.add(listener)
        self._has_listeners.set()

    def remove_listener(self, listener: Listener) -> None:
        """Remove a listener; without listeners polling pauses."""
        with self._lock:
            self._listeners.discard(listener)
            # The last listener may go after `close`, which the background thread must still notice.
            if not self._listeners and not self._closed.is_set():
                self._has_listeners.clear()

    def _lists(self) -> tuple[tuple[ListedJob, ...], tuple[str, ...]]:
        jobs = tuple(map(listed_job_of, self._client.jobs(limit=_JOBS_LISTED)))
        return jobs, tuple(scene.id for scene in self._client.scenes() if scene.gaussians is not None)

    def _poll(self) -> None:
        logged = ""
        # Without browsers the service gets no requests.
        while self._has_listeners.wait() and not self._closed.is_set():
            try:
                lists = self._lists()
                logged = ""
            except (ServiceError, ValueError, KeyError) as error:
                if str(error) != logged:  # once, not at every poll
                    logged = str(error)
                    log.warning("list of jobs: %s", error)
                lists = self.jobs, self.scenes
            if lists != (self.jobs, self.scenes):
                self.jobs, self.scenes = lists
                self._notify()
            self._closed.wait(_POLL_S)

    def _notify(self) -> None:
        with self._lock:
            listeners = tuple(self._listeners)
        for listener in listeners:
            listener()
