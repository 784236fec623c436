"""`POST /geopose`: localization for AR clients that use the GeoPoseProtocol."""

from __future__ import annotations

from typing import Annotated

from anyio import to_thread
from fastapi import APIRouter, Header, Query, Request, Response

from service.errors import DeadlineExceeded, InvalidImage, NoGeoAnchor
from service.photos.sequence import is_sequence
from service.types import GeoAnchor
from service.web.problems import problem_answer, problem_of_failure
from service.web.route_policy import PHOTO_BODY, route_policy
from service.web.routes.dependencies import AppState, AppStateOf, Visible, VisibleOf
from service.web.routes.localize import create_job
from service.web.schemas import geopose_protocol as gpp
from service.web.schemas import resources
from service.web.schemas.conversion import result_out
from service.web.schemas.error_examples import SCENE_ERRORS, errors
from service.web.schemas.request_body import Body
from service.web.schemas.requests import LocalizeFields

GEOPOSE = "application/geopose+json"

router = APIRouter()


@router.post(
    "/geopose",
    tags=["localize"],
    responses={200: {"model": gpp.GeoPoseResponse, "description": "The pose", "content": {GEOPOSE: {}}}}
    | errors(
        *("invalid_request", "bad_request", "request_timeout", *SCENE_ERRORS, "no_geo_anchor"),
        *(
            "invalid_image",
            "invalid_intrinsics",
            "invalid_prior",
            "no_pose",
            "deadline_exceeded",
            "interrupted",
            "estimator_fault",
            "storage_failed",
        ),
        body=True,
    ),
)
@route_policy(role="localize", body=PHOTO_BODY, rate_limited=True, queues_job=True)
async def geopose(
    wanted: gpp.GeoPoseRequest,
    request: Request,
    app_state: AppStateOf,
    visible: VisibleOf,
    scene: Annotated[str | None, Query(description="Default: the nearest scene with a `geo_anchor`.")] = None,
    accept: Annotated[str, Header(description=f"`{GEOPOSE}`: return only the pose, as OGC GeoPose 1.0")] = "",
) -> Response:
    """Localize a photo on Earth with Open AR Cloud's GeoPoseProtocol, in one request.

    Camera axes are +x right, +y up, +z backwards, as in WebXR. The search is a job like any other, with the longest
    time that `Prefer: wait` may have.
    """
    photo, intrinsics = gpp.image_of(wanted)
    # The protocol has one image for each reading.
    if is_sequence(photo):
        raise InvalidImage("not a photo.", where="cameraReadings.0.imageBytes")
    scene_id, anchor = await to_thread.run_sync(_anchored_scene, app_state, visible, scene, wanted)
    # Longer than it waits nobody would take the answer.
    wait_s = app_state.settings.max_wait_s
    fields = LocalizeFields(
        scene=scene_id, intrinsics=intrinsics, prior=gpp.prior_of(wanted, anchor), deadline_s=wait_s
    )
    job = await create_job(request, app_state, visible, Body(photo, "", {}), fields)
    if live := await to_thread.run_sync(app_state.jobs.live, job):
        await live.wait(wait_s)
    job = await to_thread.run_sync(app_state.jobs.get, job.id)
    if not job.ended:
        # The protocol has no second request to fetch the result with.
        await to_thread.run_sync(app_state.jobs.cancel, job)
        raise DeadlineExceeded(f"there was no answer within {wait_s:g} s.")
    # A job's error is a field elsewhere; here it must be the answer.
    if job.failure:
        return problem_answer(problem_of_failure(job.failure, request.url.path), request.url.path)
    resources.require_pose(job)
    result = result_out(await to_thread.run_sync(app_state.jobs.result, job))
    answer = gpp.response_of(wanted, result, anchor)
    if GEOPOSE in accept:
        return Response(answer.geopose.model_dump_json(), media_type=GEOPOSE)
    return Response(answer.model_dump_json(), media_type="application/json")


def _anchored_scene(
    app_state: AppState, visible: Visible, asked: str | None, wanted: gpp.GeoPoseRequest
) -> tuple[str, GeoAnchor]:
    """Return the scene that is asked for, else the nearest, in memory, with its anchor. Not for the event loop.

    Raises SceneError, NoGeoAnchor.
    """
    known = app_state.known_scenes([asked] if asked else ())
    if asked:
        visible.asked(asked, known)  # raises SceneNotFound
    named = asked or gpp.nearest_scene(visible.scenes(known), wanted)
    scene_id = app_state.engine.scene(named).id
    anchor = app_state.engine.require(scene_id).geo_anchor
    if anchor is None:
        raise NoGeoAnchor(f"scene '{scene_id}' has no geo_anchor.", where="scene")
    return scene_id, anchor
