"""The work of rendering a scene, before it is rendered: as the backend counts it that will be taken."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from kornia_tidy.render.backend import Work
from kornia_tidy.render.dispatch import choose
from kornia_tidy.render.layers import assign_layers
from kornia_tidy.render.scene import scene_of_layers


def rendering_work(
    defocus: Tensor,
    batch: int,
    channels: int,
    nodes: Sequence[float],
    window: int,
    *,
    layers: str = "linear",
    compositing: str = "gather",
    border: str = "reflect",
    double: bool = False,
) -> Work:
    """Return the work of rendering a scene through a bank, from the layers of its pixels.

    Args:
        defocus: (B or 1, 1, H, W) radians.
        batch: images B.
        channels: of the images.
        nodes: defocus of the layers that are rendered.
        window: side of the PSFs.
        layers: ``"nearest"`` or ``"linear"``.
        compositing: ``"gather"``, ``"scatter"`` or ``"occlusion"``.
        border: what lies beyond the image.
        double: in float64.

    Example:
        >>> flat = torch.zeros(1, 1, 64, 64)
        >>> rendering_work(flat, 1, 3, (-1.0, 0.0, 1.0), 5).operations == 3 * 64**2 * 2 * 2 * 5**2
        True
    """
    dtype = torch.float64 if double else torch.float32
    index, weight = assign_layers(defocus, torch.tensor(nodes, dtype=defocus.dtype, device=defocus.device), layers)
    weight = weight.to(dtype) if layers == "linear" else None
    image = torch.zeros((), dtype=dtype, device=defocus.device).expand(batch, channels, *defocus.shape[-2:])
    psfs = image.new_zeros(()).expand(len(nodes), channels, window, window)
    scene = scene_of_layers(image, index, weight, psfs, None, border, compositing, dtype)
    return choose(scene).work(scene)
