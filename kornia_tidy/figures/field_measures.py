"""Numbers of a camera behind a real lens over field, depth and colour: PSFs, their contrast, and rays' errors."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.checks import check_positive
from kornia_tidy.figures.psf_measures import FREQUENCIES, channel_names, half_contrast, in_metres
from kornia_tidy.figures.system_statistics import contrast_transfer
from kornia_tidy.masks.no_mask import NoMask
from kornia_tidy.optics.lens.lens import Lens
from kornia_tidy.optics.thin_lens import DefocusRange, ThinLensCamera
from kornia_tidy.psf.lens_psfs import turned_lenses
from kornia_tidy.psf.ray_errors import ray_errors, rays_in_stop

STEPS = 96  # of the contrast along one direction, from 0 to 0.5 cycles per pixel


@dataclass(frozen=True)
class FieldMeasures:
    """PSFs of a camera over the field and their numbers, for F heights, D depths from near to far and C channels.

    Attributes:
        lens: in words.
        heights: of the field points in metres.
        pitch: of the sensor in metres.
        depths: in words, such as ``"0.6 m"``.
        defocus: radians.
        channels: names, such as ``"530 nm"``.
        psfs: (F, D, C, P, P), light in each pixel in parts of an even scene's on the axis; columns run along the field.
        energy: (F, D, C) share of a point's light inside the window.
        light: (F, D, C) relative illumination.
        strehl: (F, D, C) peaks relative to that of an ideal lens in focus without a mask, for the same light.
        contrast: (F, D, C, R) MTF, the mean of all directions, in rings as :func:`contrast_transfer` has them.
        tangential: (F, D, C, S) MTF along the field at 0 to 0.5 cycles per pixel, ends included.
        sagittal: the same across the field.
        rays: for each height and channel (D, N, 2): y and x in pixels from the chief ray, of the lens without masks.
        spread: (F, D, C) root mean square of the rays' distance from their mean, in pixels.
        lateral: (F, C) where the channel's chief ray lands beyond that of 530 nm, in pixels.
    """

    lens: str
    heights: tuple[float, ...]
    pitch: float
    depths: tuple[str, ...]
    defocus: tuple[float, ...]
    channels: tuple[str, ...]
    psfs: Tensor
    energy: Tensor
    light: Tensor
    strehl: Tensor
    contrast: Tensor
    tangential: Tensor
    sagittal: Tensor
    rays: tuple[tuple[Tensor, ...], ...]
    spread: Tensor
    lateral: Tensor

    def table(self) -> list[str]:
        """Return the numbers as lines of aligned columns, the headings first."""
        heads = f"{'height':>8}  {'depth':>9}  {'psi, rad':>8}  {'colour':>8}  {'light':>6}  {'held':>6}  {'peak':>7}"
        lines = [f"{heads}  Strehl  {'rays':>8}  MTF50, cycles a pixel"]
        for f, height in enumerate(self.heights):
            for d, (depth, psi) in enumerate(zip(self.depths, self.defocus, strict=True)):
                for c, name in enumerate(self.channels):
                    light = float(self.light[f, d, c])
                    held, peak = 100 * float(self.energy[f, d, c]), 100 * float(self.psfs[f, d, c].max()) / light
                    lines.append(
                        f"{1e3 * height:>5.2f} mm  {depth:>9}  {psi:>+8.2f}  {name:>8}  {100 * light:>4.0f} %  "
                        f"{held:>4.1f} %  {peak:>5.2f} %  {float(self.strehl[f, d, c]):>6.3f}  "
                        f"{float(self.spread[f, d, c]):>5.2f} px  {half_contrast(self.contrast[f, d, c])}"
                    )
        return lines


def heights_to_corner(lens: Lens, count: int) -> tuple[float, ...]:
    """Return heights on the sensor in metres, evenly spaced from the axis to the largest of a lens.

    Example:
        >>> heights_to_corner(Lens.from_seidel(50e-3, 4.0, 1.0, field=10e-3), 3)
        (0.0, 0.005, 0.01)
    """
    check_positive("field", count, "heights")
    return tuple(lens.field * i / max(count - 1, 1) for i in range(count))


@torch.no_grad()
def measures_over_field(optics: TiDyOptics, heights: tuple[float, ...], defocus: Tensor) -> FieldMeasures:
    """Measure the PSFs of a camera with a lens along a line from the axis to the right.

    Args:
        optics: the camera.
        heights: of the field points in metres.
        defocus: (D,) radians, ascending.

    Raises:
        ValueError: if the camera has no lens.

    Example:
        >>> optics = TiDyOptics(NoMask(), lens="single-50mm", fidelity="draft")
        >>> measured = measures_over_field(optics, (0.0, 6e-3), torch.tensor([0.0]))
        >>> measured.psfs.shape[:3], bool(measured.spread[1, 0, 1] > measured.spread[0, 0, 1])
        (torch.Size([2, 1, 3]), True)
    """
    if optics.lens is None:
        raise ValueError("PSFs over the field need a camera with a lens, got none: give it lens='single-50mm'")
    lens, pitch, window = optics.lens, optics.camera.pixel_pitch, optics.window
    settings = optics.fidelity.replace(name=optics.fidelity.name, window=window, stray_light="discard")
    psi = defocus.flip(0).tolist()  # nearest first
    points = [(0.0, height / pitch) for height in heights]
    bank = optics.with_fidelity(settings).psf_bank(defocus=defocus.tolist(), field=points)
    psfs, energy, light = (part.flip(1).cpu().double() for part in (bank.psfs, bank.energy, bank.light))
    own = psfs / psfs.sum((-2, -1), keepdim=True)
    ideal = TiDyOptics(NoMask(), optics.camera, fidelity=settings.replace(wide_blur="waves"), spectrum=optics.spectrum)
    sharpest = ideal.psf_bank(defocus=[0.0]).psfs.amax((2, 3)).double()
    rays, lateral = _rays(optics, lens, heights, psi)
    return FieldMeasures(
        f"{lens.name}, {1e3 * lens.focal_length:.3g} mm f/{lens.f_number:.3g}, focus at {lens.focus_distance:.3g} m",
        heights,
        pitch,
        tuple(in_metres(each, optics) for each in psi),
        tuple(round(each, 6) + 0.0 for each in psi),  # without a negative zero
        tuple(channel_names(optics)),
        psfs,
        energy,
        light,
        psfs.amax((-2, -1)) / light / sharpest,
        contrast_transfer(own, FREQUENCIES),
        _contrast_along(own.sum(-2)),
        _contrast_along(own.sum(-1)),
        rays,
        torch.stack([torch.stack([_spread(seen) for seen in row], -1) for row in rays]),
        lateral,
    )


def _contrast_along(lines: Tensor) -> Tensor:
    """Return the modulus of the spectrum of line spread functions (..., P) at 0 to 0.5 cycles per pixel, (..., S)."""
    frequency = torch.linspace(0, 0.5, STEPS, dtype=torch.float64)
    phase = -2 * torch.pi * torch.arange(lines.shape[-1], dtype=torch.float64)[:, None] * frequency
    return (lines.to(torch.complex128) @ torch.polar(torch.ones_like(phase), phase)).abs()


def _rays(
    optics: TiDyOptics, lens: Lens, heights: tuple[float, ...], psi: list[float]
) -> tuple[tuple[tuple[Tensor, ...], ...], Tensor]:
    """Return the errors of rays in pixels by height and channel, at the channel's mean wavelength, and their colour."""
    pitch, metres = optics.camera.pixel_pitch, [(0.0, height) for height in heights]
    shares = torch.tensor(optics.spectrum.channel_weights, dtype=torch.float64)
    waves = (shares @ torch.tensor(optics.spectrum.wavelengths, dtype=torch.float64)).tolist()
    seen = [turned_lenses(lens.table, metres, psi, wave) for wave in waves]
    rays = tuple(
        tuple(ray_errors(turned, *rays_in_stop(turned)) / pitch for turned in row) for row in zip(*seen, strict=True)
    )
    at = torch.tensor(heights, dtype=torch.float64)
    return rays, torch.stack([lens.lateral_colour(at, wave) for wave in waves], -1) / pitch


def _spread(rays: Tensor) -> Tensor:
    return (rays - rays.mean(1, keepdim=True)).square().sum(-1).mean(1).sqrt()


def depths_around_focus(camera: ThinLensCamera | DefocusRange, count: int = 2) -> Tensor:
    """Return defocus from one end of a camera's range to the other, ascending, so many values to each side of focus.

    Example:
        >>> depths_around_focus(DefocusRange(-10.0, 20.0)).tolist()
        [-10.0, -5.0, 0.0, 10.0, 20.0]
    """
    lo, hi = camera.defocus_range
    focus = min(max(0.0, lo), hi)
    sides = [torch.linspace(*ends, count + 1, dtype=torch.float64) for ends in ((lo, focus), (focus, hi))]
    return torch.cat(sides).unique()
