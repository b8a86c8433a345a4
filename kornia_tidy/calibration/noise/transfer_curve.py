"""Points of the photon-transfer curve: the variance of counts over their level, where nothing but noise varies.

A picture, or the difference of two of the same thing, is cut into small blocks. Each place of the filter array's tile
is a plane of its own, so nothing is interpolated. A block's residuals r about a fitted plane are noise alone unless the
scene has texture there, and texture shows in what noise cannot have: neighbours that are alike, within a plane and from
one plane to the next. Blocks are judged by such correlations of r / |r| only. For Gaussian noise r / |r| and |r|² are
independent (Basu's theorem), so that what is left out leaves the variance of what is kept unbiased.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from kornia_tidy.raw.capture import RawCapture
from kornia_tidy.raw.filter_array import tile_planes

MOST_LEVELS = 32  # intervals of level, a channel
FEWEST_BLOCKS = 30  # in an interval, whose variance is then known to 4 %
CLIPPED_BLOCKS = 0.02  # share of an interval's blocks from which on all of it is left out: the rest is a selection
LEAST_SHARE = 0.1  # of an interval's blocks without texture; where there are fewer, these have some that was not seen
# Correlations, between planes and to the neighbours, in standard deviations from what white noise has. Scenes are
# mostly alike, fine weaves may be the opposite. One block of white noise in eight is left out.
LEAST_ALIKE, MOST_ALIKE = -2.3, 1.6


@dataclass(frozen=True)
class CurvePoint:
    """One point of a photon-transfer curve.

    Attributes:
        channel: letter of the color, or ``"L"`` for a sensor without colors.
        level: mean count over black.
        variance: of the noise, counts squared.
        samples: degrees of freedom behind the variance.
    """

    channel: str
    level: float
    variance: float
    samples: int


def temporal_points(frames: Sequence[RawCapture], black: Tensor | None = None) -> list[CurvePoint]:
    r"""Return the curve's points from two or more captures of the same thing under the same light.

    The scene and the sensor's fixed pattern cancel in differences. Of N frames these are the N - 1 contrasts

    .. math:: d_k = \frac{x_1 + \dots + x_k - k \, x_{k+1}}{\sqrt{k (k + 1)}},

    independent of one another and each of one frame's variance; for two frames it is :math:`(x_1 - x_2) / \sqrt 2`.

    Args:
        frames: captures of one camera, two or more.
        black: what to take for black instead of the first frame's.

    Returns:
        Points, one for each channel and interval of level.

    Convention:
        Light that drifts between frames changes a block's mean and slope only, which are not noise.

    Source: EMVA Standard 1288, 4.0, section 6.5, for two frames.
    """
    total = torch.zeros_like(_planes(frames[0], black))
    clipped = torch.zeros_like(_blocks(total, _side(frames[0]))[..., 0], dtype=torch.bool)
    contrasts = []
    for k, frame in enumerate(frames):
        planes = _planes(frame, black)
        clipped |= _clipped_blocks(frame)
        if k:
            contrasts.append((total - k * planes) / (k * (k + 1)) ** 0.5)
        total += planes
    level = total / len(frames)
    return _points(frames[0], level, contrasts, clipped, robust=False)


def spatial_points(raw: RawCapture, black: Tensor | None = None) -> list[CurvePoint]:
    """Return the curve's points from a single capture of any scene with some smooth areas of different brightness.

    Args:
        raw: the capture.
        black: what to take for black instead of the capture's.

    Returns:
        Points, one for each channel and interval of level; few or none where texture is everywhere, or where the file
        holds no raw noise (smoothed, or interpolated).

    Convention:
        Variance holds the sensor's fixed pattern too, which grows as the square of the level.
    """
    level = _planes(raw, black)
    return _points(raw, level, [level], _clipped_blocks(raw), robust=True)


def tile_of(raw: RawCapture) -> tuple[int, int]:
    """Return the tile whose places are planes of their own: the filter array's, 2x2 without one."""
    return (2, 2) if raw.pattern is None else raw.tile


