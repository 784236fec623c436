"""Cases of long tests: one of a kind in `make test`, all of them in `.ci/run`."""

from __future__ import annotations

from typing import Any

import pytest


def rest_in_ci(first: Any, *others: Any) -> list[Any]:
    """Return what `parametrize` takes: the first case, and the others marked as CI's; a tuple is a case's values."""
    return [first, *(pytest.param(*(o if isinstance(o, tuple) else (o,)), marks=pytest.mark.ci) for o in others)]
