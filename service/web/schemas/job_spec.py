"""Validates the fields of a request, and converts them to the plain values of a job. Done before a job is queued."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from service.accuracy import DEFAULT_ACCURACY, Accuracy
from service.device_readings import DeviceReadings, GpsPosition, Gravity, Heading
from service.errors import (
    InvalidIntrinsics,
    InvalidOptions,
    InvalidPrior,
    InvalidRequest,
)
from service.estimators import ESTIMATORS
from service.geometry import rotation_from_quat
from service.jobs.model import JobSpec
from service.loaded_scene import DEFAULT_ESTIMATOR
from service.photos.intrinsics import intrinsics_from
from service.pose.absolute_pose.prior_region import inside_prior
from service.types import BoxPrior, GaussianPosePrior, Intrinsics, Pose, PriorRegion, Rig, RigCamera
from service.web.problems import field_and_message
from service.web.schemas.conversion import OPENCV_FROM_OPENGL
from service.web.schemas.requests import FIELD_ERRORS, GpsIn, LocalizeFields, PoseIn, PriorIn, RigIn


def read_fields(values: Mapping[str, Any]) -> LocalizeFields:
    """Validate the fields beside the photo. Raises the error of `FIELD_ERRORS` for the first invalid one."""
    try:
        return LocalizeFields.model_validate(values)
    except ValidationError as error:
        where, message = field_and_message(error.errors(), LocalizeFields)
        where = where.replace("gps.GpsIn", "gps", 1)  # pydantic names the member of a union
        raise FIELD_ERRORS.get(where.partition(".")[0], InvalidRequest)(message, where=where) from error


def job_spec(fields: LocalizeFields, default_estimator: str = DEFAULT_ESTIMATOR) -> JobSpec:
    """Convert validated fields to a job's specification; what depends on photo and scene is checked later.

    Raises BadInput, BackendMissing.
    """
    estimator = fields.estimator or default_estimator
    options = options_from(estimator, fields.options)
    intrinsics = None if fields.intrinsics is None else checked_intrinsics(fields.intrinsics)
    prior, region = (None, None) if fields.prior is None else prior_from(fields.prior)
    if prior is None and needs_prior(estimator):
        raise InvalidPrior(f"'{estimator}' needs an approximate pose of the photo, and there is none.", where="prior")
    rig = None if fields.rig is None else _rig(fields.rig)
    return JobSpec(
        estimator=estimator,
        scene=tuple(fields.scene) if isinstance(fields.scene, list) else fields.scene,
        options={name: getattr(options, name) for name in fields.options},
        intrinsics=intrinsics,
        camera_id=fields.camera_id,
        prior=prior,
        region=region,
        readings=_readings(fields),
        exif_gps=fields.gps == "exif",
        truth=None if fields.truth is None else pose_from(fields.truth, "truth"),
        every=fields.every,
        times_s=None if fields.times_s is None else tuple(fields.times_s),
        rig=rig,
        seed=fields.seed,
        budget_s=fields.budget_s,
        deadline_s=fields.deadline_s,
        keep_photo=fields.keep_photo,
        accuracy=DEFAULT_ACCURACY if fields.accuracy is None else Accuracy(**fields.accuracy.model_dump()),
    )


def _rig(rig: RigIn) -> Rig:
    """Validate a rig. Raises InvalidRequest, InvalidIntrinsics."""
    axes = OPENCV_FROM_OPENGL if rig.convention == "opengl" else np.eye(4)
    cameras = []
    for index, camera in enumerate(rig.cameras):
        where = f"rig.cameras.{index}"
        try:
            pose = Pose(np.array(camera.rig_from_camera, np.float64) @ axes)
        except InvalidPrior as error:
            raise InvalidRequest(error.message, where=f"{where}.rig_from_camera") from None
        try:
            intrinsics = intrinsics_from(camera.intrinsics)
        except InvalidIntrinsics as error:
            error.where = f"{where}.intrinsics.{error.where}"
            raise
        cameras.append(RigCamera(pose, dataclasses.replace(intrinsics, trust="exact")))
    return Rig(tuple(cameras), rig.metric)


def _readings(fields: LocalizeFields) -> DeviceReadings | None:
    """Return what the device measured; None: the request says nothing of it. Raises InvalidPrior."""
    up, gps, heading = fields.up_in_camera, fields.gps, fields.heading
    x, y, z = up.direction if up else (0.0, -1.0, 0.0)
    found = DeviceReadings(
        Gravity((x, y, z), up.sigma_deg) if up else None,
        GpsPosition(gps.latitude, gps.longitude, gps.sigma_m, gps.height, gps.height_sigma_m)
        if isinstance(gps, GpsIn)
        else None,
        Heading(heading.degrees, heading.sigma_deg) if heading else None,
    )
    return None if found == DeviceReadings() else found


def accuracy_from(value: Any) -> Accuracy:
    """Validate an accuracy by itself, as JSON has it; None is the default. Raises InvalidAccuracy."""
    return job_spec(read_fields({"accuracy": value})).accuracy


def options_from(estimator: str, values: Mapping[str, Any]) -> Any:
    """Validate an estimator's `Options`. Raises UnknownName, BackendMissing, InvalidOptions."""
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
        where, message = field_and_message(error.errors())
        raise InvalidOptions(message, where=f"options.{where}") from error


