"""What an optical system does to a point at every depth: PSFs, contrast, and what an image of it tells of its depth."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kornia_tidy.optics.coded_lens import CodedLens

PHOTONS, BACKGROUND = 3000.0, 5.0
"""Expected from a point in each channel, and in each pixel behind it: the setting of Shechtman et al. (PRL 2014)."""

SLOPE_STEP = 0.05  # rad: far below a radian, over which PSFs change, and far above float32's rounding


class Survey(NamedTuple):
    """A system over its range of defocus."""

    defocus: Tensor
    """(D,) radians at 530 nm, ascending: far to near."""
    psfs: Tensor
    """(D, C, P, P), each of sum one."""
    contrast: Tensor
    """(D, C, F), see :func:`contrast_transfer`."""
    bound: Tensor
    """(D,) radians, see :func:`depth_bound`."""


@torch.no_grad()
def survey(lens: CodedLens, nodes: int = 49, frequencies: int = 32) -> Survey:
    """Look at a lens over all of its camera's range.

    Args:
        lens: masks, modulator, camera and spectrum.
        nodes: number D of depths, even in defocus.
        frequencies: number F of spatial frequencies.

    Example:
        >>> from kornia_tidy.optics import PixelwiseMask
        >>> seen = survey(CodedLens(PixelwiseMask(1, initial="flat")), nodes=5)
        >>> int(seen.contrast.mean((1, 2)).argmax())  # a plain lens is sharpest in the middle, in focus
        2
    """
    lo, hi = lens.camera.defocus_range
    defocus = torch.linspace(lo, hi, nodes, dtype=torch.float64)
    psfs = lens.psf_bank(defocus=defocus.tolist()).psfs
    psfs = psfs / psfs.sum((2, 3), keepdim=True)
    return Survey(defocus, psfs, contrast_transfer(psfs, frequencies), depth_bound(lens, defocus.tolist()))


def contrast_transfer(psfs: Tensor, frequencies: int = 32) -> Tensor:
    r"""Return the modulation transfer function of PSFs, averaged over all directions.

    .. math:: M(f) = \langle | \hat h(\nu) | \rangle_{|\nu| = f}, \qquad M(0) = 1

    Args:
        psfs: (..., P, P), each of sum one.
        frequencies: number F of rings of equal width from 0 to half a cycle a pixel.

    Returns:
        (..., F), the mean of each ring.

    Source: Goodman, Introduction to Fourier Optics, section 6.3.

    Example:
        >>> point = torch.zeros(1, 9, 9)
        >>> point[0, 4, 4] = 1
        >>> contrast_transfer(point, 4)
        tensor([[1., 1., 1., 1.]])
    """
    size = max(128, 2 * psfs.shape[-1])
    spectrum = torch.fft.fft2(psfs, s=(size, size)).abs()
    frequency = torch.fft.fftfreq(size, dtype=torch.float64)
    ring = (torch.hypot(frequency[:, None], frequency) * 2 * frequencies).long().flatten()
    seen = (ring < frequencies).nonzero()[:, 0].to(psfs.device)
    ring = ring.to(psfs.device)[seen]
    count = torch.bincount(ring, minlength=frequencies)
    sums = spectrum.new_zeros(*spectrum.shape[:-2], frequencies).index_add(-1, ring, spectrum.flatten(-2)[..., seen])
    return sums / count


@torch.no_grad()
def depth_bound(lens: CodedLens, defocus: list[float]) -> Tensor:
    r"""Return the least standard deviation of the defocus of a point in a known place, in radians, (D,).

    .. math:: \sigma_\psi = I^{-1/2}, \qquad
        I = \sum_{c,p} \frac{(N \, \partial h_{cp} / \partial\psi)^2}{N h_{cp} + b}

    with N = 3000 photons a channel and b = 5 a pixel. The slope is a central difference.

    Args:
        lens: masks, modulator, camera and spectrum; light outside its window is lost.
        defocus: nodes in radians at 530 nm, farther apart than a tenth.

    Source: Shechtman et al., Physical Review Letters 113, 133902 (2014), with x and y known.

    Example:
        >>> from kornia_tidy.optics import PixelwiseMask
        >>> bound = depth_bound(CodedLens(PixelwiseMask(1, initial="flat")), [-8.0, 0.0, 8.0])
        >>> bool(bound[1] > 10 * bound[0])  # in focus, a plain lens does not tell which way the point moves
        True
    """
    around = [psi + side * SLOPE_STEP for psi in defocus for side in (-1, 1)]
    bank = lens.psf_bank(defocus=around, dtype=torch.float64)
    # Remembered banks are renormalised or not as the fidelity says; the light that arrives is what counts here.
    light = bank.psfs * (bank.energy / bank.psfs.sum((2, 3)))[..., None, None]
    before, after = light[::2], light[1::2]
    slope = PHOTONS * (after - before) / (2 * SLOPE_STEP)
    expected = PHOTONS * (after + before) / 2 + BACKGROUND
    return (slope.square() / expected).sum((1, 2, 3)).rsqrt()
