"""Receptive field of a network, measured by the spread of NaN from an input pixel to the outputs."""

from __future__ import annotations

import copy
import math
from weakref import WeakKeyDictionary

import torch
from torch import Tensor, nn

from kornia_tidy.reconstruction.head import ReconstructionHead
from kornia_tidy.reconstruction.tile_place import TilePlace

FARTHEST = 8192  # px; a larger receptive field is taken for the whole image
_STRIP = 32  # px; least width of the strip in which the field is measured lengthwise
_ENDLESS = 2**20  # strides; side of an image so large that interpolation at its ends is shifted as far as it can be

_found: WeakKeyDictionary[nn.Module, int] = WeakKeyDictionary()


def total_stride(head: nn.Module) -> int:
    """Return the shift of an image in pixels that shifts a network's output equally without other changes.

    It is the ``stride`` of the :class:`ReconstructionHead` in the network, and 1 without one.

    Example:
        >>> from kornia_tidy.reconstruction.attention_unet import AttentionUNet
        >>> from kornia_tidy.reconstruction.joint import JointHead
        >>> total_stride(JointHead(AttentionUNet(out_channels=4, width=2)))
        16
    """
    return math.lcm(*(module.stride for module in head.modules() if isinstance(module, ReconstructionHead)))


def receptive_field(head: nn.Module) -> int:
    r"""Return the radius of a network's receptive field in pixels, counted from a cell of the grid of its stride.

    One cell of that grid is NaN in a strip of an image. NaN spreads to all that depends on it, also through zero
    weights, so that outputs other than NaN do not depend on the cell. Convolution algorithms that work on blocks can
    only spread it farther. It is measured along rows and columns, in both directions, and at both ends of an image for
    networks whose interpolation depends on position (:class:`~kornia_tidy.reconstruction.tile_place.TilePlace`); on
    the CPU, once for each network.

    Args:
        head: network from (B, C, H, W) to maps of the same size, in eval mode.

    Returns:
        The largest radius of all directions.

    Raises:
        ValueError: if the network is in training mode, in which batch statistics depend on all pixels, or its
            receptive field exceeds 8192 pixels, as with averages over the whole image.

    Source: Luo et al., Understanding the Effective Receptive Field in Deep Convolutional Neural Networks (NIPS 2016),
    section 2, for the definition.

    Example:
        >>> head = nn.Sequential(nn.Conv2d(3, 4, 5, padding=2), nn.ReLU(), nn.Conv2d(4, 1, 3, padding=1))
        >>> receptive_field(head.eval())
        3
    """
    check_eval(head)
    for module in head.modules():
        if isinstance(module, ReconstructionHead) and module.whole_image:
            raise ValueError(f"the head cannot be tiled: {type(module).__name__} sees the whole image")
    if head not in _found:
        _found[head] = _measure(copy.deepcopy(head).float().cpu(), total_stride(head))
    return _found[head]


def check_eval(head: nn.Module) -> None:
    """Raise ``ValueError`` for a network in training mode, in which batch statistics depend on all pixels."""
    if any(module.training for module in head.modules()):
        raise ValueError("the head must be in eval mode, not training: call head.eval()")


def take_receptive_field(copied: nn.Module, head: nn.Module) -> None:
    """Take the receptive field that was measured of a network, if it was, for that of its copy."""
    if head in _found:
        _found[copied] = _found[head]


def maps_of(output: object) -> tuple[Tensor, ...]:
    """Return the maps of a network's output, which is one tensor or a tuple of tensors, as a tuple.

    Raises:
        TypeError: if it is neither a tensor nor a tuple of tensors.
    """
    maps = output if isinstance(output, tuple) else (output,)
    if not all(isinstance(part, Tensor) for part in maps):
        raise TypeError(f"the head must return a tensor or a tuple of tensors, got {type(output).__name__}")
    return maps  # ty: ignore[invalid-explicit-return]


def input_channels(head: nn.Module) -> int:
    """Return the number of input channels of a network: that of its first convolution, or three without one.

    Example:
        >>> input_channels(nn.Sequential(nn.Conv2d(4, 1, 3)))
        4
    """
    for module in head.modules():
        if isinstance(module, ReconstructionHead | nn.Conv2d):
            return module.in_channels
    return 3


def _measure(head: nn.Module, stride: int) -> int:
    across = -(-_STRIP // stride) * stride
    length = 8 * across
    farthest = 0
    for axis in (-2, -1):
        for at_end in (False, True):
            while (seen := _marked_around(head, axis, length, across, stride, at_end)) is None:
                length *= 2
                if length > 2 * FARTHEST:
                    raise ValueError(
                        f"the head cannot be tiled: each of its outputs depends on pixels more than {FARTHEST} away, "
                        f"as if on the whole image"
                    )
            farthest = max(farthest, seen)
    return farthest


@torch.no_grad()
def _marked_around(head: nn.Module, axis: int, length: int, across: int, stride: int, at_end: bool) -> int | None:
    """Return how far NaN spreads from a cell in the middle of the strip, or None if it reaches an end."""
    size = (length, across) if axis == -2 else (across, length)
    image = torch.zeros(1, input_channels(head), *size)
    begin = length // 2 // stride * stride
    image.narrow(axis, begin, stride).fill_(math.nan)
    corner = (_ENDLESS * stride - size[0], _ENDLESS * stride - size[1]) if at_end else (0, 0)
    with TilePlace(size, corner, (_ENDLESS * stride, _ENDLESS * stride)):
        maps = maps_of(head(image))
    reach = 0
    for part in maps:
        if part.shape[-2:] != size:
            raise ValueError(f"the head must return maps of the image's size {size}, got {tuple(part.shape[-2:])}")
        marked = part.isnan().any(1)[0].any(-1 if axis == -2 else -2).nonzero().flatten()
        if not marked.numel():
            continue
        first, last = int(marked[0]), int(marked[-1])
        if first == 0 or last == length - 1:
            return None
        reach = max(reach, begin - first, last - (begin + stride - 1))
    return reach
