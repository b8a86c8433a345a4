"""What occlusion-aware rendering costs: time and memory, by formula. The PSF bank's cost is in render_cost.

Seconds are those of :mod:`kornia_tidy.render.cost_model`.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from kornia_tidy.kernels.occlusion_ops import SMALLEST_SIDE, count_work
from kornia_tidy.render.backends import direct_occlusion
from kornia_tidy.render.backends.direct import is_direct_faster
from kornia_tidy.render.backends.tile_plan import WINDOWS, choose_grid, windows_cost
from kornia_tidy.render.layers import SAMPLE, Labels

_PLANES = 6  # of a chunk at a time: light, spectra, products and quotients; 0.99 to 1.46 of what was measured


@dataclass(frozen=True)
class Windows:
    """What the renderer does for a scene with occlusion.

    See :mod:`kornia_tidy.render.backends.window_plan` and :mod:`kornia_tidy.render.backends.direct_occlusion`.

    Args:
        size: side of the windows in pixels.
        held: (N,) how many layers each window holds.
        layers: layers present in the scene.
        pixels: of the padded image in one channel, over the batch.
        direct: nanoseconds a channel by direct convolution in float32, where that is possible.
    """

    size: int
    held: Tensor
    layers: int
    pixels: int
    direct: float | None = None


def count_windows(labels: Labels, layers: int, window: int) -> Windows:
    """Cut up a scene as the renderer will, and count. Only every eighth row and column is looked at.

    Args:
        labels: of the padded image, from :func:`~kornia_tidy.render.cost_model.label_pixels`.
        layers: how many there are.
        window: side of the PSFs.

    Example:
        >>> flat = Labels(torch.zeros(1, 72, 72, dtype=torch.int64), None)
        >>> count_windows(flat, 3, 9).held.unique().tolist()
        [1]
    """
    grid = choose_grid(labels, layers, window, WINDOWS)
    here = grid.present(labels.every(SAMPLE), layers, SAMPLE)
    scene = torch.empty(labels.layer_index[:, None].shape), torch.zeros(layers, 1, window, window)
    direct = None
    if labels.layer_index.device.type == "cpu" and direct_occlusion.can_go_directly(*scene):
        counts = count_work(*scene, labels.layer_index, labels.layer_weight, direct_occlusion.COUNTED)
        direct = direct_occlusion.direct_cost(*counts, max(window, SMALLEST_SIDE))
    return Windows(grid.size, here.sum(1), int(here.any(0).sum()), labels.layer_index.numel(), direct)


def windows_seconds(windows: Windows, channels: int, itemsize: int = 4) -> float:
    """Return the time of one capture on one core, by tiles, which are computed in float64, or directly.

    Args:
        windows: of the scene.
        channels: of the image.
        itemsize: bytes of a number of the image.

    Example:
        >>> f"{windows_seconds(Windows(64, torch.full((400,), 3), 21, 2**20), 3):.1g}"
        '0.4'
    """
    tiles = float(windows_cost(windows.held, windows.size))
    faster = tiles if windows.direct is None else min(tiles, windows.direct * itemsize / 4)
    return faster * channels * 1e-9


def windows_bytes(windows: Windows, channels: int, itemsize: int) -> int:
    """Return the peak memory of one capture without gradients beyond the image and the PSFs.

    That is the spectra of the PSFs, the planes of a chunk of windows, and what belongs to pixels; directly only this.

    Args:
        windows: of the scene.
        channels: of the image.
        itemsize: bytes of a number of the image.
    """
    tiles = float(windows_cost(windows.held, windows.size))
    if windows.direct is not None and is_direct_faster(windows.direct * itemsize / 4, tiles):
        return windows.pixels * (2 * channels * itemsize + 4 * 8)
    plane = 16 * channels * windows.size**2
    chunk = max(WINDOWS.chunk_bytes, 2 * plane * int(windows.held.max()))
    return 2 * windows.layers * plane + _PLANES * chunk + windows.pixels * (2 * channels * itemsize + 4 * 8)