def black_planes(raw: RawCapture, black: Tensor | None = None) -> Tensor:
    """Return black of each plane of :func:`tile_of`, (planes, 1, 1) float64."""
    own = (raw.black if black is None else black).double().cpu()
    places = own.flatten() if raw.pattern is not None else own.flatten().repeat_interleave(4)
    return places[:, None, None]


# ---------------------------------------------------------------------- inside


def _planes(raw: RawCapture, black: Tensor | None) -> Tensor:
    return tile_planes(raw.counts.cpu(), tile_of(raw)).double() - black_planes(raw, black)


def _side(raw: RawCapture) -> int:
    """Side of a block in a plane: 16 pixels of a Bayer sensor, 24 of X-Trans."""
    return 8 if max(tile_of(raw)) == 2 else 4


def _blocks(planes: Tensor, side: int) -> Tensor:
    """(P, H, W) to (P, blocks, side * side)."""
    rows, columns = planes.shape[-2] // side, planes.shape[-1] // side
    whole = planes[:, : rows * side, : columns * side].reshape(len(planes), rows, side, columns, side)
    return whole.transpose(2, 3).reshape(len(planes), rows * columns, side * side)


def _clipped_blocks(raw: RawCapture) -> Tensor:
    """Tell which blocks (P, blocks) hold a count at either end of what the converter, or the sensor, reports."""
    low, high = _rails(raw)
    counts = _blocks(tile_planes(raw.counts.cpu(), tile_of(raw)), _side(raw))
    return ((counts <= low) | (counts >= high)).any(-1)


def _rails(raw: RawCapture) -> tuple[float, float]:
    """Counts at which values pile up, whatever the file says: more than at the next one, and in 1e-4 of all pixels."""
    counts = raw.counts.flatten().cpu()
    values, sizes = torch.unique(counts, return_counts=True)
    many = 1e-4 * counts.numel()
    low, high = 0.0, raw.white
    if len(values) > 2:
        if sizes[0] > many and sizes[0] > 2 * sizes[1]:
            low = float(values[0])
        if sizes[-1] > many and sizes[-1] > 2 * sizes[-2]:
            high = min(high, float(values[-1]))
    return low, high


def _points(
    raw: RawCapture, level: Tensor, noises: Sequence[Tensor], clipped: Tensor, robust: bool
) -> list[CurvePoint]:
    """Points of planes (P, H, W) of noise, by their level; several of noise share one of level."""
    side = _side(raw)
    freedom = side * side - 3
    levels = _blocks(level, side).mean(-1)
    if levels.numel() == 0:
        return []
    judged = [_variance_and_whiteness(noise, side) for noise in noises]
    variance = torch.stack([v for v, _ in judged], dim=-1)  # (P, blocks, noises)
    white = torch.stack([w for _, w in judged], dim=-1)  # (blocks, noises)
    names = _channels(raw)
    points = []
    for name in dict.fromkeys(names):
        mine = [k for k, other in enumerate(names) if other == name]
        own_level, own_clipped = levels[mine].flatten(), clipped[mine].flatten()
        own_variance = variance[mine].flatten(0, 1)
        own_white = white.repeat(len(mine), 1)
        interval = _intervals(own_level, own_variance[:, 0], side)
        for k in interval.unique():
            here = interval == k
            if own_clipped[here].double().mean() > CLIPPED_BLOCKS:
                continue
            here &= ~own_clipped
            values = own_variance[here][own_white[here]]
            if len(values) < max(FEWEST_BLOCKS, LEAST_SHARE * int(here.sum()) * robust):
                continue
            seen = own_level[here][own_white[here].any(-1)]
            center = _median_variance(values, freedom) if robust else _mean_variance(values)
            points.append(CurvePoint(name, float(seen.mean()), center, freedom * len(values)))
    return points


def _intervals(level: Tensor, variance: Tensor, side: int) -> Tensor:
    """Number the interval of each block's level. They are even in its root, as shot noise is.

    They are wider than the uncertainty of a level: sorted by its own noise, the same light would look like several.
    """
    top = max(float(level.max()), 1e-9)
    faint, strong = (float(variance.quantile(q)) ** 0.5 / side for q in (0.05, 0.95))  # uncertainty of the levels
    count = int(min(max(top / (3 * strong + 1e-9), 1), MOST_LEVELS))
    shift = (2 * count * faint) ** 2 / top
    root = (level.clamp(min=0) + shift).sqrt() - shift**0.5
    return (root * (count / max(float(root.max()), 1e-9))).long().clamp(max=count - 1)


