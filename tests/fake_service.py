"""A service for the viewer's tests: scripted jobs, answered with the API's own models; no renderer.

`FakeService.transport` goes into `service.client.Client`. A job's events stay open until `finish`, so a test
decides what has happened when.
"""

from __future__ import annotations

import io
import json
import re
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime

import httpx
import numpy as np
from PIL import Image

from service.coverage.calibration import Calibration
from service.coverage.coverage_map import CoverageMap, Trial
from service.geometry import look_at
from service.jobs.model import JobResult
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
from service.scene_manager.splat_sample import packed_splats
from service.scene_manager.status import CoverageStatus
from service.types import Camera, GaussianScene, Intrinsics, NamedCamera, Pose, SceneInfo
from service.web.schemas.conversion import intrinsics_out, named_camera_out, pose_out, record_out, result_out
from service.web.schemas.coverage import coverage_status_out
from service.web.schemas.job_results import FrameOut
from service.web.schemas.jobs import JobLinks, JobOut, PhotoOut
from service.web.schemas.scenes import SceneLinks, SceneOut
from service.web.viewer_relay import Upstream

PHOTO = Intrinsics(96, 64, 80.0, 80.0, 48.0, 32.0)


EXACT_RGB = (180, 60, 160)
"""Of a scene rendered on request."""


def jpeg(rgb: tuple[int, int, int], width: int = PHOTO.width, height: int = PHOTO.height) -> bytes:
    """A picture of one colour."""
    buffer = io.BytesIO()
    Image.new("RGB", (width, height), rgb).save(buffer, "JPEG", quality=95)
    return buffer.getvalue()


def render_rgb(index: int, *, matched: bool) -> tuple[int, int, int]:
    """The colour of a fake render: tells which record it is of, and from which camera."""
    return (200 if matched else 20, (40 * index) % 256, 90)


def until(condition: Callable[[], object], what: str, seconds: float = 20.0) -> None:
    """Wait for another thread's work."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, f"waited in vain: {what}"
        time.sleep(0.01)


def threads(name: str) -> list[threading.Thread]:
    return [t for t in threading.enumerate() if t.name == name]


def orbit(share: float) -> Pose:
    angle = 2 * np.pi * share
    eye = np.array([3 * np.cos(angle), 3 * np.sin(angle), 1.0])
    return look_at(eye, np.zeros(3), np.array([0.0, 0.0, 1.0]))


def scene(count: int = 300, cameras: int = 12) -> GaussianScene:
    """A coloured ball of Gaussians seen from all around."""
    rng = np.random.default_rng(0)
    return GaussianScene(
        means=rng.normal(size=(count, 3)).astype(np.float32) * 0.5,
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        scales=np.full((count, 3), 0.05, np.float32),
        opacities=np.full(count, 0.9, np.float32),
        sh=rng.normal(size=(count, 1, 3)).astype(np.float32),
        info=SceneInfo("ball", "A ball", "0" * 64, "ply", up_in_world=(0.0, 0.0, 1.0)),
        cameras=tuple(NamedCamera(f"{k}.jpg", Camera(PHOTO, orbit(k / cameras))) for k in range(cameras)),
    )


def records(count: int, seed: int = 0) -> list[IterationRecord]:
    """A trace that turns towards its answer; the first record has candidates and every one has matches."""
    rng = np.random.default_rng(seed)
    result = []
    for k in range(count):
        px = rng.uniform(0, 64, (20, 2)).astype(np.float32)
        pose = orbit(0.1 + 0.1 / (k + 1))
        result.append(
            IterationRecord(
                "retrieve" if k == 0 else "refine",
                pose,
                loss=1.0 / (k + 1),
                num_matches=100 + k,
                num_inliers=50 + k,
                step_deg=2.0 / (k + 1),
                step_units=0.5 / (k + 1),
                matches=MatchVectors(px, px + 1, np.arange(20) % 4 > 0, Camera(PHOTO, pose)),
                candidates=Candidates(
                    np.stack([orbit(s).world_from_camera for s in (0.1, 0.4, 0.7)]), np.array([0.9, 0.5, 0.2])
                )
                if k == 0
                else None,
                index=k,
                elapsed_s=0.01 * k,
            )
        )
    return result


def coverage_map(found: float = 0.95) -> CoverageMap:
    """Two places of the ball's scene: beside each other on the orbit, looked at in four directions."""
    poses = [orbit(share) for share in (0.0, 0.1)]
    trials = tuple(Trial(pose, Status.LOCALIZED, found > 0.5, 0.1, 0.01, 0.1) for pose in poses * 20)
    sees = np.array([[True, True, True, False], [True, True, True, False]])
    return CoverageMap(
        "0" * 64, np.eye(3), 0.8, np.array([pose.position_in_world for pose in poses]),
        np.arange(4) * np.pi / 2, sees, np.full((2, 4), 0.1), trials, (), Calibration(), 1.0,
    )  # fmt: skip


