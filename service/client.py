"""A client of a splatfix service in one file: copy it into an application. Needs httpx, numpy and Python 3.10.

    with Client("http://127.0.0.1:8000") as service:
        result = service.localize("photo.jpg", scene="studio")
        print(result.status, result.pose.world_from_camera)

`AsyncClient` has the same methods as coroutines. Poses are 4x4 arrays on column vectors, `world_from_camera`, with
OpenCV's camera axes (+x right, +y down, +z forward), lengths in scene units. Whatever the service answers beyond the
fields of these classes is in their `raw`. Every error is a ServiceError with the service's stable `code`.
"""

from __future__ import annotations

import asyncio
import io
import json
import os
import ssl
import time
import uuid
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any
from urllib.parse import quote

import httpx
import numpy as np

ENDED = frozenset({"succeeded", "failed", "cancelled", "interrupted"})
"""States of a job that has ended."""
MAX_WAIT_S = 3600.0
WEEK_S = 7 * 86_400.0
_RECONNECT_S = 1.0
# The service sends a ping every 15 s; a stream that is silent for three of them is broken.
_STREAM = httpx.Timeout(10.0, read=45.0)
_UPLOAD = httpx.Timeout(60.0, read=1800.0)

Json = dict[str, Any]
Photo = str | os.PathLike[str] | bytes
"""A file's path, or its bytes: JPEG, PNG, WebP, HEIC, or a video."""


class ServiceError(Exception):
    """The service answered with an error, doesn't answer, or a job ended without a result."""

    def __init__(self, code: str, detail: str, *, status: int | None = None, problem: Json | None = None) -> None:
        self.code, self.detail, self.status = code, detail, status
        """`code` is stable: of the service, or `unreachable`, `timeout`, `http_error`, `closed`; `status` is HTTP's."""
        self.where: str = (problem or {}).get("where", "")
        self.hint: str = (problem or {}).get("hint", "")
        self.retry_after_s: float | None = None
        super().__init__(" ".join(filter(None, [f"{self.where}:" if self.where else "", detail, self.hint])))


@dataclass(frozen=True)
class Intrinsics:
    """A camera of the upright photo in pixels; the centre of the first pixel is (0.5, 0.5)."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: str = "PINHOLE"
    """COLMAP's name of the model."""
    distortion: tuple[float, ...] = ()
    trust: str = "exact"
    """`approximate`: estimated with the pose, beginning from here."""

    @classmethod
    def parse(cls, raw: Json) -> Intrinsics:
        """Return the intrinsics of an answer's document."""
        return cls(**{**raw, "distortion": tuple(raw["distortion"])})


@dataclass(frozen=True)
class Pose:
    """A camera's pose in the scene's world."""

    world_from_camera: np.ndarray
    """float64, 4x4: columns 0 to 2 are the camera's x, y and z axes in the world, column 3 its centre."""

    @property
    def camera_from_world(self) -> np.ndarray:
        """The inverse, 4x4: the extrinsics of OpenCV and COLMAP."""
        inverse = np.eye(4)
        # The inverse of a rotation is its transpose: exact, and cheaper than inverting the matrix.
        inverse[:3, :3] = self.world_from_camera[:3, :3].T
        inverse[:3, 3] = -inverse[:3, :3] @ self.world_from_camera[:3, 3]
        return inverse

    @property
    def position(self) -> np.ndarray:
        """The camera's centre in the world, 3 numbers."""
        return self.world_from_camera[:3, 3]

    @property
    def opengl(self) -> np.ndarray:
        """The pose with the axes of OpenGL, Blender, three.js and ARKit (+y up, +z backwards), 4x4."""
        return self.world_from_camera @ np.diag([1.0, -1.0, -1.0, 1.0])

    def project(self, point_in_world: Sequence[float], camera: Intrinsics) -> np.ndarray:
        """Return the pixel of a point through a pinhole, x and y; the camera's distortion is left out."""
        x, y, z = (self.camera_from_world @ [*point_in_world, 1.0])[:3]
        return np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])


@dataclass(frozen=True)
class Prior:
    """What is known of the pose: a pose alone may be wrong; sigmas or a covariance make it a Gaussian; a box bounds."""

    pose: Pose | None = None
    sigma_deg: float | None = None
    sigma_units: float | None = None
    covariance: np.ndarray | None = None
    """6x6, of the same twist as a result's."""
    box: Sequence[Sequence[float]] | None = None
    """Lower and upper corner for the camera's centre, in the world."""

    def fields(self) -> Json:
        """Return the prior as a request has it, without what is not given."""
        given: Json = {"sigma_deg": self.sigma_deg, "sigma_units": self.sigma_units}
        given["world_from_camera"] = None if self.pose is None else self.pose.world_from_camera.tolist()
        given["covariance"] = None if self.covariance is None else np.asarray(self.covariance).tolist()
        given["box"] = None if self.box is None else np.asarray(self.box, float).tolist()
        # Which fields are there says what kind of prior it is.
        return {name: value for name, value in given.items() if value is not None}


