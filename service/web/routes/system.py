"""Capabilities, versions, health, metrics and tokens of the service."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from fastapi import APIRouter, Response

from service.errors import Failure, NoKeys
from service.scene_manager.status import SceneNote
from service.versions import versions
from service.web.hints import hint_for
from service.web.metrics import METRICS_TYPE
from service.web.route_policy import SMALL_BODY, route_policy
from service.web.routes.dependencies import AppStateOf, CallerOf, Visible, VisibleOf
from service.web.schemas import resources
from service.web.schemas.error_examples import errors
from service.web.schemas.system import Capabilities, Liveness, Readiness, Token

TOKEN_S = 300.0
_NO_SCENE = "no scene can be used: load one (POST /scenes/ID/load), upload one, or name some in SPLATFIX_SCENES."
_CANNOT_FAIL = ("unauthorized", "forbidden")

router = APIRouter()


@router.get("/capabilities", tags=["service"], responses=errors())
@route_policy(role="read")
def get_capabilities(app_state: AppStateOf) -> Capabilities:
    """Return the estimators with their options, the matchers, renderers and scene formats."""
    return resources.capabilities(app_state.settings)


@router.get("/version", tags=["service"], responses=errors(always=_CANNOT_FAIL))
@route_policy(role="read")
def get_version() -> dict[str, str]:
    """Return the versions of the service and of the packages that results depend on."""
    return versions()


@router.get("/livez", tags=["service"], responses=errors(always=_CANNOT_FAIL))
@route_policy(role=None)
async def live() -> Liveness:
    """Answer as long as the process runs."""
    return Liveness()


@router.get("/readyz", tags=["service"], responses={503: {"model": Readiness, "description": "Not ready"}} | errors())
@route_policy(role=None)
def ready(app_state: AppStateOf, visible: VisibleOf, response: Response) -> Readiness:
    """Return whether photos can be localized now: scenes are loaded and prepared, workers and storage work.

    Scenes that the caller may not see are listed without their names.
    """
    scenes, problems = app_state.engine.readiness(), app_state.jobs.problems()
    remedies = {s.id: _remedy(s.failure) for s in app_state.engine.scenes() if s.failure}
    if not scenes.ready and not scenes.pending and not scenes.failed:
        problems = [*problems, _NO_SCENE]
    readiness = Readiness(
        ready=scenes.ready and not problems,
        pending=_visible_notes(scenes.pending, visible, {}),
        failed=[*_visible_notes(scenes.failed, visible, remedies), *problems],
        rasterizers=list(scenes.rasterizers),
        skipped_rasterizers=list(scenes.skipped_rasterizers),
    )
    # Load balancers look at the status only.
    response.status_code = 200 if readiness.ready else 503
    return readiness


def _visible_notes(notes: Sequence[SceneNote], visible: Visible, remedies: Mapping[str, str]) -> list[str]:
    """Return notes as sentences, each with what to do."""
    hidden = "a scene that this key may not use"
    sentences = [(note, f"{note} {remedies.get(note.scene, '')}".rstrip()) for note in notes]
    # Counted all the same: without them the service would look ready.
    return [text if visible.scene(note.scene) else hidden for note, text in sentences]


def _remedy(failure: Failure) -> str:
    """Return what helps against a scene's failure, unless its text says so itself."""
    return "" if failure.hint else hint_for(failure.code, failure.where)


@router.get(
    "/metrics",
    tags=["service"],
    response_class=Response,
    responses={200: {"description": "Prometheus text format", "content": {"text/plain": {}}}} | errors(),
)
@route_policy(role="read")
def get_metrics(app_state: AppStateOf, visible: VisibleOf) -> Response:
    """Return the metrics: requests, queue, jobs by stage and status, memory by scene, workers.

    To a key with scenes: of its scenes, and of its own jobs, alone.
    """
    metrics = app_state.metrics
    found = metrics.exposition() if visible.all_scenes else metrics.exposition_of(visible.owner or "", visible.scene)
    return Response(found, media_type=METRICS_TYPE)


@router.post("/tokens", tags=["service"], responses=errors("no_keys", body=True))
@route_policy(role="read", body=SMALL_BODY, rate_limited=True)
def make_token(app_state: AppStateOf, caller: CallerOf) -> Token:
    """Make a token with the role of the caller's key, valid for some minutes, to open a page: `/viewer/?token=…`."""
    if caller is None:
        raise NoKeys("the service has no keys: its pages need none.", where="header.authorization")
    return Token(token=app_state.keys.token(caller, TOKEN_S), expires_in_s=TOKEN_S)
