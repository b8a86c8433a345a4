"""PSFs of one camera's masks at some depths, as different settings make them."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.fidelity import Fidelity
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH, Spectrum
from kornia_tidy.planning.candidates import REFERENCE, layer_kinds, wavelength_steps
from kornia_tidy.planning.costs import BankGeometry, window_side
from kornia_tidy.planning.error_model import chebyshev_nodes, chebyshev_weights, layer_coefficients, nodes_needed
from kornia_tidy.psf.defocus_interpolation import TAPS, defocus_band, guarded
from kornia_tidy.psf.lens_limits import check_defocus_range
from kornia_tidy.psf.psf_model import PSFModel
from kornia_tidy.psf.spectral_binning import bin_spectrum
from kornia_tidy.render.borders import check_border, largest_window

_TOLERANCE = 0.3  # pixel tolerance of the samples: some per cent suffice for differences of PSFs
_WAVELENGTHS = 7  # at most, in the samples: PSFs then have errors of half a per cent
_MOST_NODES = 200  # of defocus from which all others are interpolated; of wide ranges each depth has its own PSFs


class PSFSamples:
    """PSFs of a camera's masks as different settings make them, before anything is done about stray light.

    Args:
        optics: a :class:`~kornia_tidy.TiDyOptics`.
        channels: of the images: as many as its spectrum has, or 1.
    """

    def __init__(self, optics: Any, channels: int) -> None:
        model: PSFModel = optics.psf_model
        self.spectrum = model.spectrum if channels == len(model.spectrum.weights) else Spectrum.monochrome()
        states = len(model.state_weights(torch.float32))
        # For occlusion each state is rendered separately, see Fidelity.occlusion_states.
        self.captures = states if optics.compositing == "occlusion" else 1
        step = float(model.pixel_step)
        self._geometry = BankGeometry(states // self.captures, model.pupil, self.spectrum.wavelengths, step)
        self.band = defocus_band(model.pupil.max_rho2, min(model.spectrum.wavelengths), REFERENCE_WAVELENGTH)
        self.border: str = optics.border
        self.compositing: str = optics.compositing
        self.defocus_range = model.camera.defocus_range
        self.channels, self.planes = channels, len(self.spectrum.plane_weights)
        self.wide_blur = model.wide_blur if optics.compositing == "gather" else None
        self._fewest = len(self.spectrum.basis or (1,))
        self._model = model
        self._known: dict[Any, Any] = {}

    def geometry(self, fidelity: Fidelity) -> BankGeometry:
        """Return the pupil and spectrum parameters that determine the cost of the PSFs."""
        return replace(self._geometry, wavelengths=self.merged(fidelity.wavelengths).wavelengths)

    def merged(self, count: int | None) -> Spectrum:
        """Return the spectrum binned to a number of wavelengths."""
        return self.spectrum if count is None else bin_spectrum(self.spectrum, count)

    def wavelength_counts(self) -> tuple[int, ...]:
        """Return the candidate numbers of binned wavelengths, ascending; none with one wavelength per channel.

        One wavelength per channel is a model of its own, not a sample of a broader spectrum.
        """
        single = all(sum(weight > 0 for weight in row) == 1 for row in self.spectrum.weights)
        return () if single else wavelength_steps(self._fewest, len(self.spectrum.wavelengths))

    def nodes(self, fidelity: Fidelity) -> tuple[float, ...]:
        """Return the defocus of a fidelity's layers."""
        key = (fidelity.layers, fidelity.layer_spacing)
        if key not in self._known:
            self._known[key] = self._model.with_fidelity(fidelity).defocus_nodes
        return self._known[key]

    def reference(self, height: int, width: int) -> Fidelity:
        """Return the reference for images of this size, its window fixed: that of wide blur, where it is."""
        if self.wide_blur is not None:
            return replace(REFERENCE, window=self.wide_blur.window)
        limit = min(REFERENCE.max_window, largest_window(self.border, height, width))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that the widest allowed window misses the encircled energy
            window = self._model.with_fidelity(REFERENCE.replace(max_window=limit)).window
        return replace(REFERENCE, window=min(window, limit))  # a wide defocus disc takes more than the border allows

    def allows(self, reference: Fidelity, height: int, width: int) -> bool:
        """Return whether a reference keeps to the limits of the lens and of the border."""
        try:
            check_defocus_range(self.defocus_range, self._model.pixel_step, reference, reference.window)
            check_border(self.border, height, width, window_side(reference))
        except ValueError:
            return False
        return True

    def sampled(self, fidelity: Fidelity) -> Sequence[float]:
        """Return the defocus of the PSFs that are computed for a fidelity's layers."""
        nodes = self.nodes(fidelity)
        return guarded(nodes, TAPS[fidelity.layers] // 2) if fidelity.layers in TAPS else nodes

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
        model = self._model.with_fidelity(_raw(window, tolerance, most)).without_memory()
        return model.psf_bank(self.channels, dtype, tuple(nodes)).psfs.cpu()

    def layered(self, fidelity: Fidelity, depths: Sequence[float], window: int) -> Tensor:
        """Return the PSFs that a fidelity's layers give to pixels at some depths, (D, C, P, P)."""
        psi = torch.tensor(depths, dtype=torch.float64)
        weights, at = layer_coefficients(psi, self.nodes(fidelity), fidelity.layers, self.band)
        used = (weights != 0).any(0)
        weights, at = weights[:, used], torch.tensor(at, dtype=torch.float64)[used]
        if window not in self._known:
            spans = [self.sampled(each) for each in (REFERENCE, *layer_kinds())]
            lo, hi = min(nodes[0] for nodes in spans), max(nodes[-1] for nodes in spans)
            if (count := nodes_needed((hi - lo) / 2, self.band)) <= _MOST_NODES:
                nodes = chebyshev_nodes(lo, hi, count)
                self._known[window] = nodes, self.psfs(nodes.tolist(), window)
            else:
                self._known[window] = None
        if (known := self._known[window]) is None:
            psfs = self.psfs(at.tolist(), window)
        else:
            nodes, psfs = known
            weights = weights @ chebyshev_weights(at, nodes)
        return (weights @ psfs.flatten(1)).unflatten(1, psfs.shape[1:])

    @torch.no_grad()
    def binned(self, count: int | None, depths: Sequence[float], window: int) -> Tensor:
        """Return PSFs with binned wavelengths, of each channel and basis reflectance, (D, C, B, P, P)."""
        spectrum, planes = self.merged(count), torch.zeros((), dtype=torch.float64)
        model = self._model.with_fidelity(_raw(window, 1e-3, None)).without_memory()
        for wavelength, shares in zip(spectrum.wavelengths, zip(*spectrum.plane_weights, strict=True), strict=True):
            psfs = model.replace(spectrum=Spectrum.monochrome(wavelength)).psf_bank(1, torch.float64, depths).psfs.cpu()
            planes = planes + psfs * torch.tensor(shares, dtype=torch.float64)[:, None, None]
        return planes.unflatten(1, (self.channels, -1))


def _raw(window: int, tolerance: float, wavelengths: int | None) -> Fidelity:
    """Return the fidelity of PSFs in a window, before anything is done about stray light."""
    return REFERENCE.replace(window=window, pixel_tolerance=tolerance, stray_light="discard", wavelengths=wavelengths)