@dataclass(frozen=True)
class Accuracy:
    """How accurate a pose must be to be localized: bounds of its rotation, and of its position in one measure."""

    deg: float = 5.0
    units: float | None = None
    metres: float | None = None
    share: float | None = None
    """Of the distance to what is seen; 0.02 if the others are None, too."""

    def fields(self) -> Json:
        """Return the request's JSON."""
        return {name: value for name, value in self.__dict__.items() if value is not None}


@dataclass(frozen=True)
class Frame:
    """The answer for one photo of a sequence, or one frame of a video."""

    index: int
    name: str
    time_s: float
    status: str
    reason: str
    score: float
    pose: Pose
    covariance: np.ndarray | None
    raw: Json = field(repr=False)


@dataclass(frozen=True)
class Record:
    """One step of a job; of a sequence, one photo."""

    index: int
    stage: str
    elapsed_s: float
    pose: Pose
    """The best so far."""
    frame: Frame | None
    attempt: int
    """Of the job: a higher one than before makes all earlier records void."""
    raw: Json = field(repr=False)


@dataclass(frozen=True)
class Result:
    """The answer to a photo; of a sequence `frames` has all answers, and the other fields are the last localized's."""

    status: str
    """`localized`: use the pose. `uncertain`: check it. `not_localized`: don't use it."""
    reason: str
    hint: str
    advice: tuple[str, ...]
    """What would help this photo, by what was seen."""
    score: float
    """Probability that the pose is as accurate as was asked for: `right_place` times `precise`."""
    right_place: float | None
    precise: float | None
    pose: Pose
    intrinsics: Intrinsics
    covariance: np.ndarray | None
    """6x6 of the twist (rotation in rad, translation in scene units) in the camera's frame:
    true = world_from_camera @ exp(twist)."""
    scene: str
    frames: tuple[Frame, ...]
    warnings: tuple[str, ...]
    raw: Json = field(repr=False)

    @property
    def localized(self) -> bool:
        """Whether the pose may be used."""
        return self.status == "localized"


@dataclass(frozen=True)
class Job:
    """A job; `result` is None until it has succeeded."""

    id: str
    state: str
    scene: str
    estimator: str
    result: Result | None
    raw: Json = field(repr=False)

    @property
    def ended(self) -> bool:
        """Whether it is in a state that it can't leave."""
        return self.state in ENDED

    def answer(self) -> Result:
        """Return the result of an ended job. Raises ServiceError with the code of what went wrong."""
        if self.result is not None:
            return self.result
        problem = self.raw.get("error") or {}
        raise ServiceError(problem.get("code", self.state), problem.get("detail", f"The job is {self.state}."),
                           status=problem.get("status"), problem=problem)  # fmt: skip


@dataclass(frozen=True)
class Scene:
    """A scene; the file's fields are None until it is in memory."""

    id: str
    name: str
    state: str
    gaussians: int | None
    up_in_world: np.ndarray | None
    metres_per_unit: float | None
    raw: Json = field(repr=False)


@dataclass(frozen=True)
class Key:
    """What an API key may do."""

    name: str | None
    role: str
    """`read`, `localize`, `admin`: each includes those before it."""
    scenes: tuple[str, ...] | None
    """Names or patterns; None: all."""
    expires: datetime | None
    raw: Json = field(repr=False)
    """With rate, share of the queue and, of `all_keys`, when it was made."""


@dataclass(frozen=True)
class Event:
    """A server-sent event: `record`, `restarted`, `result`, `error`, or the empty name of a ping."""

    name: str
    id: str = ""
    data: str = ""

    def value(self) -> Record | Job | None:
        """Return what a `record`, or the `result` or `error` of the job's end, says; None of other events."""
        if self.name == "record":
            # The id is `attempt.index`.
            return parse_record(json.loads(self.data), int(self.id.partition(".")[0] or 1))
        return parse_job(json.loads(self.data)) if self.name in ("result", "error") else None


def parse_record(raw: Json, attempt: int) -> Record:
    """Return a step from the document of an event `record`."""
    frame = raw.get("frame") and _frame(raw["frame"])
    pose = _pose(raw["world_from_camera"])
    return Record(raw["index"], raw["stage"], raw["elapsed_s"], pose, frame, attempt, raw)


def parse_job(raw: Json) -> Job:
    """Return a job from its document, or from its entry in a list."""
    result = raw.get("result")
    return Job(raw["id"], raw["state"], raw["scene"], raw["estimator"], result and _result(result), raw)


