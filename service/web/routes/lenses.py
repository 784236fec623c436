"""`/lenses`: what is remembered of the lenses of the caller's cameras."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path

from service.errors import LensNotFound
from service.web.route_policy import SMALL_BODY, route_policy
from service.web.routes.dependencies import AppStateOf, VisibleOf
from service.web.schemas.conversion import lens_out
from service.web.schemas.error_examples import errors
from service.web.schemas.lenses import LensesDeleted, LensList

router = APIRouter()


@router.get("/lenses", tags=["lenses"], responses=errors())
@route_policy(role="read")
def list_lenses(app_state: AppStateOf, visible: VisibleOf) -> LensList:
    """List what was learnt of lenses from photos that were sent with the caller's API key; for an admin, all."""
    return LensList(lenses=[lens_out(lens) for lens in app_state.lenses.lenses(visible.owner)])


@router.delete("/lenses", tags=["lenses"], responses=errors("storage_failed", body=True))
@route_policy(role="localize", body=SMALL_BODY, rate_limited=True)
def delete_lenses(app_state: AppStateOf, visible: VisibleOf) -> LensesDeleted:
    """Forget all lenses that the caller can list."""
    return LensesDeleted(deleted=app_state.lenses.delete(owner=visible.owner))


@router.delete("/lenses/{lens_id}", tags=["lenses"], responses=errors("lens_not_found", "storage_failed", body=True))
@route_policy(role="localize", body=SMALL_BODY, rate_limited=True)
def delete_lens(
    app_state: AppStateOf, visible: VisibleOf, lens_id: Annotated[str, Path(description="The lens' id.")]
) -> LensesDeleted:
    """Forget a lens. Jobs that were accepted before keep what was recalled for them."""
    deleted = app_state.lenses.delete(lens_id, visible.owner)
    if not deleted:
        raise LensNotFound(f"lens '{lens_id[:40]}' not found.", where="lens")
    return LensesDeleted(deleted=deleted)
