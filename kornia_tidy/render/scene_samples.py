"""Scenes to measure rendering times with: discs at random depths before a slanted background."""

from __future__ import annotations

import torch
from torch import Tensor

from kornia_tidy.render.scene import LayeredScene, layered_scene

DEFOCUS = 20.0  # rad, at both ends


def sample_scene(
    side: int,
    psf_size: int,
    layers: int = 7,
    mode: str = "linear",
    compositing: str = "gather",
    discs: int = 40,
    channels: int = 3,
) -> LayeredScene:
    """Return a scene of discs, the same every time.

    Args:
        side: of the image in pixels.
        psf_size: side of the PSFs.
        layers: number of layers.
        mode: ``"nearest"`` or ``"linear"``.
        compositing: ``"gather"``, ``"scatter"`` or ``"occlusion"``.
        discs: before the background.
        channels: of the image.

    Example:
        >>> sample_scene(64, 9).output_size
        (64, 64)
    """
    generator = torch.Generator("cpu").manual_seed(0)

    def random(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float32, device="cpu")

    psfs = random(layers, channels, psf_size, psf_size) ** 4
    defocus, image = disc_defocus(side, side, discs, generator), random(1, channels, side, side)
    return layered_scene(
        image,
        defocus,
        torch.linspace(-DEFOCUS, DEFOCUS, layers, dtype=torch.float32, device="cpu"),
        psfs / psfs.sum((-2, -1), keepdim=True),
        compositing=compositing,
        layers=mode,
    )


def disc_defocus(height: int, width: int, discs: int, generator: torch.Generator) -> Tensor:
    """Return (1, 1, H, W) defocus in radians of discs before a slanted background, the later ones nearer."""
    y, x = (torch.linspace(0, 1, n, dtype=torch.float32, device="cpu") for n in (height, width))
    defocus = (0.5 * y[:, None] + 0.2 * x - 1) * DEFOCUS
    for number in range(discs):
        row, column, size, depth, slant = torch.rand(5, generator=generator, dtype=torch.float32, device="cpu").tolist()
        inside = (y[:, None] - row) ** 2 + (x - column) ** 2 < (0.02 + 0.15 * size**2) ** 2
        level = -0.9 + 1.8 * depth * ((number + 1) / discs) ** 0.3
        defocus = torch.where(inside, (level + 0.2 * slant * (x - column)) * DEFOCUS, defocus)
    return defocus.clamp(-DEFOCUS, DEFOCUS)[None, None]
