"""Checks of captures from a real sensor: outliers are repaired, contradictions to the stated noise are reported."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

BEYOND = 6.0  # standard deviations of the noise beyond all neighbours
CONTRAST = 0.5  # of the range of the neighbours, beyond them: no lens draws a point so much sharper than its surround
ROWS = 256  # that are worked on together
BLOCK = 8  # px of a square in which noise is measured, and of JPEG's blocks
DARKEST_SQUARES = 0.05  # share of the squares of a light level: those of least variance show only noise
LEVELS = 16  # of light, at which noise is measured
FEWEST = 64  # squares of a level
LEAST_OF_EVEN = 0.499  # of the variance: median of the least twentieth of squares, counted on 62,500 of white noise
LARGEST = 2048  # px, side of the middle of a picture in which noise is measured
JPEG = 1.1  # least factor of blocks: 1.00 to 1.03 without compression, 1.27 and more at a quality of 92
JPEG_NOISE = 0.008  # of even noise: of .006, .008 and .01 the best for a quality of 92, four scenes of half A
FALLING = -0.2  # of the variance in the dark for full light: noise of light rises with it, in encoded pictures it falls
TWICE = 2.0  # a stated noise is doubted beyond this factor


class Repaired(NamedTuple):
    """A capture without outliers."""

    light: Tensor
    """(C, H, W)."""
    count: int
    """Pixels of a colour that were repaired."""


def repair_outliers(light: Tensor, noise: MeasuredNoise) -> Repaired:
    r"""Replace pixels that differ from all of their neighbours by more than noise does, such as hot and dead ones.

    A pixel is an outlier if it is beyond the largest or smallest of its eight neighbours by six standard deviations of
    the noise, and by half of the neighbours' range. The median of the neighbours takes its place. Borders are
    reflected.

    Args:
        light: (C, H, W) linear light, at least 2 x 2 pixels.
        noise: of the capture, such as :func:`measure_noise` finds.

    Example:
        >>> light = torch.full((1, 5, 5), 0.5)
        >>> light[0, 2, 2] = 1.0
        >>> repaired = repair_outliers(light, MeasuredNoise(1e-4, 0.0))
        >>> repaired.count, float(repaired.light.max())
        (1, 0.5)
    """
    height = light.shape[-2]
    whole, count = light, 0
    for top in range(0, height, ROWS):  # copies of a large picture would take too much memory
        rows = torch.arange(top - 1, min(top + ROWS, height) + 1).abs()
        rows = torch.where(rows < height, rows, 2 * height - 2 - rows)
        part = functional.pad(light[:, rows], (1, 1), "reflect")
        repaired, place = _repaired(part, noise)
        if len(place[0]):
            whole = light.clone() if whole is light else whole
            whole[:, top : top + ROWS][place] = repaired
            count += len(place[0])
    return Repaired(whole, count)


def _repaired(part: Tensor, noise: MeasuredNoise) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Return the values that take the place of outliers in rows with a border of one pixel, and their places."""
    height, width = part.shape[-2] - 2, part.shape[-1] - 2
    moves = [(down, across) for down in range(3) for across in range(3) if (down, across) != (1, 1)]
    around = [part[:, down : down + height, across : across + width] for down, across in moves]
    own = part[:, 1:-1, 1:-1]
    highest, lowest = around[0].clone(), around[0].clone()
    for other in around[1:]:
        torch.maximum(highest, other, out=highest)
        torch.minimum(lowest, other, out=lowest)
    deviation = (noise.dark + noise.rise * highest).clamp(min=0).sqrt()
    margin = torch.maximum(BEYOND * deviation, CONTRAST * (highest - lowest))
    place = ((own > highest + margin) | (own < lowest - margin)).nonzero(as_tuple=True)
    return torch.stack([other[place] for other in around]).median(0).values, place


class MeasuredNoise(NamedTuple):
    """The noise of a capture: its variance is ``dark + rise * light``."""

    dark: float
    rise: float

    def std(self, light: float) -> float:
        """Return the standard deviation at a level of light."""
        return math.sqrt(max(0.0, self.dark + self.rise * light))