def _variance_and_whiteness(noise: Tensor, side: int) -> tuple[Tensor, Tensor]:
    """Variance (P, blocks) about a plane fitted to each block, and which places look like noise (blocks,)."""
    ramp = torch.arange(side, dtype=noise.dtype) - (side - 1) / 2
    ones = torch.ones_like(ramp)
    basis = torch.stack([torch.outer(a, b).flatten() for a, b in ((ones, ones), (ones, ramp), (ramp, ones))])
    basis = basis / basis.norm(dim=-1, keepdim=True)
    together, alike, variances = torch.zeros(()), torch.zeros(()), []
    for plane in noise:  # one at a time, as a picture of 20 million pixels makes large blocks
        blocks = _blocks(plane[None], side)[0]
        rest = blocks - (blocks @ basis.T) @ basis
        energy = rest.square().sum(-1)
        variances.append(energy / (side * side - 3))
        unit = (rest / energy.clamp(min=1e-12).sqrt()[:, None]).unflatten(-1, (side, side))
        together = together + unit
        right = (unit[..., 1:] * unit[..., :-1]).sum((-2, -1))
        below = (unit[:, 1:] * unit[:, :-1]).sum((-2, -1))
        alike = alike + right + below
    count = len(noise)
    between = (together.square().sum((-2, -1)) - count) / (count * (count - 1))  # mean over pairs of planes
    mean, deviation = _neighbors_of_noise(basis)
    white = torch.ones_like(between, dtype=torch.bool)
    for off in (
        between / (2 / ((side * side - 3) * count * (count - 1))) ** 0.5,
        (alike / count - mean) / (deviation / count**0.5),
    ):
        white &= (off > LEAST_ALIKE) & (off < MOST_ALIKE)
    return torch.stack(variances), white


def _neighbors_of_noise(basis: Tensor) -> tuple[float, float]:
    """Mean and standard deviation of white noise's correlation with its neighbours right and below, in a block.

    Of r = x - (its part in the basis), the correlation is r' A r / |r|² with A the pairs of neighbours: a quadratic
    form on the sphere of k dimensions, of mean tr(A) / k and variance 2 (k tr(A²) - tr(A)²) / (k² (k + 2)).
    """
    cells = basis.shape[-1]
    side = int(cells**0.5)
    index = torch.arange(cells).reshape(side, side)
    pairs = torch.zeros(cells, cells, dtype=basis.dtype)
    for one, other in ((index[:, 1:], index[:, :-1]), (index[1:], index[:-1])):
        pairs[one.flatten(), other.flatten()] = 0.5
        pairs[other.flatten(), one.flatten()] = 0.5
    keep = torch.eye(cells, dtype=basis.dtype) - basis.T @ basis
    form, k = keep @ pairs @ keep, cells - len(basis)
    trace, square = float(form.trace()), float(form.square().sum())
    return trace / k, (2 * (k * square - trace**2) / (k**2 * (k + 2))) ** 0.5


def _median_variance(values: Tensor, freedom: int) -> float:
    """Variance whose chi-squared law has this median (Wilson and Hilferty's): texture not found pulls it little."""
    return float(values.median()) / (1 - 2 / (9 * freedom)) ** 3


def _mean_variance(values: Tensor) -> float:
    """Mean without outliers, for noise of any law (quantized, few electrons): cosmic rays, something that moved."""
    middle = values.median()
    spread = 1.4826 * (values - middle).abs().median()
    return float(values[values <= middle + 8 * spread + 1e-9].mean())


def _channels(raw: RawCapture) -> list[str]:
    """Name the channel of each plane; the two greens are one."""
    if raw.pattern is not None:
        return [raw.colors[index] for row in raw.pattern for index in row]
    return [name for name in raw.colors or "L" for _ in range(4)]