def needs_prior(estimator: str) -> bool:
    """Return whether an estimator refines a pose, and can't search for one. Raises UnknownName, BackendMissing."""
    return getattr(ESTIMATORS.load(estimator), "NEEDS_PRIOR", False)


_ADAPTERS: dict[type, TypeAdapter] = {}
_ADAPTERS_LOCK = threading.Lock()


def options_adapter(kind: type) -> TypeAdapter:
    """Return pydantic's adapter that validates and describes an estimator's `Options`; cached."""
    # Locked: for the fields' docstrings pydantic parses source code, which Python 3.11 doesn't do safely in two
    # threads at once ("AST constructor recursion depth mismatch").
    with _ADAPTERS_LOCK:
        if kind not in _ADAPTERS:
            _ADAPTERS[kind] = TypeAdapter(kind)
        return _ADAPTERS[kind]


def checked_intrinsics(values: Mapping[str, Any]) -> Intrinsics:
    """Validate intrinsics of a request. Raises InvalidIntrinsics, at the field `intrinsics.*`."""
    try:
        return intrinsics_from(values)
    except InvalidIntrinsics as error:
        error.where = f"intrinsics.{error.where}"
        raise


def prior_from(prior: PriorIn) -> tuple[Pose | None, PriorRegion | None]:
    """Return a prior's approximate pose and its region, each None if not given. Raises InvalidPrior, at `prior`."""
    has_pose = any(getattr(prior, name) is not None for name in (*_POSE_FIELDS, "quaternion_wxyz"))
    # Without pose and box `pose_from` raises the error that says what is missing.
    pose = pose_from(prior, "prior") if has_pose or prior.box is None else None
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
        # Raised where the name of the request's field is unknown.
        error.where = f"prior.{error.where}"
        raise


def _gaussian(prior: PriorIn, pose: Pose | None, spreads: Sequence[str]) -> GaussianPosePrior:
    """Return the Gaussian with mean `pose` and the given sigmas or covariance. Raises InvalidPrior."""
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
            hint="For an unknown rotation, give a sigma_deg of 180.",
        )
    # The order of a twist: rotation first.
    spread = np.repeat([np.radians(prior.sigma_deg), prior.sigma_units], 3)
    return GaussianPosePrior(pose, np.diag(spread**2))


_POSE_FIELDS = ("world_from_camera", "camera_from_world", "position")


def pose_from(given_pose: PoseIn, where: str) -> Pose:
    """Convert a pose to world_from_camera in OpenCV axes. Raises InvalidPrior, at the field `where`."""
    given = [name for name in _POSE_FIELDS if getattr(given_pose, name) is not None]
    if len(given) != 1 or (given_pose.position is None) != (given_pose.quaternion_wxyz is None):
        raise InvalidPrior(
            "give exactly one of: world_from_camera; camera_from_world; position and quaternion_wxyz.",
            where=where,
        )
    try:
        pose = _as_given(given_pose)
    except InvalidPrior as error:
        error.where = f"{where}.{error.where if error.where == 'quaternion_wxyz' else given[0]}"
        raise
    # A given camera_from_world was read as if it were world_from_camera, so its inverse is the pose.
    matrix = pose.camera_from_world if given_pose.camera_from_world else pose.world_from_camera
    return Pose(matrix @ OPENCV_FROM_OPENGL if given_pose.convention == "opengl" else matrix)


def _as_given(given: PoseIn) -> Pose:
    """Return the given matrix, or the matrix of position and quaternion, checked to be rigid; not yet converted."""
    if given.position is None or given.quaternion_wxyz is None:
        return Pose(np.array(given.world_from_camera or given.camera_from_world, np.float64))
    # 1e-3, as for matrices: accepts numbers printed with 3 or 4 digits. NaN fails the comparison.
    if not abs(np.linalg.norm(given.quaternion_wxyz) - 1) < 1e-3:
        raise InvalidPrior("quaternion_wxyz must have length 1.", where="quaternion_wxyz")
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_from_quat(np.array(given.quaternion_wxyz))
    matrix[:3, 3] = given.position
    return Pose(matrix)
