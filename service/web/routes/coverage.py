"""`/scenes/{id}/coverage`: where in a scene a photo would be found."""

from __future__ import annotations

from fastapi import APIRouter

from service.web.route_policy import SMALL_BODY, route_policy
from service.web.routes.dependencies import AppStateOf, RootOf
from service.web.schemas.coverage import CoverageOut, coverage_status_out
from service.web.schemas.error_examples import SCENE_ERRORS, errors

router = APIRouter()


@router.get("/scenes/{scene_id}/coverage", tags=["scenes"], responses=errors("scene_not_found"))
@route_policy(role="read")
def get_coverage(scene_id: str, app_state: AppStateOf, root: RootOf) -> CoverageOut:
    """Return the scene's coverage map, or how far it is measured; that of a scene in memory only."""
    return coverage_status_out(app_state.engine.coverage(scene_id), f"{root}/scenes/{scene_id}/coverage")


@router.post(
    "/scenes/{scene_id}/coverage", status_code=202, tags=["scenes"], responses=errors(*SCENE_ERRORS, body=True)
)
@route_policy(role="admin", body=SMALL_BODY, rate_limited=True)
def measure_coverage(scene_id: str, app_state: AppStateOf, root: RootOf) -> CoverageOut:
    """Measure the scene's coverage map anew, in the background, on all cores: a minute or more."""
    return coverage_status_out(app_state.engine.measure_coverage(scene_id), f"{root}/scenes/{scene_id}/coverage")


@router.delete("/scenes/{scene_id}/coverage", tags=["scenes"], responses=errors("scene_not_found", body=True))
@route_policy(role="admin", body=SMALL_BODY, rate_limited=True)
def cancel_coverage(scene_id: str, app_state: AppStateOf, root: RootOf) -> CoverageOut:
    """End the measurement of the scene's coverage map, if one waits or runs: within the photos that are being tried. A
    map that was measured before stays."""
    return coverage_status_out(app_state.engine.cancel_coverage(scene_id), f"{root}/scenes/{scene_id}/coverage")
