"""Initial heights of mask sequences: noise, a mask designed for depth, combinations of the two, and lenses."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kornia_tidy.checks import check_choice, check_generator
from kornia_tidy.choices import STARTS
from kornia_tidy.masks.base import mask_axes
from kornia_tidy.masks.pixelwise import PixelwiseMask
from kornia_tidy.masks.zernike import ZernikeMask, quarter_polynomials
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH

CLEAN = {"noisy fishers": 0, "fisher, noisy fishers": 1, "3 fishers, 2 noisy": 3}  # Fisher masks without noise

NOISE_MEAN, NOISE_STD = 5.35e-7, 3.05e-7  # m; of the noise on Fisher masks in the paper
SWEEP = (0.0, -8.0, 8.0, -16.0, 16.0)  # rad; defocus at which each of the five masks is in focus
SMALL_NOISE = 6e-8  # m; breaks the symmetry: without it lenses stay round and equal masks stay equal

# Result of design_fisher_mask(seed=3) in tests/design/published_setting.py: radians rms of 55 Zernike polynomials in
# the order of OSA/ANSI.
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
    """Return the Fisher mask, a mask designed for depth estimation by the Cramér-Rao bound.

    Args:
        size: pixels N along a side.

    Returns:
        Heights in metres for an index of 1.5, (N, N) float64, from 0 to 7.1e-7.

    Convention:
        - In the published setting its bound on the error of defocus is 0.0668 rad on average over -10 to 10 rad. That
          of the mask published with PhaseCam3D is 0.0785 rad. In that setting the pupil is sampled at points, and one
          FFT of 64 x 64 pixels gives the PSF; bounds in it are about 5 % too low.

    Source: Wu et al., PhaseCam3D (ICCP 2019), section 3, for the method; the mask is our own.

    Example:
        >>> fisher_mask().shape, fisher_mask(64).shape
        (torch.Size([23, 23]), torch.Size([64, 64]))
    """
    coefficients = torch.tensor(FISHER_COEFFICIENTS, dtype=torch.float64)
    mask = ZernikeMask(1, size, len(coefficients), initial=torch.zeros(len(coefficients))).double()
    mask.polynomials = quarter_polynomials(len(coefficients), size).float().double()  # under any default data type
    with torch.no_grad():
        mask.coefficients.copy_(coefficients)
        heights = mask.heights()[0]
    return heights - heights.min()


def initial_heights(start: str, generator: torch.Generator | None = None, size: int = 23) -> Tensor:
    """Return the initial heights of a sequence of five masks.

    Args:
        start: name of the initialisation. The first five are the paper's, the others our own:

            - ``"noise"``: noise uniform on [0, 1.2e-6] m.
            - ``"fisher, noise"``: the Fisher mask, and four masks of such noise.
            - ``"noisy fishers"``: the Fisher mask, each next one rotated by another 90 degrees, plus normal noise of
              mean 5.35e-7 m and standard deviation 3.05e-7 m.
            - ``"fisher, noisy fishers"``: the same with noise on the last four only.
            - ``"3 fishers, 2 noisy"``: the same with noise on the last two only.
            - ``"like fishers"``: five Fisher masks without rotation, the last four with normal noise of standard
              deviation 6e-8 m. Rotated masks would blur the average PSF.
            - ``"focal sweep"``: for extended depth of field, lenses in focus at a defocus of 0, -8, 8, -16 and 16 rad,
              with normal noise of standard deviation 6e-8 m.
            - ``"flat"``: zero everywhere, only the lens.
        generator: source of the noise.
        size: pixels N along a side.

    Returns:
        Heights in metres, (5, N, N), for ``PixelwiseMask(initial=...)``.

    Raises:
        ValueError: if ``start`` is unknown or the size not positive.

    Convention:
        - Rotations by 90 degrees are exact on the grid, but only four differ: the fifth mask equals the first but for
          its noise.
        - The mean of the noise adds a constant phase, which has no effect. Mean and standard deviation are those of
          PhaseCam3D's published heights.

    Source: Shah et al., TiDy-PSFs (ICCV 2023). Their ablation of initial masks gives a depth RMSE of 0.0254 for
    "noise", 0.0329 for "fisher, noise", 0.0271 for "fisher, noisy fishers" and 0.0207 for "3 fishers, 2 noisy"; their
    ablation of the number of masks has "noisy fishers". Nagahara et al., Flexible Depth of Field Photography (ECCV
    2008), for the focal sweep.

    Example:
        >>> from kornia_tidy.masks.pixelwise import PixelwiseMask
        >>> masks = PixelwiseMask(initial=initial_heights("3 fishers, 2 noisy"))
        >>> masks.phase.shape
        torch.Size([5, 23, 23])
    """
    check_choice("start", start, STARTS)
    check_generator(generator)
    y, x = mask_axes(size)
    shape = 5, size, size
    uniform = PixelwiseMask.NOISE_HEIGHT * torch.rand(shape, generator=generator, dtype=torch.float64)
    if start == "noise":
        return uniform
    if start == "flat":
        return torch.zeros_like(uniform)
    fisher = fisher_mask(size)
    if start == "fisher, noise":
        return torch.cat([fisher[None], uniform[1:]])
    normal = torch.randn(shape, generator=generator, dtype=torch.float64)
    if start == "focal sweep":
        defocus = torch.tensor(SWEEP, dtype=torch.float64)[:, None, None] * (x**2 + y**2)
        return SMALL_NOISE * normal - defocus * REFERENCE_WAVELENGTH / (2 * math.pi * 0.5)  # an index of 1.5
    if start == "like fishers":
        return torch.cat([fisher[None], fisher + SMALL_NOISE * normal[1:]])
    rotated = torch.stack([fisher.rot90(quarters) for quarters in range(5)])
    noise = NOISE_MEAN + NOISE_STD * normal
    noise[: CLEAN[start]] = 0
    return rotated + noise
