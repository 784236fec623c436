"""The table of `splatfix bench field`: a line for each row, for rows that are alike together, and for each group."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

MIN_SHARED = 40
"""Queries from which on a share is printed; of fewer the counts."""
HEADER = (
    "row", "photos", "right & localized", "right, but refused", "wrong, but localized", "lost", "not answerable",
    "of the answerable", "CPU ms", "error", "focal, k1 error", "in 68, 95 %", "right, refused by", "others, refused by",
)  # fmt: skip
REFUSALS = ("refused_by", "not_found_by")
Line = Mapping[str, Any]


def outcome_of(line: Line) -> str:
    """Return which column counts a query: localized, refused, wrong, lost or unanswerable.

    Unanswerable: nothing was found, and refinement that starts at the truth doesn't stay there.
    """
    if line["localized"]:
        return "localized" if line["right"] else "wrong"
    if line["right"]:
        return "refused"
    return "lost" if line["home"]["stays"] else "unanswerable"


def refused_by(line: Line) -> str:
    """Return what refused an answer: the reason; of a right one also the signals below their floors."""
    signals = "+".join(line["below_floor"]) if line["right"] else ""
    return f"{line['reason']} ({signals})" if signals else line["reason"]


def chi_square_6(nees: float) -> float:
    """Return the probability that a chi-square of 6 degrees of freedom is less: which ellipsoid passes the truth."""
    half = nees / 2
    return float(1 - np.exp(-half) * (1 + half + half**2 / 2))


def summary(lines: Sequence[Line]) -> dict[str, Any]:
    """Return counts by outcome and medians; accuracy, lens and covariance are those of right & localized answers.

    `error_deg`, `error_units`: medians; `focal_error`, `k1_error`: medians of the absolute; `cpu_ms`: of all queries;
    `in_68`, `in_95`: shares of answers with a covariance whose ellipsoid of that probability holds the true pose.
    """
    counts = Counter(outcome_of(line) for line in lines)
    right = [line for line in lines if outcome_of(line) == "localized"]
    inside = [chi_square_6(line["nees"]) for line in right if line["nees"] is not None]
    names = ("localized", "refused", "wrong", "lost", "unanswerable")
    return {
        "queries": len(lines),
        **{name: counts[name] for name in names},
        "answerable": len(lines) - counts["unanswerable"],
        "cpu_ms": _median(line["cpu_ms"] for line in lines),
        "error_deg": _median(line["rotation_deg"] for line in right),
        "error_units": _median(line["translation_units"] for line in right),
        "focal_error": _median(abs(line["focal_error"]) for line in right),
        "k1_error": _median(abs(line["k1_error"]) for line in right if line["k1_error"] is not None),
        "with_covariance": len(inside),
        "in_68": float(np.mean([p <= 0.68 for p in inside])) if inside else None,
        "in_95": float(np.mean([p <= 0.95 for p in inside])) if inside else None,
        "refused_by": _reasons(line for line in lines if outcome_of(line) == "refused"),
        "not_found_by": _reasons(line for line in lines if outcome_of(line) in ("lost", "unanswerable")),
    }


def _reasons(lines: Iterable[Line]) -> dict[str, int]:
    return dict(Counter(map(refused_by, lines)).most_common())


def _median(values: Iterable[float]) -> float | None:
    found = list(values)
    return float(np.median(found)) if found else None


def table(lines: Sequence[Line], by_scene: bool = False) -> str:
    """Return the lines as a Markdown table, in the order in which rows first occur."""
    found = ["| " + " | ".join(HEADER) + " |", "|" + " --- |" * len(HEADER)]
    if by_scene:
        found += [_cells(name, some) for name, some in _by(lines, lambda line: f"{line['scene']}: {line['row']}")]
        return "\n".join(found)
    for group, of_group in _by(lines, lambda line: line["group"]):
        for pool, of_pool in _by(of_group, lambda line: line["pool"]):
            rows = _by(of_pool, lambda line: line["row"])
            found += [_cells(name, some) for name, some in rows]
            if len(rows) > 1:
                found.append(_cells(f"**{pool}**", of_pool))
        found.append(_cells(f"**all of {group}**", of_group))
    return "\n".join(found)


def _by(lines: Sequence[Line], key: Callable[[Line], str]) -> list[tuple[str, list[Line]]]:
    groups: dict[str, list[Line]] = {}
    for line in lines:
        groups.setdefault(key(line), []).append(line)
    return list(groups.items())


def _cells(name: str, lines: Sequence[Line]) -> str:
    """Return one line of the table."""
    found = summary(lines)
    many = found["with_covariance"] >= MIN_SHARED
    ellipsoids = f"{100 * found['in_68']:.0f}, {100 * found['in_95']:.0f}" if many else "–"
    share = f"{found['localized']} of {found['answerable']}"
    if found["answerable"] >= MIN_SHARED:
        share = f"{100 * found['localized'] / found['answerable']:.1f} %"
    focal_percent = None if found["focal_error"] is None else 100 * found["focal_error"]
    cells = [
        name,
        *(str(found[key]) for key in ("queries", "localized", "refused", "wrong", "lost", "unanswerable")),
        share,
        f"{found['cpu_ms']:.0f}",
        _joined(found["error_deg"], "{:.3f}°", found["error_units"], "{:.4f}"),
        _joined(focal_percent, "{:.2f} %", found["k1_error"], "{:.4f}"),
        ellipsoids,
        *(", ".join(f"{reason} {count}" for reason, count in found[key].items()) for key in REFUSALS),
    ]
    return "| " + " | ".join(cells) + " |"


def _joined(first: float | None, first_format: str, second: float | None, second_format: str) -> str:
    parts = [
        form.format(value) for value, form in ((first, first_format), (second, second_format)) if value is not None
    ]
    return ", ".join(parts) or "–"
