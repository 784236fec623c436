"""For pytest, where tests go through a gateway: how many tests did, counted by what the gateway has logged.

A test counts during which, with its fixtures, a gateway answered a request.
"""

from __future__ import annotations

from collections import Counter

import pytest
import two_fronts

_passed: set[str] = set()
_asked: set[str] = set()


two_fronts.send_keys()


def _logged() -> int:
    log = two_fronts.access_log()
    return log.stat().st_size if log.exists() else 0


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item):
    before = _logged()
    result = yield
    if _logged() > before:
        _asked.add(item.nodeid)
    return result


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    if report.when == "call" and report.passed:
        _passed.add(report.nodeid)


def pytest_terminal_summary(terminalreporter) -> None:
    fronts: Counter[str] = Counter()
    if _logged():
        fronts.update(line.partition(" ")[0] for line in two_fronts.access_log().read_text("utf-8").splitlines())
    terminalreporter.section("through the gateway")
    requests = f"{fronts.total()} requests at {len(fronts)} fronts"
    terminalreporter.write_line(f"{len(_passed & _asked)} tests passed through the gateway; {requests}")


def pytest_unconfigure() -> None:
    two_fronts.close()
