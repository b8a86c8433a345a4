"""Restoration in closed form whose settings follow from the PSFs and the noise by one rule for all cameras."""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Tensor

from kornia_tidy.data.scene_statistics import PHOTOGRAPHS
from kornia_tidy.reconstruction.closed_form import (
    LEAST_NOISE,
    STEP,
    WIENER_NOISES,
    ClosedForm,
    Restoration,
    light_detail,
)
from kornia_tidy.reconstruction.tikhonov import transfer_function
from kornia_tidy.reconstruction.wiener import inverse_spectrum, transfer_moments
from kornia_tidy.render.borders import next_fast_size

BANDS = (1 / 16, 1 / 8, 1 / 4)  # cycles a pixel, between four bands of spatial frequency
PLANE = 64  # samples along a side of the transfer function, for averages over bands
CLIPPED = 0.999  # of full scale: a pixel at or above it holds no more than that its light was at least so much
COLOR, SCENE_SHARE = 5.3, 0.3  # of the width in colour by the predicted error; share of the scene's part that counts
CONTENT = (0.03, 4.0)  # least and largest ratio of a scene's fine detail to that of photographs
LEAST_DETAIL = 0.1  # of the variance of noise: below it nothing is known of the scene
STEPS = 20  # places between two kernels among which the best is sought
CAMERA_MAPS = 10
"""Maps that tell a network of the camera: validity, noise left by the filter, and in each of four bands of frequency
the expected error and the mean transfer."""


