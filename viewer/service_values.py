"""What the service answers as values of `service.types` and `service.results`, and what the viewer shows of them."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import Any, cast

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from service import client as api
from service.results import Candidates, IterationRecord, MatchVectors
from service.types import Camera, Intrinsics, IntrinsicsCorrection, NamedCamera, Pose, frozen


@dataclass(frozen=True, slots=True)
class SceneDescription:
    """A scene without its Gaussians."""

    id: str
    name: str
    gaussians: int
    background_rgb: tuple[float, float, float]
    """Colour of rays that meet no Gaussian; 0..1."""
    up_in_world: tuple[float, float, float] | None
    metres_per_unit: float | None
    """None: lengths are known in scene units only."""
    cameras: tuple[NamedCamera, ...]


@dataclass(frozen=True, slots=True)
class Splats:
    """A scene's Gaussians by descending importance, without view-dependent colour."""

    centres: Float32[np.ndarray, "n 3"]
    covariances: Float32[np.ndarray, "n 6"]
    """xx, xy, xz, yy, yz, zz; world frame."""
    rgba: UInt8[np.ndarray, "n 4"]
    total: int
    """Number of Gaussians in the scene, of which these may be a part."""


@dataclass(frozen=True, slots=True)
class ListedJob:
    """A job as the list of jobs has it."""

    id: str
    state: str
    scene: str
    created: str
    """ISO 8601, UTC."""
    status: str | None
    """Of the result; None while there is none."""


@dataclass(frozen=True, slots=True)
class JobOutcome:
    """How a job ended."""

    status: str
    """localized, uncertain, not_localized; failed or cancelled where there is no result."""
    reason: str
    hint: str
    """What the search found and what to do about it; of a failed job, what to do."""
    score: float | None = None
    inliers: int | None = None


@dataclass(frozen=True, slots=True)
class Job:
    """A job without its records."""

    id: str
    state: str
    scene: str
    created: str
    """ISO 8601, UTC."""
    estimator: str
    photo_name: str
    photo: Intrinsics
    """Of the image that `Client.photo` returns."""
    truth: Pose | None
    """The true pose, where the request gave one."""
    outcome: JobOutcome | None
    """None until the job has ended."""
    photo_step: int | None = None
    """Of several photos, the step whose photo `Client.photo` returns; None: one photo, or not known yet."""

    def listed(self) -> ListedJob:
        """Return the job as the list of jobs has it."""
        return ListedJob(self.id, self.state, self.scene, self.created, self.outcome and self.outcome.status)

    def camera(self, record: IterationRecord) -> Camera:
        """Return the photo's camera as a record estimates it: its pose, and the intrinsics with its correction."""
        return Camera(self.photo.corrected(record.correction), record.pose)


@dataclass(frozen=True, slots=True)
class CoverageMap:
    """Where photos of a scene are found."""

    title: str
    cell: float
    positions_in_world: Float64[np.ndarray, "c 3"]
    directions_in_world: Float64[np.ndarray, "h 3"]
    """Horizontal, unit length."""
    probabilities: Float64[np.ndarray, "c h"]
    """NaN: nothing of the scene is in view."""


@dataclass(frozen=True, slots=True)
class CoverageAnswer:
    """A coverage map, or how far it is measured."""

    state: str
    done: int
    total: int
    problem: str
    found: CoverageMap | None


@dataclass(frozen=True, slots=True)
class FoundCamera:
    """The camera of a photo that a job has found."""

    camera: Camera
    status: str


def coverage_of(raw: dict[str, Any]) -> CoverageAnswer:
    """Return a coverage map from the API's answer."""
    found, error = raw["map"], raw["error"]
    return CoverageAnswer(
        raw["state"], raw["done"], raw["total"], error["detail"] if error else "", found and _coverage_map(found)
    )


def _coverage_map(raw: dict[str, Any]) -> CoverageMap:
    angles = np.radians(raw["headings_deg"])
    in_plan = np.stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))], 1)
    cells = raw["cells"]
    return CoverageMap(
        raw["title"],
        raw["cell"],
        frozen(np.array([cell["position"] for cell in cells]).reshape(-1, 3), np.float64),
        frozen(in_plan @ np.array(raw["plan_from_world"]), np.float64),
        frozen(np.array([cell["probabilities"] for cell in cells], np.float64), np.float64),
    )


def found_cameras(job: api.Job) -> tuple[FoundCamera, ...]:
    """Return the cameras of a job's photos but for those that are not localized."""
    result = job.result
    if result is None:
        return ()
    camera = Intrinsics(**{**result.raw["intrinsics"], "distortion": tuple(result.raw["intrinsics"]["distortion"])})
    answers = result.frames or (result,)
    found = [(Pose(answer.pose.world_from_camera), answer.status) for answer in answers]
    return tuple(FoundCamera(Camera(camera, pose), status) for pose, status in found if status != "not_localized")


