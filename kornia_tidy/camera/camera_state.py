"""A camera's view of its PSF model, and its state: weights, settings and PSF window in one ``state_dict``."""

from __future__ import annotations

import copy
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Any, NoReturn, Self

import torch
from torch import Tensor, nn

from kornia_tidy.camera.saved_parts import check_parts
from kornia_tidy.checks import check_choice, check_finite
from kornia_tidy.fidelity import PRESETS, Fidelity
from kornia_tidy.masks.base import PhaseMasks
from kornia_tidy.mode import refuse_torchscript
from kornia_tidy.modulator.modulator import Timeline
from kornia_tidy.optics.lens.lens import Lens
from kornia_tidy.optics.spectrum import Spectrum
from kornia_tidy.optics.thin_lens import DefocusRange, ThinLensCamera
from kornia_tidy.psf.camera_settings import (
    EXTRA_STATE,
    check_settings,
    read_settings,
    settings_of,
    take_over,
    write_settings,
)
from kornia_tidy.psf.field_bank import FieldBank
from kornia_tidy.psf.learnable_aperture import LearnableAperture
from kornia_tidy.psf.lens_limits import PARTS
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.psf.psf_model import PSFModel
from kornia_tidy.psf.psf_window import FittedWindow
from kornia_tidy.psf.pupil import Pupil
from kornia_tidy.render.borders import BORDERS
from kornia_tidy.render.compositing import COMPOSITING

_SUBMODULES = ("masks", "camera", "modulator", "lens", "aperture")
COLOR_SPACES = ("srgb", "linear", "paper")
OWN_SETTINGS = ("sensor", "compositing", "color_space", "border")  # of a camera, beside those of its PSF model


def _part(name: str, meaning: str, *, settable: bool = False) -> Any:
    """Return a property that is the PSF model's; to set it puts another model in the place of the present one."""

    def swap(self: Any, value: Any) -> None:
        self._swap(**{name: value})

    return property(lambda self: getattr(self.psf_model, name), swap if settable else None, doc=meaning)


