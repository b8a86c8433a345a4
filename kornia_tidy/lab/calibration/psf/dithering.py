r"""Dithering: an alias-free PSF from several point images at different sub-pixel positions.

Pixels larger than half of wavelength times f-number undersample the PSF, so a single image cannot be shifted by a
fraction of a pixel. Several images at different sub-pixel positions determine the PSF. At each frequency of the image
the aliased frequencies add up with other phases in every image, and a small linear system separates them.

Source: Lauer, Publications of the Astronomical Society of the Pacific 111, 227 (1999).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pixel_shuffle

STEPS = 16  # of conjugate gradients, enough for sharp points behind a mosaic
REACH = 1  # pixels; with weights for each pixel, noise from farther away does not reach a pixel


@dataclass(frozen=True, eq=False)
class ResolvedPSF:
    """A PSF resolved beyond the Nyquist frequency of the sensor, so that it can be sampled at any sub-pixel position.

    Args:
        spectrum: (L, L) complex, with L = 2 · band · M for images of side M.
        band: highest frequency along either axis, in cycles per sample.
        psf: samples of the PSF; the chief ray is on the sample that corresponds to the image's pixel M // 2.
        variance: variance of these samples.
        leverage: fraction of an image's noise that the fitted PSF follows, from 0 (mean of many images) to 1.
    """

    spectrum: Tensor
    band: int
    psf: Tensor
    variance: Tensor
    leverage: float

    def images_at(self, offsets: Tensor) -> tuple[Tensor, Tensor]:
        """Sample the PSF as images of a point at given positions, and the gradient of these images.

        Args:
            offsets: (N, 2) position of the chief ray, rows and columns from the centre of the central pixel.

        Returns:
            Images (N, M, M), and their gradients with respect to the two offsets (N, 2, M, M).
        """
        side, frequency = self._grid()
        rows, columns = (torch.exp(-2j * math.pi * frequency * offset[:, None]) for offset in offsets.unbind(1))
        moved = self.spectrum * rows[:, :, None] * columns[:, None, :]
        derivative = -2j * math.pi * frequency
        spectra = torch.stack([moved, moved * derivative[:, None], moved * derivative], 1)
        image = _centred(torch.fft.ifft2(_folded(spectra, side)).real)
        return image[:, 0], image[:, 1:]

    def gradient(self, upsampling: int) -> Tensor:
        """Return the gradient of the samples with respect to the offsets of the point, (2, M, M) of the PSF's side."""
        parts = torch.arange(upsampling, dtype=torch.float64) / upsampling
        _, gradients = self.images_at(-torch.cartesian_prod(parts, parts).view(-1, 2))
        return pixel_shuffle(gradients.transpose(0, 1), upsampling)[:, 0]

    def _grid(self) -> tuple[int, Tensor]:
        length = self.spectrum.shape[-1]
        return length // (2 * self.band), _frequencies(length, self.band, self.spectrum.device)


