"""Closed-form restoration and depth estimation, with which co-design compares cameras without training a network."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from kornia.color import linear_rgb_to_rgb
from torch import Tensor
from torch.nn import functional

from kornia_tidy.data.scene_statistics import SceneStatistics
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.reconstruction.periodic import periodic_extension
from kornia_tidy.reconstruction.tikhonov import transfer_function
from kornia_tidy.reconstruction.wiener import inverse_spectrum, restored_plane, transfer_moments
from kornia_tidy.render.borders import next_fast_size

NOISE_FACTORS = (0.03, 0.15, 0.8, 4.0)  # of the noise that the Wiener filter assumes
BILATERAL = (0.0, 0.07, 0.14, 0.28)  # range of the bilateral filter in sRGB values; 0: none
BILATERAL_WIDTH, BILATERAL_SPACE = 7, 2.0  # pixels
DEPTHS = 11  # at which the likelihood is computed
CONTRASTS = (1 / 4, 8.0)  # of a texture's variance to that of all scenes
MISFIT = 10.0  # times the noise: edges of depth and other light that one PSF does not explain
WINDOWS = (15, 31)  # px; side of the squares over which the likelihood is summed
TEMPERATURES = (4.0, 16.0, 64.0)  # divisor of the log-likelihood: neighbouring pixels are not independent


class WienerFilter:
    """Wiener filter of one camera for captures of one size. See :func:`~kornia_tidy.reconstruction.wiener.wiener`.

    Args:
        bank: PSFs, with their stray light.
        noise: standard deviation in units of full scale.
        statistics: of the scenes.
        size: (H, W) of the captures.

    Example:
        >>> from kornia_tidy.data.scene_statistics import PHOTOGRAPHS
        >>> point = torch.zeros(2, 3, 9, 9)
        >>> point[..., 4, 4] = 1
        >>> bank = PSFBank(point, torch.tensor([-1.0, 1.0]), torch.ones(2, 3))
        >>> capture = torch.rand(1, 3, 16, 16)
        >>> torch.allclose(WienerFilter(bank, 1e-4, PHOTOGRAPHS, (16, 16))(capture)[0], capture, atol=1e-3)
        True
    """

    def __init__(self, bank: PSFBank, noise: float, statistics: SceneStatistics, size: tuple[int, int]) -> None:
        self.size = plane_size(bank, size)
        shares = statistics.depth_weights(bank.defocus)
        self.moments = transfer_moments(bank.psfs, self.size, shares, bank.veil)
        self.noise_to_scene = noise**2 * inverse_spectrum(statistics, self.size).to(self.moments.power)

    def __call__(self, capture: Tensor, noise_factors: Sequence[float] = (1.0,)) -> list[Tensor]:
        """Return the restored images of a capture (B, C, H, W), for so many times the variance of the noise."""
        captured = torch.fft.rfft2(periodic_extension(capture, self.size))
        height, width = capture.shape[-2:]
        planes = (
            restored_plane(captured, self.moments, factor * self.noise_to_scene, self.size) for factor in noise_factors
        )
        return [plane[..., :height, :width] for plane in planes]


def plane_size(bank: PSFBank, size: tuple[int, int]) -> tuple[int, int]:
    """Return the periodic plane for captures of a size (H, W): wider by a PSF, with fast transforms."""
    return next_fast_size(size[0] + bank.window), next_fast_size(size[1] + bank.window)


def restorations(capture: Tensor, wiener: WienerFilter, by_depth: dict[str, Tensor] | None = None) -> dict[str, Tensor]:
    """Return the restorations of a capture: none and the Wiener filter, each without and with bilateral filter.

    Args:
        capture: (1, 3, H, W) linear light.
        wiener: of the camera.
        by_depth: further restorations in linear light by name, see :func:`restored_by_depth`.

    Returns:
        By a name of the setting, (1, 3, H, W) sRGB in [0, 1].

    Source: Tomasi and Manduchi, Bilateral Filtering for Gray and Color Images (ICCV 1998).
    """
    names = (f"Wiener x {factor:g}" for factor in NOISE_FACTORS)
    lights = {"capture": capture, **dict(zip(names, wiener(capture, NOISE_FACTORS), strict=True)), **(by_depth or {})}
    images = {}
    for name, light in lights.items():
        encoded = linear_rgb_to_rgb(light.clamp(0, 1))
        pixels = np.ascontiguousarray(encoded[0].permute(1, 2, 0).float().numpy())
        for scale in BILATERAL:
            if scale == 0:
                images[name] = encoded
                continue
            smooth = cv2.bilateralFilter(pixels, BILATERAL_WIDTH, scale, BILATERAL_SPACE)
            images[f"{name}, bilateral {scale:g}"] = torch.from_numpy(smooth).permute(2, 0, 1)[None]
    return images


def depth_filters(
    bank: PSFBank, noise: float, statistics: SceneStatistics, size: tuple[int, int]
) -> list[WienerFilter]:
    """Return the Wiener filter of each depth of a bank."""
    veils = [None] * len(bank.psfs) if bank.veil is None else bank.veil.split(1)
    parts = zip(bank.psfs.split(1), bank.defocus.split(1), bank.energy.split(1), veils, strict=True)
    return [WienerFilter(PSFBank(*part), noise, statistics, size) for part in parts]


def restored_by_depth(
    capture: Tensor, filters: Sequence[WienerFilter], probabilities: dict[str, Tensor]
) -> dict[str, Tensor]:
    """Return restorations by the filters of all depths, blended by the probability of each depth.

    Args:
        capture: (1, 3, H, W) linear light.
        filters: see :func:`depth_filters`.
        probabilities: of the filters' depths by name, (D, H, W), see :class:`DepthLikelihood`.

    Returns:
        By a name of the setting, (1, 3, H, W) linear light.
    """
    layers = zip(*(each(capture, NOISE_FACTORS) for each in filters), strict=True)
    blends = {}
    for factor, layer in zip(NOISE_FACTORS, layers, strict=True):
        for name, shares in probabilities.items():
            blended = (shares[:, None] * torch.cat(layer)).sum(0, keepdim=True)
            blends[f"by depth ({name}), Wiener x {factor:g}"] = blended
    return blends


class DepthLikelihood:
    r"""Depth from the texture of one capture, by the likelihood of a Gaussian scene at each depth.

    .. math:: \log p(y | d, a) = -\tfrac12 \sum_f \left( \frac{|Y_f|^2}{P_{daf}} + \log P_{daf} \right), \qquad
              P_{daf} = a \, S_f \, |H_{df}|^2 + 10 \, \sigma^2

    with the scenes' power spectrum S. The first sum is taken over a window around each pixel, of the capture filtered
    by :math:`P_{da}^{-1/2}`. The contrast a of the texture is unknown: the likelihood of a depth is the sum over some
    contrasts.

    Args:
        bank: PSFs at depths evenly spaced over the range of defocus, ascending.
        noise: standard deviation in units of full scale.
        statistics: of the scenes.
        size: (H, W) of the captures.

    Source: Levin, Fergus, Durand and Freeman, Image and Depth from a Conventional Camera with a Coded Aperture
    (SIGGRAPH 2007), for depth by the likelihood of a Gaussian scene.
    """

    def __init__(self, bank: PSFBank, noise: float, statistics: SceneStatistics, size: tuple[int, int]) -> None:
        self.size = plane_size(bank, size)
        transfer = transfer_function(bank.psfs.mean(1), self.size)  # of the grey capture
        squared = transfer.real.square() + transfer.imag.square()
        blurred = (squared / inverse_spectrum(statistics, self.size)).float()
        floor = MISFIT * noise**2 / bank.psfs.shape[1]
        power = torch.stack([contrast * blurred for contrast in CONTRASTS]) + floor
        self.filters = power.rsqrt()
        self.filters[..., 0, 0] = 0  # the mean light tells nothing
        weight = torch.full((squared.shape[-1],), 2.0)  # the half spectrum omits the conjugate frequencies
        weight[0] = 1
        self.log_power = (power.log() * weight).sum((-2, -1)) / (self.size[0] * weight.sum())
        self.log_prior = statistics.depth_weights(bank.defocus).log()
        self.mean = statistics.mean

    def __call__(self, capture: Tensor) -> dict[str, Tensor]:
        """Return the probability of each depth, (D, H, W), by a name of the setting."""
        height, width = capture.shape[-2:]
        spectrum = torch.fft.rfft2(periodic_extension(capture.mean(1) - self.mean, self.size))[0]
        planes = torch.fft.irfft2(self.filters * spectrum, s=self.size)[..., :height, :width].square()
        probabilities = {}
        for window in WINDOWS:
            local = _window_mean(planes, window)
            likelihood = -0.5 * window**2 * (local + self.log_power[..., None, None])
            for temperature in TEMPERATURES:
                posterior = (likelihood / temperature).logsumexp(0) + self.log_prior[:, None, None]
                probabilities[f"{window} px, temperature {temperature:g}"] = posterior.softmax(0)
        return probabilities


def mean_depth(probability: Tensor) -> Tensor:
    """Return normalised inverse depth, (H, W) from 0 (far) to 1: the mean of its probability (D, H, W).

    It is least wrong on average.

    Example:
        >>> mean_depth(torch.tensor([0.0, 0.5, 0.5])[:, None, None])
        tensor([[0.7500]])
    """
    return (probability * torch.linspace(0, 1, len(probability))[:, None, None]).sum(0)


def _window_mean(planes: Tensor, window: int) -> Tensor:
    """Return the mean over a square window around each pixel, as far as it lies in the image."""
    half = window // 2
    columns = functional.avg_pool2d(planes, (window, 1), 1, (half, 0), count_include_pad=False)
    return functional.avg_pool2d(columns, (1, window), 1, (0, half), count_include_pad=False)
