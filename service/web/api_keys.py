"""API keys with roles, and the short-lived tokens that browsers use in their place.

Only the SHA-256 of a key is stored. It needs no salt: a key is 256 random bits, which can't be guessed from it.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
import os
import secrets
import time
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, get_args

from service.errors import InvalidRequest, StorageFailed

Role = Literal["read", "localize", "admin"]
ROLES: tuple[Role, ...] = get_args(Role)
"""In ascending order; each role includes those before it."""
VIEWER_KEY = "viewer"
"""Name of the key of the viewer's process."""
_PREFIX = "sfx_"
"""Marks a key for people and for secret scanners."""
_SECRET_BYTES = 32
_SHARED = "share:"
"""Before what is signed of a share token: no session's token passes for one, nor the other way round."""
_RECHECK_S = 1.0
"""Time between two checks of the file."""


@dataclass(frozen=True, slots=True)
class Caller:
    """The owner of an accepted key."""

    name: str
    """Of the key."""
    role: Role

    def has_role(self, role: Role) -> bool:
        """Return whether the caller's role includes another."""
        return ROLES.index(self.role) >= ROLES.index(role)


@dataclass(frozen=True, slots=True)
class StoredKey:
    """An entry of the key file."""

    name: str
    role: Role
    sha256: str


class KeyRing:
    """The keys of a file, which is read again when it changes, and temporary keys of this process."""

    def __init__(self, path: Path | None) -> None:
        """Read the keys; none if there is no file. Raises InvalidRequest if the file is damaged."""
        self._path = path
        self._temporary: list[StoredKey] = []
        # Until `keep_sessions`: tokens end with the process.
        self._secret = secrets.token_bytes(_SECRET_BYTES)
        self._read_at, self._stamp = 0.0, (0, 0)
        self._stored: list[StoredKey] = []
        self._refresh()

    def __bool__(self) -> bool:
        """Return whether a client needs a key: whether there is any but the viewer's own."""
        self._refresh()
        return bool(self._stored) or any(key.name != VIEWER_KEY for key in self._temporary)

    def keep_sessions(self, path: Path) -> None:
        """Sign tokens with the secret in a file, made if it isn't there, so that they outlive a restart.

        Raises StorageFailed.
        """
        try:
            secret = path.read_bytes() if path.exists() else b""
            if len(secret) != _SECRET_BYTES:
                secret = secrets.token_bytes(_SECRET_BYTES)
                _write_private(path, secret)
        except OSError as error:
            raise StorageFailed(f"the secret of sessions can't be kept: {error.strerror}.", where=path.name) from error
        self._secret = secret

    def make_temporary(self, name: str, role: Role) -> str:
        """Make a key that is valid until the process ends; return it."""
        key = _PREFIX + secrets.token_urlsafe(32)
        self._temporary.append(StoredKey(name, role, _digest(key)))
        return key

    def caller(self, key: str) -> Caller | None:
        """Return the owner of a key; None for an unknown one. The comparison takes constant time."""
        self._refresh()
        digest, found = _digest(key), None
        # No early exit: the time must not reveal which key comes close.
        for known in (*self._stored, *self._temporary):
            if hmac.compare_digest(known.sha256, digest):
                found = Caller(known.name, known.role)
        return found

    def key_id(self, caller: Caller) -> str:
        """Return what tells a key from an earlier one of the same name: digits of its hash; empty if it was removed."""
        self._refresh()
        ids = [_key_id(key) for key in (*self._stored, *self._temporary) if key.name == caller.name]
        return ids[0] if ids else ""

    def token(self, caller: Caller, seconds: float) -> str:
        """Return a signed token that is valid for that time, but no longer than the caller's key."""
        key = self.key_id(caller)
        claim = json.dumps({"name": caller.name, "role": caller.role, "key": key, "until": time.time() + seconds})
        text = base64.urlsafe_b64encode(claim.encode()).decode()
        return f"{text}.{self._signature(text)}"

    def bearer(self, token: str) -> Caller | None:
        """Return the owner of a token; None if it is forged or expired, or its key was removed."""
        text, _, signature = token.partition(".")
        if not hmac.compare_digest(self._signature(text).encode(), signature.encode()):
            return None
        claim = json.loads(base64.urlsafe_b64decode(text))
        caller = Caller(claim["name"], claim["role"])
        self._refresh()
        # The signature proves who made the token, not that the key still exists with that role. Its hash counts, too:
        # a key of the same name that was added later is another one.
        living = {(key.name, key.role, _key_id(key)) for key in (*self._stored, *self._temporary)}
        named = caller.name, caller.role, claim["key"]
        return caller if claim["until"] > time.time() and named in living else None

    def share_token(self, job_id: str, seconds: float, caller: Caller | None) -> str:
        """Return a signed token that shows a job to whoever has it, for that time, but no longer than the caller's key.

        `caller` is None where the service has no keys.
        """
        key = [caller.name, caller.role, self.key_id(caller)] if caller else None
        claim = json.dumps({"job": job_id, "key": key, "until": time.time() + seconds})
        text = base64.urlsafe_b64encode(claim.encode()).decode().rstrip("=")
        return f"{text}.{self._signature(_SHARED + text)}"

    def shared_job(self, token: str) -> str | None:
        """Return the id of the job that a share token shows; None if it is forged, expired, or its key was removed."""
        text, _, signature = token.partition(".")
        if not hmac.compare_digest(self._signature(_SHARED + text).encode(), signature.encode()):
            return None
        claim = json.loads(base64.urlsafe_b64decode(text + "=" * (-len(text) % 4)))
        self._refresh()
        living = [[key.name, key.role, _key_id(key)] for key in (*self._stored, *self._temporary)]
        key_lives = claim["key"] is None or claim["key"] in living
        return claim["job"] if claim["until"] > time.time() and key_lives else None

    def _signature(self, text: str) -> str:
        return hmac.new(self._secret, text.encode(), "sha256").hexdigest()

    def _refresh(self) -> None:
        if self._path is None or time.monotonic() - self._read_at < _RECHECK_S:
            return
        self._read_at = time.monotonic()
        try:
            found = self._path.stat()
        except FileNotFoundError:
            # Removed with its last key, or not there yet.
            self._stored, self._stamp = [], (0, 0)
            return
        stamp = found.st_mtime_ns, found.st_size
        if stamp != self._stamp:
            self._stored, self._stamp = read_keys(self._path), stamp


