"""Small whole files of the kinds that are written by the library itself."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from safetensors.torch import save_file

from kornia_tidy import PixelwiseMask, TiDyOptics
from kornia_tidy.data import dead_leaves, write_depth, write_image
from kornia_tidy.data.pfm import encode_pfm
from kornia_tidy.lab.mask_export import SLMFrames, write_heights, write_slm_frames
from kornia_tidy.modulator import GreyLevels
from kornia_tidy.reconstruction.state_file import write_state
from kornia_tidy.reconstruction.trained import build_head, build_optics
from kornia_tidy.training.settings import TrainingSettings

SIZE = 48


@dataclass(frozen=True)
class Case:
    """A file to be damaged, and what reads it."""

    kind: str
    """Under which it is counted."""
    damage: str
    """Whose ways of damage are its own, see :data:`tests.mutations.damage.BY_KIND`."""
    source: Path
    """The whole file."""
    read: Callable[[Path], object]
    """What reads it."""
    companions: Path | None = None
    """A folder of what lies beside the file."""


def write_files(folder: Path) -> None:
    """Write pictures, masks, checkpoints and a described folder into an empty folder."""
    _write_pictures(folder)
    _write_masks(folder)
    _write_checkpoints(folder)
    _write_folder(folder / "rgbd", folder)


def _write_pictures(folder: Path) -> None:
    image, depth = dead_leaves(SIZE, SIZE, num_leaves=60, seed=0)
    rows = image.permute(1, 2, 0).numpy()
    for bits, name in ((8, "image.png"), (16, "image16.png"), (8, "image.tif"), (16, "image16.tif"), (8, "image.jpg")):
        write_image(folder / name, image, bits)
    write_image(folder / "grey.png", image.mean(0, keepdim=True))
    cv2.imwrite(
        str(folder / "progressive.jpg"), np.rint(255 * rows).astype(np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]
    )
    cv2.imwrite(str(folder / "float.tif"), rows)
    np.save(folder / "image.npy", rows)
    np.save(folder / "image8.npy", np.rint(255 * rows).astype(np.uint8))
    (folder / "image.pfm").write_bytes(encode_pfm(rows))
    for suffix in ("png", "pfm", "npy"):
        write_depth(folder / f"depth.{suffix}", depth.clamp(max=60), 0.001 if suffix == "png" else 1.0, saturate=True)
    cv2.imwrite(str(folder / "depth.tif"), depth[0].numpy())
    head = f"P7\nWIDTH {SIZE}\nHEIGHT {SIZE}\nDEPTH 3\nMAXVAL 1023\nTUPLTYPE RGB\nENDHDR\n".encode()
    (folder / "image.pam").write_bytes(head + np.rint(1023 * rows).astype(">u2").tobytes())
    np.savez_compressed(folder / "depth.npz", depth[0].numpy())
    with suppress(ImportError):  # an extra
        import OpenEXR

        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {"Z": depth[0].numpy()}).write(str(folder / "depth.exr"))


def _write_masks(folder: Path) -> None:
    masks = PixelwiseMask(2, generator=torch.Generator().manual_seed(0))
    write_heights(folder / "heights.npy", masks.heights().detach().double())
    write_heights(folder / "heights.safetensors", masks.heights().detach().double())
    optics = TiDyOptics(masks, fidelity="draft")
    optics.psf_bank().save(folder / "bank.safetensors")
    save_file(optics.state_dict(), folder / "camera.safetensors")
    (folder / "lut.txt").write_text(" ".join(f"{level / 40.6:.6f}" for level in range(256)))
    write_slm_frames(folder / "frames", SLMFrames.of(20 * masks.heights().detach(), GreyLevels(8)))


def _write_checkpoints(folder: Path) -> None:
    """Untrained systems in the format of trained ones: one with the capture as input, one with refocused images."""
    plain = TrainingSettings(
        task="joint", masks=2, head="plain", width=4, size=32, scenes=2, validation_scenes=1, window=9,
        fidelity="draft",
    )  # fmt: skip
    for name, settings in (("plain", plain), ("refocused", plain.replace(task="edof", refocus=2, residual=True))):
        torch.manual_seed(0)
        optics, head = build_optics(settings), build_head(settings)
        weights = {f"{part}.{key}": value for part, module in (("optics", optics), ("head", head))
                   for key, value in module.state_dict().items()}  # fmt: skip
        state = {"settings": settings.as_dict(), "state_dict": weights, "global_step": 3}
        write_state(folder / f"{name}.safetensors", state)


def _write_folder(root: Path, folder: Path) -> None:
    root.mkdir()
    for name in ("lamp", "chair"):
        shutil.copy(folder / "image.png", root / f"{name}.png")
        shutil.copy(folder / "depth.png", root / f"{name}_depth.png")
    about = {"image": "*.png", "depth": "*_depth.png", "scale": 0.001, "invalid": [65535], "kind": "depth"}
    (root / "rgbd.json").write_text(json.dumps(about))
