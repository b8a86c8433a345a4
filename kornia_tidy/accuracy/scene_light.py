"""Power spectrum of a scene's light by channel, octave and depth.

Spectra are normalised such that the sum of their product with a filter's power response is the mean square of the
filtered image.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from kornia_tidy.accuracy.depth_energy import LEVELS, Depths, brightest_around, octave_filters
from kornia_tidy.render.borders import next_fast_size, pad_border
from kornia_tidy.render.layers import layer_weights
from kornia_tidy.render.stray_light import pixels_around

CONTRAST = 0.3  # standard deviation of light assumed without an image, full scale 1; photographs have 0.13 to 0.35
GRID_RATIO = 2.0  # side of the frequency grid over the window: the autocorrelation of a PSF then does not wrap around
_BLOCK = 1024  # px; larger images are processed in blocks
ALIKE = 2.0  # rad; correlation length of changes of PSFs over defocus
_USUAL = 0.1  # weight of a photograph's spectrum in that of the scene


def spectrum_size(window: int) -> int:
    """Return the side of the frequency grid on which PSFs of a window are compared.

    It is large enough to resolve the octaves.
    """
    return next_fast_size(max(2 ** (LEVELS + 1), math.ceil(GRID_RATIO * window)))


def power_spectrum(light: Tensor, border: str, size: int) -> Tensor:
    r"""Return the power spectrum of images; its sum times a filter's power is the mean square of the filtered image.

    Args:
        light: (B, C, H, W).
        border: continuation of the image beyond its edges, see :mod:`kornia_tidy.render.borders`. Made-up light also
            counts.
        size: side N of the frequency grid.

    Returns:
        (C, N, N // 2 + 1) float64 for the half spectrum. The mean of each image is left out, as white stays white; at
        frequency zero stands what varies more slowly than the grid can tell.

    Example:
        >>> image = torch.rand(1, 1, 40, 40, dtype=torch.float64)
        >>> power = power_spectrum(image, "circular", 40)
        >>> bool(torch.isclose(power.sum(), image.var(correction=0)))
        True
    """
    light = light.double()
    varying = light - light.mean((-2, -1), keepdim=True)
    if border == "replicate":  # edges drawn out into streaks are coarser than the image, mirrored or not: take either
        drawn_out = pad_border(varying, int(size / GRID_RATIO) // 2, "replicate")
        return torch.maximum(*(_power_of_blocks(plane, "reflect", size) for plane in (varying, drawn_out)))
    power = _power_of_blocks(light if border == "zero" else varying, border, size)
    if border == "zero":  # stray light conserves the mean, except for the part spread beyond the image
        mean_square = light.mean((-2, -1)).square().mean(0).cpu()
        missed = mean_square * _dark_square(light.shape[-2:], int(size / GRID_RATIO) // 2)
        power[:, 0, 0] = _power_of_blocks(varying, "reflect", size)[:, 0, 0] + missed
    return power


def _dark_square(shape: Sequence[int], radius: int) -> float:
    """Return the mean square, over pixels, of the share of the surrounding window that lies beyond the image."""
    reach = torch.tensor([float(radius)], dtype=torch.float64)
    down, across = (pixels_around(side, reach) / (2 * radius + 1) for side in shape)
    return float((1 - down @ across.mT).square().mean())


def _power_of_blocks(light: Tensor, border: str, size: int) -> Tensor:
    total, pixels = torch.zeros((), dtype=torch.float64), 0
    for top in range(0, light.shape[-2], _BLOCK):
        for left in range(0, light.shape[-1], _BLOCK):
            block = light[..., top : top + _BLOCK, left : left + _BLOCK]
            total = total + _covariance(_endless(block, border, size), size) * block[0, 0].numel()
            pixels += block[0, 0].numel()
    return torch.fft.rfft2(total / pixels).real * (_of_two(size) / size**2)


def coarser(power: Tensor, size: int) -> Tensor:
    """Resample a power spectrum to a smaller grid by cropping its covariance.

    Example:
        >>> power = power_spectrum(torch.rand(1, 1, 40, 40, dtype=torch.float64), "circular", 20)
        >>> coarser(power, 10).shape
        torch.Size([1, 10, 6])
    """
    full = power.shape[-2]
    covariance = torch.fft.irfft2(power / _of_two(full), s=(full, full))
    lags = torch.fft.fftfreq(size, 1 / size).round().long()
    return torch.fft.rfft2(covariance[:, lags[:, None], lags]).real * ((full / size) ** 2 * _of_two(size))


def natural_power(channels: int, size: int) -> Tensor:
    """Return the power spectrum of a typical photograph: 1 / f**2, with the standard deviation ``CONTRAST``.

    The value at frequency zero is that at half the lowest frequency of the grid.

    Source: Field, Relations between the statistics of natural images and the response properties of cortical cells,
    J. Opt. Soc. Am. A 4(12), 2379 (1987).

    Example:
        >>> round(float(natural_power(1, 64).sum().sqrt()), 6) == CONTRAST
        True
    """
    down, across = torch.fft.fftfreq(size, dtype=torch.float64), torch.fft.rfftfreq(size, dtype=torch.float64)
    squared = down[:, None] ** 2 + across**2
    squared[0, 0] = (0.5 / size) ** 2
    power = _of_two(size) / squared[None]
    return (power * (CONTRAST**2 / power.sum())).expand(channels, -1, -1)


class SceneLight:
    """Power of a scene's light by channel, octave and depth, and its spectrum within each octave.

    Args:
        power: spectrum of the light, (C, N, N // 2 + 1), see :func:`power_spectrum`.
        psi: (b,) defocus in the scene, ascending.
        energies: one or more distributions of power; the one with the largest error counts. Each has shape
            (C, octaves, b) if the errors of depths add in power (gather), (C, octaves, b, b) if they add in amplitude.
    """

    def __init__(self, power: Tensor, psi: Tensor, *energies: Tensor) -> None:
        self.psi, self.energies = psi, [each if each.ndim == 3 else each.float() for each in energies]
        self._power = power
        self._shapes: dict[int, Tensor] = {}

    @classmethod
    def seen(cls, light: Tensor, depths: Depths, border: str, size: int, compositing: str) -> SceneLight:
        """Return the power distribution of an image for its compositing."""
        power = power_spectrum(light, border, size)
        if compositing == "gather":
            octaves = (power[:, None] * octave_filters(size)).sum((-2, -1))
            return cls(power, depths.psi, octaves[..., None] * depths.shares(light) / depths.seen)
        lights = [(light, False)]
        if compositing == "occlusion":  # dark objects occlude bright ones, and bright ones are seen through gaps
            lights += [(brightest_around(light) - light, False), (light, True)]
        energies = [depths.products(*each) / depths.seen for each in lights]
        if border == "zero":
            for (each, _), own in zip(lights, energies, strict=True):
                means = depths.means(each)
                missed = _dark_square(light.shape[-2:], int(size / GRID_RATIO) // 2)
                own[:, -1] += missed * means[:, :, None] * means[:, None]
        return cls(power, depths.psi, *energies)

    @classmethod
    def unseen(cls, depths: Depths, channels: int, size: int) -> SceneLight:
        """Return the power distribution of a typical photograph, the same at all depths."""
        power = natural_power(channels, size)
        octaves = (power[:, None] * octave_filters(size)).sum((-2, -1))
        return cls(power, depths.psi, octaves[..., None] * depths.share)

    def mean_square(self, squares: Tensor, alternate: bool = False) -> Iterator[float]:
        """Yield the mean square error from a change of PSFs, for each distribution of power.

        Changes at two depths are assumed fully correlated, or correlated within ``ALIKE`` radians of defocus, whichever
        gives the larger error.

        Args:
            squares: (C, octaves, b) mean square of the error for light of power one, at the depths ``psi``.
            alternate: whether changes may have opposite signs at similar depths: then they may also be independent.
        """
        for own in self.energies:
            if own.ndim == 3:
                yield float((squares * own).sum((1, 2)).mean())
                continue
            sizes = squares.sqrt().float()
            alike = torch.exp(-0.5 * ((self.psi[:, None] - self.psi) / ALIKE).square()).float()
            sums = [((each @ sizes[..., None])[..., 0] * sizes).sum(-1) for each in (own, own * alike)]
            if alternate:
                sums.append((squares * own.diagonal(dim1=-2, dim2=-1)).sum(-1))
            yield float(torch.stack([each.float() for each in sums]).amax(0).clamp(min=0).sum(1).mean())

    def depths(self, most: int) -> list[float]:
        """Return some depths of the scene, ascending, more of them where more of its pixels and light are.

        Args:
            most: how many there may be; both ends are among them.
        """
        power = sum((each if each.ndim == 3 else each.diagonal(dim1=-2, dim2=-1)).sum((0, 1)) for each in self.energies)
        mass = torch.as_tensor(power).double().clamp(min=0)
        mass = (mass / mass.sum().clamp(min=1e-30) + 1 / len(self.psi)).cumsum(0)
        at = torch.searchsorted(mass, torch.linspace(0, float(mass[-1]), most, dtype=torch.float64))
        return self.psi[at.clamp(max=len(self.psi) - 1).unique()].tolist()

    def shapes(self, window: int) -> Tensor:
        """Return the normalised spectrum within each octave, of sum one, on the frequency grid for a window.

        An octave without power in the image has the spectrum of a photograph.

        Returns:
            (C, octaves, M, M // 2 + 1) float64.
        """
        full = self._power.shape[-2]
        size = min(full, spectrum_size(window))
        if size not in self._shapes:
            power = coarser(self._power, size) if size < full else self._power
            usual = natural_power(1, size) * power.sum((-2, -1), keepdim=True).clamp(min=1e-30)
            power = power.clamp(min=0) + _USUAL * usual
            octaves = power[:, None] * octave_filters(size)
            self._shapes[size] = octaves / octaves.sum((-2, -1), keepdim=True)
        return self._shapes[size]


def interpolation(at: Tensor, nodes: Sequence[float], mode: str = "linear") -> Tensor:
    """Return the weights of interpolation between nodes, constant beyond them, (len(at), len(nodes)).

    Example:
        >>> interpolation(torch.tensor([0.5, 9.0]), (0.0, 2.0)).tolist()
        [[0.75, 0.25], [0.0, 1.0]]
    """
    weights = layer_weights(at.double().view(1, 1, 1, -1), torch.tensor(nodes, dtype=torch.float64), mode)
    return weights[0, :, 0].T


def _endless(block: Tensor, border: str, size: int) -> Tensor:
    """Extend a block to a periodic one by its border mode: mirrored, repeated, or padded with zeros."""
    height, width = block.shape[-2:]
    if border == "zero":
        return torch.nn.functional.pad(block, (0, size, 0, size)) * math.sqrt(
            (height + size) * (width + size) / (height * width)
        )
    if border == "circular":
        return block
    return torch.nn.functional.pad(block, (0, max(0, width - 2), 0, max(0, height - 2)), mode="reflect")


def _covariance(plane: Tensor, size: int) -> Tensor:
    """Return the autocovariance of a periodic plane at shifts up to half of ``size``, (C, size, size)."""
    height, width = plane.shape[-2:]
    power = torch.fft.rfft2(plane).abs().square().mean(0) / (height * width)
    lags = torch.fft.fftfreq(size, 1 / size).round().long()
    return torch.fft.irfft2(power, s=(height, width))[:, (lags % height)[:, None], lags % width].cpu()


def _of_two(size: int) -> Tensor:
    """Return how many frequencies each column of a half spectrum represents."""
    return torch.tensor([1.0] + [2.0] * ((size - 1) // 2) + [1.0] * (1 - size % 2), dtype=torch.float64)
