"""What several browsers share: the jobs' records as they come, their pictures, and the scenes.

One background thread follows each job that somebody looks at, and one the list of jobs; never viser's own
pool of callbacks, which long work would starve. When nobody looks any more, the thread ends and the data are
dropped.
"""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from service.results import IterationRecord
from viewer.comparison_images import decode
from viewer.frusta import Extent, extent
from viewer.match_geometry import BackprojectedMatches, backproject_matches
from viewer.service_client import JobSummary, JobView, SceneView, ServiceClient, ServiceError, Splats

log = logging.getLogger(__name__)

MAX_SPLATS = 400_000
"""Drawn of a scene: 13 MB a browser, smooth on an integrated GPU."""
_RENDERS_KEPT = 64
_SCENES_KEPT = 2
_POLL_S = 0.5

Listener = Callable[[], None]


class JobStream:
    """One job: grows while it runs. `records` is only ever appended to; read it from any thread."""

    def __init__(self, service: ServiceClient, job_id: str) -> None:
        self.id = job_id
        self.records: list[IterationRecord] = []
        self.job: JobView | None = None
        """As it was at the start; with its answer once finished. None: not known yet."""
        self.trouble = ""
        """Why nothing comes, in words; empty while all is well."""
        self.listeners: set[Listener] = set()
        self.complete = False
        """All records are here, and the answer."""
        self._service = service
        self._stop = threading.Event()
        self._photo: UInt8[np.ndarray, "h w 3"] | None = None
        self._asked_photo = False
        self._renders: OrderedDict[tuple[int, bool], UInt8[np.ndarray, "h w 3"]] = OrderedDict()
        self._lifted: OrderedDict[int, BackprojectedMatches] = OrderedDict()
        self._lock = threading.Lock()

    def start(self) -> None:
        threading.Thread(target=self._follow, name=f"feed-{self.id}", daemon=True).start()

    def stop(self) -> None:
        """Let the thread end at the next event or ping."""
        self._stop.set()

    def photo(self) -> UInt8[np.ndarray, "h w 3"] | None:
        """Return the job's photo, asked for once; None: it was deleted after the job.

        Raises ServiceError, ValueError.
        """
        if not self._asked_photo:
            try:
                self._photo = decode(self._service.photo(self.id))
            except ServiceError as trouble:
                if trouble.status not in (404, 410):
                    raise
            self._asked_photo = True
        return self._photo

    def render(self, index: int, *, matched: bool) -> UInt8[np.ndarray, "h w 3"]:
        """Return a record's render, one of the last few or fetched. Raises ServiceError, ValueError."""
        key = index, matched
        with self._lock:
            if key in self._renders:
                self._renders.move_to_end(key)
                return self._renders[key]
        image = decode(self._service.render(self.id, index, matched=matched))
        with self._lock:
            self._renders[key] = image
            if len(self._renders) > _RENDERS_KEPT:
                self._renders.popitem(last=False)
        return image

    def matches(self, index: int) -> BackprojectedMatches | None:
        """Return the latest matches that a step knows: its own, or an earlier one's.

        Raises ServiceError, ValueError.
        """
        record = next((r for r in reversed(self.records[: index + 1]) if r.matches is not None), None)
        if record is None or record.matches is None or self.job is None:
            return None
        with self._lock:
            if record.index in self._lifted:
                return self._lifted[record.index]
        depth = self._service.depth(self.job.scene, record.matches.render_camera)
        found = backproject_matches(record.matches, depth, record.index)
        with self._lock:
            self._lifted[record.index] = found
            if len(self._lifted) > _RENDERS_KEPT:
                self._lifted.popitem(last=False)
        return found

    def _follow(self) -> None:
        while not self._stop.is_set() and not self.complete:
            try:
                self.job, self.trouble = self._service.job(self.id), ""
                self._tell()
                for event in self._service.events(self.id, self._stop):
                    self._take(event)
            except (ServiceError, ValueError, KeyError) as error:
                gone = isinstance(error, ServiceError) and error.status == 404
                log.warning("job %s: %s", self.id, error)
                self.trouble = f"The service has no job {self.id} (any more)." if gone else str(error)
                self._tell()
                if gone:
                    return
                self._stop.wait(2.0)

    def _take(self, event: IterationRecord | JobView) -> None:
        if isinstance(event, JobView):
            self.job, self.complete = event, True
            if event.photo_step is not None:
                self._asked_photo = False  # it was another one while the job ran
        elif event.index == len(self.records):  # after a broken stream they come again from the first one on
            self.records.append(event)
        else:
            return
        self._tell()

    def _tell(self) -> None:
        for listener in tuple(self.listeners):
            listener()


