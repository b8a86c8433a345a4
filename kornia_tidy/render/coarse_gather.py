r"""Gather on coarse grids: large discs are convolved with an image of fewer pixels, and interpolated to the sensor's.

A layer with a large PSF is smooth. Its image is averaged over squares of k pixels, convolved there with the PSF of a
camera with pixels k times as wide, and interpolated linearly. Averaging twice and interpolating widens the PSF by
:math:`1/12 + 1/12 + 1/6 = 1/3` of a squared grid pixel on each axis; the PSF is sharpened by as much,
:math:`h - \Delta h / 6`, so that what is left is of fourth order. Pixels blend their two layers as in
:func:`kornia_tidy.render.compositing.gather`, and each belongs to the one group of layers that spans its defocus.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Protocol

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, pad

from kornia_tidy.render.borders import next_fast_size
from kornia_tidy.render.compositing import Bank, gather

_SHARPENED = 1 / 6  # half of the variance that averaging and interpolating add on each axis
_LAYER_BYTES = 64 << 20  # of the layers held at a time


class LayerGroup(Protocol):
    """Layers on one grid, see :class:`kornia_tidy.psf.wide_psfs.GroupBank`."""

    @property
    def grid(self) -> int:
        """Sensor pixels along a side of a pixel of the grid."""
        ...

    @property
    def span(self) -> tuple[float, float]:
        """Lowest and highest defocus of the group's pixels in radians."""
        ...

    @property
    def bank(self) -> Bank:
        """PSFs on the grid."""
        ...


def gather_groups(
    image: Tensor, defocus: Tensor, groups: Iterable[LayerGroup], window: int, border: str = "reflect"
) -> Tensor:
    """Gather light through groups of layers, each on its own grid.

    Args:
        image: (B, C, H, W) linear light.
        defocus: (B, 1, H, W) or (1, 1, H, W) radians. Beyond the groups it is clamped to the ends.
        groups: in ascending order of defocus; every pixel lies in one of them.
        window: side of the PSFs in sensor pixels, for the border ``"valid"``.
        border: what lies beyond the image, see :mod:`kornia_tidy.render.borders`. Images smaller than a PSF's radius
            are reflected several times.

    Returns:
        (B, C, h, w) light. Gradients reach image, defocus and PSFs.

    Example:
        >>> from types import SimpleNamespace
        >>> bank = SimpleNamespace(psfs=torch.full((2, 1, 5, 5), 1 / 25), defocus=torch.tensor([8.0, 9.0]), veil=None)
        >>> group = SimpleNamespace(grid=2, span=(8.0, 9.0), bank=bank)
        >>> gather_groups(torch.ones(1, 1, 16, 16), torch.full((1, 1, 16, 16), 8.2), [group], 11).unique()
        tensor([1.])
    """
    margin = window // 2 if border == "valid" else 0
    height, width = image.shape[-2] - 2 * margin, image.shape[-1] - 2 * margin
    seen = defocus[..., margin : margin + height, margin : margin + width]
    parts = list(groups)
    ends = [group.span[1] for group in parts[:-1]]
    owner = torch.bucketize(seen.detach().contiguous(), seen.new_tensor(ends), right=True)
    coded = None
    for number, group in enumerate(parts):
        if group.grid == 1:
            light = _on_sensor(image, seen, group.bank, margin, border)
        else:
            light = _on_grid(image, seen, owner == number, group, margin, border)
        coded = light if coded is None else torch.where(owner == number, light, coded)
    assert coded is not None
    return coded


def _on_sensor(image: Tensor, seen: Tensor, bank: Bank, margin: int, border: str) -> Tensor:
    """Gather on the sensor's own pixels, after as much border as the PSFs reach."""
    radius, nodes = bank.psfs.shape[-1] // 2, bank.defocus
    height, width = seen.shape[-2:]
    plane = _extended(image, (margin - radius, height + margin + radius), (margin - radius, width + margin + radius), border)
    beyond = pad(seen, (radius,) * 4)  # not looked at
    return gather(plane, beyond, nodes, bank.psfs, border="valid")


