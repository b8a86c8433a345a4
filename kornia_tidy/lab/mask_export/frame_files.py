"""Files of SLM frames: a folder of pictures of the panel's size, a timing sheet, and a sidecar with all parameters."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from kornia_tidy.checks import check_choice, check_positive
from kornia_tidy.data.npy import decode_npy, encode_npy
from kornia_tidy.data.stored import read_stored
from kornia_tidy.files import error_prefix, json_lines, read_bytes, read_json, write_folder
from kornia_tidy.lab.mask_export.placement import PanelPlacement
from kornia_tidy.lab.mask_export.slm_frames import SLMFrames
from kornia_tidy.lab.mask_export.timing import FrameTime, frame_times, timing_sheet

FORMAT = "kornia-tidy SLM frames 1"
SIDECAR, TIMING, TURNS = "frames.json", "timing.csv", "turns.npy"
LEVELS = 1 << 10  # largest number of grey levels
SUFFIXES = (".png", ".tif", ".tiff")
ALIGNMENT = "least significant bits: grey level g is stored as the number g"
ORIENTATION = (
    "rows count downwards; before flip and rotate, a phase that rises to larger columns moves the PSF to larger columns"
)


def write_slm_frames(
    folder: str | os.PathLike[str],
    frames: SLMFrames,
    placement: PanelPlacement | None = None,
    times: Sequence[FrameTime] | None = None,
    suffix: str = ".png",
    replace: bool = False,
) -> None:
    """Write a folder of frames for an SLM: one picture for each mask, a timing sheet and a sidecar.

    After an error no partial folder remains.

    Args:
        folder: folder to create; its parent must exist.
        frames: grey levels of the masks.
        placement: position on the panel. Default: the largest that fits 1920x1200 pixels of 8 um.
        times: when each frame is shown. Default: equal parts of 100 ms with instant transitions.
        suffix: ``".png"``, ``".tif"`` or ``".tiff"``.
        replace: whether to replace an existing folder of frames. A folder with other files is never replaced.

    Raises:
        FileExistsError: if the folder exists and is not to be replaced, or has other files.
        FileNotFoundError: if the parent folder does not exist.
        ValueError: if the mask does not fit on the panel, there is not one time for each frame, or the suffix is
            unknown.

    Convention:
        - Up to 8 bits are written to 8-bit files, 9 and 10 bits to 16-bit files, in the least significant bits. The
          value of a pixel is its grey level, so a 10-bit frame looks almost black.
        - ``turns.npy`` (int16) exists only if heights exceed one wave. It has the whole waves that the panel does not
          show.

    Example:
        >>> import tempfile
        >>> from kornia_tidy import PixelwiseMask
        >>> from kornia_tidy.modulator.phase_panel import GreyLevels
        >>> masks = PixelwiseMask(2)
        >>> with tempfile.TemporaryDirectory() as root:
        ...     write_slm_frames(f"{root}/slm", SLMFrames.of(masks, GreyLevels(8)))
        ...     back = read_slm_frames(f"{root}/slm")
        >>> bool((back.heights() - masks.heights()).abs().max() < 1.06e-6 / 256)
        True
    """
    check_choice("suffix", suffix, SUFFIXES)
    placement = PanelPlacement() if placement is None else placement
    count, *size = frames.grey.shape
    times = frame_times([1] * count, 0.1) if times is None else times
    if len(times) != count:
        raise ValueError(f"times must be one for each of the {count} masks, got {len(times)}")
    check_replaceable(folder, replace)
    rows, columns = size
    names = [f"frame_{k:03d}{suffix}" for k in range(count)]
    contents: dict[str, bytes] = {}
    pixel = torch.uint8 if frames.bits <= 8 else torch.int16
    for name, grey in zip(names, frames.grey.to(pixel).split(1), strict=True):
        picture = placement.place(grey, frames.background)[0].numpy()
        contents[name] = cv2.imencode(suffix, picture if frames.bits <= 8 else picture.view(np.uint16))[1].tobytes()
    contents[TIMING] = timing_sheet(times, names)
    wraps = bool(frames.turns.any())
    if wraps:
        contents[TURNS] = _encoded_turns(frames.turns)
    sidecar = {
        "format": FORMAT,
        "files": names,
        "timing": TIMING,
        "turns": TURNS if wraps else None,
        "bits": frames.bits,
        "bits_of_file": 8 if frames.bits <= 8 else 16,
        "alignment": ALIGNMENT,
        "background_level": frames.background,
        "mask": [rows, columns],
        "panel": list(placement.panel),
        "panel_pitch_m": placement.panel_pitch,
        "pupil_radius_m": placement.radius((rows, columns)),
        "panel_pixels_per_mask_pixel": placement.scale((rows, columns)),
        "offset_right_down": list(placement.offset),
        "flip": placement.flip,
        "rotate": placement.rotate,
        "orientation": ORIENTATION,
        "wavelength_m": frames.wavelength,
        "radians_per_metre": frames.radians_per_metre,
        "largest_error_rad": frames.largest_error(),
        "level_phases_rad": frames.level_phases.tolist(),
    }
    contents[SIDECAR] = json_lines(sidecar)
    write_folder(folder, contents, replace=replace)


def read_slm_frames(folder: str | os.PathLike[str]) -> SLMFrames:
    """Read the frames of a folder written by :func:`write_slm_frames`, and check every panel pixel.

    Args:
        folder: folder to read.

    Raises:
        FileNotFoundError: if the folder, its sidecar or a frame is missing.
        ValueError: if a file is damaged, or a frame contradicts the sidecar.
    """
    folder = Path(folder)
    about = _sidecar(folder)
    try:
        size = _rows_and_columns("mask", about["mask"])
        placement = PanelPlacement(
            panel=_rows_and_columns("panel", about["panel"]),
            panel_pitch=about["panel_pitch_m"],
            pupil_radius=about["pupil_radius_m"],
            offset=tuple(about["offset_right_down"]),
            flip=about["flip"],
            rotate=about["rotate"],
        )
        level_phases = torch.tensor(about["level_phases_rad"], dtype=torch.float64)
        wavelength, per_metre = float(about["wavelength_m"]), float(about["radians_per_metre"])
        names, turns_file, depth = about["files"], about["turns"], about["bits_of_file"]
        _check_sidecar(names, level_phases, wavelength, per_metre)
        placement.scale(size)
    except (KeyError, TypeError, IndexError, OverflowError, RuntimeError, ValueError) as error:
        reason = f"there is no {error}" if isinstance(error, KeyError) else str(error)
        raise ValueError(f"{folder / SIDECAR} does not describe frames: {reason:.300}") from None
    grey = torch.cat(
        [_read_frame(folder / Path(name).name, depth, len(level_phases), placement, size) for name in names]
    )
    turns = torch.zeros_like(grey)
    if turns_file is not None:
        turns = torch.from_numpy(_read_turns(folder / TURNS)).long()
        if turns.shape != grey.shape:
            raise ValueError(f"{folder / TURNS} must have shape {tuple(grey.shape)}, got {tuple(turns.shape)}")
    return SLMFrames(grey, turns, level_phases, wavelength, per_metre)


def check_replaceable(folder: str | os.PathLike[str], replace: bool) -> None:
    """Raise if a folder exists, unless it may be replaced and has only files of :func:`write_slm_frames`.

    Args:
        folder: folder to be written.
        replace: whether an existing folder may be replaced.

    Raises:
        FileExistsError: if the folder exists and may not be replaced, is a file, or has other files.
    """
    folder = Path(folder)
    if not folder.exists():
        return
    if not replace:
        raise FileExistsError(f"cannot write {folder}: it exists")
    if not folder.is_dir():
        raise FileExistsError(f"cannot write {folder}: it is a file, not a folder of frames")
    known: set[str] = set()
    if (folder / SIDECAR).exists():
        files = _sidecar(folder).get("files")
        known = {SIDECAR, TIMING, TURNS, *map(str, files if isinstance(files, list) else [])}
    foreign = sorted(entry.name for entry in folder.iterdir() if entry.name not in known)
    if foreign:
        raise FileExistsError(f"cannot replace {folder}: it holds {foreign[0]}, which is no file of a folder of frames")


def _read_turns(path: Path) -> np.ndarray:
    """Read the whole waves of masks from an NPY file.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if the file is damaged or its values are not int16.
    """
    with error_prefix(f"cannot read {path}"):
        turns = decode_npy(read_bytes(path))
    if turns.dtype != np.int16:
        raise ValueError(f"cannot read {path}: whole waves must be int16, got {turns.dtype}")
    return turns


def _sidecar(folder: Path) -> dict[str, Any]:
    path = folder / SIDECAR
    about = read_json(path)
    if not isinstance(about, dict) or about.get("format") != FORMAT:
        raise ValueError(f"cannot read {path}: its format is not {FORMAT!r}")
    return about


def _rows_and_columns(name: str, value: Any) -> tuple[int, int]:
    if not isinstance(value, list) or len(value) != 2 or not all(type(side) is int and side > 0 for side in value):
        raise ValueError(f"{name} must be rows and columns, got {value!r:.80}")
    return value[0], value[1]


def _check_sidecar(names: Any, level_phases: Tensor, wavelength: float, per_metre: float) -> None:
    if not isinstance(names, list) or not names or not all(isinstance(name, str) and name for name in names):
        raise ValueError(f"files must be the names of frames, got {names!r:.80}")
    if level_phases.ndim != 1 or not 2 <= len(level_phases) <= LEVELS or not bool(level_phases.isfinite().all()):
        raise ValueError(f"level_phases_rad must be 2 to {LEVELS} finite numbers")
    check_positive("wavelength_m", wavelength, "metres")
    check_positive("radians_per_metre", per_metre)


def _read_frame(path: Path, depth: int, levels: int, placement: PanelPlacement, size: tuple[int, int]) -> Tensor:
    codes = read_stored(path).values
    if codes.dtype.kind != "u" or codes.dtype.itemsize * 8 != depth or codes.shape[2] != 1:
        raise ValueError(f"{path} must be a grey picture of {depth} bits, got {codes.dtype} in {codes.shape[2]} planes")
    picture = torch.from_numpy(codes[..., 0].astype(np.int16 if depth == 16 else np.uint8))
    if int(picture.max()) >= levels or int(picture.min()) < 0:
        raise ValueError(f"{path} must hold grey levels from 0 to {levels - 1}, found {int(codes.max())}")
    with error_prefix(str(path)):
        return placement.read(picture[None], size).long()


def _encoded_turns(turns: Tensor) -> bytes:
    if int(turns.abs().max()) > np.iinfo(np.int16).max:
        raise ValueError(f"heights must be within 32767 waves, got {int(turns.abs().max())}")
    return encode_npy(turns.numpy().astype(np.int16))
