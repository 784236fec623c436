"""Who may use the service: every combination of what a request brings. See docs/security.md."""

from __future__ import annotations

import asyncio
import itertools
from typing import Any

import pytest

from service.errors import InvalidRequest
from service.web.api_keys import KeyRing
from service.web.app import access_rules
from service.web.key_file import ROLES, Role
from service.web.middleware.authentication import (
    COOKIE,
    AccessRules,
    Authentication,
    allowed_hosts,
    is_loopback,
)
from service.web.route_policy import RoutePolicy
from service.web.settings import Settings

LOOPBACK = {"127.0.0.1": True, "127.8.8.8": True, "localhost": True, "::1": True}
BEYOND = {"0.0.0.0": False, "::": False, "192.168.1.27": False, "12.7.0.1": False, "example.org": False}


@pytest.mark.parametrize(("host", "expected"), [*LOOPBACK.items(), *BEYOND.items()])
def test_loopback_is_what_only_this_machine_reaches(host: str, expected: bool) -> None:
    assert is_loopback(host) is expected


@pytest.mark.parametrize("given", [(), ("photos.example",)])
@pytest.mark.parametrize("open_to_all", [False, True])
@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_without_keys_a_service_on_loopback_has_loopbacks_names_alone(
    host: str, open_to_all: bool, given: tuple[str, ...]
) -> None:
    """Elsewhere, and with keys, any name will do: DNS rebinding gains nothing, and nobody knows the names."""
    found = allowed_hosts(host, given, open_to_all=open_to_all)
    if given:
        assert found == given
    elif host == "127.0.0.1" and open_to_all:
        assert set(found) == {"localhost", "127.0.0.1", "[::1]"}
    else:
        assert found == ()


@pytest.mark.parametrize(("host", "keys", "said"), [*itertools.product(["127.0.0.1", "0.0.0.0"], *2 * [[False, True]])])
def test_only_loopback_keys_or_a_word_let_a_service_start(host: str, keys: bool, said: bool) -> None:
    ring = KeyRing(None)
    if keys:
        ring.make_temporary("somebody", "read")
    chosen = Settings(host=host, open=said, scenes=[], keys_file=None)
    if host == "127.0.0.1" or keys or said:
        assert access_rules(chosen, ring).open is not keys
    else:
        with pytest.raises(InvalidRequest, match="everybody"):
            access_rules(chosen, ring)


# ------------------------------------------------------------------ one request


class Request:
    """What became of one request: the status it was answered with, or 200 if it went through."""

    def __init__(
        self, rules: AccessRules, policy: RoutePolicy, *, query: str = "", kind: str = "http", method: str = "GET",
        scheme: str = "http", root: str = "", **headers: str,
    ) -> None:  # fmt: skip
        self.sent: list[dict[str, Any]] = []
        self.scope: dict[str, Any] = {
            "type": kind,
            "method": method,
            "path": f"{root}/page",
            "root_path": root,
            "scheme": scheme,
            "query_string": query.encode(),
            "headers": [(name.encode(), text.encode()) for name, text in {"host": "localhost:8", **headers}.items()],
            "state": {"policy": policy},
        }
        asyncio.run(Authentication(self._app, rules)(self.scope, self._receive, self._send))  # type: ignore[arg-type]

    async def _app(self, *_: Any) -> None:
        self.sent.append({"status": 200})

    async def _receive(self) -> dict[str, Any]:
        return {"type": "http.request", "body": b"", "more_body": False}

    async def _send(self, message: Any) -> None:
        self.sent.append(message)

    @property
    def status(self) -> int:
        return self.sent[0].get("status", self.sent[0].get("code"))

    @property
    def headers(self) -> dict[str, str]:
        return {name.decode(): text.decode() for name, text in self.sent[0].get("headers", ())}


def rules(*, keys: bool = True, hosts: tuple[str, ...] = (), origins: tuple[str, ...] = ()) -> tuple[AccessRules, dict]:
    ring, made = KeyRing(None), {}
    if keys:
        made = {role: ring.make_temporary(f"my {role}", role) for role in ROLES}
    return AccessRules(ring, not keys, hosts, origins), made


def policy(role: Role | None, *, key_in_address: bool = False) -> RoutePolicy:
    return RoutePolicy(role=role, key_in_address=key_in_address)