def listed_job_of(job: api.Job) -> ListedJob:
    """Return an entry of the list of jobs."""
    return ListedJob(job.id, job.state, job.scene, job.raw["created"], job.raw["status"])


def description_of(scene: api.Scene) -> SceneDescription:
    """Return a scene's description."""
    raw = scene.raw
    return SceneDescription(
        raw["id"],
        raw["name"],
        raw["gaussians"] or 0,
        cast("tuple[float, float, float]", tuple(raw["background_rgb"] or (0, 0, 0))),
        cast("tuple[float, float, float] | None", raw["up_in_world"] and tuple(raw["up_in_world"])),
        raw["metres_per_unit"],
        tuple(NamedCamera(c["name"], _camera(c)) for c in raw["training_cameras"]),
    )


def api_camera(camera: Camera) -> tuple[api.Pose, api.Intrinsics]:
    """Return a camera as the client takes it."""
    return api.Pose(camera.pose.world_from_camera), api.Intrinsics(**asdict(camera.intrinsics))


def parse_splats(data: bytes) -> Splats:
    """Return the splats in a response of `/scenes/{id}/splats`. Raises ValueError if it is truncated."""
    start = 4 + int.from_bytes(data[:4], "little")
    header = json.loads(data[4:start])
    n = header["count"]
    # 9 float32 and 4 bytes a splat.
    if len(data) != start + 40 * n:
        raise ValueError(f"{len(data)} bytes for {n} splats")
    floats = np.frombuffer(data, "<f4", 9 * n, start)
    rgba = np.frombuffer(data, np.uint8, 4 * n, start + 36 * n)
    return Splats(floats[: 3 * n].reshape(n, 3), floats[3 * n :].reshape(n, 6), rgba.reshape(n, 4), header["total"])


def record_of(record: api.Record) -> IterationRecord:
    """Return a step of a job."""
    raw = record.raw
    matches, candidates = raw["matches"], raw["candidates"]
    scalars = ("loss", "num_matches", "num_inliers", "step_deg", "step_units", "index", "elapsed_s", "cpu_s")
    return IterationRecord(
        stage=raw["stage"],
        pose=_pose(raw),
        correction=IntrinsicsCorrection(**raw["intrinsics_correction"]),
        matches=matches
        and MatchVectors(
            # An empty list has no second dimension of its own.
            frozen(np.array(matches["photo_px"]).reshape(-1, 2), np.float32),
            frozen(np.array(matches["render_px"]).reshape(-1, 2), np.float32),
            frozen(np.array(matches["inlier"]), np.bool_),
            _camera(matches["render_camera"]),
        ),
        candidates=candidates
        and Candidates(
            frozen(np.array(candidates["world_from_camera"]).reshape(-1, 4, 4), np.float64),
            frozen(np.array(candidates["scores"]), np.float64),
        ),
        **{name: raw[name] for name in scalars},
    )


def job_of(job: api.Job) -> Job:
    """Return a job."""
    raw = job.raw
    return Job(
        raw["id"],
        raw["state"],
        raw["scene"],
        raw["created"],
        raw["estimator"],
        raw["photo"]["name"],
        _intrinsics(raw["photo"]["intrinsics"]),
        raw["truth"] and Pose(np.array(raw["truth"]["world_from_camera"]["matrix"], np.float64)),
        _outcome(raw),
        _photo_step((raw["result"] or {}).get("frames")),
    )


def _photo_step(frames: list[dict[str, Any]] | None) -> int | None:
    """Return the step whose photo the service keeps: the last one localized, else the last one."""
    if not frames:
        return None
    return next((f["index"] for f in reversed(frames) if f["status"] == "localized"), frames[-1]["index"])


def _outcome(raw: dict[str, Any]) -> JobOutcome | None:
    result, error = raw["result"], raw["error"]
    if result:
        hint = " ".join(filter(None, (result.get("search_summary"), result["hint"])))
        return JobOutcome(result["status"], result["reason"], hint, result["score"], result["inliers"])
    if error:
        return JobOutcome(raw["state"], error["detail"], error["hint"])
    return JobOutcome(raw["state"], "", "") if raw["state"] in api.ENDED else None


def _intrinsics(raw: dict[str, Any]) -> Intrinsics:
    return Intrinsics(**{**raw, "distortion": tuple(raw["distortion"])})


def _camera(raw: dict[str, Any]) -> Camera:
    return Camera(_intrinsics(raw["intrinsics"]), _pose(raw))


def _pose(raw: dict[str, Any]) -> Pose:
    return Pose(np.array(raw["world_from_camera"], np.float64))
