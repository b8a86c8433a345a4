"""The mask behind measured PSFs: heights, place and focus that our own optics need to make them."""

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

POLISHING = 40  # steps of quasi-Newton at the end
STEP = 2.5e-8  # metres of height that the first steps move, 0.15 rad
ORDERS = 3  # whole waves that heights are looked for in, up and down


@dataclass(frozen=True, eq=False)
class MaskFit:
    """A physical model of measured PSFs.

    Args:
        lens: the lens with the masks found.
        defocus_offset: what to add to the defocus of the measured nodes, in radians; found where the masks are fixed,
            and else 0: masks that learn take it up.
        shifts: (D, 2) rows and columns in pixels by which the measured PSFs lie off the chief ray, on average none.
        psfs: (D, C, P, P) that the model makes, shifts and all.
        residual: (D, C) relative L1, the sum of the moduli of what is left over that of the PSF.
    """

    lens: PSFModel
    defocus_offset: float
    shifts: Tensor
    psfs: Tensor
    residual: Tensor


def fit_masks(measured: PSFBank, lens: PSFModel, iterations: int = 150, channel: int | None = None) -> MaskFit:
    r"""Fit masks to measured PSFs by gradient descent through the optics, from the masks as they are; they change.

    .. math:: \min \frac{1}{DC} \sum_{dc} \lVert \sqrt{h_{dc}} - \sqrt{m_{dc}} \rVert^2

    Each depth has a shift of its own, as the place of its point is known only so well. Where no mask learns, because
    what is shown on a modulator is known, the offset of defocus is found instead. Adam along a falling cosine gets
    near, L-BFGS does the rest.

    Args:
        measured: PSFs that sum to one, at two depths or more: one depth does not tell a mask from its twin.
        lens: masks, camera and spectrum to begin with.
        iterations: gradient steps.
        channel: fit this channel alone.

    Returns:
        The fit, whose lens is the one given.

    Raises:
        ValueError: if the channels are not those of the spectrum, or the iterations not positive.

    Source: Fienup, Applied Optics 21(15) 2758 (1982), for amplitudes; Gonsalves, Optical Engineering 21, 829 (1982),
    for the diversity that defocus gives.

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
    r"""Find the one mask behind measured PSFs, of which nothing is known.

    Each channel is fitted by itself first: in all at once, heights that are wrong by a wave are traps, since a wave of
    green is none of red. What they say of each pixel, each up to whole waves of its own, fits together at one height;
    from there all channels are fitted.

    Args:
        measured: as for :func:`fit_masks`.
        camera: the lens.
        spectrum: wavelengths of the channels. Default: 610, 530 and 470 nm, one a channel.
        size: pixels of the mask along a side.
        iterations: gradient steps of each fit.
        starts: how often a channel is begun anew from other noise while its residual is not good.
        good: residual, relative L1, that is.
        generator: source of the noise.

    Returns:
        The fit, with a lens of one mask.

    Raises:
        ValueError: if the PSFs are at one depth alone, or of other channels than the spectrum.

    Source: Cheng and Wyant, Applied Optics 24(6) 804 (1985), for heights from phases at several wavelengths.
    """
    if len(measured.defocus) < 2:
        raise ValueError("a mask is found of PSFs at two depths or more: one does not tell it from its twin")
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
    r"""Return the phase at 530 nm of the heights that fit phases known up to whole waves at several wavelengths.

    .. math:: \max_{c} \sum_j \max_{n_j} \sum_\lambda \cos(\varphi_{\lambda j} - s_\lambda \varphi_j - c_\lambda)

    Args:
        phases: at each wavelength, of any one shape, each up to whole turns and a constant c of its own.
        factors: s, from phase at 530 nm to phase at each wavelength.

    Returns:
        :math:`\varphi` within :data:`ORDERS` turns either way of the first wavelength.

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
    """The PSFs that a lens makes at the measured depths, with shifts and an offset to learn."""

    def __init__(self, measured: PSFBank, lens: PSFModel, channel: int | None) -> None:
        self.lens, self.nodes, self.centre = lens, measured.defocus.tolist(), 0.0
        self.learning = any(parameter.requires_grad for parameter in lens.masks.parameters())
        weights = lens.spectrum.weights if channel is None else (lens.spectrum.weights[channel],)
        self.spectrum = _lit(Spectrum(lens.spectrum.wavelengths, weights))
        self.target = measured.psfs if channel is None else measured.psfs[:, channel : channel + 1]
        self.floor = 1e-3 / measured.window**2  # of light, below which no amplitude is told from another
        self.shifts = torch.zeros(len(self.nodes), 2, requires_grad=True)
        self.offset = torch.zeros((), requires_grad=True)
        camera = lens.camera
        self.step = camera.pixel_pitch * camera.aperture_radius / float(camera.image_distance)
        x = mask_coordinates(min(lens.masks.phase.shape[-2:])).float()
        self.tilts = 2 * math.pi * self.step / REFERENCE_WAVELENGTH * x  # moves the PSF by a pixel
        self.bowl = x[:, None] ** 2 + x**2

    def psfs(self) -> Tensor:
        """Shifts and small offsets as steps of phase from mask pixel to mask pixel; what is large is in the nodes."""
        states, weights = self.lens.modulator(self.lens.masks.phase.float())
        states = central_square(states)
        waves = self.spectrum.wavelengths
        dispersion = [self.lens.masks.dispersion(wave) for wave in waves]
        chromatic = [self.lens.camera.chromatic_defocus(wave) for wave in waves]
        shifts = self.shifts - self.shifts.mean(0) if self.learning else self.shifts
        psfs = []
        for node, (down, right) in zip(self.nodes, shifts.unbind(), strict=True):
            ramp = down * self.tilts[:, None] + right * self.tilts + self.offset * self.bowl
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
        """Put the offset into the nodes once it is no longer small, where it is exact."""
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


def _lit(spectrum: Spectrum) -> Spectrum:
    """Leave out wavelengths that no channel sees."""
    seen = [w for w in range(len(spectrum.wavelengths)) if any(channel[w] for channel in spectrum.weights)]
    return Spectrum(
        tuple(spectrum.wavelengths[w] for w in seen), tuple(tuple(c[w] for w in seen) for c in spectrum.weights)
    )


def _mean_wavelength(spectrum: Spectrum, channel: int) -> float:
    weights = spectrum.weights[channel]
    return sum(w * x for w, x in zip(weights, spectrum.wavelengths, strict=True)) / sum(weights)
