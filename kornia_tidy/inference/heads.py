"""Reconstruction networks by name, as settings and checkpoints name them."""

from __future__ import annotations

import importlib
from typing import Any

from torch import Tensor, nn

from kornia_tidy.checks import check_choice
from kornia_tidy.reconstruction.head import ReconstructionHead

# Each takes in_channels, out_channels and width, and maps (B, in_channels, H, W) to (B, out_channels, H, W).
HEADS = {
    "attention-unet": "kornia_tidy.reconstruction:AttentionUNet",
    "depth-anything-v2": "kornia_tidy.inference.baselines:depth_anything_v2",
    "phasecam3d": "kornia_tidy.reconstruction:PhaseCam3DUNet",
    "plain": "kornia_tidy.inference.heads:PlainHead",
    "zoedepth": "kornia_tidy.inference.baselines:zoedepth",
}


def make_head(name: str, out_channels: int, width: int | None = None, in_channels: int = 3) -> ReconstructionHead:
    """Return a network by name.

    Args:
        name: a key of :data:`HEADS`.
        out_channels: maps to estimate.
        width: channels of its first level. None: its default.
        in_channels: channels of its input.

    Example:
        >>> import torch
        >>> make_head("plain", 3, width=4)(torch.rand(1, 3, 20, 30)).shape
        torch.Size([1, 3, 20, 30])
    """
    check_choice("head", name, tuple(HEADS))
    module, _, attribute = HEADS[name].partition(":")
    options: dict[str, Any] = {} if width is None else {"width": width}
    network = getattr(importlib.import_module(module), attribute)
    return network(in_channels, out_channels, **options)


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
