"""PSFs of one camera's masks at some depths, as different settings make them."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace
from functools import wraps
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.accuracy.candidates import REFERENCE, wavelength_steps
from kornia_tidy.accuracy.costs import window_side
from kornia_tidy.accuracy.error_model import layer_coefficients
from kornia_tidy.fidelity import Fidelity
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH, Spectrum
from kornia_tidy.psf.defocus_interpolation import defocus_band
from kornia_tidy.psf.lens_limits import check_defocus_range
from kornia_tidy.psf.psf_model import PSFModel
from kornia_tidy.psf.psf_window import FittedWindow
from kornia_tidy.psf.spectral_binning import bin_spectrum
from kornia_tidy.render.borders import check_border, largest_window

_TOLERANCE = 0.3  # pixel tolerance of the samples: some per cent suffice for differences of PSFs
_LARGEST_REMEMBERED = 129  # px; layers of all kinds take hundreds of PSFs, and share many
_WAVELENGTHS = 7  # at most, in the samples: PSFs then have errors of half a per cent


def remembered(method: Callable[..., Any]) -> Callable[..., Any]:
    """Return a method whose results its object keeps, by its arguments, in a dictionary ``_known``."""

    @wraps(method)
    def recalled(self: Any, *given: Any) -> Any:
        key = (method, *given)
        if key not in self._known:
            self._known[key] = method(self, *given)
        return self._known[key]

    return recalled


class PSFSamples:
    """PSFs of a camera's masks as different settings make them, before anything is done about stray light.

    Args:
        optics: a :class:`~kornia_tidy.TiDyOptics`.
        channels: of the images: as many as its spectrum has, or 1.
    """

    def __init__(self, optics: Any, channels: int) -> None:
        self.model: PSFModel = optics.psf_model
        own = self.model.spectrum
        self.spectrum = own if channels == len(own.weights) else Spectrum.monochrome()
        states = len(self.model.state_weights(torch.float32))
        # For occlusion each state is rendered separately, see Fidelity.occlusion_states.
        self.captures = states if optics.compositing == "occlusion" else 1
        self.together = states // self.captures
        self.band = defocus_band(self.model.pupil.max_rho2, min(own.wavelengths), REFERENCE_WAVELENGTH)
        self.border: str = optics.border
        self.compositing: str = optics.compositing
        self.channels, self.planes = channels, len(self.spectrum.plane_weights)
        self.wide_blur = self.model.wide_blur if optics.compositing == "gather" else None
        self._fewest = len(self.spectrum.basis or (1,))
        self._known: dict[Any, Any] = {}

    def spectrum_of(self, fidelity: Fidelity) -> Spectrum:
        """Return the spectrum, binned to the number of wavelengths of a fidelity."""
        return self.spectrum if fidelity.wavelengths is None else bin_spectrum(self.spectrum, fidelity.wavelengths)

    def wavelength_counts(self) -> tuple[int, ...]:
        """Return the candidate numbers of binned wavelengths, ascending; none with one wavelength per channel.

        One wavelength per channel is a separate model, not a sample of a broader spectrum.
        """
        single = all(sum(weight > 0 for weight in row) == 1 for row in self.spectrum.weights)
        return () if single else wavelength_steps(self._fewest, len(self.spectrum.wavelengths))

    @remembered
    def nodes(self, layers: str, spacing: float) -> tuple[float, ...]:
        """Return the defocus of layers of a kind and spacing."""
        return self.model.with_fidelity(replace(REFERENCE, layers=layers, layer_spacing=spacing)).defocus_nodes

    def reference(self, height: int, width: int) -> Fidelity:
        """Return the reference for images of this size, its window fixed: that of wide blur, where it is."""
        if self.wide_blur is not None:
            return replace(REFERENCE, window=self.wide_blur.window)
        limit = min(REFERENCE.max_window, largest_window(self.border, height, width))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that the widest allowed window misses the encircled energy
            window = self.model.with_fidelity(REFERENCE.replace(max_window=limit)).window
        return replace(REFERENCE, window=min(window, limit))  # a wide defocus disc takes more than the border allows

    def allows(self, reference: Fidelity, height: int, width: int) -> bool:
        """Return whether a reference keeps to the limits of the lens and of the border."""
        try:
            check_defocus_range(self.model.camera.defocus_range, self.model.pixel_step, reference, reference.window)
            check_border(self.border, height, width, window_side(reference))
        except ValueError:
            return False
        return True

    @torch.no_grad()
    def psfs(
        self,
        nodes: Sequence[float],
        window: int,
        tolerance: float = _TOLERANCE,
        wavelengths: int | None = _WAVELENGTHS,
        dtype: torch.dtype = torch.float64,
    ) -> Tensor:
        """Return exact PSFs at ascending defocus, (D, C, P, P)."""
        most = None if wavelengths is None else max(self._fewest, wavelengths)
        model = self._model(window, tolerance, most).without_memory()
        return model.psf_bank(self.channels, dtype, tuple(nodes)).psfs.cpu()

    @torch.no_grad()
    def layered(self, layers: str, spacing: float, depths: Sequence[float], window: int) -> Tensor:
        """Return the PSFs that layers of a kind and spacing give to pixels at some depths, (D, C, P, P)."""
        if window > _LARGEST_REMEMBERED and len(depths) > 1:  # a depth of band-limited layers takes a dozen of them
            return torch.cat([self.layered(layers, spacing, [psi], window) for psi in depths])
        psi = torch.tensor(depths, dtype=torch.float64)
        weights, at = layer_coefficients(psi, self.nodes(layers, spacing), layers, self.band)
        used = (weights != 0).any(0)
        nodes = tuple(psi for psi, needed in zip(at, used.tolist(), strict=True) if needed)
        psfs = self._sampling(window).psf_bank(self.channels, torch.float64, nodes).psfs.cpu()
        return (weights[:, used] @ psfs.flatten(1)).unflatten(1, psfs.shape[1:])

    @remembered
    def _sampling(self, window: int) -> PSFModel:
        """Return the model of the compared PSFs; a copy has its own memory."""
        model = self._model(window, _TOLERANCE, max(self._fewest, _WAVELENGTHS))
        return model.without_memory() if window > _LARGEST_REMEMBERED else copy(model)

    @torch.no_grad()
    def binned(self, count: int | None, depths: Sequence[float], window: int) -> Tensor:
        """Return PSFs with binned wavelengths, of each channel and basis reflectance, (D, C, B, P, P)."""
        spectrum = self.spectrum if count is None else bin_spectrum(self.spectrum, count)
        planes = torch.zeros((), dtype=torch.float64)
        for wavelength, shares in zip(spectrum.wavelengths, zip(*spectrum.plane_weights, strict=True), strict=True):
            one = self._model(window, 1e-3, None, spectrum=Spectrum.monochrome(wavelength))
            psfs = one.without_memory().psf_bank(1, torch.float64, depths).psfs.cpu()
            planes = planes + psfs * torch.tensor(shares, dtype=torch.float64)[:, None, None]
        return planes.unflatten(1, (self.channels, -1))

    def _model(self, window: int, tolerance: float, wavelengths: int | None, **parts: Any) -> PSFModel:
        """Return the model with PSFs in a window, before anything is done about stray light."""
        points = {"pixel_tolerance": tolerance, "wavelengths": wavelengths}
        fidelity = REFERENCE.replace(window=window, stray_light="discard", **points)
        # Nobody asks how much of the light it holds.
        return self.model.replace(fidelity=fidelity, **parts).with_window(FittedWindow(window, (0.0, 1.0)))
