"""What acceptance and attempts of jobs share: store, photos, what is live, and how a job is let go."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

from service.errors import StorageFailed
from service.jobs.live_job import LiveJob
from service.jobs.photo_store import Photos
from service.jobs.sqlite_store import Ending, JobStore, StoredJob
from service.localize import LoadedScene
from service.photos.images import encode_image
from service.scene_manager.manager import Scenes
from service.types import Query
from service.web.metrics import Metrics
from service.web.problems import problem_of
from service.web.schemas.parsing import Body, Task, make_task
from service.web.schemas.requests import LocalizeFields
from service.web.settings import Settings

_log = logging.getLogger(__name__)
_T = TypeVar("_T")

_RETRY_S = 0.5


@dataclass(slots=True)
class Desk:
    settings: Settings
    scenes: Scenes
    store: JobStore
    photos: Photos
    metrics: Metrics
    live: dict[str, LiveJob] = field(default_factory=dict)
    """The jobs that haven't ended."""
    closing: threading.Event = field(default_factory=threading.Event)
    storage_error: str = ""
    """Why nothing can be written to disk; empty while it can."""

    def decoded(self, job: StoredJob, loaded: LoadedScene) -> tuple[Task, Query]:
        """Read a stored request again. Raises PhotoGone."""
        body = Body(self.photos.original(job.id), "", {})
        return make_task(
            body, LocalizeFields.model_validate_json(job.fields), loaded, job.estimator, self.settings.max_frames
        )

    def persisted(self, live: LiveJob, write: Callable[[], _T]) -> _T | None:
        """Write to the store, again and again while the disk is full. None if the service ends before that."""
        while True:
            try:
                result = write()
            except StorageFailed as error:
                self.note_storage(error)
                live.beat()
                if self.closing.wait(_RETRY_S):
                    return None
            else:
                self.storage_error = ""
                return result

    def note_storage(self, error: Exception) -> None:
        """Take note of a disk that is full or broken."""
        if isinstance(error, StorageFailed):
            if not self.storage_error:
                _log.error("%s", error)
            self.storage_error = error.message

    def photo_until(self) -> float:
        """Return until when the photo of a job that ends now can be looked at."""
        return time.time() + self.settings.photo_grace_s

    def retire(self, live: LiveJob) -> None:
        """Let go of an ended job's memory, and of its photo as it was sent."""
        job = self.store.get(live.id)
        took_s = job.finished - job.started if job.finished and job.started else None
        self.metrics.ended(job.estimator, job.state, job.status, took_s)
        wanted = live.query is not None and (job.keep_photo or self.settings.photo_grace_s > 0)
        self.photos.settle(live.id, encode_image(live.query.rgb) if wanted and live.query else None)
        self.live.pop(live.id, None)
        self.scenes.release(live.held)
        live.end()


def ending(state: str, error: Exception) -> Ending:
    """Describe how a job ended without a result."""
    return Ending(state, error=problem_of(error, "").model_dump_json())
