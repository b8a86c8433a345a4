"""Weights of defocus layers: how much of each pixel's light belongs to each layer of a PSF bank.

They follow from the two numbers that :func:`kornia_tidy.render.scene.assign_layers` gives each pixel, layer index and
layer weight.
"""

from __future__ import annotations

import torch
from torch import Tensor

from kornia_tidy.mode import Mode, torch_mode
from kornia_tidy.render.scene import Labels, assign_layers


def weight_of_layer(layer_index: Tensor, layer_weight: Tensor | None, layer: int | Tensor) -> Tensor:
    """Return the weight of one layer at every pixel, from what :func:`assign_layers` returned.

    Args:
        layer_index: (B, 1, H, W) int64 index of the layer below.
        layer_weight: (B, 1, H, W) weight of the next layer, or None for nearest layers.
        layer: the layer wanted, or a tensor of layers that broadcasts with the pixels.

    Returns:
        (B, 1, H, W) weight in [0, 1], of ``layer_weight``'s dtype, or bool without it.
    """
    if layer_weight is None:
        return layer_index == layer
    return torch.where(layer_index == layer, 1 - layer_weight, layer_weight * (layer_index == layer - 1))


def layer_weights(defocus: Tensor, nodes: Tensor, mode: str) -> Tensor:
    """Return the weights of all layers at once; a renderer asks for one at a time with :func:`weight_of_layer`.

    Args:
        defocus: (B, 1, H, W) defocus in radians.
        nodes: (D,) ascending defocus of the layers in radians.
        mode: ``"nearest"`` (one-hot) or ``"linear"`` (hat functions), see :func:`assign_layers`.

    Returns:
        (B, D, H, W) weights in [0, 1] in float32 or float64. Their sum over D is exactly one.

    Example:
        >>> import torch
        >>> defocus = torch.tensor([[[[0.5]]]])
        >>> layer_weights(defocus, torch.tensor([-2.0, 0.0, 4.0]), "linear").flatten()
        tensor([0.0000, 0.8750, 0.1250])
        >>> layer_weights(defocus, torch.tensor([-2.0, 0.0, 4.0]), "nearest").flatten()
        tensor([0., 1., 0.])
    """
    index, weight = assign_layers(defocus, nodes, mode)
    return torch.cat([weight_of_layer(index, weight, layer) for layer in range(len(nodes))], dim=1)


def blend_of_layers(values: Tensor, layer_index: Tensor, layer_weight: Tensor | None) -> Tensor:
    """Return each pixel's mean of a value that every layer and channel has.

    Args:
        values: (D, C).
        layer_index: (B, 1, H, W) int64 index of the layer below.
        layer_weight: (B, 1, H, W) weight of the next layer, or None for nearest layers.

    Returns:
        (B, C, H, W).

    Example:
        >>> import torch
        >>> values, pixels = torch.tensor([[0.0], [10.0]]), torch.zeros(1, 1, 1, 2, dtype=torch.int64)
        >>> blend_of_layers(values, pixels, torch.tensor([[[[0.25, 1.0]]]])).flatten()
        tensor([ 2.5000, 10.0000])
    """
    below = torch.cat([channel.take(layer_index) for channel in values.unbind(1)], dim=1)
    if layer_weight is None:
        return below
    above = (layer_index + 1).clamp(max=len(values) - 1)
    return torch.lerp(below, torch.cat([channel.take(above) for channel in values.unbind(1)], dim=1), layer_weight)


def present_layers(layer_index: Tensor, layer_weight: Tensor | None, count: int) -> list[int]:
    """Return the layers out of ``count`` that a scene contains, ascending. Waits for the device once, for all layers.

    While compiling or under torch.func, all layers are returned: which are present depends on the data. Where gradients
    with respect to defocus are wanted, both neighbours of a pixel count: on a node the next layer's weight is zero, its
    gradient is not.

    Args:
        layer_index: (B, 1, H, W) int64 index of the layer below, from :func:`assign_layers`.
        layer_weight: (B, 1, H, W) weight of the next layer, or None for nearest layers.
        count: the number of layers D.

    Example:
        >>> import torch
        >>> present_layers(torch.tensor([0, 3]), torch.tensor([1.0, 0.5]), count=6)
        [1, 3, 4]
    """
    if Mode.TRANSFORM in torch_mode():
        return list(range(count))
    return Labels(layer_index, layer_weight, layer_weight is not None and layer_weight.requires_grad).present()
