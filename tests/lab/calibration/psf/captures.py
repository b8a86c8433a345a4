"""Simulated point captures of a known camera, exact at any sub-pixel position, with realistic noise and defects."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from kornia_tidy.masks import PhaseMasks
from kornia_tidy.optics import Spectrum, ThinLensCamera, circular_aperture
from kornia_tidy.psf import Pupil, exact_psf_bank

FINE = 9  # subdivisions of a pixel along each side; points have positions on this grid


def point_light(masks: PhaseMasks, defocus: float, side: int, spectrum: Spectrum, camera: ThinLensCamera) -> Tensor:
    """Return a point's light on a grid of ninths of a pixel, (C, 9 side, 9 side), with the chief ray in the middle."""
    phase = masks.phase.detach().float()
    size = phase.shape[-1]
    step = camera.pixel_pitch * camera.aperture_radius / float(camera.image_distance)
    bank = exact_psf_bank(
        phase,
        torch.full((len(phase),), 1 / len(phase)),
        Pupil(circular_aperture(size, 2.3 / size), 2.3 / size),
        spectrum,
        [masks.dispersion(wavelength) for wavelength in spectrum.wavelengths],
        [defocus],
        step / FINE,
        FINE * side,
        1e-4,
    )
    return bank.psfs[0]


def on_pixels(fine: Tensor, ninths: tuple[int, int] = (0, 0)) -> Tensor:
    """Return the image of a point at an offset in ninths of a pixel from a pixel's centre, (C, side, side)."""
    return avg_pool2d(torch.roll(fine, ninths, (-2, -1))[None], FINE)[0] * FINE**2


def exposed(
    light: Tensor, exposures: Tensor, generator: torch.Generator, full_well: float, read: float, background: float
) -> Tensor:
    """Return frames of a 12-bit camera with the black level subtracted and 1 at full scale, (E, C, H, W).

    Args:
        light: (C, H, W) fraction of full scale per unit of exposure.
        exposures: (E,).
        generator: source of the noise.
        full_well: full well in electrons.
        read: read noise in electrons.
        background: fraction of full scale per unit of exposure.
    """
    black, white = 64, 4095
    electrons = (light.clamp(min=0) + background) * exposures.view(-1, 1, 1, 1) * full_well
    electrons = torch.poisson(electrons, generator=generator).clamp(max=full_well)
    electrons = electrons + read * torch.randn(electrons.shape, generator=generator)
    counts = (black + electrons / full_well * (white - black)).round().clamp(0, white)
    return (counts - black) / (white - black)


def planes(light: Tensor, tile: tuple[tuple[int, ...], ...]) -> Tensor:
    """Sample light on the sensor (C, H, W) by a filter array, as one plane for each position in its tile."""
    step = len(tile)
    height, width = (size - size % step for size in light.shape[-2:])
    places = ((row, column) for row in range(step) for column in range(step))
    return torch.stack([light[tile[row][column], row:height:step, column:width:step] for row, column in places])