def resolve_psf(
    patches: Tensor,
    offsets: Tensor,
    variances: Tensor,
    cutoff: float = 1.0,
    upsampling: int = 1,
    each_pixel: bool = False,
) -> ResolvedPSF:
    r"""Resolve the PSF from point images at several sub-pixel positions, by least squares for the aliases.

    .. math:: Y_i(f) = \sum_k H(f + k) e^{-2 \pi i (f + k) \cdot \delta_i} + n_i(f)

    Few images, or images at similar positions, do not determine all aliases. A prior then divides the power between
    them in proportion to :math:`(1 - |f| / f_c)^2`, which is typical of a lens.

    A separate solution for each frequency has to assume white noise. Then the shot noise of a bright core spreads over
    the dark pixels around it. Weights for each pixel avoid this, and need an iterative solution.

    Args:
        patches: (N, M, M) point images, background subtracted, normalised to the same brightness.
        offsets: :math:`\delta`, (N, 2) position of the chief ray, rows and columns in samples from the centre of the
            pixel (M // 2, M // 2), about one sample at most.
        variances: (N, M, M) noise variance of the patches.
        cutoff: :math:`f_c`, highest frequency that the lens passes, in cycles per sample.
        upsampling: samples of the PSF for one sample of the images along each axis; 2 for the planes of a Bayer array.
        each_pixel: whether to weight each pixel by its variance, instead of each image by its mean variance.

    Returns:
        The PSF with its variance, propagated through the linear system.

    Convention:
        - Patches are periodic. Their light must vanish at the border, or a margin must be cropped afterwards.

    Source: Lauer (1999), see above, for the linear system; Hestenes and Stiefel, Journal of Research of the National
    Bureau of Standards 49, 409 (1952), for conjugate gradients.

    Example:
        >>> x = torch.arange(16.0) - 8
        >>> offsets = torch.tensor([[0.0, -0.3], [0.25, 0.1], [-0.25, 0.35], [0.0, 0.0]])
        >>> spot = lambda dy, dx: torch.exp(-((x[:, None] - dy) ** 2 + (x - dx) ** 2) / 2)
        >>> images = torch.stack([spot(*offset) for offset in offsets.tolist()])
        >>> found = resolve_psf(images, offsets, torch.full((4, 16, 16), 1e-12))
        >>> bool((found.psf - spot(0, 0)).abs().max() < 1e-4)
        True
    """
    side = patches.shape[-1]
    band = max(1, math.ceil(cutoff))
    aliases = 2 * band
    length = aliases * side
    patches, variances, offsets = patches.double(), variances.double().clamp(min=1e-30), offsets.double()
    frequency = _frequencies(length, band, patches.device)
    spectra = torch.fft.fft2(torch.fft.ifftshift(patches, dim=(-2, -1)))
    noise = variances.mean((1, 2))  # of one pixel; white, so the same at all frequencies

    passed = (1 - torch.hypot(frequency[:, None], frequency) / cutoff).clamp(min=0).square()
    power = spectra.abs().square().mean()
    prior = passed / _folded(passed, side).mean() * (power - noise.mean() * side**2).clamp(min=1e-6 * float(power))

    # For every frequency of the image, in units of the prior and of the noise: (side, side, N, aliases^2).
    rows, columns = (
        torch.exp(-2j * math.pi * frequency * offset[:, None]).unflatten(1, (aliases, side))
        for offset in offsets.unbind(1)
    )
    noise_scale = noise.rsqrt() / side
    scale = prior.sqrt().unflatten(1, (aliases, side)).unflatten(0, (aliases, side)).permute(1, 3, 0, 2).flatten(2)
    phases = torch.einsum("nay,nbx->yxnab", rows, columns).flatten(3) * scale[:, :, None] * noise_scale[:, None]
    system = phases.mH @ phases + torch.eye(aliases**2).to(phases)
    gains = torch.linalg.solve(system, phases.mH)
    leverage = float((phases * gains.mT).sum(-1).real.mean())
    measured = spectra.permute(1, 2, 0) * noise_scale
    solved = (gains @ measured[..., None])[..., 0]
    if each_pixel:
        weights = torch.fft.ifftshift(noise[:, None, None] / variances, dim=(-2, -1)).permute(1, 2, 0)
        solved = _with_weights(solved, phases, measured, weights)
    gains = scale[..., None] * gains * noise_scale  # (side, side, aliases^2, N)
    solved = scale * solved
    spectrum = solved.unflatten(2, (aliases, aliases)).permute(2, 0, 3, 1).reshape(length, length)
    fine = upsampling * side
    psf, variance = (torch.empty(fine, fine, dtype=torch.float64).to(patches) for _ in range(2))
    if each_pixel:  # a pixel that is saturated in some images has less weight there
        variances = variances.reciprocal().mean(0).reciprocal().expand_as(variances)
    spectral_variances = torch.fft.fft2(variances)
    for down in range(upsampling):
        for right in range(upsampling):
            moves = [torch.exp(2j * math.pi * frequency * part / upsampling) for part in (down, right)]
            between = _folded(spectrum * moves[0][:, None] * moves[1], side)
            ramps = torch.einsum("ay,bx->yxab", *(move.unflatten(0, (aliases, side)) for move in moves)).flatten(2)
            # The PSF is a sum of filtered images, so its variance is a sum of variances under the squared filters.
            filters = torch.fft.ifft2((gains * ramps[..., None]).sum(2), dim=(0, 1)).real.permute(2, 0, 1)
            if each_pixel:
                near = filters * _near(side, filters)
                filters = near * (filters.square().sum((1, 2)) / near.square().sum((1, 2))).sqrt()[:, None, None]
            spectral_variance = torch.fft.fft2(filters.square()) * spectral_variances
            samples = slice(down, None, upsampling), slice(right, None, upsampling)
            psf[samples] = _centred(torch.fft.ifft2(between).real)
            variance[samples] = torch.fft.ifft2(spectral_variance.sum(0)).real
    return ResolvedPSF(spectrum, band, psf, variance.clamp(min=0), leverage)


