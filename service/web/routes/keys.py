"""`/keys`: the API keys of the service, for administrators; `/key`: what the caller's own key may do."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Request

from service.errors import InvalidRequest, NoKeys
from service.web.key_file import KEY_NAME
from service.web.route_policy import SMALL_BODY, route_policy
from service.web.routes.dependencies import AppState, AppStateOf, CallerOf
from service.web.schemas.error_examples import errors
from service.web.schemas.keys import KeyIn, KeyList, KeyOut, NewKey, OwnKey, key_out, own_key_out

router = APIRouter()
Name = Annotated[str, Path(pattern=f"^{KEY_NAME}$", description="The key's name.")]


@router.get("/key", tags=["keys"], responses=errors(always=("unauthorized", "forbidden")))
@route_policy(role="read")
def get_own_key(caller: CallerOf) -> OwnKey:
    """Return what the key may do that this request is sent with."""
    return own_key_out(caller)


@router.get("/keys", tags=["keys"], responses=errors("no_keys"))
@route_policy(role="admin")
def list_keys(request: Request, app_state: AppStateOf) -> KeyList:
    """List the API keys with their roles and limits, without the keys themselves."""
    _require_keys(request)
    return KeyList(keys=_keys(app_state))


@router.put(
    "/keys/{name}",
    status_code=201,
    tags=["keys"],
    responses=errors("invalid_request", "bad_request", "request_timeout", "no_keys", "storage_failed", body=True),
)
@route_policy(role="admin", body=SMALL_BODY, rate_limited=True)
def add_key(request: Request, name: Name, wanted: KeyIn, app_state: AppStateOf) -> NewKey:
    """Make an API key. The answer has the key itself, once: only its hash is kept."""
    _require_keys(request)
    key = app_state.keys.add(name, wanted.role, wanted.limits())
    made = next(known for known in _keys(app_state) if known.name == name)
    return NewKey(**made.model_dump(), key=key)


@router.delete(
    "/keys/{name}",
    status_code=204,
    tags=["keys"],
    responses=errors("invalid_request", "key_not_found", "no_keys", "storage_failed", body=True),
)
@route_policy(role="admin", body=SMALL_BODY, rate_limited=True)
def remove_key(request: Request, name: Name, app_state: AppStateOf, caller: CallerOf) -> None:
    """Revoke an API key, with its sessions and share links; not the one that this request is sent with."""
    _require_keys(request)
    if caller and caller.name == name:
        raise InvalidRequest(
            "this is the key that you use.", where="path.name", hint="Revoke it with another admin key."
        )
    app_state.keys.remove(name)


def _keys(app_state: AppState) -> list[KeyOut]:
    return [key_out(key, temporary=temporary) for key, temporary in app_state.keys.listed()]


def _require_keys(request: Request) -> None:
    """Refuse on a service that everybody may use: whoever came first could lock the others out. Raises NoKeys."""
    if request.state.open:
        raise NoKeys("the service has no keys.", hint="Make the first, and restart: splatfix keys add me --role admin")
