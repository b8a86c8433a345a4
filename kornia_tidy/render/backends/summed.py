"""Sums over layers in plain operations of torch, for gradients that are differentiated in turn.

Tiles and direct convolution write over their own memory and are differentiated by hand, once. Where a second
derivative is asked for, the first is made from these sums instead: the same light, at the price of transforms of the
whole plane for each layer.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from kornia_tidy.render.borders import from_spectrum, to_spectrum
from kornia_tidy.render.layers import layer_weight, present_layers


def differentiable_slopes(
    render: Callable[..., Tensor], inputs: Sequence[Tensor | None], grad: Tensor, wanted: Sequence[bool]
) -> list[Tensor | None]:
    """Return the gradients of what a function renders, where they are wanted, as differentiable as the function.

    Args:
        render: function of the inputs.
        inputs: tensors, or None.
        grad: gradient of what it returns.
        wanted: of which inputs.

    Example:
        >>> x = torch.tensor(3.0, requires_grad=True)
        >>> (slope,) = differentiable_slopes(lambda x: x**3, [x], torch.tensor(1.0), [True])
        >>> slope.item(), torch.autograd.grad(slope, x)[0].item()
        (27.0, 18.0)
    """
    # Views, so that a gradient ends here, though one input may be made of another.
    own = [None if x is None else x.view_as(x) for x in inputs]
    asked = [x for x, want in zip(own, wanted, strict=True) if want and x is not None]
    coded = render(*own)
    found = iter(torch.autograd.grad(coded, asked, grad.to(coded), create_graph=True, allow_unused=True))
    return [next(found) if want and x is not None else None for x, want in zip(own, wanted, strict=True)]


def mix_layers(plane: Tensor, psfs: Tensor, fraction: Tensor | None, lower: Tensor) -> Tensor:
    """Let each pixel take the light that it sees through the PSFs of its own layers: gather.

    Args:
        plane: (B, C, H + P - 1, W + P - 1) light.
        psfs: (D, C, P, P).
        fraction: (B, H, W) share of the next layer, or None for none.
        lower: (B, H, W) index of each pixel's layer.

    Returns:
        (B, C, H, W).
    """
    size, side = (plane.shape[-2], plane.shape[-1]), psfs.shape[-1]
    lower, fraction = lower[:, None], None if fraction is None else fraction[:, None]
    light, mixed = to_spectrum(plane, size), torch.zeros((), dtype=plane.dtype, device=plane.device)
    for index in present_layers(lower, fraction, len(psfs)):
        blurred = from_spectrum(light * to_spectrum(psfs[index], size), size, side)
        mixed = mixed + layer_weight(lower, fraction, index) * blurred
    return mixed


def spread_layers(plane: Tensor, psfs: Tensor, fraction: Tensor | None, lower: Tensor) -> Tensor:
    """Let each pixel spread its light by the PSFs of its own layers: scatter.

    Args:
        plane: (B, C, H + P - 1, W + P - 1) light.
        psfs: (D, C, P, P).
        fraction: share of the next layer, (B, H + P - 1, W + P - 1), or None for none.
        lower: index of each pixel's layer, of the same shape.

    Returns:
        (B, C, H, W).
    """
    size, side = (plane.shape[-2], plane.shape[-1]), psfs.shape[-1]
    lower, fraction = lower[:, None], None if fraction is None else fraction[:, None]
    light = torch.zeros((), dtype=plane.dtype, device=plane.device)
    for index in present_layers(lower, fraction, len(psfs)):
        own = layer_weight(lower, fraction, index) * plane
        light = light + to_spectrum(own, size) * to_spectrum(psfs[index], size)
    return from_spectrum(light, size, side)
