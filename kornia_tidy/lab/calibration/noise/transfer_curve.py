"""Points of the photon-transfer curve: noise variance over mean level, measured in blocks without texture.

A picture, or the difference of two captures of the same scene, is cut into small blocks. Each position in the filter
array's tile gives one colour plane, so nothing is interpolated. A linear ramp is fitted to each block. Its residuals r
are noise alone unless the scene has texture there. Texture correlates neighbouring pixels and colour planes, and noise
does not, so blocks with such correlations are rejected. The test uses r / |r| only. For Gaussian noise r / |r| and
|r|² are independent (Basu's theorem), so the rejection does not bias the variance of the remaining blocks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from kornia_tidy.lab.raw.capture import RawCapture
from kornia_tidy.lab.raw.filter_array import tile_planes

MOST_LEVELS = 32  # intervals of level for each channel
FEWEST_BLOCKS = 30  # in an interval; they determine its variance to 4 %
CLIPPED_BLOCKS = 0.02  # with a larger fraction of clipped blocks an interval is rejected, as the others are a selection
LEAST_FRACTION = 0.1  # of an interval's blocks must pass; if fewer do, those have undetected texture too
# Accepted correlation, in standard deviations from that of white noise. Texture usually correlates positively, fine
# weaves negatively. One block of white noise in eight is rejected.
LEAST_CORRELATION, MOST_CORRELATION = -2.3, 1.6


@dataclass(frozen=True)
class CurvePoint:
    """One point of a photon-transfer curve.

    Attributes:
        channel: letter of the color, or ``"L"`` for a sensor without colors.
        level: mean count above black.
        variance: variance of the noise in counts squared.
        samples: degrees of freedom of the variance.
    """

    channel: str
    level: float
    variance: float
    samples: int


def temporal_points(frames: Sequence[RawCapture], black: Tensor | None = None) -> list[CurvePoint]:
    r"""Measure points of the photon-transfer curve from two or more captures of the same scene under the same light.

    The scene and the sensor's fixed pattern cancel in differences. N frames give the N - 1 contrasts

    .. math:: d_k = \frac{x_1 + \dots + x_k - k \, x_{k+1}}{\sqrt{k (k + 1)}},

    which are independent and have the variance of one frame. For two frames this is :math:`(x_1 - x_2) / \sqrt 2`.

    Args:
        frames: two or more captures of one camera.
        black: black level that replaces the one in the first frame's file.

    Returns:
        Points, one for each channel and interval of level.

    Convention:
        - Light that drifts between frames changes only the ramp fitted to a block, not the residuals.

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
    """Measure points of the photon-transfer curve from a single capture with smooth areas of different brightness.

    Args:
        raw: the capture.
        black: black level that replaces the one in the capture's file.

    Returns:
        Points, one for each channel and interval of level. There are few or none if texture is everywhere, or if the
        file has no raw noise because it was smoothed or interpolated.

    Convention:
        - The variance includes the sensor's fixed pattern, which grows as the square of the level.
    """
    level = _planes(raw, black)
    return _points(raw, level, [level], _clipped_blocks(raw), robust=True)


def tile_of(raw: RawCapture) -> tuple[int, int]:
    """Return the rows and columns of the tile that splits a capture into planes: the filter array's, else 2x2."""
    return (2, 2) if raw.pattern is None else raw.tile


def black_planes(raw: RawCapture, black: Tensor | None = None) -> Tensor:
    """Return the black level of each plane of :func:`tile_of`, (planes, 1, 1) float64."""
    levels = (raw.black if black is None else black).double().cpu().flatten()
    return (levels if raw.pattern is not None else levels.repeat_interleave(4))[:, None, None]


def _planes(raw: RawCapture, black: Tensor | None) -> Tensor:
    return tile_planes(raw.counts.cpu(), tile_of(raw)).double() - black_planes(raw, black)


def _side(raw: RawCapture) -> int:
    """Return the side of a block in pixels of a plane: 16 sensor pixels for Bayer arrays, 24 for X-Trans."""
    return 8 if max(tile_of(raw)) == 2 else 4


def _blocks(planes: Tensor, side: int) -> Tensor:
    """Cut planes into blocks, (P, H, W) to (P, blocks, side * side)."""
    rows, columns = planes.shape[-2] // side, planes.shape[-1] // side
    whole = planes[:, : rows * side, : columns * side].reshape(len(planes), rows, side, columns, side)
    return whole.transpose(2, 3).reshape(len(planes), rows * columns, side * side)


def _clipped_blocks(raw: RawCapture) -> Tensor:
    """Return which blocks have a clipped count, at black or at saturation, (P, blocks)."""
    low, high = _clipping_counts(raw)
    counts = _blocks(tile_planes(raw.counts.cpu(), tile_of(raw)), _side(raw))
    return ((counts <= low) | (counts >= high)).any(-1)


