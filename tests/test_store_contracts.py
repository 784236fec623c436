"""What every store promises, whatever it is made of: the service's own, and trivial ones in memory."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from memory_stores import MemoryJobStore, MemoryPhotoStore, MemorySceneStore
from object_stores import S3, address_of
from postgres_server import POSTGRES
from test_scenes import ply

from service.errors import (
    Failure,
    IdempotencyConflict,
    InvalidRequest,
    JobNotFound,
    PhotoGone,
    QueueFull,
    SceneError,
    SceneExists,
    SceneNotFound,
)
from service.jobs.model import Batch, Ending, JobFilter, JobRecord, JobResult, JobSpec, NewJob, PhotoInfo, Retention
from service.jobs.object_photo_store import ObjectPhotoStore
from service.jobs.photo_store import FolderPhotoStore, PhotoStore
from service.jobs.sqlite_store import SqliteJobStore
from service.jobs.store import JobStore
from service.object_store import open_objects
from service.results import (
    Candidates,
    IterationRecord,
    MatchVectors,
    PoseEstimate,
    Reason,
    StageTiming,
    Status,
    Verdict,
)
from service.scene_manager.object_scene_store import ObjectSceneStore
from service.scene_manager.scene_store import FolderSceneStore, SceneStore
from service.scene_manager.status import StoredScene
from service.types import BoxPrior, Camera, Intrinsics, Pose

CAMERA = Intrinsics(64, 48, 60.0, 61.0, 32.0, 24.0, "OPENCV", (0.1, 0.2, 0.3, 0.4), "approximate")
FAILURE = Failure("interrupted", "the service ended.")
NONE = Batch(0, ())


@pytest.fixture(params=["sqlite", "memory", POSTGRES])
def store(request, tmp_path) -> Iterator[JobStore]:
    if request.param == "postgres":
        database = request.getfixturevalue("database")  # which skips the test where there is none
        from service.jobs.postgres_store import PostgresJobStore

        made: JobStore = PostgresJobStore(database)
    else:
        made = SqliteJobStore(tmp_path / "jobs.sqlite") if request.param == "sqlite" else MemoryJobStore()
    assert isinstance(made, JobStore)
    yield made
    made.close()


def new_job(name: str, **changes) -> NewJob:
    values = {
        **{"id": name, "client": "c", "idempotency_key": None, "digest": "d", "created": time.time()},
        **{"deadline": None, "scene": "s", "estimator": "e", "spec": JobSpec("e"), "photo_sha256": "0"},
        **{"photo": PhotoInfo("p.jpg", "0", CAMERA), "photo_bytes": 10, "keep_photo": False},
    }
    return NewJob(**(values | changes))


def record(stage: str, index: int = 0) -> JobRecord:
    px = np.array([[1.5, 2.25], [3.0, 4.0]], np.float32)
    pose = Pose(np.eye(4))
    return JobRecord(
        IterationRecord(
            stage,
            pose,
            loss=0.1 + index,
            matches=MatchVectors.sample(px, px + 1, np.array([True, False]), Camera(CAMERA, pose)),
            candidates=Candidates(np.eye(4)[None], np.array([0.25])),
            index=index,
        )
    )


def result(status: Status = Status.LOCALIZED) -> JobResult:
    verdict = Verdict(
        status,
        Reason.VERIFIED,
        0.75,
        100,
        0.5,
        0.25,
        np.eye(6) / 3,
        (0.01, 0.02, 0.03, 0.04),
        signals={"inliers": 100.0},
    )
    pose = Pose(np.array([[0.0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]]))
    estimate = PoseEstimate(
        pose=pose,
        verdict=verdict,
        intrinsics=CAMERA,
        intrinsics_source="exif",
        scene_id="s",
        scene_sha256="ab",
        estimator="e",
        rasterizer="r",
        matcher="m",
        seed=3,
        budget_exhausted=False,
        renders=7,
        timings=(StageTiming("match", 0.1, 0.2),),
        warnings=("beware",),
        records=(IterationRecord("match", pose),),
        scene_ranking=(("s", 5),),
    )
    return JobResult(estimate, StageTiming("decode", 0.3, 0.4), None, {"numpy": "2"})


# ------------------------------------------------------------------ jobs


def test_a_job_comes_back_as_it_was_accepted(store):
    spec = JobSpec(
        "e",
        scene=("a", "b"),
        options={"steps": 4, "loss": "l2"},
        intrinsics=CAMERA,
        region=BoxPrior(np.zeros(3), np.array([1.0, 2.0, 3.0])),
        times_s=(0.5, 1.0),
        seed=2**62,
        budget_s=0.1,
    )
    new = new_job("a", spec=spec, keep_photo=True, deadline=5.5)
    stored = store.accept(new)
    assert (stored.state, stored.attempt, stored.lost, stored.ended) == ("queued", 0, 0, False)
    read = store.get("a")
    for name in ("id", "client", "digest", "created", "deadline", "scene", "estimator", "photo", "keep_photo"):
        assert getattr(read, name) == getattr(new, name)
    assert (read.spec.scene, read.spec.options, read.spec.times_s) == (("a", "b"), {"steps": 4, "loss": "l2"}, (0.5, 1))
    assert (read.spec.intrinsics, read.spec.seed, read.spec.budget_s) == (CAMERA, 2**62, 0.1)
    assert isinstance(read.spec.region, BoxPrior)
    assert read.spec.region.upper_in_world.tolist() == [1, 2, 3]
    assert [job.id for job in store.queued()] == ["a"]
    with pytest.raises(JobNotFound):
        store.get("b")


def test_a_job_is_claimed_once_and_ends_once(store):
    job = store.accept(new_job("a"))
    assert store.claim(job, math.inf) == 1
    assert store.claim(job, math.inf) is None
    assert store.append("a", 1, Batch(0, [record("x"), record("x", 1)]))
    assert not store.append("a", 2, Batch(2, [record("x", 2)]))
    assert store.finish("a", 1, Batch(2, [record("y", 2)]), Ending("succeeded", result(), scene="t"), None)
    assert not store.finish("a", 1, NONE, Ending("failed", failure=FAILURE), None)
    assert not store.requeue("a", 1)
    ended = store.get("a")
    assert (ended.state, ended.records, ended.stage, ended.scene) == ("succeeded", 3, "y", "t")
    assert (ended.status, ended.score, ended.failure) == (Status.LOCALIZED, 0.75, None)
    assert ended.finished
    assert [r.step.index for r in store.records("a", 1)] == [1, 2]


def test_records_and_results_come_back_exactly(store):
    store.claim(store.accept(new_job("a")), math.inf)
    store.finish("a", 1, Batch(0, [record("x")]), Ending("succeeded", result()), None)
    (read,), given = store.records("a"), record("x")
    assert read.step.loss == given.step.loss
    assert read.step.matches.photo_px.dtype == np.float32
    assert np.array_equal(read.step.matches.photo_px, given.step.matches.photo_px)
    assert read.step.matches.inlier.tolist() == [True, False]
    assert read.step.matches.render_camera.intrinsics == CAMERA
    assert np.array_equal(read.step.candidates.world_from_camera, np.eye(4)[None])
    found, wanted = store.result("a"), result()
    assert np.array_equal(found.estimate.pose.world_from_camera, wanted.estimate.pose.world_from_camera)
    assert np.array_equal(found.estimate.verdict.covariance, np.eye(6) / 3)
    assert found.estimate.timings == wanted.estimate.timings
    assert (found.decode, found.versions, found.frames) == (wanted.decode, wanted.versions, None)
    assert (found.estimate.scene_ranking, found.estimate.warnings) == ((("s", 5),), ("beware",))
    assert store.result("b") is None


def test_a_failure_comes_back(store):
    store.claim(store.accept(new_job("a")), math.inf)
    store.finish("a", 1, NONE, Ending("failed", failure=FAILURE), None)
    assert (store.get("a").state, store.get("a").failure, store.result("a")) == ("failed", FAILURE, None)


def test_many_threads_agree_on_one_winner(store):
    job = store.accept(new_job("a"))
    won: list[int] = []
    barrier = threading.Barrier(8)

    def compete() -> None:
        barrier.wait()
        attempt = store.claim(job, math.inf)
        if attempt:
            won.append(attempt)

    threads = [threading.Thread(target=compete) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert won == [1]


def test_of_jobs_that_are_accepted_at_once_as_many_are_stored_as_may_wait(store):
    store.accept(new_job("of another", client="other"))
    refused: list[str] = []
    barrier = threading.Barrier(8)

    def send(name: str) -> None:
        barrier.wait()
        try:
            store.accept(new_job(name, idempotency_key=name), 3)
        except QueueFull:
            refused.append(name)

    threads = [threading.Thread(target=send, args=(name,)) for name in "abcdefgh"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(refused) == 5
    (first, *_) = accepted = [name for name in "abcdefgh" if name not in refused]
    assert store.count("queued", "c") == len(accepted) == 3
    assert store.accept(new_job("again", idempotency_key=first), 3).id == first
    store.claim(store.get(first), math.inf)
    assert store.accept(new_job("more"), 3).id == "more"


def test_keys_belong_to_their_client(store):
    store.accept(new_job("a", idempotency_key="k"))
    assert store.accept(new_job("b", idempotency_key="k")).id == "a"
    assert store.accept(new_job("c", idempotency_key="k", client="other")).id == "c"
    with pytest.raises(IdempotencyConflict):
        store.accept(new_job("d", idempotency_key="k", digest="e"))
    with pytest.raises(IdempotencyConflict):
        store.find_by_key("c", "k", "e")
    assert store.find_by_key("c", "k", "d").id == "a"
    assert store.find_by_key("c", None, "d") is None
    assert (store.has_key("c", "k"), store.has_key("third", "k")) == (True, False)


def test_a_lost_attempt_is_made_again_and_its_late_result_is_refused(store):
    store.claim(store.accept(new_job("a")), 100.0)
    store.append("a", 1, Batch(0, [record("x")]))
    assert store.reclaim(100.0, 3, FAILURE) == []  # it ends then, not before
    (job,) = store.reclaim(100.5, 3, FAILURE)
    assert (job.id, job.state, job.attempt, job.lost) == ("a", "queued", 1, 1)
    # The worker of the first attempt comes back, before and after another one has the job.
    assert not store.append("a", 1, Batch(1, [record("x", 1)]))
    assert not store.finish("a", 1, NONE, Ending("succeeded", result()), None)
    assert store.claim(job, 200.0) == 2
    assert not store.append("a", 1, Batch(1, [record("x", 1)]))
    assert not store.finish("a", 1, NONE, Ending("succeeded", result()), None)
    assert not store.requeue("a", 1)
    assert store.records("a") == []
    assert store.finish("a", 2, Batch(0, [record("y")]), Ending("succeeded", result()), None)
    assert [r.step.stage for r in store.records("a")] == ["y"]


def test_a_lease_is_renewed_by_who_has_it(store):
    store.claim(store.accept(new_job("a")), 100.0)
    store.renew([("a", 1)], 200.0)
    assert store.reclaim(150.0, 3, FAILURE) == []
    store.renew([("a", 7), ("none", 1)], 900.0)
    (job,) = store.reclaim(250.0, 3, FAILURE)
    store.renew([("a", 1)], 300.0)  # lost already
    assert store.get("a") == job
    assert store.claim(job, 400.0) == 2


def test_a_job_that_loses_too_many_attempts_is_interrupted(store):
    job = store.accept(new_job("a"))
    for lost in (1, 2):
        store.claim(job, 0.0)
        (job,) = store.reclaim(1.0, 3, FAILURE)
        assert (job.state, job.lost) == ("queued", lost)
    store.claim(job, 0.0)
    store.requeue("a", 3)  # stopped on purpose: that isn't counted
    assert store.claim(store.get("a"), 0.0) == 4
    (job,) = store.reclaim(math.inf, 3, FAILURE)
    assert (job.state, job.failure, job.lost, job.ended) == ("interrupted", FAILURE, 3, True)
    assert store.queued() == []


def test_a_cancelled_job_is_not_made_again(store):
    waiting, running = store.accept(new_job("a")), store.accept(new_job("b"))
    store.claim(running, 0.0)
    for name in ("a", "b"):
        store.request_cancel(name)
    assert store.claim(store.get("a"), math.inf) is None
    assert store.end_queued(waiting, Ending("cancelled"), None)
    assert not store.end_queued(waiting, Ending("cancelled"), None)
    assert not store.end_queued(store.get("b"), Ending("cancelled"), None)  # it runs
    assert [job.state for job in store.reclaim(1.0, 3, FAILURE)] == ["cancelled"]
    assert [store.get(name).state for name in ("a", "b")] == ["cancelled", "cancelled"]


def test_pages_are_filtered_and_newest_first(store):
    for k in range(4):
        store.accept(new_job(f"{k}", scene="ab"[k % 2], photo_sha256=f"{k // 2}"))
    store.claim(store.get("1"), math.inf)
    store.finish("1", 1, NONE, Ending("succeeded", result(Status.UNCERTAIN)), None)

    def listed(limit: int = 9, **wanted) -> list[str]:
        return [job.id for job in store.page(JobFilter(**wanted), limit)]

    assert listed() == ["3", "2", "1", "0"]
    assert listed(2) == ["3", "2"]
    assert listed(before=store.get("2").number) == ["1", "0"]
    assert listed(scene="a") == ["2", "0"]
    assert listed(photo_sha256="1", scene="b") == ["3"]
    assert listed(status=Status.UNCERTAIN) == ["1"]
    assert listed(state="queued", estimator="e") == ["3", "2", "0"]
    assert listed(estimator="f") == []
    assert (store.count("queued"), store.count("succeeded"), store.count("failed")) == (3, 1, 0)
    assert store.ids() == {"0", "1", "2", "3"}


def test_jobs_are_reassigned_with_their_keys(store):
    for name, client, key in (("a", "old", "k"), ("b", "old", None), ("c", "new", None), ("d", "other", "k")):
        store.accept(new_job(name, client=client, idempotency_key=key))
    store.reassign("old", "new")
    assert [job.id for job in store.page(JobFilter(client="new"), 9)] == ["c", "b", "a"]
    assert store.page(JobFilter(client="old"), 9) == []
    assert [store.has_key(client, "k") for client in ("old", "new", "other")] == [False, True, True]
    # An idempotency key that both have used: neither job is lost.
    store.accept(new_job("e", client="old", idempotency_key="k"))
    store.reassign("old", "new")
    assert (store.get("a").client, store.get("e").client) == ("new", "old")


def test_jobs_are_listed_and_counted_by_client(store):
    for name, client in (("a", "key:ann:1"), ("b", "key:bob:2"), ("c", "key:ann:1"), ("d", "key:ann")):
        store.accept(new_job(name, client=client))
    assert [job.id for job in store.page(JobFilter(client="key:ann:1"), 9)] == ["c", "a"]
    assert [job.id for job in store.page(JobFilter(client="key:ann:1"), 1)] == ["c"]
    assert store.page(JobFilter(client=""), 9) == []
    store.claim(store.get("a"), time.time() + 60)
    assert [store.count("queued", client) for client in (None, "key:ann:1", "key:bob:2", "nobody")] == [3, 1, 1, 0]
    assert [store.count("running", client) for client in (None, "key:ann:1", "key:bob:2")] == [1, 1, 0]


@pytest.mark.parametrize(
    ("kept", "left"),
    [
        (Retention(2, 1e9, 10**9), ["running", "c", "b"]),
        (Retention(9, 1e9, 250), ["running", "c", "b"]),
        (Retention(9, 3600, 10**9), ["running", "c"]),
    ],
)
def test_the_oldest_ended_jobs_are_forgotten(store, kept, left, monkeypatch):
    now = time.time()
    for age, name in ((9000, "a"), (8000, "b"), (10, "c")):
        store.claim(store.accept(new_job(name, photo_bytes=100)), math.inf)
        monkeypatch.setattr(time, "time", lambda age=age: now - age)
        store.finish(name, 1, NONE, Ending("cancelled"), None)
        monkeypatch.undo()
    store.claim(store.accept(new_job("running")), math.inf)
    gone = {"running", "c", "b", "a"} - set(left)
    assert set(store.prune(kept)) == gone
    assert [job.id for job in store.page(JobFilter(), 9)] == left


def test_only_an_ended_job_is_deleted_with_all_that_it_has(store):
    store.claim(store.accept(new_job("running")), math.inf)
    store.claim(store.accept(new_job("ended")), math.inf)
    store.finish("ended", 1, NONE, Ending("cancelled"), None)
    assert [store.delete(name) for name in ("running", "ended", "ended", "nothing")] == [False, True, False, False]
    assert store.ids() == {"running"}
    with pytest.raises(JobNotFound):
        store.get("ended")


def test_photos_are_stale_when_their_time_is_over(store):
    for name, keep, until in (("old", False, 1.0), ("new", False, time.time() + 60), ("kept", True, 1.0)):
        store.claim(store.accept(new_job(name, keep_photo=keep)), math.inf)
        store.finish(name, 1, NONE, Ending("cancelled"), until)
    store.accept(new_job("waiting"))
    assert store.expire_photos() == ["old"]
    assert store.expire_photos() == []
    store.probe()


# ------------------------------------------------------------------ photos


@pytest.fixture(params=["folder", "memory", POSTGRES, "objects", S3])
def photos(request, tmp_path) -> PhotoStore:
    if request.param == "postgres":
        database = request.getfixturevalue("database")
        from service.jobs.postgres_store import PostgresPhotoStore

        made: PhotoStore = PostgresPhotoStore(database)
    elif request.param in ("objects", "s3"):
        made = ObjectPhotoStore(open_objects(address_of(request.param, request, tmp_path)))
    else:
        made = FolderPhotoStore(tmp_path / "photos") if request.param == "folder" else MemoryPhotoStore()
    assert isinstance(made, PhotoStore)
    return made


def test_a_photo_is_kept_as_sent_then_as_shown_then_not_at_all(photos):
    photos.accept("a", b"sent")
    photos.accept("b", b"other")
    assert (photos.original("a"), photos.with_original(), photos.ids()) == (b"sent", {"a", "b"}, {"a", "b"})
    with pytest.raises(PhotoGone):
        photos.kept("a")
    photos.discard_original("a", b"shown")
    photos.discard_original("b", None)
    assert (photos.kept("a"), photos.with_original(), photos.ids()) == (b"shown", set(), {"a"})
    for read in (photos.original, photos.kept):
        with pytest.raises(PhotoGone):
            read("b")
    with pytest.raises(PhotoGone):
        photos.original("a")
    photos.delete("a")
    photos.delete("never")
    assert photos.ids() == set()


# ------------------------------------------------------------------ scenes


@pytest.fixture(params=["folder", "memory", "objects", S3])
def make_scenes(request, tmp_path) -> Callable[[], SceneStore]:
    named = [StoredScene("zoo", tmp_path / "zoo"), StoredScene("attic", tmp_path / "attic")]
    (tmp_path / "uploads").mkdir()
    if request.param == "memory":
        kept = MemorySceneStore(named, tmp_path / "uploads")
        return lambda: kept
    if request.param in ("objects", "s3"):
        address = address_of(request.param, request, tmp_path)
        return lambda: ObjectSceneStore(named, address, tmp_path / "cache", tmp_path / "uploads", 10**6)
    return lambda: FolderSceneStore(named, tmp_path / "uploads", 10**6)


def upload(store: SceneStore, name: str, data: bytes, file_name: str = "scene.ply") -> StoredScene:
    with store.draft(name) as draft:
        draft.write(data[:100])
        draft.write(data[100:])
        return draft.commit(file_name)


def test_scenes_are_listed_found_and_deleted(make_scenes):
    store = make_scenes()
    assert isinstance(store, SceneStore)
    for name in ("house", "barn"):
        stored = upload(store, name, ply())
        assert (stored.id, stored.uploaded) == (name, True)
        assert stored.path.exists()
    assert [scene.id for scene in store.scenes()] == ["zoo", "attic", "barn", "house"]
    assert (store.find("zoo").uploaded, store.find("none")) == (False, None)
    path = store.find("barn").path
    store.delete("barn")
    assert not path.exists()
    assert [scene.id for scene in make_scenes().scenes()] == ["zoo", "attic", "house"]  # also for who comes later
    for name in ("barn", "zoo"):
        with pytest.raises(SceneNotFound):
            store.delete(name)


def test_a_draft_that_is_refused_or_left_is_no_scene(make_scenes, tmp_path):
    store = make_scenes()
    for name in ("a/b", "..", "auto", ""):
        with pytest.raises(InvalidRequest):
            store.draft(name)
    for name in ("zoo", "attic"):
        with pytest.raises(SceneExists):
            store.draft(name)
    with pytest.raises(SceneError):
        upload(store, "house", b"ply\nformat binary_little_endian 1.0\nelement vertex 9\n")
    with store.draft("house") as draft:
        draft.write(b"x")
    assert store.find("house") is None
    assert not [path for path in Path(tmp_path / "uploads").rglob("*") if path.is_file()]
    with store.draft("house") as first, store.draft("house") as second:
        for draft in (first, second):
            draft.write(ply())
        first.commit("scene.ply")
        with pytest.raises(SceneExists):
            second.commit("scene.ply")