@dataclass
class FakeJob:
    id: str
    records: list[IterationRecord] = field(default_factory=list)
    estimate: PoseEstimate | None = None
    truth: Pose | None = None
    walk: list[Status] = field(default_factory=list)
    """Of several photos, what became of each."""
    created: datetime = field(default_factory=lambda: datetime.now(UTC))
    changed: threading.Condition = field(default_factory=threading.Condition)
    attempt: int = 1

    def add(self, record: IterationRecord) -> None:
        with self.changed:
            self.records.append(replace(record, index=len(self.records)))
            self.changed.notify_all()

    def restart(self) -> None:
        """Begin another attempt."""
        with self.changed:
            self.attempt, self.records = self.attempt + 1, []
            self.changed.notify_all()

    def finish(self, status: Status = Status.LOCALIZED, reason: Reason = Reason.VERIFIED) -> None:
        verdict = Verdict(status, reason, 0.93, 212, 0.8, 0.9, np.eye(6))
        ending = PoseEstimate(
            pose=self.records[-1].pose,
            verdict=verdict,
            intrinsics=PHOTO,
            intrinsics_source="given",
            scene_id="ball",
            scene_sha256="0" * 64,
            estimator="view_index",
            rasterizer="cpu",
            matcher="xfeat",
            seed=0,
            budget_exhausted=False,
            renders=0,
            timings=(),
            warnings=(),
            records=tuple(self.records),
        )
        with self.changed:
            self.estimate = ending
            self.changed.notify_all()

    def out(self) -> JobOut:
        decode = StageTiming("decode", 0, 0)
        result = self.estimate and result_out(JobResult(self.estimate, decode, None, {"splatfix": "0"}))
        if result and self.walk:
            frames = [self._frame(k, status) for k, status in enumerate(self.walk)]
            result = result.model_copy(update={"frames": frames})
        links = dict.fromkeys(JobLinks.model_fields, "/")
        return JobOut(
            id=self.id,
            state="succeeded" if result else "running",
            scene="ball",
            requested_scene="ball",
            estimator="view_index",
            attempt=1,
            created=self.created,
            started=self.created,
            finished=None,
            records=len(self.records),
            stage=None,
            status=result and result.status,
            score=result and result.score,
            links=JobLinks(**links),
            photo=PhotoOut(name="<b>holiday</b>.jpg", sha256="0" * 64, intrinsics=intrinsics_out(PHOTO)),
            seed=0,
            budget_s=None,
            deadline=None,
            options={},
            prior=None,
            prior_region=None,
            truth=self.truth and pose_out(self.truth),
            result=result,
            error=None,
        )

    def _frame(self, index: int, status: Status) -> FrameOut:
        return FrameOut(
            index=index,
            name=f"{index}.jpg",
            time_s=index,
            status=status,
            reason=Reason.VERIFIED,
            score=0.9,
            tracked=index > 0,
            world_from_camera=pose_out(self.records[index].pose).world_from_camera,
            covariance=None,
        )

    def events(self) -> Iterator[bytes]:
        sent, attempt = 0, self.attempt
        while True:
            with self.changed:
                if len(self.records) == sent and self.estimate is None:
                    self.changed.wait(0.2)
                fresh, done = self.records[sent:], self.estimate is not None
            yield b": ping\n\n"
            if self.attempt != attempt:
                sent, attempt = 0, self.attempt
                yield b"event: restarted\ndata: {}\n\n"
            for record in fresh:
                yield f"event: record\nid: {attempt}.{sent}\ndata: {record_out(record).model_dump_json()}\n\n".encode()
                sent += 1
            if done:
                yield f"event: result\nid: end\ndata: {self.out().model_dump_json()}\n\n".encode()
                return


