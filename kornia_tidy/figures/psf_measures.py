"""Numbers of a camera's PSFs over depth and colour: light in the window, peak, Strehl ratio and contrast."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.figures.depth import depth_at
from kornia_tidy.figures.system_statistics import contrast_transfer, ring_centres
from kornia_tidy.masks.pixelwise import PixelwiseMask
from kornia_tidy.optics.thin_lens import ThinLensCamera

FREQUENCIES = 64  # rings of the contrast
SLICES = 81  # through focus


@dataclass(frozen=True)
class PSFMeasures:
    """PSFs of a camera and their numbers, for D depths from near to far, C channels and PSFs of P x P pixels.

    Attributes:
        depths: in words, such as ``"0.6 m"``.
        defocus: radians.
        channels: names, such as ``"530 nm"``.
        psfs: (D, C, P, P), share of a point's light in each pixel.
        strehl: (D, C), peaks relative to that of an ideal lens in focus without a mask.
        contrast: (D, C, F) MTF in rings of equal width from 0 to 0.5 cycles per pixel.
        focus: (S,) radians of the slice through focus, ascending.
        slices: (S, P) middle rows of the middle channel's PSFs there.
    """

    depths: tuple[str, ...]
    defocus: tuple[float, ...]
    channels: tuple[str, ...]
    psfs: Tensor
    strehl: Tensor
    contrast: Tensor
    focus: Tensor
    slices: Tensor

    def table(self) -> list[str]:
        """Return the numbers as lines of aligned columns, the headings first."""
        heads = f"{'depth':>9}  {'psi, rad':>8}  {'colour':>8}  {'held':>6}  {'peak':>7}  Strehl"
        lines = [f"{heads}  MTF50, cycles a pixel"]
        for d, (depth, psi) in enumerate(zip(self.depths, self.defocus, strict=True)):
            for c, name in enumerate(self.channels):
                held, peak = 100 * float(self.psfs[d, c].sum()), 100 * float(self.psfs[d, c].max())
                lines.append(
                    f"{depth:>9}  {psi:>+8.2f}  {name:>8}  {held:>4.1f} %  {peak:>5.2f} %  "
                    f"{float(self.strehl[d, c]):>6.3f}  {half_contrast(self.contrast[d, c])}"
                )
        return lines


@torch.no_grad()
def measures_of_psfs(optics: TiDyOptics, defocus: Tensor) -> PSFMeasures:
    """Measure the PSFs of a camera.

    Args:
        optics: the camera. Its fidelity should discard stray light: otherwise the window holds all of it.
        defocus: (D,) radians, ascending.

    Example:
        >>> measured = measures_of_psfs(TiDyOptics(fidelity="draft"), torch.tensor([0.0, 20.0]))
        >>> measured.depths, measured.psfs.shape[:2]
        (('0.298 m', '0.595 m'), torch.Size([2, 3]))
    """
    psfs = optics.psf_bank(defocus=defocus.tolist()).psfs.flip(0)  # nearest first
    focus = torch.linspace(*optics.camera.defocus_range, SLICES, dtype=torch.float64)
    through = optics.psf_bank(defocus=focus.tolist()).psfs
    psi = tuple(round(each, 6) + 0.0 for each in defocus.flip(0).tolist())  # without a negative zero
    return PSFMeasures(
        tuple(in_metres(each, optics) for each in psi),
        psi,
        tuple(channel_names(optics)),
        psfs,
        psfs.amax((2, 3)) / _without_mask(optics).amax((2, 3)),
        contrast_transfer(psfs / psfs.sum((2, 3), keepdim=True), FREQUENCIES),
        focus,
        through[:, through.shape[1] // 2, optics.window // 2],
    )


def _without_mask(optics: TiDyOptics) -> Tensor:
    """Return the in-focus PSFs of an ideal lens of the same aperture with a flat mask, (1, C, P, P)."""
    rows, columns = optics.masks.phase.shape[-2:]
    masks = PixelwiseMask(1, (rows, columns), initial="flat")
    plain = TiDyOptics(
        masks, optics.camera, fidelity=optics.fidelity, spectrum=optics.spectrum, aperture=optics.aperture
    )
    return plain.psf_bank(defocus=[0.0]).psfs


def in_metres(psi: float, optics: TiDyOptics) -> str:
    """Return the depth of a defocus in words; a dash where the camera has no lengths.

    Example:
        >>> in_metres(0.0, TiDyOptics(fidelity="draft"))
        '0.595 m'
    """
    if not isinstance(optics.camera, ThinLensCamera):
        return "-"
    depth = depth_at(psi, optics.camera)
    return "inf" if math.isinf(depth) else f"{depth:.3g} m"


def channel_names(optics: TiDyOptics) -> list[str]:
    """Return the names of the channels: a wavelength, or a colour if a channel has several.

    Example:
        >>> from kornia_tidy.optics import camera_spectrum
        >>> [channel_names(TiDyOptics(fidelity="draft", spectrum=s)) for s in (None, camera_spectrum())]
        [['610 nm', '530 nm', '470 nm'], ['red', 'green', 'blue']]
    """
    seen = [
        [wavelength for wavelength, weight in zip(optics.spectrum.wavelengths, weights, strict=True) if weight]
        for weights in optics.spectrum.weights
    ]
    names = ("red", "green", "blue") if len(seen) == 3 else tuple(f"{c + 1}" for c in range(len(seen)))
    return [f"{own[0] * 1e9:.0f} nm" if len(own) == 1 else name for own, name in zip(seen, names, strict=True)]


def half_contrast(contrast: Tensor) -> str:
    """Return the frequency at which contrast first falls to one half, in cycles per pixel, in words.

    Example:
        >>> half_contrast(torch.tensor([0.9, 0.6, 0.4, 0.1])), half_contrast(torch.tensor([0.4, 0.1]))
        ('0.250', '0.104')
    """
    frequency, values = [0.0, *ring_centres(len(contrast))], [1.0, *contrast.tolist()]
    for i in range(1, len(values)):
        if values[i] <= 0.5:
            share = (values[i - 1] - 0.5) / (values[i - 1] - values[i])
            return f"{frequency[i - 1] + share * (frequency[i] - frequency[i - 1]):.3f}"
    return "above 0.5"
