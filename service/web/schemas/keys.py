"""API keys: what a key may do, and what is asked for one."""

from __future__ import annotations

from datetime import UTC, datetime

from pydantic import AwareDatetime, Field

from service.web.api_keys import Caller
from service.web.api_model import Model
from service.web.key_file import KeyLimits, Role, StoredKey


class KeyIn(Model):
    """What a new key may do."""

    role: Role = "localize"
    """Each role includes those before it: `read`, `localize`, `admin`."""
    scenes: list[str] | None = Field(default=None, max_length=100)
    """Names of the scenes that it may use, or patterns (`*`, `?`, `[12]`); null: all, as an `admin` key always has."""
    rate: str | None = Field(default=None, max_length=40)
    """Its rate limit, as `10/second`, `600/minute`, `1000/day`; null: that of the service."""
    queue_share: float | None = Field(default=None, gt=0, le=1, allow_inf_nan=False)
    """How much of the queue its waiting jobs may take; null: all."""
    expires: AwareDatetime | None = None
    """When it ends, with its sessions and share links; null: never."""

    def limits(self) -> KeyLimits:
        """Return what narrows the role. Raises InvalidRequest."""
        scenes = None if self.scenes is None else tuple(self.scenes)
        return KeyLimits(scenes, self.rate, self.queue_share, self.expires and self.expires.timestamp())


class _Grant(Model):
    role: Role
    scenes: list[str] | None
    """Names or patterns of the scenes that it may use; null: all."""
    rate: str | None
    """Its own rate limit; null: that of the service."""
    queue_share: float | None
    """How much of the queue its waiting jobs may take; null: all."""
    expires: datetime | None


class OwnKey(_Grant):
    """What the key may do that the request was sent with."""

    name: str | None
    """null: the service has no keys, and everybody may do everything."""


class KeyOut(_Grant):
    """An API key, without the key itself."""

    name: str
    created: datetime | None
    """null: not on record."""
    expired: bool
    temporary: bool
    """It was made for this run of the service, and ends with it."""


class NewKey(KeyOut):
    """A key that was just made."""

    key: str
    """The key itself: it is shown this once, only its hash is kept."""


class KeyList(Model):
    """The API keys of the service."""

    keys: list[KeyOut]


def own_key_out(caller: Caller | None) -> OwnKey:
    """Describe the caller's key."""
    if caller is None:
        return OwnKey(name=None, role="admin", scenes=None, rate=None, queue_share=None, expires=None)
    return OwnKey(name=caller.name, role=caller.role, **_limits(caller.limits))


def key_out(key: StoredKey, *, temporary: bool) -> KeyOut:
    """Describe a key."""
    created = None if key.created is None else datetime.fromtimestamp(key.created, UTC)
    return KeyOut(
        name=key.name,
        role=key.role,
        **_limits(key.limits),
        created=created,
        expired=not key.is_valid(),
        temporary=temporary,
    )


def _limits(limits: KeyLimits) -> dict:
    return {
        "scenes": None if limits.scenes is None else list(limits.scenes),
        "rate": limits.rate,
        "queue_share": limits.queue_share,
        "expires": None if limits.expires is None else datetime.fromtimestamp(limits.expires, UTC),
    }