class CameraState(nn.Module):
    """A camera with a PSF model, and a ``state_dict`` of weights, settings and PSF window.

    Masks, camera, modulator, lens and a learnable aperture of the model are its submodules, so that states hold
    ``masks.phase``, and optimisers and ``to(device)`` reach the parts. To set one of them, or ``fidelity``,
    ``spectrum`` or ``aperture``, puts another PSF model in the place of the present one.

    The settings of its parts and its PSF window are one entry, ``_extra_state``, a tensor of bytes. Loading a state

    - of the same camera restores weights and window: every capture is the same to the last bit;
    - of another camera is refused, also with ``strict=False``, before any weight of this camera is changed; the
      first difference is named. ``take_over=True`` sets this camera's settings to the saved ones first;
    - without that entry, such as masks alone, loads the weights and measures the window anew for them;
    - without weights of this camera does not change it.

    The entry is never counted among the missing keys, so that masks alone and files of earlier versions load with
    ``strict=True``. In a larger module's state it stands under the camera's prefix, and ``load_state_dict`` of that
    module obeys the same rules. To take settings over there, load the camera's part of the state into the camera first.
    """

    psf_model: PSFModel
    fixed_defocus: tuple[float, float] | None = None  # of every scene, see with_fixed_layers
    masks: PhaseMasks
    camera: ThinLensCamera | DefocusRange
    modulator: nn.Module
    lens: Lens | None

    fidelity: Fidelity = _part("fidelity", "How exactly to compute.", settable=True)
    spectrum: Spectrum = _part("spectrum", "Wavelengths, and how each channel weights them.", settable=True)
    aperture: Tensor | LearnableAperture | None = _part(
        "aperture", "Amplitude over the mask's pixels, None for the binary disc; a module where it is learnt."
    )
    pupil: Pupil = _part("pupil", "The aperture over the masks' pixels.")
    defocus_nodes: tuple[float, ...] = _part(
        "defocus_nodes", "Defocus of the PSF bank's layers in radians: evenly spaced over the camera's range."
    )
    window: int = _part(
        "window", "Side of the PSFs in pixels: given by the fidelity, or measured by :meth:`fit_window`."
    )

    def __init__(self, psf_model: PSFModel) -> None:
        super().__init__()
        self.psf_model = psf_model
        for name in _SUBMODULES:
            self._take(name)
        self.register_load_state_dict_post_hook(_measure_window)

    def __setattr__(self, name: str, value: Any) -> None:
        """Set an attribute; masks, camera, modulator, lens and aperture are also those of the PSF model."""
        if name not in _SUBMODULES:
            super().__setattr__(name, value)
            return
        self._swap(**{name: value})
        self._take(name)

    def _take(self, name: str) -> None:
        """Make a part of the PSF model a part of this camera."""
        part = getattr(self.psf_model, name)
        if name != "aperture" or isinstance(part, nn.Module):
            super().__setattr__(name, part)
        else:
            self._modules.pop(name, None)  # an aperture that is not learnt is the PSF model's alone

    def _swap(self, **parts: Any) -> None:
        self.psf_model = self.psf_model.replace(**parts)

    @abstractmethod
    def _replace(self, **attributes: Any) -> Self:
        """Return this module with other attributes; all others are shared."""

    def __prepare_scriptable__(self) -> NoReturn:
        """Refuse ``torch.jit.script`` of this camera and of modules that contain it."""
        refuse_torchscript()

    @property
    def light_held(self) -> tuple[float, float]:
        """Least and largest share of the light in the window, as it was when the window was chosen."""
        return self.psf_model.fitted.held

    def fit_window(self) -> int:
        """Choose the smallest PSF window that holds the fidelity's share of the light of the present masks.

        It is done on construction, when a part is swapped, and after loading weights that do not tell their window;
        masks in training keep their window until this is called again. A window or a preset that fixes the side is only
        measured.

        Returns:
            The side in pixels: at most ``fidelity.max_window``, or as wide as the lens's defocus disc; with a warning
            if that does not hold the share.
        """
        self.psf_model = self.psf_model.with_window(None)
        return self.psf_model.fitted.side

    def psf_bank(
        self,
        channels: int | None = None,
        dtype: torch.dtype | None = None,
        defocus: Sequence[float] | None = None,
        *,
        field: Sequence[tuple[float, float]] | None = None,
    ) -> Any:
        """Return the PSFs of the present masks. See :meth:`kornia_tidy.psf.psf_model.PSFModel.psf_bank`."""
        return self.psf_model.psf_bank(channels, dtype, defocus, field=field)

    def state_weights(self, dtype: torch.dtype) -> Tensor:
        """Return the share of the exposure of each state that the modulator shows, (S,)."""
        return self.psf_model.state_weights(dtype)

    def timeline(self, dtype: torch.dtype) -> Timeline:
        """Return the modulator's states of the masks during one exposure, and their times."""
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
            depth: depths that span the range of all scenes, in the camera's unit, such as metres. Default: all of the
                camera's range. Depths beyond it are rendered as its nearest layer.

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
            ValueError: if the state is unknown.
        """
        return self._replace(psf_model=self.psf_model.through_state(state))

    def through_moment(self, moment: int) -> Self:
        """Return this camera with the modulator's state of one moment shown all the time. The parts are shared.

        Args:
            moment: index among the moments of :meth:`timeline`.

        Raises:
            ValueError: if the moment is unknown.
        """
        return self._replace(psf_model=self.psf_model.through_moment(moment))

    def with_bank(self, bank: PSFBank | FieldBank) -> Self:
        """Return this camera with measured PSFs instead of those of its masks. The other parts are shared.

        Args:
            bank: with the channels of the spectrum. Other depths than it holds are seen as the nearest of them. Of one
                over the field, see :meth:`kornia_tidy.psf.FieldBank.from_measured`, each pixel sees the PSFs of its
                place.
        """
        return self._replace(psf_model=self.psf_model.with_bank(bank))

    # ------------------------------------------------------------------ state

    def settings(self) -> dict[str, Any]:
        """Return what shapes a capture besides the weights, by the names of the parts."""
        return {**self.psf_model.settings(), **{name: settings_of(getattr(self, name)) for name in OWN_SETTINGS}}

    def _take_over(self, saved: Mapping[str, Any]) -> None:
        for name, allowed in (("compositing", COMPOSITING), ("color_space", COLOR_SPACES), ("border", BORDERS)):
            if name in saved:
                check_choice(name, saved[name], tuple(allowed))
        fidelity = saved.get("fidelity")
        if isinstance(fidelity, dict):
            preset = PRESETS.get(str(fidelity.get("name")).removesuffix(", changed"), Fidelity())
            later = {name: getattr(preset, name) for name in ("wide_blur", "field_tolerance")}
            own = {**later, **fidelity, "window": saved.get("fixed_window")}
            saved = {**saved, "fidelity": own}
        take_over(self, saved, self.settings(), {name: name for name in (*PARTS, "aperture", *OWN_SETTINGS)})
        self.psf_model = self.psf_model.with_window(None)
        self.psf_model.check_layers()

    def get_extra_state(self) -> Tensor:
        """Return settings and window, uint8."""
        window, fixed = self.psf_model.fitted, self.fidelity.window
        return write_settings(
            {**self.settings(), "window": window.side, "light_held": window.held, "fixed_window": fixed}
        )

    def set_extra_state(self, state: Tensor) -> None:
        """Take the window of a saved camera that has these settings.

        Raises:
            ValueError: if the saved camera is another one, or its settings are damaged.
        """
        saved = read_settings(state)
        check_settings(saved, self.settings())
        window, held = saved.get("window"), saved.get("light_held")
        if type(window) is not int or window < 1 or window % 2 == 0:
            raise ValueError(f"the window in the state must be an odd number of pixels, got {window}")
        if not isinstance(held, list) or [type(share) for share in held] != [float, float]:
            raise ValueError(f"light_held in the state must be two shares of the light, got {held}")
        self.psf_model = self.psf_model.with_window(FittedWindow(window, (held[0], held[1])))

    def load_state_dict(
        self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False, *, take_over: bool = False
    ) -> Any:
        """Load a camera: weights, and the window where the state has it. See the class for refusals.

        Args:
            state_dict: result of ``state_dict()``, or only weights.
            strict: refuse missing and unknown weights.
            assign: as in PyTorch.
            take_over: set the settings of this camera's parts to those in the state first, where they differ. Parts of
                another class are not made: they are refused. After any error nothing is changed.

        Returns:
            The missing and the unknown keys, as in PyTorch.

        Raises:
            ValueError: if the state is that of another camera, or it has no settings to take over.
            RuntimeError: if weights do not fit, as in PyTorch.

        Example:
            >>> from kornia_tidy import PixelwiseMask, ThinLensCamera, TiDyOptics
            >>> saved = TiDyOptics(PixelwiseMask(2), ThinLensCamera(pixel_pitch=9e-6)).state_dict()
            >>> optics = TiDyOptics(PixelwiseMask(2))
            >>> optics.load_state_dict(saved, take_over=True), optics.camera.pixel_pitch
            (<All keys matched successfully>, 9e-06)
        """
        if take_over:
            if EXTRA_STATE not in state_dict:
                raise ValueError(
                    f"there are no settings to take over: the state has no entry {EXTRA_STATE!r}, only "
                    f"{', '.join(state_dict) or 'nothing'}"
                )
            check_parts(state_dict, self.settings())
            saved, rehearsal = read_settings(state_dict[EXTRA_STATE]), copy.deepcopy(self)
            for camera in (rehearsal, self):  # so that an error changes nothing
                camera._take_over(saved)
                keys = nn.Module.load_state_dict(camera, state_dict, strict, assign)
            return keys
        return super().load_state_dict(state_dict, strict, assign)

    def _load_from_state_dict(
        self,
        state_dict: Mapping[str, Any],
        prefix: str,
        local_metadata: Any,
        strict: bool,
        missing_keys: list[str],
        unexpected_keys: list[str],
        error_msgs: list[str],
    ) -> None:
        key = prefix + EXTRA_STATE
        own = (prefix + name for name, _ in chain(self.named_parameters(), self.named_buffers()))
        weights = {name: state_dict[name] for name in own if isinstance(state_dict.get(name), Tensor)}
        for name, value in weights.items():
            check_finite(f"{name} in the state", value)
        if key not in state_dict and weights:
            self.psf_model = self.psf_model.with_window(None)  # measured when the weights are there
        super()._load_from_state_dict(
            state_dict, prefix, local_metadata, strict, missing_keys, unexpected_keys, error_msgs
        )
        if key in missing_keys:  # masks alone are a state too, and that of versions which did not save settings
            missing_keys.remove(key)


def _measure_window(camera: CameraState, _: Any) -> None:
    _ = camera.psf_model.fitted
