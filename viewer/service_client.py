"""HTTP client of a splatfix service; returns `service.types` and `service.results`. The only file with httpx."""

from __future__ import annotations

import io
import json
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, cast

import httpx
import numpy as np
from jaxtyping import Float32, UInt8

from service.results import Candidates, IterationRecord, MatchVectors
from service.types import Camera, Intrinsics, IntrinsicsCorrection, NamedCamera, Pose, frozen

FINISHED = frozenset({"succeeded", "failed", "cancelled", "interrupted"})
_JOBS_LISTED = 50


class ServiceError(Exception):
    """The service doesn't respond, or responds with an error."""

    def __init__(self, path: str, problem: object, status: int | None = None) -> None:
        super().__init__(f"{path}: {problem if status is None else f'HTTP {status}'}")
        self.status = status
        """HTTP status; None if there was no response."""


@dataclass(frozen=True, slots=True)
class SceneDescription:
    """A scene without its Gaussians."""

    id: str
    name: str
    gaussians: int
    background_rgb: tuple[float, float, float]
    """Colour of rays that meet no Gaussian; 0..1."""
    up_in_world: tuple[float, float, float] | None
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
    score: float | None = None
    inliers: int | None = None


@dataclass(frozen=True, slots=True)
class Job:
    """A job without its records."""

    id: str
    state: str
    scene: str
    estimator: str
    photo_name: str
    photo: Intrinsics
    """Of the image that `ServiceClient.photo` returns."""
    truth: Pose | None
    """The true pose, where the request gave one."""
    outcome: JobOutcome | None
    """None until the job has ended."""
    photo_step: int | None = None
    """Of several photos, the step whose photo `ServiceClient.photo` returns; None: one photo, or not known yet."""

    def camera(self, record: IterationRecord) -> Camera:
        """Return the photo's camera as a record estimates it: its pose, and the intrinsics with its correction."""
        return Camera(self.photo.corrected(record.correction), record.pose)


