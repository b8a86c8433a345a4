"""Point captures of a camera we know: exact at any place between the pixels, with all that spoils a measurement."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from kornia_tidy import Spectrum, ThinLensCamera
from kornia_tidy.masks import PhaseMasks
from kornia_tidy.optics.aperture import circular_aperture
from kornia_tidy.psf.exact import exact_psf_bank
from kornia_tidy.psf.pupil import Pupil

FINE = 9  # parts of a pixel along each side: points lie at whole numbers of them


def point_light(masks: PhaseMasks, defocus: float, side: int, spectrum: Spectrum, camera: ThinLensCamera) -> Tensor:
    """Share of a point's light in each ninth of a pixel, (C, 9 side, 9 side), the chief ray in the middle."""
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
    """The image of a point that lies ninths of a pixel down and right of a pixel's centre, (C, side, side)."""
    return avg_pool2d(torch.roll(fine, ninths, (-2, -1))[None], FINE)[0] * FINE**2


def exposed(
    light: Tensor, exposures: Tensor, generator: torch.Generator, full_well: float, read: float, background: float
) -> Tensor:
    """Frames of a 12-bit camera, black level taken off, 1 at full scale: (E, C, H, W).

    Args:
        light: (C, H, W) share of full scale per unit of exposure.
        exposures: (E,).
        generator: of the noise.
        full_well: electrons.
        read: electrons.
        background: share of full scale per unit of exposure.
    """
    black, white = 64, 4095
    electrons = (light.clamp(min=0) + background) * exposures.view(-1, 1, 1, 1) * full_well
    electrons = torch.poisson(electrons, generator=generator).clamp(max=full_well)
    electrons = electrons + read * torch.randn(electrons.shape, generator=generator)
    counts = (black + electrons / full_well * (white - black)).round().clamp(0, white)
    return (counts - black) / (white - black)


def planes(light: Tensor, tile: tuple[tuple[int, ...], ...]) -> Tensor:
    """What the pixels of each place of a filter array's tile see of light on the sensor, (C, H, W) to its planes."""
    step = len(tile)
    height, width = (size - size % step for size in light.shape[-2:])
    places = ((row, column) for row in range(step) for column in range(step))
    return torch.stack([light[tile[row][column], row:height:step, column:width:step] for row, column in places])
