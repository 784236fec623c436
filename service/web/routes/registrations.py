"""`/scenes/{id}/registration`: where a scene is on Earth or in a frame in metres, how large, and which way is up."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from fastapi import APIRouter

from service.errors import BadInput, InvalidRequest, RegistrationNotFound
from service.registration.gathering import gathered
from service.registration.register import register
from service.registration.registration import Registration
from service.registration.registration_file import RegistrationFile
from service.results import Status
from service.types import Pose, SceneInfo
from service.web.route_policy import SMALL_BODY, route_policy
from service.web.routes.dependencies import AppState, AppStateOf
from service.web.schemas.error_examples import SCENE_ERRORS, errors
from service.web.schemas.registrations import (
    PhotoPlaceIn,
    RegistrationIn,
    RegistrationOut,
    gather_options,
    known_photos,
    picked_points,
    registration_out,
    require_places,
)

router = APIRouter()


@router.get(
    "/scenes/{scene_id}/registration",
    tags=["scenes"],
    responses=errors("scene_not_found", "registration_not_found", "corrupt_scene"),
)
@route_policy(role="read")
def get_registration(scene_id: str, app_state: AppStateOf) -> RegistrationOut:
    """Return the scene's registration in force, with its residuals."""
    file = _file(app_state, scene_id)
    current = file and file.current()
    if current is None:
        raise RegistrationNotFound("the scene is not registered.", where="scene")
    return _answer(app_state, scene_id, current)


@router.post(
    "/scenes/{scene_id}/registration",
    status_code=201,
    tags=["scenes"],
    responses=errors(
        *("invalid_request", "bad_request", "request_timeout", *SCENE_ERRORS, "bad_input", "job_not_found"),
        *("job_not_ready", "registration_failed", "storage_failed"),
        body=True,
    ),
)
@route_policy(role="admin", body=SMALL_BODY, rate_limited=True)
def register_scene(scene_id: str, wanted: RegistrationIn, app_state: AppStateOf) -> RegistrationOut:
    """Register a scene by photos that jobs have localized in it, by points, lengths and floor points.

    Outliers are rejected. What the places don't determine is refused with the reason, or left out of `determined`.
    Jobs that were accepted before keep the registration of then.
    """
    require_places(wanted)
    info = app_state.engine.require(scene_id)
    file = _file(app_state, scene_id)
    if file is None:
        raise BadInput("it has no file that a registration could be kept beside.", where="scene")
    poses = [_localized(app_state, scene_id, info, photo) for photo in wanted.photos]
    known, photos = known_photos(wanted, poses)
    above = _inside(app_state, scene_id)
    evidence, origin = gathered(known, photos, picked_points(wanted), info, above, gather_options(wanted))
    # A fixed seed: the same places lead to the same registration.
    found = register(evidence, np.random.default_rng(0))
    added = file.add(replace(found, origin=origin, source="api", scene_sha256=info.sha256, created=time.time()))
    return _answer(app_state, scene_id, added)


@router.delete(
    "/scenes/{scene_id}/registration",
    tags=["scenes"],
    responses=errors("scene_not_found", "registration_not_found", "corrupt_scene", "storage_failed", body=True),
)
@route_policy(role="admin", body=SMALL_BODY, rate_limited=True)
def undo_registration(scene_id: str, app_state: AppStateOf) -> RegistrationOut | None:
    """Undo the scene's latest registration; return the one before it, which is in force again, or null."""
    file = _file(app_state, scene_id)
    if file is None:
        raise RegistrationNotFound("the scene is not registered.", where="scene")
    before = file.undo()
    return None if before is None else _answer(app_state, scene_id, before)


def _file(app_state: AppState, scene_id: str) -> RegistrationFile | None:
    """Return the scene's file of registrations; None for a scene without a file. Raises SceneNotFound."""
    app_state.engine.scene(scene_id)
    stored = app_state.scene_store.find(scene_id)
    return None if stored is None else RegistrationFile(stored.path, app_state.settings.data_dir, stored.remote)


def _answer(app_state: AppState, scene_id: str, registration: Registration) -> RegistrationOut:
    info = app_state.engine.scene(scene_id).info
    return registration_out(registration, applies=info is None or info.sha256 == registration.scene_sha256)


def _localized(
    app_state: AppState, scene_id: str, info: SceneInfo, photo: PhotoPlaceIn
) -> tuple[Pose, np.ndarray | None]:
    """Return the pose that a job found, with its covariance. Raises JobNotFound, JobNotReady, InvalidRequest."""
    job = app_state.jobs.get(photo.job)
    result = app_state.jobs.result(job)
    estimate, where = result.estimate, f"photos: job {job.id}"
    if job.scene != scene_id or estimate.scene_sha256 != info.sha256:
        raise InvalidRequest("is of another scene, or of another version of it.", where=where)
    if estimate.verdict.status is not Status.LOCALIZED or result.frames is not None:
        raise InvalidRequest("must be of a single photo that was localized.", where=where)
    return estimate.pose, estimate.verdict.covariance


def _inside(app_state: AppState, scene_id: str) -> np.ndarray:
    """Return a point above the floor: the mean of the training cameras, else the middle of the scene."""
    contents = app_state.engine.contents(scene_id)
    if contents is not None and contents.cameras:
        return np.mean([c.camera.pose.position_in_world for c in contents.cameras], axis=0)
    bounds = contents and contents.bounds_in_world
    return np.zeros(3) if bounds is None else bounds.mean(0)