def read_keys(path: Path) -> list[StoredKey]:
    """Return a file's keys; none if there is no file. Raises InvalidRequest."""
    try:
        entries = json.loads(path.read_text("utf-8")) if path.exists() else []
        keys = [StoredKey(**entry) for entry in entries]
    except (OSError, ValueError, TypeError) as error:
        raise InvalidRequest(f"not a file of keys: {error}.", where=str(path)) from error
    if not all(key.role in ROLES for key in keys):
        raise InvalidRequest(f"a role must be one of {', '.join(ROLES)}.", where=str(path))
    return keys


def add_key(path: Path, name: str, role: Role) -> str:
    """Make a key and store its hash; return the key, which can't be read from the file. Raises InvalidRequest."""
    keys = read_keys(path)
    if any(key.name == name for key in keys):
        raise InvalidRequest(f"key '{name}' already exists.", where="name", hint="Remove it first.")
    key = _PREFIX + secrets.token_urlsafe(32)
    _write(path, [*keys, StoredKey(name, role, _digest(key))])
    return key


def remove_key(path: Path, name: str) -> None:
    """Remove a key; running services refuse it from the next second on. Raises InvalidRequest."""
    keys = read_keys(path)
    left = [key for key in keys if key.name != name]
    if len(left) == len(keys):
        raise InvalidRequest(f"key '{name}' not found.", where="name")
    _write(path, left)


def _write(path: Path, keys: list[StoredKey]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    _write_private(path, json.dumps([asdict(key) for key in keys], indent=1).encode())


def _write_private(path: Path, content: bytes) -> None:
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


def _key_id(key: StoredKey) -> str:
    return key.sha256[:16]


def _digest(key: str) -> str:
    return hashlib.sha256(key.encode()).hexdigest()
