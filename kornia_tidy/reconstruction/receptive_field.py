"""How far a network looks: found by marking pixels and seeing which outputs are marked."""

from __future__ import annotations

import copy
import math
from weakref import WeakKeyDictionary

import torch
from torch import Tensor, nn

from kornia_tidy.reconstruction.head import ReconstructionHead
from kornia_tidy.reconstruction.tile_place import TilePlace

FARTHEST = 8192  # px; a network that looks farther is taken to look everywhere
_STRIP = 32  # px across, at least: nothing is looked for along that side
_ENDLESS = 2**20  # px of an image at whose ends interpolation is most shifted; a multiple of any stride

_found: WeakKeyDictionary[nn.Module, int] = WeakKeyDictionary()


def total_stride(head: nn.Module) -> int:
    """Return the pixels by which an image must be shifted for a network's output to be shifted, and nothing else.

    It is the ``stride`` of the :class:`ReconstructionHead` in it, and 1 where there is none.

    Example:
        >>> from kornia_tidy.reconstruction.attention_unet import AttentionUNet
        >>> from kornia_tidy.reconstruction.joint import JointHead
        >>> total_stride(JointHead(AttentionUNet(out_channels=4, width=2)))
        16
    """
    return math.lcm(*(module.stride for module in head.modules() if isinstance(module, ReconstructionHead)))


def receptive_field(head: nn.Module) -> int:
    r"""Return how many pixels beyond an edge on the grid of its stride still have a say in a network's output.

    In a strip of an image one cell of that grid is NaN. Every operation passes it on to whatever it has a say in, also
    where a weight is zero, so the outputs that are not NaN do not depend on the cell. Algorithms that convolve whole
    blocks at once can only mark more. Measured along rows and columns, in both directions, and at both ends of an
    image, for networks that interpolate by their place (:class:`~kornia_tidy.reconstruction.tile_place.TilePlace`);
    on the CPU, once for each network.

    Args:
        head: (B, C, H, W) to maps of the same size, in eval mode.

    Returns:
        Pixels, the largest of all directions.

    Raises:
        ValueError: if it is in training mode, where pixels see each other through the batch's statistics, or looks
            farther than 8192 pixels, as averages over the whole image do.

    Source: Luo et al., Understanding the Effective Receptive Field in Deep Convolutional Neural Networks (NIPS 2016),
    section 2, for what is measured here.

    Example:
        >>> head = nn.Sequential(nn.Conv2d(3, 4, 5, padding=2), nn.ReLU(), nn.Conv2d(4, 1, 3, padding=1))
        >>> receptive_field(head.eval())
        3
    """
    if any(module.training for module in head.modules()):
        raise ValueError("the head must be in eval mode, not training: call head.eval()")
    if head not in _found:
        _found[head] = _measure(copy.deepcopy(head).float().cpu(), total_stride(head))
    return _found[head]


def maps_of(output: object) -> tuple[Tensor, ...]:
    """Return the maps of a network's output: itself, or the fields of a tuple.

    Raises:
        TypeError: if it is neither a tensor nor a tuple of tensors.
    """
    maps = output if isinstance(output, tuple) else (output,)
    if not all(isinstance(part, Tensor) for part in maps):
        raise TypeError(f"the head must return a tensor or a tuple of tensors, got {type(output).__name__}")
    return maps  # ty: ignore[invalid-explicit-return]


def input_channels(head: nn.Module) -> int:
    """Return the channels of the images that a network takes: those its first convolution takes, or three.

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
    """How far outputs beside the one marked cell are marked, or None if that is to the end of the strip."""
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
