"""From the body of a request to a validated job: nothing is queued that could have been refused."""

from __future__ import annotations

import base64
import dataclasses
import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from anyio import to_thread
from pydantic import TypeAdapter, ValidationError
from pydantic_core import from_json
from starlette.datastructures import UploadFile
from starlette.exceptions import HTTPException
from starlette.requests import Request as HttpRequest

from service.errors import (
    InvalidImage,
    InvalidIntrinsics,
    InvalidOptions,
    InvalidPrior,
    InvalidRequest,
)
from service.estimators import ESTIMATORS
from service.geometry import rotation_from_quat
from service.jobs.model import JobSpec
from service.jobs.read_photo import MAX_FRAMES
from service.localize import DEFAULT_ESTIMATOR
from service.photos.intrinsics import intrinsics_from
from service.photos.sequence import is_packed, is_sequence, packed
from service.pose.absolute_pose.prior_region import inside_prior
from service.types import BoxPrior, GaussianPosePrior, Intrinsics, Pose, PriorRegion
from service.web.problems import described
from service.web.schemas.conversion import OPENCV_FROM_OPENGL
from service.web.schemas.requests import LocalizeFields, LocalizeIn, PoseIn, PriorIn

_FIELDS = frozenset(LocalizeIn.model_fields)
_ERRORS = {
    "options": InvalidOptions,
    "intrinsics": InvalidIntrinsics,
    "prior": InvalidPrior,
    "truth": InvalidPrior,
    "times_s": InvalidRequest,
}
"""Fields that a form has as JSON text."""


@dataclass(frozen=True, slots=True)
class Body:
    """What was sent, taken apart but not yet judged."""

    photo: bytes
    """A photo or a video; several photos are packed together."""
    name: str
    """Of the file; empty if it has none."""
    fields: Mapping[str, Any]


async def read_body(request: HttpRequest, max_frames: int = MAX_FRAMES) -> Body:
    """Take a multipart form or a JSON body apart. Raises InvalidRequest; HTTPException 415 for others."""
    media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media_type == "multipart/form-data":
        return await _form_body(request, max_frames)
    if media_type == "application/json":
        return await to_thread.run_sync(_json_body, await request.body())
    raise HTTPException(415, f"Send multipart/form-data or application/json, not '{media_type}'.")


async def _form_body(request: HttpRequest, max_frames: int) -> Body:
    async with request.form(max_files=max_frames, max_fields=16) as form:
        names = [name for name, _ in form.multi_items()]
        _refuse_unknown(names)
        repeated = sorted({name for name in names if name != "photo" and names.count(name) > 1})
        if repeated:
            raise InvalidRequest("given more than once.", where=repeated[0])
        photos = form.getlist("photo")
        if not photos or not all(isinstance(photo, UploadFile) for photo in photos):
            raise InvalidRequest("a file is required here.", where="photo", hint="With curl: -F photo=@photo.jpg")
        # Forms send an empty text for what was left empty.
        texts = {name: str(value) for name, value in form.items() if name != "photo" and value != ""}
        listed = {"scene"} if texts.get("scene", "").startswith("[") else set()
        fields = {name: parsed_json(t, name) if name in {*_ERRORS, *listed} else t for name, t in texts.items()}
        files = [(p.filename or "", await p.read()) for p in photos if isinstance(p, UploadFile)]
        return await to_thread.run_sync(body_of, files, fields)


def _json_body(text: bytes) -> Body:
    value = parsed_json(text, "body")
    if not isinstance(value, dict):
        raise InvalidRequest("must be a JSON object.", where="body")
    _refuse_unknown(value)
    photo = value.pop("photo", None)
    if not isinstance(photo, str):
        raise InvalidRequest("the photo as base64 text is required here.", where="photo")
    try:
        data = base64.b64decode(photo, validate=True)
    except ValueError as error:
        raise InvalidRequest(f"not base64: {error}.", where="photo") from error
    return body_of([("", data)], {name: v for name, v in value.items() if v is not None})


