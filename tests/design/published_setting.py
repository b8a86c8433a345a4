"""The published setting of depth masks, a point-sampled pupil and one FFT, and the design of the Fisher mask in it.

Bounds from these PSFs compare with published ones. They are about 5 % too low, for two reasons: real mask pixels have
a width and scatter light far out, which point samples do not; and light beyond the M x M pixels is aliased back.

Source: Wu et al., PhaseCam3D (ICCP 2019), section 3, for a mask designed in this way, with a bound of 0.0785 rad;
Shechtman et al., Physical Review Letters 113, 133902 (2014), for the resulting tetrapod PSF.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kornia_tidy.design import design
from kornia_tidy.design.fisher_information import PointResponse, defocus_bound, fisher_information
from kornia_tidy.masks import MASK_SPAN, ZernikeMask, mask_coordinates
from kornia_tidy.optics import circular_aperture


def sampled_response(
    phase: Tensor, aperture: Tensor, defocus: Sequence[float], samples: int = 64, weights: Tensor | None = None
) -> PointResponse:
    """Return PSFs of one channel, (D, 1, M, M), averaged over masks (K, N, N) of radians, and their derivatives."""
    count, size = phase.shape[0], phase.shape[-1]
    weights = phase.new_full((count,), 1 / count, dtype=torch.float64) if weights is None else weights.double()
    step = size / (samples * MASK_SPAN)
    x = mask_coordinates(size)
    u = (torch.arange(samples, dtype=torch.float64) - samples // 2) * step
    psi = torch.as_tensor(defocus, dtype=torch.float64)
    kernel = torch.exp(1j * (psi[:, None, None] * x**2 - 2 * math.pi * u[:, None] * x)) / math.sqrt(samples)
    k0, k1, k2 = (kernel[:, None] * x**moment for moment in (0, 1, 2))
    field = torch.polar(aperture.double().expand_as(phase), phase.double())
    wave, along_x, along_y = k0 @ field @ k0.mT, k0 @ field @ k1.mT, k1 @ field @ k0.mT
    defocused = 1j * (k2 @ field @ k0.mT + k0 @ field @ k2.mT)
    changes = torch.stack([defocused, 2j * math.pi * step * along_x, 2j * math.pi * step * along_y])
    shares = (weights / aperture.double().square().sum())[:, None, None]
    psfs = (shares * wave.abs().square()).sum(1, keepdim=True)
    return PointResponse(psfs, 2 * (shares * (wave.conj() * changes).real).sum(2, keepdim=True))


def design_fisher_mask(seed: int = 0, iterations: int = 150) -> tuple[ZernikeMask, float]:
    """Design a mask of 55 Zernike polynomials by its mean bound over -10 to 10 rad, and return it with that bound."""
    generator = torch.Generator().manual_seed(seed)
    start = 0.5 / math.sqrt(55) * torch.randn(55, generator=generator, dtype=torch.float32)
    mask = ZernikeMask(1, 23, 55, initial=start).double()
    aperture = circular_aperture(23, 0.1)
    nodes = torch.linspace(-10, 10, 21, dtype=torch.float64).tolist()

    def mean_bound() -> Tensor:
        return defocus_bound(fisher_information(sampled_response(mask.phase, aperture, nodes))).mean()

    design(mask, mean_bound, iterations, lr_metres=8.4e-9)
    return mask, float(mean_bound().detach())
