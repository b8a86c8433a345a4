"""Mask files: heights in NPY files, and phases in the safetensors state of a camera."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from safetensors.torch import save
from torch import Tensor, nn

from kornia_tidy.camera.saved_parts import masks_of_state, modulator_of_state
from kornia_tidy.checks import check_choice, check_float_tensor
from kornia_tidy.data.npy import decode_npy, encode_npy
from kornia_tidy.files import error_prefix, read_bytes, write_bytes
from kornia_tidy.lab.mask_export.slm_frames import checked_heights
from kornia_tidy.lab.mask_export.timing import FrameTime, frame_times
from kornia_tidy.masks.base import metres_to_radians
from kornia_tidy.modulator.modulator import DwellTimes, LearnableDwellTimes
from kornia_tidy.modulator.phase_panel import GreyLevels
from kornia_tidy.modulator.switching import Switching
from kornia_tidy.optics.materials import Material, constant_index
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH
from kornia_tidy.psf.camera_settings import EXTRA_STATE
from kornia_tidy.tensor_files import read_tensors

SUFFIXES = (".npy", ".safetensors")
_KEYS = ("masks.phase", "phase")  # in the state of a camera, and in that of masks


class SavedMasks(NamedTuple):
    """Masks of a file: their heights, and the file's description of their material and modulator."""

    heights: Tensor
    """(K, rows, columns) metres, float64, with the constraint applied."""
    material: Material
    modulator: nn.Module | None = None
    """None where the file does not tell it, or its class is none of this package."""
    dwell: list[float] | None = None
    """Share of each mask, summing to one; None where all are equal."""

    def levels(
        self,
        wavelength: float = REFERENCE_WAVELENGTH,
        bits: int | None = None,
        phase_range: float | None = None,
        response: Sequence[float] | None = None,
    ) -> GreyLevels:
        """Return the grey levels that show the masks: those of the camera's panel, unless others are given.

        Args:
            wavelength: metres, at which the panel works.
            bits: of a level. Default: as saved, or 8.
            phase_range: radians at the wavelength that the levels span. Default: as saved, or one wave.
            response: instead: the phase of each level.
        """
        if response is not None:
            return GreyLevels(8 if bits is None else bits, response=response)
        known = next((part for part in self._parts() if isinstance(part, GreyLevels)), None)
        if known is None or bits is not None or phase_range is not None:
            return GreyLevels(8 if bits is None else bits, 2 * math.pi if phase_range is None else phase_range)
        if wavelength == REFERENCE_WAVELENGTH:
            return known
        scale = metres_to_radians(self.material, wavelength) / metres_to_radians(self.material)
        if known.response is None:
            return GreyLevels(known.bits, known.phase_range * scale)
        return GreyLevels(known.bits, response=(known.levels * scale).tolist())

    def times(
        self,
        exposure: float | None = None,
        switching_time: float | None = None,
        dwell: Sequence[float] = (),
        cyclic: bool = False,
    ) -> list[FrameTime]:
        """Return when the masks are shown: as the camera's modulator shows them, unless it is given otherwise.

        Args:
            exposure: seconds. Default: as saved, or 0.1.
            switching_time: seconds of a swap. Default: as saved, or 0.
            dwell: share of each mask. Default: as saved, or equal.
            cyclic: the swap back to the first also falls into the exposure.

        Raises:
            ValueError: if there are other numbers of shares and masks.
        """
        known = next((part for part in self._parts() if isinstance(part, Switching)), Switching(0.0))
        exposure = known.exposure if exposure is None else exposure
        switching_time = known.switching_time if switching_time is None else switching_time
        shares = dwell or self.dwell or [1.0] * len(self.heights)
        if len(shares) != len(self.heights):
            raise ValueError(f"there are {len(shares)} dwell shares for {len(self.heights)} masks")
        return frame_times(shares, exposure, switching_time, cyclic or known.cyclic)

    def _parts(self) -> list[nn.Module]:
        return [] if self.modulator is None else list(self.modulator.modules())


