"""Phase retrieval: masks, shifts and a defocus offset fitted to measured PSFs through the optical model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.checks import check_positive
from kornia_tidy.fidelity import Fidelity
from kornia_tidy.masks.base import adam_groups, central_square, mask_coordinates
from kornia_tidy.masks.pixelwise import PixelwiseMask
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH, Spectrum
from kornia_tidy.optics.thin_lens import DefocusRange, ThinLensCamera
from kornia_tidy.psf.exact import exact_psf_bank
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.psf.psf_model import PSFModel

POLISHING = 40  # L-BFGS steps after Adam
STEP = 2.5e-8  # m; initial learning rate in height, 0.15 rad
ORDERS = 3  # whole waves above and below within which heights are searched


@dataclass(frozen=True, eq=False)
class MaskFit:
    """Result of a fit of the optical model to measured PSFs.

    Args:
        lens: lens with the fitted masks.
        defocus_offset: correction of the defocus of the measured nodes in radians. It is fitted if the masks are fixed,
            and 0 otherwise, as learnable masks include it.
        shifts: (D, 2) rows and columns in pixels from the chief ray to the centre of each measured PSF. For learnable
            masks their mean is zero.
        psfs: (D, C, P, P) PSFs of the model, shifts included.
        residual: (D, C) relative L1 error: the sum of absolute differences over the sum of the PSF.
    """

    lens: PSFModel
    defocus_offset: float
    shifts: Tensor
    psfs: Tensor
    residual: Tensor


def fit_masks(measured: PSFBank, lens: PSFModel, iterations: int = 150, channel: int | None = None) -> MaskFit:
    r"""Fit the masks of a lens in place to measured PSFs, by gradient descent through the optical model.

    .. math:: \min \frac{1}{DC} \sum_{dc} \lVert \sqrt{h_{dc}} - \sqrt{m_{dc}} \rVert^2

    Each depth has its own shift, because the position of its point is known only approximately. If no mask is
    learnable, because the masks on the modulator are known, a defocus offset is fitted instead. Adam with a cosine
    schedule comes first, then L-BFGS.

    Args:
        measured: PSFs that sum to one, at two depths or more. One depth does not distinguish a mask from its twin (the
            conjugate, flipped by 180 degrees).
        lens: initial masks, camera and spectrum.
        iterations: steps of Adam.
        channel: fit only this channel.

    Returns:
        The fit, with the given lens.

    Raises:
        ValueError: if the channels are not those of the spectrum, or the iterations not positive.

    Source: Fienup, Applied Optics 21(15) 2758 (1982), for the error in amplitudes; Gonsalves, Optical Engineering 21,
    829 (1982), for phase diversity by defocus.

    Example:
        >>> small, spectrum = Fidelity("small", window=15), Spectrum.monochrome()
        >>> shown = PSFModel(PixelwiseMask(1, 11), fidelity=small, spectrum=spectrum)
        >>> with torch.no_grad():
        ...     bank = shown.psf_bank(defocus=[-5.0, 5.0])
        >>> near = PixelwiseMask(1, initial=shown.masks.heights() + 5e-8 * torch.rand(11, 11))
        >>> fit = fit_masks(bank, PSFModel(near, fidelity=small, spectrum=spectrum), iterations=20)
        >>> bool(fit.residual.max() < 0.01)
        True
    """
    check_positive("iterations", iterations)
    channels = len(lens.spectrum.weights)
    if measured.psfs.shape[1] != channels:
        raise ValueError(f"the spectrum has {channels} channels, the measured PSFs {measured.psfs.shape[1]}")
    model = _Model(measured, lens, channel)
    groups: list[dict[str, Any]] = [{"params": [model.shifts], "lr": 0.02}]
    if model.learning:
        groups.append(adam_groups(lens.masks, STEP))
    else:
        groups.append({"params": [model.offset], "lr": 0.2})
    optimizer = torch.optim.Adam(groups)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, iterations)
    for _ in range(iterations):
        optimizer.zero_grad()
        model.error().backward()
        optimizer.step()
        schedule.step()
        model.settle()
    free = [parameter for group in groups for parameter in group["params"]]
    polish = torch.optim.LBFGS(free, max_iter=POLISHING, history_size=20, line_search_fn="strong_wolfe")

    def evaluate() -> Tensor:
        polish.zero_grad()
        error = model.error()
        error.backward()
        return error

    polish.step(evaluate)
    model.settle()
    return model.fit()


def spectrum_of(channels: int) -> Spectrum:
    """Return the wavelengths of measured PSFs by their number of channels: 530 nm, or red, green and blue.

    Raises:
        ValueError: if there are other than 1 or 3.

    Example:
        >>> spectrum_of(1).wavelengths
        (5.3e-07,)
    """
    if channels not in {1, 3}:
        raise ValueError(f"a mask is found by PSFs of 1 or 3 channels, these have {channels}")
    return Spectrum.monochrome() if channels == 1 else Spectrum.rgb()


def retrieve_mask(
    measured: PSFBank,
    camera: ThinLensCamera | DefocusRange,
    spectrum: Spectrum | None = None,
    size: int = 23,
    iterations: int = 150,
    starts: int = 3,
    good: float = 0.1,
    generator: torch.Generator | None = None,
) -> MaskFit:
    r"""Retrieve an unknown single mask from measured PSFs.

    First each channel is fitted by itself, which gives the phase up to whole waves of its wavelength. Then
    :func:`one_height` combines these phases to one height, and a fit of all channels follows. A fit of all channels
    from the start would have local minima at heights wrong by one wave, since a wave of green is not a wave of red.

    Args:
        measured: as for :func:`fit_masks`.
        camera: the lens.
        spectrum: wavelengths of the channels. Default: 610, 530 and 470 nm, one a channel.
        size: pixels of the mask along a side.
        iterations: steps of Adam in each fit.
        starts: largest number of fits of a channel, each from other noise, until its residual is below ``good``.
        good: residual, relative L1, at which a channel needs no further start.
        generator: source of the noise.

    Returns:
        The fit, with a lens of one mask.

    Raises:
        ValueError: if the PSFs have only one depth, or their channels are not those of the spectrum.

    Source: Cheng and Wyant, Applied Optics 24(6) 804 (1985), for heights from phases at several wavelengths.
    """
    if len(measured.defocus) < 2:
        raise ValueError(f"measured must have PSFs at two depths or more, got {len(measured.defocus)}")
    spectrum = Spectrum.rgb() if spectrum is None else spectrum
    fidelity = Fidelity("fit", window=measured.window)
    found = []
    for channel in range(len(spectrum.weights)):
        best: MaskFit | None = None
        for _ in range(starts):
            lens = PSFModel(PixelwiseMask(1, size, generator=generator), camera, None, fidelity, spectrum)
            fit = fit_masks(measured, lens, iterations, channel)
            if best is None or fit.residual.mean() < best.residual.mean():
                best = fit
            if float(best.residual.mean()) < good:
                break
        assert best is not None  # starts is 1 or more
        found.append(best.lens.masks.phase.detach()[0])
    masks = PixelwiseMask(1, size)
    factors = [masks.dispersion(_mean_wavelength(spectrum, channel)) for channel in range(len(found))]
    with torch.no_grad():
        masks.phase.copy_(one_height([phase * s for phase, s in zip(found, factors, strict=True)], factors)[None])
    return fit_masks(measured, PSFModel(masks, camera, None, fidelity, spectrum), iterations)


def one_height(phases: Sequence[Tensor], factors: Sequence[float]) -> Tensor:
    r"""Unwrap phases known at several wavelengths to one height map, returned as phase at 530 nm.

    .. math:: \max_{c} \sum_j \max_{n_j} \sum_\lambda \cos(\varphi_{\lambda j} - s_\lambda \varphi_j - c_\lambda)

    Args:
        phases: phase at each wavelength, all of the same shape. Each is known up to whole waves in every pixel j, and
            up to a constant c.
        factors: s, ratio of the phase at each wavelength to that at 530 nm.

    Returns:
        :math:`\varphi`, within :data:`ORDERS` waves of the first wavelength above and below the first phase.

    Example:
        >>> heights, factors = torch.linspace(0, 9, 50), [1.0, 530 / 610, 530 / 470]
        >>> found = one_height([(heights * s + c) % (2 * torch.pi) for s, c in zip(factors, (0, 1, 2))], factors)
        >>> bool((found - found[0] - heights).abs().max() < 0.1)
        True
    """
    first = phases[0].flatten().double()
    orders = torch.arange(-ORDERS, ORDERS + 1, dtype=torch.float64, device=first.device) * (2 * math.pi)
    candidates = (first + orders[:, None]) / factors[0]  # (n, pixels)
    constants = torch.arange(48, dtype=torch.float64, device=first.device) * (2 * math.pi / 48)
    agreement = torch.zeros(1, *candidates.shape, dtype=torch.float64, device=first.device)
    for phase, factor in zip(phases[1:], factors[1:], strict=True):
        rest = phase.flatten().double() - factor * candidates
        agreement = (agreement[:, None] + torch.cos(rest - constants.view(-1, 1, 1))[None]).flatten(0, 1)
    best = agreement.amax(1).sum(1).argmax()
    order = agreement[best].argmax(0, keepdim=True)
    return candidates.gather(0, order)[0].reshape(phases[0].shape).to(phases[0].dtype)


class _Model:
    """Optical model of the measured PSFs, with learnable shifts and a learnable defocus offset."""

    def __init__(self, measured: PSFBank, lens: PSFModel, channel: int | None) -> None:
        self.lens, self.nodes, self.centre = lens, measured.defocus.tolist(), 0.0
        self.learning = any(parameter.requires_grad for parameter in lens.masks.parameters())
        weights = lens.spectrum.weights if channel is None else (lens.spectrum.weights[channel],)
        self.spectrum = _without_unused(Spectrum(lens.spectrum.wavelengths, weights))
        self.target = measured.psfs if channel is None else measured.psfs[:, channel : channel + 1]
        self.floor = 1e-3 / measured.window**2  # added to intensities, so that noise near zero has little weight
        self.shifts = torch.zeros(len(self.nodes), 2, requires_grad=True)
        self.offset = torch.zeros((), requires_grad=True)
        camera = lens.camera
        self.step = camera.pixel_pitch * camera.aperture_radius / float(camera.image_distance)
        x = mask_coordinates(min(lens.masks.phase.shape[-2:])).float()
        self.tilts = 2 * math.pi * self.step / REFERENCE_WAVELENGTH * x  # shifts the PSF by one pixel
        self.quadratic = x[:, None] ** 2 + x**2

    def psfs(self) -> Tensor:
        """Return the model's PSFs, (D, C, P, P).

        Shifts and a small offset are added to the phase of the mask pixels. A large offset would be inaccurate on the
        pixel grid, so :meth:`settle` moves it to the defocus nodes.
        """
        states, weights = self.lens.modulator(self.lens.masks.phase.float())
        states = central_square(states)
        waves = self.spectrum.wavelengths
        dispersion = [self.lens.masks.dispersion(wave) for wave in waves]
        chromatic = [self.lens.camera.chromatic_defocus(wave) for wave in waves]
        shifts = self.shifts - self.shifts.mean(0) if self.learning else self.shifts
        psfs = []
        for node, (down, right) in zip(self.nodes, shifts.unbind(), strict=True):
            ramp = down * self.tilts[:, None] + right * self.tilts + self.offset * self.quadratic
            bank = exact_psf_bank(
                states + ramp,
                weights,
                self.lens.pupil,
                self.spectrum,
                dispersion,
                [node + self.centre],
                self.step,
                self.target.shape[-1],
                self.lens.fidelity.pixel_tolerance,
                chromatic,
            )
            psfs.append(bank.with_stray_light("renormalize").psfs[0])
        return torch.stack(psfs)

    def error(self) -> Tensor:
        difference = (self.psfs() + self.floor).sqrt() - (self.target + self.floor).sqrt()
        return difference.square().sum((2, 3)).mean()

    @torch.no_grad()
    def settle(self) -> None:
        """Add the defocus offset to the nodes if it is no longer small: there it is exact."""
        if abs(float(self.offset)) > 0.25:
            self.centre += float(self.offset)
            self.offset.zero_()

    @torch.no_grad()
    def fit(self) -> MaskFit:
        self.centre += float(self.offset)
        self.offset.zero_()
        psfs = self.psfs()
        residual = (psfs - self.target).abs().sum((2, 3)) / self.target.sum((2, 3))
        shifts = self.shifts - self.shifts.mean(0) if self.learning else self.shifts
        return MaskFit(self.lens, self.centre, shifts.detach().clone(), psfs, residual)


def _without_unused(spectrum: Spectrum) -> Spectrum:
    """Return the spectrum without the wavelengths that have no weight in any channel."""
    used = [w for w in range(len(spectrum.wavelengths)) if any(channel[w] for channel in spectrum.weights)]
    return Spectrum(
        tuple(spectrum.wavelengths[w] for w in used), tuple(tuple(c[w] for w in used) for c in spectrum.weights)
    )


def _mean_wavelength(spectrum: Spectrum, channel: int) -> float:
    weights = spectrum.weights[channel]
    return sum(w * x for w, x in zip(weights, spectrum.wavelengths, strict=True)) / sum(weights)
