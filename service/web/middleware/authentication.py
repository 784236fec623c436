"""Who comes in: host, origin, key and role are checked before anything of a request is read.

A browser can't send a header with a page or a WebSocket. It comes once with `?key=` (an API key) or `?token=` (from
`POST /tokens`), and gets a cookie with a token that stands for the key.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from urllib.parse import parse_qs, urlsplit

from starlette.datastructures import Headers
from starlette.requests import HTTPConnection
from starlette.responses import RedirectResponse, Response
from starlette.types import ASGIApp, Receive, Scope, Send

from service.errors import Forbidden, Unauthorized
from service.web.api_keys import Caller, KeyRing, Role
from service.web.problems import problem_response, refuse

COOKIE = "splatfix_session"
SESSION_S = 12 * 3600.0
_LOOPBACK = ("localhost", "127.0.0.1", "[::1]")
_PUBLIC = ("/", "/livez", "/readyz", "/docs", "/openapi.json")
_PUBLIC_FOLDERS = ("/ui/",)
_SAFE = ("GET", "HEAD", "OPTIONS")


@dataclass(frozen=True, slots=True)
class Door:
    """How the service may be reached."""

    keys: KeyRing
    open: bool
    """Nobody needs a key."""
    hosts: Sequence[str]
    """What `Host` may be, without its port, while no key protects from a page that lets its own name point here;
    empty: anything."""
    origins: Sequence[str]
    """Other sites whose pages may speak with the service."""


class Gate:
    """An ASGI layer; puts the `Caller` in the request's state."""

    def __init__(self, app: ASGIApp, door: Door) -> None:
        self._app, self._door = app, door

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        path = scope["path"].removeprefix(scope.get("root_path", "")) or "/"
        try:
            self._check_site(scope)
            caller = self._caller(scope, path)
            if caller and scope["type"] == "http" and (entered := self._entrance(scope, path, caller)):
                await entered(scope, receive, send)
                return
            needed = None if self._door.open else needed_role(scope.get("method", "GET"), path)
            if needed and caller is None:
                raise Unauthorized("an API key is needed here.", hint="Send it: Authorization: Bearer KEY.")
            if needed and caller and not caller.may(needed):
                raise Forbidden(f"the key's role is {caller.role}, needed is {needed}.")
        except (Unauthorized, Forbidden) as error:
            await _refuse(error, scope, receive, send)
            return
        scope.setdefault("state", {})["caller"] = caller
        await self._app(scope, receive, send)

    def _check_site(self, scope: Scope) -> None:
        """Refuse what another site's page sends in a visitor's name. Raises Forbidden."""
        headers = Headers(scope=scope)
        host = headers.get("host", "").lower()
        if self._door.hosts and re.sub(r":\d+$", "", host) not in (*self._door.hosts, *_LOOPBACK):
            raise Forbidden(
                f"the service isn't called '{host[:80]}'.", where="header.host", hint="Set SPLATFIX_ALLOWED_HOSTS."
            )
        origin = headers.get("origin")
        guarded = scope["type"] == "websocket" or scope["method"] not in _SAFE
        if origin is None or not guarded or origin in self._door.origins:
            return
        if urlsplit(origin).netloc.lower() != host:
            raise Forbidden(
                f"pages of {origin[:80]} may not use this service.",
                where="header.origin",
                hint="Set SPLATFIX_CORS_ORIGINS, or make the proxy keep the Host header.",
            )

    def _caller(self, scope: Scope, path: str) -> Caller | None:
        """Raises Unauthorized for a key that isn't one: it shall not be taken for none."""
        connection = HTTPConnection(scope)
        keys, query = self._door.keys, _entrance_query(scope, path)
        given = connection.headers.get("authorization", "")
        if given:
            key = given.partition(" ")[2].strip() if given.lower().startswith("bearer ") else ""
            caller = keys.caller(key) or keys.bearer(key)
        elif query:
            caller = keys.caller(query.get("key", "")) or keys.bearer(query.get("token", ""))
        else:
            return keys.bearer(connection.cookies.get(COOKIE, ""))
        if caller is None and not self._door.open:
            raise Unauthorized("the key or token is not valid, or not any more.", where="header.authorization")
        return caller

    def _entrance(self, scope: Scope, path: str, caller: Caller) -> Response | None:
        """Take the key out of a page's address, and leave a cookie instead."""
        if not _entrance_query(scope, path):
            return None
        root = scope.get("root_path", "")
        response = RedirectResponse(f"{root}{path}", 303)
        response.set_cookie(
            COOKIE,
            self._door.keys.token(caller, SESSION_S),
            max_age=int(SESSION_S),
            path=f"{root}/",
            secure=scope.get("scheme") == "https",
            httponly=True,
            samesite="lax",
        )
        return response


def _entrance_query(scope: Scope, path: str) -> dict[str, str]:
    """Return the key or token in the address of a page; not of anything else."""
    if path != "/" and not re.match("/viewer(/|$)", path):
        return {}
    query = parse_qs(scope.get("query_string", b"").decode("latin-1"))
    return {name: query[name][0] for name in ("key", "token") if name in query}


def needed_role(method: str, path: str) -> Role | None:
    """Return what a request needs; None: nothing."""
    if method in _SAFE and (path in _PUBLIC or path.startswith(_PUBLIC_FOLDERS)):
        return None
    if method in _SAFE or path == "/tokens" or (method == "POST" and path.endswith("/render")):
        return "read"
    return "localize" if path in ("/localize", "/geopose") or path.startswith("/jobs/") else "admin"


def allowed_hosts(listens_on: str, given: Sequence[str], *, open_to_all: bool) -> tuple[str, ...]:
    """Return the names under which a service without keys is called."""
    if given:
        return tuple(given)
    return _LOOPBACK if open_to_all and is_loopback(listens_on) else ()


def is_loopback(host: str) -> bool:
    """Return whether only this machine reaches an address to listen on."""
    return host in ("localhost", "::1") or host.startswith("127.")


async def _refuse(error: Unauthorized | Forbidden, scope: Scope, receive: Receive, send: Send) -> None:
    if scope["type"] == "websocket":
        await receive()  # websocket.connect
        await send({"type": "websocket.close", "code": 1008, "reason": error.message[:100]})
        return
    response = problem_response(error, scope["path"])
    if isinstance(error, Unauthorized):
        response.headers["WWW-Authenticate"] = "Bearer"
    await refuse(response, scope, receive, send)