class FakeService:
    """Jobs newest first, one scene."""

    def __init__(self, gaussians: GaussianScene | None = None) -> None:
        self.scene = gaussians or scene()
        self.jobs: list[FakeJob] = []
        self.scenes = ["ball"]
        """Ids; all have the same content."""
        self.viewer_started = 0.0
        """Of the viewer."""
        self.pending: list[str] = []
        """What `/readyz` waits for."""
        self.listed = 100
        """Jobs on the first page of the list."""
        self.unloaded = False
        """The scene isn't in memory yet."""
        self.coverage = CoverageStatus("none")
        self.anchors: dict[str, list[float]] = {}
        self.photos_kept = True
        self.loading_s = 0.0
        """How long splats take."""
        self.asked: list[str] = []
        """Paths, in order."""
        self.renders: list[dict] = []
        """What was to be rendered on request."""
        self.transport = httpx.MockTransport(self._answer)

    def upstream(self, port: int) -> Upstream:
        """What a relay connects to."""
        fake = self

        class _Upstream:
            def __init__(self) -> None:
                self.port = port

            @property
            def started(self) -> float:
                return fake.viewer_started

        return _Upstream()

    def job(self, job_id: str, steps: int = 0, *, finished: bool = False) -> FakeJob:
        """Add a job, the newest from now on."""
        job = FakeJob(job_id)
        for record in records(steps):
            job.add(record)
        if finished:
            job.finish()
        self.jobs.insert(0, job)
        return job

    def _answer(self, request: httpx.Request) -> httpx.Response:
        path = request.url.path
        self.asked.append(path)
        if path == "/jobs":
            return httpx.Response(
                200, json={"jobs": [j.out().model_dump(mode="json") for j in self.jobs[: self.listed]]}
            )
        if path == "/scenes":
            scenes = [self._scene_out(name).model_dump(mode="json") for name in self.scenes]
            return httpx.Response(200, json={"scenes": scenes})
        _, kind, name, *rest = path.split("/", 3)
        if kind == "scenes" and self.unloaded:
            return httpx.Response(503, json={"code": "scene_not_ready", "detail": "scene 'ball' is loading."})
        if kind == "scenes" and not rest:
            return httpx.Response(200, json=self._scene_out(name).model_dump(mode="json"))
        if kind == "scenes" and rest == ["render"]:
            return self._render(json.loads(request.content))
        if kind == "scenes" and rest == ["anchors"]:
            anchors = [{"name": name, "position": position} for name, position in self.anchors.items()]
            return httpx.Response(200, json={"anchors": anchors})
        if kind == "scenes" and rest == ["coverage"]:
            answer = coverage_status_out(self.coverage, path)
            return httpx.Response(200, json=answer.model_dump(mode="json"))
        if kind == "scenes" and rest == ["splats"]:
            time.sleep(self.loading_s)
            return httpx.Response(200, content=packed_splats(self.scene, int(request.url.params["max"])))
        match = re.fullmatch(r"/jobs/(\w+)(/.*)?", path)
        job = next((j for j in self.jobs if match and j.id == match[1]), None)
        return self._answer_of(job, (match and match[2]) or "", request) if job else httpx.Response(404)

    def _render(self, wanted: dict) -> httpx.Response:
        """Depth is 3 everywhere, a picture is one colour."""
        self.renders.append(wanted)
        width, height = wanted["intrinsics"]["width"], wanted["intrinsics"]["height"]
        if wanted["format"] == "depth":
            file = io.BytesIO()
            np.save(file, np.full((height, width), 3, np.float32))
            return httpx.Response(200, content=file.getvalue())
        return httpx.Response(200, content=jpeg(EXACT_RGB, width, height))

    def _answer_of(self, job: FakeJob, rest: str, request: httpx.Request) -> httpx.Response:
        if rest == "":
            return httpx.Response(200, json=job.out().model_dump(mode="json"))
        if rest == "/events":
            return httpx.Response(200, content=job.events())
        if rest == "/photo" and not self.photos_kept:
            return httpx.Response(404)
        if rest == "/photo":
            return httpx.Response(200, content=jpeg((120, 160, 200)))
        index = int(rest.split("/")[2])
        matched = request.url.params.get("camera") == "matches"
        return httpx.Response(200, content=jpeg(render_rgb(index, matched=matched)))

    def _scene_out(self, name: str) -> SceneOut:
        info = self.scene.info
        return SceneOut(
            id=name,
            name=info.name,
            state="ready",
            gaussians=self.scene.count,
            sh_degree=0,
            cameras=len(self.scene.cameras),
            memory_bytes=self.scene.nbytes,
            index=None,
            jobs=0,
            uploaded=False,
            error=None,
            links=SceneLinks(self="/", splats="/", thumbnail="/"),
            sha256=info.sha256,
            format=info.format,
            background_rgb=list(info.background_rgb),
            background_is_known=info.background_is_known,
            up_in_world=info.up_in_world and list(info.up_in_world),
            metres_per_unit=None,
            render_mode="default",
            bounds_in_world=None,
            frames=[],
            warnings=[],
            training_cameras=[named_camera_out(c) for c in self.scene.cameras],
        )
