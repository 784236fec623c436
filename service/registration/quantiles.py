"""Quantiles of the F distribution and of chi-square, by the incomplete beta function's continued fraction."""

from __future__ import annotations

import math
from functools import lru_cache

_MANY = 1e7
"""Degrees of freedom at which F is chi-square over its degrees of freedom, to six digits."""


def chi_square_quantile(probability: float, freedom: float) -> float:
    """Return the value that chi-square with these degrees of freedom stays below with the given probability."""
    return freedom * f_quantile(probability, freedom, _MANY)


@lru_cache(maxsize=1000)
def f_quantile(probability: float, numerator: float, denominator: float) -> float:
    """Return the value that F with these degrees of freedom stays below with the given probability (by bisection)."""
    low, high = 0.0, 1.0
    while _f_cdf(high, numerator, denominator) < probability:
        low, high = high, 2 * high
    # So many halvings of an interval exhaust a float's digits.
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if _f_cdf(middle, numerator, denominator) < probability else (low, middle)
    return (low + high) / 2


def _f_cdf(value: float, numerator: float, denominator: float) -> float:
    x = numerator * value / (numerator * value + denominator)
    return _incomplete_beta(x, numerator / 2, denominator / 2)


def _incomplete_beta(x: float, a: float, b: float) -> float:
    """Return the regularized incomplete beta function (DLMF 8.17.22, evaluated by Lentz's method)."""
    if x <= 0 or x >= 1:
        return float(x >= 1)
    if x > (a + 1) / (a + b + 2):  # where the fraction of the complement converges faster
        return 1 - _incomplete_beta(1 - x, b, a)
    log_front = math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b) + a * math.log(x) + b * math.log1p(-x)
    c, d, fraction = 1.0, 0.0, 1.0
    for step in range(1, 10_000):
        m = step // 2
        if step % 2:
            term = -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1))
        else:
            term = m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m))
        d, c = 1 / (1 + term * d), 1 + term / c
        fraction *= c * d
        if abs(1 - c * d) < 1e-13:
            break
    return math.exp(log_front) / (a * fraction)