def _result(raw: Json) -> Result:
    names = ("status", "reason", "hint", "score")
    return Result(
        **{name: raw[name] for name in names},
        advice=tuple(raw.get("advice", ())),
        right_place=raw.get("right_place"),
        precise=raw.get("precise"),
        pose=_pose(raw["pose"]["world_from_camera"]["matrix"]),
        intrinsics=Intrinsics.parse(raw["intrinsics"]),
        covariance=_covariance(raw),
        scene=raw["scene"]["id"],
        frames=tuple(map(_frame, raw.get("frames") or ())),
        warnings=tuple(raw["warnings"]),
        raw=raw,
    )


def _frame(raw: Json) -> Frame:
    names = ("index", "name", "time_s", "status", "reason", "score")
    pose = _pose(raw["world_from_camera"]["matrix"])
    return Frame(**{name: raw[name] for name in names}, pose=pose, covariance=_covariance(raw), raw=raw)


def _covariance(raw: Json) -> np.ndarray | None:
    return raw["covariance"] and np.array(raw["covariance"]["matrix"], np.float64)


def _pose(rows: list[list[float]]) -> Pose:
    return Pose(np.array(rows, np.float64))


def _scene(raw: Json) -> Scene:
    up = raw.get("up_in_world")
    names = ("id", "name", "state", "gaussians")
    return Scene(
        **{name: raw[name] for name in names},
        up_in_world=up and np.array(up, np.float64),
        metres_per_unit=raw.get("metres_per_unit"),
        raw=raw,
    )


class EventParser:
    """Turns the lines of a server-sent event stream into events; a comment, which is a ping, into a nameless one."""

    def __init__(self) -> None:
        self._name, self._id, self._data = "message", "", list[str]()

    def line(self, line: str) -> Event | None:
        """Take a line without its line break; return the event that it ends, if it does."""
        name, _, value = line.partition(":")
        # A line that begins with a colon is a comment, which the service sends while nothing happens.
        if line and not name:
            return Event("")
        if name == "event":
            self._name = value.strip()
        elif name == "id":
            self._id = value.strip()
        elif name == "data":
            # One space after the colon belongs to the notation, further ones to the data.
            self._data.append(value[1:] if value.startswith(" ") else value)
        elif not line:
            event = Event(self._name, self._id, "\n".join(self._data)) if self._data else None
            self._name, self._id, self._data = "message", "", []
            return event
        return None


@dataclass
class _Waiting:
    """How long a call may wait, and what a resumed stream has seen."""

    timeout_s: float
    last_id: str = ""
    since: float = field(default_factory=time.monotonic)

    def pause(self, error: ServiceError) -> float:
        """Return the seconds until a lost connection or a full queue is tried again. Raises `error` if it isn't."""
        if error.code != "unreachable" and error.retry_after_s is None:
            raise error
        # A service that is busy says when to come again; a lost connection says nothing.
        seconds = _RECONNECT_S if error.retry_after_s is None else error.retry_after_s
        if time.monotonic() - self.since + seconds > self.timeout_s:
            raise error
        return seconds

    def value(self, event: Event, job_id: str) -> Record | Job | None:
        """Return what an event says, and note where the stream is resumed. Raises ServiceError once it is too late."""
        self.last_id = event.id or self.last_id
        value = event.value()
        # An answer that arrives late is an answer nevertheless.
        if not isinstance(value, Job) and time.monotonic() - self.since > self.timeout_s:
            raise ServiceError("timeout", f"Job {job_id} has not ended after {self.timeout_s:g} s; it goes on.")
        return value


def _form(photos: Photo | Sequence[Photo], fields: Mapping[str, Any]) -> Json:
    """Return the multipart form of a request; nested fields are JSON text. Raises TypeError, OSError."""
    data: Json = {}
    for name, value in fields.items():
        value = {"world_from_camera": value.world_from_camera.tolist()} if isinstance(value, Pose) else value
        value = value.fields() if isinstance(value, (Prior, Accuracy)) else value
        value = dict(value.__dict__) if isinstance(value, Intrinsics) else value
        value = value.tolist() if isinstance(value, np.ndarray) else value
        if value is not None:
            is_text = isinstance(value, str)
            data[name] = value if is_text else json.dumps(value)
    given = [photos] if isinstance(photos, (str, bytes, os.PathLike)) else list(photos)
    return {"data": data, "files": [("photo", _file(photo)) for photo in given]}


def _file(photo: Photo) -> tuple[str, bytes]:
    return ("photo", photo) if isinstance(photo, bytes) else (Path(photo).name, Path(photo).read_bytes())


