"""The keys of a running service, and the tokens that stand for them: of sessions, of share links, of the viewer."""

from __future__ import annotations

import base64
import hmac
import json
import os
import secrets
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from service.errors import InvalidRequest
from service.web.key_file import (
    ROLES,
    UNLIMITED,
    KeyLimits,
    Role,
    StoredKey,
    add_key,
    digest,
    key_exists,
    new_key,
    read_keys,
    remove_key,
)

_SESSION, _SHARED, _VIEWER = "session:", "share:", "viewer:"
"""Kinds of tokens. They are signed with the kind before them, so that none passes for one of another kind."""


@dataclass(frozen=True, slots=True)
class Caller:
    """The owner of an accepted key."""

    name: str
    """Of the key."""
    role: Role
    id: str = ""
    """Of the key: another one of the same name has another."""
    limits: KeyLimits = UNLIMITED
    by_viewer: bool = False
    """The viewer asks, for somebody who looks at it."""

    @property
    def client(self) -> str:
        """The key by name and id: whose jobs, lenses and limits these are."""
        return f"key:{self.name}:{self.id}"

    def has_role(self, role: Role) -> bool:
        """Return whether the caller's role includes another."""
        return ROLES.index(self.role) >= ROLES.index(role)


class KeyRing:
    """The keys of a file, which is read again when it changes, and temporary keys of this process."""

    def __init__(self, path: Path | None) -> None:
        """Read the keys; none if there is no file. Raises InvalidRequest if the file is damaged."""
        self._path = path
        self._temporary: list[StoredKey] = []
        # Until `keep_sessions`: tokens end with the process.
        self._secret = secrets.token_bytes()
        self._stamp = (0, 0, 0)
        self._stored: list[StoredKey] = []
        self._refresh()

    def __bool__(self) -> bool:
        """Return whether a client needs a key: whether there is any, be it expired."""
        self._refresh()
        return bool(self._stored or self._temporary)

    def keep_sessions(self, secret: bytes) -> None:
        """Sign tokens with a secret that is kept, so that they outlive a restart, and hold at all fronts."""
        self._secret = secret

    def make_temporary(self, name: str, role: Role, limits: KeyLimits = UNLIMITED) -> str:
        """Make a key that is valid until the process ends; return it."""
        key, stored = new_key(name, role, limits)
        self._temporary.append(stored)
        return key

    def listed(self) -> list[tuple[StoredKey, bool]]:
        """Return all keys, each with whether it is temporary."""
        self._refresh()
        return [*((key, False) for key in self._stored), *((key, True) for key in self._temporary)]

    def unnamed_clients(self) -> Iterator[tuple[str, str]]:
        """Yield, of each key of an earlier release, whose jobs it has: by its name alone, and by name and id.

        Such a release kept no key's time; a key of the same name that was made later has one, and gets no jobs.
        """
        for key, _ in self.listed():
            if key.created is None:
                yield f"key:{key.name}", _caller(key).client

    def add(self, name: str, role: Role, limits: KeyLimits) -> str:
        """Make a key and store its hash; return the key. Raises InvalidRequest, StorageFailed."""
        if any(key.name == name for key in self._temporary):
            raise key_exists(name)
        return add_key(self._stored_in(), name, role, limits)

    def remove(self, name: str) -> None:
        """Remove a key, with all that stands for it. Raises KeyNotFound, InvalidRequest, StorageFailed."""
        left = [key for key in self._temporary if key.name != name]
        if len(left) < len(self._temporary):
            self._temporary = left
            return
        remove_key(self._stored_in(), name)

    def _stored_in(self) -> Path:
        if self._path is None:
            raise InvalidRequest("no file of keys is set.", where="keys_file", hint="Set SPLATFIX_KEYS_FILE.")
        return self._path

    def caller(self, key: str) -> Caller | None:
        """Return the owner of a key; None for an unknown or expired one. The comparison takes constant time."""
        self._refresh()
        sent, found = digest(key), None
        # No early exit: the time must not reveal which key comes close.
        for known in (*self._stored, *self._temporary):
            if hmac.compare_digest(known.sha256, sent):
                found = known
        return _caller(found) if found and found.is_valid() else None

    def still_valid(self, caller: Caller) -> bool:
        """Return whether a caller's key is still there, and has not expired."""
        return self._find(caller.id) is not None

    def token(self, caller: Caller, seconds: float) -> str:
        """Return a signed token that is valid for that time, but no longer than the caller's key."""
        return self._signed(_SESSION, {"key": caller.id, "until": time.time() + seconds})

    def bearer(self, token: str) -> Caller | None:
        """Return the owner of a token; None if it is forged or expired, or its key was removed or expired."""
        claim = self._claim(_SESSION, token)
        # The signature proves who made the token, not that the key still exists. Its hash counts, not its name: a key
        # of the same name that was added later is another one.
        key = self._find(claim["key"]) if claim and claim["until"] > time.time() else None
        return _caller(key) if key else None

    def viewer_token(self, caller: Caller) -> str:
        """Return the token by which the viewer asks in the caller's name; always the same one of a key."""
        # Without a time: the viewer shares what it has fetched among browsers whose tokens are equal.
        return self._signed(_VIEWER, {"key": caller.id})

    def viewer_bearer(self, token: str) -> Caller | None:
        """Return in whose name the viewer asks; None if the token is forged, or its key was removed or expired."""
        claim = self._claim(_VIEWER, token)
        key = self._find(claim["key"]) if claim else None
        return _caller(key, by_viewer=True) if key else None

    def share_token(self, job_id: str, seconds: float, caller: Caller | None) -> str:
        """Return a signed token that shows a job to whoever has it, for that time, but no longer than the caller's key.

        `caller` is None where the service has no keys.
        """
        key = caller.id if caller else None
        return self._signed(_SHARED, {"job": job_id, "key": key, "until": time.time() + seconds})

    def shared_job(self, token: str) -> str | None:
        """Return the id of the job that a share token shows; None if it is forged, expired, or its key is not valid."""
        claim = self._claim(_SHARED, token)
        if claim is None or claim["until"] <= time.time():
            return None
        return claim["job"] if claim["key"] is None or self._find(claim["key"]) else None

    def _find(self, key_id: str) -> StoredKey | None:
        self._refresh()
        known = (*self._stored, *self._temporary)
        return next((key for key in known if key.id == key_id and key.is_valid()), None)

    def _signed(self, kind: str, claim: dict[str, object]) -> str:
        text = base64.urlsafe_b64encode(json.dumps(claim).encode()).decode().rstrip("=")
        return f"{text}.{self._signature(kind + text)}"

    def _claim(self, kind: str, token: str) -> dict | None:
        """Return what a token of this kind claims; None if it wasn't signed here, or is of another kind."""
        text, _, signature = token.partition(".")
        # Before it is parsed: what is forged never reaches the parser.
        if not hmac.compare_digest(self._signature(kind + text).encode(), signature.encode()):
            return None
        return json.loads(base64.urlsafe_b64decode(text + "=" * (-len(text) % 4)))

    def _signature(self, text: str) -> str:
        return hmac.new(self._secret, text.encode(), "sha256").hexdigest()

    def _refresh(self) -> None:
        if self._path is None:
            return
        # Each time, for some microseconds: a key that another front has made or removed is known here at once.
        try:
            found = os.stat(self._path)
        except FileNotFoundError:
            # Removed with its last key, or not there yet.
            self._stored, self._stamp = [], (0, 0, 0)
            return
        # The file is replaced when it changes: another one may be as old and as large as the last.
        stamp = found.st_ino, found.st_mtime_ns, found.st_size
        if stamp != self._stamp:
            self._stored, self._stamp = read_keys(self._path), stamp


def _caller(key: StoredKey, *, by_viewer: bool = False) -> Caller:
    return Caller(key.name, key.role, key.id, key.limits, by_viewer)
