"""Restoration in closed form whose settings follow from the PSFs, the noise and the capture by one rule."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from kornia_tidy.data.scene_statistics import PHOTOGRAPHS
from kornia_tidy.mode import Mode, torch_mode
from kornia_tidy.reconstruction.bilateral import bilateral_filter
from kornia_tidy.reconstruction.clipped_light import CLIPPED, beyond_full_scale
from kornia_tidy.reconstruction.closed_form import (
    LEAST_NOISE,
    SPACE,
    STEP,
    WIENER_NOISES,
    WINDOW,
    ClosedForm,
    Restoration,
    interpolated,
)
from kornia_tidy.reconstruction.kernel_convolution import convolve_kernels
from kornia_tidy.reconstruction.predicted_error import depth_shares, predicted_errors
from kornia_tidy.reconstruction.tikhonov_kernels import tikhonov_kernels
from kornia_tidy.reconstruction.wiener import inverse_spectrum, transfer_moments
from kornia_tidy.reconstruction.wiener_kernels import wiener_kernels
from kornia_tidy.render.borders import pad_border

BANDS = (1 / 16, 1 / 8, 1 / 4)  # cycles a pixel, between four bands of spatial frequency
PLANE = 64  # samples along a side of the transfer function, for averages over bands
FINER = 2  # more Wiener filters, for less noise than those of the network
NOISES = tuple(WIENER_NOISES[0] * 10 ** (STEP * i) for i in range(-FINER, 0)) + WIENER_NOISES
TIKHONOV = (3e-2, 1e-2, 3e-3, 1e-3)  # weights of the filters that follow, whose inverses of wide PSFs are cut less
FILTERS = len(NOISES) + len(TIKHONOV)
BEFORE_BILATERAL = 0.3  # of the variance of noise: how much the kernel takes it for, as a bilateral filter follows
CONTENT = (0.003, 4.0)  # least and largest ratio of a scene's fine detail to that of photographs
IN_DIFFERENCES = 2.0  # of the variance of white noise: its power in the differences of neighbours
LEAST_DETAIL = 0.1  # of the variance of noise: below it nothing is known of the scene
STEPS = 20  # places between two kernels among which the best is sought
COLORS = tuple(0.01 * 2 ** (i / 2) for i in range(11))  # 0.01 to 0.32, widths of the bilateral filter in colour
USUAL, AROUND = 3.2, 2  # width in standard deviations of the restored noise about which it is sought, and steps
PERTURBED = 0.1  # of the noise: the perturbation that measures how the filter passes noise
NEAR = 5  # px, over which light is averaged to find by how much its noise is encoded
SAMPLED, SAMPLES = 160, 2  # px, side of the windows from which settings follow; their largest number along an axis
CAMERA_MAPS = 10
"""Maps that tell a network of the camera: validity, noise left by the filter, and in each of four bands of frequency
the expected error and the mean transfer."""


class Settings(NamedTuple):
    """Settings of a capture's restoration."""

    noise: Tensor
    """Standard deviation of even noise with the mean variance of the capture's, in linear light, (B, 1, 1, 1)."""
    place: Tensor
    """Of the kernel between Wiener's by rising noise and Tikhonov's by falling weight, (B, 1, 1, 1)."""
    color: Tensor
    """Width of the bilateral filter in colour, (B, 1, 1, 1); 0 for none."""
    detail: Tensor
    """Power of the scene's fine detail over that of photographs behind this camera, (B, 1, 1, 1), without bounds."""