def measure_noise(light: Tensor) -> MeasuredNoise | None:
    """Measure the noise of a capture by its most even places.

    In squares of 8 x 8 pixels the second difference along both axes leaves noise and little of a blurred scene. At each
    level of light the squares of least variance show only noise. A line through the levels is the model of the noise.

    Args:
        light: (C, H, W) linear light.

    Returns:
        The noise; None where the capture has fewer than 64 squares that are neither dark nor clipped.

    Source: Immerkaer, Fast noise variance estimation (CVIU 64(2), 1996), for the difference; Foi et al., Practical
    Poissonian-Gaussian noise modeling (TIP 2008), for the model.

    Example:
        >>> drawn = 0.5 + 0.01 * torch.randn(1, 256, 256, generator=torch.Generator().manual_seed(0))
        >>> round(measure_noise(drawn).std(0.5), 3)
        0.01
    """
    if min(light.shape[-2:]) < BLOCK + 2:
        return None
    mask = light.new_tensor([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]])[None, None]
    difference = functional.conv2d(light[:, None], mask) / 6
    squares = functional.avg_pool2d(difference.square(), BLOCK).flatten()
    inner = light[:, None, 1:-1, 1:-1]
    means = functional.avg_pool2d(inner, BLOCK).flatten()
    whole = functional.max_pool2d(inner, BLOCK).flatten() < 0.98
    dark = -functional.max_pool2d(-inner, BLOCK).flatten() <= 0
    squares, means = squares[whole & ~dark], means[whole & ~dark]
    if len(squares) < FEWEST:
        return None
    order = means.argsort()
    groups = order.tensor_split(max(1, min(LEVELS, len(order) // FEWEST)))
    levels, variances = [], []
    for group in groups:
        least = squares[group].sort().values[: max(4, round(DARKEST_SQUARES * len(group)))]
        levels.append(means[group].mean())
        variances.append(least.median() / LEAST_OF_EVEN)
    level, variance = torch.stack(levels).double(), torch.stack(variances).double()
    weight = 1 / variance.clamp(min=1e-12).square()
    rise = _slope(level, variance, weight)
    dark_variance = float(((variance - rise * level) * weight).sum() / weight.sum())
    if dark_variance < 0:
        rise, dark_variance = float((variance * level * weight).sum() / (level.square() * weight).sum()), 0.0
    return MeasuredNoise(dark_variance, rise)


def blockiness(light: Tensor) -> float:
    """Return the factor by which differences across the borders of 8 x 8 blocks exceed others, a trace of JPEG.

    Args:
        light: (C, H, W).

    Returns:
        The largest factor of the eight places at which blocks may begin along each axis, the smaller of both axes.

    Source: Wang, Sheikh and Bovik, No-reference perceptual quality assessment of JPEG compressed images (ICIP 2002).

    Example:
        >>> blocks = torch.rand(1, 8, 8, generator=torch.Generator().manual_seed(0))
        >>> blockiness(blocks.repeat_interleave(8, 1).repeat_interleave(8, 2)) > 100
        True
    """
    factors = []
    for axis in (-1, -2):
        second = light.diff(n=3, dim=axis).abs()  # larger at borders of blocks than in scenes
        lines = second.mean([d for d in range(light.ndim) if d != light.ndim + axis])
        usable = len(lines) // BLOCK * BLOCK
        if not usable:
            return 1.0
        phases = lines[:usable].view(-1, BLOCK).median(0).values.clamp(min=1e-9)
        factors.append(float(phases.max() / phases.median()))
    return min(factors)


def _slope(level: Tensor, variance: Tensor, weight: Tensor) -> float:
    """Return the slope of the weighted regression of variances on levels; 0 for a single level."""
    share = weight / weight.sum()
    apart = level - (share * level).sum()
    spread = (share * apart.square()).sum()
    return float((share * apart * variance).sum() / spread) if float(spread) > 1e-6 else 0.0


class CheckedCapture(NamedTuple):
    """A capture without outliers, with its noise and notes."""

    light: Tensor
    """(C, H, W)."""
    noise: MeasuredNoise | None
    """As it was measured; None for a small or clipped capture."""
    notes: tuple[str, ...]
    """Sentences, each with its remedy."""
    least_noise: float = 0.0
    """What a network should take the noise for at least, by its standard deviation: more than the sensor's for JPEG."""


def check_capture(light: Tensor, told: MeasuredNoise | None = None) -> CheckedCapture:
    """Repair the outliers of a capture, and compare its noise with the stated noise.

    Args:
        light: (C, H, W) linear light.
        told: the stated noise, with which the capture will be restored. None: nothing is compared.

    Example:
        >>> light = 0.5 + 0.01 * torch.randn(3, 128, 128, generator=torch.Generator().manual_seed(0))
        >>> check_capture(light, MeasuredNoise(1e-6, 0.0)).notes
        ('its noise is 0.01 of full scale, 10 times the stated noise: give noise=0.01',)
    """
    height, width = light.shape[-2:]
    top, left = max(0, (height - LARGEST) // 2), max(0, (width - LARGEST) // 2)
    middle = light[:, top : top + LARGEST, left : left + LARGEST]
    noise = measure_noise(middle)
    if noise is None:
        return CheckedCapture(light, None, ())
    notes = []
    repaired = repair_outliers(light, noise)
    if repaired.count:
        notes.append(f"{repaired.count} outliers, such as hot pixels, were replaced by their neighbours' median")
    level = float(middle.mean())
    found = noise.std(level)
    if told is not None and found > TWICE * told.std(level):
        factor = found / max(told.std(level), 1e-9)
        notes.append(
            f"its noise is {found:.2g} of full scale, {factor:.0f} times the stated noise: give noise={found:.2g}"
        )
    blocks = blockiness(middle) > JPEG
    if blocks:
        notes.append(f"it shows the blocks of JPEG, taken for a noise of {JPEG_NOISE}: rather restore the raw file")
    elif noise.rise < FALLING * noise.dark:
        notes.append(
            "its noise falls with light, as in pictures that are encoded or tone-mapped: give it as sRGB, or develop "
            "the raw file to linear light"
        )
    return CheckedCapture(repaired.light, noise, tuple(notes), JPEG_NOISE if blocks else 0.0)
