"""The PSFs that a scene needs: of masks, modulator, lens, spectrum and fidelity, computed or remembered."""

from __future__ import annotations

from functools import partial
from math import ceil, floor
from typing import Any, NoReturn, Self, cast

import numpy as np
import torch
from torch import Tensor, nn

from kornia_tidy.checks import check_finite, check_part
from kornia_tidy.fidelity import Fidelity
from kornia_tidy.masks.base import PhaseMasks, central_square
from kornia_tidy.masks.pixelwise import PixelwiseMask
from kornia_tidy.modulator.modulator import DwellTimes, Timeline, settled_timeline, timeline_of
from kornia_tidy.optics.aperture import check_aperture
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH, Spectrum
from kornia_tidy.optics.thin_lens import DefocusRange, ThinLensCamera
from kornia_tidy.psf.defocus_interpolation import (
    TAPS,
    defocus_band,
    fine_nodes,
    interpolable_spacing,
    interpolated_bank,
    nodes_around,
)
from kornia_tidy.psf.lens_limits import PARTS, check_defocus_range, check_layer_spacing
from kornia_tidy.psf.paper import PAPER_SIZE, paper_psf_bank, warn_if_aliased
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.psf.psf_cache import BankMemory, plain_attributes
from kornia_tidy.psf.psf_ops import computed_psf_bank
from kornia_tidy.psf.psf_window import FittedWindow, fitted_window
from kornia_tidy.psf.pupil import Pupil, pupil_over
from kornia_tidy.psf.spectral_binning import bin_spectrum
from kornia_tidy.psf.wide_blur import BlurGroup
from kornia_tidy.psf.wide_model import Derived, WidePSFs
from kornia_tidy.psf.wide_psfs import is_flat, learnt_bank
from kornia_tidy.runtime.reading import is_unread
from kornia_tidy.runtime.threads import SharedLock
from kornia_tidy.runtime.tracing import is_transformed, is_value_unknown, refuse_torchscript

EACH = -1  # in the place of a state: all of them, each for itself, in one bank


