"""Mask files: heights in NPY files, and phases in the safetensors state of a camera."""

from __future__ import annotations

import io
import os
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save
from torch import Tensor

from kornia_tidy.checks import check_choice
from kornia_tidy.data.npy import decode_npy
from kornia_tidy.files import read_bytes, write_bytes
from kornia_tidy.mask_export.slm_frames import checked_heights
from kornia_tidy.masks.base import metres_to_radians
from kornia_tidy.optics.materials import Material, constant_index
from kornia_tidy.psf.camera_settings import EXTRA_STATE
from kornia_tidy.tensor_files import read_tensors

SUFFIXES = (".npy", ".safetensors")
_KEYS = ("masks.phase", "phase")  # in the state of a camera, and in that of masks alone


def read_heights(path: str | os.PathLike[str], material: Material | None = None) -> Tensor:
    """Read the heights of masks from a file.

    Args:
        path: NPY file of heights in metres, (K, rows, columns) or (rows, columns); or safetensors file with the
            ``state_dict`` of a camera or of masks, whose ``masks.phase`` or ``phase`` is in radians at 530 nm.
        material: material for the conversion of radians to metres. Default: index 1.5, the default of masks.

    Returns:
        (K, rows, columns) metres, float64.

    Raises:
        FileNotFoundError: if there is no file.
        ValueError: if the suffix is another, the file is damaged or has no pixel-wise masks, or a height is not finite.

    Convention:
        - A state does not include the constraint of its masks. Masks with a constraint, and families without a
          ``phase``, are exported from Python: :meth:`~kornia_tidy.mask_export.SLMFrames.of` takes the masks themselves.
    """
    path = Path(path)
    check_choice("the suffix of a file of masks", path.suffix.lower(), SUFFIXES)
    if path.suffix.lower() == ".npy":
        data = read_bytes(path)
        try:
            array = decode_npy(data)
        except ValueError as error:
            raise ValueError(f"cannot read {path}: {error}") from None
        if array.dtype.kind != "f" or array.ndim not in (2, 3):
            raise ValueError(f"cannot read {path}: heights are floats in 2 or 3 axes, not {array.dtype} {array.shape}")
        heights = torch.from_numpy(array.astype(np.float64))
    else:
        state = read_tensors(path)[0]
        names = [key for key in _KEYS if key in state]
        if not names:
            raise ValueError(
                f"cannot read {path}: it has no 'masks.phase', only "
                f"{', '.join(sorted(state.keys() - {EXTRA_STATE}))[:200] or 'nothing'}"
            )
        material = constant_index(1.5) if material is None else material
        heights = state[names[0]].double() / metres_to_radians(material)
    try:
        return checked_heights(heights[None] if heights.ndim == 2 else heights)
    except ValueError as error:
        raise ValueError(f"cannot read {path}: {error}") from None


def read_dwell_shares(path: str | os.PathLike[str]) -> list[float] | None:
    """Read the learnt dwell shares from the state of a camera.

    Args:
        path: safetensors file of a camera's state, or any other file of masks.

    Returns:
        One share for each mask, summing to one. None if the state has no learnt dwell times, or the file no state.

    Raises:
        FileNotFoundError: if there is no file.
        ValueError: if the file is damaged.
    """
    path = Path(path)
    if path.suffix.lower() != ".safetensors":
        return None
    state = read_tensors(path)[0]
    learnt = [v for key, v in state.items() if key.startswith("modulator.") and key.endswith("logits")]
    return learnt[0].double().softmax(0).tolist() if learnt else None


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
        data = io.BytesIO()
        np.lib.format.write_array(data, heights.numpy(), allow_pickle=False)
        write_bytes(path, data.getvalue())
        return
    phase = heights * metres_to_radians(constant_index(1.5) if material is None else material)
    write_bytes(path, save({"masks.phase": phase.float().contiguous()}))
