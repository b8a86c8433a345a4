r"""Gather and scatter by three sums, each the derivative of :math:`\sum_x J_x I_x` to one of its factors.

With a plane L, pixels J in layers d of weights :math:`w_d`, and the PSFs h:

- gather: :math:`I_x = \sum_d w_d(x) \sum_k h_d(k) L(x - k)`, of a plane;
- scatter: :math:`L_y = \sum_d \sum_k h_d(k) w_d(y - k) J(y - k)`, of pixels;
- the gradient of the PSFs: :math:`h_d(k) = \sum_x w_d(x) J(x) L(x - k)`.

Where a capture is gathered, its gradient is scattered, and the other way round, through PSFs turned by 180 degrees.
"""

from __future__ import annotations

from itertools import product
from typing import Protocol

import torch
from torch import Tensor
from torch.nn.functional import pad

from kornia_tidy.render.backend import GradientPairs, gradient_pairs, wants_gradient
from kornia_tidy.render.scene import Labels, LayeredScene


class LayerSums(Protocol):
    """The sums of a scene, through its PSFs and the layers of its pixels. None records gradients."""

    def gather(self, plane: Tensor, *, correlate: bool = False, weight_gradient: bool = False) -> Tensor:
        """Return (B, C, h, w) of a plane (B, C, h + P - 1, w + P - 1).

        Args:
            plane: light, or a gradient with a rim of zeros.
            correlate: through the PSFs turned by 180 degrees.
            weight_gradient: the derivative with respect to the layer weight instead.
        """

    def scatter(self, pixels: Tensor, *, correlate: bool = False) -> Tensor:
        """Return (B, C, h + P - 1, w + P - 1) of pixels (B, C, h, w); of a scattered capture its middle is enough."""

    def psf_gradient(self, plane: Tensor, pixels: Tensor, *, correlate: bool = False) -> Tensor:
        """Return (D, C, P, P) of a plane and of pixels, turned where gather and scatter take the PSFs turned."""


def present_in_tiles(labels: Labels, tile: tuple[int, int], layers: int, reach: int = 0, step: int = 1) -> Tensor:
    """Return (tiles, D) bool: which layers each tile of a batch of planes holds, image by image and row by row.

    Args:
        labels: of every ``step``-th row and column.
        tile: height and width.
        layers: D.
        reach: pixels beyond the tiles, to the right and below, that count too.
        step: between labels.
    """
    (batch, *shape), device = labels.layer_index.shape, labels.layer_index.device
    counts = [max(1, -(-(side * step - reach) // own)) for side, own in zip(shape, tile, strict=True)]
    present = torch.zeros(batch * counts[0] * counts[1] * layers, dtype=torch.bool, device=device)
    images = torch.arange(batch, device=device)[:, None, None]
    for back in product({0, reach}, repeat=2):  # windows reach into the next tile only
        rows, columns = (
            ((torch.arange(side, device=device) * step - own) // long).clamp_(0, most - 1)
            for side, own, long, most in zip(shape, back, tile, counts, strict=True)
        )
        for first in range(0, len(rows), 64):  # in a processor's cache
            part = slice(first, first + 64)
            keys = ((images * counts[0] + rows[part, None]) * counts[1] + columns) * layers
            for layer in labels.terms(slice(None), part):
                present.index_fill_(0, (keys + layer).flatten(), True)
    return present.view(-1, layers)


def seen(scene: LayeredScene, spread: Tensor) -> Tensor:
    """Return the part of scattered light (B, C, H, W) that the sensor sees, without the rim.

    Args:
        scene: that was scattered.
        spread: from :meth:`LayerSums.scatter`.
    """
    lost, (height, width) = scene.psfs.shape[-1] - 1, scene.padded_size
    return spread[..., lost:height, lost:width]


def blend_gradients(scene: LayeredScene, sums: LayerSums, gradient: Tensor) -> GradientPairs:
    """Return the gradients of the padded plane, of the PSFs and of the layer weight.

    Args:
        scene: tensors that autograd records.
        sums: of the scene.
        gradient: (B, C, h, w) of the light.
    """
    tensors, lost = (scene.plane, scene.psfs, scene.batch_weight), scene.psfs.shape[-1] - 1
    plane, of_plane, of_psfs, of_weight = tensors[0].detach(), None, None, None
    # Layers belong to the gradient's pixels for gather, and to those of the light for scatter.
    scatters = scene.compositing == "scatter"
    window, pixels = (pad(gradient, (lost,) * 4), plane) if scatters else (plane, gradient)
    with torch.no_grad():
        if wants_gradient(tensors[0]):
            of_plane = sums.gather(window, correlate=True) if scatters else sums.scatter(pixels, correlate=True)
        if wants_gradient(tensors[1]):
            of_psfs = sums.psf_gradient(window, pixels, correlate=scatters)
        if wants_gradient(tensors[2]):
            of_weight = (sums.gather(window, correlate=scatters, weight_gradient=True) * pixels).sum(1)
    return gradient_pairs(tensors, (of_plane, of_psfs, of_weight))
