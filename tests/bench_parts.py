"""Parts for the tests of `service.bench.gpu_runner`: they are imported by name in a process of their own."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from typing import Any


class Shared:
    def __init__(self, name: str) -> None:
        self.name, self.parts = name, 0


def good(shared: Shared) -> Iterator[dict[str, Any]]:
    shared.parts += 1
    yield {"process": os.getpid(), "name": shared.name}
    yield {"parts": shared.parts}


def failing(shared: Shared) -> Iterator[dict[str, Any]]:
    yield {"row": 1}
    raise ArithmeticError("no result")


def unwritable(shared: Shared) -> Iterator[dict[str, Any]]:
    yield {"row": 1}
    yield {"row": float("nan")}


def dying(shared: Shared) -> Iterator[dict[str, Any]]:
    yield {"row": 1}
    os._exit(7)


def endless(shared: Shared) -> Iterator[dict[str, Any]]:
    yield {"row": 1}
    time.sleep(600)
    yield {"row": 2}
