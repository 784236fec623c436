"""What all fronts of a service have in common beside jobs, as a protocol, and what a service of one process has.

It is the secret that signs tokens, how often each client has asked, and which live sessions go on.
`postgres_state` is for several fronts.
"""

from __future__ import annotations

import secrets
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Protocol, runtime_checkable

from limits import RateLimitItemPerSecond, parse
from limits.storage import MemoryStorage
from limits.strategies import SlidingWindowCounterRateLimiter

from service.errors import RateLimited, StorageFailed
from service.web.key_file import write_private

SECRET_BYTES = 32


@dataclass(frozen=True, slots=True)
class Rate:
    """So many requests in so many seconds."""

    amount: int
    seconds: int


@dataclass(frozen=True, slots=True)
class SessionLimits:
    """How many live sessions may go on at once."""

    all: int
    of_client: int

    def require_room(self, all_sessions: int, of_client: int) -> None:
        """Raise RateLimited if there is no room for one more beside those that go on."""
        if of_client >= self.of_client:
            raise RateLimited(f"limit of live sessions for this key reached: {of_client}.")
        if all_sessions >= self.all:
            raise RateLimited(f"limit of live sessions of the service reached: {all_sessions}; try again later.")


@runtime_checkable
class SharedState(Protocol):
    """Safe to call from several threads. Methods may wait for a database, and raise StorageFailed without it."""

    def secret(self) -> bytes:
        """Return the secret that signs tokens: the same for all fronts, and after a restart."""
        ...

    def hit(self, client: str, rate: Rate) -> float | None:
        """Count a request of a client; return None, or in how many seconds to ask again if it is one too many.

        A sliding window counter: the requests of the last full period count with the part of it that is not yet over.
        """
        ...

    def begin_session(self, client: str, limits: SessionLimits) -> str:
        """Count a live session; return its id. Raises RateLimited if there is no room for it."""
        ...

    def renew_session(self, client: str, session: str) -> None:
        """Say that a session still goes on, which is to be done every RENEW_S seconds."""
        ...

    def end_session(self, session: str) -> None:
        """Count a session no longer; without effect if it isn't known."""
        ...


RENEW_S = 10.0


def parse_rate(text: str) -> Rate:
    """Read a rate as 10/second or 600 per minute. Raises ValueError."""
    limit = parse(text)
    return Rate(limit.amount, limit.get_expiry())


class LocalState:
    """Implements `SharedState` for one process: the secret is a file, the rest is in memory."""

    def __init__(self, secret_file: Path) -> None:
        self._secret_file = secret_file
        self._limiter = SlidingWindowCounterRateLimiter(MemoryStorage())
        self._sessions: dict[str, str] = {}
        """Client of each live session."""
        self._lock = Lock()

    def secret(self) -> bytes:
        path = self._secret_file
        try:
            secret = path.read_bytes() if path.exists() else b""
            if len(secret) != SECRET_BYTES:
                secret = secrets.token_bytes(SECRET_BYTES)
                write_private(path, secret)
        except OSError as error:
            raise StorageFailed(f"the secret of sessions can't be kept: {error.strerror}.", where=path.name) from error
        return secret

    def hit(self, client: str, rate: Rate) -> float | None:
        limit = RateLimitItemPerSecond(rate.amount, rate.seconds)
        with self._lock:
            if self._limiter.hit(limit, client):
                return None
            return self._limiter.get_window_stats(limit, client).reset_time - time.time()

    def begin_session(self, client: str, limits: SessionLimits) -> str:
        with self._lock:
            limits.require_room(len(self._sessions), Counter(self._sessions.values())[client])
            session = secrets.token_hex(8)
            self._sessions[session] = client
        return session

    def renew_session(self, client: str, session: str) -> None:
        """Do nothing: who could end without `end_session` ends this process."""

    def end_session(self, session: str) -> None:
        with self._lock:
            self._sessions.pop(session, None)
