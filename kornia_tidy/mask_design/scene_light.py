"""Light of scenes for mask design: power spectrum, mean and spread, and what of it a linear restoration loses."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from kornia_tidy.checks import check_positive
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.render.borders import next_fast_size
from kornia_tidy.sensor.noise import SensorNoise

_REFINED, _POINTS = 8, 16  # bins around frequency zero whose average is taken over 16 x 16 points


@dataclass(frozen=True)
class SceneLight:
    r"""Statistics of scenes in linear light, white = 1.

    .. math:: S(f) \propto (f^2 + f_0^2)^{-\gamma / 2}

    Args:
        slope: exponent :math:`\gamma` of the power spectrum.
        knee: :math:`f_0` in cycles per pixel, below which the spectrum is flat.
        mean: mean light.
        spread: standard deviation of the light over all pixels.

    Raises:
        ValueError: if a number is not positive and finite.

    Source: the defaults were measured on 13 photographs with depth (Middlebury, 7-Scenes, TUM, KITTI, SUN), 22
    November 2026.

    Example:
        >>> SceneLight().slope
        2.9
    """

    slope: float = 2.9
    knee: float = 1 / 256
    mean: float = 0.29
    spread: float = 0.23

    def __post_init__(self) -> None:
        for name in ("slope", "knee", "mean", "spread"):
            check_positive(name, getattr(self, name))

    def variances(self, size: tuple[int, int]) -> Tensor:
        """Return the expected power of each frequency of a plane, as a share of the light's variance.

        Args:
            size: rows M and columns N of the plane.

        Returns:
            (M, N // 2 + 1) float64, the half spectrum; the whole spectrum sums to one. Each is the average over the
            frequencies around it, because the spectrum is steep near zero.

        Example:
            >>> shares = SceneLight().variances((8, 8))
            >>> shares.shape, bool(shares[0, 0] > shares[1, 1] > shares[4, 4])
            (torch.Size([8, 5]), True)
        """
        rows = torch.fft.fftfreq(size[0], dtype=torch.float64)
        columns = torch.fft.rfftfreq(size[1], dtype=torch.float64)
        power = self._power(rows[:, None].square() + columns.square())
        offsets = (torch.arange(_POINTS, dtype=torch.float64) + 0.5) / _POINTS - 0.5
        fine_rows = (rows[:, None] + offsets / size[0])[rows.abs() * size[0] < _REFINED]
        fine_columns = (columns[:, None] + offsets / size[1])[columns * size[1] < _REFINED]
        fine = self._power(fine_rows[:, :, None, None].square() + fine_columns.square()).mean((1, 3))
        near = (rows.abs() * size[0] < _REFINED).nonzero()
        power[near, (columns * size[1] < _REFINED).nonzero()[:, 0]] = fine
        return power / (power * counted_twice(size[1])).sum()

    def _power(self, squared_frequency: Tensor) -> Tensor:
        return (squared_frequency + self.knee**2) ** (-self.slope / 2)


def counted_twice(columns: int) -> Tensor:
    """Return how often each column of a half spectrum stands in the whole one, (columns // 2 + 1,) float64.

    Example:
        >>> counted_twice(4)
        tensor([1., 2., 1.], dtype=torch.float64)
    """
    count = torch.full((columns // 2 + 1,), 2.0, dtype=torch.float64)
    count[0] = 1
    if columns % 2 == 0:
        count[-1] = 1
    return count


def noise_variance(sensor: SensorNoise, light: SceneLight) -> float:
    """Return the variance of a sensor's noise at the mean light of scenes, full scale 1.

    Example:
        >>> noise_variance(SensorNoise(0.0, full_well=1000.0), SceneLight(mean=0.3))
        0.0003
    """
    return float(f"{float(sensor.std(torch.tensor(light.mean, dtype=torch.float64))) ** 2:.12g}")


def lost_variance(bank: PSFBank, light: SceneLight, sensor: SensorNoise) -> Tensor:
    r"""Return the share of the scenes' variance that the best linear restoration with one filter for all depths loses.

    .. math:: \sum_f v_f \left( 1 - \frac{|\langle H_f \rangle|^2}{\langle |H_f|^2 \rangle + r / v_f} \right)

    H is the transfer function, :math:`\langle\rangle` the mean over the depths of the bank, v the scenes' power
    spectrum, of sum one, and r the variance of the noise in a frequency over that of the light.

    Args:
        bank: PSFs. The light outside their window counts as a uniform background.
        light: statistics of the scenes.
        sensor: gives the noise at the mean light.

    Returns:
        0-dimensional, between 0 and 1, the mean over the channels; gradients reach the PSFs.

    Source: Diaz, Goudail, Loiseaux and Huignard, Optics Letters 34(19) 2970 (2009).

    Example:
        >>> point = torch.zeros(2, 1, 9, 9)
        >>> point[..., 4, 4] = 1
        >>> bank = PSFBank(point, torch.tensor([-1.0, 1.0]), torch.ones(2, 1))
        >>> bool(lost_variance(bank, SceneLight(), SensorNoise(1e-6)) < 1e-4)
        True
    """
    size = next_fast_size(2 * bank.window)
    shares = light.variances((size, size)).to(bank.psfs)
    transfer = torch.fft.rfft2(bank.psfs, s=(size, size))
    mean, power = depth_moments(transfer, bank.psfs.sum((-2, -1)))
    ratio = noise_variance(sensor, light) / light.spread**2 / size**2
    kept = (mean.real.square() + mean.imag.square()) / (power + ratio / shares)
    return (shares * counted_twice(size).to(shares) * (1 - kept)).sum((-2, -1)).mean()


def depth_moments(transfer: Tensor, inside: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean and mean squared modulus over depth of transfer functions, the light outside the window added to DC.

    Args:
        transfer: (D, C, M, N // 2 + 1) complex.
        inside: (D, C) share of the light in the PSFs.

    Returns:
        (C, M, N // 2 + 1) complex, and (C, M, N // 2 + 1).
    """
    uniform = torch.zeros_like(transfer)
    uniform[..., 0, 0] = (1 - inside).to(transfer)
    transfer = transfer + uniform
    return transfer.mean(0), (transfer.real.square() + transfer.imag.square()).mean(0)
