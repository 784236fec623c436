"""The file of API keys: what each key may do, and the SHA-256 of the key itself.

The hash needs no salt: a key is 256 random bits, which can't be guessed from it.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import secrets
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Literal, get_args

from service.errors import InvalidRequest, KeyNotFound, StorageFailed
from service.operating_system import locked

Role = Literal["read", "localize", "admin"]
ROLES: tuple[Role, ...] = get_args(Role)
"""In ascending order; each role includes those before it."""
KEY_NAME = r"[A-Za-z0-9][\w .@-]{0,63}"
"""Of a key, as a regular expression: without a colon, which separates it from the key's id."""
SCENE_PATTERN = r"[\w*?\[\]!-]{1,64}"
RATE = r"[1-9]\d{0,5}/(second|minute|hour|day)"
_PREFIX = "sfx_"
"""Marks a key for people and for secret scanners."""
_ID_DIGITS = 16
_LOCK_S = 10.0
"""How long a change waits for another one."""
_UNITS_S = {"m": 60, "h": 3600, "d": 86_400, "w": 7 * 86_400}


@dataclass(frozen=True, slots=True)
class KeyLimits:
    """What narrows a key's role; the default is nothing."""

    scenes: tuple[str, ...] | None = None
    """Names of the scenes that it may use, or patterns of them (`*`, `?`, `[...]`); None: all."""
    rate: str | None = None
    """Its rate limit, e.g. 10/second; None: that of the service."""
    queue_share: float | None = None
    """How much of the queue its waiting jobs may take, 0..1; None: all."""
    expires: float | None = None
    """Seconds since 1970 at which it ends; None: never."""

    def __post_init__(self) -> None:
        """Check the values. Raises InvalidRequest."""
        if self.scenes == ():
            raise InvalidRequest("a key needs a scene.", where="scenes", hint=_SCENES)
        for pattern in self.scenes or ():
            if not re.fullmatch(SCENE_PATTERN, pattern):
                raise InvalidRequest(
                    f"{pattern[:80]!r} is neither a scene nor a pattern.", where="scenes", hint=_SCENES
                )
        if self.rate is not None and not re.fullmatch(RATE, self.rate):
            raise InvalidRequest(f"{self.rate[:40]!r} is no rate.", where="rate", hint="Example: 10/second")
        if self.queue_share is not None and not 0 < self.queue_share <= 1:
            raise InvalidRequest("must be above 0 and at most 1.", where="queue_share", hint="Example: 0.5")

    def cover(self, scene_id: str) -> bool:
        """Return whether the key may use a scene of that name, be it there or not."""
        # fnmatch itself ignores case on Windows.
        return self.scenes is None or any(fnmatchcase(scene_id, pattern) for pattern in self.scenes)


UNLIMITED = KeyLimits()
_SCENES = "Name a scene, or a pattern of names: lab, floor-*"


@dataclass(frozen=True, slots=True)
class StoredKey:
    """An entry of the key file."""

    name: str
    role: Role
    sha256: str
    limits: KeyLimits = UNLIMITED
    created: float | None = None
    """Seconds since 1970; None: not on record."""

    def __post_init__(self) -> None:
        """Check the values. Raises InvalidRequest."""
        if self.role not in ROLES:
            raise InvalidRequest(f"a role must be one of {', '.join(ROLES)}.", where="role")
        if self.role == "admin" and self.limits.scenes is not None:
            raise InvalidRequest("an admin key has all scenes.", where="scenes", hint="Leave out scenes, or the role.")

    @property
    def id(self) -> str:
        """Digits of its hash, which distinguish it from another key of the same name."""
        return self.sha256[:_ID_DIGITS]

    def is_valid(self) -> bool:
        """Return whether the key has not expired."""
        return self.limits.expires is None or time.time() < self.limits.expires


def new_key(name: str, role: Role, limits: KeyLimits = UNLIMITED) -> tuple[str, StoredKey]:
    """Make a key; return it, and its entry. Raises InvalidRequest, also for a name that no key may have."""
    if not re.fullmatch(KEY_NAME, name):
        raise InvalidRequest(
            "a key's name has 1 to 64 letters, digits, spaces and _ . @ -.", where="name", hint="Example: robot-7"
        )
    key = _PREFIX + secrets.token_urlsafe(32)
    return key, StoredKey(name, role, digest(key), limits, time.time())


