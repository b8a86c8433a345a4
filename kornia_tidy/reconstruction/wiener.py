"""Wiener restoration of captures by the statistics of scenes, one filter for all depths.

Captures must be linear light. See :mod:`kornia_tidy.reconstruction.tikhonov` for the treatment of borders.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from kornia_tidy.checks import check_float_tensor, check_number, check_part
from kornia_tidy.data.scene_statistics import PHOTOGRAPHS, SceneStatistics
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.reconstruction.periodic import periodic_extension
from kornia_tidy.reconstruction.tikhonov import Inversion, plane_of, transfer_function
from kornia_tidy.sensor.sensor import SensorNoise


def wiener(
    capture: Tensor,
    psfs: Tensor,
    noise: float | Tensor,
    statistics: SceneStatistics = PHOTOGRAPHS,
    *,
    depth_weights: Tensor | None = None,
    veil: Tensor | None = None,
    border: str = "smooth",
) -> Tensor:
    r"""Restore a capture by the linear filter of least mean squared error over depths, scenes and noise.

    .. math:: X = \frac{\bar{\langle H \rangle} \, Y}{\langle |H|^2 \rangle + \sigma^2 / S}

    H is the transfer function, :math:`\langle\rangle` the mean over depth, and S the power spectrum of scenes. Where
    PSFs differ between depths, :math:`\langle |H|^2 \rangle` exceeds :math:`|\langle H \rangle|^2`, and the filter
    amplifies less. Its error is :func:`kornia_tidy.design.restoration_error`.

    Args:
        capture: y, (B, C, H, W) linear light.
        psfs: h, (D, C, P, P) with P odd.
        noise: standard deviation :math:`\sigma` of the noise in units of full scale, not negative; a number, or a
            tensor that broadcasts to (B, C, 1, 1).
        statistics: of the scenes; gives S.
        depth_weights: (D,) share of pixels at each depth, of sum one. Default: equal.
        veil: (D, C) stray light, the fraction of light spread evenly over the image, or None.
        border: ``"smooth"`` or ``"circular"``.

    Returns:
        (B, C, H, W) in the capture's dtype, computed in float32 or better, also under autocast. It is neither clamped
        nor checked for NaN. White stays white to :math:`\sigma^2 / S(0)`, 2e-7 for a noise of 0.01.

    Raises:
        TypeError: if a tensor is not floating point.
        ValueError: if shapes do not fit, or the noise is negative.

    Convention:
        It inverts a convolution; for captures made with ``correlate=True`` flip the PSFs by ``psfs.flip(-2, -1)``.

    Source: Wiener (1949); Diaz, Goudail, Loiseaux and Huignard, Optics Letters 34(19) 2970 (2009), for one filter that
    serves all depths.

    Example:
        >>> points = torch.zeros(2, 1, 3, 3)
        >>> points[..., 1, 2] = 1.0  # moves every point to the right
        >>> capture = torch.tensor([0.0, 0.0, 1.0, 0.0]).view(1, 1, 1, 4)
        >>> wiener(capture, points, 1e-4, border="circular").flatten() > 0.99
        tensor([False,  True, False, False])
    """
    check_float_tensor("psfs", psfs, 4, "(D, C, P, P)")
    if not isinstance(noise, Tensor):
        _check_noise(noise)
    size = plane_of(capture, psfs, border)
    if not len(capture):
        return capture.clone()
    precise = torch.promote_types(torch.promote_types(capture.dtype, psfs.dtype), torch.float32)
    captured = torch.fft.rfft2(periodic_extension(capture.to(precise), size))
    moments = transfer_moments(psfs.to(precise), size, depth_weights, veil)
    noise_power = torch.as_tensor(noise, dtype=precise, device=capture.device).square()
    plane = restored_plane(captured, moments, noise_power * inverse_spectrum(statistics, size).to(moments.power), size)
    return plane[..., : capture.shape[-2], : capture.shape[-1]].to(capture.dtype)


class TransferMoments(NamedTuple):
    """Mean over depth of the transfer function and of its squared modulus."""

    mean: Tensor
    """(C, M, N // 2 + 1) complex."""
    power: Tensor
    """(C, M, N // 2 + 1) real, at least the squared modulus of the mean."""


def transfer_moments(
    psfs: Tensor, size: tuple[int, int], depth_weights: Tensor | None = None, veil: Tensor | None = None
) -> TransferMoments:
    """Return the mean over depth of the transfer function and of its squared modulus, on a periodic plane.

    The squared modulus is the transform of the autocorrelation, whose mean over depth fills a small window. So only two
    small windows per channel are transformed to the plane.

    Args:
        psfs: (D, C, P, P) with P odd, float32 or float64.
        size: rows M and columns N of the plane.
        depth_weights: (D,) share of pixels at each depth, of sum one. Default: equal.
        veil: (D, C) stray light, the fraction of light spread evenly over the plane, or None.

    Example:
        >>> points = torch.zeros(2, 1, 3, 3)
        >>> points[0, 0, 1, 1], points[1, 0, 1, 1] = 1.0, 0.5
        >>> mean, power = transfer_moments(points, (2, 2))
        >>> mean.real.unique(), power.unique()
        (tensor([0.7500]), tensor([0.6250]))
    """
    share = psfs.new_full((len(psfs),), 1 / len(psfs)) if depth_weights is None else depth_weights.to(psfs)
    share = (share / share.sum())[:, None, None, None]  # no matrix products, which autocast would round
    side = 2 * psfs.shape[-1]
    window = torch.fft.rfft2(psfs, s=(side, side))
    squared = (share * (window.real.square() + window.imag.square())).sum(0)
    autocorrelation = torch.fft.fftshift(torch.fft.irfft2(squared, s=(side, side)), (-2, -1))[..., 1:, 1:]
    mean = transfer_function((share * psfs).sum(0), size)
    power = transfer_function(autocorrelation, size).real
    if veil is not None:
        veil, light = veil.to(psfs), psfs.sum((-2, -1))
        added = share[..., 0, 0] * veil
        mean = mean + _at_zero(added.sum(0), size)
        power = power + _at_zero((added * (2 * light + veil)).sum(0), size)
    return TransferMoments(mean, power.maximum(mean.real.square() + mean.imag.square()))


def restored_plane(captured: Tensor, moments: TransferMoments, noise_to_scene: Tensor, size: tuple[int, int]) -> Tensor:
    """Return the plane that the Wiener filter restores from the half spectrum of a capture. See :func:`wiener`.

    Args:
        captured: (B, C, M, N // 2 + 1).
        moments: of the PSFs.
        noise_to_scene: noise power over the power spectrum of scenes.
        size: rows M and columns N of the plane.
    """
    return torch.fft.irfft2(moments.mean.conj() * captured / (moments.power + noise_to_scene), s=size)


def _at_zero(values: Tensor, size: tuple[int, int]) -> Tensor:
    """Return a half spectrum of one value per channel at frequency zero, and zeros."""
    return functional.pad(values[..., None, None], (0, size[1] // 2, 0, size[0] - 1))


def inverse_spectrum(statistics: SceneStatistics, size: tuple[int, int]) -> Tensor:
    """Return one over the power spectral density of scenes on the half spectrum of a plane.

    Args:
        statistics: of the scenes.
        size: rows M and columns N of the plane.

    Returns:
        (M, N // 2 + 1) float64.

    Example:
        >>> bool((inverse_spectrum(PHOTOGRAPHS, (8, 8)).diff(dim=1) > 0).all())
        True
    """
    rows, columns = size
    down = torch.fft.fftfreq(rows, dtype=torch.float64, device="cpu")  # not every default device has float64
    across = torch.fft.rfftfreq(columns, dtype=torch.float64, device="cpu")
    return statistics.spectrum(torch.hypot(down[:, None], across)).reciprocal()


class Wiener(Inversion):
    """Wiener restoration with one filter for all layers, by the statistics of scenes. See :func:`wiener`.

    Args:
        noise: standard deviation of the noise in units of full scale, or the sensor, whose noise at the mean light of
            each channel is taken.
        statistics: of the scenes; they also say how the layers of a bank are weighted.
        weight: factor of the ratio of noise to scene power, learnt as a logarithm. 1 is optimal for true statistics.
        border: as for :class:`~kornia_tidy.reconstruction.tikhonov.Inversion`.
        correlate: as for :class:`~kornia_tidy.reconstruction.tikhonov.Inversion`.

    Shape:
        - ``(capture, bank)``: (B, C, H, W) linear light and a bank of C channels, to (B, C, H, W).
        - ``log_weight``: learnable scalar.

    Example:
        >>> bank = PSFBank.from_measured(torch.rand(4, 3, 5, 5), torch.arange(4.0))
        >>> round(Wiener(SensorNoise(0.01))(torch.ones(1, 3, 16, 20), bank).mean().item(), 3)
        1.0
    """

    def __init__(
        self,
        noise: float | SensorNoise = 0.01,
        statistics: SceneStatistics = PHOTOGRAPHS,
        weight: float = 1.0,
        border: str = "smooth",
        *,
        correlate: bool = False,
    ) -> None:
        super().__init__(weight, border, correlate=correlate)
        check_part("statistics", statistics, SceneStatistics, "SceneStatistics such as PHOTOGRAPHS")
        if not isinstance(noise, SensorNoise):
            _check_noise(noise)
        self.noise, self.statistics = noise, statistics

    def forward(self, capture: Tensor, bank: PSFBank, noise: Tensor | None = None) -> Tensor:
        """Return the estimate of the all-in-focus image.

        Args:
            capture: (B, C, H, W) linear light.
            bank: of C channels.
            noise: standard deviation of the noise that broadcasts to (B, C, 1, 1), in place of the module's own.
        """
        known: float | Tensor | SensorNoise = self.noise if noise is None else noise
        if isinstance(known, SensorNoise):
            known = known.std(capture.to(self.weight.dtype).mean((-2, -1), keepdim=True))
        return wiener(
            capture,
            self._psfs(bank),
            known * self.weight.sqrt(),
            self.statistics,
            depth_weights=self.statistics.depth_weights(bank.defocus),
            veil=bank.veil,
            border=self.border,
        )


def _check_noise(noise: float) -> None:
    check_number("noise", noise, "units of full scale")
    if not 0 <= noise < float("inf"):
        raise ValueError(f"noise must be a standard deviation of at least 0 in units of full scale, got {noise}")
