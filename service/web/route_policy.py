"""What each route allows: its role, whether it reads a body and how large, and the limits that count its requests.

A policy is declared on the function or application that serves a route, directly under its path. The middleware looks
up the route of a request, and enforces the policy before it reads a byte of the body: a FastAPI dependency would run
only after the whole upload. What declares nothing is denied to all but administrators, and stops the start.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

from fastapi.routing import iter_route_contexts
from starlette.routing import BaseRoute, Match
from starlette.types import Scope

from service.web.key_file import Role
from service.web.settings import Settings

SAFE_METHODS = ("GET", "HEAD", "OPTIONS")
_ATTRIBUTE = "route_policy"
_Endpoint = TypeVar("_Endpoint")


@dataclass(frozen=True, slots=True)
class BodyLimit:
    """How large a body may be, and how long it may take to arrive."""

    max_bytes: Callable[[Settings], int]

    def seconds(self, settings: Settings) -> float:
        """Return the time limit: one second more for each megabyte, so that slow lines are not cut off."""
        return settings.upload_s + self.max_bytes(settings) / 1e6


SMALL_BYTES = 1_000_000
SMALL_BODY = BodyLimit(lambda settings: SMALL_BYTES)
"""A body without a file."""
PHOTO_BODY = BodyLimit(lambda settings: settings.upload_limit * 4 // 3 + SMALL_BYTES)
"""Photos in base64, which takes 4/3 of their bytes, and the fields beside them; their own size is checked later."""
SCENE_BODY = BodyLimit(lambda settings: settings.max_scene_bytes)


@dataclass(frozen=True, slots=True)
class RoutePolicy:
    """What the middleware enforces for a route."""

    role: Role | None
    """The lowest role that may use it; None: anybody, without a key."""
    body: BodyLimit | None = None
    """None: no body is read, whatever is sent."""
    rate_limited: bool = False
    """Requests count towards the client's `rate_limit`."""
    queues_job: bool = False
    """Requests are refused while the queue is full."""
    key_in_address: bool = False
    """A browser opens it, and can't send a header: `?key=` and `?token=` are accepted."""


DENIED_READ = RoutePolicy("read")
"""Of safe methods where no route is: readers get 404, everybody else 401."""
DENIED_WRITE = RoutePolicy("admin", SMALL_BODY, rate_limited=True)
"""Of other methods where no route is, or none that declares a policy."""


def declare(endpoint: _Endpoint, policy: RoutePolicy) -> _Endpoint:
    """Attach a policy to what serves a route: a function, or the application of a mount."""
    # On what serves the route: FastAPI makes its route objects later, and keeps that in them.
    setattr(endpoint, _ATTRIBUTE, policy)
    return endpoint


def route_policy(
    *,
    role: Role | None,
    body: BodyLimit | None = None,
    rate_limited: bool = False,
    queues_job: bool = False,
    key_in_address: bool = False,
) -> Callable[[_Endpoint], _Endpoint]:
    """Return a decorator that declares the policy of a route's function; it stands below the route's own."""
    policy = RoutePolicy(role, body, rate_limited, queues_job, key_in_address)
    return lambda endpoint: declare(endpoint, policy)


def declared_policy(route: BaseRoute) -> RoutePolicy | None:
    """Return what a route, WebSocket or mount declares."""
    # Routes and WebSockets have a function, mounts an application.
    served_by = getattr(route, "endpoint", None) or getattr(route, "app", None)
    return getattr(served_by, _ATTRIBUTE, None)


def require_policies(routes: Sequence[BaseRoute]) -> None:
    """Check that every route declares a policy. Raises TypeError."""
    for found in iter_route_contexts(routes):
        if declared_policy(found.original_route) is None:
            raise TypeError(f"the route {found.path} declares no policy")


@dataclass(frozen=True, slots=True)
class FoundRoute:
    """What is known of a request's route before the request is answered."""

    policy: RoutePolicy
    scene_id: str | None = None
    """In the path: the scene that the request is about."""


def find_route(routes: Sequence[BaseRoute], scope: Scope) -> FoundRoute:
    """Find the route of an HTTP or WebSocket request, as the router will, and return its policy.

    HEAD and OPTIONS have the policy of GET at their path. A mount serves safe methods only. Where no route matches, the
    request is denied by default.
    """
    is_socket = scope["type"] == "websocket"
    is_safe = is_socket or scope["method"] in SAFE_METHODS
    if is_safe and not is_socket:
        scope = {**scope, "method": "GET"}
    if scope["path"] == scope.get("root_path"):  # the router redirects it to the start page
        scope = {**scope, "path": scope["path"] + "/"}
    # As many matches as the router itself makes; 30 regular expressions take some microseconds.
    for found in iter_route_contexts(routes):
        match, matched = found.matches(scope)
        if match is Match.FULL:
            policy = declared_policy(found.original_route)
            # A mount matches every method, and has no list of its own.
            if policy and (is_safe or found.methods):
                return FoundRoute(policy, matched.get("path_params", {}).get("scene_id"))
    return FoundRoute(DENIED_READ if is_safe else DENIED_WRITE)
