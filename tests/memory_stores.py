"""Second implementations of the stores' protocols: nothing is written, everything goes with the process."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from service.errors import (
    AnchorNotFound,
    BadInput,
    Failure,
    IdempotencyConflict,
    JobNotFound,
    PhotoGone,
    SceneExists,
    SceneNotFound,
)
from service.jobs.model import (
    Batch,
    Ending,
    JobFilter,
    JobRecord,
    JobResult,
    JobState,
    NewJob,
    Retention,
    StoredJob,
)
from service.jobs.store import JobWatch, require_share
from service.scene_formats import load_scene
from service.scene_manager.anchor_store import Anchor
from service.scene_manager.scene_store import check_scene_id
from service.scene_manager.status import StoredScene


@dataclass
class _Row:
    job: StoredJob
    lease_until: float = 0.0
    records: list[JobRecord] | None = None
    result: JobResult | None = None


class MemoryJobStore:
    """Implements `JobStore`."""

    def __init__(self) -> None:
        self._rows: dict[str, _Row] = {}
        self._lock = threading.RLock()

    def watch(self) -> JobWatch | None:
        return None

    def now(self) -> float:
        return time.time()

    def accept(self, job: NewJob, most_queued: int | None = None) -> StoredJob:
        with self._lock:
            if known := self.find_by_key(job.client, job.idempotency_key, job.digest):
                return known
            if most_queued is not None:
                require_share(self.count("queued", job.client), most_queued)
            given = {field.name: getattr(job, field.name) for field in fields(NewJob)}
            fresh: dict[str, Any] = {
                **{"number": len(self._rows) + 1, "state": "queued", "attempt": 0, "lost": 0, "cancelled": False},
                **{"started": None, "finished": None, "photo_until": None, "records": 0, "stage": None},
                **{"status": None, "score": None, "failure": None},
            }
            self._rows[job.id] = _Row(StoredJob(**given, **fresh))
            return self._rows[job.id].job

    def find_by_key(self, client: str, key: str | None, digest: str) -> StoredJob | None:
        with self._lock:
            jobs = [row.job for row in self._rows.values()]
        known = next((j for j in jobs if key is not None and (j.client, j.idempotency_key) == (client, key)), None)
        if known and known.digest != digest:
            raise IdempotencyConflict("the key was used for another request.", where="header.idempotency-key")
        return known

    def has_key(self, client: str, key: str) -> bool:
        with self._lock:
            return any((r.job.client, r.job.idempotency_key) == (client, key) for r in self._rows.values())

    def claim(self, job: StoredJob, lease_until: float) -> int | None:
        with self._lock:
            row = self._rows[job.id]
            if row.job.state != "queued" or row.job.attempt != job.attempt or row.job.cancelled:
                return None
            self._change(row, state="running", attempt=job.attempt + 1, started=time.time(), records=0, stage=None)
            row.lease_until, row.records = lease_until, []
            return job.attempt + 1

    def renew(self, attempts: Sequence[tuple[str, int]], lease_until: float) -> None:
        with self._lock:
            for job_id, attempt in attempts:
                if row := self._running(job_id, attempt):
                    row.lease_until = lease_until

    def reclaim(self, before: float, most_lost: int, failure: Failure) -> list[StoredJob]:
        with self._lock:
            lost = [r for r in self._rows.values() if r.job.state == "running" and r.lease_until < before]
            for row in lost:
                self._change(row, lost=row.job.lost + 1)
                if row.job.cancelled:
                    self._end(row, Ending("cancelled"), time.time())
                elif row.job.lost >= most_lost:
                    self._end(row, Ending("interrupted", failure=failure), time.time())
                else:
                    self._change(row, state="queued")
            return [row.job for row in lost]

    def append(self, job_id: str, attempt: int, batch: Batch) -> bool:
        with self._lock:
            row = self._running(job_id, attempt)
            if row is None or row.records is None:
                return False
            row.records = [*row.records[: batch.first], *batch.records]
            stage = batch.records[-1].step.stage if batch.records else row.job.stage
            self._change(row, records=len(row.records), stage=stage)
            return True

    def finish(self, job_id: str, attempt: int, batch: Batch, ending: Ending, photo_until: float | None) -> bool:
        with self._lock:
            row = self._running(job_id, attempt)
            if row is None or not self.append(job_id, attempt, batch):
                return False
            self._end(row, ending, photo_until)
            return True

    def requeue(self, job_id: str, attempt: int) -> bool:
        with self._lock:
            row = self._running(job_id, attempt)
            if row:
                self._change(row, state="queued")
            return row is not None

    def end_queued(self, job: StoredJob, ending: Ending, photo_until: float | None) -> bool:
        with self._lock:
            row = self._rows[job.id]
            if row.job.state != "queued" or row.job.attempt != job.attempt:
                return False
            self._end(row, ending, photo_until)
            return True

    def request_cancel(self, job_id: str) -> None:
        with self._lock:
            if not self._rows[job_id].job.ended:
                self._change(self._rows[job_id], cancelled=True)

    def get(self, job_id: str) -> StoredJob:
        with self._lock:
            if job_id not in self._rows:
                raise JobNotFound(f"job '{job_id}' not found or expired.", where="job")
            return self._rows[job_id].job

    def queued(self) -> list[StoredJob]:
        with self._lock:
            return [row.job for row in self._rows.values() if row.job.state == "queued"]

    def page(self, wanted: JobFilter, limit: int) -> list[StoredJob]:
        given = {f.name: getattr(wanted, f.name) for f in fields(JobFilter) if f.name != "before"}
        given = {name: value for name, value in given.items() if value is not None}
        with self._lock:
            jobs = [row.job for row in reversed(self._rows.values())]
        jobs = [job for job in jobs if wanted.before is None or job.number < wanted.before]
        return [job for job in jobs if all(getattr(job, name) == value for name, value in given.items())][:limit]

    def count(self, state: JobState, client: str | None = None) -> int:
        with self._lock:
            jobs = [row.job for row in self._rows.values() if row.job.state == state]
        return sum(client in (None, job.client) for job in jobs)

    def records(self, job_id: str, first: int = 0) -> list[JobRecord]:
        with self._lock:
            return (self._rows[job_id].records or [])[first:]

    def result(self, job_id: str) -> JobResult | None:
        with self._lock:
            row = self._rows.get(job_id)
            return row and row.result

    def expire_photos(self) -> list[str]:
        with self._lock:
            now = time.time()
            dated = [row for row in self._rows.values() if row.job.ended and row.job.photo_until is not None]
            stale = [row for row in dated if (row.job.photo_until or now) < now]
            for row in stale:
                self._change(row, photo_until=None, keep_photo=False, photo_bytes=0)
            return [row.job.id for row in stale]

    def prune(self, kept: Retention) -> list[str]:
        with self._lock:
            gone, total = [], 0
            for place, row in enumerate([r for r in reversed(self._rows.values()) if r.job.ended], 1):
                total += row.job.photo_bytes
                late = (row.job.finished or 0) < time.time() - kept.seconds
                if place > kept.jobs or total > kept.bytes or late:
                    gone.append(row.job.id)
            for job_id in gone:
                del self._rows[job_id]
            return gone

    def delete(self, job_id: str) -> bool:
        with self._lock:
            ended = job_id in self._rows and self._rows[job_id].job.ended
            if ended:
                del self._rows[job_id]
            return ended

    def ids(self) -> set[str]:
        with self._lock:
            return set(self._rows)

    def reassign(self, client: str, to: str) -> None:
        with self._lock:
            taken = {row.job.idempotency_key for row in self._rows.values() if row.job.client == to} - {None}
            for row in self._rows.values():
                if row.job.client == client and row.job.idempotency_key not in taken:
                    self._change(row, client=to)

    def probe(self) -> None: ...

    def close(self) -> None: ...

    def _running(self, job_id: str, attempt: int) -> _Row | None:
        row = self._rows.get(job_id)
        return row if row and (row.job.state, row.job.attempt) == ("running", attempt) else None

    def _end(self, row: _Row, ending: Ending, photo_until: float | None) -> None:
        verdict = ending.result.estimate.verdict if ending.result else None
        row.result = ending.result
        self._change(
            row,
            state=ending.state,
            status=verdict and verdict.status,
            score=verdict and verdict.score,
            failure=ending.failure,
            scene=ending.scene or row.job.scene,
            finished=time.time(),
            photo_until=None if row.job.keep_photo else photo_until,
        )

    def _change(self, row: _Row, **values: Any) -> None:
        row.job = replace(row.job, **values)


class MemoryPhotoStore:
    """Implements `PhotoStore`."""

    def __init__(self) -> None:
        self._sent: dict[str, bytes] = {}
        self._kept: dict[str, bytes] = {}

    def accept(self, job_id: str, data: bytes) -> None:
        self._sent[job_id] = data

    def original(self, job_id: str) -> bytes:
        return self._read(self._sent, job_id)

    def discard_original(self, job_id: str, jpeg: bytes | None) -> None:
        if jpeg is not None:
            self._kept[job_id] = jpeg
        self._sent.pop(job_id, None)

    def kept(self, job_id: str) -> bytes:
        return self._read(self._kept, job_id)

    def delete(self, job_id: str) -> None:
        self._sent.pop(job_id, None)
        self._kept.pop(job_id, None)

    def with_original(self) -> set[str]:
        return set(self._sent)

    def ids(self) -> set[str]:
        return set(self._sent) | set(self._kept)

    def _read(self, photos: dict[str, bytes], job_id: str) -> bytes:
        if job_id not in photos:
            raise PhotoGone("the photo was deleted after the job.", where="photo")
        return photos[job_id]


class MemorySceneStore:
    """Implements `SceneStore`; since scenes are loaded from files, a folder has those of the uploads."""

    def __init__(self, named: Sequence[StoredScene], folder: Path) -> None:
        self._scenes = {scene.id: scene for scene in named}
        self._folder = folder

    def scenes(self) -> list[StoredScene]:
        uploads = sorted((s for s in self._scenes.values() if s.uploaded), key=lambda s: s.id)
        return [*(s for s in self._scenes.values() if not s.uploaded), *uploads]

    def find(self, scene_id: str) -> StoredScene | None:
        return self._scenes.get(scene_id)

    def draft(self, scene_id: str) -> MemoryDraft:
        check_scene_id(scene_id)
        if scene_id in self._scenes:
            raise SceneExists(f"scene '{scene_id}' already exists.", where="scene")
        return MemoryDraft(self._scenes, scene_id, self._folder)

    def delete(self, scene_id: str) -> None:
        scene = self._scenes.get(scene_id)
        if scene is None or not scene.uploaded:
            raise SceneNotFound(f"uploaded scene '{scene_id}' not found.", where="scene")
        scene.path.unlink()
        del self._scenes[scene_id]


class MemoryDraft:
    def __init__(self, scenes: dict[str, StoredScene], scene_id: str, folder: Path) -> None:
        self._scenes, self._id, self._folder = scenes, scene_id, folder
        self._data = b""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def write(self, data: bytes) -> None:
        self._data += data

    def commit(self, file_name: str) -> StoredScene:
        path = self._folder / f"{self._id}{Path(file_name).suffix}"
        path.write_bytes(self._data)
        try:
            load_scene(path)
        except BaseException:
            path.unlink()
            raise
        if self._id in self._scenes:
            path.unlink()
            raise SceneExists(f"scene '{self._id}' already exists.", where="scene")
        self._scenes[self._id] = StoredScene(self._id, path, uploaded=True)
        return self._scenes[self._id]


class MemoryAnchorStore:
    """Implements `AnchorStore`."""

    def __init__(self, scenes: set[str]) -> None:
        self._anchors: dict[str, dict[str, Anchor]] = {scene: {} for scene in scenes}

    def anchors(self, scene_id: str) -> tuple[Anchor, ...]:
        found = self._anchors.get(scene_id, {})
        return tuple(found[name] for name in sorted(found))

    def put(self, scene_id: str, anchor: Anchor) -> None:
        if scene_id not in self._anchors:
            raise BadInput("the scene has no file to keep anchors with.", where="scene")
        self._anchors[scene_id][anchor.name] = anchor

    def delete(self, scene_id: str, name: str) -> None:
        if self._anchors.get(scene_id, {}).pop(name, None) is None:
            raise AnchorNotFound(f"anchor '{name}' not found.", where="name")
