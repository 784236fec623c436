"""Finds the route of a request, and puts the route's policy into the request's state for the layers behind."""

from __future__ import annotations

from collections.abc import Sequence

from starlette.routing import BaseRoute
from starlette.types import ASGIApp, Receive, Scope, Send

from service.web.route_policy import find_policy


class RouteLookup:
    """ASGI middleware. `routes` is read anew for each request: the sub-path must be in its scope by now."""

    def __init__(self, app: ASGIApp, routes: Sequence[BaseRoute]) -> None:
        self._app, self._routes = app, routes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] in ("http", "websocket"):
            # Starlette's `request.state` shows the same dictionary to the routes.
            scope.setdefault("state", {})["policy"] = find_policy(self._routes, scope)
        await self._app(scope, receive, send)
