"""Files of masks: heights as NPY, and the state of a camera as safetensors."""

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
_KEYS = ("masks.phase", "phase")  # of a camera's state, and of its masks alone


def read_heights(path: str | os.PathLike[str], material: Material | None = None) -> Tensor:
    """Read masks.

    Args:
        path: NPY of heights in metres, (K, rows, columns) or (rows, columns); or safetensors with a camera's or a
            mask's ``state_dict``, whose ``masks.phase`` or ``phase`` is radians at 530 nm.
        material: what turns radians into metres. Default: index 1.5, as the masks'.

    Returns:
        (K, rows, columns) metres, float64.

    Raises:
        FileNotFoundError: if there is no file.
        ValueError: if it is neither, has no pixelwise masks in it, or a height is not finite.

    Convention:
        - A state does not tell its constraint. Masks with one, and families without a ``phase``, are exported from
          Python, where :class:`~kornia_tidy.mask_export.SLMFrames` takes the masks themselves.
    """
    path = Path(path)
    check_choice("the suffix of a file of masks", path.suffix.lower(), SUFFIXES)
    if path.suffix.lower() == ".npy":
        data = read_bytes(path)
        try:
            stored = decode_npy(data)
        except ValueError as error:
            raise ValueError(f"cannot read {path}: {error}") from None
        if stored.dtype.kind != "f" or stored.ndim not in (2, 3):
            raise ValueError(
                f"cannot read {path}: heights are floats in 2 or 3 axes, not {stored.dtype} {stored.shape}"
            )
        heights = torch.from_numpy(stored.astype(np.float64))
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
    """Return the dwell shares that a camera's state holds, where they were learnt; else None.

    Raises:
        FileNotFoundError: if there is no file.
        ValueError: if it cannot be read.
    """
    path = Path(path)
    if path.suffix.lower() != ".safetensors":
        return None
    state = read_tensors(path)[0]
    learnt = [v for key, v in state.items() if key.startswith("modulator.") and key.endswith("logits")]
    return learnt[0].double().softmax(0).tolist() if learnt else None


def write_heights(path: str | os.PathLike[str], heights: Tensor, material: Material | None = None) -> None:
    """Write masks, whole or not at all; an existing file is replaced.

    Args:
        path: ``.npy`` for metres, float64; ``.safetensors`` for ``masks.phase`` in radians at 530 nm, float32, which
            ``TiDyOptics.load_state_dict`` takes.
        heights: (K, rows, columns) metres.
        material: of safetensors only. Default: index 1.5.

    Raises:
        FileNotFoundError: if the folder does not exist.
        ValueError: if the suffix is another, or heights are not finite maps.
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