@pytest.mark.parametrize("sent", [None, "wrong", *ROLES])
@pytest.mark.parametrize("needed", [None, *ROLES])
@pytest.mark.parametrize("keys", [False, True])
def test_roles_include_the_lower_ones(keys: bool, needed: Role | None, sent: str | None) -> None:
    allowed, made = rules(keys=keys)
    header = {} if sent is None else {"authorization": f"Bearer {made.get(sent, 'sfx_wrong')}"}
    request = Request(allowed, policy(needed), **header)
    if not keys:
        expected = 200
    elif sent == "wrong":
        expected = 401  # not taken for none, on public pages either
    elif needed is None:
        expected = 200
    elif sent is None:
        expected = 401
    else:
        expected = 200 if ROLES.index(sent) >= ROLES.index(needed) else 403  # type: ignore[arg-type]
    assert request.status == expected
    assert request.headers.get("www-authenticate") == ("Bearer" if expected == 401 else None)
    if expected == 200:
        caller = request.scope["state"]["caller"]
        assert (caller.role if caller else None) == (sent if sent in made else None)


@pytest.mark.parametrize("scheme", ["Basic", "Digest", "bearer", "BEARER"])
def test_other_schemes_are_no_keys(scheme: str) -> None:
    allowed, made = rules()
    request = Request(allowed, policy("read"), authorization=f"{scheme}  {made['read']} ")
    assert request.status == (200 if scheme.lower() == "bearer" else 401)


@pytest.mark.parametrize("by", ["key", "token"])
@pytest.mark.parametrize("accepted", [False, True])
@pytest.mark.parametrize("valid", [False, True])
def test_a_key_in_the_address_counts_where_the_route_says_so(valid: bool, accepted: bool, by: str) -> None:
    allowed, made = rules()
    key = made["read"]
    if by == "token":
        key = allowed.keys.token(allowed.keys.caller(key), 60.0)  # type: ignore[arg-type]
    query = f"{by}={key if valid else 'sfx_wrong'}&job=7"
    request = Request(allowed, policy("read", key_in_address=accepted), query=query)
    assert request.status == (303 if accepted and valid else 401)
    if request.status == 303:
        cookie = request.headers["set-cookie"]
        assert request.headers["location"] == "/page"
        assert "HttpOnly" in cookie
        assert "SameSite=lax" in cookie
        assert "Secure" not in cookie
        assert f"Max-Age={12 * 3600};" in cookie  # docs/security.md: 12 hours
        again = Request(allowed, policy("read"), cookie=cookie.partition(";")[0])
        assert again.status == 200
        assert again.scope["state"]["caller"].name == "my read"


def test_behind_tls_and_below_a_path_the_cookie_is_for_that_alone() -> None:
    allowed, made = rules()
    request = Request(
        allowed, policy("read", key_in_address=True), query=f"key={made['admin']}", scheme="https", root="/fix"
    )
    assert request.headers["location"] == "/fix/page"
    assert "Secure" in request.headers["set-cookie"]
    assert "Path=/fix/;" in request.headers["set-cookie"]


def test_a_socket_is_not_redirected_but_opened_with_the_key_of_its_address() -> None:
    allowed, made = rules()
    accepting = policy("read", key_in_address=True)
    assert Request(allowed, accepting, kind="websocket", query=f"key={made['read']}").status == 200
    assert Request(allowed, accepting, kind="websocket").status == 1008


def test_an_expired_cookie_counts_as_none() -> None:
    allowed, made = rules()
    expired = allowed.keys.token(allowed.keys.caller(made["read"]), -1.0)  # type: ignore[arg-type]
    assert Request(allowed, policy(None), cookie=f"{COOKIE}={expired}").status == 200
    assert Request(allowed, policy("read"), cookie=f"{COOKIE}={expired}").status == 401


@pytest.mark.parametrize("kind", ["http", "websocket"])
@pytest.mark.parametrize("method", ["GET", "HEAD", "POST", "PUT", "DELETE"])
@pytest.mark.parametrize("origin", [None, "own", "friend", "foreign", "null"])
def test_other_sites_pages_may_read_nothing_and_change_nothing(origin: str | None, method: str, kind: str) -> None:
    sites = {"own": "http://localhost:8", "friend": "https://friend.example", "foreign": "https://evil.example"}
    allowed, _ = rules(keys=False, origins=(sites["friend"],))
    header = {} if origin is None else {"origin": sites.get(origin, origin)}
    request = Request(allowed, policy("read"), kind=kind, method=method, **header)
    guarded = kind == "websocket" or method not in ("GET", "HEAD")
    refused = guarded and origin in ("foreign", "null")
    assert request.status == ((1008 if kind == "websocket" else 403) if refused else 200)


@pytest.mark.parametrize(
    ("host", "passes"),
    [*((name, True) for name in ("localhost:8", "LOCALHOST", "127.0.0.1:99", "[::1]:9", "photos.example"))]
    + [(name, False) for name in ("evil.example", "evil.example:80", "photos.example.evil.example", "")],
)
def test_names_of_the_service(host: str, passes: bool) -> None:
    named, _ = rules(keys=False, hosts=("photos.example",))
    any_name, _ = rules(keys=False)
    assert Request(named, policy("read"), host=host).status == (200 if passes else 403)
    assert Request(any_name, policy("read"), host=host).status == 200
