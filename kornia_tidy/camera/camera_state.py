"""The state of a camera: weights, settings and PSF window in one ``state_dict``."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import chain
from typing import Any

from torch import Tensor

from kornia_tidy.camera.psf_model_owner import PSFModelOwner
from kornia_tidy.checks import check_choice, check_finite
from kornia_tidy.fidelity import Fidelity
from kornia_tidy.psf.camera_settings import (
    EXTRA_STATE,
    check_settings,
    read_settings,
    settings_of,
    take_over,
    write_settings,
)
from kornia_tidy.psf.lens_limits import PARTS
from kornia_tidy.psf.psf_model import PSFModel
from kornia_tidy.psf.psf_window import FittedWindow
from kornia_tidy.render.borders import BORDERS
from kornia_tidy.render.compositing import COMPOSITING

COLOR_SPACES = ("srgb", "linear", "paper")
OWN_SETTINGS = ("sensor", "compositing", "color_space", "border")  # of a camera, beside those of its PSF model


class CameraState(PSFModelOwner):
    """A camera with a ``state_dict`` of weights, settings and PSF window.

    The settings of its parts and its PSF window are one entry, ``_extra_state``, a tensor of bytes. Loading a state

    - of the same camera restores weights and window: every capture is the same to the last bit;
    - of another camera is refused, also with ``strict=False``, before any weight of this camera is changed; the
      first difference is named. ``take_over=True`` sets this camera's settings to the saved ones first;
    - without that entry, such as masks alone, loads the weights and measures the window anew for them;
    - without weights of this camera leaves it as it is.

    The entry is never counted among the missing keys, so that masks alone and files of earlier versions load with
    ``strict=True``. In a larger module's state it stands under the camera's prefix, and ``load_state_dict`` of that
    module obeys the same rules. To take settings over there, load the camera's part of the state into the camera first.
    """

    def __init__(self, psf_model: PSFModel) -> None:
        super().__init__(psf_model)
        self.register_load_state_dict_post_hook(_measure_window)

    def settings(self) -> dict[str, Any]:
        """Return what shapes a capture besides the weights, by the names of the parts."""
        return {**self.psf_model.settings(), **{name: settings_of(getattr(self, name)) for name in OWN_SETTINGS}}

    def _take_over(self, saved: Mapping[str, Any]) -> None:
        for name, allowed in (("compositing", COMPOSITING), ("color_space", COLOR_SPACES), ("border", BORDERS)):
            if name in saved:
                check_choice(name, saved[name], tuple(allowed))
        fidelity = saved.get("fidelity")
        if isinstance(fidelity, dict):
            own = {"wide_blur": Fidelity.wide_blur, **fidelity, "window": saved.get("fixed_window")}
            saved = {**saved, "fidelity": own}
        take_over(self, saved, self.settings(), {name: name for name in (*PARTS, "aperture", *OWN_SETTINGS)})
        self.psf_model = self.psf_model.with_window(None)

    def get_extra_state(self) -> Tensor:
        """Return settings and window, uint8."""
        with self.psf_model.lock:
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
        """Load a camera: weights, and the window where the state has it. See the class for what is refused.

        Args:
            state_dict: what ``state_dict()`` returned, or weights alone.
            strict: refuse missing and unknown weights.
            assign: as in PyTorch.
            take_over: set the settings of this camera's parts to those in the state first, where they differ. Parts of
                another class are not made: they are refused, and nothing is changed.

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
        with self.psf_model.lock:  # captures of other threads see the camera before or after it
            if take_over:
                if EXTRA_STATE not in state_dict:
                    raise ValueError(
                        f"there are no settings to take over: the state has no entry {EXTRA_STATE!r}, only "
                        f"{', '.join(state_dict) or 'nothing'}"
                    )
                self._take_over(read_settings(state_dict[EXTRA_STATE]))
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
