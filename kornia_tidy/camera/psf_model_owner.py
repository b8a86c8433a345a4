"""A module that owns a PSF model, and offers the model's parts and PSFs as its own attributes and methods."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, Literal, NoReturn, Self, overload

import torch
from torch import Tensor, nn

from kornia_tidy.fidelity import Fidelity
from kornia_tidy.masks.base import PhaseMasks
from kornia_tidy.modulator.modulator import Timeline
from kornia_tidy.optics.spectrum import Spectrum
from kornia_tidy.optics.thin_lens import DefocusRange, ThinLensCamera
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.psf.psf_model import PSFModel
from kornia_tidy.psf.pupil import Pupil
from kornia_tidy.psf.state_bank import StateBank
from kornia_tidy.runtime.tracing import is_followed, refuse_torchscript

_SUBMODULES = ("masks", "camera", "modulator")


class PSFModelOwner(nn.Module):
    """A module with a PSF model; masks, camera and modulator of the model are its submodules.

    So states hold ``masks.phase``, and optimisers and ``to(device)`` reach the parts. To set ``masks``, ``camera``,
    ``modulator``, ``fidelity``, ``spectrum`` or ``aperture`` puts another PSF model in the place of the present one.

    Args:
        psf_model: the model.
    """

    psf_model: PSFModel
    fixed_defocus: tuple[float, float] | None = None  # of every scene, see with_fixed_layers
    masks: PhaseMasks
    camera: ThinLensCamera | DefocusRange
    modulator: nn.Module

    def __init__(self, psf_model: PSFModel) -> None:
        super().__init__()
        self.psf_model = psf_model
        for name in _SUBMODULES:
            super().__setattr__(name, getattr(psf_model, name))

    def __setattr__(self, name: str, value: Any) -> None:
        """Set an attribute; masks, camera and modulator are of the PSF model too."""
        if name not in _SUBMODULES:
            super().__setattr__(name, value)
            return
        with self.psf_model.lock:
            self._swap(**{name: value})
            super().__setattr__(name, value)

    def _swap(self, **parts: Any) -> None:
        with self.psf_model.lock:
            self.psf_model = self.psf_model.replace(**parts)

    @abstractmethod
    def _replace(self, **attributes: Any) -> Self:
        """Return this module with other attributes; all others are shared."""

    def __prepare_scriptable__(self) -> NoReturn:
        """Refuse ``torch.jit.script`` of this camera and of modules that contain it."""
        refuse_torchscript()

    @property
    def fidelity(self) -> Fidelity:
        """How exactly to compute."""
        return self.psf_model.fidelity

    @fidelity.setter
    def fidelity(self, value: Fidelity) -> None:
        self._swap(fidelity=value)

    @property
    def spectrum(self) -> Spectrum:
        """Wavelengths, and how each channel weights them."""
        return self.psf_model.spectrum

    @spectrum.setter
    def spectrum(self, value: Spectrum) -> None:
        self._swap(spectrum=value)

    @property
    def aperture(self) -> Tensor | None:
        """Amplitude over the mask's pixels, None for the binary disc."""
        return self.psf_model.aperture

    @aperture.setter
    def aperture(self, value: Tensor | None) -> None:
        self._swap(aperture=value)

    @property
    def pupil(self) -> Pupil:
        """The aperture over the masks' pixels."""
        return self.psf_model.pupil

    @property
    def defocus_nodes(self) -> tuple[float, ...]:
        """Defocus of the PSF bank's layers in radians: evenly spaced over the camera's range."""
        return self.psf_model.defocus_nodes

    @property
    def window(self) -> int:
        """Side of the PSFs in pixels: given by the fidelity, or measured by :meth:`fit_window`."""
        return self.psf_model.window

    @property
    def light_held(self) -> tuple[float, float]:
        """Least and largest share of the light in the window, as it was when the window was chosen."""
        return self.psf_model.fitted.held

    def fit_window(self) -> int:
        """Choose the smallest PSF window that holds the fidelity's share of the light of the masks as they are now.

        It is done on construction, when a part is swapped, and after loading weights that do not tell their window;
        masks in training keep their window until this is called again. A window or a preset that fixes the side is only
        measured.

        Returns:
            The side in pixels: at most ``fidelity.max_window``, or as wide as the lens's defocus disc; with a warning
            if that does not hold the share.
        """
        with self.psf_model.lock:
            self.psf_model = self.psf_model.with_window(None)
            return self.psf_model.fitted.side

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
        model = self.psf_model
        if not is_followed():
            with model.lock:  # the window and the masks of one moment
                model = self.psf_model.snapshot(model.bank_dtype(dtype))
        if states:
            return model.psf_bank(channels, dtype, defocus, states=True)
        return model.psf_bank(channels, dtype, defocus)

    def state_weights(self, dtype: torch.dtype) -> Tensor:
        """Return the share of the exposure of each state that the modulator shows, (S,)."""
        return self.psf_model.state_weights(dtype)

    def timeline(self, dtype: torch.dtype) -> Timeline:
        """Return what the modulator shows of the masks during one exposure, and when."""
        return self.psf_model.timeline(dtype)

    def with_fidelity(self, fidelity: str | Fidelity) -> Self:
        """Return this camera at another fidelity. The parts are shared, so masks learn through both.

        Args:
            fidelity: a preset's name or a :class:`~kornia_tidy.fidelity.Fidelity`, such as that of a plan.
        """
        return self._replace(psf_model=self.psf_model.with_fidelity(fidelity))

    def with_fixed_layers(self, depth: Tensor | None = None) -> Self:
        """Return this camera with the same defocus layers for every scene. The parts are shared, so masks learn.

        A capture usually looks at the scene: it checks its values, and convolves the layers between its nearest and its
        farthest point. An accelerator has to be waited for to know them. With fixed layers a capture on an accelerator
        looks at no value: the host never waits, and a training step can be captured in a CUDA graph, once one was made
        before. On the CPU values are checked as ever.

        Args:
            depth: depths whose range all scenes keep to, in what the camera takes, such as metres. Default: all of the
                camera's range. What lies beyond is rendered as its nearest layer.

        Raises:
            ValueError: if a depth is NaN or not positive.

        Example:
            >>> from kornia_tidy import TiDyOptics
            >>> optics = TiDyOptics().with_fixed_layers(torch.tensor([0.5, 2.0]))
            >>> [round(psi, 2) for psi in optics.fixed_defocus]
            [-14.06, 3.8]
        """
        if depth is None:
            return self._replace(fixed_defocus=self.psf_model.camera.defocus_range)
        reach = torch.stack(torch.aminmax(self.psf_model.camera.defocus(depth.detach())))
        return self._replace(fixed_defocus=tuple(reach.tolist()))

    def through_state(self, state: int) -> Self:
        """Return this camera with one state of its modulator shown all the time. The parts and the window are shared.

        Args:
            state: index among the states that the modulator shows.

        Raises:
            ValueError: if there is no such state.
        """
        return self._replace(psf_model=self.psf_model.through_state(state))

    def through_moment(self, moment: int) -> Self:
        """Return this camera with what its modulator shows at one moment shown all the time. The parts are shared.

        Args:
            moment: index among the moments of :meth:`timeline`.

        Raises:
            ValueError: if there is no such moment.
        """
        return self._replace(psf_model=self.psf_model.through_moment(moment))

    def with_bank(self, bank: PSFBank) -> Self:
        """Return this camera with PSFs that were measured in the place of its masks'. The other parts are shared.

        Args:
            bank: with the channels of the spectrum. Other depths than it holds are seen as the nearest of them.
        """
        return self._replace(psf_model=self.psf_model.with_bank(bank))