def _settings(key: str | None, timeout_s: float, certificate: str | os.PathLike[str] | None) -> Json:
    """Return httpx' arguments. Raises ValueError for a key that no header can carry."""
    key = (key or "").strip()
    if not key.isascii() or any(c.isspace() for c in key):
        raise ValueError("an API key is printable ASCII without spaces, as `splatfix keys add` printed it.")
    # An empty key is none: "Bearer " is no header that HTTP allows.
    found: Json = {"headers": {"Authorization": f"Bearer {key}"} if key else {}, "timeout": timeout_s}
    return found if certificate is None else {**found, "verify": _trusting(Path(certificate))}


def _trusting(certificate: Path) -> ssl.SSLContext:
    """Return a context that accepts one certificate: the first of a PEM file. Raises OSError, ValueError."""
    end = "-----END CERTIFICATE-----"
    first, found, _ = certificate.read_text("utf-8").partition(end)
    context = ssl.create_default_context(cadata=first + found)
    # The certificate itself is trusted, not its authority; then its name says nothing more.
    context.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN
    context.check_hostname = False
    return context


def _checked(response: httpx.Response) -> httpx.Response:
    """Return a response without an error, whose body was read. Raises ServiceError."""
    if not response.is_error:
        return response
    try:
        problem = dict(response.json())
    except (ValueError, TypeError):
        problem = {}
    detail = problem.get("detail") or f"{response.request.url.path} answered HTTP {response.status_code}."
    # Without a problem document it is a proxy that answers, or another program.
    code = problem.get("code") or ("unreachable" if response.status_code >= 500 else "http_error")
    # Of a proxy 5xx means that the service is away, which may pass: such calls are tried again.
    error = ServiceError(code, detail, status=response.status_code, problem=problem)
    after = response.headers.get("Retry-After", "")
    # Retry-After may also be a date, which this service does not send.
    if response.status_code in (429, 503) and after.isdigit():
        error.retry_after_s = float(after)
    raise error


def _document(response: httpx.Response) -> Any:
    try:
        return response.json()
    except ValueError:
        detail = f"{response.request.url} answered no JSON: is it the address of a splatfix service?"
        raise ServiceError("http_error", detail, status=response.status_code) from None


def _unreachable(error: httpx.HTTPError, base: httpx.URL) -> ServiceError:
    return ServiceError("unreachable", f"{base} doesn't answer: {error or type(error).__name__}.")


def _render_body(camera: Intrinsics | None, pose: Pose, kind: str) -> Json:
    size = ("width", "height", "fx", "fy", "cx", "cy")
    body: Json = {"pose": {"world_from_camera": np.asarray(pose.world_from_camera).tolist()}, "format": kind}
    if camera is not None:
        body["intrinsics"] = {name: getattr(camera, name) for name in size}
    return body


def _depth(data: bytes) -> np.ndarray:
    # Never a pickle: whoever answers could run code here.
    return np.load(io.BytesIO(data), allow_pickle=False)


def _anchor_path(scene_id: str, name: str) -> str:
    return f"/scenes/{scene_id}/anchors/{quote(name, safe='')}"


def _anchors(raw: Json) -> dict[str, np.ndarray]:
    return {anchor["name"]: np.array(anchor["position"], np.float64) for anchor in raw["anchors"]}


def _address(base: httpx.URL, link: str) -> str:
    """Return the whole address of a path that the service answered, which has the service's sub-path already."""
    return str(base.join(link))


def _key(raw: Json) -> Key:
    # Python 3.10 doesn't read the Z of ISO 8601.
    expires = raw["expires"] and datetime.fromisoformat(raw["expires"].replace("Z", "+00:00"))
    scenes = None if raw["scenes"] is None else tuple(raw["scenes"])
    return Key(raw["name"], raw["role"], scenes, expires, raw)


def _key_body(role: str, limits: Mapping[str, Any]) -> Json:
    expires = limits.get("expires")
    return {"role": role, **limits, "expires": expires.isoformat() if isinstance(expires, datetime) else expires}


def _key_path(name: str) -> str:
    return f"/keys/{quote(name, safe='')}"


def _scene_pause(scene: Scene, waiting: _Waiting) -> float:
    """Return the seconds until a scene is looked at again. Raises ServiceError if it won't be ready."""
    problem = scene.raw.get("error")
    if problem:
        raise ServiceError(problem["code"], problem["detail"], status=problem["status"], problem=problem)
    # It stays so until somebody loads it: waiting would not end.
    if scene.state == "unloaded":
        raise ServiceError("scene_unloaded", f"Scene '{scene.id}' is not in memory: load it first.")
    if time.monotonic() - waiting.since > waiting.timeout_s:
        raise ServiceError("timeout", f"Scene '{scene.id}' is {scene.state} after {waiting.timeout_s:g} s.")
    return 0.5


