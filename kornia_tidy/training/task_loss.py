"""Losses by name, and the weighted loss of a task's maps."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from torch import Tensor

from kornia_tidy.reconstruction.depth_distribution import distribution_loss
from kornia_tidy.reconstruction.losses import l1_loss, mse_loss, phasecam3d_loss
from kornia_tidy.reconstruction.metrics import ssim
from kornia_tidy.reconstruction.validity import valid_maps

Loss = Callable[[Tensor, Tensor, Tensor | None], Tensor]
"""From prediction (B, C, H, W), target (B, C, H, W) and validity mask, bool (B, 1, H, W) or None, to a scalar."""

CHARBONNIER_EPSILON = 1e-3
LEAST_MSE = 1e-5  # 50 dB: above it blank images gain little
SSIM_WEIGHT = 20.0  # dB of PSNR that weigh as much as a unit of SSIM


def charbonnier_loss(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    r"""Return the Charbonnier loss, an absolute error that is smooth at zero and so less sensitive to outliers.

    .. math:: L = \frac{1}{N} \sum \sqrt{(x - \hat{x})^2 + \epsilon^2}, \quad \epsilon = 10^{-3}

    Args:
        prediction: (B, C, H, W), in [0, 1].
        target: (B, C, H, W); anything, NaN included, where the mask is False.
        mask: bool (B, 1, H, W), True where the target is known. None: everywhere.

    Returns:
        A scalar; N counts the valid samples. Zero if there are none.

    Convention:
        kornia's ``charbonnier_loss`` has :math:`\epsilon = 1`, and so is a squared error for images in [0, 1].

    Source: Lai et al., Deep Laplacian Pyramid Networks (CVPR 2017), equation 2.

    Example:
        >>> import torch
        >>> charbonnier_loss(torch.zeros(1, 1, 1, 2), torch.tensor([0.0, 0.5]).view(1, 1, 1, 2))
        tensor(0.2505)
    """
    prediction, target, mask = valid_maps(prediction, target, mask)
    error = ((prediction - target).square() + CHARBONNIER_EPSILON**2).sqrt()
    return (error * mask).sum() / mask.sum().clamp(min=1)


def psnr_ssim_loss(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    r"""Return the negative PSNR plus structural dissimilarity, the score of restored images.

    .. math:: L = 10 \log_{10}(\mathrm{MSE} + 10^{-5}) + 20 \, (1 - \mathrm{SSIM})

    An absolute or squared error is that of the few images with most of it; this is a mean over images of decibels, in
    which a smooth image counts as much as a textured one.

    Args:
        prediction: (B, C, H, W), in [0, 1], at least 11 pixels a side.
        target: (B, C, H, W); anything, NaN included, where the mask is False.
        mask: bool (B, 1, H, W), True where the target is known. None: everywhere. Both maps are taken for equal where
            it is not.

    Returns:
        A scalar, the mean over images.

    Raises:
        ValueError: if maps are smaller than 11 pixels.

    Source: Chen et al., Simple Baselines for Image Restoration (ECCV 2022), for the PSNR as a loss; Zhao et al., Loss
    Functions for Image Restoration With Neural Networks (IEEE TCI 2017), for the added SSIM.

    Example:
        >>> import torch
        >>> psnr_ssim_loss(torch.full((1, 3, 16, 16), 0.5), torch.full((1, 3, 16, 16), 0.5))
        tensor(-50.)
    """
    prediction, target, mask = valid_maps(prediction, target, mask)
    squared = (prediction - target).square().sum((1, 2, 3)) / mask.sum((1, 2, 3)).clamp(min=1)
    return (10 * (squared + LEAST_MSE).log10() + SSIM_WEIGHT * (1 - ssim(prediction, target))).mean()


# That of TiDy-PSFs, of Ikoma et al. for depth, of PhaseCam3D for depth, and two of restoration networks. Each is
# applied to every map of a task.
LOSSES: dict[str, Loss] = {
    "mse": mse_loss,
    "l1": l1_loss,
    "phasecam3d": phasecam3d_loss,
    "charbonnier": charbonnier_loss,
    "psnr-ssim": psnr_ssim_loss,
}


def task_loss(
    loss: Loss,
    estimate: Mapping[str, Tensor],
    truth: Mapping[str, Tensor],
    mask: Tensor,
    weights: Mapping[str, float],
    logits: Tensor | None = None,
) -> Tensor:
    """Return the weighted sum of the losses of a task's maps.

    Args:
        loss: of one map.
        estimate: maps by name, each (B, C, H, W).
        truth: the true maps by name.
        mask: bool (B, 1, H, W), True where depth is known. The image is known everywhere.
        weights: factor of each map's loss by name.
        logits: those of the distribution of depth, (B, D, H, W), if the network estimates one. The loss of depth is
            then :func:`~kornia_tidy.reconstruction.depth_distribution.distribution_loss` instead of ``loss``.

    Convention:
        The depth loss of a batch without any known depth, such as a crop inside a hole, is zero.
    """
    terms = []
    for name, maps in estimate.items():
        if name == "depth" and logits is not None:
            terms.append(weights[name] * distribution_loss(logits, truth[name], mask))
        elif name == "depth" and not bool(mask.any()):
            terms.append(0 * maps.sum())
        else:
            terms.append(weights[name] * loss(maps, truth[name], mask if name == "depth" else None))
    return sum(terms[1:], terms[0])
