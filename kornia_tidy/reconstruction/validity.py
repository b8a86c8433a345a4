"""Validity masks, which exclude pixels without a true value, NaN included, from losses and metrics."""

from __future__ import annotations

import torch
from torch import Tensor

from kornia_tidy.checks import check_float_tensor


def valid_maps(
    prediction: Tensor, target: Tensor, mask: Tensor | None = None, filler: float = 0.0
) -> tuple[Tensor, Tensor, Tensor]:
    """Return prediction and target with equal values at masked pixels, and the mask of every sample.

    Masked pixels are replaced before any computation, so that they affect neither values nor gradients. A product with
    zero would keep NaN.

    Args:
        prediction: (B, C, H, W).
        target: (B, C, H, W).
        mask: bool (B, 1, H, W), or another shape that broadcasts; True where the target is known. None: everywhere.
        filler: value of masked pixels in both.

    Returns:
        Prediction, target, both in float32 or float64, and the mask, all (B, C, H, W).

    Raises:
        TypeError: if prediction or target are not floating point, or the mask is not bool.
        ValueError: if the shapes do not fit. Broadcasting (B, H, W) with (B, 1, H, W) would compare all pairs of
            images.

    Example:
        >>> depth = torch.tensor([1.5, float("nan")]).view(1, 1, 1, 2)
        >>> prediction, target, mask = valid_maps(torch.ones(1, 1, 1, 2), depth, ~depth.isnan())
        >>> target.flatten(), mask.flatten()
        (tensor([1.5000, 0.0000]), tensor([ True, False]))
    """
    layout = "(B, C, H, W)"
    check_float_tensor("prediction", prediction, 4, layout)
    check_float_tensor("target", target, 4, layout)
    if prediction.shape != target.shape:
        raise ValueError(
            f"prediction must have the target's shape {tuple(target.shape)}, got {tuple(prediction.shape)}"
        )
    dtype = torch.promote_types(torch.promote_types(prediction.dtype, target.dtype), torch.float32)
    prediction, target = prediction.to(dtype), target.to(dtype)
    if mask is None:
        return prediction, target, torch.ones((), dtype=torch.bool, device=target.device).expand(target.shape)
    if mask.dtype != torch.bool:
        raise TypeError(f"mask must be bool, True where the target is known, got {mask.dtype}")
    if mask.ndim != 4 or any(side not in {1, whole} for side, whole in zip(mask.shape, target.shape, strict=True)):
        raise ValueError(f"mask must broadcast to the target's shape {tuple(target.shape)}, got {tuple(mask.shape)}")
    mask = mask.expand(target.shape)
    return torch.where(mask, prediction, filler), torch.where(mask, target, filler), mask
