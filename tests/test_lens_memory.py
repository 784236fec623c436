"""The memory of lenses between photos and answers: simulated cameras, and jobs on an engine that answers as they do."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from io import BytesIO

import httpx
import numpy as np
import pytest
from api_server import assert_problem, fake_estimators, post, serving, settings, until, until_ready
from memory_stores import MemoryJobStore, MemoryPhotoStore
from PIL import Image
from stand_ins import make_scene
from test_camera_identity import FOCAL, FOCAL_35, MAKE, MODEL, ORIENTATION
from test_leases import CountingObserver
from test_lenses import PHONE, viewpoint

from service.jobs.config import JobsConfig
from service.jobs.embedded_engine import EmbeddedEngine, EngineConfig
from service.jobs.engine import EngineAnswer, LocalizeTask, OnRecord
from service.jobs.job_order import JobOrder
from service.jobs.model import JobRecord, JobResult, JobSpec
from service.jobs.service import Jobs
from service.lenses.lens_memory import LensMemory, measured
from service.lenses.lens_store import MemoryLensStore
from service.photos.camera_identity import CameraIdentity
from service.photos.images import open_photo
from service.photos.intrinsics import ORIENTATIONS, oriented
from service.results import IterationRecord, PoseEstimate, Reason, StageTiming, Status, Verdict
from service.types import Intrinsics, IntrinsicsSource, Query
from service.web.app import create_app
from service.web.key_file import add_key, remove_key
from service.web.schemas.request_body import body_of

TRUE = Intrinsics(4032, 3024, 3050.0, 3050.0, 2016 + 40.0, 1512 - 24.0, "SIMPLE_RADIAL", (-0.06,), "approximate")
"""Of the photo as the phone stores it."""


def answer(
    intrinsics: Intrinsics,
    angle_deg: float = 0.0,
    source: IntrinsicsSource = "exif",
    status: Status = Status.LOCALIZED,
    score: float = 0.99,
    sigmas: tuple[float, float, float] = (0.003, 0.004, 0.002),
) -> PoseEstimate:
    covariance, signals = np.eye(6) * 1e-6, {"sigma_share": np.sqrt(3e-6) / 4.0}
    verdict = Verdict(
        status,
        Reason.VERIFIED,
        score,
        *(200, 0.9, 1.0, covariance),
        correction_sigma=(*sigmas, sigmas[2]),
        signals=signals,
    )
    pose = viewpoint(angle_deg).pose
    return PoseEstimate(
        pose=pose,
        verdict=verdict,
        intrinsics=intrinsics,
        intrinsics_source=source,
        scene_id="room",
        scene_sha256="ab" * 32,
        estimator="stepping",
        rasterizer="flat",
        matcher="blind",
        seed=0,
        budget_exhausted=False,
        renders=1,
        timings=(StageTiming("verify", 0.1, 0.1),),
        warnings=(),
        records=(IterationRecord("verify", pose),),
    )


def memory() -> LensMemory:
    return LensMemory(MemoryLensStore(10))


def taught(lenses: LensMemory, photos: int = 3, camera: CameraIdentity = PHONE, truth: Intrinsics = TRUE) -> LensMemory:
    for k in range(photos):
        upright = oriented(truth, *ORIENTATIONS[camera.orientation])
        known = lenses.recall("me", None, camera)
        assert lenses.learn("me", None, camera, known, answer(upright, 20.0 * k))
    return lenses


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("taught_by", [1, 3, 6, 8])
def test_what_is_recalled_is_the_lens_however_the_camera_is_held(orientation, taught_by):
    lenses = taught(memory(), camera=replace(PHONE, orientation=taught_by))
    known = lenses.recall("me", None, replace(PHONE, orientation=orientation))
    expected = oriented(TRUE, *ORIENTATIONS[orientation])
    assert (known.intrinsics.width, known.intrinsics.height) == (expected.width, expected.height)
    assert (known.intrinsics.model, known.intrinsics.trust) == ("SIMPLE_RADIAL", "approximate")
    assert known.intrinsics.distortion == pytest.approx((-0.06,))
    for name in ("fx", "fy", "cx", "cy"):
        assert getattr(known.intrinsics, name) == pytest.approx(getattr(expected, name), abs=1e-6)
    assert 0.007 < known.prior.log_focal_scale < 0.01
    assert 0.003 < known.prior.k1_sigma < 0.006
    assert 0.005 < known.prior.principal_point_scale <= 0.007
    assert known.photos == 3


def test_a_resized_photo_has_the_same_lens():
    known = taught(memory()).recall("me", None, replace(PHONE, width=1008, height=756))
    assert known.intrinsics == TRUE.resized(1008, 756) or known.intrinsics.fx == pytest.approx(3050 / 4)
    assert known.intrinsics.cx == pytest.approx(504 + 10)


def test_of_a_photo_stored_upright_the_principal_point_is_unknown():
    """Nothing tells to which side the camera was turned: neither when it is learnt from, nor when it is recalled."""
    upright = replace(PHONE, width=3024, height=4032)
    known = taught(memory()).recall("me", None, upright)
    assert (known.intrinsics.cx, known.intrinsics.cy) == (1512, 2016)
    assert known.intrinsics.fx == pytest.approx(3050.0)
    assert known.prior.principal_point_scale == 0.007
    lenses = memory()
    turned = oriented(TRUE, *ORIENTATIONS[6])
    for k in range(2):
        lenses.learn("me", None, upright, lenses.recall("me", None, upright), answer(turned, 20.0 * k))
    known = lenses.recall("me", None, PHONE)
    assert (known.intrinsics.cx, known.intrinsics.cy) == (2016, 1512)
    assert known.intrinsics.fx == pytest.approx(3050.0)


@pytest.mark.parametrize(
    "changes",
    [
        {"status": Status.UNCERTAIN},
        {"status": Status.NOT_LOCALIZED},
        {"score": 0.9},
        {"sigmas": (0.02, 0.004, 0.002)},
        {"sigmas": (0.0, 0.0, 0.0)},  # given as exact: not estimated
        {"intrinsics": replace(TRUE, model="OPENCV_FISHEYE", distortion=(0.0, 0.0, 0.0, 0.0))},
    ],
)
def test_an_answer_that_is_not_sure_teaches_nothing(changes):
    lenses = memory()
    assert not lenses.learn("me", None, PHONE, None, answer(**({"intrinsics": TRUE} | changes)))
    assert lenses.store.lenses() == []
    assert lenses.recall("me", None, PHONE) is None


def test_a_photo_of_no_known_camera_teaches_nothing():
    lenses = memory()
    assert not lenses.learn("me", None, CameraIdentity(4032, 3024), None, answer(TRUE))
    assert lenses.learn("me", "left eye", CameraIdentity(4032, 3024), None, answer(TRUE))
    assert lenses.recall("me", "left eye", CameraIdentity(4032, 3024)) is not None
    for owner, camera_id in (("you", "left eye"), ("me", "right eye"), ("me", None)):
        assert lenses.recall(owner, camera_id, CameraIdentity(4032, 3024)) is None


def test_the_priors_share_is_taken_out_of_an_answer():
    """The answer is the product of prior and evidence, written out for normal distributions."""
    known = taught(memory()).recall("me", None, PHONE)
    before, scale = np.log(known.intrinsics.fx), known.prior.log_focal_scale
    seen, sigma = before + 0.002, 0.004  # near the prior's centre, where its tails don't matter
    after_sigma = (sigma**-2 + scale**-2) ** -0.5
    after = (seen * sigma**-2 + before * scale**-2) * after_sigma**2
    posterior = replace(known.intrinsics, fx=float(np.exp(after)), fy=float(np.exp(after)))
    found = measured(answer(posterior, sigmas=(after_sigma, 0.001, 0.001)), PHONE, known)
    assert found.value[0] == pytest.approx(seen - np.log(4032), abs=1e-4)
    assert found.sigma[0] == pytest.approx(sigma, rel=0.01)


def test_what_was_recalled_does_not_confirm_itself():
    lenses = taught(memory())
    known = lenses.recall("me", None, PHONE)
    # The photo tells hardly anything: its answer is as certain as its prior.
    sigma = 0.95 * known.prior.log_focal_scale
    assert not lenses.learn("me", None, PHONE, known, answer(known.intrinsics, 90.0, sigmas=(sigma, 0.001, 0.001)))
    assert lenses.recall("me", None, PHONE) == known


# ------------------------------------------------------------------ jobs


@pytest.fixture(autouse=True, scope="module")
def stepping() -> Iterator[None]:
    with fake_estimators():
        yield


def photo(orientation: int = 1, seed: int = 0, model: str = "iPhone 12") -> bytes:
    exif = Image.Exif()
    exif.update({MAKE: "Apple", MODEL: model, ORIENTATION: orientation})
    exif.get_ifd(0x8769).update({FOCAL: 4.2, FOCAL_35: 26})
    file, pixels = BytesIO(), np.random.default_rng(seed).integers(0, 256, (60, 80, 3), np.uint8)
    Image.fromarray(pixels).save(file, "JPEG", exif=exif)
    return file.getvalue()


@dataclass
class SureEngine(EmbeddedEngine):
    """Localizes every photo surely, with the lens `TRUE`, each from another place."""

    lens: Intrinsics = TRUE
    photos: list[Query] = field(default_factory=list)
    before: Callable[[], object] = bool

    def __post_init__(self) -> None:
        super().__init__(EngineConfig("stepping"))
        self.add_loaded("room", make_scene())

    def localize(self, task: LocalizeTask, on_record: OnRecord) -> EngineAnswer:
        self.before()
        query = task.source
        assert isinstance(query, Query)
        self.photos.append(query)
        size = query.photo_intrinsics.width, query.photo_intrinsics.height
        upright = oriented(self.lens, *ORIENTATIONS[6]) if size[1] > size[0] else self.lens
        found = answer(upright.resized(*size), 20.0 * len(self.photos), query.intrinsics_source)
        on_record(JobRecord(found.records[0]), None)
        return EngineAnswer(JobResult(found, task.decode, None, {}), "room")


@contextmanager
def sure_service(**changes) -> Iterator[tuple[httpx.Client, SureEngine]]:
    engine = SureEngine()
    with serving(create_app(settings(**changes), engine)) as client:
        until_ready(client)
        yield client, engine


def test_the_second_photo_of_a_phone_starts_from_the_first_ones_lens():
    with sure_service() as (client, engine):
        first, second, third = (post(client, photo(seed=k), camera_id="mine").json() for k in range(3))
        listed = client.get("/lenses").json()["lenses"]
        other = post(client, photo(model="iPhone 13")).json()
        told = {"width": 80, "height": 60, "fx": 60, "fy": 60, "cx": 40, "cy": 30}
        given = post(client, photo(), camera_id="mine", intrinsics=told).json()
        for bad in ("", "x" * 65, "a\nb", "ä"):
            body = {"photo": "AAAA", "camera_id": bad}
            assert_problem(client.post("/localize", json=body), 400, "invalid_request", "camera_id")
    assert [job["camera_id"] for job in (first, other)] == ["mine", None]
    sources = [job["result"]["intrinsics_source"] for job in (first, second, third, other, given)]
    assert sources == ["exif", "memory", "memory", "exif", "given"]
    assert [job["lens"] and job["lens"]["photos"] for job in (first, second, third, other, given)] == [
        None,
        1,
        2,
        None,
        None,
    ]
    assert engine.photos[0].photo_intrinsics.fx == pytest.approx(26 / 36 * 80, rel=0.05)
    for query in engine.photos[1:3]:
        assert query.photo_intrinsics.fx == pytest.approx(3050 / 4032 * 80)
        assert query.photo_intrinsics.distortion == pytest.approx((-0.06,))
        assert query.intrinsics.model == "PINHOLE"
    # Seen from one place, then from two.
    assert second["lens"]["focal_sigma"] == 0.03
    assert third["lens"]["focal_sigma"] < 0.01
    (lens,) = listed
    assert (lens["id"], lens["camera_id"], lens["make"], lens["model"]) == (
        *(third["lens"]["id"], "mine", "Apple", "iPhone 12"),
    )
    assert (lens["photos"], lens["viewpoints"], lens["tested"]) == (3, 3, True)
    assert lens["focal_length"] == pytest.approx(3050 / 4032)
    assert lens["k1"] == pytest.approx(-0.06)
    assert lens["principal_point"] == pytest.approx([40 / 4032, -24 / 4032])
    assert (lens["aspect"], lens["focal_35mm"], lens["is_video"]) == (1.33, 26.0, False)


def test_nothing_is_remembered_where_that_is_turned_off(tmp_path):
    with sure_service(data_dir=tmp_path) as (client, _):
        post(client, photo())
        assert len(client.get("/lenses").json()["lenses"]) == 1
    with sure_service(data_dir=tmp_path, keep_lenses=0) as (client, _):
        jobs = [post(client, photo(seed=k)).json() for k in range(2)]
        assert [job["result"]["intrinsics_source"] for job in jobs] == ["exif", "exif"]
        assert client.get("/lenses").json() == {"lenses": []}
    with sure_service(data_dir=tmp_path) as (client, _):
        assert client.get("/lenses").json() == {"lenses": []}


def bearer(key: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {key}"}


def test_lenses_belong_to_an_api_key(tmp_path):
    path = tmp_path / "keys.json"
    keys = {name: add_key(path, name, role) for name, role in (("a", "localize"), ("b", "localize"), ("root", "admin"))}
    with sure_service(keys_file=path, rate_limit="") as (client, _):

        def send(key: str, seed: int) -> str:
            headers = {**bearer(key), "Prefer": "wait=20"}
            done = client.post("/localize", files={"photo": photo(seed=seed)}, headers=headers).json()
            return done["result"]["intrinsics_source"]

        def listed(key: str) -> list[tuple[str, str]]:
            found = client.get("/lenses", headers=bearer(key)).json()["lenses"]
            return [(lens["owner"], lens["id"]) for lens in found]

        assert [send(keys["a"], 0), send(keys["b"], 1), send(keys["a"], 2)] == ["exif", "exif", "memory"]
        ((owner, mine),) = listed(keys["a"])
        ((_, yours),) = listed(keys["b"])
        assert owner == "a"
        assert mine != yours
        assert listed(keys["root"]) == [("a", mine), ("b", yours)]
        missing = client.delete(f"/lenses/{mine}", headers=bearer(keys["b"]))
        assert_problem(missing, 404, "lens_not_found", "lens")
        assert client.delete("/lenses", headers=bearer(keys["b"])).json() == {"deleted": 1}
        assert listed(keys["root"]) == [("a", mine)]
        # Another key of the same name is another owner.
        remove_key(path, "a")
        keys["a"] = add_key(path, "a", "localize")
        until(lambda: client.get("/lenses", headers=bearer(keys["a"])).status_code == 200)
        assert listed(keys["a"]) == []
        assert send(keys["a"], 3) == "exif"
        assert client.delete(f"/lenses/{mine}", headers=bearer(keys["root"])).json() == {"deleted": 1}
        assert len(listed(keys["root"])) == 1
        assert client.delete("/lenses", headers=bearer(keys["root"])).json() == {"deleted": 1}


def order(seed: int, idempotency_key: str | None = None) -> JobOrder:
    data = photo(seed=seed)
    return JobOrder(
        data, "p.jpg", hashlib.sha256(data).hexdigest(), JobSpec("stepping"), "me", idempotency_key, str(seed), "me"
    )


@contextmanager
def running(store: MemoryJobStore, photos: MemoryPhotoStore, lenses: LensMemory, engine: SureEngine) -> Iterator[Jobs]:
    engine.start()
    until(lambda: engine.readiness().ready)
    config = JobsConfig(workers=1, lease_s=0.6, shutdown_s=0)
    jobs = Jobs(config, engine, store, photos, CountingObserver(), lenses)
    jobs.start()
    try:
        yield jobs
    finally:
        jobs.close()
        engine.close()


def test_a_job_keeps_the_prior_that_it_was_accepted_with():
    """Even after a restart, and whatever was learnt meanwhile."""
    store, photos, lenses = MemoryJobStore(), MemoryPhotoStore(), memory()
    taught(lenses, 2, open_photo(photo()).camera)
    known = lenses.recall("me", None, open_photo(photo()).camera)
    # The first process ends before the job is started.
    engine = SureEngine()
    with running(store, photos, lenses, engine) as jobs:
        engine.before = lambda: until(lambda: jobs._worker.closing.is_set())
        blocking = jobs.accept(order(0))
        until(lambda: jobs.get(blocking.id).state == "running")
        waiting = jobs.accept(order(1))
        assert jobs.get(waiting.id).spec.lens.recalled == known
    taught(lenses, 4, open_photo(photo()).camera, replace(TRUE, fx=3300.0, fy=3300.0))
    assert lenses.recall("me", None, open_photo(photo()).camera).intrinsics.fx != known.intrinsics.fx
    again = SureEngine()
    with running(store, photos, lenses, again) as jobs:
        until(lambda: jobs.get(waiting.id).ended)
    assert again.photos
    for query in again.photos:
        assert query.photo_intrinsics == known.intrinsics
        assert query.lens_prior == known.prior
        assert query.intrinsics_source == "memory"


def test_several_photos_of_one_camera_start_from_its_lens():
    lenses = memory()
    camera = open_photo(photo()).camera
    taught(lenses, 2, camera)
    from service.jobs.read_photo import read_photo

    body = body_of([("a.jpg", photo(6, 0)), ("b.jpg", photo(6, 1))], {})
    found = read_photo(
        body.photo, JobSpec("stepping"), (0.0, 0.0, 0.0), recall=lambda seen: lenses.recall("me", None, seen)
    )
    assert found.camera == replace(camera, orientation=6)
    assert found.recalled == lenses.recall("me", None, found.camera)
    assert found.source.options.intrinsics == found.recalled.intrinsics == found.query.photo_intrinsics
    assert found.query.intrinsics_source == "memory"


def test_a_full_disk_costs_the_lesson_and_not_the_answer(monkeypatch):
    from service.errors import StorageFailed

    lenses, engine = memory(), SureEngine()

    def full(*_: object) -> None:
        raise StorageFailed("no space.")

    monkeypatch.setattr(lenses.store, "change", full)
    with running(MemoryJobStore(), MemoryPhotoStore(), lenses, engine) as jobs:
        job = jobs.accept(order(0))
        until(lambda: jobs.get(job.id).ended)
        assert jobs.get(job.id).state == "succeeded"
