"""The PSF model: from masks, modulator, lens, spectrum and fidelity to point spread functions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, Self, overload

import torch
from torch import Tensor

from kornia_tidy.fidelity import Fidelity
from kornia_tidy.psf.camera_settings import digest_of, settings_of
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.psf.psf_window import FittedWindow
from kornia_tidy.psf.scene_psfs import ScenePSFs
from kornia_tidy.psf.state_bank import StateBank
from kornia_tidy.psf.wide_model import Derived


class PSFModel(ScenePSFs):
    """A lens whose phase mask changes during one exposure: all that decides how a point of light spreads.

    A value: its attributes cannot be set, :meth:`replace` returns another one. The parameters of masks, modulator and
    camera may change, as in training; PSFs are those of the parameters as they are when PSFs are asked for.

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
        >>> model = PSFModel()
        >>> model.psf_bank(defocus=[-10.0, 0.0]).psfs.shape[:2]
        torch.Size([2, 3])
    """

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
        Without gradients, PSFs are remembered while masks and camera stay as they are. Measured PSFs are mixed linearly
        between their nodes, as a capture mixes them.

        Args:
            channels: 1 for an image of one channel, which is taken at 530 nm. Default: those of the spectrum.
            dtype: float32 or float64. Default: float32, or float64 where the fidelity asks for it.
            defocus: ascending nodes in radians. Default: all of ``defocus_nodes``.
            states: return the PSFs of each state that the modulator shows, with their weights, not the average.
        """
        spectrum = self.spectrum_of(len(self.spectrum.weights) if channels is None else channels)
        dtype = self.bank_dtype(dtype)
        if self.measured is not None:
            if states:
                raise ValueError("PSFs that were measured are known for the whole exposure, not for each state of it")
            bank = self._measured_bank(spectrum, dtype, self.masks.phase.device)
            return bank if defocus is None else bank.at_defocus(defocus)
        now = self.snapshot(dtype)
        nodes, stray_light = now.defocus_nodes if defocus is None else tuple(defocus), now.fidelity.stray_light
        if not states:
            return now._computed_bank(spectrum.flat(), dtype, nodes).with_stray_light(stray_light)
        weights = now.state_weights(dtype)
        banks = [now._computed_bank(spectrum.flat(), dtype, nodes, state) for state in range(len(weights))]
        return StateBank.of([bank.with_stray_light(stray_light) for bank in banks], weights)

    def bank_dtype(self, dtype: torch.dtype | None) -> torch.dtype:
        """Return the type that was asked for, or float32 or float64 as the fidelity says."""
        return (torch.float64 if self.fidelity.double else torch.float32) if dtype is None else dtype

    def state_weights(self, dtype: torch.dtype) -> Tensor:
        """Return the share of the exposure of each state that the modulator shows, (S,)."""
        return self.states(dtype)[1]

    # ------------------------------------------------------------------ other models of the same parts

    def with_fidelity(self, fidelity: str | Fidelity) -> Self:
        """Return this model at another fidelity. The parts are shared, so masks learn through both.

        Args:
            fidelity: a preset's name or a :class:`~kornia_tidy.fidelity.Fidelity`, such as that of a plan.
        """
        return self.replace(fidelity=Fidelity.of(fidelity))

    def without_memory(self) -> Self:
        """Return this model without remembered PSFs; those that the copy computes are freed with it. Parts are shared.

        Example:
            >>> PSFModel().without_memory().psf_bank(defocus=[0.0]).psfs.shape[:2]
            torch.Size([1, 3])
        """
        return self._replace(_memories={})

    def through_state(self, state: int) -> Self:
        """Return this model with one state of its modulator shown all the time. The parts and the window are shared.

        Args:
            state: index among the states that the modulator shows.

        Raises:
            ValueError: if there is no such state.

        Example:
            >>> model = PSFModel()
            >>> one, every = model.through_state(2).psf_bank(defocus=[0.0]), model.psf_bank(defocus=[0.0], states=True)
            >>> torch.equal(one.psfs, every.psfs[2])
            True
        """
        count = len(self.state_weights(torch.float32))
        if not 0 <= state < count:
            raise ValueError(f"state must be from 0 to {count - 1}, got {state}")
        return self._replace(state=state, _derived=Derived(self.fitted))

    def through_moment(self, moment: int) -> Self:
        """Return this model with what its modulator shows at one moment shown all the time: one state, or some at once.

        The parts and the window are shared.

        Args:
            moment: index among the moments of :meth:`timeline`.

        Raises:
            ValueError: if there is no such moment.

        Example:
            >>> from kornia_tidy.modulator.modulator import DiffractionEfficiency
            >>> model = PSFModel(modulator=DiffractionEfficiency(0.75))
            >>> model.through_moment(2).state_weights(torch.float32)
            tensor([0.7500, 0.2500])
        """
        count = len(self.timeline(torch.float32).durations)
        if not 0 <= moment < count:
            raise ValueError(f"moment must be from 0 to {count - 1}, got {moment}")
        return self._replace(moment=moment, _derived=Derived(self.fitted))

    def with_bank(self, bank: PSFBank) -> Self:
        """Return this model with PSFs that were measured in the place of its masks'. The other parts are shared.

        Args:
            bank: with the channels of the spectrum. Other depths than it holds are seen as the nearest of them.

        Example:
            >>> measured = PSFBank.from_measured(torch.rand(2, 3, 5, 5), torch.tensor([-5.0, 5.0]))
            >>> model = PSFModel().with_bank(measured)
            >>> model.window, torch.equal(model.psf_bank().psfs, measured.psfs)
            (5, True)
        """
        return self.replace(fidelity=self.fidelity.replace(occlusion_states="mean"))._replace(measured=bank)

    def with_window(self, window: FittedWindow | None) -> Self:
        """Return this model with a window that is known; None measures it, and finds the pupil, when it is asked for.

        Raises:
            ValueError: if this model's window is fixed to another side.
        """
        if window is not None and self.fixed_window not in (None, window.side):
            raise ValueError(
                f"the state is that of another camera: its PSF window is {window.side} px, and this one's is fixed to "
                f"{self.fixed_window} px; set Fidelity.window, or take its settings over by "
                f"load_state_dict(state, take_over=True)"
            )
        return self._replace(_derived=Derived(window))

    def settings(self) -> dict[str, Any]:
        """Return what shapes the PSFs besides the weights, by the names of the parts."""
        fidelity = settings_of(self.fidelity)
        fidelity.pop("window")  # the window has an entry of its own
        if fidelity["wide_blur"] == Fidelity.wide_blur:  # states of earlier versions do not have it
            fidelity.pop("wide_blur")
        bank = self.measured
        return {
            **{name: settings_of(getattr(self, name)) for name in ("masks", "camera", "modulator", "spectrum")},
            "fidelity": fidelity,
            "mask_pixels": list(self.masks.phase.shape[-2:]),
            "aperture": settings_of(self.aperture),
            "measured PSFs": None if bank is None else digest_of(bank.psfs, bank.defocus, bank.energy),
            "state": self.state,
            "moment": self.moment,
        }
