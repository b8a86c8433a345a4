r"""A PSF from point images at several places between the pixels: what one image aliases, several resolve.

A sensor samples a PSF too coarsely as soon as its pixels are larger than half of wavelength times f-number, so a single
image cannot be moved by a part of a pixel. Images of one point at several places can: at each frequency of the image,
the aliases that fall on it come with other phases in every image, and are unknowns of a small linear system.

Source: Lauer, Publications of the Astronomical Society of the Pacific 111, 227 (1999).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

STEPS = 16  # of conjugate gradients, as sharp points behind a mosaic need
REACH = 1  # pixels from which noise is counted where each pixel has a weight: beyond, weights keep it out


@dataclass(frozen=True, eq=False)
class ResolvedPSF:
    """A PSF known between the pixels too, by its spectrum beyond the sensor's own Nyquist frequency.

    Args:
        spectrum: (L, L) complex; L is a whole multiple, twice the band, of the side M of the images it came of.
        band: highest frequency along either axis, in cycles per sample.
        psf: samples, as many to the image's one as asked for, the chief ray on that of the image's pixel M // 2.
        variance: of these.
        leverage: share of an image's noise that the PSF has taken up, from 0, as in the mean of many, to 1.
    """

    spectrum: Tensor
    band: int
    psf: Tensor
    variance: Tensor
    leverage: float

    def seen_from(self, offsets: Tensor) -> tuple[Tensor, Tensor]:
        """Return what point images look like, and how they change with the place of the point.

        Args:
            offsets: (N, 2) where the chief ray falls, rows and columns from the centre of the central pixel.

        Returns:
            Images (N, M, M), and their slopes (N, 2, M, M) over the two offsets.
        """
        side, frequency = self._grid()
        rows, columns = (torch.exp(-2j * math.pi * frequency * offset[:, None]) for offset in offsets.unbind(1))
        moved = self.spectrum * rows[:, :, None] * columns[:, None, :]
        turn = -2j * math.pi * frequency
        three = torch.stack([moved, moved * turn[:, None], moved * turn], 1)
        image = _centred(torch.fft.ifft2(_folded(three, side)).real)
        return image[:, 0], image[:, 1:]

    def _grid(self) -> tuple[int, Tensor]:
        length = self.spectrum.shape[-1]
        return length // (2 * self.band), _frequencies(length, self.band, self.spectrum.device)


def resolve_psf(
    patches: Tensor,
    offsets: Tensor,
    variances: Tensor,
    cutoff: float = 1.0,
    finer: int = 1,
    each_pixel: bool = False,
) -> ResolvedPSF:
    r"""Return the PSF that explains point images at several places: least squares for all aliases of each frequency.

    .. math:: Y_i(f) = \sum_k H(f + k) e^{-2 \pi i (f + k) \cdot \delta_i} + n_i(f)

    Few images, or images alike in place, do not fix all aliases. Those are then shared out as a lens shares its light
    between frequencies, in proportion to a prior :math:`(1 - |f| / f_c)^2` of the image's own power.

    Frequencies that are solved one by one take noise for white, and the shot noise of a bright core then spreads over
    the dark about it. Weights of each pixel keep it where it is, for which there is no solution but step by step.

    Args:
        patches: (N, M, M) point images, background taken off, alike in brightness.
        offsets: :math:`\delta`, (N, 2) where the chief ray falls, rows and columns in samples from the centre of the
            pixel (M // 2, M // 2); within a sample or so.
        variances: (N, M, M).
        cutoff: :math:`f_c`, highest frequency that the lens passes, in cycles per sample.
        finer: samples of the PSF to one of the images along each axis, as a mosaic's planes have every second pixel.
        each_pixel: whether each pixel has a weight of its own, by its variance, and not each image by its mean one.

    Returns:
        The PSF with its variance, propagated through the linear system.

    Convention:
        Patches repeat at their borders: light there must have faded, or a margin be cut off afterwards.

    Source: Hestenes and Stiefel, Journal of Research of the National Bureau of Standards 49, 409 (1952), for the steps.

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
    noise = variances.mean((1, 2))  # of one pixel, alike at all frequencies

    passed = (1 - torch.hypot(frequency[:, None], frequency) / cutoff).clamp(min=0).square()
    power = spectra.abs().square().mean()
    prior = passed / _folded(passed, side).mean() * (power - noise.mean() * side**2).clamp(min=1e-6 * float(power))

    # For every frequency of the image, in units in which prior and noise are one: (side, side, N, aliases^2).
    rows, columns = (
        torch.exp(-2j * math.pi * frequency * offset[:, None]).unflatten(1, (aliases, side))
        for offset in offsets.unbind(1)
    )
    noise_scale = noise.rsqrt() / side
    own = prior.sqrt().unflatten(1, (aliases, side)).unflatten(0, (aliases, side)).permute(1, 3, 0, 2).flatten(2)
    phases = torch.einsum("nay,nbx->yxnab", rows, columns).flatten(3) * own[:, :, None] * noise_scale[:, None]
    system = phases.mH @ phases + torch.eye(aliases**2).to(phases)
    gains = torch.linalg.solve(system, phases.mH)
    leverage = float((phases * gains.mT).sum(-1).real.mean())
    seen = spectra.permute(1, 2, 0) * noise_scale
    solved = (gains @ seen[..., None])[..., 0]
    if each_pixel:
        weights = torch.fft.ifftshift(noise[:, None, None] / variances, dim=(-2, -1)).permute(1, 2, 0)
        solved = _with_weights(solved, phases, seen, weights)
    gains = own[..., None] * gains * noise_scale  # (side, side, aliases^2, N)
    solved = own * solved
    spectrum = solved.unflatten(2, (aliases, aliases)).permute(2, 0, 3, 1).reshape(length, length)
    psf, variance = (torch.empty(finer * side, finer * side, dtype=torch.float64).to(patches) for _ in range(2))
    spectral_variances = torch.fft.fft2(variances)
    for down in range(finer):
        for right in range(finer):
            moves = [torch.exp(2j * math.pi * frequency * part / finer) for part in (down, right)]
            between = _folded(spectrum * moves[0][:, None] * moves[1], side)
            ramps = torch.einsum("ay,bx->yxab", *(move.unflatten(0, (aliases, side)) for move in moves)).flatten(2)
            # What an image adds to the PSF, and how its noise spreads.
            filters = torch.fft.ifft2((gains * ramps[..., None]).sum(2), dim=(0, 1)).real.permute(2, 0, 1)
            if each_pixel:
                filters = filters * _near(side, filters)
            spread = torch.fft.fft2(filters.square()) * spectral_variances
            place = slice(down, None, finer), slice(right, None, finer)
            psf[place] = _centred(torch.fft.ifft2(between).real)
            variance[place] = torch.fft.ifft2(spread.sum(0)).real
    return ResolvedPSF(spectrum, band, psf, variance.clamp(min=0), leverage)


def most_aliases(cutoff: float) -> int:
    """Return how many frequencies that a lens passes fall together at most: so many images tell them apart.

    Args:
        cutoff: the highest that it passes, in cycles per sample.

    Example:
        >>> [most_aliases(cutoff) for cutoff in (0.5, 0.784, 2.08)]  # a lens well sampled, one not, behind a mosaic
        [1, 4, 16]
    """
    reach = math.ceil(cutoff)
    shifts = torch.arange(-reach, reach + 1, dtype=torch.float64)
    squares = (torch.linspace(0, 0.5, 33, dtype=torch.float64)[:, None] + shifts).square()
    return int((squares[:, None, :, None] + squares[:, None] < cutoff**2).sum((2, 3)).max())


def _with_weights(solved: Tensor, phases: Tensor, seen: Tensor, weights: Tensor) -> Tensor:
    """Go from the solution for white noise towards that for weights of each pixel, by conjugate gradients.

    Few steps do: dark pixels, which are most, are served in the first, and what a bright core says of itself it has
    said in the solution for white noise.

    Args:
        solved: (M, M, aliases^2) aliases of each frequency in units of their prior.
        phases: (M, M, N, aliases^2) what the images' spectra are of them, in units of the images' mean noise.
        seen: (M, M, N) the images' spectra in these units.
        weights: (M, M, N) of each pixel, about one; the chief ray's pixel is the first.
    """

    def back(spectra: Tensor) -> Tensor:
        weighted = torch.fft.fft2(weights * torch.fft.ifft2(spectra, dim=(0, 1)), dim=(0, 1))
        return (phases.mH @ weighted[..., None])[..., 0]

    level = weights.mean((0, 1))[:, None]
    factor = torch.linalg.cholesky(phases.mH @ (level * phases) + torch.eye(phases.shape[-1]).to(phases))
    rest = back(seen - (phases @ solved[..., None])[..., 0]) - solved
    step, before = torch.zeros_like(rest), 1.0
    rounding = 1e-28 * float(solved.abs().square().sum())
    for _ in range(STEPS):
        towards = torch.cholesky_solve(rest[..., None], factor)[..., 0]
        now = float((rest.conj() * towards).real.sum())
        if now <= rounding:  # images that are alike bright everywhere are solved already
            break
        step, before = towards + now / before * step, now
        change = back((phases @ step[..., None])[..., 0]) + step
        length = now / max(float((step.conj() * change).real.sum()), 1e-300)
        solved, rest = solved + length * step, rest - length * change
    return solved


def _near(side: int, like: Tensor) -> Tensor:
    """One for the pixels next to the first of a periodic image, from where weights let noise come, zero elsewhere."""
    distance = torch.fft.fftfreq(side, 1 / side).abs()
    near = (distance <= REACH).to(like)
    return near[:, None] * near


def _frequencies(length: int, band: int, device: torch.device) -> Tensor:
    """Frequencies of a spectrum that reaches beyond Nyquist, in cycles per sample."""
    return torch.fft.fftfreq(length, 1 / (2 * band), dtype=torch.float64, device=device)


def _folded(spectrum: Tensor, side: int) -> Tensor:
    """Add up the aliases: the spectrum of the samples."""
    aliases = spectrum.shape[-1] // side
    return spectrum.unflatten(-1, (aliases, side)).sum(-2).unflatten(-2, (aliases, side)).sum(-3)


def _centred(image: Tensor) -> Tensor:
    return torch.fft.fftshift(image, dim=(-2, -1))
