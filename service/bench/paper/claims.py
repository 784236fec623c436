"""Checks claims about the methods, the supplement's and ours, against the results: which is ahead, by which counts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from service.bench.paper.tables import Line

STARTS_APART = ("easy", "hard")
REFINING = ("l1", "blur", "relative", "l2", "feature", "corner")


@dataclass(frozen=True, slots=True)
class Claim:
    """A claim of the paper, and whether the results support it."""

    statement: str
    """Source and content."""
    finding: str
    """Counts of the results."""
    holds: bool | None
    """None: the counts are equal, or there are none."""


def claims(lines: Sequence[Line]) -> list[Claim]:
    """Return the claims that there are results for."""
    return [claim for claim in (*_stages(lines), *_methods(lines), *_losses(lines), *_default(lines)) if claim]


def _within(lines: Sequence[Line], key: str = "within_5deg_0p05", **wanted: str) -> tuple[int, int]:
    chosen = [line for line in lines if all(line[k] == v for k, v in wanted.items())]
    return sum(bool(line[key]) for line in chosen), len(chosen)


def _ahead(statement: str, better: tuple[str, tuple[int, int]], worse: tuple[str, tuple[int, int]]) -> Claim | None:
    (name, (a, n)), (other, (b, m)) = better, worse
    # Without results of both there is nothing to compare.
    if not n or not m:
        return None
    # Shares, because the methods may have different numbers of queries.
    difference = a / n - b / m
    return Claim(statement, f"{name} {a}/{n}, {other} {b}/{m}", None if difference == 0 else difference > 0)


def _stages(lines: Sequence[Line]) -> Iterator[Claim | None]:
    of_table = [line for line in lines if line["study"] == "table5"]

    def ahead(statement: str, better: str, worse: str, key: str = "within_5deg_0p05") -> Claim | None:
        both = _common(of_table, f"mc_do:{better}", f"mc_do:{worse}")
        counts = [(name, _within(both, key, method=f"mc_do:{name}")) for name in (better, worse)]
        return _ahead(statement, *counts)

    yield ahead("Table 5: MC alone is ahead of DO alone", "mc", "do")
    yield ahead("Table 5: MC + DO is ahead of MC alone", "mc+do", "mc")
    yield ahead("Table 5: the loss adds to MC + DO, within 1 deg and 0.01", "mc+do+loss", "mc+do", "within_1deg_0p01")
    yield ahead("Section H: DO alone may be worse than going without it", "descent", "do")


def _methods(lines: Sequence[Line]) -> Iterator[Claim | None]:
    order = ("mc_do", "icomma", "inerf_dagger", "inerf")
    shared = [line for line in lines if line["study"] == "table2" and line["protocol"] == "hard"]
    for better, worse in pairwise(order):
        pair = [(name, _within(_common(shared, better, worse), method=name)) for name in (better, worse)]
        yield _ahead(f"Table 2: {better} is ahead of {worse}", *pair)
    pair = [(n, _within(_common(shared, "mc_do", "mc_do_gradient"), method=n)) for n in ("mc_do", "mc_do_gradient")]
    yield _ahead("Ours: DO by least squares is ahead of DO by gradient", *pair)
    starts = [(start, _within(lines, study="table2", method="inerf_dagger", protocol=start)) for start in STARTS_APART]
    yield _ahead("Section G: inerf_dagger does better from small errors than from large ones", *starts)


def _common(lines: Sequence[Line], *methods: str) -> list[Line]:
    """Return the lines of queries that all of the methods answered, so that counts compare the same queries."""
    answered = [
        {(line["scene"], line["photo"], line["trial"]) for line in lines if line["method"] == method}
        for method in methods
    ]
    both = set.intersection(*answered)
    return [line for line in lines if (line["scene"], line["photo"], line["trial"]) in both]


def _losses(lines: Sequence[Line]) -> Iterator[Claim | None]:
    near = [line for line in lines if line["study"] == "table1"]
    of_loss = {loss: [line for line in near if line["method"] == f"mc_do:{loss}"] for loss in REFINING}
    if not all(of_loss.values()):
        return
    shares = {loss: _within(each) for loss, each in of_loss.items()}
    ranked = sorted(shares, key=lambda loss: -shares[loss][0] / shares[loss][1])
    finding = ", ".join(f"{loss} {shares[loss][0]}/{shares[loss][1]}" for loss in ranked)
    best, ours = (shares[loss][0] / shares[loss][1] for loss in (ranked[0], "l1"))
    yield Claim("Table 1: L1 succeeds as often as any loss near the optimum", finding, ours >= best)
    # Where all losses succeed, only precision tells them apart.
    errors = {loss: float(np.median([line["translation_units"] for line in each])) for loss, each in of_loss.items()}
    ranked = sorted(errors, key=lambda loss: errors[loss])
    finding = ", ".join(f"{loss} {errors[loss]:.2g}" for loss in ranked) + " units"
    yield Claim("Ours: L1 ends nearest of all losses, by the median error", finding, ranked[0] == "l1")


def _default(lines: Sequence[Line]) -> Iterator[Claim | None]:
    """Compare the default with the paper's method, on the queries that both answered."""
    for protocol in ("hard", "easy", "none"):
        chosen = [line for line in lines if line["study"] == "table2" and line["protocol"] == protocol]
        for scene in dict.fromkeys(line["scene"] for line in chosen):
            both = _common([line for line in chosen if line["scene"] == scene], "view_index", "mc_do")
            ours, paper = (_within(both, method=name) for name in ("view_index", "mc_do"))
            if ours[1]:
                times = [_median_s(both, name) for name in ("view_index", "mc_do")]
                finding = (
                    f"{ours[0]}/{ours[1]} in {times[0]:.2f} s of CPU time, {paper[0]}/{paper[1]} in {times[1]:.2f} s"
                )
                # Both at once: speed alone, or success alone, would be a trade.
                holds = ours[0] >= paper[0] and times[0] < times[1]
                statement = f"Ours: view_index is never worse than mc_do, and faster: {scene}, start '{protocol}'"
                yield Claim(statement, finding, holds)


def _median_s(lines: Sequence[Line], method: str) -> float:
    return float(np.median([line["cpu_ms"] for line in lines if line["method"] == method])) / 1e3
