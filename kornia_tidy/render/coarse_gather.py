r"""Gather on coarse grids: large discs are convolved with an image of fewer pixels, and interpolated to the sensor's.

A layer with a large PSF is smooth. Its image is averaged over squares of k pixels, convolved there with the PSF of a
camera with pixels k times as wide, and interpolated linearly. Averaging twice and interpolating widens the PSF by
:math:`1/12 + 1/12 + 1/6 = 1/3` of a squared grid pixel on each axis; the PSF is sharpened by as much,
:math:`h - \Delta h / 6`, so that the rest is of fourth order. Pixels blend their two layers as in
:func:`kornia_tidy.render.compositing.gather`, and each belongs to the one group of layers that spans its defocus.

A sharpened PSF is negative just outside of the aperture's image: there h is zero, and at a straight edge at most two of
its four neighbours lie within, so that it is at least :math:`-h_{max} / 3`. Averaging and interpolation only mix its
values. Light that is nowhere negative therefore gives

.. math:: I(x) \ge -\sum_j \max(-h_j, 0) \, L_{max},

with the sum over the sharpened PSF, 0.023 for a disc of 12 pixels of the grid and 0.007 for one of 24, and the
brightest light within the PSF's reach. One pixel of light L gives at least :math:`-L / (3 A R^2)` for a radius of R
sensor pixels, with the aperture's area A in squared pupil radii, which is :math:`\pi` for the disc. Where two groups
meet, both have a layer with the same PSF h. Their pixels differ by at most half of the absolute sum of the difference
of the two kernels, 0.034 for the disc, times the range of the light within reach; by
:data:`~kornia_tidy.psf.wide_blur.GRID_ERROR` root mean square in a photograph.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, pad

from kornia_tidy.psf.psf_bank import BankOfPSFs
from kornia_tidy.render.borders import cropped, extended, next_fast_size
from kornia_tidy.render.compositing import gather
from kornia_tidy.render.scene import assign_layers

_SHARPENED = 1 / 6  # half of the variance that averaging and interpolating add on each axis
_LAYER_BYTES = 64 << 20  # of the layers held at a time


def gather_group(
    image: Tensor, defocus: Tensor, bank: BankOfPSFs, own: Tensor, grid: int, margin: int = 0, border: str = "reflect"
) -> Tensor:
    """Gather light through a group of layers on one grid, at the pixels that are the group's.

    Args:
        image: (B, C, H, W) linear light.
        defocus: (B, 1, H, W) or (1, 1, H, W) radians. Beyond the group's layers it is clamped to the ends.
        bank: PSFs of the group.
        own: which pixels are the group's, bool, as ``defocus``.
        grid: sensor pixels along a side of a pixel of the PSFs.
        margin: pixels that are not seen on each side.
        border: continuation of the image beyond its edges, see :mod:`kornia_tidy.render.borders`. Images smaller than a
            PSF's radius are reflected several times.

    Returns:
        (B, C, h, w) light, zero at pixels of other groups. Gradients reach image, defocus and PSFs.

    Example:
        >>> from kornia_tidy.psf import PSFBank
        >>> bank = PSFBank(torch.full((2, 1, 5, 5), 1 / 25), torch.tensor([8.0, 9.0]), torch.ones(2, 1))
        >>> defocus = torch.full((1, 1, 16, 16), 8.2)
        >>> gather_group(torch.ones(1, 1, 16, 16), defocus, bank, defocus > 8, grid=2).mean().round()
        tensor(1.)
    """
    seen, own = cropped(defocus, margin), cropped(own, margin)
    if grid == 1:
        return torch.where(own, _on_sensor(image, seen, bank, margin, border), 0)
    coded = image.new_zeros(*image.shape[:2], *seen.shape[-2:])
    for b, pixels, light in _on_grid(image, seen, own, bank, grid, margin, border):
        coded.flatten(2)[b].index_copy_(1, pixels, light.to(image.dtype))
    return coded


def _on_sensor(image: Tensor, seen: Tensor, bank: BankOfPSFs, margin: int, border: str) -> Tensor:
    """Gather on the sensor's own pixels, after as much border as the PSFs reach."""
    radius = bank.window // 2
    height, width = seen.shape[-2:]
    rows, columns = ((margin - radius, side + margin + radius) for side in (height, width))
    plane = extended(image, rows, columns, border)
    beyond = pad(seen, (radius,) * 4)  # not looked at
    return gather(plane, beyond, bank.defocus, bank.psfs, border="valid")


