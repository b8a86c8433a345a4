"""The published discretisation of the PhaseCam3D family: one FFT of a 23x23 pupil for each colour.

It is cheap, and wrong at the extremes: from |psi| = 14.7 (blue) the phase of defocus steps by more than pi between mask
pixels, light wraps around the window, and the crop loses more of it in red than in blue, which puts a colour on depth.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence

import torch
from torch import Tensor

from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH, Spectrum
from kornia_tidy.psf.psf_bank import PSFBank

PAPER_SIZE = 23  # pixels of mask, pupil and PSF
PAPER_PAD = 27  # zero-padded side at the reference wavelength


class AliasingWarning(UserWarning):
    """The pupil grid cannot carry the defocus that was asked for."""


def padded_size(wavelength: float) -> int:
    """Return the zero-padded side for a wavelength in metres: the odd number next to 27 * wavelength / 530 nm.

    Source: PhaseCam3D (Wu et al., ICCP 2019), whose code uses 31, 27 and 23 for red, green and blue.

    Raises:
        ValueError: if the wavelength is so short that the padded side is below 23.

    Example:
        >>> [padded_size(w) for w in (610e-9, 530e-9, 470e-9)]
        [31, 27, 23]
    """
    size = 2 * round((PAPER_PAD * wavelength / REFERENCE_WAVELENGTH - 1) / 2) + 1
    if size < PAPER_SIZE:
        raise ValueError(f"the paper's pupil needs wavelengths of at least 453 nm, got {wavelength * 1e9:.0f} nm")
    return size


def paper_psfs(
    phase: Tensor, weights: Tensor, aperture: Tensor, defocus: Tensor, wavelength: float, dispersion: float = 1.0
) -> Tensor:
    r"""Return the PSFs of the published discretisation at one wavelength.

    .. math:: h_d = \sum_k w_k \, \mathrm{crop}\,
        \frac{| \mathrm{FFT}_M\{ A e^{i \phi_k + i \psi_d \rho^2 \lambda_0/\lambda} \} |^2}{M^2 \sum A^2}

    Args:
        phase: radians at 530 nm, (K, 23, 23).
        weights: share of the exposure of each mask, (K,).
        aperture: amplitude, (23, 23), or one for each mask, (K, 23, 23), all of one light.
        defocus: radians at the pupil edge at 530 nm, (D,).
        wavelength: in metres.
        dispersion: factor that takes the phase at 530 nm to this wavelength (for n = 1.5, 530 nm / wavelength).

    Returns:
        (D, 23, 23), summing to one before the crop and less after it; not renormalised, point-sampled.

    Source: equations of PhaseCam3D (Wu et al., ICCP 2019), kept by TiDy-PSFs (Shah et al., ICCV 2023).

    Example:
        >>> from kornia_tidy.optics.aperture import circular_aperture
        >>> flat = torch.zeros(1, 23, 23, dtype=torch.float64)
        >>> psf = paper_psfs(flat, torch.ones(1), circular_aperture(23), torch.zeros(1), 530e-9)
        >>> round(float(psf.sum()), 3)
        0.988
    """
    pad = padded_size(wavelength)
    x = torch.linspace(-1.1, 1.1, PAPER_SIZE, dtype=torch.float64, device=phase.device)
    rho2 = x[:, None].square() + x.square()
    lens = (defocus.to(rho2) * (REFERENCE_WAVELENGTH / wavelength))[:, None, None, None] * rho2
    angle = phase * dispersion + lens.to(phase.dtype)
    amplitude = aperture.to(angle)
    field = torch.complex(amplitude * angle.cos(), amplitude * angle.sin())
    wave = torch.fft.fftshift(torch.fft.fft2(field, s=(pad, pad)), dim=(-2, -1))
    margin = (pad - PAPER_SIZE) // 2
    wave = wave[..., margin : margin + PAPER_SIZE, margin : margin + PAPER_SIZE]
    intensity = wave.real.square() + wave.imag.square()
    mean = (weights.to(intensity)[:, None, None] * intensity).sum(1)  # no matrix product: GPUs may round those to TF32
    light = amplitude.square().sum() if amplitude.ndim == 2 else amplitude[0].square().sum()
    return mean / (pad**2 * light)


def paper_psf_bank(
    phase: Tensor,
    weights: Tensor,
    aperture: Tensor,
    spectrum: Spectrum,
    dispersion: Sequence[float],
    defocus: Sequence[float],
    chromatic_defocus: Sequence[float] | None = None,
) -> PSFBank:
    """Return the bank of the published discretisation; see :func:`paper_psfs` and, for the arguments, the exact bank.

    Raises:
        ValueError: if mask or aperture are not 23x23.
    """
    if phase.shape[-1] != PAPER_SIZE or aperture.shape[-1] != PAPER_SIZE:
        raise ValueError(
            f"fidelity 'paper' is defined for masks and apertures of 23x23 pixels, got {phase.shape[-1]} and "
            f"{aperture.shape[-1]}"
        )
    nodes = phase.new_tensor(defocus)
    psfs = phase.new_zeros(len(defocus), len(spectrum.plane_weights), PAPER_SIZE, PAPER_SIZE)
    for w, wavelength in enumerate(spectrum.wavelengths):
        share = phase.new_tensor([channel[w] for channel in spectrum.plane_weights])
        shift = 0.0 if chromatic_defocus is None else chromatic_defocus[w]
        one = paper_psfs(phase, weights, aperture, nodes + shift, wavelength, dispersion[w])
        psfs = psfs + one[:, None] * share[:, None, None]
    return PSFBank(psfs, nodes, psfs.sum((2, 3)))


def warn_if_aliased(defocus_range: Sequence[float], spectrum: Spectrum) -> None:
    r"""Warn if the defocus steps by more than :math:`\pi` between neighbouring pixels of the paper's pupil.

    At the edge the step is :math:`(1 - 0.9^2)\,|\psi|\,\lambda_0/\lambda`: the grid carries :math:`|\psi|` up to
    14.7 at 470 nm, 16.5 at 530 nm and 19.0 at 610 nm.
    """
    shortest = min(spectrum.wavelengths)
    step = (1 - 0.9**2) * REFERENCE_WAVELENGTH / shortest
    worst = max(abs(p) for p in defocus_range)
    if worst * step > math.pi:
        warnings.warn(
            f"the paper's 23x23 pupil carries |psi| up to {math.pi / step:.1f} rad at {shortest * 1e9:.0f} nm, but the "
            f"range goes to {worst:.1f}: there the PSFs wrap around; use fidelity='balanced', which never aliases, or "
            f"a smaller range",
            AliasingWarning,
            stacklevel=3,
        )
