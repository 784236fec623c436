"""Calls of Ray's actors that raise what the actors raised, and end where their cluster is left."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import ray  # pyright: ignore[reportMissingImports]
from ray.exceptions import RayError, RayTaskError  # pyright: ignore[reportMissingImports]

from service.jobs.engine import EngineLost


def call(actor: Any, name: str, *arguments: Any) -> Any:
    """Call a method and wait for its answer. Raises what it raises, and RayError."""
    with _own_errors():
        return _waited(partial(ray.get, getattr(actor, name).remote(*arguments)))


def stream(method: Any, *arguments: Any) -> Iterator[Any]:
    """Yield what a method yields. Raises what it raises, and EngineLost."""
    try:
        messages = method.options(num_returns="streaming").remote(*arguments)
        while (message := _waited(partial(next, messages, None))) is not None:
            with _own_errors():
                found = _waited(partial(ray.get, message))
            yield found
    except RayTaskError:  # a bug in the replica
        raise
    except RayError as error:
        raise EngineLost from error


def _waited(wait: Callable[[], Any]) -> Any:
    """Return what is waited for. Raises RayError where another thread leaves the cluster meanwhile: Ray itself raises
    SystemExit there, by which a worker's thread would end, and nobody its attempt."""
    try:
        return wait()
    except SystemExit:
        raise RayError("the cluster was left.") from None


class _own_errors:
    """Raises errors of our own as they were raised in the actor."""

    def __enter__(self) -> None: ...

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        cause = getattr(error, "cause", None) if isinstance(error, RayTaskError) else None
        if isinstance(cause, Exception):
            raise cause from None