def _on_grid(
    image: Tensor, seen: Tensor, own: Tensor, bank: BankOfPSFs, grid: int, margin: int, border: str
) -> Iterator[tuple[int, Tensor, Tensor]]:
    """Yield images of the batch, pixels (n,) of the group and their light (C, n), some layers at a time."""
    radius = bank.psfs.shape[-1] // 2 + 2  # one for interpolation, one for sharpening
    rows, columns = ((margin - radius * grid, margin + (-(-side // grid) + radius) * grid) for side in seen.shape[-2:])
    plane = avg_pool2d(extended(image, rows, columns, border), grid)
    psfs, nodes = _sharpened(bank.psfs.to(plane.dtype)), bank.defocus.to(seen)
    size, lost = [next_fast_size(side) for side in plane.shape[-2:]], psfs.shape[-1] - 1
    spectrum = torch.fft.rfft2(plane, s=size)
    at_once = max(2, _LAYER_BYTES // max(1, plane.numel() * plane.element_size()))
    for first in range(0, max(1, len(nodes) - 1), at_once - 1):
        chunk = slice(first, min(first + at_once, len(nodes)))
        inside = own & _between(seen.detach(), nodes, chunk)
        if not bool(inside.any()):
            continue
        blurred = [torch.fft.irfft2(spectrum * torch.fft.rfft2(psf, s=size), s=size) for psf in psfs[chunk]]
        layers = torch.stack(blurred, 2)[..., lost : plane.shape[-2], lost : plane.shape[-1]]
        for b in range(len(image)):
            of_scene = b if len(seen) > 1 else 0
            pixels = inside[of_scene].flatten().nonzero().flatten()
            row, column = ((at + 0.5) / grid + 0.5 for at in (pixels // seen.shape[-1], pixels % seen.shape[-1]))
            index, weight = assign_layers(seen[of_scene].flatten()[pixels], nodes[chunk], "linear")
            yield (
                b,
                pixels,
                _interpolated(layers[b], index + weight, row, column),
            )


def _between(defocus: Tensor, nodes: Tensor, chunk: slice) -> Tensor:
    """Return where defocus lies in the intervals of a chunk of layers; the outermost reach to infinity."""
    inside = torch.ones_like(defocus, dtype=torch.bool)
    if chunk.start > 0:
        inside &= defocus >= nodes[chunk.start]
    if chunk.stop < len(nodes):
        inside &= defocus < nodes[chunk.stop - 1]
    return inside


def _interpolated(layers: Tensor, layer: Tensor, row: Tensor, column: Tensor) -> Tensor:
    """Return values between layers and pixels, (C, n), of layers (C, D, h, w)."""
    sizes = [max(1, side - 1) for side in layers.shape[1:]]
    where = torch.stack([2 * column / sizes[2] - 1, 2 * row / sizes[1] - 1, 2 * layer / sizes[0] - 1], -1).to(layers)
    sampled = grid_sample(layers[None], where.view(1, 1, 1, -1, 3), align_corners=True)
    return sampled[0, :, 0, 0]


def _sharpened(psfs: Tensor) -> Tensor:
    """Return PSFs less a sixth of their Laplacian, with one more pixel around."""
    wide = pad(psfs, (2,) * 4)
    middle = wide[..., 1:-1, 1:-1]
    around = wide[..., :-2, 1:-1] + wide[..., 2:, 1:-1] + wide[..., 1:-1, :-2] + wide[..., 1:-1, 2:]
    return middle - _SHARPENED * (around - 4 * middle)
