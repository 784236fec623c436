"""Host, origin, API key, role and scene of a request are checked before its body is read.

A browser can't send a header with a page or a WebSocket. It sends `?key=` (an API key) or `?token=` (from
`POST /tokens`) once, and gets a cookie with a token that stands for the key.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from urllib.parse import parse_qs, quote, urlsplit

from starlette.datastructures import Headers
from starlette.requests import HTTPConnection
from starlette.responses import RedirectResponse, Response
from starlette.types import ASGIApp, Receive, Scope, Send

from service.errors import Forbidden, SceneNotFound, Unauthorized
from service.scene_manager.scene_errors import unknown_scene
from service.web.api_keys import Caller, KeyRing
from service.web.key_file import Role
from service.web.problems import problem_response, refuse
from service.web.route_policy import SAFE_METHODS, RoutePolicy
from service.web.settings import is_loopback

COOKIE = "splatfix_session"
SESSION_S = 12 * 3600.0
_LOOPBACK = ("localhost", "127.0.0.1", "[::1]")


@dataclass(frozen=True, slots=True)
class AccessRules:
    """From where, and with what, the service may be used."""

    keys: KeyRing
    open: bool
    """Nobody needs a key."""
    hosts: Sequence[str]
    """Accepted values of the `Host` header, without port; empty: any. Without keys this stops DNS rebinding."""
    origins: Sequence[str]
    """Other sites whose pages may use the service."""


class Authentication:
    """ASGI middleware; puts the `Caller` into the request's state. Needs the route's policy there."""

    def __init__(self, app: ASGIApp, rules: AccessRules) -> None:
        self._app, self._rules = app, rules

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        policy: RoutePolicy = scope["state"]["policy"]
        try:
            self._check_site(scope)
            query = _key_in_address(scope) if policy.key_in_address else {}
            caller = self._caller(scope, query)
            if caller and query and scope["type"] == "http":
                await self._redirect_with_cookie(scope, caller)(scope, receive, send)
                return
            # Before the checks: what is refused is logged with its caller, too.
            scope["state"].update(caller=caller, open=self._rules.open)
            self._check_role(policy.role, caller)
            _check_scene(scope["state"].get("scene_id"), caller)
        except (Unauthorized, Forbidden, SceneNotFound) as error:
            if isinstance(error, Unauthorized) and policy.key_in_address and _opens_page(scope):
                await _redirect_to_form(scope)(scope, receive, send)
            else:
                await _refuse(error, scope, receive, send)
            return
        await self._app(scope, receive, send)

    def _check_site(self, scope: Scope) -> None:
        """Refuse requests that another site's page sends from a visitor's browser. Raises Forbidden."""
        headers = Headers(scope=scope)
        host = headers.get("host", "").lower()
        # The port may be a proxy's or a forwarded one, so only the name is compared.
        if self._rules.hosts and re.sub(r":\d+$", "", host) not in (*self._rules.hosts, *_LOOPBACK):
            raise Forbidden(
                f"unknown host name '{host[:80]}'.", where="header.host", hint="Set SPLATFIX_ALLOWED_HOSTS."
            )
        origin = headers.get("origin")
        # A browser lets no page read another site's answer to a GET, but it does send a POST, and opens WebSockets.
        guarded = scope["type"] == "websocket" or scope["method"] not in SAFE_METHODS
        if origin is None or not guarded or origin in self._rules.origins:
            return
        # The scheme is not compared: behind a TLS proxy the service itself is called by http.
        if urlsplit(origin).netloc.lower() != host:
            raise Forbidden(
                f"pages of {origin[:80]} may not use this service.",
                where="header.origin",
                hint="Set SPLATFIX_CORS_ORIGINS, or make the proxy keep the Host header.",
            )

    def _caller(self, scope: Scope, query: dict[str, str]) -> Caller | None:
        """Return whose key, token or cookie was sent; None without one. Raises Unauthorized for an invalid one."""
        connection = HTTPConnection(scope)
        keys, given = self._rules.keys, connection.headers.get("authorization", "")
        if given:
            # Other schemes, e.g. Basic, are refused like a wrong key.
            key = given.partition(" ")[2].strip() if given.lower().startswith("bearer ") else ""
            caller = keys.caller(key) or keys.bearer(key) or keys.viewer_bearer(key)
        elif query:
            caller = keys.caller(query.get("key", "")) or keys.bearer(query.get("token", ""))
        else:
            # An expired cookie counts as none: the browser sends it whether the page is public or not.
            return keys.bearer(connection.cookies.get(COOKIE, ""))
        if caller is None and not self._rules.open:
            raise Unauthorized("the key or token is not valid or has expired.", where="header.authorization")
        return caller

    def _check_role(self, needed: Role | None, caller: Caller | None) -> None:
        """Raises Unauthorized without a key, Forbidden with one whose role is too low."""
        if needed is None or self._rules.open:
            return
        if caller is None:
            raise Unauthorized("an API key is needed here.", hint="Send it: Authorization: Bearer KEY.")
        if not caller.has_role(needed):
            raise Forbidden(f"the key's role is {caller.role}, needed is {needed}.")

    def _redirect_with_cookie(self, scope: Scope, caller: Caller) -> Response:
        """Redirect to the same page without the key in its address, and set the cookie."""
        root = scope.get("root_path", "")
        path = scope["path"].removeprefix(root) or "/"
        response = RedirectResponse(f"{root}{path}", 303)
        response.set_cookie(
            COOKIE,
            self._rules.keys.token(caller, SESSION_S),
            max_age=int(SESSION_S),
            path=f"{root}/",
            secure=scope.get("scheme") == "https",  # else a browser would not send it back over http
            httponly=True,
            samesite="lax",
        )
        return response


def _check_scene(scene_id: str | None, caller: Caller | None) -> None:
    """Answer for every scene that the key doesn't cover as for one that isn't there. Raises SceneNotFound."""
    # Here, for each route whose path names a scene, and not in the routes: a new one can't forget it.
    if scene_id is not None and caller is not None and not caller.limits.cover(scene_id):
        raise unknown_scene(scene_id)


def _opens_page(scope: Scope) -> bool:
    """Return whether a browser opens a page, to whose user a problem document in JSON is of no use."""
    return scope["type"] == "http" and "text/html" in Headers(scope=scope).get("accept", "")


def _redirect_to_form(scope: Scope) -> Response:
    """Redirect to the page that asks for a key, without the wrong one in the address; afterwards back to this page."""
    root = scope.get("root_path", "")
    then = quote(scope["path"].removeprefix(root).lstrip("/"))
    refused = "&refused" if _key_in_address(scope) else ""
    return RedirectResponse(f"{root}/#/key?then={then}{refused}", 303)


def _key_in_address(scope: Scope) -> dict[str, str]:
    """Return `key` and `token` of the query, where they are given."""
    query = parse_qs(scope.get("query_string", b"").decode("latin-1"))
    return {name: query[name][0] for name in ("key", "token") if name in query}


def allowed_hosts(listens_on: str, given: Sequence[str], *, open_to_all: bool) -> tuple[str, ...]:
    """Return the accepted host names: those given, else loopback's for a service without keys."""
    if given:
        return tuple(given)
    return _LOOPBACK if open_to_all and is_loopback(listens_on) else ()


async def _refuse(error: Unauthorized | Forbidden | SceneNotFound, scope: Scope, receive: Receive, send: Send) -> None:
    response = problem_response(error, scope["path"])
    if isinstance(error, Unauthorized):
        response.headers["WWW-Authenticate"] = "Bearer"
    await refuse(response, scope, receive, send)
