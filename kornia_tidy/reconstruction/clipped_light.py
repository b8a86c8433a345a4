"""Light beyond full scale: an estimate for clipped pixels from the pixels around them."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from kornia_tidy.mode import Mode, torch_mode

CLIPPED = 0.999  # of full scale: a pixel at or above it holds no more than that its light was at least so much
# The excess is e d / (d + DOUBT s (1 - b)) with e = b m (NEARLY a - HALFWAY b) + AMONG c^3 - COLORS c k + LEVEL. Here
# a, b and c are the shares of clipped pixels within NEAR, WIDER and FAR, m by how much the known ones within WIDER fall
# short of full scale, d = m (1 - b), k the number of colours of the pixel that are known, and s the noise, which lifts
# pixels to full scale too. The numbers of e are from regression over 50,000 pixels of overexposed photographs behind
# cameras of training, of an excess of at most MOST. On others its error is .097; that of a line in a and m is .107,
# that of no excess .232.
NEARLY, HALFWAY, AMONG, COLORS, LEVEL, DOUBT, MOST = 3.77, 3.25, 0.405, 0.062, 0.016, 6.0, 0.5
NEAR, WIDER, FAR = 1.5, 3.0, 6.0  # px, of Gaussian weights
REACH = 15  # px, how far a pixel's neighbours reach
LEAST = 1e-4  # of d: far from known pixels nothing is doubted


def beyond_full_scale(light: Tensor, noise: Tensor | float) -> Tensor:
    """Return light whose clipped pixels have their expected excess over full scale.

    A pixel that is clipped in the middle of others, or beside much darker ones, is brighter than one that noise lifts
    to full scale. So a deconvolution rings less around clipped places. Where the known pixels about fall short of full
    scale by no more than the noise, hardly any excess is expected.

    Args:
        light: (B, C, H, W), linear, full scale 1.
        noise: standard deviation in linear light, a number or (B, 1, 1, 1).

    Returns:
        Light of the same shape, at most 1.5 where it was clipped. Light above full scale is known, and stays.

    Source: Knutsson and Westin, Normalized and differential convolution (CVPR 1993), for the mean of known pixels.

    Example:
        >>> seen = torch.linspace(0.0, 1.5, 64).expand(1, 1, 8, 64).clamp(max=1)
        >>> found = beyond_full_scale(seen, 0.01)
        >>> bool((found[..., :40] == seen[..., :40]).all()), bool((found[..., 48:] > 1.1).all())
        (True, True)
    """
    clipped = _clipped(light)
    if Mode.GRAPH not in torch_mode() and not clipped.any():
        return light
    known = (~clipped).to(light)
    close, around, far = (1 - _near(known, sigma) for sigma in (NEAR, WIDER, FAR))
    sum_short = _near(known * (1 - light), WIDER)
    short = sum_short / (1 - around).clamp(min=1e-3)
    by_border = around * short * (NEARLY * close - HALFWAY * around)
    by_place = AMONG * far**3 - COLORS * far * known.sum(1, keepdim=True) + LEVEL
    sure = (sum_short + LEAST) / (sum_short + DOUBT * noise * (1 - around) + LEAST)
    excess = sure * (by_border + by_place)
    return torch.where(clipped, 1 + excess.clamp(0.0, MOST), light)  # ends of one type for ONNX


def clipped_share(capture: Tensor) -> Tensor:
    """Return the share of the pixels about each that are clipped in any colour, (B, C, H, W) to (B, 1, H, W).

    Example:
        >>> seen = torch.zeros(1, 3, 5, 40)
        >>> seen[..., 20:] = 1.0
        >>> clipped_share(seen)[0, 0, 0, [0, 19, 20, 39]].round(decimals=1)
        tensor([0.0000, 0.4000, 0.6000, 1.0000])
    """
    return _near(_clipped(capture).any(1, keepdim=True).to(capture), NEAR)


def _clipped(light: Tensor) -> Tensor:
    return (light - 1).abs() <= 1 - CLIPPED


def _near(values: Tensor, sigma: float) -> Tensor:
    """Return means over the neighbours by Gaussian weights."""
    radius = round(2.5 * sigma)
    place = torch.arange(-radius, radius + 1, dtype=values.dtype, device=values.device)
    weights = (-0.5 * (place / sigma).square()).softmax(0)
    padded = functional.pad(values, (radius,) * 4, "replicate")
    if Mode.GRAPH not in torch_mode():
        padded = padded.contiguous(memory_format=torch.channels_last)  # a sixth of the time on a processor
    count = values.shape[1]
    rows = functional.conv2d(padded, weights.expand(count, 1, 1, -1), groups=count)
    return functional.conv2d(rows, weights[:, None].expand(count, 1, -1, 1), groups=count)
