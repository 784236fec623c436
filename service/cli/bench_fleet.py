"""`splatfix bench fleet`: simulated fleets of replicas."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from service.cli.terminal import err, out


def bench_fleet(
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the figures to a file.")] = None,
) -> None:
    """Simulate fleets of 2 to 100 replicas: what scenes, memory and failures do to latency."""
    from rich.table import Table

    from service.bench.fleet_simulation import run

    with err.status("simulating"):
        rows = run()
    table = Table("replicas", "scenes", "in each", "failures/h", "p50 s", "p95 s", "p99 s", "loads/job", "busy")
    for model, found in rows:
        table.add_row(
            *(str(model.replicas), str(model.scenes), str(model.scenes_in_memory), f"{model.failures_per_hour:g}"),
            *(f"{value:.2f}" for value in (found.p50_s, found.p95_s, found.p99_s)),
            *(f"{found.loads_per_job:.4f}", f"{found.busy_share:.0%}"),
        )
    out.print(table)
    if json_file:
        figures = [{"model": asdict(model), "figures": asdict(found)} for model, found in rows]
        json_file.write_text(json.dumps(figures, indent=1), encoding="utf-8")
