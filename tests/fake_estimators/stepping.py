"""An estimator for tests: counts steps, waits where it is told to, fails on demand."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from service.errors import EstimatorFault
from service.interfaces import Tools
from service.results import IterationRecord, MatchVectors
from service.types import Query

GO_ON = threading.Event()
"""A held job waits for it after its first record."""


@dataclass(frozen=True, slots=True)
class Options:
    steps: int = 3
    """Records to yield."""
    hold: bool = False
    pause_s: float = 0.0
    """After each record."""
    fail: str = ""
    """`fault` is an error of ours, anything else a bug's."""

    __pydantic_config__: ClassVar[dict] = {"extra": "forbid", "use_attribute_docstrings": True}


def run(query: Query, tools: Tools, options: Any) -> Iterator[IterationRecord]:
    camera = tools.scene.cameras[0].camera
    pose = query.prior or camera.pose
    points = np.array([[1.5, 2.5], [3.5, 4.5]], np.float32)
    matches = MatchVectors.sample(points, points + 1, np.array([True, False]), camera)
    for step in range(options.steps):
        yield IterationRecord("step", pose, loss=1.0 / (1 + step), num_matches=2, matches=matches)
        time.sleep(options.pause_s)
        if options.hold:
            assert GO_ON.wait(20)
        if options.fail == "fault":
            raise EstimatorFault("told to fail.")
        if options.fail:
            raise RuntimeError("secret detail of a bug")
