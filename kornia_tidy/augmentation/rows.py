"""Rows of a batch: an augmentation computes only the changed ones, each with its own draws and noise."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import wraps
from typing import Any

import torch
from torch import Tensor

_SEEDS = 2**31  # whole numbers that a cast of the parameters to float64 keeps


def outside_graphs(method: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """Keep a method out of the graphs of ``torch.compile``, as ``torch.compiler.disable`` does.

    That decorator imports ``torch._dynamo``, which takes a second. This one imports it while a caller is compiled.

    Args:
        method: runs as Python code, eagerly.

    Example:
        >>> outside_graphs(torch.neg)(torch.ones(1))
        tensor([-1.])
    """

    @wraps(method)
    def call(*arguments: Any, **options: Any) -> Tensor:
        if torch.compiler.is_compiling():
            return torch.compiler.disable(method)(*arguments, **options)
        return method(*arguments, **options)

    return call


def changed_rows(
    image: Tensor,
    params: Mapping[str, Any],
    every: bool,
    change: Callable[[Tensor | slice, dict[str, Tensor]], Tensor],
) -> Tensor:
    """Return a batch with some images changed. The others are not computed.

    Args:
        image: (B, C, H, W).
        params: of an augmentation of kornia; ``"batch_prob"`` above 0.5 marks the images to be changed.
        every: change all of them, whatever ``"batch_prob"`` says.
        change: takes the indices of images and their draws, and returns the changed images.

    Example:
        >>> params = {"batch_prob": torch.tensor([0.0, 1.0]), "by": torch.tensor([1.0, 2.0])}
        >>> ones = torch.ones(2, 1, 1, 1)
        >>> changed_rows(ones, params, False, lambda rows, drawn: ones[rows] + drawn["by"]).flatten()
        tensor([1., 3.])
    """
    drawn = drawn_rows(params, len(image))
    if not len(image):
        return image
    rows = params["batch_prob"].flatten() > 0.5
    if every or bool(rows.all()):
        return change(slice(None), drawn)
    index = rows.nonzero()[:, 0]
    if not len(index):
        return image
    part = {name: value[index.to(value.device)] for name, value in drawn.items()}
    index = index.to(image.device)
    return image.index_copy(0, index, change(index, part))


def drawn_rows(params: Mapping[str, Any], count: int) -> dict[str, Tensor]:
    """Return the draws of each image of a batch, without the entries that kornia adds to ``params``.

    Args:
        params: of an augmentation.
        count: images of the batch.

    Example:
        >>> sorted(drawn_rows({"seed": torch.ones(2), "batch_prob": torch.ones(2), "data_keys": ["input"]}, 2))
        ['seed']
    """
    kornias = ("batch_prob", "forward_input_shape")
    return {
        name: value
        for name, value in params.items()
        if name not in kornias and isinstance(value, Tensor) and value.ndim and len(value) == count
    }


def row_seeds(count: int, same: bool) -> Tensor:
    """Draw a seed for each image of a batch from the global generator.

    Args:
        count: images of the batch.
        same: one seed for all of them.

    Returns:
        (count,) int64.

    Example:
        >>> row_seeds(3, same=True).unique().shape
        torch.Size([1])
    """
    return torch.randint(_SEEDS, (1 if same else count,)).expand(count).clone()


def row_places(shape: tuple[int, ...], optics: Any, same: bool) -> Tensor:
    """Draw where each image of a batch lies in the field of a camera's lens, from the global generator.

    Args:
        shape: of the batch, (B, C, H, W).
        optics: a :class:`~kornia_tidy.TiDyOptics` with a lens, whose field no corner exceeds.
        same: one place for all of them.

    Returns:
        (B, 2) float64, y and x of the middle in pixels from the axis, evenly over a disc.

    Example:
        >>> from kornia_tidy import NoMask, TiDyOptics
        >>> places = row_places((100, 3, 60, 80), TiDyOptics(NoMask(23), lens="single-50mm"), same=False)
        >>> bool((places.norm(dim=1) <= 6.784e-3 / 8e-6 - 50).all())
        True
    """
    free = max(0.0, optics.lens.field / float(optics.camera.pixel_pitch) - math.hypot(*shape[-2:]) / 2)
    radius, angle = torch.rand(2, 1 if same else shape[0], dtype=torch.float64)
    places = free * radius.sqrt() * torch.stack([torch.sin(2 * math.pi * angle), torch.cos(2 * math.pi * angle)])
    return places.T.expand(shape[0], 2).clone()