def most_aliases(cutoff: float) -> int:
    """Return the largest number of frequencies aliased onto one, which is the number of images that resolve them.

    Args:
        cutoff: highest frequency that the lens passes, in cycles per sample.

    Example:
        >>> [most_aliases(cutoff) for cutoff in (0.5, 0.784, 2.08)]  # well sampled, undersampled, behind a mosaic
        [1, 4, 16]
    """
    reach = math.ceil(cutoff)
    shifts = torch.arange(-reach, reach + 1, dtype=torch.float64)
    squares = (torch.linspace(0, 0.5, 33, dtype=torch.float64)[:, None] + shifts).square()
    return int((squares[:, None, :, None] + squares[:, None] < cutoff**2).sum((2, 3)).max())


def _with_weights(solved: Tensor, phases: Tensor, measured: Tensor, weights: Tensor) -> Tensor:
    """Solve the system with a weight for each pixel by conjugate gradients, from the solution for white noise.

    A few steps suffice: the solution for white noise is accurate in the bright core already, and the first steps
    correct the dark pixels, which are most.

    Args:
        solved: (M, M, aliases^2) solution for white noise, in units of the prior.
        phases: (M, M, N, aliases^2) system matrix from aliases to the images' spectra, in units of their mean noise.
        measured: (M, M, N) the images' spectra in these units.
        weights: (M, M, N) weight of each pixel, of order one; the chief ray's pixel comes first.

    Returns:
        The aliases of each frequency, (M, M, aliases^2).
    """

    def back(spectra: Tensor) -> Tensor:
        weighted = torch.fft.fft2(weights * torch.fft.ifft2(spectra, dim=(0, 1)), dim=(0, 1))
        return (phases.mH @ weighted[..., None])[..., 0]

    level = weights.mean((0, 1))[:, None]
    factor = torch.linalg.cholesky(phases.mH @ (level * phases) + torch.eye(phases.shape[-1]).to(phases))
    rest = back(measured - (phases @ solved[..., None])[..., 0]) - solved
    step, before = torch.zeros_like(rest), 1.0
    rounding = 1e-28 * float(solved.abs().square().sum())
    for _ in range(STEPS):
        towards = torch.cholesky_solve(rest[..., None], factor)[..., 0]
        now = float((rest.conj() * towards).real.sum())
        if now <= rounding:  # with equal weights the first solution is exact
            break
        step, before = towards + now / before * step, now
        change = back((phases @ step[..., None])[..., 0]) + step
        length = now / max(float((step.conj() * change).real.sum()), 1e-300)
        solved, rest = solved + length * step, rest - length * change
    return solved


def _near(side: int, like: Tensor) -> Tensor:
    """Return a mask (side, side) of the pixels within ``REACH`` of the first one of a periodic image."""
    distance = torch.fft.fftfreq(side, 1 / side).abs()
    near = (distance <= REACH).to(like)
    return near[:, None] * near


def _frequencies(length: int, band: int, device: torch.device) -> Tensor:
    """Return the frequencies of a spectrum that extends beyond Nyquist, in cycles per sample."""
    return torch.fft.fftfreq(length, 1 / (2 * band), dtype=torch.float64, device=device)


def _folded(spectrum: Tensor, side: int) -> Tensor:
    """Add up the aliases of a spectrum, which gives the spectrum after sampling."""
    aliases = spectrum.shape[-1] // side
    return spectrum.unflatten(-1, (aliases, side)).sum(-2).unflatten(-2, (aliases, side)).sum(-3)


def _centred(image: Tensor) -> Tensor:
    return torch.fft.fftshift(image, dim=(-2, -1))
