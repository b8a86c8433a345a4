r"""Distribution of a scene's power over depth and spatial frequency, in bins of defocus and octaves.

A texture and the dark area around it may lie at different depths, so the power of the whole image does not determine
the power blurred by one PSF. The power is therefore split by octave and by depth. Box averages over cells of
:math:`2^j` pixels split it into octaves: the difference between two levels, :math:`m_j^2 - m_{j+1}^2` summed over
cells, is the power after the filter

.. math:: K_j(f) = B_j(f) - B_{j+1}(f), \qquad B_j(f) = \prod_{x, y} \frac{\sin^2(\pi 2^j f)}{4^j \sin^2(\pi f)}

averaged over the positions of the cells. All :math:`K_j \ge 0`, and together with the last average they sum to one. The
averages are local, so the power of each octave can be assigned to the depths of the cells.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d, pad

from kornia_tidy.render.borders import cropped, extended

LEVELS = 5  # octaves from 2 px to 32; lower frequencies share one more
REACHES = (1, 3, 9)  # candidate spreads of a PSF, in cells; the one with the largest power counts
_REACH_CELL = 8  # px, the least size of these cells
_STRIP = 1 << 18  # px; larger images are processed in strips of rows
_OFFSET = 21  # px from a corner of a cell to that of the image: edges at round pixels then lie inside cells


def octave_filters(size: int, levels: int = LEVELS) -> Tensor:
    """Return the power responses of the octave filters, the finest first; they sum to one at each frequency.

    Args:
        size: side N of the frequency grid.
        levels: number of octaves; one more filter passes all lower frequencies.

    Returns:
        (levels + 1, N, N // 2 + 1) float64.

    Example:
        >>> filters = octave_filters(16)
        >>> filters.shape, bool((filters >= 0).all()), bool(torch.allclose(filters.sum(0), torch.ones(16, 9).double()))
        (torch.Size([6, 16, 9]), True, True)
    """
    down, across = torch.fft.fftfreq(size, dtype=torch.float64), torch.fft.rfftfreq(size, dtype=torch.float64)
    boxes = [torch.ones(size, len(across), dtype=torch.float64)]
    for level in range(levels):
        pair = [torch.cos(math.pi * 2**level * f).square() for f in (down, across)]
        boxes.append(boxes[-1] * pair[0][:, None] * pair[1])
    return torch.stack([*(a - b for a, b in pairwise(boxes)), boxes[-1]])


class Depths:
    """Depths of a scene in bins of defocus, with its padded pixels in cells.

    Args:
        defocus: (B, 1, H, W) or (1, 1, H, W) radians.
        lo: least defocus of the camera; values below are clamped.
        hi: largest defocus of the camera; values above are clamped.
        border: continuation of the image beyond its edges, see :mod:`kornia_tidy.render.borders`.
        margin: pixels at each side of the image that the capture does not show.
        bins: how many there may be.

    Attributes:
        psi: (b,) float64, the mean defocus of each bin that is not empty, ascending.
        share: (b,) the share of the pixels in it.
        seen: the share of the image that the capture shows.
    """

    def __init__(self, defocus: Tensor, lo: float, hi: float, border: str, margin: int = 0, bins: int = 256) -> None:
        at = defocus.detach().double().cpu().clamp(lo, hi)
        low, high = float(at.min()), float(at.max())
        index = ((at - low) * (bins / max(high - low, 1e-9))).long().clamp(max=bins - 1)
        count = torch.bincount(index.flatten(), minlength=bins)
        sums = torch.bincount(index.flatten(), at.flatten(), minlength=bins)
        full = count > 0
        self.psi, self.share = sums[full] / count[full], count[full].double() / at.numel()
        self._index = (full.cumsum(0) - 1)[index]
        self._border = "reflect" if border == "valid" else border
        self._rows, self._columns = (_whole_cells(side) for side in defocus.shape[-2:])
        whole = torch.ones(1, 1, *defocus.shape[-2:])
        inner = pad(cropped(whole, margin), (margin,) * 4)  # the capture
        self.seen = float(inner.mean())
        self._image, self._shown = (extended(each, self._rows, self._columns, "zero") for each in (whole, inner))

    def _laid_out(self, plane: Tensor) -> Tensor:
        """Return planes (B, C, H, W) padded by the border mode to whole cells of the largest size."""
        return extended(plane, self._rows, self._columns, self._border)

    def _labels(self, batch: int, foremost: bool = False) -> Tensor:
        """Return one more than the bin of each pixel of the padded planes, (B, 1, H', W'); outside, zero."""
        index = max_pool2d(self._index.double(), 3, 1, 1).long() if foremost else self._index
        return self._laid_out(index + 1).expand(batch, -1, -1, -1)

    def shares(self, light: Tensor) -> Tensor:
        r"""Return the share of each octave's power within reach of the pixels at each depth, for gather.

        A pixel collects light within the reach of its PSF. The power is therefore spread over several distances, from
        none to some tens of pixels, and for each depth the largest result counts. The shares of an octave sum to one or
        more, and no share is larger than one.

        Args:
            light: (B, C, H, W).

        Returns:
            (C, levels + 1, b) float64.
        """
        light = light.detach().cpu()
        mean = light.mean((-2, -1), keepdim=True)
        averages = self._laid_out(light) - mean
        labels = torch.where(self._shown > 0, self._labels(len(light)), 0).flatten()
        alone = self._largest(averages.square(), 1, labels, (1,))  # a single point of light is part of all octaves
        octaves = []
        for level in range(LEVELS + 1):
            squares = averages.square()
            if level < LEVELS:
                coarser = avg_pool2d(averages, 2)
                squares, averages = avg_pool2d(squares, 2) - coarser.square(), coarser
            side = 2 ** min(level + 1, LEVELS)
            octaves.append(torch.maximum(alone, self._largest(squares.clamp(min=0), side, labels)))
        return torch.stack(octaves, 1)

    def _largest(self, squares: Tensor, side: int, labels: Tensor, reaches: Sequence[int] = REACHES) -> Tensor:
        """Return the largest share of each bin in the power over all reaches, (C, b), for cells of a given side."""
        inside = avg_pool2d(self._image, side)
        total = (squares * inside).sum((0, 2, 3)).double()[:, None]
        count = len(self.psi)
        largest = torch.zeros(squares.shape[1], count, dtype=torch.float64)
        for reach in reaches:
            own, cell = squares, side
            if reach > 1:
                if side < _REACH_CELL:
                    own, cell = avg_pool2d(own, _REACH_CELL // side), _REACH_CELL
                own = avg_pool2d(own, reach, 1, reach // 2, count_include_pad=False)
            spread = own.repeat_interleave(cell, -2).repeat_interleave(cell, -1).transpose(0, 1).flatten(1)
            sums = spread.new_zeros(count + 1, len(spread)).index_add_(0, labels, spread.T).T[:, 1:]
            largest = torch.maximum(largest, sums.double() / side**2 / total)
        return torch.where(total > 0, largest.clamp(max=1), self.share)

    def means(self, light: Tensor) -> Tensor:
        """Return the sum of the light at each depth divided by the number of pixels, (C, b) float64."""
        planes = light.detach().cpu().transpose(0, 1).flatten(1).double()
        labels = self._index.expand(len(light), -1, -1, -1).flatten()
        return planes.new_zeros(len(planes), len(self.psi)).index_add_(1, labels, planes) / planes.shape[1]

    def products(self, light: Tensor, foremost: bool = False) -> Tensor:
        """Return the inner products of the light at two depths in each octave, for scatter.

        The light of one depth, black elsewhere, has outlines that the image lacks. For depths with similar PSFs they
        cancel those of the next depth. The sum over both depths is the power of the image.

        Args:
            light: (B, C, H, W).
            foremost: whether a pixel's light is given to the nearest depth among its neighbours, as light that shines
                through a gap has the blur of the gap.

        Returns:
            (C, levels + 1, b, b) float64, a mean over pixels; of the last octave less that of the means.
        """
        light = light.detach().double().cpu()
        planes = self._laid_out(light).transpose(0, 1)
        labels = self._labels(len(light), foremost)[:, 0]
        inside = (labels[:1, None] > 0).double()
        covered = avg_pool2d(inside, 2**LEVELS)[0]
        drawn_out = self._border == "replicate"  # the replicated border adds to the light of the image
        pixels = len(light) * float((self._image if drawn_out else inside).sum())
        rows = 2**LEVELS * max(1, _STRIP // (2**LEVELS * labels.shape[0] * labels.shape[-1]))
        products = []
        for plane in planes:
            strips = [
                _products_of_cells(*strip, len(self.psi))
                for strip in zip(plane.split(rows, 1), labels.split(rows, 1), strict=True)
            ]
            levels = torch.stack([levels for levels, _ in strips]).sum(0)
            cells = torch.cat([cells for _, cells in strips], 1)
            slow = (cells - covered[..., None] * cells.sum((1, 2), keepdim=True) / covered.sum()).flatten(0, 2)
            levels = torch.cat([-levels.diff(dim=0), (slow.T @ slow)[None] / 4**LEVELS])
            products.append(levels / pixels)
        return torch.stack(products)


def brightest_around(light: Tensor) -> Tensor:
    """Return the brightest mean over cells of 8 x 8 pixels near each pixel, (B, C, H, W).

    Example:
        >>> star = torch.zeros(1, 1, 64, 64)
        >>> star[..., 20, 20] = 64
        >>> brightest_around(star)[0, 0, 30, ::15].tolist()
        [0.0, 1.0, 1.0, 0.0, 0.0]
    """
    side = _REACH_CELL
    height, width = light.shape[-2:]
    cells = max_pool2d(avg_pool2d(light, side, ceil_mode=True, count_include_pad=False), 3, 1, 1)
    return cells.repeat_interleave(side, -2)[..., :height, :].repeat_interleave(side, -1)[..., :width]


def _whole_cells(side: int) -> tuple[int, int]:
    """Return the first row of the padded planes, and the one beyond the last."""
    return -_OFFSET, 2**LEVELS * math.ceil((side + _OFFSET) / 2**LEVELS) - _OFFSET


def _products_of_cells(plane: Tensor, labels: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return the inner products of cell sums at each level, (levels + 1, b, b), and the sums over the largest cells.

    Args:
        plane: (B, H', W') light.
        labels: the same of labels, from 1 to the count; outside, 0.
        count: number of bins b.
    """
    width, at = plane.shape[-1], labels.flatten().nonzero().flatten()
    where = at.numpy(), labels.flatten()[at].numpy() - 1
    cells, levels = csr_array((plane.flatten()[at].numpy(), where), (plane.numel(), count)), []
    for level in range(LEVELS + 1):
        if level:
            found = cells.tocoo()
            row, column = np.divmod(found.row, width)
            width //= 2
            cells = csr_array((found.data, (row // 2 * width + column // 2, found.col)), (cells.shape[0] // 4, count))
        levels.append(torch.from_numpy((cells.T @ cells).toarray()) / 4**level)
    largest = torch.from_numpy(cells.toarray()).view(len(plane), plane.shape[1] >> LEVELS, width, count)
    return torch.stack(levels), largest
