"""The lens with a programmable mask: from masks, camera and spectrum to the PSFs that a scene needs."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Mapping, Sequence
from functools import partial
from math import ceil, floor, pi
from typing import Any, ClassVar, Literal, NoReturn, Self, cast, overload

import numpy as np
import torch
from torch import Tensor, nn

from kornia_tidy.checks import check_finite, check_part
from kornia_tidy.fidelity import Fidelity
from kornia_tidy.masks.base import MASK_SPAN, PhaseMasks, central_square
from kornia_tidy.masks.pixelwise import PixelwiseMask
from kornia_tidy.modulator.modulator import DwellTimes, Timeline, timeline_of
from kornia_tidy.optics.aperture import check_aperture, circular_aperture
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH, Spectrum
from kornia_tidy.optics.thin_lens import DefocusRange, ThinLensCamera
from kornia_tidy.psf.camera_settings import digest_of, settings_of, take_over
from kornia_tidy.psf.camera_state import CameraState
from kornia_tidy.psf.defocus_interpolation import TAPS, defocus_band, fine_nodes, interpolated_bank, nodes_around
from kornia_tidy.psf.exact import exact_psf_bank
from kornia_tidy.psf.fitted_window import fitted_window
from kornia_tidy.psf.lens_limits import PARTS, check_defocus_range
from kornia_tidy.psf.paper import PAPER_SIZE, paper_psf_bank, warn_if_aliased
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.psf.psf_cache import BankMemory
from kornia_tidy.psf.pupil import Pupil
from kornia_tidy.psf.settled_timeline import settled_timeline
from kornia_tidy.psf.spectral_binning import fewer_wavelengths
from kornia_tidy.psf.state_bank import StateBank
from kornia_tidy.runtime.tracing import is_followed, is_value_unknown, refuse_torchscript


class CodedLens(CameraState):
    """A lens whose phase mask changes during one exposure: all that decides how a point of light spreads.

    Its parts can be swapped: ``masks``, ``modulator``, ``camera``, ``spectrum``, ``fidelity``. It knows no scene but
    for the range of its defocus. :class:`kornia_tidy.TiDyOptics` is one that takes pictures.

    Args:
        masks: phase masks. Default: five learnable 23x23 masks of uniform noise.
        camera: turns depth into defocus. Default: :class:`ThinLensCamera` as it comes.
        modulator: turns masks into the states shown and their weights; its ``fill_factor``, where it has one, is the
            share of each mask pixel that modulates. Default: equal dwell times.
        fidelity: a preset's name or a :class:`~kornia_tidy.fidelity.Fidelity`.
        spectrum: wavelengths and how each channel weights them. Default: 610, 530 and 470 nm, one a channel.
        aperture: amplitude over the mask's pixels (N, N), of which N is the shorter side, or finer by a whole factor.
            Default: the binary disc.

    Raises:
        TypeError: if a part is of another type.
        ValueError: if the camera's defocus needs more than 4096 layers or PSFs eight times as wide as the largest
            window, or a mask holds NaN.

    Example:
        >>> lens = CodedLens()
        >>> lens.psf_bank(defocus=[-10.0, 0.0]).psfs.shape[:2]
        torch.Size([2, 3])
    """

    _SETTABLE: ClassVar = {**dict(zip(PARTS, PARTS, strict=True)), "aperture": "_aperture"}  # settings: attributes

    _moment: int | None = None  # the one moment looked at, if not the whole exposure
    _state: int | None = None  # the one state looked through, if not all
    _bank: PSFBank | None = None  # measured, in the place of the masks' own
    _shown: Timeline | None = None  # what a snapshot shows, which masks that change leave alone

    _seen: Spectrum  # what PSFs are computed at: the spectrum, at no more wavelengths than the fidelity allows

    def __init__(
        self,
        masks: PhaseMasks | None = None,
        camera: ThinLensCamera | DefocusRange | None = None,
        modulator: nn.Module | None = None,
        fidelity: str | Fidelity = "balanced",
        spectrum: Spectrum | None = None,
        aperture: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.fidelity = Fidelity.of(fidelity)
        self.masks = PixelwiseMask() if masks is None else masks
        self.camera = ThinLensCamera() if camera is None else camera
        self.modulator = DwellTimes() if modulator is None else modulator
        self.spectrum = Spectrum.rgb() if spectrum is None else spectrum
        if aperture is not None:
            check_part("aperture", aperture, (Tensor, np.ndarray), "a tensor of amplitudes (N, N) such as 23x23")
        self._aperture = None if aperture is None else check_aperture(aperture, aperture.shape[-1])
        # Of each moment and state, and of their averages, for each number of threads.
        self._memories: dict[tuple[int | None, int | None, int], BankMemory] = {}
        if self.fidelity.propagation == "paper":
            warn_if_aliased(self.camera.defocus_range, self.spectrum)
        self.fit_window()

    @overload
    def psf_bank(
        self,
        channels: int | None = None,
        dtype: torch.dtype | None = None,
        defocus: Sequence[float] | None = None,
        *,
        states: Literal[False] = False,
    ) -> PSFBank: ...

    @overload
    def psf_bank(
        self,
        channels: int | None = None,
        dtype: torch.dtype | None = None,
        defocus: Sequence[float] | None = None,
        *,
        states: Literal[True],
    ) -> StateBank: ...

    def psf_bank(
        self,
        channels: int | None = None,
        dtype: torch.dtype | None = None,
        defocus: Sequence[float] | None = None,
        *,
        states: bool = False,
    ) -> PSFBank | StateBank:
        """Return the PSFs of the masks as they are now, averaged over the exposure; gradients reach the masks.

        They are those of a point that reflects all wavelengths alike, whether or not the spectrum has a basis.
        Without gradients, PSFs are remembered while masks and camera stay as they are.

        Args:
            channels: 1 for an image of one channel, which is taken at 530 nm. Default: those of the spectrum.
            dtype: float32 or float64. Default: float32, or float64 where the fidelity asks for it.
            defocus: ascending nodes in radians. Default: all of ``defocus_nodes``.
            states: return the PSFs of each state that the modulator shows, with their weights, not the average.
        """
        spectrum = self._spectrum(len(self.spectrum.weights) if channels is None else channels)
        dtype = (torch.float64 if self.fidelity.double else torch.float32) if dtype is None else dtype
        if self._bank is not None:
            if states or defocus is not None:
                raise ValueError("PSFs that were measured are known at their own defocus and for the whole exposure")
            return self._measured_bank(spectrum, dtype)
        now = self.snapshot(dtype)
        nodes, stray_light = now.defocus_nodes if defocus is None else tuple(defocus), now.fidelity.stray_light
        if not states:
            return now._computed_bank(spectrum.flat(), dtype, nodes).with_stray_light(stray_light)
        weights = now.state_weights(dtype)
        banks = [now._computed_bank(spectrum.flat(), dtype, nodes, state) for state in range(len(weights))]
        return StateBank.of([bank.with_stray_light(stray_light) for bank in banks], weights)

    def state_weights(self, dtype: torch.dtype) -> Tensor:
        """Return the share of the exposure of each state that the modulator shows, (S,)."""
        return self._states(dtype)[1]

    def timeline(self, dtype: torch.dtype) -> Timeline:
        """Return what the modulator shows of the masks during one exposure, and when."""
        if torch.jit.is_tracing():
            refuse_torchscript()
        if self._shown is not None:
            return self._shown.map(lambda part: part.to(dtype))
        return timeline_of(self.modulator, self.masks.phase.to(dtype))

    @property
    def defocus_nodes(self) -> tuple[float, ...]:
        """Defocus of the PSF bank's layers in radians: evenly spaced over the camera's range."""
        if self._bank is not None:
            return tuple(self._bank.defocus.tolist())
        lo, hi = self.camera.defocus_range
        intervals = max(1, round((hi - lo) / self.fidelity.layer_spacing))
        return tuple(lo + (hi - lo) * i / intervals for i in range(intervals + 1))

    def with_fidelity(self, fidelity: str | Fidelity) -> Self:
        """Return this lens at another fidelity. The parts are shared, so masks learn through both.

        Args:
            fidelity: a preset's name or a :class:`~kornia_tidy.fidelity.Fidelity`, such as that of a plan.
        """
        other = self._sharing_parts()
        other.fidelity = Fidelity.of(fidelity)
        return other

    def through_state(self, state: int) -> Self:
        """Return this lens with one state of its modulator shown all the time. The parts and the window are shared.

        Args:
            state: index among the states that the modulator shows.

        Raises:
            ValueError: if there is no such state.

        Example:
            >>> lens = CodedLens()
            >>> one, every = lens.through_state(2).psf_bank(defocus=[0.0]), lens.psf_bank(defocus=[0.0], states=True)
            >>> torch.equal(one.psfs, every.psfs[2])
            True
        """
        count = len(self.state_weights(torch.float32))
        if not 0 <= state < count:
            raise ValueError(f"state must be from 0 to {count - 1}, got {state}")
        return self._looking(_state=state)

    def through_moment(self, moment: int) -> Self:
        """Return this lens with what its modulator shows at one moment shown all the time: one state, or some at once.

        The parts and the window are shared.

        Args:
            moment: index among the moments of :meth:`timeline`.

        Raises:
            ValueError: if there is no such moment.

        Example:
            >>> from kornia_tidy.modulator.modulator import DiffractionEfficiency
            >>> lens = CodedLens(modulator=DiffractionEfficiency(0.75))
            >>> lens.through_moment(2).state_weights(torch.float32)
            tensor([0.7500, 0.2500])
        """
        count = len(self.timeline(torch.float32).durations)
        if not 0 <= moment < count:
            raise ValueError(f"moment must be from 0 to {count - 1}, got {moment}")
        return self._looking(_moment=moment)

    def _looking(self, **where: int) -> Self:
        other, window = self._sharing_parts(), self.window
        other.__dict__.update(_window=window, _memories=self._memories, **where)  # PSFs remembered by both
        return other

    def with_bank(self, bank: PSFBank) -> Self:
        """Return this lens with PSFs that were measured in the place of its masks'. The other parts are shared.

        Args:
            bank: with the channels of the spectrum. Other depths than it holds are seen as the nearest of them.

        Example:
            >>> measured = PSFBank.from_measured(torch.rand(2, 3, 5, 5), torch.tensor([-5.0, 5.0]))
            >>> lens = CodedLens().with_bank(measured)
            >>> lens.window, torch.equal(lens.psf_bank().psfs, measured.psfs)
            (5, True)
        """
        other = self.with_fidelity(self.fidelity.replace(occlusion_states="mean"))
        other.__dict__["_bank"] = bank
        return other

    def _measured_bank(self, spectrum: Spectrum, dtype: torch.dtype, device: torch.device | None = None) -> PSFBank:
        bank = cast("PSFBank", self._bank)
        if bank.psfs.shape[1] != len(spectrum.weights):
            raise ValueError(f"the measured PSFs have {bank.psfs.shape[1]} channels, not {len(spectrum.weights)}")
        veil = None if bank.veil is None else bank.veil.to(device, dtype)
        return PSFBank(*(x.to(device, dtype) for x in (bank.psfs, bank.defocus, bank.energy)), veil)

    def _sharing_parts(self) -> Self:
        with self._lock:
            other = copy.copy(self)
            for kind in ("_modules", "_parameters", "_buffers"):  # or swapping a part of one would swap that of both
                other.__dict__[kind] = dict(self.__dict__[kind])
        return other

    def snapshot(self, dtype: torch.dtype) -> Self:
        """Return this lens as it is now, for one capture: what other threads change meanwhile is seen by the next one.

        Masks that another thread changes in place, as an optimiser does, are copied until they stand still. The parts
        themselves are shared; memories too. The compiler sees the lens itself.

        Args:
            dtype: float32 or float64, in which the masks are needed.
        """
        if self._shown is not None or is_followed():
            return self
        with self._lock:
            shown = settled_timeline(self.masks, self.modulator, dtype)
            if self._window is None:
                self.fit_window()
            _ = self.pupil  # found here, once for all threads
            now = object.__new__(type(self))
            now.__dict__ = {**self.__dict__, "_modules": dict(self._modules), "_shown": shown}
        return now

    # ------------------------------------------------------------------ the window of the PSFs

    @property
    def window(self) -> int:
        """Side of the PSFs in pixels: given by the fidelity, or measured by :meth:`fit_window`."""
        window = self._window
        if window is None and self._fixed_window and self._bank is None:
            self._check_layers()
            return self._fixed_window
        return self.fit_window() if window is None else window

    @property
    def light_held(self) -> tuple[float, float]:
        """Least and largest share of the light in the window, as it was when the window was chosen."""
        with self._lock:
            if self._window is None:
                self.fit_window()
            return self._held

    @property
    def _fixed_window(self) -> int | None:
        return PAPER_SIZE if self.fidelity.propagation == "paper" else self.fidelity.window

    def _check_layers(self) -> None:
        settings = self.fidelity
        check_defocus_range(self.camera.defocus_range, self._pixel_step(), settings, self._fixed_window)
        if settings.layers == "bandlimited" and settings.layer_spacing >= (limit := pi / self._band()):
            raise ValueError(
                f"layers='bandlimited' needs a layer_spacing below {limit:.2f} rad for this aperture and "
                f"{min(self.spectrum.wavelengths) * 1e9:.0f} nm, got {settings.layer_spacing}"
            )

    def fit_window(self) -> int:
        """Choose the smallest PSF window that holds the fidelity's share of the light of the masks as they are now.

        It is done on construction, when a part is swapped, and after loading weights that do not tell their window;
        masks in training keep their window until this is called again. A window or a preset that fixes the side is only
        measured.

        Returns:
            The side in pixels: at most ``fidelity.max_window``, with a warning if that does not hold the share.
        """
        with self._lock:
            self._window, self._held, enough = self._fitted_window()
            window, held = self._window, self._held
        if not enough:
            settings = self.fidelity
            warnings.warn(
                f"the largest PSF window allowed, {window} px, holds {held[0]:.0%} of the light where it should "
                f"hold {settings.enclosed_energy:.0%}; the rest is handled by {settings.stray_light!r}: raise "
                f"Fidelity.max_window, or lower Fidelity.enclosed_energy",
                stacklevel=2,
            )
        return window

    def _fitted_window(self) -> tuple[int, tuple[float, float], bool]:
        """Return the window, the least and largest share of the light in it, and whether that is enough."""
        if self._bank is not None:
            energy = self._bank.energy
            return self._bank.window, (float(energy.min()), float(energy.max())), True
        self._check_layers()
        return fitted_window(self._sampled_psfs, self.fidelity, self._fixed_window)

    @torch.no_grad()
    def _sampled_psfs(self, size: int) -> Tensor:
        """PSFs at both ends of the range and at focus, good enough to see where the light goes."""
        lo, hi = self.camera.defocus_range
        nodes = tuple(sorted({lo, min(max(0.0, lo), hi), hi}))
        states, weights = self._states(torch.float32)
        return self._build(states, weights, self._seen.flat(), self._pixel_step(), size, 0.1, nodes).psfs

    def __setattr__(self, name: str, value: Any) -> None:
        """Set an attribute; a part that shapes the PSFs makes wavelengths, window and pupil to be found anew."""
        if name not in PARTS:
            super().__setattr__(name, value)
            return
        check_part(name, value, *PARTS[name])
        with self._lock:
            if name in ("spectrum", "fidelity"):
                both = {**self.__dict__, name: value}
                if "spectrum" in both and "fidelity" in both:
                    spectrum, most = both["spectrum"], both["fidelity"].wavelengths
                    self.__dict__["_seen"] = spectrum if most is None else fewer_wavelengths(spectrum, most)
            super().__setattr__(name, value)
            self.__dict__.update(_window=None, _pupil=None)
            if name in ("masks", "modulator"):
                self.__dict__["_shown"] = None

    def __prepare_scriptable__(self) -> NoReturn:
        """Refuse ``torch.jit.script``, of this camera and of what it is a part of."""
        refuse_torchscript()

    def __getstate__(self) -> dict[str, Any]:
        """Return what travels with pickle and deepcopy: no PSFs."""
        return {**super().__getstate__(), "_memories": {}}

    # ------------------------------------------------------------------ the state

    def settings(self) -> dict[str, Any]:
        """Return what shapes the PSFs besides the weights, by the names of the parts."""
        fidelity = settings_of(self.fidelity)
        fidelity.pop("window")  # the window has an entry of its own
        bank = self._bank
        return {
            **{name: settings_of(getattr(self, name)) for name in ("masks", "camera", "modulator", "spectrum")},
            "fidelity": fidelity,
            "mask_pixels": list(self.masks.phase.shape[-2:]),
            "aperture": settings_of(self._aperture),
            "measured PSFs": None if bank is None else digest_of(bank.psfs, bank.defocus, bank.energy),
            "state": self._state,
            "moment": self._moment,
        }

    def _take_over(self, saved: Mapping[str, Any]) -> None:
        fidelity = saved.get("fidelity")
        if isinstance(fidelity, dict):
            saved = {**saved, "fidelity": {**fidelity, "window": saved.get("fixed_window")}}
        take_over(self, saved, self.settings(), self._SETTABLE)
        self.__dict__.update(_window=None, _pupil=None)

    def _check_window(self, window: int) -> None:
        fixed = self._fixed_window if self._bank is None else self._bank.window
        if fixed not in (None, window):
            raise ValueError(
                f"the state is that of another camera: its PSF window is {window} px, and this one's is fixed to "
                f"{fixed} px; set Fidelity.window, or take its settings over by load_state_dict(state, take_over=True)"
            )

    # ------------------------------------------------------------------ inside

    def _states(self, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """What the modulator shows over the pupil, and for what share of the exposure."""
        shown = self.timeline(dtype)
        states, weights = (shown.states, shown.weights) if self._moment is None else shown.moment(self._moment)
        if self._state is not None:
            states, weights = states[self._state : self._state + 1], torch.ones_like(weights[:1])
        return central_square(states), weights

    @property
    def pupil(self) -> Pupil:
        """The aperture over the masks' pixels."""
        fill_factor = getattr(self.modulator, "fill_factor", 1.0)
        pupil = self.__dict__["_pupil"]
        if pupil is None or pupil.fill_factor != fill_factor:
            size = min(self.masks.phase.shape[-2:])
            amplitude = circular_aperture(size, MASK_SPAN / size) if self._aperture is None else self._aperture
            if amplitude.shape[-1] % size:
                raise ValueError(
                    f"aperture must have a whole number of cells for each of the {size} mask pixels, got "
                    f"{tuple(amplitude.shape)}"
                )
            pupil = self.__dict__["_pupil"] = Pupil(amplitude, MASK_SPAN / amplitude.shape[-1], fill_factor)
        return pupil

    def _build(
        self,
        states: Tensor,
        weights: Tensor,
        spectrum: Spectrum,
        step: float | Tensor,
        window: int,
        tolerance: float,
        nodes: tuple[float, ...],
    ) -> PSFBank:
        if not is_value_unknown():
            check_finite("the phase of the masks", states)
            check_finite("the weights of the modulator", weights)
        dispersion, shift = self._colours(spectrum)
        if self.fidelity.propagation == "paper":
            if self.pupil.fill_factor != 1:
                raise ValueError(
                    f"fidelity 'paper' has one sample a mask pixel and so no gaps between them, got a fill_factor of "
                    f"{self.pupil.fill_factor}"
                )
            return paper_psf_bank(states, weights, self.pupil.amplitude, spectrum, dispersion, nodes, shift)
        return exact_psf_bank(states, weights, self.pupil, spectrum, dispersion, nodes, step, window, tolerance, shift)

    def _computed_bank(
        self, spectrum: Spectrum, dtype: torch.dtype, nodes: tuple[float, ...], state: int | None = None
    ) -> PSFBank:
        """PSFs at these nodes, computed or remembered, before anything is done about stray light."""
        states, weights = self._states(dtype)
        if state is not None:
            states, weights = states[state : state + 1], torch.ones_like(weights[:1])
        step, tolerance = self._pixel_step(), self.fidelity.pixel_tolerance
        build = partial(self._build, states, weights, spectrum, step, self.window, tolerance)
        learning = any(isinstance(x, Tensor) and x.requires_grad for x in (states, weights, step))
        if is_followed() or isinstance(step, Tensor) or (learning and torch.is_grad_enabled()):
            return build(nodes)
        paper = self.fidelity.propagation == "paper"
        setting = (self._colours(spectrum), step, self.window, tolerance, paper, self.pupil)
        # Sums of another number of threads are rounded in another order.
        key = self._moment, state if self._state is None else self._state, torch.get_num_threads()
        return self._memories.setdefault(key, BankMemory()).recall(spectrum, setting, states, weights, nodes, build)

    def scene_bank(self, channels: int, dtype: torch.dtype, defocus: Tensor, state: int | None = None) -> PSFBank:
        """Return the PSFs that a scene needs: those of depths it does not hold are not computed.

        Where the spectrum has a basis, (D, C B, P, P): those of a channel follow each other.

        Args:
            channels: of the image, as in :meth:`psf_bank`.
            dtype: float32 or float64.
            defocus: the scene's defocus in radians, any shape.
            state: index of the one state to look through. Default: the average over the exposure.
        """
        spectrum, kind = self._spectrum(channels), self.fidelity.layers
        if self._bank is not None:
            return self._measured_bank(spectrum, dtype, defocus.device)
        nodes = self.defocus_nodes
        if kind in ("nearest", "linear"):
            bank = self._computed_bank(spectrum, dtype, nodes_around(nodes, defocus), state)
        else:
            spacing, guards = (nodes[-1] - nodes[0]) / (len(nodes) - 1), TAPS[kind] // 2
            targets = nodes_around(fine_nodes(nodes), defocus)
            first = floor((targets[0] - nodes[0]) / spacing + 1e-9) - guards
            last = ceil((targets[-1] - nodes[0]) / spacing - 1e-9) + guards
            samples = tuple(nodes[0] + spacing * i for i in range(first, last + 1))
            bank = self._computed_bank(spectrum, dtype, samples, state)
            bank = interpolated_bank(bank, samples, targets, self._band() if kind == "bandlimited" else None)
        return bank.with_stray_light(self.fidelity.stray_light, len(spectrum.basis or (1,)))

    def _band(self) -> float:
        return defocus_band(self.pupil.max_rho2, min(self.spectrum.wavelengths), REFERENCE_WAVELENGTH)

    def _colours(self, spectrum: Spectrum) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """How the phase of the masks and the focus of the lens change from wavelength to wavelength."""
        waves = spectrum.wavelengths
        return tuple(map(self.masks.dispersion, waves)), tuple(map(self.camera.chromatic_defocus, waves))

    def _pixel_step(self) -> float | Tensor:
        """A sensor pixel seen from the pupil, in metres: see :func:`exact_psf_bank`."""
        return self.camera.pixel_pitch * self.camera.aperture_radius / self.camera.image_distance

    def _spectrum(self, channels: int, remedy: str = "") -> Spectrum:
        if channels == len(self.spectrum.weights):
            return self._seen
        if channels == 1:
            return Spectrum.monochrome()
        raise ValueError(
            f"image must have {len(self.spectrum.weights)} channels as the spectrum has, or 1, got {channels}{remedy}"
        )
