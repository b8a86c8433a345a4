"""Mosaics of real numbers, demosaiced by what computes in unsigned integers: by bands of rows, each in a thread."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import torch
from torch import Tensor

from kornia_tidy.checks import check_finite

ROWS_AT_ONCE = 16  # what is between two steps then stays in the processor's cache
LARGEST_BAND = 1 << 21  # pixels, 16 MB in LibRaw: malloc keeps that for the next band, the system gives it anew
FEWEST_ROWS = 64  # of a band: what it computes beyond its edges is then a third of it at most


def in_whole_numbers(
    mosaic: Tensor,
    compute: Callable[[np.ndarray], np.ndarray],
    bits: int,
    matrix: Tensor,
    reach: int | None = None,
) -> Tensor:
    """Return the colours that ``compute`` makes of mosaics, in unsigned integers that span their range, 0 and 1.

    Args:
        mosaic: (N, H, W), finite.
        compute: (rows, W) to (rows, W, colors), unsigned integers; called by several threads at once.
        bits: 8 or 16.
        matrix: (C, colors) with which colours are multiplied on their way back.
        reach: rows, an even number, beyond which nothing changes what a row becomes; bands of rows are then computed
            side by side, and the result is the same. None: only all at once.

    Returns:
        (N, C, H, W) like ``mosaic``.

    Raises:
        ValueError: if the mosaic is not finite.
    """
    tensor = mosaic.detach().to("cpu", torch.promote_types(mosaic.dtype, torch.float32))
    low, high = (float(end) for end in torch.aminmax(tensor))
    if not math.isfinite(high - low):
        check_finite("mosaic", mosaic)  # says which value
    low, high = min(0.0, low), max(1.0, high)
    step = (high - low) / (2**bits - 1)
    height, width = tensor.shape[-2:]
    # PyTorch's memory: NumPy asks for large pages, which where memory is in pieces cost up to seven times as much.
    image = torch.empty(len(tensor), len(matrix), height, width, dtype=tensor.dtype)
    factors = matrix.detach().double().cpu().numpy()
    back = np.hstack([step * factors, low * factors.sum(1, keepdims=True)])  # from whole numbers, and 1
    edges = [0, height] if reach is None else band_edges(height, width, torch.get_num_threads())

    def work(place: tuple[int, tuple[int, int]]) -> None:
        index, (top, bottom) = place
        first, last = max(top - (reach or 0), 0), min(bottom + (reach or 0), height)
        counts = _counts(tensor[index, first:last].numpy(), low, step, bits)
        _restore(compute(counts)[top - first : bottom - first], back, image[index, :, top:bottom].numpy())

    with ThreadPoolExecutor(torch.get_num_threads()) as threads:
        for _ in threads.map(work, itertools.product(range(len(tensor)), itertools.pairwise(edges))):
            pass  # what failed raises here
    return image.to(mosaic)


def band_edges(height: int, width: int, threads: int) -> list[int]:
    """Return where bands of rows begin and where the last ends: not too large, and as many as threads or a multiple.

    Rows that are restored together stay together, so that the last bit of a value does not depend on the bands.

    Example:
        >>> band_edges(2176, 4128, threads=2), band_edges(120, 4128, threads=2)
        ([0, 352, 720, 1088, 1440, 1808, 2176], [0, 120])
    """
    bands = -(-height * width // LARGEST_BAND)
    bands = max(1, min(-(-bands // threads) * threads, height // FEWEST_ROWS))
    return [ROWS_AT_ONCE * (height * band // (ROWS_AT_ONCE * bands)) for band in range(bands)] + [height]


def _counts(values: np.ndarray, low: float, step: float, bits: int) -> np.ndarray:
    counts = np.empty(values.shape, np.uint8 if bits == 8 else np.uint16)
    for top in range(0, len(values), ROWS_AT_ONCE):
        rows = slice(top, top + ROWS_AT_ONCE)
        scaled = values[rows] - low
        scaled /= step
        counts[rows] = np.rint(scaled, out=scaled)
    return counts


def _restore(counts: np.ndarray, back: np.ndarray, image: np.ndarray) -> None:
    """Write (C, rows, W) of whole numbers (rows, W, colors)."""
    for top in range(0, len(counts), ROWS_AT_ONCE):
        rows = slice(top, top + ROWS_AT_ONCE)
        cv2.split(cv2.transform(counts[rows].astype(image.dtype), back), list(image[:, rows]))
