"""Runs the parts of `splatfix bench gpu` one after another, and writes what is known after every row of every part.

    this process: limits, the file            a process of its own: parts, one after another
    part 1                        ----->      rows, as they are made
    rows, end                     <-----
    part 2                        ----->      ...

A part that fails, dies or outlasts its limit costs that process, since a GPU's context may be unusable afterwards; the
next part begins in a new one. Whatever happens to either process, the file is whole: it is replaced, never rewritten.
"""

from __future__ import annotations

import importlib
import json
import multiprocessing
import os
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

Row = dict[str, Any]
DONE, FAILED, LATE, DIED, RUNNING, NOT_RUN = "done", "failed", "too late", "died", "running", "not run"
"""States of a part."""
_LEAST_S = 1.0
"""Of the whole time limit, without which a part isn't begun."""


@dataclass(frozen=True, slots=True)
class Part:
    """One part of the bench."""

    name: str
    function: str
    """`module:function`, a generator function of rows that takes what `setup` of `run_parts` made."""
    limit_s: float


def run_parts(
    parts: Sequence[Part],
    setup: tuple[str, tuple[Any, ...]],
    *,
    facts: Row,
    limit_s: float,
    file: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Run the parts; return `facts` with `parts`, a dict each, as written to `file` after each row.

    `setup` has `module:function` and arguments; called in the parts' process, it makes what all parts share. Without
    the first part nothing else would work: if it isn't done, the others aren't run. A part gets its own limit, or what
    is left of `limit_s`.
    """
    ends_at = time.monotonic() + limit_s
    states: list[dict[str, Any]] = [{"part": p.name, "state": NOT_RUN, "seconds": 0.0, "rows": []} for p in parts]
    outcome = {**facts, "parts": states}
    worker: _Worker | None = None
    try:
        for done, (part, state) in enumerate(zip(parts, states, strict=True)):
            left_s = ends_at - time.monotonic()
            if left_s < _LEAST_S or states[0]["state"] not in (DONE, NOT_RUN):
                break
            worker = worker or _Worker(setup)
            for change in worker.run(part, min(part.limit_s, left_s)):
                state["rows"] += change.pop("rows", [])
                state |= change
                write_whole(file, outcome)
            if state["state"] != DONE:
                worker.kill()
                worker = None
            if progress:
                progress(done + 1, len(parts))
    finally:
        if worker:
            worker.kill()
    write_whole(file, outcome)
    return outcome


def write_whole(file: Path | None, outcome: dict[str, Any]) -> None:
    """Replace the file: a reader, or a run that is cut short, finds the old content or the new one."""
    if file:
        temporary = file.with_name(file.name + ".part")
        temporary.write_text(json.dumps(outcome, indent=1) + "\n", encoding="utf-8")
        os.replace(temporary, file)


class _Worker:
    """The process that runs parts."""

    def __init__(self, setup: tuple[str, tuple[Any, ...]]) -> None:
        context = multiprocessing.get_context("spawn")  # CUDA doesn't survive a fork
        self._connection, other = context.Pipe()
        self._process = context.Process(target=_work, args=(other, setup), daemon=True)
        self._process.start()
        # Else the end of that process would not be the end of the connection.
        other.close()

    def run(self, part: Part, limit_s: float) -> Iterator[dict[str, Any]]:
        """Yield changes of the part's state: new `rows` to be appended, its end."""
        began = time.monotonic()

        def change(state: str, **more: Any) -> dict[str, Any]:
            return {"state": state, "seconds": round(time.monotonic() - began, 2), **more}

        yield change(RUNNING)
        try:
            self._connection.send(part.function)
            while self._connection.poll(max(0.0, began + limit_s - time.monotonic())):
                kind, value = self._connection.recv()
                if kind != "row":
                    yield change(kind, **value)
                    return
                yield change(RUNNING, rows=[value])
        except (EOFError, OSError):
            self._process.join(5)
            yield change(DIED, error=f"its process ended with exit code {self._process.exitcode}.")
            return
        yield change(LATE, error=f"it was stopped after {limit_s:.0f} s.")

    def kill(self) -> None:
        """End the process, whatever it does."""
        self._connection.close()
        self._process.kill()
        self._process.join(10)


def _work(connection: Connection, setup: tuple[str, tuple[Any, ...]]) -> None:
    """Run parts as they are asked for. Sends ("row", row) for each row, then a state and what belongs to it."""
    shared: Any = None
    with suppress(EOFError, OSError):  # the other process has ended
        while True:
            name = connection.recv()
            try:
                if shared is None:
                    shared = _function(setup[0])(*setup[1])
                for row in _function(name)(shared):
                    # What JSON can't hold is this part's failure, not that of the process that writes the file.
                    connection.send(("row", json.loads(json.dumps(row, allow_nan=False))))
            except Exception as error:  # whatever it is, it is this part's result
                text = f"{type(error).__name__}: {error}"
                connection.send((FAILED, {"error": text, "traceback": traceback.format_exc()[-2000:]}))
            else:
                connection.send((DONE, {}))


def _function(name: str) -> Callable[..., Any]:
    module, _, function = name.partition(":")
    return getattr(importlib.import_module(module), function)
