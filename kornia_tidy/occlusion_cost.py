"""What occlusion-aware rendering costs: time and memory, by formula. The PSF bank's cost is in render_cost.

Seconds are those of :mod:`kornia_tidy.render_cost`.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from kornia_tidy.scene.occlusion_tiles import CHUNK_BYTES, choose_grid, layers_of_windows, windows_cost
from kornia_tidy.scene.tiles import Labels

_PLANES = 6  # of a chunk at a time: light, spectra, products and quotients; 0.99 to 1.46 of what was measured


@dataclass(frozen=True)
class Windows:
    """What the renderer does for a scene, see :mod:`kornia_tidy.scene.occlusion_tiles`.

    Args:
        size: side of the windows in pixels.
        held: (N,) how many layers each window holds.
        layers: layers present in the scene.
        pixels: of the padded image in one channel, over the batch.
    """

    size: int
    held: Tensor
    layers: int
    pixels: int


def count_windows(labels: Labels, layers: int, window: int) -> Windows:
    """Cut up a scene as the renderer will, and count. Only every eighth row and column is looked at.

    Args:
        labels: of the padded image, from :func:`~kornia_tidy.render_cost.label_pixels`.
        layers: how many there are.
        window: side of the PSFs.

    Example:
        >>> import torch
        >>> flat = Labels(torch.zeros(1, 72, 72, dtype=torch.int64), None)
        >>> count_windows(flat, 3, 9).held.unique().tolist()
        [1]
    """
    terms = labels.terms()
    height, width = (side - window + 1 for side in labels.lower.shape[-2:])
    grid = choose_grid(terms, (height, width), layers, window)
    here = layers_of_windows(terms, grid, layers)
    return Windows(grid.size, here.sum(1), int(here.any(0).sum()), labels.lower.numel())


def windows_seconds(windows: Windows, channels: int) -> float:
    """Return the time of one capture on one core, whatever its precision: it is computed in float64.

    Example:
        >>> import torch
        >>> f"{windows_seconds(Windows(64, torch.full((400,), 3), 21, 2**20), 3):.1g}"
        '0.4'
    """
    return float(windows_cost(windows.held, windows.size)) * channels * 1e-9


def windows_bytes(windows: Windows, channels: int, itemsize: int) -> int:
    """Return the peak memory of one capture without gradients beyond the image and the PSFs.

    That is the spectra of the PSFs, the planes of a chunk of windows, and what belongs to pixels.

    Args:
        windows: of the scene.
        channels: of the image.
        itemsize: bytes of a number of the image.
    """
    plane = 16 * channels * windows.size**2
    chunk = max(CHUNK_BYTES["cpu"], 2 * plane * int(windows.held.max()))
    return 2 * windows.layers * plane + _PLANES * chunk + windows.pixels * (2 * channels * itemsize + 4 * 8)
