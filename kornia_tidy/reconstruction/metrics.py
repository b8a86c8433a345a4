"""Metrics of depth maps and all-in-focus images: one value per image, over its valid pixels.

The score of an image without a valid pixel is NaN, and a NaN at a valid pixel makes it NaN.

PSNR and SSIM are those of ``kornia.metrics``. torchmetrics gives the same PSNR, RMSE and relative error, but its
SSIM counts windows that reach over the border, and its metrics take no masks. It comes with the extra ``train`` only.
"""

from __future__ import annotations

import kornia
import torch
from torch import Tensor

from kornia_tidy.kernels.precision import safe_sqrt
from kornia_tidy.reconstruction.validity import valid_maps

SSIM_WINDOW = 11  # pixels; its weights are a Gaussian of sigma 1.5, as in Wang et al. 2004
PHASECAM3D_SPAN = 20.0  # radians; PhaseCam3D's maps span psi in [-10, 10], and its RMSE is in radians


def rmse(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    r"""Return the root mean squared error, :math:`\lVert x - \hat{x} \rVert_2 / \sqrt{N}`.

    Args:
        prediction: (B, C, H, W), in any unit.
        target: (B, C, H, W), in the same unit; anything, NaN included, where the mask is False.
        mask: bool (B, 1, H, W), True where the target is known. None: everywhere.

    Returns:
        (B,) in float32 or float64, in the unit of the maps; NaN for an image without a valid pixel.

    Raises:
        TypeError: if prediction or target are not floating point, or the mask is not bool.
        ValueError: if the shapes do not fit.

    Example:
        >>> rmse(torch.zeros(1, 1, 1, 2), torch.tensor([1.0, 7.0]).view(1, 1, 1, 2))
        tensor([5.])
    """
    prediction, target, mask = valid_maps(prediction, target, mask)
    return safe_sqrt(_mean((prediction - target).square(), mask))


def psnr(prediction: Tensor, target: Tensor, mask: Tensor | None = None, max_value: float = 1.0) -> Tensor:
    r"""Return the peak signal-to-noise ratio, :math:`20 \log_{10}(\mathrm{max} / \mathrm{RMSE})`.

    Args:
        prediction: as for :func:`rmse`.
        target: as for :func:`rmse`.
        mask: as for :func:`rmse`.
        max_value: the data range.

    Returns:
        (B,) in decibels; ``inf`` for equal images. The mean over images differs from the PSNR of their pooled error,
        which :func:`kornia.metrics.psnr` returns for a batch.

    Raises:
        TypeError: as :func:`rmse`.
        ValueError: as :func:`rmse`.

    Example:
        >>> psnr(torch.zeros(2, 3, 4, 4), torch.full((2, 3, 4, 4), 0.1))
        tensor([20., 20.])
    """
    prediction, target, mask = valid_maps(prediction, target, mask)
    images = zip(prediction, target, mask, strict=True)
    found = [kornia.metrics.psnr(image[seen], truth[seen], max_value) for image, truth, seen in images]
    return torch.stack(found) if found else target.new_empty(0)


def ssim(prediction: Tensor, target: Tensor, mask: Tensor | None = None, max_value: float = 1.0) -> Tensor:
    """Return the structural similarity: the mean over all windows of 11x11 pixels without a masked pixel.

    Args:
        prediction: as for :func:`rmse`, at least 11 pixels a side.
        target: as for :func:`rmse`.
        mask: as for :func:`rmse`.
        max_value: the data range.

    Returns:
        (B,) at most 1; NaN for an image without a valid window.

    Raises:
        TypeError: as :func:`rmse`.
        ValueError: as :func:`rmse`, or if the images are too small.

    Convention:
        Gaussian window of sigma 1.5, K1 = 0.01, K2 = 0.03, no padding: the reference implementation of Wang et al.
        without its downsampling of large images. Channels are averaged.

    Source: Wang et al., IEEE Transactions on Image Processing 13(4) 600 (2004).

    Example:
        >>> image = torch.rand(1, 3, 16, 16)
        >>> ssim(image, image)
        tensor([1.])
    """
    prediction, target, mask = valid_maps(prediction, target, mask)
    if min(target.shape[-2:]) < SSIM_WINDOW:
        raise ValueError(f"ssim needs images of at least {SSIM_WINDOW} pixels a side, got {tuple(target.shape[-2:])}")
    similarity = kornia.metrics.ssim(prediction, target, SSIM_WINDOW, float(max_value), eps=0.0, padding="valid")
    masked = torch.nn.functional.max_pool2d((~mask).to(similarity), SSIM_WINDOW, stride=1)  # 1: a masked pixel
    whole = masked == 0
    return _mean(torch.where(whole, similarity, 0), whole)


def abs_rel(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    r"""Return the mean relative error of depth, :math:`\frac{1}{N} \sum |z - \hat{z}| / z`.

    Args:
        prediction: depth as for :func:`rmse`.
        target: true depth z, positive and finite where valid.
        mask: as for :func:`rmse`.

    Returns:
        (B,), no unit; NaN for an image without a valid pixel.

    Raises:
        TypeError: as :func:`rmse`.
        ValueError: as :func:`rmse`, or if a valid true depth is not positive and finite.

    Example:
        >>> abs_rel(torch.full((1, 1, 1, 2), 3.0), torch.tensor([2.0, 4.0]).view(1, 1, 1, 2))
        tensor([0.3750])
    """
    prediction, target, mask = _valid_depths(prediction, target, mask)
    return _mean((prediction - target).abs() / target, mask)


def log10_error(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    r"""Return the mean logarithmic error of depth, :math:`\frac{1}{N} \sum |\log_{10} z - \log_{10} \hat{z}|`.

    Args:
        prediction: depth as for :func:`rmse`. Where it is zero or negative the error is infinite.
        target: as for :func:`abs_rel`.
        mask: as for :func:`rmse`.

    Returns:
        (B,) in decades, NaN as for :func:`abs_rel`; it raises as that does.

    Example:
        >>> log10_error(torch.full((1, 1, 1, 2), 10.0), torch.tensor([1.0, 10.0]).view(1, 1, 1, 2))
        tensor([0.5000])
    """
    prediction, target, mask = _valid_depths(prediction, target, mask)
    return _mean((prediction.clamp(min=0).log10() - target.log10()).abs(), mask)


def delta_accuracy(prediction: Tensor, target: Tensor, mask: Tensor | None = None, threshold: float = 1.25) -> Tensor:
    r"""Return the fraction of pixels with a depth right within a factor, :math:`\max(z/\hat{z}, \hat{z}/z) < t`.

    Args:
        prediction: depth as for :func:`rmse`. A pixel where it is zero or negative is wrong.
        target: as for :func:`abs_rel`.
        mask: as for :func:`rmse`.
        threshold: the factor t; 1.25, 1.25² and 1.25³ are usual.

    Returns:
        (B,) in [0, 1], NaN as for :func:`abs_rel`; it raises as that does. It has no gradient.

    Source: Eigen et al., NeurIPS 2014.

    Example:
        >>> delta_accuracy(torch.ones(1, 1, 1, 3), torch.tensor([0.9, 1.2, 1.3]).view(1, 1, 1, 3))
        tensor([0.6667])
    """
    prediction, target, mask = _valid_depths(prediction, target, mask)
    right = (prediction < threshold * target) & (target < threshold * prediction)  # no division by zero
    return _mean((right & mask).to(target), mask)


def depth_scores(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> dict[str, Tensor]:
    """Return all metrics of depth in metres: rmse, abs_rel, log10, delta1, delta2 and delta3, each (B,).

    Args:
        prediction: depth as for :func:`rmse`.
        target: as for :func:`abs_rel`.
        mask: as for :func:`rmse`.

    Raises:
        TypeError: as :func:`abs_rel`.
        ValueError: as :func:`abs_rel`.

    Example:
        >>> scores = depth_scores(torch.full((1, 1, 4, 4), 2.2), torch.full((1, 1, 4, 4), 2.0))
        >>> {name: round(value.item(), 4) for name, value in scores.items()}
        {'rmse': 0.2, 'abs_rel': 0.1, 'log10': 0.0414, 'delta1': 1.0, 'delta2': 1.0, 'delta3': 1.0}
    """
    maps = prediction, target, mask
    scores = {"rmse": rmse(*maps), "abs_rel": abs_rel(*maps), "log10": log10_error(*maps)}
    return scores | {f"delta{n}": delta_accuracy(*maps, threshold=1.25**n) for n in (1, 2, 3)}


def defocus_scores(
    prediction: Tensor, target: Tensor, mask: Tensor | None = None, span: float = PHASECAM3D_SPAN
) -> dict[str, Tensor]:
    """Return the RMSE of normalised defocus maps in [0, 1] and in radians, the two units used in papers.

    Args:
        prediction: (B, 1, H, W), normalised to [0, 1].
        target: (B, 1, H, W), normalised to [0, 1].
        mask: as for :func:`rmse`.
        span: radians of defocus between 0 and 1: 20 for PhaseCam3D's range, 40 for the TiDy paper's.

    Returns:
        ``rmse_unit``, the RMSE of the maps, and ``rmse_radians``, ``span`` times as large; each (B,).

    Convention:
        PhaseCam3D reports radians with a span of 20: its 0.521 rad are 0.026 in [0, 1].

    Raises:
        TypeError: as :func:`rmse`.
        ValueError: as :func:`rmse`.

    Example:
        >>> defocus_scores(torch.full((1, 1, 4, 4), 0.55), torch.full((1, 1, 4, 4), 0.5))
        {'rmse_unit': tensor([0.0500]), 'rmse_radians': tensor([1.0000])}
    """
    unit = rmse(prediction, target, mask)
    return {"rmse_unit": unit, "rmse_radians": span * unit}


def image_scores(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> dict[str, Tensor]:
    """Return the metrics of images in [0, 1]: rmse, psnr and ssim, each (B,).

    Args:
        prediction: as for :func:`ssim`.
        target: as for :func:`ssim`.
        mask: as for :func:`ssim`.

    Raises:
        TypeError: as :func:`ssim`.
        ValueError: as :func:`ssim`.

    Example:
        >>> sorted(image_scores(torch.rand(1, 3, 16, 16), torch.rand(1, 3, 16, 16)))
        ['psnr', 'rmse', 'ssim']
    """
    maps = prediction, target, mask
    return {"rmse": rmse(*maps), "psnr": psnr(*maps), "ssim": ssim(*maps)}


def _valid_depths(prediction: Tensor, target: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Return :func:`valid_maps` with masked depths of 1, after a check of valid depths that waits for the device."""
    prediction, target, mask = valid_maps(prediction, target, mask, filler=1.0)
    good = (target > 0) & target.isfinite()
    if not bool(good.all()):
        bad = target[~good][0].item()
        raise ValueError(f"valid true depths must be positive and finite, got {bad} (mark holes in the mask)")
    return prediction, target, mask


def _mean(error: Tensor, mask: Tensor) -> Tensor:
    """Return the mean of an error, zero where masked, over each image; NaN for an image without valid pixels."""
    count = mask.flatten(1).sum(1)
    return torch.where(count > 0, error.flatten(1).sum(1) / count.clamp(min=1), torch.nan)
