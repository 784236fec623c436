"""`splatfix bench ...`: the benchmark commands by name."""

from __future__ import annotations

import typer

from service.cli.bench_ablation import bench_ablation
from service.cli.bench_coverage import bench_coverage
from service.cli.bench_device import bench_device
from service.cli.bench_evaluate import bench_evaluate
from service.cli.bench_field import bench_field
from service.cli.bench_fleet import bench_fleet
from service.cli.bench_gate import bench_gate
from service.cli.bench_gpu import bench_gpu
from service.cli.bench_live import bench_live
from service.cli.bench_localize import bench_localize
from service.cli.bench_paper import bench_paper
from service.cli.bench_peer import bench_peer
from service.cli.bench_render import bench_render
from service.cli.bench_rigs import bench_rigs
from service.cli.bench_scale import bench_scale
from service.cli.bench_track import bench_track

bench_app = typer.Typer(no_args_is_help=True, help="Measure accuracy and speed.")
# In the order in which `--help` lists them.
bench_app.command("localize")(bench_localize)
bench_app.command("track")(bench_track)
bench_app.command("live")(bench_live)
bench_app.command("rigs")(bench_rigs)
bench_app.command("paper")(bench_paper)
bench_app.command("gate")(bench_gate)
bench_app.command("render")(bench_render)
bench_app.command("device")(bench_device)
bench_app.command("coverage")(bench_coverage)
bench_app.command("gpu")(bench_gpu)
bench_app.command("scale")(bench_scale)
bench_app.command("ablation")(bench_ablation)
bench_app.command("field")(bench_field)
bench_app.command("evaluate")(bench_evaluate)
bench_app.command("fleet")(bench_fleet)
bench_app.command("peer")(bench_peer)
