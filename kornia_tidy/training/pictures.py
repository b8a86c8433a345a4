"""Pictures of a training run: masks, PSFs over depth, captures and estimates."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.data.image_files import write_image

if TYPE_CHECKING:
    from kornia_tidy.training.module import BatchResult

SCALE, GAP = 4, 2  # picture pixels per pixel of a mask or PSF; picture pixels between two of them
DEPTHS, SCENES = 7, 4  # drawn, at most
ERROR_SCALE = 3.0  # of error maps, so that small errors are visible


def draw_pictures(optics: TiDyOptics, result: BatchResult, folder: Path, epoch: int) -> dict[str, Tensor]:
    """Write masks, PSFs and estimates to PNG files named by the epoch, and return the pictures, (3, H, W)."""
    folder.mkdir(parents=True, exist_ok=True)
    pictures = {"masks": masks_picture(optics), "psfs": psfs_picture(optics), "estimates": estimates_picture(result)}
    for name, picture in pictures.items():
        write_image(folder / f"epoch_{epoch:04d}_{name}.png", picture)
    return pictures


@torch.no_grad()
def masks_picture(optics: TiDyOptics) -> Tensor:
    """Return the masks side by side, phase from 0 (black) to 2 pi (white).

    Example:
        >>> from kornia_tidy import FresnelLens
        >>> masks_picture(TiDyOptics(FresnelLens())).shape
        torch.Size([3, 92, 92])
    """
    phase = optics.masks.phase.detach().float().cpu().remainder(2 * math.pi) / (2 * math.pi)
    return _grid([[enlarged(mask[None]) for mask in phase]])


@torch.no_grad()
def psfs_picture(optics: TiDyOptics) -> Tensor:
    """Return PSFs from the near (left) to the far end of the range: square roots, each scaled to its peak."""
    psfs = optics.psf_bank().psfs.detach().float().cpu()
    nodes = torch.linspace(len(psfs) - 1, 0, DEPTHS).round().long().tolist()
    light = [psfs[node] if psfs.shape[1] == 3 else psfs[node, :1] for node in nodes]
    return _grid([[enlarged((psf / psf.max().clamp(min=1e-30)).clamp(min=0).sqrt()) for psf in light]])


def estimates_picture(result: BatchResult) -> Tensor:
    """Return one row per scene: the capture, then for each map estimate, true map, and :func:`error_map`."""
    rows = []
    for i in range(min(SCENES, len(result.coded))):
        row = [result.coded[i]]
        for name, maps in result.estimate.items():
            truth = result.truth[name][i]
            row += [maps[i], truth, error_map(maps[i], truth)]
        rows.append([part.detach().float().cpu() for part in row])
    return _grid(rows)


def error_map(estimate: Tensor, truth: Tensor) -> Tensor:
    """Return the absolute difference of two maps, times 3, clipped to 1.

    Example:
        >>> error_map(torch.tensor([0.5]), torch.tensor([0.25]))
        tensor([0.7500])
    """
    return ((estimate - truth).abs() * ERROR_SCALE).clamp(max=1)


def enlarged(picture: Tensor) -> Tensor:
    """Return a picture enlarged by whole pixels."""
    return torch.nn.functional.interpolate(picture[None], scale_factor=float(SCALE), mode="nearest")[0]


def _grid(rows: list[list[Tensor]]) -> Tensor:
    """Return a grid of pictures of one size, with white gaps."""
    height, width = rows[0][0].shape[-2:]
    canvas = torch.ones(3, len(rows) * (height + GAP) - GAP, len(rows[0]) * (width + GAP) - GAP)
    for y, row in enumerate(rows):
        for x, part in enumerate(row):
            top, left = y * (height + GAP), x * (width + GAP)
            canvas[:, top : top + height, left : left + width] = part.nan_to_num().clamp(0, 1)
    return canvas
