"""Reliability of estimated uncertainties: predicted against found errors, and the error of the surest pixels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_tidy.reconstruction.validity import valid_maps


class ReliabilityCurve(NamedTuple):
    """Predicted and found errors in bins of equally many pixels, from the surest to the least sure; each (bins,)."""

    predicted: Tensor
    """Root mean square of the predicted standard deviations."""
    found: Tensor
    """Root mean squared error."""

    def calibration_error(self) -> float:
        r"""Return the mean relative difference, :math:`\frac{1}{n} \sum |found - predicted| / predicted`.

        Source: Levi et al., Evaluating and Calibrating Uncertainty Prediction in Regression Tasks (Sensors 2022).

        Example:
            >>> ReliabilityCurve(torch.tensor([0.5, 1.0]), torch.tensor([0.5, 1.5])).calibration_error()
            0.25
        """
        least = torch.finfo(self.predicted.dtype).tiny  # a prediction of no error is right where none is found
        return float(((self.found - self.predicted).abs() / self.predicted.clamp(min=least)).mean())


def reliability_curve(
    prediction: Tensor, deviation: Tensor, target: Tensor, mask: Tensor | None = None, bins: int = 10
) -> ReliabilityCurve:
    """Return found errors over predicted ones: both are equal if the uncertainty is calibrated.

    Args:
        prediction: (B, 1, H, W), in any unit.
        deviation: (B, 1, H, W), the predicted standard deviation, in the same unit.
        target: (B, 1, H, W); anything, NaN included, where the mask is False.
        mask: bool (B, 1, H, W), True where the target is known. None: everywhere.
        bins: number of bins, each of equally many pixels; no more than there are pixels.

    Raises:
        TypeError: if maps are not floating point, or the mask is not bool.
        ValueError: if shapes do not fit, or there are fewer known pixels than bins.

    Example:
        >>> noise = torch.randn(1, 1, 100, 100, generator=torch.Generator().manual_seed(0))
        >>> sigma = torch.linspace(0.1, 0.2, 100).expand(1, 1, 100, 100)
        >>> reliability_curve(noise * sigma, sigma, torch.zeros(1, 1, 100, 100)).calibration_error() < 0.05
        True
    """
    errors, deviations = _surest_first(prediction, deviation, target, mask)
    if not 0 < bins <= len(errors):
        raise ValueError(f"bins must be from 1 to the {len(errors)} pixels of known depth, got {bins}")
    parts = zip(deviations.tensor_split(bins), errors.tensor_split(bins), strict=True)
    predicted, found = zip(*((p.square().mean().sqrt(), f.square().mean().sqrt()) for p, f in parts), strict=True)
    return ReliabilityCurve(torch.stack(predicted), torch.stack(found))


def sparsification_curve(
    prediction: Tensor, deviation: Tensor, target: Tensor, mask: Tensor | None = None, *, shares: Sequence[float]
) -> Tensor:
    """Return the root mean squared error over the surest part of the pixels.

    Args:
        prediction: as for :func:`reliability_curve`.
        deviation: as for :func:`reliability_curve`.
        target: as for :func:`reliability_curve`.
        mask: as for :func:`reliability_curve`.
        shares: parts of the known pixels, each above 0 and at most 1.

    Returns:
        (len(shares),), in the unit of the maps. With the absolute error as ``deviation`` it is the lowest possible.

    Raises:
        TypeError: as :func:`reliability_curve`.
        ValueError: as :func:`reliability_curve`, if a share is not allowed, or if no pixel is known.

    Source: Ilg et al., Uncertainty Estimates and Multi-Hypotheses Networks for Optical Flow (ECCV 2018).

    Example:
        >>> error = torch.tensor([1.0, 2.0, 7.0]).view(1, 1, 1, 3)
        >>> sparsification_curve(error, torch.tensor([0.1, 0.2, 0.9]).view(1, 1, 1, 3), 0 * error, shares=(0.3, 1.0))
        tensor([1.0000, 4.2426])
    """
    if bad := [share for share in shares if not 0 < share <= 1]:
        raise ValueError(f"shares must be above 0 and at most 1, got {bad[0]}")
    errors, _ = _surest_first(prediction, deviation, target, mask)
    if not len(errors):
        raise ValueError("the surest pixels are taken from those of known depth, and there are none")
    squares = errors.square().double().cumsum(0)
    counts = [max(1, round(share * len(errors))) for share in shares]
    counts = torch.tensor(counts, dtype=torch.int64, device=errors.device)
    return (squares[counts - 1] / counts).sqrt().to(errors.dtype)


def _surest_first(prediction: Tensor, deviation: Tensor, target: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return the errors and the deviations of the known pixels in the order of the deviations."""
    deviation, _, _ = valid_maps(deviation, prediction)
    prediction, target, mask = valid_maps(prediction, target, mask)
    deviation, order = deviation.detach()[mask].sort(stable=True)
    return (prediction - target).detach()[mask][order], deviation
