"""Masks made stronger, for tests of accuracy."""

from __future__ import annotations

import torch

from kornia_tidy.masks import PhaseMasks


@torch.no_grad()
def strong(masks: PhaseMasks, factor: float) -> PhaseMasks:
    """The masks with their parameters multiplied by a factor, in place."""
    for parameter in masks.parameters():
        parameter.mul_(factor)
    return masks