class ServiceClient:
    """Client of one running service. Every method raises ServiceError. Safe to use from several threads."""

    def __init__(self, url: str, transport: httpx.BaseTransport | None = None, key: str = "") -> None:
        headers = {"Authorization": f"Bearer {key}"} if key else {}
        # No proxy from the environment, since the service is on loopback; a render takes seconds on a busy machine.
        self._http = httpx.Client(base_url=url, timeout=30.0, trust_env=False, transport=transport, headers=headers)

    def close(self) -> None:
        """Close all connections."""
        self._http.close()

    def scenes(self) -> list[str]:
        """Return the ids of the scenes that are in memory."""
        return [s["id"] for s in self._json("/scenes")["scenes"] if s["gaussians"] is not None]

    def scene(self, scene_id: str) -> SceneDescription:
        """Return a scene's description."""
        raw = self._json(f"/scenes/{scene_id}")
        return SceneDescription(
            raw["id"],
            raw["name"],
            raw["gaussians"] or 0,
            cast("tuple[float, float, float]", tuple(raw["background_rgb"] or (0, 0, 0))),
            cast("tuple[float, float, float] | None", raw["up_in_world"] and tuple(raw["up_in_world"])),
            tuple(NamedCamera(c["name"], _camera(c)) for c in raw["training_cameras"]),
        )

    def splats(self, scene_id: str, limit: int) -> Splats:
        """Return the `limit` most important Gaussians of a scene. Raises ValueError, too, for a truncated response."""
        return parse_splats(self._bytes(f"/scenes/{scene_id}/splats", {"max": limit}))

    def jobs(self) -> list[ListedJob]:
        """Return the newest jobs, the newest first."""
        jobs = json.loads(self._bytes("/jobs", {"limit": _JOBS_LISTED}))["jobs"]
        return [ListedJob(j["id"], j["state"], j["scene"], j["created"], j["status"]) for j in jobs]

    def job(self, job_id: str) -> Job:
        """Return a job."""
        return _job(self._json(f"/jobs/{job_id}"))

    def photo(self, job_id: str) -> bytes:
        """Return a job's photo as an image file."""
        return self._bytes(f"/jobs/{job_id}/photo")

    def render(self, job_id: str, index: int, *, matched: bool) -> bytes:
        """Return a JPEG of the scene at a record's pose, or at the camera that its matches refer to."""
        query = {"camera": "matches"} if matched else {}
        return self._bytes(f"/jobs/{job_id}/iterations/{index}/render.jpg", query)

    def picture(self, scene_id: str, camera: Camera) -> bytes:
        """Return a render of a scene as a JPEG."""
        return self._rendered(scene_id, camera, "jpeg")

    def depth(self, scene_id: str, camera: Camera) -> Float32[np.ndarray, "h w"]:
        """Return a depth map of a scene: z-depth in scene units; 0 where nothing is opaque."""
        return np.load(io.BytesIO(self._rendered(scene_id, camera, "depth")), allow_pickle=False)

    def _rendered(self, scene_id: str, camera: Camera, kind: str) -> bytes:
        k = camera.intrinsics
        size = {name: getattr(k, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
        pose = {"world_from_camera": camera.pose.world_from_camera.tolist()}
        path = f"/scenes/{scene_id}/render"
        try:
            response = self._http.post(path, json={"pose": pose, "intrinsics": size, "format": kind})
            return response.raise_for_status().content
        except httpx.HTTPStatusError as error:
            raise ServiceError(path, error, error.response.status_code) from error
        except httpx.HTTPError as error:
            raise ServiceError(path, error) from error

    def events(self, job_id: str, stop: threading.Event) -> Iterator[tuple[int, IterationRecord] | Job]:
        """Yield a job's records from the first one on, then the ended job; end early once `stop` is set.

        A record comes with the number of its attempt: a job that is tried again begins anew at record 0.
        """
        # The service sends a ping every 15 s; a stream that is silent for three of them is broken.
        timeout, path = httpx.Timeout(10.0, read=45.0), f"/jobs/{job_id}/events"
        try:
            with self._http.stream("GET", path, timeout=timeout) as response:
                if response.is_error:
                    raise ServiceError(path, "", response.status_code)
                for event, event_id, data in sse_events(response.iter_lines()):
                    if stop.is_set():
                        return
                    if event == "record":
                        yield int(event_id.partition(".")[0]), parse_record(json.loads(data))
                    # The last event of a stream.
                    elif event in ("result", "error"):
                        yield _job(json.loads(data))
                        return
        except httpx.HTTPError as error:
            raise ServiceError(path, error) from error

    def _json(self, path: str) -> Any:
        return json.loads(self._bytes(path))

    def _bytes(self, path: str, query: dict[str, Any] | None = None) -> bytes:
        try:
            return self._http.get(path, params=query).raise_for_status().content
        except httpx.HTTPStatusError as error:
            raise ServiceError(path, error, error.response.status_code) from error
        except httpx.HTTPError as error:
            raise ServiceError(path, error) from error


def sse_events(lines: Iterator[str]) -> Iterator[tuple[str, str, str]]:
    """Yield (event, id, data) of a server-sent event stream; a comment, which is a ping, yields ("", "", "")."""
    event, event_id, data = "message", "", []
    for line in lines:
        field, _, value = line.partition(":")
        if line and not field:
            yield "", "", ""
        elif field == "event":
            event = value.strip()
        elif field == "id":
            event_id = value.strip()
        elif field == "data":
            data.append(value.removeprefix(" "))
        elif not line:
            if data:
                yield event, event_id, "\n".join(data)
            event, event_id, data = "message", "", []


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


def parse_record(raw: dict[str, Any]) -> IterationRecord:
    """Return the record in an event of `/jobs/{id}/events`, as decoded JSON."""
    matches, candidates = raw["matches"], raw["candidates"]
    scalars = ("loss", "num_matches", "num_inliers", "step_deg", "step_units", "index", "elapsed_s", "cpu_s")
    return IterationRecord(
        stage=raw["stage"],
        pose=_pose(raw),
        correction=IntrinsicsCorrection(**raw["intrinsics_correction"]),
        matches=matches
        and MatchVectors(
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


def _job(raw: dict[str, Any]) -> Job:
    return Job(
        raw["id"],
        raw["state"],
        raw["scene"],
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
        return JobOutcome(result["status"], result["reason"], result["hint"], result["score"], result["inliers"])
    if error:
        return JobOutcome(raw["state"], error["detail"], error["hint"])
    return JobOutcome(raw["state"], "", "") if raw["state"] in FINISHED else None


def _intrinsics(raw: dict[str, Any]) -> Intrinsics:
    return Intrinsics(**{**raw, "distortion": tuple(raw["distortion"])})


def _camera(raw: dict[str, Any]) -> Camera:
    return Camera(_intrinsics(raw["intrinsics"]), _pose(raw))


def _pose(raw: dict[str, Any]) -> Pose:
    return Pose(np.array(raw["world_from_camera"], np.float64))
