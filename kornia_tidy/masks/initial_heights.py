"""What sequences of masks start from: noise, a mask designed for depth, mixtures of the two, and lenses."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kornia_tidy.checks import check_choice, check_generator
from kornia_tidy.masks.base import mask_axes
from kornia_tidy.masks.pixelwise import PixelwiseMask
from kornia_tidy.masks.zernike import ZernikeMask
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH

CLEAN = {"noisy fishers": 0, "fisher, noisy fishers": 1, "3 fishers, 2 noisy": 3}  # Fisher masks without noise
STARTS = ("noise", "fisher, noise", *CLEAN, "like fishers", "focal sweep")

NOISE_MEAN, NOISE_STD = 5.35e-7, 3.05e-7  # m; of the noise on Fisher masks in the paper
SWEEP = (0.0, -8.0, 8.0, -16.0, 16.0)  # rad; each of the five is sharp at a depth of its own
SMALL_NOISE = 6e-8  # m; without it masks stay round, or alike

# What design_fisher_mask(seed=3) found: radians rms of 55 Zernike polynomials in the order of OSA/ANSI.
# fmt: off
FISHER_COEFFICIENTS = (
    -0.0056, 0.2993, -0.2471, 0.7524, 0.0021, -0.0805, 0.0000, 0.0000, 0.0001, 0.0000, 0.0000,
    -0.5963, -0.0003, 0.0623, -0.0001, -0.0001, 0.0000, 0.0000, -0.0001, -0.0001, 0.0000, 0.0142,
    0.0000, 0.1069, -0.0006, -0.0100, 0.0003, -0.0020, 0.0000, 0.0001, 0.0000, 0.0000, 0.0000,
    0.0000, -0.0001, 0.0000, 0.0000, -0.0038, 0.0001, -0.0294, 0.0002, 0.0060, -0.0002, 0.0033,
    0.0000, 0.0000, 0.0000, 0.0000, 0.0000, 0.0000, 0.0000, 0.0000, 0.0000, 0.0000, 0.0000,
)
# fmt: on


def fisher_mask(size: int = 23) -> Tensor:
    """Return a mask designed for depth, that of seed 3.

    It is the one of :func:`~kornia_tidy.mask_design.objectives.design_fisher_mask`.

    Args:
        size: pixels N along a side.

    Returns:
        Heights in metres for an index of 1.5, (N, N) float64, from 0 to 7.1e-7.

    Convention:
        - In the published setting it tells defocus to 0.0668 rad on average over -10 to 10 rad; the mask published
          with PhaseCam3D to 0.0785 rad. See :func:`~kornia_tidy.mask_design.fisher_information.sampled_response`.

    Source: Wu et al., PhaseCam3D (ICCP 2019), section 3, for the idea; the mask is our own.

    Example:
        >>> fisher_mask().shape, fisher_mask(64).shape
        (torch.Size([23, 23]), torch.Size([64, 64]))
    """
    coefficients = torch.tensor(FISHER_COEFFICIENTS, dtype=torch.float64)
    mask = ZernikeMask(1, size, len(coefficients), initial=torch.zeros(len(coefficients))).double()
    with torch.no_grad():
        mask.coefficients.copy_(coefficients)
        heights = mask.heights()[0]
    return heights - heights.min()


def initial_heights(start: str, generator: torch.Generator | None = None) -> Tensor:
    """Return the five masks that a sequence starts from.

    Args:
        start: one of the paper's, or of our own:

            - ``"noise"``: each uniform on [0, 1.2e-6] m.
            - ``"fisher, noise"``: the first the Fisher mask, the others such noise.
            - ``"noisy fishers"``: Fisher masks turned by a quarter each, with noise added, normal of mean 5.35e-7 and
              standard deviation 3.05e-7 m.
            - ``"fisher, noisy fishers"``: the same, the first without noise.
            - ``"3 fishers, 2 noisy"``: the same, with noise on the last two.
            - ``"like fishers"``: the Fisher mask, and four times the same with normal noise of 6e-8 m: their average is
              not blurred by turns.
            - ``"focal sweep"``: for extended depth of field, lenses focused at a defocus of 0, -8, 8, -16 and 16 rad,
              with the same noise.
        generator: source of the noise.

    Returns:
        Heights in metres, (5, 23, 23), for ``PixelwiseMask(initial=...)``.

    Raises:
        ValueError: if there is no such start.

    Convention:
        - Quarter turns are exact on the grid, but there are four of them: the fifth mask is the first again, noisy.
        - The noise's mean only raises a mask, which changes nothing; its numbers are the mean and the standard
          deviation of PhaseCam3D's published heights.

    Source: Shah et al., TiDy-PSFs (ICCV 2023): the ablation of initial masks ranks them for depth (RMSE 0.0254 for
    noise, then 0.0329, 0.0271 and 0.0207 for those that begin with a Fisher mask, in this order), and in that of their
    number all Fisher masks have noise; Nagahara et al., Flexible Depth of Field Photography (ECCV 2008), for the sweep
    of focus.

    Example:
        >>> from kornia_tidy.masks.pixelwise import PixelwiseMask
        >>> masks = PixelwiseMask(initial=initial_heights("3 fishers, 2 noisy"))
        >>> masks.phase.shape
        torch.Size([5, 23, 23])
    """
    check_choice("start", start, STARTS)
    check_generator(generator)
    uniform = PixelwiseMask.NOISE_HEIGHT * torch.rand(5, 23, 23, generator=generator, dtype=torch.float64)
    if start == "noise":
        return uniform
    fisher = fisher_mask()
    if start == "fisher, noise":
        return torch.cat([fisher[None], uniform[1:]])
    normal = torch.randn(5, 23, 23, generator=generator, dtype=torch.float64)
    if start == "focal sweep":
        y, x = mask_axes(23)
        defocus = torch.tensor(SWEEP, dtype=torch.float64)[:, None, None] * (x**2 + y**2)
        return SMALL_NOISE * normal - defocus * REFERENCE_WAVELENGTH / (2 * math.pi * 0.5)  # an index of 1.5
    if start == "like fishers":
        return torch.cat([fisher[None], fisher + SMALL_NOISE * normal[1:]])
    turned = torch.stack([fisher.rot90(quarters) for quarters in range(5)])
    noise = NOISE_MEAN + NOISE_STD * normal
    noise[: CLEAN[start]] = 0
    return turned + noise