def body_of(files: Sequence[tuple[str, bytes]], fields: Mapping[str, Any]) -> Body:
    """Put (name, photo) together. Raises InvalidImage, InvalidRequest."""
    for index, (_, data) in enumerate(files):
        if is_packed(data):
            raise InvalidImage("a ZIP is no photo.", where="photo", hint="Send several photos as parts of their own.")
        if len(files) > 1 and is_sequence(data):
            raise InvalidRequest("a video is a job of its own.", where=f"photo.{index}")
    name, data = files[0]
    if len(files) == 1:
        return Body(data, name, fields)
    return Body(packed(files), f"{name} and {len(files) - 1} more", fields)


def _refuse_unknown(names: Iterable[str]) -> None:
    unknown = sorted(set(names) - _FIELDS)
    if unknown:
        known = ", ".join(sorted(_FIELDS))
        raise InvalidRequest("there is no such field.", where=unknown[0], hint=f"Known: {known}.")


def parsed_json(text: str | bytes, where: str) -> Any:
    """Parse JSON from outside. Raises the error that belongs to the field `where`."""
    try:
        return from_json(text)  # unlike json.loads it refuses halves of surrogate pairs, and bounds the depth
    except ValueError as error:
        raise _ERRORS.get(where, InvalidRequest)(f"not JSON: {error}.", where=where) from error


def read_fields(values: Mapping[str, Any]) -> LocalizeFields:
    """Check the fields beside the photo. Raises the error that belongs to the first bad one."""
    try:
        return LocalizeFields.model_validate(values)
    except ValidationError as error:
        where, message = described(error.errors())
        raise _ERRORS.get(where.partition(".")[0], InvalidRequest)(message, where=where) from error


def job_spec(fields: LocalizeFields, default_estimator: str = DEFAULT_ESTIMATOR) -> JobSpec:
    """Return what a request asks for, checked as far as that is possible without the photo and the scene.

    Raises BadInput, BackendMissing.
    """
    estimator = fields.estimator or default_estimator
    options = options_from(estimator, fields.options)
    intrinsics = None if fields.intrinsics is None else checked_intrinsics(fields.intrinsics)
    prior, region = (None, None) if fields.prior is None else prior_from(fields.prior)
    return JobSpec(
        estimator=estimator,
        scene=tuple(fields.scene) if isinstance(fields.scene, list) else fields.scene,
        options={name: getattr(options, name) for name in fields.options},
        intrinsics=intrinsics,
        prior=prior,
        region=region,
        truth=None if fields.truth is None else pose_from(fields.truth, "truth"),
        every=fields.every,
        times_s=None if fields.times_s is None else tuple(fields.times_s),
        seed=fields.seed,
        budget_s=fields.budget_s,
        deadline_s=fields.deadline_s,
        keep_photo=fields.keep_photo,
    )


def options_from(estimator: str, values: Mapping[str, Any]) -> Any:
    """Return the estimator's `Options`. Raises UnknownName, BackendMissing, InvalidOptions."""
    kind = ESTIMATORS.load(estimator).Options
    known = {field.name for field in dataclasses.fields(kind)}
    unknown = sorted(values.keys() - known)
    if unknown:
        raise InvalidOptions(
            f"'{estimator}' has no such option; it has: {', '.join(sorted(known))}.",
            where=f"options.{unknown[0]}",
        )
    try:
        return options_adapter(kind).validate_python(dict(values))
    except ValidationError as error:
        where, message = described(error.errors())
        raise InvalidOptions(message, where=f"options.{where}") from error


_ADAPTERS: dict[type, TypeAdapter] = {}
_ADAPTERS_LOCK = threading.Lock()


def options_adapter(kind: type) -> TypeAdapter:
    """Return what checks and describes an estimator's `Options`, made once.

    Behind a lock: for the fields' docstrings pydantic parses source code, which Python 3.11 doesn't do safely in
    two threads at once ("AST constructor recursion depth mismatch").
    """
    with _ADAPTERS_LOCK:
        if kind not in _ADAPTERS:
            _ADAPTERS[kind] = TypeAdapter(kind)
        return _ADAPTERS[kind]


