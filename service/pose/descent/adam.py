"""Adam (Kingma and Ba, ICLR 2015) on a vector of a few numbers."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64


class Adam:
    """One run of the optimizer. `rate` may be changed between steps; the other defaults are the paper's."""

    def __init__(
        self, size: int, rate: float, beta_1: float = 0.9, beta_2: float = 0.999, epsilon: float = 1e-8
    ) -> None:
        self.rate = rate
        self._beta_1, self._beta_2, self._epsilon = beta_1, beta_2, epsilon
        self._mean, self._square, self._count = np.zeros(size), np.zeros(size), 0

    def step(self, gradient: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n"]:
        """Return the step to be subtracted from the numbers, given the loss' gradient at them."""
        self._count += 1
        self._mean += (1 - self._beta_1) * (gradient - self._mean)
        self._square += (1 - self._beta_2) * (gradient**2 - self._square)
        # Both moments start at zero: divided by what they would be for a constant gradient of one.
        mean = self._mean / (1 - self._beta_1**self._count)
        square = self._square / (1 - self._beta_2**self._count)
        return self.rate * mean / (np.sqrt(square) + self._epsilon)
