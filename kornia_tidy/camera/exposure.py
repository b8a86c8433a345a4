"""The irradiance of one exposure: what the camera's PSF banks make of a scene, each for its share of the time."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from kornia_tidy.camera.samples import cropped, zero_of
from kornia_tidy.fidelity import Fidelity
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.render.render_ops import render_layers

Banks = list[tuple[Tensor | float, PSFBank]]


def render_banks(
    light: Tensor, defocus: Tensor, banks: Banks, fidelity: Fidelity, compositing: str, border: str, method: str
) -> Tensor:
    """Return the irradiance of a scene on the sensor, over the whole exposure.

    Args:
        light: (B, C, H, W) linear light.
        defocus: (B, 1, H, W) or (1, 1, H, W) radians.
        banks: from :meth:`kornia_tidy.psf.scene_psfs.ScenePSFs.scene_banks`: PSFs, each with its share of the exposure.
        fidelity: says how layers are assigned, and whether PSFs are flipped.
        compositing: ``"gather"``, ``"scatter"`` or ``"occlusion"``.
        border: what lies beyond the image.
        method: the backend, see :func:`kornia_tidy.render.compositing.render`.
    """
    share, bank = banks[0]
    # Planes for each channel: one for each of the scene's colours, where these have spectra, or one for each state.
    planes, states = bank.psfs.shape[1] // light.shape[1], share if isinstance(share, Tensor) and share.ndim else None
    if planes > 1:
        light = light.repeat(1, planes, 1, 1)
    if len(light) == 0:  # an empty batch: gradients are zero
        margin = bank.window // 2 if border == "valid" else 0
        total = cropped(light, margin) + zero_of(defocus, *(bank.psfs for _, bank in banks))
    else:
        options: dict[str, Any] = {"compositing": compositing, "border": border, "correlate": fidelity.correlate}
        options["layers"] = "nearest" if fidelity.layers == "nearest" else "linear"
        total = light
        for index, (share, bank) in enumerate(banks):
            scene = light, defocus, bank.defocus, bank.psfs, bank.veil
            seen = render_layers(*scene, method=method, **options)
            seen = seen if len(banks) == 1 else seen * share
            total = total + seen if index else seen
    if states is not None:
        return (total.unflatten(1, (len(states), -1)) * states.to(total)[:, None, None, None]).sum(1)
    return total.unflatten(1, (-1, planes)).sum(2) if planes > 1 else total
