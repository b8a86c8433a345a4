"""Losses of depth maps and all-in-focus images over valid pixels.

Each is a mean over all valid samples of the batch; those in :mod:`kornia_tidy.reconstruction.metrics` are means over
each image. Gradients of masked pixels are exactly zero.
"""

from __future__ import annotations

import torch
from torch import Tensor

from kornia_tidy.kernels.precision import safe_sqrt
from kornia_tidy.reconstruction.validity import valid_maps

PHASECAM3D_WEIGHT = 20.0  # of the RMSE, relative to the gradient loss


def mse_loss(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    r"""Return the mean squared error, the paper's loss for depth maps and for all-in-focus images.

    .. math:: L = \frac{1}{N} \lVert x - \hat{x} \rVert_2^2

    Args:
        prediction: (B, C, H, W), in any unit.
        target: (B, C, H, W), in the same unit; anything, NaN included, where the mask is False.
        mask: bool (B, 1, H, W), True where the target is known. None: everywhere.

    Returns:
        A scalar in float32 or float64, in the unit squared; N counts the valid samples of the whole batch.

    Raises:
        TypeError: if prediction or target are not floating point, or the mask is not bool.
        ValueError: if shapes do not fit, or the mask is False everywhere, a check that waits for the device. Compiled
            code does not check the mask, and returns zero with zero gradients then.

    Source: Shah et al., TiDy-PSFs, ICCV 2023.

    Example:
        >>> depth = torch.tensor([2.0, float("nan")]).view(1, 1, 1, 2)
        >>> mse_loss(torch.ones(1, 1, 1, 2), depth, ~depth.isnan())
        tensor(1.)
    """
    prediction, target, mask = valid_maps(prediction, target, mask)
    return _mean((prediction - target).square(), mask)


def l1_loss(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    r"""Return the mean absolute error, the loss of Ikoma et al. for depth maps.

    .. math:: L = \frac{1}{N} \lVert x - \hat{x} \rVert_1

    Args:
        prediction: as for :func:`mse_loss`.
        target: as for :func:`mse_loss`.
        mask: as for :func:`mse_loss`.

    Returns:
        A scalar in the unit of the maps; it raises as :func:`mse_loss` does. Its gradient is zero where both are equal.

    Source: Ikoma et al., Depth from Defocus with Learned Optics, ICCP 2021.

    Example:
        >>> l1_loss(torch.ones(1, 1, 1, 2), torch.tensor([2.0, -1.0]).view(1, 1, 1, 2))
        tensor(1.5000)
    """
    prediction, target, mask = valid_maps(prediction, target, mask)
    return _mean((prediction - target).abs(), mask)


def rmse_loss(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    r"""Return the root mean squared error, PhaseCam3D's loss of depth maps.

    .. math:: L = \frac{1}{\sqrt{N}} \lVert x - \hat{x} \rVert_2

    Args:
        prediction: as for :func:`mse_loss`.
        target: as for :func:`mse_loss`. PhaseCam3D's maps are in [0, 1] and it weights this loss by 20.
        mask: as for :func:`mse_loss`.

    Returns:
        A scalar in the unit of the maps; it raises as :func:`mse_loss` does. Its gradient is zero where both are equal.

    Source: Wu et al., PhaseCam3D, ICCP 2019.

    Example:
        >>> rmse_loss(torch.zeros(1, 1, 1, 2), torch.tensor([1.0, 7.0]).view(1, 1, 1, 2))
        tensor(5.)
    """
    return safe_sqrt(mse_loss(prediction, target, mask))


def gradient_loss(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    r"""Return the root mean squared difference of two maps' gradients, PhaseCam3D's loss for sharp depth edges.

    .. math:: L = \frac{1}{\sqrt{N_x}} \lVert \partial_x x - \partial_x \hat{x} \rVert_2
                + \frac{1}{\sqrt{N_y}} \lVert \partial_y x - \partial_y \hat{x} \rVert_2

    Derivatives are differences of neighbouring pixels that are both valid; N counts these pairs.

    Args:
        prediction: as for :func:`mse_loss`, at least two pixels a side.
        target: as for :func:`mse_loss`.
        mask: as for :func:`mse_loss`.

    Returns:
        A scalar in the unit of the maps per pixel; a constant offset does not change it.

    Raises:
        TypeError: as :func:`mse_loss`.
        ValueError: as :func:`mse_loss`, or if along one axis no two neighbours are both valid.

    Source: Wu et al., PhaseCam3D, ICCP 2019.

    Example:
        >>> ramp = torch.arange(4.0).expand(1, 1, 4, 4)
        >>> gradient_loss(3 * ramp + 7, ramp)
        tensor(2.)
    """
    prediction, target, mask = valid_maps(prediction, target, mask)
    error, loss = prediction - target, prediction.new_zeros(())
    for axis, name in ((-1, "beside"), (-2, "above")):
        pairs = mask.narrow(axis, 1, mask.shape[axis] - 1) & mask.narrow(axis, 0, mask.shape[axis] - 1)
        squares = torch.where(pairs, error.diff(dim=axis), 0).square()
        loss = loss + safe_sqrt(_mean(squares, pairs, f"pair of pixels {name} each other"))
    return loss


def phasecam3d_loss(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    r"""Return PhaseCam3D's loss of a map: 20 times :func:`rmse_loss` plus :func:`gradient_loss`.

    Args:
        prediction: as for :func:`gradient_loss`, in [0, 1].
        target: as for :func:`gradient_loss`, in [0, 1].
        mask: as for :func:`gradient_loss`.

    Returns:
        A scalar; it raises as :func:`gradient_loss` does.

    Source: Wu et al., PhaseCam3D, ICCP 2019.

    Example:
        >>> phasecam3d_loss(torch.full((1, 1, 4, 4), 0.55), torch.full((1, 1, 4, 4), 0.5))
        tensor(1.0000)
    """
    return PHASECAM3D_WEIGHT * rmse_loss(prediction, target, mask) + gradient_loss(prediction, target, mask)


def _mean(error: Tensor, mask: Tensor, sample: str = "pixel") -> Tensor:
    """Return the mean of an error over the valid samples; it must be zero at the others."""
    count = mask.sum()
    if not torch.compiler.is_compiling() and not bool(count):
        raise ValueError(f"a loss needs at least one valid {sample}, got a mask {tuple(mask.shape)} with none")
    return error.sum() / count.clamp(min=1)
