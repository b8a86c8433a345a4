"""Convolution of images with several large kernels, by Fourier transform, or by strided convolutions where exported."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from kornia_tidy.mode import Mode, torch_mode
from kornia_tidy.render.borders import from_spectrum, pad_border, to_spectrum

STEP = 4  # pixels of the output along a side that one strided convolution computes together


def convolve_kernels(image: Tensor, kernels: Tensor) -> Tensor:
    r"""Convolve each channel of an image with its own kernels, with padded borders.

    .. math:: z_{dc} = k_{dc} * x_c

    Compiled and exported graphs have no complex numbers, and ``torch.vmap`` shows no values. There :math:`s^2`
    neighbouring pixels are computed by one convolution of stride s with shifted copies of the kernels, as a matrix
    product that is large enough to be fast.

    Args:
        image: (B, C, H, W), float32 or float64.
        kernels: (D, C, P, P) with P odd; the centre has the index P // 2.

    Returns:
        (B, D, C, H, W). NaN spreads over the window of the kernels and no farther.

    Convention:
        Borders are reflected; if a side is too short for that, its outermost pixel is repeated.

    Example:
        >>> shift = torch.zeros(1, 1, 3, 3)
        >>> shift[0, 0, 1, 2] = 1.0  # moves the image to the right
        >>> convolve_kernels(torch.tensor([[[[1.0, 2.0, 3.0]]]]), shift).round(decimals=4).flatten()
        tensor([1., 1., 2.])
    """
    radius = kernels.shape[-1] // 2
    padded = pad_border(image, radius, "reflect" if radius < min(image.shape[-2:]) else "replicate")
    if Mode.GRAPH in torch_mode():
        return _strided(padded, kernels, (image.shape[-2], image.shape[-1]))
    window = kernels.shape[-1]
    unknown = padded.isnan()
    if marked := bool(unknown.any()):  # a transform would spread NaN over the whole picture
        padded = padded.where(~unknown, 0)
    size = padded.shape[-2], padded.shape[-1]
    spectrum = to_spectrum(padded, size).unsqueeze(1)
    # Without gradients, as for large pictures, one kernel at a time takes a fraction of the memory.
    together = len(kernels) if torch.is_grad_enabled() else 1
    parts = [from_spectrum(spectrum * to_spectrum(some, size), size, window) for some in kernels.split(together)]
    convolved = torch.cat(parts, 1)
    if marked:
        reached = functional.max_pool2d(unknown.to(padded.dtype), (1, window), 1)  # then down: P^2 values take long
        reached = functional.max_pool2d(reached, (window, 1), 1) > 0
        convolved = convolved.masked_fill(reached.unsqueeze(1), torch.nan)
    return convolved


def _strided(padded: Tensor, kernels: Tensor, size: tuple[int, int]) -> Tensor:
    """Convolve a padded image by one convolution of stride ``STEP``."""
    missing = [-side % STEP for side in size]
    padded = functional.pad(padded, (0, missing[1], 0, missing[0]))
    flipped = kernels.flip((-2, -1)).transpose(0, 1).unsqueeze(2)  # (C, D, 1, P, P)
    shifts = [
        functional.pad(flipped, (across, STEP - 1 - across, down, STEP - 1 - down))
        for down in range(STEP)
        for across in range(STEP)
    ]
    weight = torch.cat(shifts, 2).flatten(0, 2).unsqueeze(1)  # (C D STEP^2, 1, P + STEP - 1, P + STEP - 1)
    phases = functional.conv2d(padded, weight, stride=STEP, groups=kernels.shape[1])
    maps = functional.pixel_shuffle(phases, STEP)[..., : size[0], : size[1]]
    return maps.unflatten(1, (kernels.shape[1], kernels.shape[0])).transpose(1, 2)
