"""Layer assignment: how much of each pixel's light belongs to each defocus layer of a PSF bank.

A bank knows its PSFs at a few nodes of defocus. A pixel between two nodes has a layer index, that of the node below it,
and a layer weight, the fraction of the way to the next node. All weights follow from these two numbers, so no
(B, D, H, W) tensor is needed.
"""

from __future__ import annotations

import torch
from torch import Tensor

from kornia_tidy.checks import check_choice, check_float_tensor
from kornia_tidy.mode import Mode, torch_mode

LAYER_MODES = ("nearest", "linear")


def assign_layers(defocus: Tensor, nodes: Tensor, mode: str) -> tuple[Tensor, Tensor]:
    r"""Return the layer below each pixel's defocus and the weight of the next layer.

    .. math:: t = \frac{\psi - \psi_i}{\psi_{i+1} - \psi_i}, \qquad \psi_i \le \psi \le \psi_{i+1}

    Args:
        defocus: (B, 1, H, W) defocus in radians. Values beyond the nodes are clamped.
        nodes: (D,) defocus of the layers in radians, strictly ascending; the spacing may vary.
        mode: ``"linear"`` shares the light between two layers, ``"nearest"`` gives all of it to one.

    Returns:
        The layer index i in int64 and the layer weight t in [0, 1], both (B, 1, H, W). Layer i has the weight 1 - t and
        layer i + 1 the weight t. For ``"nearest"`` t is zero.

    Raises:
        ValueError: if ``mode`` is not known, or the nodes do not ascend (not checked while compiling, nor on an
            accelerator: see :func:`check_nodes`).

    Convention:
        - Half way between two nodes, nearest takes the lower one (the farther from the camera).
        - Linear has a gradient with respect to defocus; on a node it is that of the interval above, on the last node
          that of the interval below. Nearest has none.

    Example:
        >>> import torch
        >>> defocus = torch.tensor([-4.0, 0.5, 3.0, 9.0]).view(1, 1, 1, 4)
        >>> index, weight = assign_layers(defocus, torch.tensor([-2.0, 0.0, 4.0]), "linear")
        >>> index.flatten().tolist(), weight.flatten().tolist()
        ([0, 1, 1, 1], [0.0, 0.125, 0.75, 1.0])
    """
    if mode not in LAYER_MODES:
        check_choice("layers", mode, LAYER_MODES)
    check_float_tensor("nodes", nodes, 1, "(D,)")
    dtype = torch.promote_types(torch.promote_types(defocus.dtype, nodes.dtype), torch.float32)
    defocus, nodes = defocus.to(dtype), nodes.to(dtype)
    spacing = None if Mode.TRANSFORM in torch_mode() else _even_spacing(nodes)
    if spacing is None and nodes.device.type == "cpu":
        check_nodes(nodes)
    if mode == "nearest" and spacing is not None:
        steps = (defocus.detach() - nodes[0]).div_(spacing).sub_(0.5).ceil_().clamp_(0, len(nodes) - 1)
        return steps.long(), torch.zeros((), dtype=dtype).expand(defocus.shape)
    if mode == "nearest" or len(nodes) == 1:
        middles = (nodes[1:] + nodes[:-1]) / 2
        index = torch.bucketize(defocus.detach().contiguous(), middles.detach())
        return index, torch.zeros((), dtype=dtype, device=defocus.device).expand(defocus.shape)
    if spacing is not None:
        steps = (defocus - nodes[0]).div_(spacing).clamp_(0, len(nodes) - 1)
        index = steps.detach().long().clamp_(max=len(nodes) - 2)
        return index, steps - index
    clamped = defocus.clamp(nodes[0], nodes[-1])
    # Inner nodes only: the end nodes belong to the first and last interval.
    index = torch.bucketize(clamped.detach().contiguous(), nodes[1:-1].detach().contiguous(), right=True)
    return index, (clamped - nodes.take(index)) / nodes.diff().take(index)


def check_nodes(nodes: Tensor) -> None:
    """Raise ``ValueError`` if the nodes do not ascend strictly, unless their values are unknown. Waits for the device.

    Args:
        nodes: (D,) defocus of the layers in radians.
    """
    if Mode.GRAPH not in torch_mode() and not bool((nodes.diff() > 0).all()):
        raise ValueError(f"nodes must ascend strictly, got {nodes.tolist()}")


def _even_spacing(nodes: Tensor) -> Tensor | None:
    """Return the distance between ascending nodes if it is the same, to rounding: a search takes ten times as long.

    None too where nodes are learnt, or on a device that one would have to wait for.
    """
    if nodes.device.type != "cpu" or nodes.requires_grad or len(nodes) == 1:
        return None
    spacing = (nodes[-1] - nodes[0]) / (len(nodes) - 1)
    even = nodes[0] + spacing * torch.arange(len(nodes), dtype=nodes.dtype)
    rounding = 4 * torch.finfo(nodes.dtype).eps * nodes.abs().max()
    return spacing if bool((((nodes - even).abs() <= rounding) & (spacing > 2 * rounding)).all()) else None


def weight_of_layer(layer_index: Tensor, layer_weight: Tensor | None, layer: int | Tensor) -> Tensor:
    """Return the weight of one layer at every pixel, from what :func:`assign_layers` returned.

    Args:
        layer_index: (B, 1, H, W) int64 index of the layer below.
        layer_weight: (B, 1, H, W) weight of the next layer, or None for nearest layers.
        layer: the layer wanted, or a tensor of layers that broadcasts with the pixels.

    Returns:
        (B, 1, H, W) weight in [0, 1], of ``layer_weight``'s dtype, or bool if that is None.
    """
    if layer_weight is None:
        return layer_index == layer
    return torch.where(layer_index == layer, 1 - layer_weight, torch.where(layer_index == layer - 1, layer_weight, 0))


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
    present = torch.zeros(count, dtype=torch.bool, device=layer_index.device)
    if layer_weight is None:
        present[layer_index] = True
        return [layer for layer, here in enumerate(present.tolist()) if here]
    next_layer, with_gradient = layer_index + 1, layer_weight.requires_grad
    present[layer_index if with_gradient else torch.where(layer_weight < 1, layer_index, next_layer)] = True
    present[next_layer if with_gradient else torch.where(layer_weight > 0, next_layer, layer_index)] = True
    return [layer for layer, here in enumerate(present.tolist()) if here]
