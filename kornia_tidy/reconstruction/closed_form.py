"""Restoration of a capture in closed form as one module: Tikhonov or Wiener deconvolutions and a bilateral filter."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from kornia_tidy.checks import check_choice, check_count, check_float_tensor, check_not_negative
from kornia_tidy.choices import INVERSES
from kornia_tidy.kernels.pixel_ops import decode, encode
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.reconstruction.bilateral import bilateral_filter
from kornia_tidy.reconstruction.depth_likelihood import depth_likelihood, likelihood_filters
from kornia_tidy.reconstruction.kernel_convolution import convolve_kernels
from kornia_tidy.reconstruction.predicted_error import best_wiener_kernels
from kornia_tidy.reconstruction.tikhonov_kernels import tikhonov_kernels

WEIGHTS = tuple(3e-3 * 10 ** (i / 2) for i in range(4))  # 0.003 to 0.095
# The best weight is 0.003 (noise / 0.002) ** 1.3. If a bilateral filter follows, which takes noise away, it is
# 0.003 (noise / 0.002) ** 0.87, and the best width in colour is 0.2 (noise / 0.002) ** 0.5: at noise of 0.002, 0.01 and
# 0.03, weights of 0.003, 0.01 and 0.03, and widths of 0.2, 0.4 and 0.8 are best on 18 real scenes.
NOISE, EXPONENT, EXPONENT_BEFORE_BILATERAL = 2e-3, 1.3, 0.87
STEP = 0.55  # of the logarithm of the noise between two Wiener filters
WIENER_NOISES = tuple(8e-4 * 10 ** (STEP * i) for i in range(len(WEIGHTS)))  # 0.0008 to 0.036
# It takes the noise for less than it is where a bilateral filter follows, which takes noise away, and for more where
# none does. Of the variance half is best at 0.002 before a bilateral filter, all of it at 0.03, and five times as much
# without a filter, on real scenes of half A.
WIENER_FACTOR, WIENER_FACTOR_BEFORE_BILATERAL, WIENER_RISE = 5.0, 0.5, 0.3
WINDOW, SPACE = 7, 2.0  # of the bilateral filter, pixels
COLOR, COLOR_EXPONENT = 0.2, 0.5  # difference of encoded colours
LEAST_NOISE = 1e-5  # of full scale; its logarithm is finite
LAYER_WEIGHT = 1e-2  # of the deconvolution for one depth, as an input of a network
FINE_WEIGHT = 1e-3  # of a second one: with the masks of edof-designed the best in bright light where depth is known
# Blended by the likelihood of depth, the best weight rises from 0.003 to 0.03 with a noise of 0.002 to 0.03. With one
# weight the images of joint-5 are 1.8 dB better than by the mean PSF at the one end, .3 dB worse at the other.
BLEND_WEIGHT = 5e-3
BLEND_SHARPNESS = 0.5  # best temperature of the likelihood at a noise of 0.002; it rises in proportion to the noise
NODES = 11  # depths over which PSFs are averaged
LIKELIHOOD_WINDOW = 65  # pixels of a PSF that the likelihood of its depth takes; the filters are three times as wide
SHARPNESS = 4.0  # temperature of the likelihood in closed form, which takes patches for uniform in depth; RMSE is least
# at 1 (.188 of the range on 18 real scenes, .197 at 4), calibration best at 8 (off by 19 %, 26 % at 4)
LEAST = -12.0  # of the logarithm of a likelihood: no depth is excluded for certain


def closed_form_channels(layers: int = 0, *, likelihood: bool = False, fine: bool = False) -> int:
    """Return the number of maps that :class:`ClosedForm` gives to a network for images of three channels.

    Example:
        >>> closed_form_channels(), closed_form_channels(layers=5), closed_form_channels(layers=5, likelihood=True)
        (19, 24, 29)
        >>> closed_form_channels(layers=5, fine=True)
        29
    """
    return 3 * (2 + len(WEIGHTS)) + 1 + layers * (1 + likelihood + fine)


def with_image(maps: Tensor, image: Tensor) -> Tensor:
    """Return the maps of :class:`ClosedForm` with an image (B, 3, H, W) in place of the restored one.

    Example:
        >>> maps = with_image(torch.zeros(1, closed_form_channels(), 2, 2), torch.ones(1, 3, 2, 2))
        >>> maps[0, :, 0, 0].nonzero().flatten()
        tensor([15, 16, 17])
    """
    place = 3 * (1 + len(WEIGHTS))
    return torch.cat([maps[:, :place], image, maps[:, place + 3 :]], 1)


class Restoration(NamedTuple):
    """A restored image and the maps that a network takes."""

    image: Tensor
    """All-in-focus image, (B, 3, H, W) in [0, 1], in the colours of the capture."""
    maps: Tensor
    """(B, N, H, W): capture, estimates by rising weight or noise, ``image``, level of the noise, brightness by depth,
    with ``fine`` once more, likelihood of each depth."""
    layers: Tensor
    """Linear light deconvolved for each depth, (B, D, 3, H, W); without likelihood D is 0."""


class ClosedForm(nn.Module):
    r"""Deconvolution of a capture in linear light, Tikhonov's or Wiener's, followed by a bilateral filter.

    For Tikhonov's the PSF is the mean over depth. The weight of the deconvolution and the width of the bilateral filter
    in colour follow the noise in each pixel,

    .. math:: \gamma = 0.003 \, (\sigma / 0.002)^{0.87}, \quad c = 0.2 \, (\sigma / 0.002)^{0.5} \ge 0.2;

    without the filter the weight rises with an exponent of 1.3. Estimates of four fixed weights from 0.003 to 0.095 are
    interpolated linearly in :math:`\log \gamma`, in linear light. The bilateral filter works on the encoded image.

    Wiener's filter (:func:`~kornia_tidy.reconstruction.predicted_error.best_wiener_kernels`) knows the power spectrum
    of scenes and how PSFs differ between depths. It takes the noise for

    .. math:: \sigma'^2 = 0.5 \, \sigma^2 \max(\sigma / 0.002, 1)^{0.3},

    without a bilateral filter for :math:`5 \sigma^2`; estimates of four noises from 0.0008 to 0.036 are interpolated
    linearly in :math:`\log \sigma'`. On 8 real scenes with the masks of ``edof-5`` it is ahead of Tikhonov's by .6, .2
    and .0 dB at a noise of 0.002, 0.01 and 0.03; with a lens without masks at f/48 it is .3 dB behind.

    With ``likelihood`` the image is blended from deconvolutions for D depths instead, by the likelihood l of each:

    .. math:: \hat x = \sum_k p_k \, (k_k * y), \quad p \propto e^{l / T}, \quad T = 0.5 \max(\sigma / 0.002, 1)

    Args:
        layers: number D of depths with a deconvolution of the brightness for each, with a weight of 0.01 and the
            mean PSF of the colours, as further inputs of a network: where PSFs differ between depths, the map of its
            own depth restores a region best.
        bilateral: False leaves out the bilateral filter.
        encoded: captures are encoded as sRGB. False: they are linear light.
        likelihood: blend the image by the likelihood of each of the ``layers``, see
            :func:`~kornia_tidy.reconstruction.depth_likelihood.depth_likelihood`, and give its logarithm as further
            inputs of a network, as 1 + its quarter / 12, at least 0. The brightness for a depth is then that of the
            image for this depth, of weight 0.005.
        fine: deconvolve the brightness for each of the ``layers`` a second time, with a weight of 0.001, as inputs that
            are sharper and have more noise; not with ``likelihood``.

    Shape:
        - capture: (B, 3, H, W) in [0, 1].
        - noise: standard deviation of the noise in linear light, in units of full scale: a number, one for each sample
          (B, 1, 1, 1), a map (B, 3, H, W), or four axes that broadcast to it. None: by the sensor of
          :meth:`set_noise`.
        - output: :class:`Restoration`.

    Raises:
        TypeError: if the capture is not floating point.
        ValueError: if shapes do not fit, no PSFs were given before the first capture, or ``fine`` is asked for without
            layers or with ``likelihood``.

    Convention:
        - Computed in float32 or better, also under autocast, and returned in the capture's dtype.
        - Stray light, the veil of the bank, is taken for even over the picture. It follows from the mean light of the
          capture; for tiles from that of the whole picture, see
          :func:`~kornia_tidy.reconstruction.whole_picture.whole_picture`.
        - PSFs and noise are part of the state: a network that was loaded needs no camera. Kernels follow from the PSFs.
        - Borders are padded by reflection; no output depends on pixels farther away than kernel and filter reach.

    Source: Sitzmann et al., ACM Transactions on Graphics 37(4) 114 (2018); Tomasi and Manduchi, Bilateral Filtering
    (ICCV 1998).

    Example:
        >>> restore = ClosedForm()
        >>> restore.set_psfs(PSFBank.from_measured(torch.rand(4, 3, 5, 5), torch.arange(4.0)))
        >>> restored = restore(torch.rand(2, 3, 16, 20), torch.tensor(0.01))
        >>> restored.image.shape, restored.maps.shape
        (torch.Size([2, 3, 16, 20]), torch.Size([2, 19, 16, 20]))
    """

    even_noise = False  # True if the noise of a pixel counts by its mean over the picture
    psfs: Tensor
    veil: Tensor
    kernels: Tensor
    filters: Tensor
    whitening: Tensor
    log_determinants: Tensor
    noise_model: Tensor

    def __init__(
        self,
        layers: int = 0,
        *,
        bilateral: bool = True,
        encoded: bool = True,
        likelihood: bool = False,
        inverse: str = "tikhonov",
        fine: bool = False,
    ) -> None:
        super().__init__()
        check_count("layers", layers, 2 * likelihood)
        if fine and (likelihood or not layers):
            raise ValueError(f"fine is for layers without likelihood, got layers={layers}, likelihood={likelihood}")
        check_choice("inverse", inverse, INVERSES)
        self.inverse, self.fine = inverse, fine
        self.layers, self.bilateral, self.encoded, self.likelihood = layers, bilateral, encoded, likelihood
        self.mean_light: Tensor | None = None
        self.sample: list[Tensor] | None = None  # windows of the whole picture's light
        self.has_stray_light = False
        self.register_buffer("psfs", torch.zeros(layers or (NODES if inverse == "wiener" else 1), 3, 0, 0))
        self.register_buffer("veil", torch.zeros(3))  # share of stray light, mean over depth
        for name in ("kernels", "filters", "whitening", "log_determinants"):
            self.register_buffer(name, torch.zeros(0), persistent=False)
        self.register_buffer("noise_model", torch.tensor([NOISE**2, 0.0]))  # variance in the dark, and per light
        self.register_load_state_dict_pre_hook(_take_window)
        self.register_load_state_dict_post_hook(_renew_kernels)

    def set_psfs(self, bank: PSFBank, *, correlate: bool = False) -> None:
        """Compute the kernels from a camera's PSFs; gradients reach them.

        Args:
            bank: PSFs of three channels. With ``layers`` a node for each of them; else 11 nodes for Wiener's filter,
                of evenly spaced defocus, and any number for Tikhonov's.
            correlate: captures are correlations, as with fidelity ``"paper"``: PSFs are flipped by 180 degrees.

        Raises:
            ValueError: if the bank has other channels or another number of layers.
        """
        psfs = bank.psfs.flip((-2, -1)) if correlate else bank.psfs
        nodes = len(self.psfs) if self.layers or self.inverse == "wiener" else None
        if psfs.shape[1] != 3 or nodes not in {None, len(psfs)}:
            wanted = f"{nodes or 'D'}, 3, P, P"
            raise ValueError(f"the closed form needs PSFs of shape ({wanted}), got {tuple(psfs.shape)}")
        self.veil = psfs.new_zeros(3) if bank.veil is None else bank.veil.mean(0).detach()
        self.has_stray_light = bool(self.veil.any())
        psfs = psfs.mean(0, keepdim=True) if nodes is None else psfs
        if psfs.requires_grad or self.kernels.requires_grad or not torch.equal(psfs, self.psfs):
            self.psfs = psfs.detach()
            self._set_kernels(psfs)

    def _set_kernels(self, psfs: Tensor) -> None:
        """Compute the kernels from PSFs, (D, 3, P, P)."""
        wide = psfs.to(torch.promote_types(psfs.dtype, torch.float32))
        self.kernels = self._kernels_of(wide)
        if self.likelihood:
            self.filters = tikhonov_kernels(wide.flatten(0, 1), (BLEND_WEIGHT,)).unflatten(1, (-1, 3))[0]
        elif self.layers:
            weights = (LAYER_WEIGHT, FINE_WEIGHT) if self.fine else (LAYER_WEIGHT,)
            self.filters = tikhonov_kernels(wide.mean(1), weights).flatten(0, 1).unsqueeze(1)
        if self.likelihood:
            beyond = max(0, wide.shape[-1] - LIKELIHOOD_WINDOW) // 2
            middle = slice(beyond, wide.shape[-1] - beyond)
            self.whitening, self.log_determinants = likelihood_filters(wide.mean(1)[..., middle, middle])

    def _kernels_of(self, psfs: Tensor) -> Tensor:
        if self.inverse == "wiener":
            return best_wiener_kernels(psfs, WIENER_NOISES)
        return tikhonov_kernels(psfs.mean(0), WEIGHTS)

    def set_noise(self, sensor: nn.Module) -> None:
        """Take the noise of a sensor as the default for captures without a given noise.

        Raises:
            TypeError: if the sensor has no ``std`` to describe its noise.
        """
        deviation = getattr(sensor, "std", None)
        if not callable(deviation):
            raise TypeError(
                f"a closed form restores captures by their noise, and {type(sensor).__name__} has no std(light) that "
                f"tells it: add one (see kornia_tidy.sensor.Sensor), or give the noise with each capture"
            )
        light = torch.tensor([0.0, 1.0], dtype=torch.float64)
        dark, full = deviation(light).square().tolist()
        self.noise_model = self.noise_model.new_tensor([dark, full - dark])

    def noise_map(self, capture: Tensor, noise: Tensor | float | None = None) -> Tensor:
        """Return the standard deviation of the noise in each pixel, (B, 3, H, W), in units of full scale.

        Raises:
            ValueError: if the noise does not broadcast to the capture, or is a negative or no finite number.
        """
        if noise is None:
            return self._noise_of(self._light(capture.clamp(0, 1)))
        if isinstance(noise, float | int):
            check_not_negative("noise", noise, "in units of full scale")
        noise = noise.to(capture) if isinstance(noise, Tensor) else capture.new_tensor(noise)
        fits = all(side in {1, whole} for side, whole in zip(noise.shape, capture.shape, strict=False))
        if noise.ndim not in {0, 4} or not fits:
            raise ValueError(
                f"noise must be a number, (B, 1, 1, 1) or broadcast to {tuple(capture.shape)}, got {tuple(noise.shape)}"
            )
        return noise.expand(capture.shape)

    def forward(self, capture: Tensor, noise: Tensor | float | None = None) -> Restoration:
        """Return the restored image, and the maps for a network."""
        self._check(capture)
        precise = torch.promote_types(capture.dtype, self.kernels.dtype)
        with torch.autocast(capture.device.type, enabled=False):
            restored = self._restore(capture.to(precise), self.noise_map(capture.to(precise), noise))
        return Restoration(*(part.to(capture.dtype) for part in restored))

    def _check(self, capture: Tensor) -> None:
        if not self.kernels.numel():
            raise ValueError("the closed form does not know its camera: call set_psfs(optics.psf_bank()) first")
        check_float_tensor("capture", capture, 4, "(B, 3, H, W)")
        if capture.shape[1] != 3 or 0 in capture.shape[-2:]:
            raise ValueError(f"capture must have shape (B, 3, H, W) with one pixel or more, got {tuple(capture.shape)}")

    def blend(self, layers: Tensor, shares: Tensor, noise: Tensor) -> Tensor:
        """Return the light deconvolved for each depth, averaged pixel by pixel with the shares of depths, and smoothed.

        Args:
            layers: of the :class:`Restoration`.
            shares: of each depth, (B, D, H, W), of sum one.
            noise: standard deviation of the noise in linear light, (B, 3, H, W).

        Returns:
            (B, 3, H, W) in [0, 1], in the colours of the capture.
        """
        precise = torch.promote_types(layers.dtype, self.kernels.dtype)
        with torch.autocast(layers.device.type, enabled=False):
            image = self._encode((shares.to(precise).unsqueeze(2) * layers.to(precise)).sum(1))
            return self._smooth(image, self._color(noise.to(precise))).to(layers.dtype)

    def _restore(self, capture: Tensor, noise: Tensor) -> Restoration:
        light = self._without_stray_light(self._light(capture))
        place = self._place(noise.clamp(min=LEAST_NOISE).log10())
        return self._restored(capture, light, noise, place, self._color(noise))

    def _chosen(self, light: Tensor, estimates: Tensor, place: Tensor) -> Tensor:
        """Return the light restored by the kernel at a place."""
        del light
        return interpolated(estimates, place)

    def _restored(self, capture: Tensor, light: Tensor, noise: Tensor, place: Tensor, color: Tensor) -> Restoration:
        """Restore light by the kernel at a place, and smooth it by a width in colour."""
        estimates = convolve_kernels(light, self.kernels.to(light.dtype))
        level = noise.clamp(min=LEAST_NOISE).log10()
        brightness = light.mean(1, keepdim=True)
        by_depth, deconvolved = [], light.new_zeros(len(light), 0, *light.shape[1:])
        if self.likelihood:
            fits = depth_likelihood(brightness, self.whitening.to(light.dtype), self.log_determinants.to(light.dtype))
            deconvolved = convolve_kernels(light, self.filters.to(light.dtype))
            shares = (fits / (BLEND_SHARPNESS * 10 ** _above(noise))).softmax(1)
            image = self._encode((shares.unsqueeze(2) * deconvolved).sum(1))
            by_depth = [self._encode(deconvolved.mean(2)), 1 - (fits / SHARPNESS).clamp(min=LEAST) / LEAST]
        else:
            image = self._encode(self._chosen(light, estimates, place))
            if self.layers:
                by_depth = [self._encode(convolve_kernels(brightness, self.filters.to(light.dtype))[:, :, 0])]
        image = self._smooth(image, color)
        maps = [capture, self._encode(estimates).flatten(1, 2), image, (level + 2).mean(1, keepdim=True), *by_depth]
        return Restoration(image, torch.cat(maps, 1), deconvolved)

    def _place(self, level: Tensor) -> Tensor:
        """Return which of the estimates is best for the noise, given as its logarithm; between two a fraction."""
        above = level - math.log10(NOISE)
        if self.inverse == "tikhonov":
            return 2 * (EXPONENT_BEFORE_BILATERAL if self.bilateral else EXPONENT) * above  # half a decade apart
        if self.bilateral:
            taken = level + (math.log10(WIENER_FACTOR_BEFORE_BILATERAL) + WIENER_RISE * above.clamp(min=0)) / 2
        else:
            taken = level + math.log10(WIENER_FACTOR) / 2
        return (taken - math.log10(WIENER_NOISES[0])) / STEP

    def _smooth(self, image: Tensor, color: Tensor) -> Tensor:
        return bilateral_filter(image, color, WINDOW, SPACE) if self.bilateral else image

    def _color(self, noise: Tensor) -> Tensor:
        """Return the width of the bilateral filter in colour."""
        return COLOR * 10 ** (COLOR_EXPONENT * _above(noise))

    def completed(self, light: Tensor) -> Tensor:
        """Return light with what is expected beyond full scale: here nothing."""
        return light

    def _noise_of(self, light: Tensor) -> Tensor:
        """Return the standard deviation of the sensor's noise at light within [0, 1]."""
        dark, rise = self.noise_model.to(light.dtype)
        return (dark + rise * light).sqrt()

    def _light(self, colors: Tensor) -> Tensor:
        return decode(colors) if self.encoded else colors

    def _without_stray_light(self, light: Tensor) -> Tensor:
        return light - self._stray_light(light) if self.has_stray_light else light

    def _stray_light(self, light: Tensor) -> Tensor:
        """Return the stray light of a capture, or of the whole picture, (B, 3, 1, 1)."""
        mean = light.nan_to_num().mean((-2, -1), keepdim=True) if self.mean_light is None else self.mean_light.to(light)
        energy = self.psfs.mean(0).sum((-2, -1))
        share = (self.veil / (energy + self.veil)).to(light.dtype)
        return share[:, None, None] * mean

    def _encode(self, light: Tensor) -> Tensor:
        light = light.clamp(0, 1)
        return encode(light) if self.encoded else light


