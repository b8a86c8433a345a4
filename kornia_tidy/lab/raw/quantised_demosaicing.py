"""Quantised demosaicing: mosaics as integers of 16 bits for LibRaw, in bands of rows on several threads."""

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

HIGHEST = 65535
ROWS_AT_ONCE = 16  # few enough for intermediate results to stay in the processor's cache
LARGEST_BAND = 1 << 21  # pixels, 16 MB in LibRaw: malloc reuses such blocks and returns larger ones to the system
FEWEST_ROWS = 64  # of a band: limits the rows computed twice to a third of a band


def demosaic_quantised(
    mosaic: Tensor,
    compute: Callable[[np.ndarray], np.ndarray],
    matrix: Tensor,
    reach: int | None = None,
) -> Tensor:
    """Demosaic real-valued mosaics with an integer algorithm, and multiply the colours by a matrix.

    The integers span the range of the mosaics, extended to include 0 and 1.

    Args:
        mosaic: (N, H, W), finite.
        compute: the algorithm, (rows, W) to (rows, W, colors), unsigned integers of 16 bits. Several threads call it
            at once.
        matrix: (C, colors), applied to the colours during their conversion back to real values.
        reach: number of rows, even, that influence a row on either side. Bands of rows are then computed in parallel
            with the same result. None: the algorithm has no bounded reach, and the whole mosaic is one band.

    Returns:
        (N, C, H, W) like ``mosaic``.

    Raises:
        ValueError: if the mosaic is not finite.
    """
    tensor = mosaic.detach().to("cpu", torch.promote_types(mosaic.dtype, torch.float32))
    low, high = (float(end) for end in torch.aminmax(tensor))
    if not math.isfinite(high - low):
        check_finite("mosaic", mosaic)  # names the value
    low, high = min(0.0, low), max(1.0, high)
    step = (high - low) / HIGHEST
    height, width = tensor.shape[-2:]
    # Allocated by PyTorch: NumPy requests huge pages, which cost up to seven times as much in fragmented memory.
    image = torch.empty(len(tensor), len(matrix), height, width, dtype=tensor.dtype)
    factors = matrix.detach().double().cpu().numpy()
    back = np.hstack([step * factors, low * factors.sum(1, keepdims=True)])  # acts on the integers and a constant 1
    edges = [0, height] if reach is None else band_edges(height, width, torch.get_num_threads())

    def work(place: tuple[int, tuple[int, int]]) -> None:
        index, (top, bottom) = place
        first, last = max(top - (reach or 0), 0), min(bottom + (reach or 0), height)
        counts = _counts(tensor[index, first:last].numpy(), low, step)
        _restore(compute(counts)[top - first : bottom - first], back, image[index, :, top:bottom].numpy())

    with ThreadPoolExecutor(torch.get_num_threads()) as threads:
        for _ in threads.map(work, itertools.product(range(len(tensor)), itertools.pairwise(edges))):
            pass  # an exception of a thread is raised here
    return image.to(mosaic)


def band_edges(height: int, width: int, threads: int) -> list[int]:
    """Return the edges of bands of rows of bounded size, with a multiple of the number of threads as their number.

    Edges are multiples of ``ROWS_AT_ONCE``, so that the last bit of a value does not depend on the bands.

    Example:
        >>> band_edges(2176, 4128, threads=2), band_edges(120, 4128, threads=2)
        ([0, 352, 720, 1088, 1440, 1808, 2176], [0, 120])
    """
    bands = -(-height * width // LARGEST_BAND)
    bands = max(1, min(-(-bands // threads) * threads, height // FEWEST_ROWS))
    return [ROWS_AT_ONCE * (height * band // (ROWS_AT_ONCE * bands)) for band in range(bands)] + [height]


def _counts(values: np.ndarray, low: float, step: float) -> np.ndarray:
    counts = np.empty(values.shape, np.uint16)
    for top in range(0, len(values), ROWS_AT_ONCE):
        rows = slice(top, top + ROWS_AT_ONCE)
        scaled = values[rows] - low
        scaled /= step
        counts[rows] = np.rint(scaled, out=scaled)
    return counts


def _restore(counts: np.ndarray, back: np.ndarray, image: np.ndarray) -> None:
    """Convert integers (rows, W, colors) to real values, and write them to (C, rows, W)."""
    for top in range(0, len(counts), ROWS_AT_ONCE):
        rows = slice(top, top + ROWS_AT_ONCE)
        cv2.split(cv2.transform(counts[rows].astype(image.dtype), back), list(image[:, rows]))
