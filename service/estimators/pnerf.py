"""pNeRF, "Parallel Inversion" (Lin et al., ICRA 2023), as the supplement's section B runs it, on Gaussians.

Many hypotheses descend the L2 loss side by side; from time to time the best are kept and the others drawn anew
around them. SO(3) x T(3): each turns in place and shifts.

From the supplement: 2560 steps, resampling every 512, rates 5e-3 (turn) and 3e-3 (shift), both times 0.33 per 256
steps, L2. From the published method's code: 64 hypotheses within +-15 degrees and +-0.3 units of the prior; the best
fraction max(4 / n, 0.25 / 2^round) is kept, children lie within +-3 degrees and +-0.1 units of their parent; the
answer is the hypothesis of the least loss.

Deviation: the scene is one of Gaussians, not an Instant-NGP. Renders of 100 px in the long side by default, for a CPU.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from jaxtyping import Float64

from service.estimators.inerf import required_prior
from service.interfaces import Tools
from service.pose.descent.adam import Adam
from service.pose.descent.gradient_descent import So3T3, losses_and_gradients, require_within
from service.pose.descent.losses import loss_against, require_loss
from service.pose.features.image_sizes import sized
from service.pose.features.query_images import QueryImages
from service.pose.features.scene_focus import Focus, focus_of_scene
from service.results import Candidates, IterationRecord
from service.types import Pose, Query


@dataclass(frozen=True, slots=True)
class PnerfConfig:
    """The rates' schedule is from the supplement, the sampling from the published method's code."""

    decay: float = 0.33
    """Factor of both rates in `decay_steps` steps."""
    decay_steps: int = 256
    start_deg: float = 15.0
    """Range of the first hypotheses around the prior, per axis..."""
    start_units: float = 0.3
    """...and of their translations, in normalized units."""
    child_deg: float = 3.0
    """Likewise of resampled hypotheses around their parents."""
    child_units: float = 0.1
    kept_share: float = 0.25
    """Of the hypotheses; the k-th resampling (from 1) keeps this share divided by 2^k."""
    min_parents: int = 4
    recorded_every: int = 16
    """Steps; of the others no hypotheses are recorded: a trace holds thousands of steps."""


PNERF = PnerfConfig()


NEEDS_PRIOR = True


@dataclass(frozen=True, slots=True)
class Options:
    hypotheses: int = 64
    steps: int = 2560
    resample_every: int = 512
    """Steps."""
    turn_rate: float = 5e-3
    """rad."""
    shift_rate: float = 3e-3
    """Normalized units: the scene's focus at a distance of 4."""
    loss: str = "l2"
    """l1, l2, relative, feature, corner or blur."""
    long_side_px: int = 100
    """Long side of the renders, in pixels."""

    __pydantic_config__: ClassVar = {"extra": "forbid", "use_attribute_docstrings": True}

    def __post_init__(self) -> None:
        limits = {"hypotheses": (1, 1024), "steps": (1, 100_000), "resample_every": (1, 100_000)}
        require_within(self, limits | {"turn_rate": (0, 1), "shift_rate": (0, 1), "long_side_px": (32, 4096)})
        require_loss(self.loss)


def prepare(tools: Tools[None], cache_dir: Path | None) -> Focus:
    """Return the scene's focus, which defines the normalized units."""
    return focus_of_scene(tools.scene, tools.rasterizer)


class _Hypothesis:
    """A pose under optimization, with numbers and Adam of its own; its anchor is where it was drawn."""

    def __init__(self, anchor: Pose, focus: Focus) -> None:
        self._of = So3T3(anchor, focus)
        self._numbers = np.zeros(6)
        self._adam = Adam(6, 1.0)
        self.loss = np.inf

    @property
    def pose(self) -> Pose:
        return self._of.pose(self._numbers)

    def update(self, loss: float, by_twist: Float64[np.ndarray, "6"], rates: Float64[np.ndarray, "6"]) -> None:
        self.loss = loss
        self._numbers = self._numbers - rates * self._adam.step(self._of.gradient(self._numbers, by_twist))


def run(
    query: Query, tools: Tools[Focus], options: Options, config: PnerfConfig = PNERF
) -> Generator[IterationRecord, None, None]:
    """Descend from poses around the prior. A record's pose is that of the least loss in its step.

    Raises InvalidPrior without a prior.
    """
    start, focus = required_prior(query, "pnerf"), tools.prepared
    intrinsics = sized(query.intrinsics, options.long_side_px)
    images = QueryImages(query, tools.matcher)
    loss = loss_against(options.loss, images.resized(intrinsics), images.valid_mask(intrinsics))
    yield IterationRecord("start", start)
    # The prior itself is one of the hypotheses.
    hypotheses = [_Hypothesis(start, focus)]
    hypotheses += [_drawn(start, config.start_deg, config.start_units, tools) for _ in range(options.hypotheses - 1)]
    for step in range(options.steps):
        if step and step % options.resample_every == 0:
            hypotheses = _resampled(hypotheses, step // options.resample_every, tools, config)
        decay = config.decay ** (step / config.decay_steps)
        # Per number: three of the rotation, three of the translation.
        rates = decay * np.repeat([options.turn_rate, options.shift_rate], 3)
        best, least = start, np.inf
        poses = [hypothesis.pose for hypothesis in hypotheses]
        found = losses_and_gradients(tools.rasterizer, intrinsics, poses, loss)
        for hypothesis, pose, (value, by_twist) in zip(hypotheses, poses, found, strict=True):
            hypothesis.update(value, by_twist, rates)
            if hypothesis.loss < least:
                best, least = pose, hypothesis.loss
        # All hypotheses of every step would fill the trace.
        shown = _candidates(hypotheses) if step % config.recorded_every == 0 else None
        yield IterationRecord("descend", best, loss=least, candidates=shown)


def _resampled(
    hypotheses: list[_Hypothesis], round_number: int, tools: Tools[Focus], config: PnerfConfig
) -> list[_Hypothesis]:
    """Keep the best, and replace the others by hypotheses drawn around them in turn; rounds count from 1."""
    # Stable sort: with equal losses the result doesn't depend on chance.
    ranked = sorted(hypotheses, key=lambda hypothesis: hypothesis.loss)
    keep = min(len(hypotheses), max(config.min_parents, round(len(hypotheses) * config.kept_share / 2**round_number)))
    parents = ranked[:keep]
    children = [
        # In turn, so that each kept hypothesis has as many others around it.
        _drawn(parents[i % keep].pose, config.child_deg, config.child_units, tools)
        for i in range(len(hypotheses) - keep)
    ]
    return parents + children


def _drawn(pose: Pose, degrees: float, units: float, tools: Tools[Focus]) -> _Hypothesis:
    """Draw a hypothesis, uniformly: rotation vector within +-degrees an axis, translation within +-units."""
    focus = tools.prepared
    turn = np.radians(degrees) * tools.rng.uniform(-1, 1, 3)
    numbers = np.concatenate([turn, units * tools.rng.uniform(-1, 1, 3)])
    return _Hypothesis(So3T3(pose, focus).pose(numbers), focus)


def _candidates(hypotheses: list[_Hypothesis]) -> Candidates:
    poses = np.stack([hypothesis.pose.world_from_camera for hypothesis in hypotheses])
    return Candidates(poses, -np.array([hypothesis.loss for hypothesis in hypotheses]))