def digest(key: str) -> str:
    """Return the hash by which a key is stored."""
    return hashlib.sha256(key.encode()).hexdigest()


def expiry(text: str) -> float:
    """Return the time, in seconds since 1970, of an age as `30d` (m, h, d, w) or a date as `2030-01-31`, in UTC.

    Raises InvalidRequest.
    """
    if found := re.fullmatch(r"([1-9]\d{0,4})([mhdw])", text):
        return time.time() + int(found[1]) * _UNITS_S[found[2]]
    try:
        return datetime.strptime(text, "%Y-%m-%d").replace(tzinfo=UTC).timestamp()
    except ValueError:
        raise InvalidRequest(
            f"{text[:40]!r} is neither an age nor a date.", where="expires", hint="Examples: 12h, 30d, 2030-01-31"
        ) from None


def read_keys(path: Path) -> list[StoredKey]:
    """Return a file's keys; none if there is no file. Raises InvalidRequest."""
    try:
        entries = json.loads(path.read_text("utf-8")) if path.exists() else []
        return [_stored(**entry) for entry in entries]
    except (OSError, ValueError, TypeError, InvalidRequest) as error:
        raise InvalidRequest(f"not a file of keys: {error}", where=str(path)) from error


def add_key(path: Path, name: str, role: Role, limits: KeyLimits = UNLIMITED) -> str:
    """Make a key, store its hash, return the key, which the file doesn't have. Raises InvalidRequest, StorageFailed."""
    key, stored = new_key(name, role, limits)
    with _changing(path):
        keys = read_keys(path)
        if any(known.name == name for known in keys):
            raise key_exists(name)
        _write(path, [*keys, stored])
    return key


def key_exists(name: str) -> InvalidRequest:
    """Return the error for a name that another key has."""
    return InvalidRequest(
        f"key '{name}' already exists.", where="name", hint="Remove it first, or choose another name."
    )


def remove_key(path: Path, name: str) -> None:
    """Remove a key; running services refuse it from the next request on.

    Raises KeyNotFound, InvalidRequest, StorageFailed.
    """
    with _changing(path):
        keys = read_keys(path)
        left = [key for key in keys if key.name != name]
        if len(left) == len(keys):
            raise KeyNotFound(f"key '{name[:64]}' not found.", where="name")
        _write(path, left)


@contextmanager
def _changing(path: Path) -> Iterator[None]:
    """Let nobody else change the file: two admins may add keys at once, at two fronts. Raises StorageFailed."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = locked(path.with_name(f"{path.name}.lock"), _LOCK_S)
    except OSError as error:
        raise _unwritable(error) from error
    try:
        yield
    finally:
        lock.release()


def _unwritable(error: OSError) -> StorageFailed:
    reason = "it is being changed" if isinstance(error, BlockingIOError) else error.strerror
    return StorageFailed(f"the file of keys can't be written: {reason}.", where="keys_file")


def write_private(path: Path, content: bytes) -> None:
    """Write a file that its owner alone may read. Raises OSError."""
    # Replaced at once: a running service must never read half a file.
    draft = path.with_name(f"{path.name}.{os.getpid()}")
    try:
        # Mode 600 from the start: a chmod afterwards would leave the file readable for a moment.
        with os.fdopen(os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "wb") as file:
            file.write(content)
        draft.replace(path)
    finally:
        with suppress(FileNotFoundError):
            draft.unlink()


def _stored(
    name: str, role: Role, sha256: str, scenes: Sequence[str] | None = None, created: float | None = None, **limits: Any
) -> StoredKey:
    """Return a key from its entry in the file."""
    return StoredKey(name, role, sha256, KeyLimits(None if scenes is None else tuple(scenes), **limits), created)


def _write(path: Path, keys: Sequence[StoredKey]) -> None:
    entries = []
    for key in keys:
        values = asdict(key)
        values |= values.pop("limits")
        entries.append({name: value for name, value in values.items() if value is not None})
    try:
        write_private(path, json.dumps(entries, indent=1).encode())
    except OSError as error:
        raise _unwritable(error) from error
