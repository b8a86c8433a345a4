r"""Fisher information of a point's defocus and position in its image, and the Cramér-Rao bound on their estimates.

A pixel counts :math:`\mu = N h + b` photons on average, Poisson distributed: N of the point with the PSF h, and b of
the background. No unbiased estimate of the parameters :math:`\theta` has a covariance below the inverse of

.. math:: I_{ij} = \sum_{c,p} \frac{1}{\mu_{cp}} \frac{\partial \mu_{cp}}{\partial \theta_i}
    \frac{\partial \mu_{cp}}{\partial \theta_j}

The derivatives of the PSF are computed under its integrals, not by finite differences: see :func:`defocus_response`.

Source: Ober, Ram and Ward, Biophysical Journal 86, 1185 (2004), for the information; Shechtman, Sahl, Backer and
Moerner, Physical Review Letters 113, 133902 (2014), for the bound as an objective of mask design.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_tidy.checks import check_positive
from kornia_tidy.masks.base import central_square
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH
from kornia_tidy.psf.propagation import sensor_kernels
from kornia_tidy.psf.psf_model import PSFModel
from kornia_tidy.psf.pupil import gapped_cells, gapped_pupil_field, pupil_field

PHOTONS, BACKGROUND = 3000.0, 5.0
"""Photons of a point, and background photons of each pixel: the usual setting since Shechtman et al."""


_ROUNDING = 1e-20  # per rad²; information below this (a bound of 1e10 rad) is round-off and counts as zero


class PointResponse(NamedTuple):
    """PSFs and their derivatives with respect to the point's defocus and position."""

    psfs: Tensor
    """(D, C, P, P), fraction of the point's light in each pixel."""
    derivatives: Tensor
    """(3, D, C, P, P): per radian of defocus at 530 nm, and per pixel of shift of the image along x and along y."""