class RuledClosedForm(ClosedForm):
    r"""Deconvolution and bilateral filter with settings that follow from the PSFs, the noise and the capture.

    The settings of :class:`~kornia_tidy.reconstruction.closed_form.ClosedForm` were chosen behind one camera. Here the
    kernel k, Wiener's for one of several noises, Tikhonov's of one of several weights, or a blend of two neighbours,
    minimises the predicted error of the encoded picture:

    .. math:: J(k) = r \int S \, \big\langle |1 - K H|^2 \big\rangle \, df + 0.3 \, s^2 \lVert k \rVert_2^2

    :math:`s^2 = \overline{(\sigma g'(y))^2}` is the mean variance of the encoded noise, g the encoding. S is the power
    spectrum of photographs, and r this scene's share of it: the power of differences between neighbouring pixels of
    the encoded capture, less that of noise, over the one that photographs would have behind this camera; between .003
    and 4 times :math:`\overline{g'^2}`. Noise counts by .3, as the bilateral filter takes noise away. Kernels are of
    bounded size, so a PSF that fills its window is inverted less sharply, and rather by Tikhonov's.

    The width c of the bilateral filter B in colour is the one of the least risk that Stein's estimate predicts for the
    picture u that the kernel restored,

    .. math:: R(c) = \overline{|B(u) - u|^2} + 2 \, \overline{n \cdot \partial_n B(u)},

    where n is noise drawn as the capture has it, restored and encoded as the capture is; the derivative is a
    difference. So texture beyond the noise is kept, and behind sharp optics in bright light c is 0.

    Clipped pixels have the light that their neighbours let expect
    (:func:`~kornia_tidy.reconstruction.clipped_light.beyond_full_scale`), so that the deconvolution rings less.

    The rule and its numbers were found on real scenes of half A behind the training cameras of
    ``tests/benchmarks/any_camera``. ``docs/record`` says how near it comes to the best choice behind each camera.

    Args:
        layers: number of depths with a deconvolution of the brightness for each, as inputs of a network.
        encoded: captures are encoded as sRGB. False: they are linear light.

    Shape:
        - capture: (B, 3, H, W).
        - noise: as for :class:`~kornia_tidy.reconstruction.closed_form.ClosedForm`.
        - output: :class:`~kornia_tidy.reconstruction.closed_form.Restoration`, with ``CAMERA_MAPS`` more maps.

    Raises:
        TypeError: as :class:`~kornia_tidy.reconstruction.closed_form.ClosedForm`.
        ValueError: as :class:`~kornia_tidy.reconstruction.closed_form.ClosedForm`.

    Convention:
        - Settings are the same all over a picture, and follow from four windows of it. Tiles take those of the whole
          picture, see :func:`~kornia_tidy.reconstruction.whole_picture.whole_picture`; a map of noise that does not
          follow from the sensor then counts by its mean over the tile.
        - No gradient reaches the settings.
        - ``in_differences`` is the power of noise in differences of neighbours, over its variance. It is 2 for white
          noise, and 0 for captures from JPEG, which takes most of it away there.

    Source: Wiener (1949); Tomasi and Manduchi, Bilateral Filtering (ICCV 1998); Stein, Estimation of the mean of a
    multivariate normal distribution (Annals of Statistics 9(6), 1981); Ramani et al., Monte-Carlo SURE (IEEE TIP
    17(9), 2008), for the derivative by a random difference.

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
    drawn: Tensor
    places: Tensor

    def __init__(self, layers: int = 0, *, encoded: bool = True) -> None:
        super().__init__(layers, encoded=encoded, inverse="wiener")
        self.in_differences = IN_DIFFERENCES
        self.remembered: dict[float | None, Settings] = {}  # of the sample, by the noise told; None: the sensor's
        places = STEPS * (FILTERS - 1) + 1
        for name, shape in (("norms", (places,)), ("scene_errors", (places,)), ("photographs_detail", ())):
            self.register_buffer(name, torch.ones(shape), persistent=False)
        self.register_buffer("bands", torch.zeros(2, len(WIENER_NOISES), len(BANDS) + 1), persistent=False)
        self.register_buffer("places", torch.zeros(0), persistent=False)
        drawn = torch.randn(3, SAMPLED, SAMPLED, generator=torch.Generator().manual_seed(0))
        self.register_buffer("drawn", drawn, persistent=False)

    def _kernels_of(self, psfs: Tensor) -> Tensor:
        filters = torch.cat([wiener_kernels(psfs, NOISES), tikhonov_kernels(psfs.mean(0), TIKHONOV)])
        known, self.places = psfs.detach(), filters.detach()
        between = torch.stack([self.places[:-1], (self.places[:-1] + self.places[1:]) / 2], 1).flatten(0, 1)
        halves = torch.cat([between, self.places[-1:]])
        errors, self.photographs_detail = predicted_errors(known, halves)
        self.scene_errors = _parabolas(errors)
        self.norms = _parabolas(halves.square().sum((-2, -1)).mean(1)).sqrt()
        self.bands = band_facts(known)
        self.remembered = {}
        return filters[FINER : len(NOISES)]

    def _chosen(self, light: Tensor, estimates: Tensor, place: Tensor) -> Tensor:
        del estimates
        kernels = self._kernels_at(place)
        return torch.cat([convolve_kernels(*one)[:, 0] for one in zip(light.split(1), kernels.split(1), strict=True)])

    def _kernels_at(self, place: Tensor) -> Tensor:
        """Return the kernels at places (B, 1, 1, 1), (B, C, Q, Q)."""
        return interpolated(self.places.to(place).expand(len(place), *self.places.shape), place)

    def settings_of(self, capture: Tensor, noise: Tensor | float | None = None) -> Settings:
        """Return the settings of a capture, in its dtype; for arguments see the class."""
        self._check(capture)
        precise = capture.to(torch.promote_types(capture.dtype, self.kernels.dtype))
        with torch.autocast(capture.device.type, enabled=False):
            light = self._without_stray_light(self._light(precise))
            found = self.settings(light, self.noise_map(precise, noise))
        return Settings(*(part.to(capture.dtype) for part in found))

    def restore_by(self, capture: Tensor, found: Settings) -> Restoration:
        """Return the restored image, and the maps for a network, with settings that are known."""
        precise = torch.promote_types(capture.dtype, self.kernels.dtype)
        with torch.autocast(capture.device.type, enabled=False):
            restored = self._by(capture.to(precise), Settings(*(part.to(precise) for part in found)))
        return Restoration(*(part.to(capture.dtype) for part in restored))

    def _restore(self, capture: Tensor, noise: Tensor) -> Restoration:
        return self._by(capture, self.settings(self._without_stray_light(self._light(capture)), noise))

    def _by(self, capture: Tensor, found: Settings) -> Restoration:
        light = self._without_stray_light(beyond_full_scale(self._light(capture), found.noise))
        restored = self._restored(capture, light, found.noise.expand_as(capture), found.place, found.color)
        return restored._replace(maps=torch.cat([restored.maps, self._camera_maps(capture, found.noise)], 1))

    def completed(self, light: Tensor) -> Tensor:
        """Return light with what is expected beyond full scale, behind the noise of the sensor."""
        return beyond_full_scale(light, self._noise_of(light).square().mean((1, 2, 3), keepdim=True).sqrt())

    def _smooth(self, image: Tensor, color: Tensor) -> Tensor:
        smoothed = bilateral_filter(image, color.clamp(min=COLORS[0]), WINDOW, SPACE)
        return torch.where(color > 0, smoothed, image)

    def expected_error(self, noise: Tensor) -> Tensor:
        """Return the root mean square error of photographs that is expected behind this camera, in linear light.

        Args:
            noise: standard deviation of even noise, (B, 1, 1, 1), as :class:`Settings` have it.

        Returns:
            (B, 1, 1, 1), by the best kernel for scenes with as much detail as photographs have.
        """
        left = (noise.flatten()[:, None] * self.norms.to(noise)).square()
        return (left + self.scene_errors.to(noise)).min(1).values.sqrt()[:, None, None, None]

    def set_noise(self, sensor: nn.Module) -> None:
        """Take the noise of a sensor as the default for captures without a given noise, see :class:`ClosedForm`."""
        super().set_noise(sensor)
        self.remembered = {}

    @torch.no_grad()
    def settings(self, light: Tensor, noise: Tensor) -> Settings:
        """Return how captures are restored.

        Args:
            light: (B, 3, H, W), linear, without stray light.
            noise: standard deviation in linear light, (B, 3, H, W).
        """
        if self.sample is None:
            return self._settings(list(zip(sampled_windows(light), sampled_windows(noise), strict=True)))
        of_sensor, even = self._is_of_sensor(light, noise), noise.square().nan_to_num().mean().sqrt()
        if Mode.GRAPH in torch_mode():
            return self._settings_of_sample(light, of_sensor, even)
        told = None if bool(of_sensor) else float(even)
        if told not in self.remembered:
            self.remembered[told] = self._settings_of_sample(light, of_sensor, even)
        return self.remembered[told]

    def _settings_of_sample(self, light: Tensor, of_sensor: Tensor, even: Tensor) -> Settings:
        """Return the settings from the sample of a picture, with the noise of the sensor or another that is even."""
        windows = [part.to(light) for part in self.sample or ()]
        levels = [torch.where(of_sensor, self._noise_of(part), even) for part in windows]
        without = [self._without_stray_light(part) for part in windows]
        return self._settings(list(zip(without, levels, strict=True)))

    def _settings(self, windows: list[tuple[Tensor, Tensor]]) -> Settings:
        """Return the settings from windows of light and of its noise."""
        light = windows[0][0]
        facts = zip(*(self._facts(*one) for one in windows), strict=True)
        detail, variance, slope = (torch.stack(each).mean(0) for each in facts)
        of_scene = (detail - self.in_differences * variance).clamp(min=LEAST_DETAIL * variance)
        power = of_scene / self.photographs_detail.to(light)
        ratio = power / slope.clamp(min=torch.finfo(slope.dtype).tiny)
        left = BEFORE_BILATERAL * variance[:, None] * self.norms.square().to(light)
        cost = (ratio.clamp(*CONTENT) * slope)[:, None] * self.scene_errors.to(light) + left
        place = cost.argmin(1)[:, None, None, None].to(light) / STEPS
        squares = [part.square().nan_to_num().mean((1, 2, 3), keepdim=True) for _, part in windows]
        even = torch.stack(squares).mean(0).sqrt().clamp(min=LEAST_NOISE)
        return Settings(even, place, self._color_of_least_risk(windows, place), ratio[:, None, None, None])

    def _is_of_sensor(self, light: Tensor, noise: Tensor) -> Tensor:
        """Return whether the noise of a tile without stray light is that of the sensor, and no other that was told."""
        seen = light + self._stray_light(light) if self.has_stray_light else light
        return ((self._noise_of(seen.clamp(0, 1)) - noise).abs() <= 1e-3 * noise).float().mean() > 0.5

    def _facts(self, light: Tensor, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return detail and variance of noise of the encoded light, and the mean squared slope of the code, (B,)."""
        slope = self._slope(light)
        squares = [(slope * noise).square(), slope.square()]
        variance, steep = (part.nan_to_num().mean((1, 2, 3)) for part in squares)
        return light_detail(self._encode(light.nan_to_num())), variance, steep

    def _slope(self, light: Tensor) -> Tensor:
        """Return the derivative of the encoding at the mean light about each pixel."""
        if not self.encoded:
            return torch.ones_like(light)
        border = NEAR // 2
        padded = pad_border(light.nan_to_num(), border, "replicate")
        near = functional.avg_pool2d(padded, NEAR, 1)
        curved = 1.055 / 2.4 * near.clamp(min=0.0031308) ** (1 / 2.4 - 1)
        return torch.where(near > 0.0031308, curved, 12.92)  # IEC 61966-2-1

    def _color_of_least_risk(self, windows: list[tuple[Tensor, Tensor]], place: Tensor) -> Tensor:
        """Return the width in colour with the least risk over all windows, (B, 1, 1, 1)."""
        kernels = self._kernels_at(place)
        pairs = [self._perturbed(light, noise, kernels) for light, noise in windows]
        deviation = torch.stack([noise.square().mean((1, 2, 3)) for _, _, noise in pairs]).mean(0).sqrt()
        steps = deviation.new_tensor(COLORS)
        usual = (USUAL * deviation[:, None] / steps).log().abs().argmin(1)
        choices = [(usual + step).clamp(0, len(COLORS) - 1) for step in range(-AROUND, AROUND + 1)]
        colors = steps[torch.stack(choices)]
        risks = torch.stack([_risk(*pair, colors[..., None, None, None]) for pair in pairs]).mean(0)
        best = torch.cat([2 * deviation.square()[None], risks]).argmin(0, keepdim=True)
        return torch.cat([torch.zeros_like(colors[:1]), colors]).gather(0, best)[0, :, None, None, None]

    def _perturbed(self, light: Tensor, noise: Tensor, kernels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the picture that the kernels restore, the same with a little more noise, and that noise restored."""
        rows, columns = light.shape[-2:]
        light, noise = light.nan_to_num(), noise.nan_to_num()
        pair = torch.stack([light, light + PERTURBED * noise * self.drawn[:, :rows, :columns].to(light)], 1)
        one, other = torch.stack([convolve_kernels(*one)[:, 0] for one in zip(pair, kernels.split(1), strict=True)], 1)
        first, second = self._encode(one), self._encode(other)
        return first, second, (second - first) / PERTURBED

    def _left(self, noise: Tensor, place: Tensor) -> Tensor:
        """Return the standard deviation of the noise that a kernel leaves of even noise, all (B, 1, 1, 1)."""
        return noise * _at(self.norms[:, None], STEPS * place)[:, :, None, None]

    def _camera_maps(self, capture: Tensor, noise: Tensor) -> Tensor:
        """Return maps of the camera's and each pixel's properties, (B, CAMERA_MAPS, H, W)."""
        place = ((noise.log10() - math.log10(WIENER_NOISES[0])) / STEP).clamp(0, len(WIENER_NOISES) - 1)
        facts = [self._left(noise, FINER + place)[..., 0, 0].log10() + 2, *(_at(table, place) for table in self.bands)]
        told = torch.cat(facts, 1).to(capture)[:, :, None, None].expand(-1, -1, *capture.shape[-2:])
        return torch.cat([(capture < CLIPPED).all(1, keepdim=True).to(capture), told], 1)


def sampled_windows(picture: Tensor) -> list[Tensor]:
    """Return windows of a picture (B, C, H, W), at most two along each axis, about its quarters.

    Example:
        >>> [tuple(part.shape) for part in sampled_windows(torch.zeros(1, 3, 100, 400))]
        [(1, 3, 100, 160), (1, 3, 100, 160)]
    """
    places = []
    for length in picture.shape[-2:]:
        side = min(SAMPLED, length)
        count = 1 if length <= SAMPLED else SAMPLES
        middles = [(2 * index + 1) * length // (2 * count) for index in range(count)]
        firsts = [min(max(0, middle - side // 2), length - side) for middle in middles]
        places.append([slice(first, first + side) for first in firsts])
    return [picture[..., rows, columns] for rows in places[0] for columns in places[1]]


def light_detail(light: Tensor) -> Tensor:
    """Return the mean square difference of neighbouring pixels of each picture, (B, C, H, W) to (B,).

    Example:
        >>> light_detail(torch.tensor([[0.0, 1.0], [0.0, 1.0]]).view(1, 1, 2, 2))
        tensor([0.5000])
    """
    along, down = (light.diff(dim=axis).square().nan_to_num().mean((1, 2, 3)) for axis in (-1, -2))
    return (along + down).nan_to_num() / 2


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
    moments = transfer_moments(psfs, size, depth_shares(psfs))
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


def _risk(first: Tensor, second: Tensor, noise: Tensor, color: Tensor) -> Tensor:
    """Return Stein's estimate of the risk of bilateral filters (K, B, 1, 1, 1), but for a constant, (K, B)."""
    taken, other = (bilateral_filter(image, color, WINDOW, SPACE) for image in (first, second))
    kept = noise * (other - taken) / PERTURBED
    return ((taken - first).square() + 2 * kept).mean((-3, -2, -1))


def _parabolas(halves: Tensor) -> Tensor:
    """Interpolate the square of a piecewise linear function from its values at the nodes and midway, (N,)."""
    first, middle, last = halves[:-2:2], halves[1::2], halves[2::2]
    place = torch.arange(STEPS, dtype=halves.dtype, device=halves.device) / STEPS
    bent, rise = 2 * (first - 2 * middle + last), 4 * middle - 3 * first - last
    curves = first[:, None] + place * (rise[:, None] + place * bent[:, None])
    return torch.cat([curves.flatten(), halves[-1:]]).clamp(min=0)


def _at(table: Tensor, place: Tensor) -> Tensor:
    """Interpolate linearly between the rows of a table (N, M) at places (B, 1, 1, 1) from 0 to N - 1, as (B, M)."""
    steps = torch.arange(len(table), device=table.device)
    shares = (1 - (place.flatten()[:, None] - steps).abs()).clamp(min=0)
    return shares.to(table) @ table