@dataclass(frozen=True, slots=True)
class SceneContent:
    view: SceneView
    splats: Splats
    extent: Extent


class Library:
    """Everything that browsers share, by name."""

    def __init__(self, service: ServiceClient) -> None:
        self.service = service
        self.jobs: tuple[JobSummary, ...] | None = None
        """Newest first, up to date while somebody listens; None: not known yet."""
        self.scenes: tuple[str, ...] = ()
        """Ids of those that can be shown."""
        self._feeds: dict[str, JobStream] = {}
        self._scenes: OrderedDict[str, SceneContent] = OrderedDict()
        self._listeners: set[Listener] = set()
        self._awake = threading.Event()
        self._closed = threading.Event()
        self._lock = threading.Lock()

    def start(self) -> None:
        threading.Thread(target=self._watch, name="jobs", daemon=True).start()

    def close(self) -> None:
        self._closed.set()
        self._awake.set()
        with self._lock:
            for feed in self._feeds.values():
                feed.stop()

    def listen(self, listener: Listener) -> None:
        """Call `listener` whenever the list of jobs or of scenes has changed, until `ignore`."""
        with self._lock:
            self._listeners.add(listener)
        self._awake.set()

    def ignore(self, listener: Listener) -> None:
        with self._lock:
            self._listeners.discard(listener)
            if not self._listeners:
                self._awake.clear()

    def follow(self, job_id: str, listener: Listener) -> JobStream:
        """Return the job's feed, shared with everyone who follows it; `leave` it when done."""
        with self._lock:
            feed = self._feeds.get(job_id) or JobStream(self.service, job_id)
            feed.listeners.add(listener)
            if job_id not in self._feeds:
                self._feeds[job_id] = feed
                feed.start()
            return feed

    def leave(self, feed: JobStream, listener: Listener) -> None:
        with self._lock:
            feed.listeners.discard(listener)
            if not feed.listeners and self._feeds.get(feed.id) is feed:
                feed.stop()
                del self._feeds[feed.id]

    def scene(self, scene_id: str) -> SceneContent:
        """Return a scene for drawing; the last few are kept. Raises ServiceError, ValueError."""
        with self._lock:
            if scene_id in self._scenes:
                self._scenes.move_to_end(scene_id)
                return self._scenes[scene_id]
        view = self.service.scene(scene_id)
        splats = self.service.splats(scene_id, MAX_SPLATS)
        cameras = [named.camera for named in view.cameras]
        content = SceneContent(view, splats, extent(splats.centres, cameras, view.up_in_world))
        with self._lock:
            self._scenes[scene_id] = content
            if len(self._scenes) > _SCENES_KEPT:
                self._scenes.popitem(last=False)
        return content

    def _watch(self) -> None:
        """Poll the lists of jobs and scenes while somebody listens."""
        trouble = ""
        while self._awake.wait() and not self._closed.is_set():
            try:
                known = tuple(self.service.jobs()), tuple(self.service.scenes())
                trouble = ""
            except (ServiceError, ValueError, KeyError) as error:
                if str(error) != trouble:  # once, not at every poll
                    trouble = str(error)
                    log.warning("list of jobs: %s", error)
                known = self.jobs, self.scenes
            if known != (self.jobs, self.scenes):
                self.jobs, self.scenes = known
                with self._lock:
                    listeners = tuple(self._listeners)
                for listener in listeners:
                    listener()
            self._closed.wait(_POLL_S)
