"""Photos that crashes have left over: a photo is written before its job, and replaced after the job's end."""

from __future__ import annotations

import time

from service.jobs.model import JobFilter
from service.jobs.photo_store import PhotoStore
from service.jobs.store import JobStore

_EVERY_S = 600.0


class LeftOverPhotos:
    """Deletes them at the start, and now and then where other processes may leave some."""

    def __init__(self, store: JobStore, photos: PhotoStore) -> None:
        self._store, self._photos = store, photos
        self._suspects: set[str] = set()
        self._next_at = 0.0

    def delete(self) -> None:
        """Delete them all; no other process uses the stores."""
        self._suspects = self._found()
        self.delete_old()

    def delete_old(self) -> None:
        """Delete those that were there already when they were looked for last, unless that is not long ago.

        Another process may be between a photo and its job, or between a job's end and its photo.
        """
        if time.monotonic() < self._next_at:
            return
        found, known = self._found(), self._store.ids()
        for job_id in found & self._suspects:
            if job_id in known:
                self._photos.discard_original(job_id, None)
            else:
                self._photos.delete(job_id)
        self._suspects, self._next_at = found, time.monotonic() + _EVERY_S

    def _found(self) -> set[str]:
        """Return the jobs that aren't there but for a photo, or that ended and have it as it was sent."""
        photos, sent = self._photos.ids(), self._photos.with_original()
        running = self._store.page(JobFilter(state="running"), 10**9)
        unfinished = {job.id for job in (*running, *self._store.queued())}
        known = self._store.ids()
        return (photos - known) | ((sent & known) - unfinished)
