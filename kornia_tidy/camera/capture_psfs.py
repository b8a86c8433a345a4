"""The PSFs of a capture: in groups of layers where blur is wide, else one bank, one for each state, or pieces."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from kornia_tidy.camera.bank_pieces import BankPieces, pieces_for
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.psf.wide_psfs import WideBank
from kornia_tidy.render.coarse_gather import gather_groups

Banks = list[tuple[Tensor | float, PSFBank]] | WideBank | BankPieces
_MOST_COPIES = 64  # of PSFs: while they are computed, and in their spectra, for each state
_BANKS = 3  # held at a time by scatter and occlusion: of layers, and their spectra


def capture_psfs(camera: Any, channels: int, dtype: torch.dtype, reach: Tensor, defocus: Tensor) -> Banks:
    """Return the PSFs that a capture needs.

    Args:
        camera: a :class:`~kornia_tidy.TiDyOptics` as it is at one moment.
        channels: of the image.
        dtype: float32 or float64.
        reach: lowest and highest defocus of the scene, (2,), or its map, see
            :func:`kornia_tidy.camera.samples.survey_defocus`.
        defocus: the map in radians, or ``reach`` again where it is not at hand.

    Raises:
        ValueError: if blur is so wide that scatter or occlusion would need more than the camera's memory budget.
    """
    model = camera.psf_model
    if (blur := model.wide_blur) is not None:
        if camera.compositing == "gather" and defocus.numel():
            wide = model.wide_bank(channels, dtype, defocus)
            if wide is not None:
                return wide
        needed = _BANKS * len(blur.nodes) * channels * dtype.itemsize * blur.window**2
        if needed > camera.memory_budget:
            raise ValueError(
                f"compositing {camera.compositing!r} of this lens needs {len(blur.nodes)} layers of PSFs {blur.window} "
                f"px wide, some {needed / 2**30:.1f} GiB, of which memory_budget allows "
                f"{camera.memory_budget / 2**30:.1f} GiB: take compositing='gather', a smaller aperture, a narrower "
                f"depth_range, or a larger memory_budget"
            )
    else:
        (lo, hi), fidelity = model.camera.defocus_range, model.fidelity
        samples = ((hi - lo) / fidelity.layer_spacing + 1) * model.largest_window**2
        if _MOST_COPIES * samples * channels * dtype.itemsize > camera.memory_budget // 2:  # else it surely fits
            pieces = pieces_for(camera, channels, dtype, reach)
            if pieces is not None:
                return pieces
    return model.scene_banks(channels, dtype, reach, camera.compositing == "occlusion", defocus.device)


def wide_irradiance(light: Tensor, defocus: Tensor, bank: WideBank, border: str) -> Tensor:
    """Return the irradiance of a scene through wide blur. See :func:`kornia_tidy.render.coarse_gather.gather_groups`.

    Args:
        light: (B, C, H, W) linear light.
        defocus: (B, 1, H, W) or (1, 1, H, W) radians.
        bank: PSFs.
        border: what lies beyond the image.
    """
    return gather_groups(light, defocus, bank.groups, bank.window, border).to(light.dtype)
