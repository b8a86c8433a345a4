"""Depth as a distribution over classes: mean, standard deviation, soft targets, loss and temperature.

Classes are evenly spaced over normalised inverse depth, from 0 (far end of the range) to 1 (near end). Where a capture
does not show the depth, as on a blank wall, the distribution is wide and its standard deviation says so.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kornia_tidy.checks import check_float_tensor
from kornia_tidy.kernels.precision import safe_sqrt
from kornia_tidy.reconstruction.validity import valid_maps

ERROR_WEIGHT = 10.0  # of the ranked probability score: both terms are then of order one
_COLDEST, _HOTTEST = 1 / 32, 32.0  # limits of a fitted temperature
_HALVINGS = 40


def depth_moments(logits: Tensor) -> tuple[Tensor, Tensor]:
    r"""Return the mean and the standard deviation of a distribution of depth, with resolution below one class.

    .. math:: \mu = \sum_k p_k c_k, \quad \sigma^2 = \sum_k p_k (c_k - \mu)^2, \quad c_k = k / (D - 1)

    Args:
        logits: (B, D, H, W), logarithms of the probabilities up to a constant, D at least 2.

    Returns:
        Mean and standard deviation, each (B, 1, H, W) in float32 or float64, in parts of the range. A uniform
        distribution has a deviation of :math:`1 / \sqrt{12}` and a little more.

    Raises:
        TypeError: if the logits are not floating point.
        ValueError: if their shape is another.

    Example:
        >>> mean, deviation = depth_moments(torch.tensor([0.0, 0.0, -50.0]).view(1, 3, 1, 1))
        >>> mean.item(), deviation.item()
        (0.25, 0.25)
    """
    _check_logits(logits)
    probabilities = _precise(logits).softmax(1)
    centres = _centres(probabilities)
    mean = (probabilities * centres).sum(1, keepdim=True)
    return mean, safe_sqrt((probabilities * (centres - mean).square()).sum(1, keepdim=True))


def layer_weights(logits: Tensor, layers: int) -> Tensor:
    """Return the probability of each depth layer: that of the classes, distributed linearly to the nearest two layers.

    Args:
        logits: as for :func:`depth_moments`.
        layers: number L of layers, evenly spaced over the same range as the classes.

    Returns:
        (B, L, H, W), not negative; they sum to one, and their mean depth is that of the distribution.

    Example:
        >>> layer_weights(torch.tensor([-50.0, 0.0, -50.0]).view(1, 3, 1, 1), 2).flatten()
        tensor([0.5000, 0.5000])
    """
    _check_logits(logits)
    probabilities = _precise(logits).softmax(1)
    centres = _centres(probabilities).view(1, 1, 1, -1)
    with torch.autocast(logits.device.type, enabled=False):  # the weights would no longer sum to one
        return torch.einsum("lk,bkhw->blhw", soft_targets(centres, layers)[0, :, 0], probabilities)


def interpolated_classes(maps: Tensor, classes: int) -> Tensor:
    """Return maps of evenly spaced layers, linearly interpolated to classes over the same range.

    Args:
        maps: (B, L, H, W).
        classes: number D, at least 2.

    Returns:
        (B, D, H, W).

    Example:
        >>> interpolated_classes(torch.tensor([0.0, 1.0]).view(1, 2, 1, 1), 3).flatten()
        tensor([0.0000, 0.5000, 1.0000])
    """
    centres = torch.linspace(0, 1, classes, dtype=maps.dtype, device=maps.device).view(1, 1, 1, -1)
    with torch.autocast(maps.device.type, enabled=False):
        return torch.einsum("lk,blhw->bkhw", soft_targets(centres, maps.shape[1])[0, :, 0], maps)


def soft_targets(depth: Tensor, classes: int) -> Tensor:
    """Return the distribution of a known depth: the two nearest classes, weighted so that their mean is the depth.

    Args:
        depth: (B, 1, H, W), normalised inverse depth; clamped to [0, 1].
        classes: number D, at least 2.

    Returns:
        (B, D, H, W).

    Example:
        >>> soft_targets(torch.full((1, 1, 1, 1), 0.2), 3).flatten()
        tensor([0.6000, 0.4000, 0.0000])
    """
    steps = torch.arange(classes, dtype=depth.dtype, device=depth.device).view(-1, 1, 1)
    return (1 - (depth.clamp(0, 1) * (classes - 1) - steps).abs()).clamp(min=0)


def distribution_loss(logits: Tensor, depth: Tensor, mask: Tensor | None = None) -> Tensor:
    r"""Return the loss of a distribution of depth: cross-entropy with soft targets plus ranked probability score.

    .. math:: L = \frac{1}{N} \sum_{x} \Big[ -\sum_k q_k \log p_k
                + \frac{\lambda}{D - 1} \sum_k \Big( \sum_{j \le k} p_j - q_j \Big)^2 \Big]

    The cross-entropy makes probabilities true. The ranked probability score is the expected absolute error minus half
    the expected difference of two draws: a distribution near the depth costs less than one far away. Both are proper
    scores: they are least for the true distribution, so that the uncertainty is not trained away.

    Args:
        logits: (B, D, H, W).
        depth: (B, 1, H, W), normalised inverse depth; anything, NaN included, where the mask is False.
        mask: bool (B, 1, H, W), True where the depth is known. None: everywhere.

    Returns:
        A scalar in float32 or float64, with :math:`\lambda = 10`; N counts the valid pixels of the whole batch.
        Without any it is zero, with zero gradients.

    Raises:
        TypeError: if logits or depth are not floating point, or the mask is not bool.
        ValueError: if shapes do not fit.

    Source: Gneiting and Raftery, Strictly Proper Scoring Rules (JASA 2007), 4.2; soft targets as in Diaz and Marathe,
    Soft Labels for Ordinal Regression (CVPR 2019).

    Example:
        >>> depth = torch.full((1, 1, 1, 1), 0.5)
        >>> distribution_loss(torch.tensor([-99.0, 0.0, -99.0]).view(1, 3, 1, 1), depth)
        tensor(0.)
    """
    _check_logits(logits)
    _, depth, mask = valid_maps(logits[:, :1], depth, mask)
    classes = logits.shape[1]
    log_probabilities = _precise(logits.where(mask, 0)).log_softmax(1)
    targets = soft_targets(depth, classes)
    entropy = -(targets * log_probabilities).sum(1, keepdim=True)
    excess = (log_probabilities.exp() - targets).cumsum(1)
    score = excess.square().sum(1, keepdim=True) / (classes - 1)
    return torch.where(mask, entropy + ERROR_WEIGHT * score, 0).sum() / mask.sum().clamp(min=1)


@torch.no_grad()
def fit_temperature(logits: Tensor, depth: Tensor, mask: Tensor | None = None) -> float:
    r"""Fit the temperature T of distributions :math:`p \propto e^{z / T}` to known depths by maximum likelihood.

    It is the one parameter of a recalibration: above 1 the distributions were too narrow, below 1 too wide. The
    likelihood is concave in 1 / T, so that halving an interval finds its maximum.

    Args:
        logits: z, (B, D, H, W), of scenes that the network was not trained on.
        depth: as for :func:`distribution_loss`.
        mask: as for :func:`distribution_loss`.

    Returns:
        A number from 1/32 to 32; 1 if no depth is known.

    Raises:
        TypeError: as :func:`distribution_loss`.
        ValueError: as :func:`distribution_loss`.

    Source: Guo et al., On Calibration of Modern Neural Networks (ICML 2017), 4.2.

    Example:
        >>> logits = torch.tensor([3.0, 0.0]).view(1, 2, 1, 1).expand(1, 2, 1, 4)  # sure of 0
        >>> depth = torch.tensor([0.0, 0.0, 0.0, 1.0]).view(1, 1, 1, 4)  # one in four is 1: log 3 would be right
        >>> round(fit_temperature(logits, depth), 4)
        2.7307
    """
    _check_logits(logits)
    _, depth, mask = valid_maps(logits[:, :1], depth, mask)
    known = mask[:, 0]
    scores = _precise(logits).movedim(1, -1)[known].double()
    if not len(scores):
        return 1.0
    expected = (soft_targets(depth, logits.shape[1]).movedim(1, -1)[known] * scores).sum(-1)
    low, high = math.log(1 / _HOTTEST), math.log(1 / _COLDEST)
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        rise = expected - ((scores * math.exp(middle)).softmax(-1) * scores).sum(-1)  # of the log likelihood with 1 / T
        low, high = (middle, high) if rise.sum() > 0 else (low, middle)
    return math.exp(-(low + high) / 2)


def _centres(like: Tensor) -> Tensor:
    return torch.linspace(0, 1, like.shape[1], dtype=like.dtype, device=like.device).view(-1, 1, 1)


def _precise(tensor: Tensor) -> Tensor:
    return tensor.to(torch.promote_types(tensor.dtype, torch.float32))


def _check_logits(logits: Tensor) -> None:
    check_float_tensor("logits", logits, 4, "(B, D, H, W)")
    if logits.shape[1] < 2:
        raise ValueError(f"a distribution needs 2 classes or more, got logits {tuple(logits.shape)}")
