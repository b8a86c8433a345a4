"""PSF samples of one camera's masks, computed once for all scenes that are planned with them."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Protocol

import torch
from torch import Tensor

from kornia_tidy.fidelity import Fidelity
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH, Spectrum
from kornia_tidy.planning.bank_cost import BankGeometry
from kornia_tidy.planning.candidates import REFERENCE, layer_kinds, wavelength_steps
from kornia_tidy.planning.error_model import chebyshev_nodes, nodes_needed
from kornia_tidy.psf.defocus_interpolation import TAPS, defocus_band, guarded
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.psf.pupil import Pupil
from kornia_tidy.psf.spectral_binning import bin_spectrum
from kornia_tidy.render.borders import largest_window

_TOLERANCE = 0.3  # pixel tolerance of the samples: some per cent suffice for differences of PSFs
_WAVELENGTHS = 7  # at most, in the samples: PSFs then have errors of half a per cent
_LAYERS_WINDOW = 65  # px, to compare layers: a fifth of the light lies outside, but only a few per cent of its square
_WINDOW_SPACING = 4.0  # radians between the PSFs with which windows are compared
_INTERVALS = 8  # of defocus between the PSFs with which quadrature points and wavelengths are compared
_PIXEL_WINDOW = 65  # px, to compare quadrature points: 33 give 0.9 of the error and 129 give 1.05 (random mask)
_COLOUR_WINDOW = 65  # px, to compare wavelengths


class PlannableCamera(Protocol):
    """Protocol of a camera that can be planned, such as :class:`kornia_tidy.TiDyOptics`."""

    masks: Any
    modulator: Any
    camera: Any
    spectrum: Any
    border: str
    compositing: str

    @property
    def pupil(self) -> Pupil:
        """The aperture."""
        ...

    @property
    def window(self) -> int:
        """Side of the PSFs."""
        ...

    @property
    def defocus_nodes(self) -> tuple[float, ...]:
        """Defocus of the layers in radians."""
        ...

    def with_fidelity(self, fidelity: Fidelity) -> PlannableCamera:
        """The camera at another fidelity."""
        ...

    def psf_bank(self, channels: int, dtype: torch.dtype, defocus: Sequence[float]) -> PSFBank:
        """PSFs at some defocus."""
        ...


class PSFSamples:
    """PSF samples of a camera's masks at the time of construction, each computed once on first use.

    Args:
        optics: the camera.
        channels: of the images: as many as its spectrum has, or 1.
    """

    def __init__(self, optics: PlannableCamera, channels: int) -> None:
        camera = optics.camera
        self.spectrum = optics.spectrum if channels == len(optics.spectrum.weights) else Spectrum.monochrome()
        step = float(camera.pixel_pitch * camera.aperture_radius / camera.image_distance)
        states = len(optics.modulator(optics.masks.phase)[1])
        # For occlusion each state is rendered separately, see Fidelity.occlusion_states.
        self.captures = states if optics.compositing == "occlusion" else 1
        self._geometry = BankGeometry(states // self.captures, optics.pupil, self.spectrum.wavelengths, step)
        self.band = defocus_band(optics.pupil.max_rho2, min(optics.spectrum.wavelengths), REFERENCE_WAVELENGTH)
        self.border, self.compositing = optics.border, optics.compositing
        self.defocus_range: tuple[float, float] = camera.defocus_range
        self._fewest = len(self.spectrum.basis or (1,))
        self.channels, self.planes = channels, len(self.spectrum.plane_weights)
        self._optics = optics
        self._nodes: dict[tuple[str, float], tuple[float, ...]] = {}
        self._references: dict[int, Fidelity] = {}
        self._layers: dict[int, tuple[Tensor, Tensor]] = {}
        self._wide: dict[int, Tensor] = {}
        self._pixels: dict[tuple[float, int], Tensor] = {}
        self._colours: dict[tuple[int | None, int], Tensor] = {}

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
        if key not in self._nodes:
            self._nodes[key] = self._optics.with_fidelity(fidelity).defocus_nodes
        return self._nodes[key]

    def reference(self, height: int, width: int) -> Fidelity:
        """Return the reference for images of this size, its window fixed."""
        limit = min(REFERENCE.max_window, largest_window(self.border, height, width))
        if limit not in self._references:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that the widest allowed window misses the encircled energy
                window = self._optics.with_fidelity(REFERENCE.replace(max_window=limit)).window
            window = min(window, limit)  # that of a wide defocus disc may be larger than the border allows
            self._references[limit] = replace(REFERENCE, window=window)
        return self._references[limit]

    def layer_samples(self, window: int) -> tuple[Tensor, Tensor]:
        """Return Chebyshev nodes for interpolation over defocus and the PSFs there, in a window of bounded size."""
        window = min(window, _LAYERS_WINDOW)
        if window not in self._layers:
            spans = [
                guarded(self.nodes(each), TAPS[each.layers] // 2) if each.layers in TAPS else self.nodes(each)
                for each in (REFERENCE, *layer_kinds())
            ]
            lo, hi = min(nodes[0] for nodes in spans), max(nodes[-1] for nodes in spans)
            nodes = chebyshev_nodes(lo, hi, nodes_needed((hi - lo) / 2, self._geometry.bandwidth))
            psfs = self._bank(tuple(nodes.tolist()), window, _TOLERANCE, torch.float32).psfs.cpu()
            self._layers[window] = nodes, psfs
        return self._layers[window]

    def window_samples(self, window: int) -> tuple[tuple[float, ...], Tensor]:
        """Return sample values of defocus over the range, and the PSFs there in a window."""
        nodes = self._spread(max(1, round((self.defocus_range[1] - self.defocus_range[0]) / _WINDOW_SPACING)))
        if window not in self._wide:
            self._wide[window] = self._bank(nodes, window, _TOLERANCE, torch.float32).psfs.cpu()
        return nodes, self._wide[window]

    def pixel_changes(self, tolerance: float, window: int) -> tuple[tuple[float, ...], Tensor]:
        """Return sample values of defocus, and the change of the PSFs' centres with fewer quadrature points per pixel.

        PSFs in focus and those of the shortest wavelength change most, and both are included.
        """
        nodes, window = self._spread_and_focus(), min(window, _PIXEL_WINDOW)
        for each in (tolerance, REFERENCE.pixel_tolerance):
            if (each, window) not in self._pixels:
                bank = self._bank(nodes, window, each, torch.float64, wavelengths=None)
                self._pixels[each, window] = bank.psfs.cpu()
        return nodes, self._pixels[tolerance, window] - self._pixels[REFERENCE.pixel_tolerance, window]

    def wavelength_changes(self, count: int, window: int) -> tuple[tuple[float, ...], list[Tensor]]:
        r"""Return sample values of defocus, and the change of the PSFs' centres with binned wavelengths.

        With a reflectance basis, channel c captures :math:`h_c * L_c + \sum_b h_{cb} * (L_b - L_c)` with the PSF
        :math:`h_c = \sum_b h_{cb}` of white.

        Returns:
            The nodes, and a list of (D, C, P, P): the changes of :math:`h_c`, and with a basis those of
            :math:`h_{cb}` for the channel b after c, then for the one after that.
        """
        window = min(window, _COLOUR_WINDOW)
        for each in (count, None):
            if (each, window) not in self._colours:
                self._colours[each, window] = self._planes(self.merged(each), window)
        changes = self._colours[count, window] - self._colours[None, window]
        own = torch.arange(self.channels)
        colours = [changes[:, own, (own + k) % self.channels] for k in range(1, changes.shape[2])]
        return self._spread_and_focus(), [changes.sum(2), *colours]

    @torch.no_grad()
    def _planes(self, spectrum: Spectrum, window: int) -> Tensor:
        """Return the PSFs of each channel and basis reflectance, (D, C, B, P, P), wavelength by wavelength."""
        raw = REFERENCE.replace(window=window, pixel_tolerance=1e-3, stray_light="discard")
        lens, nodes = self._optics.with_fidelity(raw), self._spread_and_focus()
        planes = torch.zeros((), dtype=torch.float64)
        for wavelength, shares in zip(spectrum.wavelengths, zip(*spectrum.plane_weights, strict=True), strict=True):
            lens.spectrum = Spectrum.monochrome(wavelength)
            psfs = lens.psf_bank(1, torch.float64, nodes).psfs.cpu()
            planes = planes + psfs * torch.tensor(shares, dtype=torch.float64)[:, None, None]
        return planes.unflatten(1, (self.channels, -1))

    def _spread(self, intervals: int) -> tuple[float, ...]:
        lo, hi = self.defocus_range
        return tuple(lo + (hi - lo) * i / intervals for i in range(intervals + 1))

    def _spread_and_focus(self) -> tuple[float, ...]:
        lo, hi = self.defocus_range
        return tuple(sorted({*self._spread(_INTERVALS), min(max(0.0, lo), hi)}))

    @torch.no_grad()
    def _bank(
        self,
        nodes: tuple[float, ...],
        window: int,
        tolerance: float,
        dtype: torch.dtype,
        wavelengths: int | None = _WAVELENGTHS,
    ) -> PSFBank:
        raw = REFERENCE.replace(
            window=window,
            pixel_tolerance=tolerance,
            stray_light="discard",
            wavelengths=None if wavelengths is None else max(self._fewest, wavelengths),
        )
        return self._optics.with_fidelity(raw).psf_bank(self.channels, dtype, nodes)
