"""Adam (Kingma and Ba, 2015) on a few numbers."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-8


class Adam:
    """Gives steps to be subtracted; the rate may be changed between them."""

    def __init__(self, size: int, rate: float) -> None:
        self.rate = rate
        self._mean, self._square, self._count = np.zeros(size), np.zeros(size), 0

    def step(self, gradient: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n"]:
        self._count += 1
        self._mean += (1 - BETA_1) * (gradient - self._mean)
        self._square += (1 - BETA_2) * (gradient**2 - self._square)
        mean = self._mean / (1 - BETA_1**self._count)
        square = self._square / (1 - BETA_2**self._count)
        return self.rate * mean / (np.sqrt(square) + EPSILON)
