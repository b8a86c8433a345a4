"""Ranges of values that augmentations draw from, and the probability with which they change an image."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from kornia.augmentation.random_generator import PlainUniformGenerator

from kornia_tidy.checks import check_number

Range = Sequence[float] | None
"""Lowest and highest value, or None to leave a setting as it is."""


def checked_range(name: str, ends: object, unit: str = "", zero: bool = False) -> tuple[float, float]:
    """Return the lowest and the highest value of a range, or raise.

    Args:
        name: of the range, for messages.
        ends: (low, high).
        unit: of the values.
        zero: whether the low end may be zero.

    Raises:
        TypeError: if the range is not two numbers.
        ValueError: if it is empty, negative or infinite.

    Example:
        >>> checked_range("noise_level", (0, 0.1), "of full scale", zero=True)
        (0.0, 0.1)
    """
    if isinstance(ends, str) or not isinstance(ends, Sequence) or len(ends) != 2:
        raise TypeError(f"{name} must be a range (low, high){' ' + unit if unit else ''}, got {ends!r}")
    low, high = (float(end) for end in ends)
    if not (0 <= low <= high < math.inf) or (low == 0 and not zero):
        raise ValueError(
            f"{name} must be a range (low, high) with 0 {'<=' if zero else '<'} low <= high"
            f"{', ' + unit if unit else ''}, got {(low, high)}"
        )
    return low, high


def uniform_draws(ranges: Mapping[str, tuple[float, float]]) -> PlainUniformGenerator:
    """Return kornia's generator of numbers that are drawn from ranges, each uniformly, by their names."""
    samplers = [(torch.tensor(ends, device="cpu"), name, None, None) for name, ends in ranges.items()]
    return PlainUniformGenerator(*samplers)


def check_probability(p: float) -> None:
    """Raise unless a number is a probability.

    Raises:
        TypeError: if it is not a number.
        ValueError: if it is not from 0 to 1.
    """
    check_number("p", p)
    if not 0 <= p <= 1:
        raise ValueError(f"p must be a probability from 0 to 1, got {p}")
