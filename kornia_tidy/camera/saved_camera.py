"""Cameras made from their saved states: the parts from the settings, then weights and PSF window."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from kornia_tidy.camera.saved_parts import masks_of_state, part_of, settings_in
from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.fidelity import Fidelity
from kornia_tidy.optics.lens.lens import Lens
from kornia_tidy.psf.camera_settings import EXTRA_STATE

MOST_PSFS = 1 << 27  # bytes; a small file could name a window that takes gigabytes


def camera_of_state(state: Mapping[str, Tensor]) -> TiDyOptics:
    """Return the camera that was saved: every capture is the same to the last bit.

    Args:
        state: the result of its ``state_dict()``, with the entry of the settings.

    Raises:
        ValueError: if the state has no settings, a part is of a class that this package does not offer, or settings and
            weights do not fit.

    Example:
        >>> from kornia_tidy import PixelwiseMask, ThinLensCamera
        >>> saved = TiDyOptics(PixelwiseMask(2, constraint="clamp"), ThinLensCamera(f_number=8)).state_dict()
        >>> optics = camera_of_state(saved)
        >>> optics.masks.constraint, optics.camera.aperture_diameter
        ('clamp', 0.00625)
    """
    settings = settings_in(state)
    parts = {name: part_of(name, settings, state) for name in ("camera", "modulator", "sensor", "spectrum", "fidelity")}
    window = settings.get("window")
    if not isinstance(window, int) or 36 * window**2 > MOST_PSFS:  # three colours at three depths
        raise ValueError(f"PSFs of the camera's state must take at most {MOST_PSFS >> 20} MiB, got window {window}")
    parts["fidelity"] = Fidelity.of(parts["fidelity"]).replace(window=window)  # so that it need not be measured
    if (amplitude := state.get("aperture.amplitude")) is not None:
        parts["aperture"] = nn.Parameter(amplitude.detach().clone().clamp(0, 1))
    if (lens := state.get(f"lens.{EXTRA_STATE}")) is not None:
        parts["lens"] = Lens.of_state(lens)
    paper = parts["fidelity"].propagation == "paper"
    with torch.random.fork_rng(devices=[]):
        camera = TiDyOptics(masks_of_state(state), color_space="paper" if paper else "srgb", **parts)
    try:
        camera.load_state_dict(state, take_over=True)
    except RuntimeError as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"the camera's state does not fit its settings: {reason:.300}") from error
    return camera
