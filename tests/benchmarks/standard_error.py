"""Means over scenes or seeds with their standard errors, which take the values as independent."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence


def standard_error(values: Sequence[float]) -> float:
    """Return the standard error of the mean of values; NaN for fewer than two.

    Example:
        >>> standard_error([1.0, 3.0]), standard_error([1.0])
        (1.0, nan)
    """
    return statistics.stdev(values) / math.sqrt(len(values)) if len(values) > 1 else math.nan


def mean_and_error(values: Sequence[float], sign: str = "") -> str:
    """Return the mean of values and its standard error in words.

    Args:
        values: two or more.
        sign: ``"+"`` writes that of a positive mean, too, as of differences.

    Example:
        >>> mean_and_error([0.1, 0.3], "+")
        '+0.200 ± 0.100'
    """
    return f"{statistics.fmean(values):{sign}.3f} ± {standard_error(values):.3f}"
