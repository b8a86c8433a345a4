"""The part of a PSF model that knows fast lenses without a mask: their layers, windows, grids and PSFs."""

from __future__ import annotations

import math
from abc import abstractmethod
from functools import partial
from typing import cast

import torch
from torch import Tensor, nn

from kornia_tidy.fidelity import Fidelity
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH, Spectrum
from kornia_tidy.optics.thin_lens import DefocusRange, ThinLensCamera
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.psf.psf_window import FittedWindow
from kornia_tidy.psf.pupil import Pupil
from kornia_tidy.psf.wide_blur import SMALLEST_WIDE_RADIUS, BlurGroup, WideBlur, blurs_widely, wide_blur, window_of
from kornia_tidy.psf.wide_psfs import GroupBank, WideBank, held_nodes, is_flat, wide_psfs
from kornia_tidy.runtime.tracing import is_value_unknown


class Derived:
    """What follows from the parts of a PSF model and is found when it is first asked for: window, pupil, wide blur."""

    def __init__(self, window: FittedWindow | None = None) -> None:
        self.window: FittedWindow | None = window
        self.pupil: Pupil | None = None
        self.blur: WideBlur | None = None
        self.blur_known = False


class WidePSFs:
    """Layers and PSFs of wide blur, see :mod:`kornia_tidy.psf.wide_blur`."""

    camera: ThinLensCamera | DefocusRange
    modulator: nn.Module
    fidelity: Fidelity
    spectrum: Spectrum
    measured: PSFBank | None  # PSFs in the place of the masks' own
    _sampled: Spectrum  # the spectrum, at no more wavelengths than the fidelity allows
    _derived: Derived

    @abstractmethod
    def states(self, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """Return the phase of each state over the pupil and its share of the exposure."""

    @abstractmethod
    def spectrum_of(self, channels: int, remedy: str = "") -> Spectrum:
        """Return the wavelengths at which an image of so many channels is seen."""

    @property
    @abstractmethod
    def pupil(self) -> Pupil:
        """The aperture over the masks' pixels."""

    @property
    @abstractmethod
    def pixel_step(self) -> float | Tensor:
        """A sensor pixel seen from the pupil, in metres."""

    @abstractmethod
    def _computed_bank(
        self,
        spectrum: Spectrum,
        dtype: torch.dtype,
        nodes: tuple[float, ...],
        state: int | None = None,
        stray_light: tuple[str, int] | None = None,
        group: BlurGroup | None = None,
    ) -> PSFBank: ...

    @abstractmethod
    def _build(
        self,
        states: Tensor,
        weights: Tensor,
        spectrum: Spectrum,
        window: int,
        tolerance: float,
        nodes: tuple[float, ...],
        grid: int = 1,
    ) -> PSFBank: ...

    @property
    def wide_blur(self) -> WideBlur | None:
        """Layers and grids of a fast lens without a mask; None where masks are shown, or the blur is narrow.

        Found with the masks as they were at the first look, and dropped as soon as they are no longer flat.
        """
        derived = self._derived
        if not derived.blur_known and not is_value_unknown():
            derived.blur, derived.blur_known = self._find_wide_blur(), True
        return derived.blur

    def _find_wide_blur(self) -> WideBlur | None:
        camera, known, step = self.camera, self._derived.window, self.pixel_step
        if self.measured is not None or not self.fidelity.blurs_by_rays or self.spectrum.basis is not None:
            return None
        # A focus that is learnt moves the PSFs' sampling; colours with focuses of their own have discs of their own.
        if isinstance(step, Tensor) or any(camera.chromatic_defocus(w) for w in self.spectrum.wavelengths):
            return None
        if not blurs_widely(camera.defocus_range, step) or getattr(self.modulator, "fill_factor", 1) != 1:
            return None
        if not is_flat(self.states(torch.float32)[0]):
            return None
        blur = wide_blur(camera.defocus_range, step, self.pupil.extent)
        return blur if known is None or known.side == blur.window else None  # a window of another kind was loaded

    def wide_bank(self, channels: int, dtype: torch.dtype, defocus: Tensor) -> WideBank | None:
        """Return the PSFs that a scene needs on the grids of wide blur; None where the lens has evenly spaced layers.

        Args:
            channels: of the image.
            dtype: float32 or float64.
            defocus: map in radians, or its lowest and highest value, (2,).
        """
        if is_value_unknown() or (blur := self.wide_blur) is None:
            return None
        spectrum, stray_light, groups = self.spectrum_of(channels), (self.fidelity.stray_light, 1), []
        for group, nodes in held_nodes(blur, defocus):
            bank = self._computed_bank(spectrum, dtype, nodes, None, stray_light, group)
            groups.append(GroupBank(group.grid, (group.nodes[0], group.nodes[-1]), bank))
        return WideBank(tuple(groups), blur.window)

    def _wide_psfs(
        self,
        states: Tensor,
        weights: Tensor,
        spectrum: Spectrum,
        grid: int,
        window: int,
        nodes: tuple[float, ...],
    ) -> PSFBank:
        exact, blur = partial(self._exact_psfs, spectrum, grid, states, weights), cast("WideBlur", self.wide_blur)
        shares = [sum(row) for row in spectrum.plane_weights]
        return wide_psfs(exact, blur, self.pupil, float(self.pixel_step), grid, shares, window, nodes, states)

    def _exact_psfs(
        self,
        spectrum: Spectrum,
        grid: int,
        states: Tensor,
        weights: Tensor,
        nodes: tuple[float, ...],
        window: int,
    ) -> PSFBank:
        return self._build(states, weights, spectrum, window, self.fidelity.pixel_tolerance, nodes, grid)

    @torch.no_grad()
    def _wide_light(self) -> tuple[float, float]:
        """Return the least and largest share of the light in the windows of small discs; large ones hold more."""
        states, step, shares = self.states(torch.float32), float(self.pixel_step), []
        for radius in (0.0, 2.0, SMALLEST_WIDE_RADIUS):
            nodes = (radius * math.pi * step / REFERENCE_WAVELENGTH,)
            side = window_of(radius, step, self.pupil.extent)
            shares.append(self._build(*states, self._sampled.flat(), side, 0.1, nodes).energy)
        return float(torch.cat(shares).min()), float(torch.cat(shares).max())