def masks_in_state(state: Mapping[str, Tensor], material: Material | None = None) -> SavedMasks:
    """Return the masks of a camera's state: of any family, with its constraint, range of phase and material.

    Args:
        state: of a camera; or ``masks.phase`` or ``phase`` in radians at 530 nm, unchanged.
        material: of masks with a state that lacks it. Default: index 1.5, the default of masks.

    Raises:
        ValueError: if there are no masks, their family is unknown, or they are of another material.

    Example:
        >>> from kornia_tidy import DwellTimes, TiDyOptics
        >>> from kornia_tidy.masks import CubicMask
        >>> masks = CubicMask([20.0, 8.0], constraint="wrapped")
        >>> found = masks_in_state(TiDyOptics(masks, modulator=DwellTimes((3, 1))).state_dict())
        >>> bool((found.heights - masks.heights().detach()).abs().max() < 1e-13), found.dwell
        (True, [0.75, 0.25])
    """
    if EXTRA_STATE in state:
        masks, modulator = masks_of_state(state), modulator_of_state(state)
        if material not in (None, masks.material):
            raise ValueError(f"its masks are of {masks.material.name}: leave the material out, got {material.name}")
        dwell = None if modulator is None else _dwell_shares(modulator)
        heights = masks.phase.detach().double() / metres_to_radians(masks.material)
        return SavedMasks(checked_heights(heights), masks.material, modulator, dwell)
    names = [key for key in _KEYS if key in state]
    if not names:
        raise ValueError(f"it has no 'masks.phase', only {', '.join(sorted(state))[:200] or 'nothing'}")
    material = constant_index(1.5) if material is None else material
    learnt = [v for key, v in state.items() if key.startswith("modulator.") and key.endswith("logits")]
    dwell = learnt[0].double().softmax(0).tolist() if learnt else None
    phase = state[names[0]][None] if state[names[0]].ndim == 2 else state[names[0]]
    check_float_tensor(names[0], phase, 3, "(K, rows, columns)")
    return SavedMasks(checked_heights(phase.double() / metres_to_radians(material)), material, None, dwell)


def _dwell_shares(modulator: nn.Module) -> list[float] | None:
    for part in modulator.modules():
        if isinstance(part, LearnableDwellTimes):
            return part.logits.detach().double().softmax(0).tolist()
        if isinstance(part, DwellTimes) and part.shares is not None:
            return list(part.shares)
    return None


def read_heights(path: str | os.PathLike[str], material: Material | None = None) -> Tensor:
    """Read the heights of masks from a file.

    Args:
        path: NPY file of heights in metres, (K, rows, columns) or (rows, columns); or safetensors file with the
            ``state_dict`` of a camera with masks of any family, or with only ``phase`` in radians at 530 nm.
        material: for the conversion of radians to metres, where the state does not tell it. Default: index 1.5.

    Returns:
        (K, rows, columns) metres, float64, with the constraint of the masks applied.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if the suffix is another, the file is damaged or has no masks, a height is not finite, or the masks
            are of another material.

    Convention:
        - The state of only the masks includes neither constraint nor material: save the camera's.
    """
    path = Path(path)
    check_choice("the suffix of a file of masks", path.suffix.lower(), SUFFIXES)
    with error_prefix(f"cannot read {path}", TypeError):
        if path.suffix.lower() != ".npy":
            return masks_in_state(read_tensors(path)[0], material).heights
        array = decode_npy(read_bytes(path))
        if array.dtype.kind != "f" or array.ndim not in (2, 3):
            raise ValueError(f"heights are floats in 2 or 3 axes, not {array.dtype} {array.shape}")
        if array.dtype == np.float16:
            raise ValueError("heights are floats of 32 or 64 bits: those of 16 have steps of 60 nm near zero")
        heights = torch.from_numpy(array.astype(np.float64))
        return checked_heights(heights[None] if heights.ndim == 2 else heights)


def write_heights(path: str | os.PathLike[str], heights: Tensor, material: Material | None = None) -> None:
    """Write the heights of masks to a file; an existing one is replaced, and after an error no partial file remains.

    Args:
        path: ``.npy`` for metres in float64; ``.safetensors`` for ``masks.phase`` in radians at 530 nm and float32,
            which ``TiDyOptics.load_state_dict`` accepts.
        heights: (K, rows, columns) metres.
        material: material for the conversion to radians, for safetensors only. Default: index 1.5.

    Raises:
        FileNotFoundError: if the folder does not exist.
        TypeError: if heights are not a floating-point tensor.
        ValueError: if the suffix is another, or heights have another shape or are not finite.
    """
    path, heights = Path(path), checked_heights(heights)
    check_choice("the suffix of a file of masks", path.suffix.lower(), SUFFIXES)
    if path.suffix.lower() == ".npy":
        write_bytes(path, encode_npy(heights.numpy()))
        return
    phase = heights * metres_to_radians(constant_index(1.5) if material is None else material)
    write_bytes(path, save({"masks.phase": phase.float().contiguous()}))
