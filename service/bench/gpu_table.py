"""The Markdown of docs/results from the result file of `splatfix bench gpu`, also of a run that was cut short."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

Rows = Sequence[dict[str, Any]]
_UNKNOWN = "?"


def markdown(outcome: dict[str, Any]) -> str:
    """Return the tables: the parts with their states, then figures of each part that has rows."""
    parts = {each["part"]: each for each in outcome["parts"]}
    lines = [_heading(outcome, parts["machine"]["rows"]), ""]
    lines += _table(("part", "state", "s", ""), [_part_row(each) for each in outcome["parts"]])
    for name, table in _TABLES.items():
        rows = parts.get(name, {}).get("rows", [])
        if rows:
            lines += ["", *table(rows)]
    return "\n".join(lines)


def _heading(outcome: dict[str, Any], rows: Rows) -> str:
    facts = {key: value for row in rows for key, value in row.items()}
    device, versions = facts.get("device", {}), facts.get("versions", {})
    named = ", ".join(f"{name} {version}" for name, version in versions.items() if version != "unknown")
    small = " **Small: a run of the script, not a measurement.**" if outcome["small"] else ""
    extras = [f"compute capability {device['compute_capability']}"] if "compute_capability" in device else []
    extras += [f"{_mb(device['memory_bytes'])} MB", f"CUDA {device['cuda']}"] if "memory_bytes" in device else []
    where = ", ".join([str(device.get("name", _UNKNOWN)), *extras])
    scene = f"{outcome['scene']}, {facts.get('gaussians', _UNKNOWN)} Gaussians"
    scene += f" of SH degree {facts.get('sh_degree', _UNKNOWN)}"
    return (
        f"`{outcome['renderer']}` on {where}; CPU: {outcome.get('processor', _UNKNOWN)}. "
        f"{outcome.get('started', _UNKNOWN)}; scene {scene}; {named}.{small}"
    )


def _part_row(part: dict[str, Any]) -> tuple[str, ...]:
    return part["part"], part["state"], f"{part['seconds']:.1f}", part.get("error", "").replace("|", "/")


def _pictures(rows: Rows) -> list[str]:
    """The worst of all images, by size."""
    names = list(rows[0]["differences"])
    found = []
    for width in dict.fromkeys(row["width"] for row in rows):
        these = [row for row in rows if row["width"] == width]
        worst = (_pair(_worst(row["differences"][name] for row in these)) for name in names)
        found.append((f"{width} px", _share(these), *worst))
    titles = "images", "within bounds", *(f"{name}: mean, 99.9 %" for name in names)
    return _table(titles, found)


def _gradients(rows: Rows) -> list[str]:
    names = list(rows[0]["differences"])
    worst = (_number(_largest(row["differences"][name] for row in rows)) for name in names)
    return _table(("gradients", "within bounds", *names), [("relative difference", _share(rows), *worst)])


def _poses(rows: Rows) -> list[str]:
    same = sum(row["status"] == row["cpu_status"] for row in rows)
    both = [row for row in rows if row["status"] == row["cpu_status"] == "localized"]
    found = [
        ("photos; same status; within bounds", f"{len(rows)}; {same}; {_share(rows)}"),
        ("localized; by the CPU", "; ".join(str(_localized(rows, key)) for key in ("status", "cpu_status"))),
        ("largest difference of poses localized by both, deg", _number(_largest(r["rotation_deg"] for r in both))),
        ("the same, units", _number(_largest(r["translation_units"] for r in both))),
    ]
    found += [(f"differs: {row['photo']}", f"{row['status']}, CPU {row['cpu_status']}; {_number(row['rotation_deg'])} "
               f"deg, {_number(row['translation_units'])} units") for row in rows if not row["within"]]  # fmt: skip
    return _table(("poses", ""), found)


def _latency(rows: Rows) -> list[str]:
    stages = list(dict.fromkeys(stage for row in rows for stage in row["stages_ms_p50"]))
    found = [("a photo, median", *(_number(row["ms_p50"]) for row in rows))]
    found += [("a photo, 95 %", *(_number(row["ms_p95"]) for row in rows))]
    for stage in stages:
        cells = (f"{_number(row['stages_ms_p50'].get(stage))} ({row['stages_count'].get(stage, 0)})" for row in rows)
        found.append((f"{stage} (localizations)", *cells))
    return _table(("ms", *(row["renderer"] for row in rows)), found)


def _throughput(rows: Rows) -> list[str]:
    renderers = list(dict.fromkeys(row["renderer"] for row in rows))
    rates = {(row["renderer"], row["at_a_time"]): row["jobs_per_s"] for row in rows}
    counts = list(dict.fromkeys(row["at_a_time"] for row in rows))
    found = [(f"{n} at a time", *(_number(rates.get((name, n))) for name in renderers)) for n in counts]
    return _table(("jobs/s", *renderers), found)


def _index(rows: Rows) -> list[str]:
    names = "views", "seconds", "views_per_s", "renders_per_s"
    return _table(
        ("index", *map(_title, names)), [(row["renderer"], *(_number(row[name]) for name in names)) for row in rows]
    )


def _sizes(rows: Rows) -> list[str]:
    """Keys are those of the first size: a size that failed has an error in their place."""
    names = [name for name in rows[0] if name not in ("gaussians", "error")]
    titles = [_title(name) for name in names]
    found = []
    for row in rows:
        cells = (_mb(row[name]) if "bytes" in name else _number(row[name]) for name in names if name in row)
        found.append((f"{row['gaussians']:,}", *((row["error"].replace("|", "/"),) if "error" in row else cells)))
    return _table(("Gaussians", *titles), found)


def _out_of_memory(rows: Rows) -> list[str]:
    return _table(("out of memory", ""), [(row["case"], row["happens"].replace("|", "/")) for row in rows])


def _many_jobs(rows: Rows) -> list[str]:
    names = [name for name in rows[0] if "bytes" in name]
    found = [(str(row["jobs"]), *(_mb(row[name]) for name in names)) for row in rows]
    return _table(("jobs", *map(_title, names)), found)


_TABLES: dict[str, Callable[[Rows], list[str]]] = {
    "pictures": _pictures,
    "gradients": _gradients,
    "poses": _poses,
    "latency": _latency,
    "throughput": _throughput,
    "index": _index,
    "sizes": _sizes,
    "out of memory": _out_of_memory,
    "many jobs": _many_jobs,
}


def _table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    full = ([*row, *[""] * (len(titles) - len(row))] for row in rows)
    return [f"| {' | '.join(row)} |" for row in (titles, ["---"] * len(titles), *full)]


def _title(name: str) -> str:
    return name.replace("bytes", "MB").replace("_per_s", "/s").replace("_", " ")


def _share(rows: Rows) -> str:
    return f"{sum(row['within'] for row in rows)} of {len(rows)}"


def _localized(rows: Rows, key: str) -> int:
    return sum(row[key] == "localized" for row in rows)


def _worst(pairs: Iterable[Sequence[float | None]]) -> list[float | None]:
    return [_largest(column) for column in zip(*pairs, strict=True)]


def _largest(values: Iterable[float | None]) -> float | None:
    """Return the largest; None if one of them isn't finite, or there is none."""
    found = list(values)
    return None if None in found else max((value for value in found if value is not None), default=None)


def _pair(values: Iterable[float | None]) -> str:
    return ", ".join(map(_number, values))


def _number(value: float | None) -> str:
    return _UNKNOWN if value is None else str(value) if isinstance(value, int) else f"{value:.3g}"


def _mb(count: int) -> str:
    return f"{count / 1e6:,.0f}"