def _above(noise: Tensor) -> Tensor:
    """Return by how much the logarithm of the noise, mean over colours, exceeds that of 0.002: ringing is left then."""
    return (noise.clamp(min=LEAST_NOISE).log10().mean(1, keepdim=True) - math.log10(NOISE)).clamp(min=0)


def interpolated(estimates: Tensor, place: Tensor) -> Tensor:
    """Interpolate linearly between estimates (B, D, C, H, W) at a place (B, C, H, W) among them, from 0 to D - 1."""
    place = place.clamp(0.0, estimates.shape[1] - 1.0)  # real ends: ONNX mixes up whole ones of two such calls
    steps = torch.arange(estimates.shape[1], device=place.device)[:, None, None, None]
    shares = (1 - (place.unsqueeze(1) - steps).abs()).clamp(min=0)
    return (shares * estimates).sum(1)


def _renew_kernels(module: nn.Module, _: Any) -> None:
    """Compute from a state that was loaded what follows from its PSFs."""
    if isinstance(module, ClosedForm) and module.psfs.numel():
        module.has_stray_light = bool(module.veil.any())
        module._set_kernels(module.psfs)


def _take_window(module: nn.Module, state: dict[str, Any], prefix: str, *_: Any) -> None:
    """Give the PSFs the size that they have in a state, before it is loaded; if it has none, they and the veil stay."""
    stored = state.get(f"{prefix}psfs")
    if isinstance(module, ClosedForm) and stored is not None and stored.shape[:2] == module.psfs.shape[:2]:
        if stored.numel():
            module.psfs = module.psfs.new_empty(stored.shape)
        else:
            state |= {f"{prefix}{name}": getattr(module, name) for name in ("psfs", "veil")}
