"""Finds the route of a request, and puts its policy and the scene that it names into the request's state."""

from __future__ import annotations

from collections.abc import Sequence

from starlette.routing import BaseRoute
from starlette.types import ASGIApp, Receive, Scope, Send

from service.web.route_policy import find_route


class RouteLookup:
    """ASGI middleware. `routes` is read anew for each request: the sub-path must be in its scope by now."""

    def __init__(self, app: ASGIApp, routes: Sequence[BaseRoute]) -> None:
        self._app, self._routes = app, routes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] in ("http", "websocket"):
            # Starlette's `request.state` shows the same dictionary to the routes.
            found = find_route(self._routes, scope)
            scope.setdefault("state", {}).update(policy=found.policy, scene_id=found.scene_id)
        await self._app(scope, receive, send)
