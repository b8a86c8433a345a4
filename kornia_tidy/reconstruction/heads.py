"""Reconstruction networks made by name, as settings and checkpoints name them."""

from __future__ import annotations

import importlib
from typing import Any

from torch import Tensor, nn

from kornia_tidy.reconstruction.head import ReconstructionHead
from kornia_tidy.reconstruction.head_names import CLOSED_FORMS, DEEPENED, FIXED, HEADS, check_head, check_repeats


def make_head(
    name: str, out_channels: int, width: int | None = None, in_channels: int = 3, repeats: int = 1
) -> ReconstructionHead:
    """Return a network by name or import path.

    Args:
        name: a key of :data:`HEADS`, or ``module:Class``, a class that is called with ``in_channels``,
            ``out_channels`` and, if given, ``width``. Importing the module runs its code.
        out_channels: maps to estimate.
        width: channels of its first level. None: its default.
        in_channels: channels of its input.
        repeats: factor of the number of its blocks, for :data:`DEEPENED` heads.

    Raises:
        ValueError: if the name is unknown, the class cannot be imported or is not a ``torch.nn.Module``, or the network
            cannot have these channels, this width or more blocks.

    Example:
        >>> import torch
        >>> make_head("plain", 3, width=4)(torch.rand(1, 3, 20, 30)).shape
        torch.Size([1, 3, 20, 30])
    """
    check_head(name)
    if name in CLOSED_FORMS:
        raise ValueError(f"the head {name!r} has no network: make it by ClosedFormHead")
    check_repeats(name, repeats)
    if name in FIXED:
        if in_channels != 3 or width is not None:
            raise ValueError(f"the head {name!r} takes 3 channels and no width, got {in_channels} and width={width}")
        return _attribute(HEADS[name])(out_channels)
    options: dict[str, Any] = {} if width is None else {"width": width}
    if name in DEEPENED:
        options["repeats"] = repeats
    if name in HEADS:
        return _attribute(HEADS[name])(in_channels, out_channels, **options)
    return OutsideHead(_imported(name), in_channels, out_channels, **options)


def _attribute(path: str) -> Any:
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(module), name)


def _imported(path: str) -> Any:
    """Return a network class of the user by its import path."""
    try:
        network = _attribute(path)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"the head {path!r:.80} cannot be imported: {error}") from error
    if not (isinstance(network, type) and issubclass(network, nn.Module)):
        raise ValueError(f"the head {path!r:.80} must be a class of torch.nn.Module, got {network!r:.80}")
    return network


class OutsideHead(ReconstructionHead):
    """A network of the user, with the checks, padding and cropping of :class:`ReconstructionHead`.

    Args:
        kind: class that is called with ``in_channels``, ``out_channels`` and, if given, ``width``. Its attribute
            ``stride``, if it is a number, is the number that divides the sides of its images.
        in_channels: channels of the image.
        out_channels: maps to estimate.
        width: channels of its first level, if it takes it.

    Shape:
        - image: (B, in_channels, H, W), any size.
        - output: (B, out_channels, H, W).

    Raises:
        ValueError: if the class does not take these arguments, or returns maps of another shape.
    """

    def __init__(self, kind: type[nn.Module], in_channels: int, out_channels: int, **width: int) -> None:
        super().__init__(in_channels, out_channels)
        try:
            self.network = kind(in_channels, out_channels, **width)
        except TypeError as error:
            arguments = ", ".join([str(in_channels), str(out_channels), *(f"{k}={v}" for k, v in width.items())])
            raise ValueError(f"the head {kind.__name__}({arguments}) cannot be made: {error}") from error
        stride = getattr(self.network, "stride", 1)
        self.stride = stride if isinstance(stride, int) else 1  # a convolution's is a tuple

    def predict(self, image: Tensor) -> Tensor:
        """Return the network's maps."""
        maps = self.network(image)
        if maps.shape != (wanted := (len(image), self.out_channels, *image.shape[-2:])):
            raise ValueError(f"the head {type(self.network).__name__} must return {wanted}, got {tuple(maps.shape)}")
        return maps


class PlainHead(ReconstructionHead):
    """Small network of five 3x3 convolutions with growing dilation and a receptive field of 63 pixels.

    It is fast and has no batch normalisation, whose statistics would differ between processes: for examples, tests and
    first trials.

    Args:
        in_channels: channels of the image.
        out_channels: maps to estimate.
        width: channels of the layers between.

    Shape:
        - image: (B, in_channels, H, W), any size.
        - output: (B, out_channels, H, W), any real number.
    """

    stride = 1

    def __init__(self, in_channels: int = 3, out_channels: int = 3, width: int = 16) -> None:
        super().__init__(in_channels, out_channels)
        steps = [1, 2, 4, 8, 16]
        channels = [in_channels, *[width] * (len(steps) - 1), out_channels]
        self.layers = nn.ModuleList(
            nn.Conv2d(i, o, 3, padding=step, dilation=step)
            for i, o, step in zip(channels[:-1], channels[1:], steps, strict=True)
        )

    def predict(self, image: Tensor) -> Tensor:
        """Return the maps."""
        features = image
        for layer in self.layers[:-1]:
            features = nn.functional.leaky_relu(layer(features), 0.1)
        return self.layers[-1](features)
