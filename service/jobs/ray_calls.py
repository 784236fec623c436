"""Calls of Ray's actors that raise what the actors raised, and end where their cluster is left."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import ray  # pyright: ignore[reportMissingImports]
from ray.exceptions import GetTimeoutError, RayError, RayTaskError  # pyright: ignore[reportMissingImports]

from service.jobs.engine import EngineLost

_LOOK_S = 1.0
"""How often who waits looks whether the cluster is being left."""
_LEAVE_S = 10.0
"""How long those who wait are waited for."""

_lock = threading.Condition()
_under_way = 0
_cluster: object | None = None
"""The cluster that this process is in; None in none, and while it leaves one."""


def join(**settings: Any) -> None:
    """Become a part of a cluster, or start one; `settings` are ray.init's, unless Ray was started before."""
    global _cluster
    if not ray.is_initialized():
        ray.init(**settings)
    with _lock:
        _cluster = _cluster or object()


def leave() -> None:
    """Leave the cluster. Calls that are under way end with RayError first: Ray ends a process in which another thread
    uses a cluster that was left, or lets that thread wait for ever."""
    global _cluster
    with _lock:
        _cluster = None
        _lock.wait_for(lambda: _under_way == 0, _LEAVE_S)
    ray.shutdown()


def call(actor: Any, name: str, *arguments: Any) -> Any:
    """Call a method and wait for its answer. Raises what it raises, and RayError."""
    calls = _Calls()
    with _own_errors():
        return calls.waited(partial(ray.get, calls.within(partial(getattr(actor, name).remote, *arguments))))


def send(actor: Any, name: str, *arguments: Any) -> None:
    """Call a method whose answer nobody needs. Raises EngineLost."""
    try:
        _Calls().within(partial(getattr(actor, name).remote, *arguments))
    except RayError as error:
        raise EngineLost from error


def stream(method: Any, *arguments: Any) -> Iterator[Any]:
    """Yield what a method yields. Raises what it raises, and EngineLost."""
    calls = _Calls()
    try:
        messages = calls.within(partial(method.options(num_returns="streaming").remote, *arguments))
        while (message := calls.waited(partial(_next, messages))) is not None:
            with _own_errors():
                found = calls.waited(partial(ray.get, message))
            yield found
    except RayTaskError:  # a bug in the replica
        raise
    except RayError as error:
        raise EngineLost from error


def _next(messages: Any, timeout: float) -> Any:
    """Return a stream's next message; None at its end. Raises GetTimeoutError."""
    if not ray.wait([messages], timeout=timeout)[0]:
        raise GetTimeoutError
    return next(messages, None)


class _Calls:
    """Calls in the cluster that this process is in now. Once it was left, they raise RayError."""

    def __init__(self) -> None:
        self._cluster = _cluster

    def waited(self, wait: Callable[..., Any]) -> Any:
        """Return what is waited for; `wait` takes a timeout (s)."""
        while True:
            try:
                return self.within(partial(wait, timeout=_LOOK_S))
            except GetTimeoutError:
                continue

    def within(self, do: Callable[[], Any]) -> Any:
        """Return what Ray does in this cluster."""
        global _under_way
        with _lock:
            if self._cluster is None or self._cluster is not _cluster:
                raise RayError("this process is in no cluster, or in another one by now.")
            _under_way += 1
        try:
            return do()
        finally:
            with _lock:
                _under_way -= 1
                _lock.notify_all()


class _own_errors:
    """Raises errors of our own as they were raised in the actor."""

    def __enter__(self) -> None: ...

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        cause = getattr(error, "cause", None) if isinstance(error, RayTaskError) else None
        if isinstance(cause, Exception):
            raise cause from None
