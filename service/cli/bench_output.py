"""What the benchmark commands print: the machine, a progress bar, and figures as lines."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from service.cli.terminal import counter, print_machine, progress_bar, say, short, write_json


@contextmanager
def measuring(unit: str) -> Iterator[Callable[[int, int], None]]:
    """Print the processor, and show a bar while a benchmark runs; yield the function that updates it: (done, total)."""
    print_machine()
    with progress_bar() as progress:
        yield counter(progress, unit)


def report_figures(outcome: Mapping[str, Any], json_file: Path | None, *, rows: str, width: int = 28) -> None:
    """Write an outcome to a file, if one is given, and print its figures; `rows` names the part for the file alone."""
    write_json(json_file, outcome)
    for name, value in outcome.items():
        # Hundreds of rows: a terminal would show nothing but them.
        if name != rows:
            say(f"{name:{width}} {short(value)}")