def checked_intrinsics(values: Mapping[str, Any]) -> Intrinsics:
    """Read intrinsics from outside. Raises InvalidIntrinsics, which names the field with its parent."""
    try:
        return intrinsics_from(values)
    except InvalidIntrinsics as error:
        error.where = f"intrinsics.{error.where}"
        raise


def prior_from(prior: PriorIn, where: str = "prior") -> tuple[Pose | None, PriorRegion | None]:
    """Return the guess and the region of a prior. Raises InvalidPrior, at the field `where`."""
    has_pose = any(getattr(prior, name) is not None for name in (*SPELLINGS, "quaternion_wxyz"))
    pose = pose_from(prior, where) if has_pose or prior.box is None else None
    spreads = [name for name in ("sigma_deg", "sigma_units", "covariance") if getattr(prior, name) is not None]
    try:
        if spreads:
            return pose, _gaussian(prior, pose, spreads)
        if prior.box is None:
            return pose, None
        box = BoxPrior(np.array(prior.box[0]), np.array(prior.box[1]))
        if pose is not None and not inside_prior(box, pose):
            raise InvalidPrior("the pose lies outside the box.", where="box", hint="Leave one of them out.")
        return pose, box
    except InvalidPrior as error:
        error.where = f"{where}.{error.where}"
        raise


def _gaussian(prior: PriorIn, pose: Pose | None, spreads: Sequence[str]) -> GaussianPosePrior:
    """Return the Gaussian whose spreads were given. Raises InvalidPrior."""
    if prior.box is not None:
        raise InvalidPrior("a prior is a Gaussian or a box, not both.", where=spreads[0])
    if pose is None:
        raise InvalidPrior("a Gaussian needs a pose, its mean.", where=spreads[0])
    if spreads == ["covariance"]:
        return GaussianPosePrior(pose, np.array(prior.covariance, np.float64))
    if prior.sigma_deg is None or prior.sigma_units is None or prior.covariance is not None:
        raise InvalidPrior(
            "give sigma_deg and sigma_units together, or a covariance instead of both.",
            where=spreads[0],
            hint="A sigma_deg of 180 says that the direction is unknown.",
        )
    spread = np.repeat([np.radians(prior.sigma_deg), prior.sigma_units], 3)
    return GaussianPosePrior(pose, np.diag(spread**2))


SPELLINGS = ("world_from_camera", "camera_from_world", "position")


def pose_from(given_pose: PoseIn, where: str) -> Pose:
    """Return the pose in our conventions. Raises InvalidPrior, at the field `where`."""
    given = [name for name in SPELLINGS if getattr(given_pose, name) is not None]
    if len(given) != 1 or (given_pose.position is None) != (given_pose.quaternion_wxyz is None):
        raise InvalidPrior(
            "give exactly one of: world_from_camera; camera_from_world; position and quaternion_wxyz.",
            where=where,
        )
    try:
        pose = _as_given(given_pose)
    except InvalidPrior as error:
        error.where = f"{where}.{given[0]}"
        raise
    matrix = pose.camera_from_world if given_pose.camera_from_world else pose.world_from_camera
    return Pose(matrix @ OPENCV_FROM_OPENGL if given_pose.convention == "opengl" else matrix)


def _as_given(given: PoseIn) -> Pose:
    """Check what was given as a rigid motion, whatever its direction and axes."""
    if given.position is None or given.quaternion_wxyz is None:
        return Pose(np.array(given.world_from_camera or given.camera_from_world, np.float64))
    # 1e-3, as for matrices: what was printed with 3 or 4 digits passes. NaN fails the comparison.
    if not abs(np.linalg.norm(given.quaternion_wxyz) - 1) < 1e-3:
        raise InvalidPrior("quaternion_wxyz must have length 1.")
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_from_quat(np.array(given.quaternion_wxyz))
    matrix[:3, 3] = given.position
    return Pose(matrix)
