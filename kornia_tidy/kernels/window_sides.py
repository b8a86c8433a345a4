"""Sides of the windows that are transformed in C: whole vectors, and products of small primes."""

from __future__ import annotations

import torch

WIDEST_VECTOR_BYTES = 64  # narrower ones, see vectors.h, divide it: windows are the same on every processor


def size_step(dtype: torch.dtype) -> int:
    """Return the number of samples that divides the side of every window.

    Example:
        >>> size_step(torch.float32), size_step(torch.float64)
        (32, 16)
    """
    return 2 * WIDEST_VECTOR_BYTES // dtype.itemsize


def is_window_size(size: int, dtype: torch.dtype) -> bool:
    """Return whether windows may have a side: a multiple of :func:`size_step` without prime factors but 2, 3 and 5.

    Example:
        >>> [n for n in range(1, 200) if is_window_size(n, torch.float32)]
        [32, 64, 96, 128, 160, 192]
    """
    return size >= 1 and size % size_step(dtype) == 0 and next_fast_size(size) == size


def needed_side(size: int, pixels: int, psf_side: int, step: int) -> int:
    """Return the least side of windows that cut an axis into as many tiles as windows of a size do.

    Args:
        size: side of a window, in samples.
        pixels: along the axis.
        psf_side: P, of the PSFs.
        step: divisor of the side, as for :func:`is_window_size`.

    Returns:
        Samples, ``size`` at most.

    Example:
        >>> needed_side(1280, 1110, 513, 16), needed_side(1280, 1282, 513, 32)
        (1152, 1280)
    """
    tiles = -(-pixels // (size - psf_side + 1))
    least = -(-pixels // tiles) + psf_side - 1
    return next(side for side in range(-(-least // step) * step, size + 1, step) if next_fast_size(side) == side)


def next_fast_size(size: int) -> int:
    """Return the smallest number of samples, at least ``size``, that has no prime factor above 5.

    Example:
        >>> next_fast_size(1046)
        1080
    """
    while True:
        rest = size
        for prime in (2, 3, 5):
            while rest % prime == 0:
                rest //= prime
        if rest == 1:
            return size
        size += 1