def _on_grid(image: Tensor, seen: Tensor, own: Tensor, group: LayerGroup, margin: int, border: str) -> Tensor:
    """Gather on the group's grid, at its own pixels; elsewhere there is nothing."""
    grid, bank = group.grid, group.bank
    radius = bank.psfs.shape[-1] // 2 + 2  # one more for interpolation, one for sharpening
    rows, columns = (-(-side // grid) for side in seen.shape[-2:])
    plane = avg_pool2d(
        _extended(
            image,
            (margin - radius * grid, margin + (rows + radius) * grid),
            (margin - radius * grid, margin + (columns + radius) * grid),
            border,
        ),
        grid,
    )
    light = plane.new_zeros(*image.shape[:2], *seen.shape[-2:])
    psfs, nodes = _sharpened(bank.psfs.to(plane.dtype)), bank.defocus.to(seen)
    size = [next_fast_size(side) for side in plane.shape[-2:]]
    spectrum = torch.fft.rfft2(plane, s=size)
    at_once = max(2, _LAYER_BYTES // max(1, plane.numel() * plane.element_size()))
    for first in range(0, max(1, len(nodes) - 1), at_once - 1):
        chunk = slice(first, min(first + at_once, len(nodes)))
        inside = own & _between(seen.detach(), nodes, chunk)
        if not bool(inside.any()):
            continue
        blurred = []
        for psf in psfs[chunk]:
            product = spectrum * torch.fft.rfft2(psf, s=size)
            blurred.append(torch.fft.irfft2(product, s=size))
        lost = psfs.shape[-1] - 1
        layers = torch.stack(blurred, 2)[..., lost : plane.shape[-2], lost : plane.shape[-1]]
        for b, pixels in enumerate(_pixels(inside, len(image))):
            y, x = pixels
            t = _layer_of(seen[b if len(seen) > 1 else 0, 0][y, x], nodes[chunk])
            samples = _interpolated(layers[b], t, (y + 0.5) / grid + 0.5, (x + 0.5) / grid + 0.5)
            light = light.index_put((torch.tensor(b), slice(None), y, x), samples.T) if light.requires_grad or samples.requires_grad else _put(light, b, y, x, samples)
    return light


def _put(light: Tensor, b: int, y: Tensor, x: Tensor, samples: Tensor) -> Tensor:
    light[b, :, y, x] = samples
    return light


def _pixels(inside: Tensor, batch: int) -> Iterator[tuple[Tensor, Tensor]]:
    for b in range(batch):
        y, x = inside[b if len(inside) > 1 else 0, 0].nonzero(as_tuple=True)
        yield y, x


def _between(defocus: Tensor, nodes: Tensor, chunk: slice) -> Tensor:
    """Return where defocus lies in the intervals of a chunk of layers; the outermost reach to infinity."""
    inside = torch.ones_like(defocus, dtype=torch.bool)
    if chunk.start > 0:
        inside &= defocus >= nodes[chunk.start]
    if chunk.stop < len(nodes):
        inside &= defocus < nodes[chunk.stop - 1]
    return inside


def _layer_of(defocus: Tensor, nodes: Tensor) -> Tensor:
    """Return the layer of each pixel as a real number between 0 and the last one."""
    if len(nodes) == 1:
        return torch.zeros_like(defocus)
    clamped = defocus.clamp(nodes[0], nodes[-1])
    index = torch.bucketize(clamped.detach(), nodes[1:-1].contiguous(), right=True)
    return index + (clamped - nodes[index]) / nodes.diff()[index]


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


def _extended(image: Tensor, rows: tuple[int, int], columns: tuple[int, int], border: str) -> Tensor:
    """Return rows and columns of an image that reach beyond it; ``"valid"`` repeats what nobody looks at."""
    for axis, (first, last) in ((-2, rows), (-1, columns)):
        side = image.shape[axis]
        at = torch.arange(first, last, device=image.device)
        outside = (at < 0) | (at >= side)
        if border == "reflect":
            period = max(1, 2 * side - 2)
            at = at.remainder(period)
            at = torch.minimum(at, period - at)
        elif border == "circular":
            at = at.remainder(side)
        image = image.index_select(axis, at.clamp(0, side - 1))
        if border == "zero":
            shape = (-1, 1) if axis == -2 else (-1,)
            image = image * (~outside).to(image.dtype).view(shape)
    return image