class RuledClosedForm(ClosedForm):
    r"""Wiener filter and bilateral filter with settings that follow from the PSFs and the noise of the capture.

    The settings of :class:`~kornia_tidy.reconstruction.closed_form.ClosedForm` were chosen behind one camera. Here
    noise is even over the picture, with its mean variance :math:`\sigma^2`, and the kernel k minimises the predicted
    error:

    .. math:: J(k) = r \int S \, \big\langle |1 - K H|^2 \big\rangle \, df + \sigma^2 \lVert k \rVert_2^2

    S is the power spectrum of photographs, and r this scene's share of it: the power of differences between
    neighbouring pixels of the capture, less that of noise, over the one that photographs would have behind this camera;
    between .03 and 4. Kernels are of bounded size, so a PSF that fills its window is inverted less sharply. The width c
    of the bilateral filter in colour follows the predicted error, of which the filter takes noise well and what the
    kernel left of the scene less:

    .. math:: c = 5.3 \, \sqrt{\sigma^2 \lVert k \rVert_2^2 + 0.3 \, r \int S \, \langle |1 - K H|^2 \rangle \, df}

    The form was found on painted scenes behind the training cameras of ``tests/benchmarks/any_camera``, its two numbers
    on six real scenes of half A. ``docs/record`` says how near it comes to the best choice behind each camera.

    Args:
        layers: number of depths with a deconvolution of the brightness for each, as inputs of a network.
        encoded: captures are encoded as sRGB. False: they are linear light.

    Shape:
        - capture: (B, 3, H, W); clipped pixels may hold more than 1, see
          :func:`~kornia_tidy.reconstruction.clipped.estimate_clipped`.
        - noise: as for :class:`~kornia_tidy.reconstruction.closed_form.ClosedForm`; its mean variance is taken.
        - output: :class:`~kornia_tidy.reconstruction.closed_form.Restoration`, with ``CAMERA_MAPS`` more maps.

    Raises:
        TypeError: as :class:`~kornia_tidy.reconstruction.closed_form.ClosedForm`.
        ValueError: as :class:`~kornia_tidy.reconstruction.closed_form.ClosedForm`.

    Convention:
        - For tiles the mean of the noise follows from the mean light of the whole picture, see
          :func:`~kornia_tidy.reconstruction.whole_picture.whole_picture`.

    Source: Wiener (1949); Tomasi and Manduchi, Bilateral Filtering (ICCV 1998).

    Example:
        >>> from kornia_tidy.psf.psf_bank import PSFBank
        >>> restore = RuledClosedForm()
        >>> restore.set_psfs(PSFBank.from_measured(torch.rand(11, 3, 5, 5), torch.arange(11.0)))
        >>> restored = restore(torch.rand(2, 3, 16, 20), torch.tensor(0.01))
        >>> restored.image.shape, restored.maps.shape
        (torch.Size([2, 3, 16, 20]), torch.Size([2, 29, 16, 20]))
    """

    even_noise = True
    norms: Tensor
    scene_errors: Tensor
    photographs_detail: Tensor
    bands: Tensor

    def __init__(self, layers: int = 0, *, encoded: bool = True) -> None:
        super().__init__(layers, encoded=encoded, inverse="wiener")
        kinds = len(WIENER_NOISES)
        for name, shape in (("norms", (kinds,)), ("scene_errors", (kinds,)), ("photographs_detail", ())):
            self.register_buffer(name, torch.ones(shape), persistent=False)
        self.register_buffer("bands", torch.zeros(2, kinds, len(BANDS) + 1), persistent=False)

    def _set_kernels(self, psfs: Tensor) -> None:
        super()._set_kernels(psfs)
        psfs, kernels = psfs.detach().to(self.kernels.dtype), self.kernels.detach()
        self.norms = kernels.square().sum((-2, -1)).mean(1).sqrt()
        self.scene_errors, self.photographs_detail = predicted_errors(psfs, kernels)
        self.bands = band_facts(psfs)

    def noise_map(self, capture: Tensor, noise: Tensor | float | None = None) -> Tensor:
        """Return the standard deviation of even noise with the mean variance of the capture's, (B, 3, H, W)."""
        if noise is None and self.mean_light is not None:
            dark, rise = self.noise_model.to(capture.dtype)
            variance = dark + rise * self.mean_light.to(capture).clamp(0, 1).mean(1, keepdim=True)
        else:
            each = super().noise_map(capture, noise).square().nan_to_num()
            variance = each.mean((1, 2, 3), keepdim=True)
        return variance.sqrt().expand(capture.shape)

    def _restore(self, capture: Tensor, noise: Tensor) -> Restoration:
        restored = super()._restore(capture, noise)
        maps = [capture.clamp(max=1), restored.maps[:, 3:], self._camera_maps(capture, noise[:, :1, :1, :1])]
        return restored._replace(maps=torch.cat(maps, 1))

    def expected_error(self, capture: Tensor, noise: Tensor | float | None = None) -> Tensor:
        """Return the root mean square error of photographs that is expected behind this camera, in linear light.

        Args:
            capture: (B, 3, H, W).
            noise: as for :meth:`forward`.

        Returns:
            (B, 1, 1, 1), of scenes with as much detail as photographs have, by the kernel that the capture gets.
        """
        even = self.noise_map(capture, noise)[:, :1, :1, :1].clamp(min=LEAST_NOISE)
        place, _, left = self._best(even, self._light(capture))
        return (left + _at(self.scene_errors.log()[:, None], place).exp()[:, :, None, None]).sqrt()

    def _place(self, level: Tensor, light: Tensor) -> Tensor:
        return self._best(10 ** level[:, :1, :1, :1], light)[0]

    def _color(self, noise: Tensor, light: Tensor) -> Tensor:
        _, scene, left = self._best(noise[:, :1, :1, :1].clamp(min=LEAST_NOISE), light)
        return COLOR * (left + SCENE_SHARE * scene).sqrt()

    def _best(self, noise: Tensor, light: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the place of the kernel with the least predicted error, and both parts of it, all (B, 1, 1, 1)."""
        detail = light_detail(light) if self.detail is None else self.detail.to(light)
        variance = noise.flatten().square()
        power = (detail - 2 * variance).clamp(min=LEAST_DETAIL * variance)
        content = (power / self.photographs_detail.to(light)).clamp(*CONTENT)
        logs = torch.stack([self.scene_errors, self.norms.square()]).clamp(min=1e-12).log().double()
        curve = _cubic(len(self.norms), STEPS).to(logs.device)
        scene = content[:, None] * (curve @ logs[0]).exp().to(light)
        left = variance[:, None] * (curve @ logs[1]).exp().to(light)
        best = (scene + left).argmin(1, keepdim=True)
        parts = (best / STEPS, scene.gather(1, best), left.gather(1, best))
        return tuple(part.to(light)[:, :, None, None] for part in parts)  # ty: ignore[invalid-explicit-return]

    def _left(self, noise: Tensor, place: Tensor) -> Tensor:
        """Return the standard deviation of the noise that a kernel leaves of even noise, all (B, 1, 1, 1)."""
        curve = (_at(self.norms.log()[:, None], place)).exp()
        return noise * curve[:, :, None, None]

    def _camera_maps(self, capture: Tensor, noise: Tensor) -> Tensor:
        """Return maps of the camera's and each pixel's properties, (B, CAMERA_MAPS, H, W)."""
        noise = noise.clamp(min=LEAST_NOISE)
        place = (noise.log10() - math.log10(WIENER_NOISES[0])) / STEP
        facts = [self._left(noise, place)[..., 0, 0].log10() + 2, *(_at(table, place) for table in self.bands)]
        told = torch.cat(facts, 1).to(capture)[:, :, None, None].expand(-1, -1, *capture.shape[-2:])
        return torch.cat([(capture < CLIPPED).all(1, keepdim=True).to(capture), told], 1)


def predicted_errors(psfs: Tensor, kernels: Tensor) -> tuple[Tensor, Tensor]:
    r"""Return the mean squared error of photographs without noise by each kernel, and their detail behind the camera.

    .. math:: \int S \, \big\langle |1 - K H|^2 \big\rangle \, df, \qquad
              \int S \, \langle |H|^2 \rangle (2 - \cos 2 \pi f_x - \cos 2 \pi f_y) \, df

    Args:
        psfs: (D, C, P, P) with P odd, at depths of evenly spaced defocus, from the farthest to the nearest.
        kernels: (N, C, Q, Q) with Q odd.

    Returns:
        (N,) in linear light, mean over the colours; and :func:`light_detail` of captures without noise, a scalar.

    Example:
        >>> point = torch.zeros(2, 1, 3, 3)
        >>> point[..., 1, 1] = 1.0
        >>> errors, _ = predicted_errors(point, torch.cat([point[:1], 0.5 * point[:1]]))
        >>> bool(errors[0].abs() < 1e-6), bool(errors[1] > 10 * errors[0].abs())
        (True, True)
    """
    side = next_fast_size(psfs.shape[-1] + kernels.shape[-1])
    size = (side, side)
    moments = transfer_moments(psfs, size, _shares(psfs))
    inverse = transfer_function(kernels, size)
    power = _scene_power(side).to(psfs)
    squared = inverse.real.square() + inverse.imag.square()
    left = 1 - 2 * (inverse * moments.mean).real + squared * moments.power
    down, across = torch.fft.fftfreq(side)[:, None], torch.fft.rfftfreq(side)
    differences = (2 - (2 * math.pi * down).cos() - (2 * math.pi * across).cos()).to(psfs)
    return (left * power).sum((-2, -1)).mean(1), (moments.power.mean(0) * differences * power).sum()


def band_facts(psfs: Tensor) -> Tensor:
    r"""Return the share of a scene's power that is not restored, and the transfer, in bands of frequency.

    .. math:: e_b = \frac{\sum_b S \, \big(1 - |\langle H \rangle|^2 / (\langle |H|^2 \rangle + \sigma^2 / S)\big)}
              {\sum_b S}

    Args:
        psfs: (D, C, P, P) with P odd, at depths of evenly spaced defocus, from the farthest to the nearest.

    Returns:
        (2, N, 4) for N noises: e in each band, mean over the colours, and the mean of
        :math:`|\langle H \rangle|`, which does not depend on the noise.

    Source: the error of Wiener's filter, see :func:`kornia_tidy.reconstruction.wiener.wiener`.

    Example:
        >>> point = torch.zeros(2, 1, 3, 3)
        >>> point[..., 1, 1] = 1.0
        >>> lost, transfer = band_facts(point)
        >>> bool((lost[0] < lost[-1]).all()), bool(((transfer - 1).abs() < 1e-6).all())
        (True, True)
    """
    size = (PLANE, PLANE)
    moments = transfer_moments(psfs, size, _shares(psfs))
    squared = moments.mean.real.square() + moments.mean.imag.square()
    to_scene = inverse_spectrum(PHOTOGRAPHS, size).to(psfs)
    frequency = torch.hypot(
        torch.fft.fftfreq(PLANE, device=psfs.device)[:, None], torch.fft.rfftfreq(PLANE, device=psfs.device)
    )
    band = torch.bucketize(frequency, frequency.new_tensor(BANDS))
    members = torch.stack([band == index for index in range(len(BANDS) + 1)]).to(psfs)
    members[0, 0, 0] = 0  # white is restored
    power = members / to_scene
    variances = psfs.new_tensor(WIENER_NOISES)[:, None, None, None].square()
    lost = (1 - squared / (moments.power + variances * to_scene)).mean(1)
    errors = (lost[:, None] * power).sum((-2, -1)) / power.sum((-2, -1))
    transfer = (squared.sqrt().mean(0) * members).sum((-2, -1)) / members.sum((-2, -1))
    return torch.stack([errors, transfer.expand_as(errors)])


def _shares(psfs: Tensor) -> Tensor:
    """Return the share of pixels of photographs at each depth."""
    return PHOTOGRAPHS.depth_weights(torch.linspace(-1.0, 1.0, len(psfs), dtype=torch.float64)).to(psfs)


@lru_cache(maxsize=4)
def _scene_power(side: int) -> Tensor:
    """Return the power of photographs on a half spectrum, but that of white, which is restored; it is not changed."""
    power = PHOTOGRAPHS.cell_power(side)
    power[0, 0] = 0
    return power


@lru_cache(maxsize=1)
def _cubic(nodes: int, steps: int) -> Tensor:
    """Return the matrix that interpolates values at nodes by their polynomial, ``steps`` places from each to the next.

    Source: Lagrange's formula.
    """
    places = torch.arange((nodes - 1) * steps + 1, dtype=torch.float64) / steps
    columns = []
    for own in range(nodes):
        others = [other for other in range(nodes) if other != own]
        columns.append(torch.stack([(places - other) / (own - other) for other in others]).prod(0))
    return torch.stack(columns, 1)


def _at(table: Tensor, place: Tensor) -> Tensor:
    """Interpolate linearly between the rows of a table (N, M) at places (B, 1, 1, 1); the result is (B, M)."""
    steps = torch.arange(len(table), device=table.device)
    shares = (1 - (place.flatten()[:, None].clamp(0, len(table) - 1) - steps).abs()).clamp(min=0)
    return shares.to(table) @ table