class ScenePSFs(WidePSFs):
    """The parts of a :class:`~kornia_tidy.psf.psf_model.PSFModel`, and the PSFs that a scene needs of them."""

    masks: PhaseMasks
    aperture: Tensor | None
    state: int | None  # the one state looked through, if not all
    moment: int | None  # the one moment looked at, if not the whole exposure
    shown: Timeline | None  # what a snapshot shows, which masks that change leave alone
    lock: SharedLock  # held while masks are read, and by whoever changes several of them at once

    _aperture_mark: object  # another one for each aperture that was set, by which remembered PSFs know it
    # For each moment and state, for their averages, for each number of threads and each grid.
    _memories: dict[tuple[int | None, int | None, int, int], BankMemory]

    def __init__(
        self,
        masks: PhaseMasks | None = None,
        camera: ThinLensCamera | DefocusRange | None = None,
        modulator: nn.Module | None = None,
        fidelity: str | Fidelity = "balanced",
        spectrum: Spectrum | None = None,
        aperture: Tensor | None = None,
    ) -> None:
        unset = dict.fromkeys(("measured", "state", "moment", "shown"))
        vars(self).update(unset, lock=SharedLock(), _memories={})
        parts = self.replace(
            fidelity=Fidelity.of(fidelity),
            masks=PixelwiseMask() if masks is None else masks,
            camera=ThinLensCamera() if camera is None else camera,
            modulator=DwellTimes() if modulator is None else modulator,
            spectrum=Spectrum.rgb() if spectrum is None else spectrum,
            aperture=aperture,
        )
        vars(self).update(vars(parts))
        if self.fidelity.propagation == "paper":
            warn_if_aliased(self.camera.defocus_range, self.spectrum)
        _ = self.fitted

    def __setattr__(self, name: str, value: object) -> NoReturn:
        """Refuse: a model is a value."""
        raise AttributeError(f"{name} of a PSFModel cannot be set: take model.replace({name}=...)")

    def __getstate__(self) -> dict[str, Any]:
        """Return what travels with pickle and deepcopy: no PSFs."""
        return {**vars(self), "_memories": {}}

    def replace(self, **parts: Any) -> Self:
        """Return this model with other parts. Its window is measured when it is first asked for.

        Args:
            parts: by their names: ``masks``, ``camera``, ``modulator``, ``fidelity``, ``spectrum``, ``aperture``.

        Raises:
            TypeError: if a part is of another type.

        Example:
            >>> from kornia_tidy.psf.psf_model import PSFModel
            >>> model = PSFModel(fidelity="draft").replace(masks=PixelwiseMask(1, initial="flat"))
            >>> model.fidelity.name, model.masks.phase.shape
            ('draft', torch.Size([1, 23, 23]))
        """
        for name, value in parts.items():
            if name in PARTS:
                check_part(name, value, *PARTS[name])
        if "aperture" in parts:
            parts["_aperture_mark"] = object()
        if (aperture := parts.get("aperture")) is not None:
            check_part("aperture", aperture, (Tensor, np.ndarray), "a tensor of amplitudes (N, N) such as 23x23")
            parts["aperture"] = check_aperture(aperture, aperture.shape[-1])
        if "spectrum" in parts or "fidelity" in parts:
            fidelity, spectrum = parts.get("fidelity") or self.fidelity, parts.get("spectrum") or self.spectrum
            most = fidelity.wavelengths
            parts["_sampled"] = spectrum if most is None else bin_spectrum(spectrum, most)
        if "masks" in parts or "modulator" in parts:
            parts["shown"] = None
        return self._replace(_derived=Derived(), **parts)

    def _replace(self, **fields: Any) -> Self:
        """Return a model with other fields. What is not replaced is shared: parts, lock and remembered PSFs."""
        other = object.__new__(type(self))
        vars(other).update(vars(self), **fields)
        return other

    # ------------------------------------------------------------------ PSFs

    def scene_bank(self, channels: int, dtype: torch.dtype, defocus: Tensor) -> PSFBank:
        """Return the PSFs that a scene needs, averaged over the exposure. See :meth:`scene_banks`."""
        return self.scene_banks(channels, dtype, defocus)[0][1]

    def scene_banks(
        self,
        channels: int,
        dtype: torch.dtype,
        defocus: Tensor,
        each_state: bool = False,
        device: torch.device | None = None,
    ) -> list[tuple[Tensor | float, PSFBank]]:
        """Return the PSFs that a scene needs, with shares of the exposure; of depths it does not hold there are none.

        Where the spectrum has a basis, (D, C B, P, P): those of a channel follow each other. The banks may be given out
        again: their tensors must not be changed.

        Args:
            channels: of the image: those of the spectrum, or 1.
            dtype: float32 or float64.
            defocus: the scene's defocus in radians, any shape.
            each_state: return a bank for each state of the exposure, not their average, unless the fidelity takes the
                mean PSFs in any case. In one bank, (D, S C, P, P), with shares (S,), where values are left unread.
            device: of measured PSFs. Default: that of ``defocus``.
        """
        spectrum = self._sampled if channels == len(self.spectrum.weights) else self.spectrum_of(channels)
        if self.measured is not None:
            return [(1.0, self._measured_bank(spectrum, dtype, device or defocus.device))]
        nodes, kind = self.defocus_nodes, self.fidelity.layers
        stray_light = self.fidelity.stray_light, len(spectrum.basis or (1,))
        interpolated = kind not in ("nearest", "linear")
        around = fine_nodes(nodes) if interpolated else nodes
        targets = nodes_around(around, defocus)
        states: list[tuple[Tensor | float, int | None]] = [(1.0, None)]
        if each_state and self.fidelity.occlusion_states == "each":
            shares = self.states(dtype)[1]
            states = [(shares, EACH)] if is_unread() else [(share, state) for state, share in enumerate(shares)]
        banks: list[tuple[Tensor | float, PSFBank]] = []
        for share, state in states:
            if interpolated:
                bank = self._interpolated_bank(spectrum, dtype, targets, state).with_stray_light(*stray_light)
            else:
                bank = self._computed_bank(spectrum, dtype, targets, state, stray_light)
            banks.append((share, bank))
        return banks

    def _interpolated_bank(
        self, spectrum: Spectrum, dtype: torch.dtype, targets: tuple[float, ...], state: int | None
    ) -> PSFBank:
        """Return the PSFs at fine nodes, interpolated from those at the layers around them."""
        nodes, kind = self.defocus_nodes, self.fidelity.layers
        spacing, guards = (nodes[-1] - nodes[0]) / (len(nodes) - 1), TAPS[kind] // 2
        first = floor((targets[0] - nodes[0]) / spacing + 1e-9) - guards
        last = ceil((targets[-1] - nodes[0]) / spacing - 1e-9) + guards
        samples = tuple(nodes[0] + spacing * i for i in range(first, last + 1))
        bank = self._computed_bank(spectrum, dtype, samples, state)
        return interpolated_bank(bank, samples, targets, self._band() if kind == "bandlimited" else None)

    def _computed_bank(
        self,
        spectrum: Spectrum,
        dtype: torch.dtype,
        nodes: tuple[float, ...],
        state: int | None = None,
        stray_light: tuple[str, int] | None = None,
        group: BlurGroup | None = None,
    ) -> PSFBank:
        """Return the PSFs at these nodes, computed or remembered; those of a group of wide blur on its grid."""
        states, weights = self.states(dtype)
        if state is not None and state != EACH:
            states, weights = states[state : state + 1], torch.ones_like(weights[:1])
        derived = self._derived
        side = self.window if derived.window is None else derived.window.side
        tolerance, grid = self.fidelity.pixel_tolerance, 1 if group is None else group.grid
        learning = torch.is_grad_enabled() and (states.requires_grad or weights.requires_grad)
        traced = torch.compiler.is_compiling() or is_transformed()
        if group is not None:
            side = group.window
        build = partial(self._build, states, weights, spectrum, side, tolerance, each_state=state == EACH)
        if self.wide_blur is not None and not traced and state != EACH:
            if learning:  # the PSFs are remembered; their gradients are made in the backward pass
                with torch.no_grad():
                    bank = self._computed_bank(spectrum, dtype, nodes, state, None, group)
                bank = learnt_bank(bank, partial(self._exact_psfs, spectrum, grid), states, weights, grid)
                return bank if stray_light is None else bank.with_stray_light(*stray_light)
            build = partial(self._wide_psfs, states, weights, spectrum, grid, side)
        if learning or traced or is_unread() or next(self.camera.parameters(), None) is not None:
            bank = build(nodes)
            return bank if stray_light is None else bank.with_stray_light(*stray_light)
        fill_factor = getattr(self.modulator, "fill_factor", 1.0)
        setting = [side, self.fidelity, self._aperture_mark, fill_factor]
        setting += plain_attributes(self.masks, self.camera)
        # Sums of another number of threads are rounded in another order.
        key = self.moment, state if self.state is None else self.state, torch.get_num_threads(), grid
        memory = self._memories.get(key) or self._memories.setdefault(key, BankMemory())
        return memory.recall(spectrum, setting, states, weights, nodes, build, stray_light)

    def _build(
        self,
        states: Tensor,
        weights: Tensor,
        spectrum: Spectrum,
        window: int,
        tolerance: float,
        nodes: tuple[float, ...],
        grid: int = 1,
        each_state: bool = False,
    ) -> PSFBank:
        if not (is_value_unknown() or is_unread()):
            check_finite("the phase of the masks", states)
            check_finite("the weights of the modulator", weights)
        # How the phase of the masks and the focus of the lens change from wavelength to wavelength.
        dispersion = [self.masks.dispersion(wavelength) for wavelength in spectrum.wavelengths]
        shift = [self.camera.chromatic_defocus(wavelength) for wavelength in spectrum.wavelengths]
        pupil = self.pupil
        if self.fidelity.propagation == "paper":
            if pupil.fill_factor != 1:
                raise ValueError(
                    f"fidelity 'paper' has one sample a mask pixel and so no gaps between them, got a fill_factor of "
                    f"{pupil.fill_factor}"
                )
            return paper_psf_bank(states, weights, pupil.amplitude, spectrum, dispersion, nodes, shift)
        lens = pupil, spectrum, dispersion, nodes, self.pixel_step * grid, window, tolerance, shift
        return computed_psf_bank(states, weights, *lens, each_state=each_state)

    def _measured_bank(self, spectrum: Spectrum, dtype: torch.dtype, device: torch.device | None = None) -> PSFBank:
        bank = cast("PSFBank", self.measured)
        if bank.psfs.shape[1] != len(spectrum.weights):
            raise ValueError(f"the measured PSFs have {bank.psfs.shape[1]} channels, not {len(spectrum.weights)}")
        return bank.to(device, dtype)

    # ------------------------------------------------------------------ the exposure

    def states(self, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """Return the phase of each state over the pupil, (S, N, N) radians, and its share of the exposure, (S,)."""
        shown = self.timeline(dtype) if self.shown is None or self.shown.states.dtype != dtype else self.shown
        if self.moment is not None:
            states, weights = shown.moment(self.moment)
        else:
            states, weights = shown.states, shown.durations if shown.mixture is None else shown.weights
        if self.state is not None:
            states, weights = states[self.state : self.state + 1], torch.ones_like(weights[:1])
        return (states if states.shape[-1] == states.shape[-2] else central_square(states)), weights

    def timeline(self, dtype: torch.dtype) -> Timeline:
        """Return what the modulator shows of the masks during one exposure, and when."""
        if torch.jit.is_tracing():
            refuse_torchscript()
        if self.shown is not None:
            return self.shown.map(lambda part: part.to(dtype))
        return timeline_of(self.modulator, self.masks.phase.to(dtype))

    def snapshot(self, dtype: torch.dtype) -> Self:
        """Return this model with its masks as they are now, for one capture: later changes are seen by the next one.

        Masks that another thread changes in place, as an optimiser does, are copied until they stand still. The parts
        themselves are shared; memories too. The compiler sees the model itself.

        Args:
            dtype: float32 or float64, in which the masks are needed.
        """
        if torch.jit.is_tracing():
            refuse_torchscript()
        if self.shown is not None or torch.compiler.is_compiling() or is_transformed():
            return self
        with self.lock:
            shown, derived = settled_timeline(self.masks, self.modulator, dtype), self._derived
            if derived.blur is not None and not is_flat(shown.states):  # masks that were flat have been learnt
                derived.blur, derived.window = None, None
            if self._derived.window is None:
                _ = self.fitted, self.pupil  # found here, once for all threads
            model = object.__new__(type(self))
            vars(model).update(vars(self), shown=shown)
            return model

    # ------------------------------------------------------------------ what follows from the parts

    @property
    def defocus_nodes(self) -> tuple[float, ...]:
        """Defocus of the PSF bank's layers in radians: evenly spaced over the camera's range, unless blur is wide."""
        if self.measured is not None:
            return tuple(self.measured.defocus.tolist())
        if self.wide_blur is not None:
            return self.wide_blur.nodes
        lo, hi = self.camera.defocus_range
        spacing = self.fidelity.layer_spacing
        if self.fidelity.layers == "bandlimited":
            spacing = min(spacing, interpolable_spacing(self._band()))
        intervals = max(1, round((hi - lo) / spacing))
        return tuple(lo + (hi - lo) * i / intervals for i in range(intervals + 1))

    @property
    def fixed_window(self) -> int | None:
        """Side of the PSFs in pixels if the fidelity, or the measured PSFs, fix it."""
        if self.measured is not None:
            return self.measured.window
        return PAPER_SIZE if self.fidelity.propagation == "paper" else self.fidelity.window

    @property
    def window(self) -> int:
        """Side of the PSFs in pixels: fixed by the fidelity, or measured when the model was made."""
        if self._derived.window is None and self.measured is None and self.fixed_window is not None:
            self._check_layers()
            return self.fixed_window
        return self.fitted.side

    @property
    def fitted(self) -> FittedWindow:
        """The window and the share of the light in it, measured with the masks as they were at the first look."""
        with self.lock:
            if self._derived.window is None:
                self._derived.window = self._fitted_window()
                self._derived.window.warn_if_small(self.fidelity, stacklevel=3)
            return self._derived.window

    def _fitted_window(self) -> FittedWindow:
        if self.measured is not None:
            return FittedWindow.of_bank(self.measured)
        if (blur := self.wide_blur) is not None:
            return FittedWindow(blur.window, self._wide_light())
        self._check_layers()
        return fitted_window(self._sampled_psfs, self.fidelity, self.fixed_window)

    @torch.no_grad()
    def _sampled_psfs(self, size: int) -> Tensor:
        """Return the PSFs at both ends of the range and at focus, good enough to see where the light goes."""
        lo, hi = self.camera.defocus_range
        nodes = tuple(sorted({lo, min(max(0.0, lo), hi), hi}))
        return self._build(*self.states(torch.float32), self._sampled.flat(), size, 0.1, nodes).psfs

    def _check_layers(self) -> None:
        check_defocus_range(self.camera.defocus_range, self.pixel_step, self.fidelity, self.fixed_window)
        if self.fidelity.layers == "bandlimited":
            check_layer_spacing(self.fidelity.layer_spacing, self._band(), min(self.spectrum.wavelengths))

    @property
    def pupil(self) -> Pupil:
        """The aperture over the masks' pixels."""
        fill_factor, pupil = getattr(self.modulator, "fill_factor", 1.0), self._derived.pupil
        if pupil is None or pupil.fill_factor != fill_factor:
            pupil = self._derived.pupil = pupil_over(self.masks.phase.shape, self.aperture, fill_factor)
        return pupil

    def _band(self) -> float:
        return defocus_band(self.pupil.max_rho2, min(self.spectrum.wavelengths), REFERENCE_WAVELENGTH)

    @property
    def pixel_step(self) -> float | Tensor:
        """A sensor pixel seen from the pupil, in metres: see :func:`exact_psf_bank`."""
        return self.camera.pixel_pitch * self.camera.aperture_radius / self.camera.image_distance

    def spectrum_of(self, channels: int, remedy: str = "") -> Spectrum:
        """Return the wavelengths at which an image of so many channels is seen.

        Args:
            channels: those of the spectrum, or 1.
            remedy: to be put behind the message if it is another number.

        Raises:
            ValueError: if it is another number.
        """
        if channels == len(self.spectrum.weights):
            return self._sampled
        if channels == 1:
            return Spectrum.monochrome()
        raise ValueError(
            f"image must have {len(self.spectrum.weights)} channels as the spectrum has, or 1, got {channels}{remedy}"
        )
