"""Statistics of an optical system over defocus: PSFs, modulation transfer function, Cramér-Rao bound on depth."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kornia_tidy.psf.psf_model import PSFModel


class SystemStatistics(NamedTuple):
    """PSFs, contrast and depth bound of a system over its range of defocus."""

    defocus: Tensor
    """(D,) radians at 530 nm, ascending: far to near."""
    psfs: Tensor
    """(D, C, P, P), each of sum one."""
    contrast: Tensor
    """(D, C, F), see :func:`contrast_transfer`."""
    bound: Tensor
    """(D,) radians, see :func:`~kornia_tidy.design.fisher_information.crlb`."""


@torch.no_grad()
def system_statistics(lens: PSFModel, nodes: int = 49, frequencies: int = 32) -> SystemStatistics:
    """Compute PSFs, contrast and Cramér-Rao bound of a lens over the defocus range of its camera.

    Args:
        lens: masks, modulator, camera and spectrum.
        nodes: number D of depths, evenly spaced in defocus.
        frequencies: number F of spatial frequencies.

    Example:
        >>> from kornia_tidy.masks.pixelwise import PixelwiseMask
        >>> seen = system_statistics(PSFModel(PixelwiseMask(1, initial="flat")), nodes=5)
        >>> int(seen.contrast.mean((1, 2)).argmax())  # a plain lens is sharpest in the middle, in focus
        2
    """
    from kornia_tidy.design.fisher_information import crlb  # noqa: PLC0415 (contrast does not need the design of masks)

    lo, hi = lens.camera.defocus_range
    defocus = torch.linspace(lo, hi, nodes, dtype=torch.float64)
    psfs = lens.psf_bank(defocus=defocus.tolist()).psfs
    psfs = psfs / psfs.sum((2, 3), keepdim=True)
    return SystemStatistics(defocus, psfs, contrast_transfer(psfs, frequencies), crlb(lens, defocus.tolist()))


def contrast_transfer(psfs: Tensor, frequencies: int = 32) -> Tensor:
    r"""Return the modulation transfer function of PSFs, averaged over all directions.

    .. math:: M(f) = \langle | \hat h(\nu) | \rangle_{|\nu| = f}, \qquad M(0) = 1

    Args:
        psfs: (..., P, P), each of sum one.
        frequencies: number F of rings of equal width from 0 to 0.5 cycles per pixel.

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


def ring_centres(frequencies: int) -> list[float]:
    """Return the central frequency of each ring in cycles per pixel.

    The rings are those of :func:`contrast_transfer`.

    Example:
        >>> ring_centres(2)
        [0.125, 0.375]
    """
    return [(ring + 0.5) / (2 * frequencies) for ring in range(frequencies)]