def _clipping_counts(raw: RawCapture) -> tuple[float, float]:
    """Return the lowest and highest count at which values are clipped, found in the histogram.

    An extreme count is a clipping count if it occurs in more than 1e-4 of all pixels, and more than twice as often as
    the next one. The file's levels may be wrong.
    """
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
    """Measure the curve's points from noise planes and their level plane.

    Args:
        raw: gives the filter array.
        level: mean level, (P, H, W).
        noises: planes of noise (P, H, W) that share this level.
        clipped: blocks with clipped counts, (P, blocks).
        robust: whether to take the median over blocks, as undetected texture requires, instead of a trimmed mean.
    """
    side = _side(raw)
    freedom = side * side - 3
    levels = _blocks(level, side).mean(-1)
    if levels.numel() == 0:
        return []
    tested = [_variance_and_whiteness(noise, side) for noise in noises]
    variance = torch.stack([v for v, _ in tested], dim=-1)  # (P, blocks, noises)
    white = torch.stack([w for _, w in tested], dim=-1)  # (blocks, noises)
    names = _channels(raw)
    points = []
    for name in dict.fromkeys(names):
        planes = [k for k, other in enumerate(names) if other == name]
        channel_level, channel_clipped = levels[planes].flatten(), clipped[planes].flatten()
        channel_variance = variance[planes].flatten(0, 1)
        channel_white = white.repeat(len(planes), 1)
        interval = _intervals(channel_level, channel_variance[:, 0], side)
        for k in interval.unique():
            inside = interval == k
            if channel_clipped[inside].double().mean() > CLIPPED_BLOCKS:
                continue
            inside &= ~channel_clipped
            values = channel_variance[inside][channel_white[inside]]
            if len(values) < max(FEWEST_BLOCKS, LEAST_FRACTION * int(inside.sum()) * robust):
                continue
            accepted = channel_level[inside][channel_white[inside].any(-1)]
            center = _median_variance(values, freedom) if robust else _mean_variance(values)
            points.append(CurvePoint(name, float(accepted.mean()), center, freedom * len(values)))
    return points


def _intervals(level: Tensor, variance: Tensor, side: int) -> Tensor:
    """Return the index of the level interval of each block; intervals are equal in the square root of the level.

    An interval is wider than the uncertainty of a block's level. Otherwise noise alone would sort blocks of the same
    level into several intervals.
    """
    top = max(float(level.max()), 1e-9)
    faint, strong = (float(variance.quantile(q)) ** 0.5 / side for q in (0.05, 0.95))  # uncertainty of the levels
    count = int(min(max(top / (3 * strong + 1e-9), 1), MOST_LEVELS))
    shift = (2 * count * faint) ** 2 / top
    root = (level.clamp(min=0) + shift).sqrt() - shift**0.5
    return (root * (count / max(float(root.max()), 1e-9))).long().clamp(max=count - 1)


def _variance_and_whiteness(noise: Tensor, side: int) -> tuple[Tensor, Tensor]:
    """Return the residual variance of each block, (P, blocks), and whether its residuals are white noise, (blocks,).

    The residuals are those of a linear ramp fitted to the block in each plane.
    """
    ramp = torch.arange(side, dtype=noise.dtype) - (side - 1) / 2
    ones = torch.ones_like(ramp)
    basis = torch.stack([torch.outer(a, b).flatten() for a, b in ((ones, ones), (ones, ramp), (ramp, ones))])
    basis = basis / basis.norm(dim=-1, keepdim=True)
    total, neighbours, variances = torch.zeros(()), torch.zeros(()), []
    for plane in noise:  # one at a time, to save memory with pictures of 20 million pixels
        blocks = _blocks(plane[None], side)[0]
        rest = blocks - (blocks @ basis.T) @ basis
        energy = rest.square().sum(-1)
        variances.append(energy / (side * side - 3))
        unit = (rest / energy.clamp(min=1e-12).sqrt()[:, None]).unflatten(-1, (side, side))
        total = total + unit
        right = (unit[..., 1:] * unit[..., :-1]).sum((-2, -1))
        below = (unit[:, 1:] * unit[:, :-1]).sum((-2, -1))
        neighbours = neighbours + right + below
    count = len(noise)
    between = (total.square().sum((-2, -1)) - count) / (count * (count - 1))  # mean over pairs of planes
    mean, deviation = _neighbor_correlation(basis)
    white = torch.ones_like(between, dtype=torch.bool)
    for correlation in (
        between / (2 / ((side * side - 3) * count * (count - 1))) ** 0.5,
        (neighbours / count - mean) / (deviation / count**0.5),
    ):
        white &= (correlation > LEAST_CORRELATION) & (correlation < MOST_CORRELATION)
    return torch.stack(variances), white


def _neighbor_correlation(basis: Tensor) -> tuple[float, float]:
    """Return mean and standard deviation of the correlation of neighbouring pixels, for white noise in a block.

    With r the residual of x after projection on the basis and A the matrix of neighbour pairs (right and below), the
    correlation is r' A r / |r|². This is a quadratic form on the sphere of k dimensions, of mean tr(A) / k and variance
    2 (k tr(A²) - tr(A)²) / (k² (k + 2)).
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
    """Return the variance from the median over blocks, by Wilson and Hilferty's median of the chi-squared distribution.

    A median is insensitive to blocks with undetected texture.
    """
    return float(values.median()) / (1 - 2 / (9 * freedom)) ** 3


def _mean_variance(values: Tensor) -> float:
    """Return the mean variance without outliers, such as cosmic rays or motion, for noise of any distribution."""
    middle = values.median()
    spread = 1.4826 * (values - middle).abs().median()
    return float(values[values <= middle + 8 * spread + 1e-9].mean())


def _channels(raw: RawCapture) -> list[str]:
    """Return the channel name of each plane; both greens have the same."""
    if raw.pattern is not None:
        return [raw.colors[index] for row in raw.pattern for index in row]
    return [name for name in raw.colors or "L" for _ in range(4)]