class Client:
    """A client of one service; safe to use from several threads. Every method raises ServiceError."""

    def __init__(
        self,
        url: str,
        key: str | None = None,
        *,
        timeout_s: float = 60.0,
        transport: httpx.BaseTransport | None = None,
        use_proxy: bool = True,
        certificate: str | os.PathLike[str] | None = None,
    ) -> None:
        """`key` is needed where the service has keys; `use_proxy` is whether the environment's proxy is used.

        `certificate` is a PEM file: only the service that has it is spoken with, whatever name it was made for.
        """
        arguments = _settings(key, timeout_s, certificate)
        self._http = httpx.Client(base_url=url, transport=transport, trust_env=use_proxy, **arguments)

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    def close(self) -> None:
        """Close all connections."""
        self._http.close()

    def localize(
        self,
        photos: Photo | Sequence[Photo],
        *,
        timeout_s: float = MAX_WAIT_S,
        on_record: Callable[[Record], object] | None = None,
        **fields: Any,
    ) -> Result:
        """Localize a photo, a video, or several photos of one camera in their order; wait for the result.

        `fields` are those of docs/api.md: `scene`, `intrinsics` (Intrinsics), `prior` (Prior), `accuracy` (Accuracy),
        `up_in_camera`, `gps` and `heading` (mappings; `gps` also "exif"), `times_s`, ...
        `on_record` is called with each step. Raises ServiceError; a photo that is not localized is a result.
        """
        job = self.submit(photos, timeout_s=timeout_s, **fields)
        for item in self.follow(job.id, timeout_s=timeout_s):
            if isinstance(item, Job):
                job = item
            elif on_record is not None:
                on_record(item)
        return job.answer()

    def submit(self, photos: Photo | Sequence[Photo], *, timeout_s: float = 0.0, **fields: Any) -> Job:
        """Queue a job and return it. A full queue or a lost connection is tried again for `timeout_s`."""
        waiting, form, headers = _Waiting(timeout_s), _form(photos, fields), {"Idempotency-Key": uuid.uuid4().hex}
        while True:
            try:
                return parse_job(_document(self._send("POST", "/localize", headers=headers, **form)))
            except ServiceError as error:
                time.sleep(waiting.pause(error))

    def follow(self, job_id: str, *, timeout_s: float = MAX_WAIT_S) -> Iterator[Record | Job]:
        """Yield each step of a job from the first on, then the ended job. A lost connection is taken up again."""
        waiting = _Waiting(timeout_s)
        while True:
            try:
                for event in self.events(job_id, waiting.last_id):
                    value = waiting.value(event, job_id)
                    if value is not None:
                        yield value
                    if isinstance(value, Job):
                        return
                raise ServiceError("unreachable", "The stream of events ended before the job.")
            except ServiceError as error:
                time.sleep(waiting.pause(error))

    def wait(self, job_id: str, *, timeout_s: float = MAX_WAIT_S) -> Job:
        """Return the job once it has ended."""
        *_, last = self.follow(job_id, timeout_s=timeout_s)
        assert isinstance(last, Job)
        return last

    def events(self, job_id: str, last_id: str = "") -> Iterator[Event]:
        """Yield the events of one connection, pings included; `last_id` resumes after that event."""
        headers, parser = {"Last-Event-ID": last_id} if last_id else {}, EventParser()
        try:
            with self._http.stream("GET", f"/jobs/{job_id}/events", timeout=_STREAM, headers=headers) as response:
                if response.is_error:
                    # The body of a stream is not read by itself, and has the problem document.
                    response.read()
                _checked(response)
                yield from filter(None, map(parser.line, response.iter_lines()))
        except (httpx.HTTPError, RuntimeError, OSError) as error:
            # What httpx raises where another thread has closed the client.
            if self._http.is_closed:
                raise ServiceError("closed", "The client is closed.") from error
            if not isinstance(error, httpx.HTTPError):
                raise
            raise _unreachable(error, self._http.base_url) from error

    def job(self, job_id: str) -> Job:
        """Return a job."""
        return parse_job(self._json(f"/jobs/{job_id}"))

    def jobs(self, **filters: Any) -> list[Job]:
        """Return a page of jobs without their results, the newest first; `limit`, `scene`, `state`, ... filter."""
        return list(map(parse_job, self._json("/jobs", filters)["jobs"]))

    def cancel(self, job_id: str) -> Job:
        """Cancel a job; without effect if it has ended."""
        return parse_job(_document(self._send("DELETE", f"/jobs/{job_id}")))

    def trace(self, job_id: str) -> Json:
        """Return a job's steps with everything that is on record of them, as the API has them."""
        return self._json(f"/jobs/{job_id}/trace")

    def photo(self, job_id: str) -> bytes:
        """Return a job's photo as a JPEG: upright, undistorted, reduced if large."""
        return self._send("GET", f"/jobs/{job_id}/photo").content

    def step_render(self, job_id: str, index: int | str = "last", *, camera: str = "pose") -> bytes:
        """Return a JPEG of the scene at a step's pose, or with `matches` from the camera that its matches refer to."""
        path = f"/jobs/{job_id}/iterations/{index}/render.jpg"
        return self._send("GET", path, params={"camera": camera}).content

    def export(self, job_id: str, format: str, **options: Any) -> str:
        """Return the pose, or a sequence's poses, as `colmap`, `nerfstudio`, `tum` or `geopose`."""
        return self._send("GET", f"/jobs/{job_id}/export/{format}", params=options).text

    def scenes(self) -> list[Scene]:
        """Return all scenes; the fields of their files are None here."""
        return list(map(_scene, self._json("/scenes")["scenes"]))

    def scene(self, scene_id: str) -> Scene:
        """Return a scene; its training cameras are in `raw`."""
        return _scene(self._json(f"/scenes/{scene_id}"))

    def upload_scene(self, scene_id: str, file: Photo) -> Scene:
        """Add a scene file, or a ZIP of a scene folder (role admin); it is loaded then."""
        name, data = _file(file)
        # A scene of gigabytes takes minutes to be checked.
        put = {"params": {"file": name}, "content": data, "timeout": _UPLOAD}
        return _scene(_document(self._send("PUT", f"/scenes/{scene_id}", **put)))

    def load_scene(self, scene_id: str) -> Scene:
        """Begin to load a scene into memory (role admin)."""
        return _scene(_document(self._send("POST", f"/scenes/{scene_id}/load")))

    def unload_scene(self, scene_id: str) -> Scene:
        """Remove a scene from memory once its last job has ended (role admin)."""
        return _scene(_document(self._send("POST", f"/scenes/{scene_id}/unload")))

    def delete_scene(self, scene_id: str) -> None:
        """Delete an uploaded scene and its files (role admin)."""
        self._send("DELETE", f"/scenes/{scene_id}")

    def wait_until_ready(self, scene_id: str, *, timeout_s: float = 600.0) -> Scene:
        """Return the scene once photos can be localized in it."""
        waiting = _Waiting(timeout_s)
        while (scene := self.scene(scene_id)).state != "ready":
            time.sleep(_scene_pause(scene, waiting))
        return scene

    def coverage(self, scene_id: str, *, measure: bool = False) -> Json:
        """Return a scene's coverage map as the API has it, or how far it is measured; `measure`: begin that."""
        return _document(self._send("POST" if measure else "GET", f"/scenes/{scene_id}/coverage"))

    def cancel_coverage(self, scene_id: str) -> Json:
        """End the measurement of a scene's coverage map, if one runs; return how far it is."""
        return _document(self._send("DELETE", f"/scenes/{scene_id}/coverage"))

    def anchors(self, scene_id: str) -> dict[str, np.ndarray]:
        """Return the positions of a scene's named points in its world, by name; results have their pixels."""
        return _anchors(self._json(f"/scenes/{scene_id}/anchors"))

    def put_anchor(self, scene_id: str, name: str, position: Sequence[float]) -> None:
        """Add a named point to a scene, or move the one of that name."""
        self._send("PUT", _anchor_path(scene_id, name), json={"position": list(map(float, position))})

    def delete_anchor(self, scene_id: str, name: str) -> None:
        """Delete a named point of a scene."""
        self._send("DELETE", _anchor_path(scene_id, name))

    def share(self, job_id: str, *, expires_in_s: float = WEEK_S) -> str:
        """Make a link that shows a job, read-only, to whoever has it; return its address."""
        made = _document(self._send("POST", f"/jobs/{job_id}/share", json={"expires_in_s": expires_in_s}))
        return _address(self._http.base_url, made["link"])

    def own_key(self) -> Key:
        """Return what the key may do that requests are sent with; its name is None where the service has no keys."""
        return _key(self._json("/key"))

    def all_keys(self) -> list[Key]:
        """Return all keys of the service (role admin)."""
        return list(map(_key, self._json("/keys")["keys"]))

    def add_key(self, name: str, role: str = "localize", **limits: Any) -> str:
        """Make a key (role admin) and return it, which no later answer has.

        `limits`: scenes, rate, queue_share, and expires, a datetime with its time zone.
        """
        return _document(self._send("PUT", _key_path(name), json=_key_body(role, limits)))["key"]

    def remove_key(self, name: str) -> None:
        """Revoke a key, with its sessions and share links (role admin)."""
        self._send("DELETE", _key_path(name))

    def splats(self, scene_id: str, limit: int) -> bytes:
        """Return the most important Gaussians for drawing, in the binary form of GET /scenes/{id}/splats."""
        return self._send("GET", f"/scenes/{scene_id}/splats", params={"max": limit}).content

    def render(self, scene_id: str, pose: Pose, camera: Intrinsics | None = None, *, kind: str = "jpeg") -> bytes:
        """Return a `jpeg`, `png` or `depth` (a .npy file) of a scene from any pose."""
        path, body = f"/scenes/{scene_id}/render", _render_body(camera, pose, kind)
        return self._send("POST", path, json=body).content

    def depth(self, scene_id: str, pose: Pose, camera: Intrinsics | None = None) -> np.ndarray:
        """Return z-depth, float32 of (height, width), in scene units; 0 where the scene is empty."""
        return _depth(self.render(scene_id, pose, camera, kind="depth"))

    def _json(self, path: str, query: Json | None = None) -> Any:
        return _document(self._send("GET", path, params=query))

    def _send(self, method: str, path: str, **arguments: Any) -> httpx.Response:
        try:
            return _checked(self._http.request(method, path, **arguments))
        except (httpx.HTTPError, RuntimeError, OSError) as error:
            # What httpx raises where another thread has closed the client.
            if self._http.is_closed:
                raise ServiceError("closed", "The client is closed.") from error
            if not isinstance(error, httpx.HTTPError):
                raise
            raise _unreachable(error, self._http.base_url) from error