def defocus_response(lens: PSFModel, defocus: Sequence[float] | None = None) -> PointResponse:
    r"""Return the time-averaged PSFs of a lens and their derivatives with respect to defocus and position.

    The wave on the sensor is :math:`W = K U K^T` with the pupil field U (see :mod:`~kornia_tidy.psf.propagation`). With
    K' and K'' the kernels that have an additional factor x and x² under the integral,

    .. math:: \partial_\psi W = i (K'' U K^T + K U {K''}^T), \qquad \partial_x W = 2\pi i\, s\, K U K'^T

    Propagation is always exact, even if the fidelity of the lens asks for another.

    Args:
        lens: gives masks, modulator, camera, spectrum, window and pixel tolerance. Light outside the window is lost.
        defocus: nodes in radians at 530 nm. Default: those of the lens.

    Returns:
        PSFs and derivatives in float64, differentiable twice with respect to masks and modulator.

    Example:
        >>> psfs, derivatives = defocus_response(PSFModel(), [-8.0, 0.0, 8.0])
        >>> psfs.shape[:2], derivatives.shape[:3]
        (torch.Size([3, 3]), torch.Size([3, 3, 3]))
    """
    nodes = lens.defocus_nodes if defocus is None else tuple(map(float, defocus))
    states, weights = lens.modulator(lens.masks.phase.double())
    states, weights, pupil = central_square(states), weights.double(), lens.pupil
    cells, camera = pupil.amplitude.shape[-1], lens.camera
    gaps = None if pupil.fill_factor == 1 else (cells // states.shape[-1], pupil.fill_factor)
    field = pupil_field if gaps is None else gapped_pupil_field
    distance = torch.as_tensor(camera.image_distance, dtype=torch.float64).detach()
    pixel = camera.pixel_pitch * camera.aperture_radius / float(distance)
    psfs, derivatives = [], []
    for wavelength in lens.spectrum.wavelengths:
        scale, shift = REFERENCE_WAVELENGTH / wavelength, camera.chromatic_defocus(wavelength)
        kernels = _exact_kernels(
            tuple((psi + shift) * scale for psi in nodes),
            pixel / wavelength,
            (lens.window, cells, pupil.cell_pitch, pupil.extent, lens.fidelity.pixel_tolerance),
            gaps,
            states.device,
        )
        waves = field(states, pupil.amplitude.to(states), lens.masks.dispersion(wavelength))
        psf, derivative = _energies(waves, weights / pupil.light, kernels, pixel / wavelength)
        psfs.append(psf)
        derivatives.append(torch.cat([derivative[:1] * scale, derivative[1:]]))
    channel_weights = states.new_tensor(lens.spectrum.flat().channel_weights)
    return PointResponse(
        torch.einsum("wdyx,cw->dcyx", torch.stack(psfs), channel_weights),
        torch.einsum("wsdyx,cw->sdcyx", torch.stack(derivatives), channel_weights),
    )


def fisher_information(response: PointResponse, photons: float = PHOTONS, background: float = BACKGROUND) -> Tensor:
    """Return the Fisher information matrix of defocus, x and y, summed over pixels and channels.

    Args:
        response: PSFs and their derivatives.
        photons: expected photons of the point in each channel; the PSF gives the fraction that each pixel receives.
        background: expected background photons in each pixel of each channel.

    Returns:
        (D, 3, 3), per rad² and per pixel².

    Raises:
        ValueError: if ``photons`` is not positive, or the background is negative or not finite.

    Example:
        >>> psfs = torch.full((1, 1, 1, 2), 0.5)
        >>> derivatives = torch.tensor([0.5, -0.5]).expand(3, 1, 1, 1, 2)
        >>> fisher_information(PointResponse(psfs, derivatives), photons=100.0, background=0.0)[0, 0, 0]
        tensor(100.)
    """
    check_positive("photons", photons)
    if not 0 <= background < math.inf:
        raise ValueError(f"background must be finite and not negative, got {background}")
    expected = photons * response.psfs + background
    # A pixel without expected light has zero derivatives and no information; the clamp avoids 0/0 there.
    divisor = expected.clamp(min=torch.finfo(expected.dtype).tiny)
    derivatives = photons * response.derivatives
    return torch.einsum("idcyx,jdcyx->dij", derivatives / divisor, derivatives)


def defocus_bound(information: Tensor) -> Tensor:
    r"""Return the square root of the Cramér-Rao bound on defocus from Fisher information, in radians, (D,).

    .. math:: \sqrt{[I^{-1}]_{\psi\psi}} = (I_{\psi\psi} - I_{\psi p} I_{pp}^{-1} I_{p\psi})^{-1/2}

    Args:
        information: (D, 3, 3) of defocus and of the point's place x and y, which is estimated from the same image.

    Returns:
        Standard deviation in radians. It is ``inf``, without gradient, where the image does not change with defocus,
        as for a plain lens in focus.

    Example:
        >>> defocus_bound(torch.diag(torch.tensor([100.0, 4.0, 4.0]))[None])
        tensor([0.1000])
    """
    mixed = information[:, 0, 1:, None]
    effective = information[:, 0, 0] - (mixed.mT @ torch.linalg.solve(information[:, 1:, 1:], mixed)).flatten()
    return effective.masked_fill(effective < _ROUNDING, 0).rsqrt()


def crlb(
    lens: PSFModel,
    defocus: Sequence[float] | None = None,
    photons: float = PHOTONS,
    background: float = BACKGROUND,
) -> Tensor:
    r"""Return the square root of the Cramér-Rao bound on the defocus of a point imaged by a lens, in radians.

    For several masks the bound is that of the time-averaged PSFs, because the estimate has only one image.

    Args:
        lens: masks, modulator, camera and spectrum.
        defocus: nodes in radians at 530 nm. Default: those of the lens.
        photons: expected photons of the point in each channel; the point is grey.
        background: expected background photons in each pixel of each channel.

    Returns:
        (D,) float64, differentiable with respect to masks and modulator.

    Raises:
        ValueError: if ``photons`` is not positive, or the background is negative or not finite.

    Convention:
        - For a bound in metres at a depth z multiply by :math:`\lambda_0 z^2 / (\pi R^2)`, see
          :func:`~kornia_tidy.optics.thin_lens.thin_lens_defocus`.
        - Estimates reach the bound with many photons only. Maximum likelihood estimates with
          :func:`~kornia_tidy.masks.initial_heights.fisher_mask` and a background of 5, from 2000 images at each of
          psi = -8, 0 and 8 rad, had a standard deviation of 1.01, 0.99 and 1.02 times the bound at 3000 photons, 0.99,
          1.03 and 1.00 times at 1000, and 1.25, 1.07 and 1.25 times at 200.

    Source: Shechtman et al., Physical Review Letters 113, 133902 (2014).

    Example:
        >>> from kornia_tidy.masks.pixelwise import PixelwiseMask
        >>> flat = PSFModel(PixelwiseMask(1, initial="flat"))
        >>> [round(value, 3) for value in crlb(flat, [-8.0, 0.0, 8.0]).tolist()]
        [0.041, inf, 0.041]
    """
    return defocus_bound(fisher_information(defocus_response(lens, defocus), photons, background))


def _energies(field: Tensor, weights: Tensor, kernels: Tensor, step: float) -> tuple[Tensor, Tensor]:
    """Return the PSFs of K pupil fields and their derivatives with respect to defocus, x and y.

    Args:
        field: (K, N, N) complex.
        weights: of the fields, (K,).
        kernels: propagation matrices of the moments 0, 1 and 2, (3, D, P, q, N), with q samples in a pixel.
        step: pixel in cycles per pupil radius.

    Returns:
        Energies (D, P, P) and derivatives (3, D, P, P).
    """
    window = kernels.shape[2]
    k0, k1, k2 = kernels.flatten(2, 3)[:, :, None]  # (D, 1, Pq, N)
    rows = [kernel @ field for kernel in (k0, k1, k2)]
    wave = rows[0] @ k0.mT
    tilt = 2j * math.pi * step
    wave_derivatives = (1j * (rows[2] @ k0.mT + rows[0] @ k2.mT), tilt * (rows[0] @ k1.mT), tilt * (rows[1] @ k0.mT))
    products = [wave.real.square() + wave.imag.square()]
    products += [2 * (wave.real * change.real + wave.imag * change.imag) for change in wave_derivatives]
    energies = [
        torch.einsum("k,dkyqxr->dyx", weights, product.unflatten(-1, (window, -1)).unflatten(2, (window, -1)))
        for product in products
    ]
    return energies[0], torch.stack(energies[1:])


@lru_cache(maxsize=12)
def _exact_kernels(
    defocus: tuple[float, ...],
    step: float,
    geometry: tuple[int, int, float, float, float],
    gaps: tuple[int, float] | None,
    device: torch.device,
) -> Tensor:
    spans = None if gaps is None else gapped_cells(geometry[1], *gaps)
    with torch.inference_mode(False), torch.no_grad():
        return torch.stack([sensor_kernels(defocus, step, *geometry, device, spans, m) for m in (0, 1, 2)])