class AsyncClient:
    """`Client` for asyncio: the same methods as coroutines; `follow` and `events` are asynchronous iterators."""

    def __init__(
        self,
        url: str,
        key: str | None = None,
        *,
        timeout_s: float = 60.0,
        transport: httpx.AsyncBaseTransport | None = None,
        use_proxy: bool = True,
        certificate: str | os.PathLike[str] | None = None,
    ) -> None:
        arguments = _settings(key, timeout_s, certificate)
        self._http = httpx.AsyncClient(base_url=url, transport=transport, trust_env=use_proxy, **arguments)

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        await self.close()

    async def close(self) -> None:
        await self._http.aclose()

    async def localize(
        self,
        photos: Photo | Sequence[Photo],
        *,
        timeout_s: float = MAX_WAIT_S,
        on_record: Callable[[Record], object] | None = None,
        **fields: Any,
    ) -> Result:
        job = await self.submit(photos, timeout_s=timeout_s, **fields)
        async for item in self.follow(job.id, timeout_s=timeout_s):
            if isinstance(item, Job):
                job = item
            elif on_record is not None:
                on_record(item)
        return job.answer()

    async def submit(self, photos: Photo | Sequence[Photo], *, timeout_s: float = 0.0, **fields: Any) -> Job:
        waiting, headers = _Waiting(timeout_s), {"Idempotency-Key": uuid.uuid4().hex}
        form = await asyncio.to_thread(_form, photos, fields)
        while True:
            try:
                return parse_job(_document(await self._send("POST", "/localize", headers=headers, **form)))
            except ServiceError as error:
                await asyncio.sleep(waiting.pause(error))

    async def follow(self, job_id: str, *, timeout_s: float = MAX_WAIT_S) -> AsyncIterator[Record | Job]:
        waiting = _Waiting(timeout_s)
        while True:
            try:
                async for event in self.events(job_id, waiting.last_id):
                    value = waiting.value(event, job_id)
                    if value is not None:
                        yield value
                    if isinstance(value, Job):
                        return
                raise ServiceError("unreachable", "The stream of events ended before the job.")
            except ServiceError as error:
                await asyncio.sleep(waiting.pause(error))

    async def wait(self, job_id: str, *, timeout_s: float = MAX_WAIT_S) -> Job:
        last = [item async for item in self.follow(job_id, timeout_s=timeout_s)][-1]
        assert isinstance(last, Job)
        return last

    async def events(self, job_id: str, last_id: str = "") -> AsyncIterator[Event]:
        headers, parser = {"Last-Event-ID": last_id} if last_id else {}, EventParser()
        try:
            async with self._http.stream("GET", f"/jobs/{job_id}/events", timeout=_STREAM, headers=headers) as response:
                if response.is_error:
                    await response.aread()
                _checked(response)
                async for line in response.aiter_lines():
                    if event := parser.line(line):
                        yield event
        except httpx.HTTPError as error:
            raise _unreachable(error, self._http.base_url) from error

    async def job(self, job_id: str) -> Job:
        return parse_job(await self._json(f"/jobs/{job_id}"))

    async def jobs(self, **filters: Any) -> list[Job]:
        return list(map(parse_job, (await self._json("/jobs", filters))["jobs"]))

    async def cancel(self, job_id: str) -> Job:
        return parse_job(_document(await self._send("DELETE", f"/jobs/{job_id}")))

    async def trace(self, job_id: str) -> Json:
        return await self._json(f"/jobs/{job_id}/trace")

    async def photo(self, job_id: str) -> bytes:
        return (await self._send("GET", f"/jobs/{job_id}/photo")).content

    async def step_render(self, job_id: str, index: int | str = "last", *, camera: str = "pose") -> bytes:
        path = f"/jobs/{job_id}/iterations/{index}/render.jpg"
        return (await self._send("GET", path, params={"camera": camera})).content

    async def export(self, job_id: str, format: str, **options: Any) -> str:
        return (await self._send("GET", f"/jobs/{job_id}/export/{format}", params=options)).text

    async def scenes(self) -> list[Scene]:
        return list(map(_scene, (await self._json("/scenes"))["scenes"]))

    async def scene(self, scene_id: str) -> Scene:
        return _scene(await self._json(f"/scenes/{scene_id}"))

    async def upload_scene(self, scene_id: str, file: Photo) -> Scene:
        name, data = await asyncio.to_thread(_file, file)
        put = {"params": {"file": name}, "content": data, "timeout": _UPLOAD}
        return _scene(_document(await self._send("PUT", f"/scenes/{scene_id}", **put)))

    async def load_scene(self, scene_id: str) -> Scene:
        return _scene(_document(await self._send("POST", f"/scenes/{scene_id}/load")))

    async def unload_scene(self, scene_id: str) -> Scene:
        return _scene(_document(await self._send("POST", f"/scenes/{scene_id}/unload")))

    async def delete_scene(self, scene_id: str) -> None:
        await self._send("DELETE", f"/scenes/{scene_id}")

    async def wait_until_ready(self, scene_id: str, *, timeout_s: float = 600.0) -> Scene:
        waiting = _Waiting(timeout_s)
        while (scene := await self.scene(scene_id)).state != "ready":
            await asyncio.sleep(_scene_pause(scene, waiting))
        return scene

    async def coverage(self, scene_id: str, *, measure: bool = False) -> Json:
        return _document(await self._send("POST" if measure else "GET", f"/scenes/{scene_id}/coverage"))

    async def cancel_coverage(self, scene_id: str) -> Json:
        return _document(await self._send("DELETE", f"/scenes/{scene_id}/coverage"))

    async def anchors(self, scene_id: str) -> dict[str, np.ndarray]:
        return _anchors(await self._json(f"/scenes/{scene_id}/anchors"))

    async def put_anchor(self, scene_id: str, name: str, position: Sequence[float]) -> None:
        await self._send("PUT", _anchor_path(scene_id, name), json={"position": list(map(float, position))})

    async def delete_anchor(self, scene_id: str, name: str) -> None:
        await self._send("DELETE", _anchor_path(scene_id, name))

    async def share(self, job_id: str, *, expires_in_s: float = WEEK_S) -> str:
        made = _document(await self._send("POST", f"/jobs/{job_id}/share", json={"expires_in_s": expires_in_s}))
        return _address(self._http.base_url, made["link"])

    async def own_key(self) -> Key:
        return _key(await self._json("/key"))

    async def all_keys(self) -> list[Key]:
        return list(map(_key, (await self._json("/keys"))["keys"]))

    async def add_key(self, name: str, role: str = "localize", **limits: Any) -> str:
        return _document(await self._send("PUT", _key_path(name), json=_key_body(role, limits)))["key"]

    async def remove_key(self, name: str) -> None:
        await self._send("DELETE", _key_path(name))

    async def splats(self, scene_id: str, limit: int) -> bytes:
        return (await self._send("GET", f"/scenes/{scene_id}/splats", params={"max": limit})).content

    async def render(self, scene_id: str, pose: Pose, camera: Intrinsics | None = None, *, kind: str = "jpeg") -> bytes:
        body = _render_body(camera, pose, kind)
        return (await self._send("POST", f"/scenes/{scene_id}/render", json=body)).content

    async def depth(self, scene_id: str, pose: Pose, camera: Intrinsics | None = None) -> np.ndarray:
        return _depth(await self.render(scene_id, pose, camera, kind="depth"))

    async def _json(self, path: str, query: Json | None = None) -> Any:
        return _document(await self._send("GET", path, params=query))

    async def _send(self, method: str, path: str, **arguments: Any) -> httpx.Response:
        try:
            return _checked(await self._http.request(method, path, **arguments))
        except httpx.HTTPError as error:
            raise _unreachable(error, self._http.base_url) from error
