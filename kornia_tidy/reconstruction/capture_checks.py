"""Checks of captures from a real sensor: outliers are repaired, contradictions to the stated noise are reported."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from kornia_tidy.reconstruction.clipped_light import CLIPPED

BEYOND = 6.0  # standard deviations of the noise beyond all neighbours
CONTRAST = 0.5  # of the range of the neighbours, beyond them: few points of a scene are so much sharper than that
SHARED = 0.25  # of an outlier's excess, in another colour: a point of the scene has several, a hot pixel has one
SHARPER = 2.0  # than PSFs at the nodes of depth: a point between them
STUCK = 0.1  # least softness of a point at zero or full scale, where most hot and dead pixels are
ROWS = 256  # that are worked on together
BLOCK = 8  # px of a square in which noise is measured, and of JPEG's blocks
DARKEST_SQUARES = 0.05  # share of the squares of a light level: those of least variance show only noise
LEVELS = 16  # of light, at which noise is measured
FEWEST = 64  # squares of a level
HALF_NORMAL = 0.6745  # of a standard deviation: median of absolute values
LEAST_OF_EVEN = 0.499  # of the variance: median of the least twentieth of squares, counted on 62,500 of white noise
LARGEST = 2048  # px, side of the middle of a picture in which noise is measured
JPEG = 1.1  # least factor of blocks: 1.00 to 1.03 without compression, 1.27 and more at a quality of 92
QUIETER = 0.9  # of the stated noise: JPEG leaves up to .85 of it, undisturbed captures have .94 and more
JPEG_NOISE = 0.006  # of even noise: of .0045, .006 and .008 the best for a quality of 92, half A behind five cameras
FALLING = -0.2  # of the variance in the dark for full light: noise of light rises with it, in encoded pictures it falls
TWICE = 2.0  # a stated noise is doubted beyond this factor
SHORTEST = 64  # px of a row or column whose median is its level
SAMPLED = 512  # px of a row, whose median is its level
BANDS = 3.0  # a factor by which steps between rows exceed those between columns, or the reverse
FAINT_BAND = 0.15  # of the noise: weaker bands stay
OF_MEDIANS = 4.0  # of the noise, for the median of one pixel: 3 times its deviation
WHITE = 2.8  # least ratio of fourth to second differences: 3.4 for bands, and 1.4 for waves of five rows
LAW = 0.25  # standard deviation of the logarithm of variances over a sensor's law; .05 to .21 where it holds


class Repaired(NamedTuple):
    """A capture without outliers."""

    light: Tensor
    """(C, H, W)."""
    count: int
    """Pixels of a colour that were repaired."""


def repair_outliers(light: Tensor, noise: MeasuredNoise, softness: float = math.inf) -> Repaired:
    r"""Replace pixels that differ from all of their neighbours by more than noise does, such as hot and dead ones.

    A pixel is an outlier if it is beyond the largest or smallest of its eight neighbours by six standard deviations of
    the noise, and by half of the neighbours' range. What takes its place is half the sum of the four beside it less a
    quarter of that of the corners, exact where light is linear or quadratic along rows and columns, between the second
    lowest and the second highest of them. Borders are reflected. What two colours show, or the only one, is a point of
    the scene if it is as soft as the camera draws points, such as a star.

    Args:
        light: (C, H, W) linear light, at least 2 x 2 pixels.
        noise: of the capture, such as :func:`measure_noise` finds.
        softness: least of the camera's points, see :func:`least_softness`. Default: outliers are repaired in all
            colours.

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
        repaired, shared, place = _repaired(part, noise)
        color, row, column = place
        own = light[color, row + top, column]
        least = torch.where((own <= 0) | (own >= CLIPPED), max(softness, STUCK), softness / SHARPER)
        hot = ~shared | (_softness(light, color, row + top, column) < least)
        if hot.any():
            whole = light.clone() if whole is light else whole
            whole[color[hot], row[hot] + top, column[hot]] = repaired[hot]
            count += int(hot.sum())
    return Repaired(whole, count)


def least_softness(psfs: Tensor) -> float:
    """Return by how much the sharpest PSF raises the pixels around its peak, in parts of the peak.

    Args:
        psfs: (..., P, P).

    Example:
        >>> least_softness(torch.tensor([[0.0, 1.0, 0.0], [1.0, 4.0, 1.0], [0.0, 1.0, 0.0]]))
        0.125
    """
    padded = functional.pad(psfs.detach().reshape(-1, *psfs.shape[-2:]), (2, 2, 2, 2))
    sharpest = torch.unravel_index(padded.argmax(), padded.shape)
    return float(_softness(padded, *(index[None] for index in sharpest)))


def _softness(light: Tensor, color: Tensor, row: Tensor, column: Tensor) -> Tensor:
    """Return the mean of the eight pixels around each over the pixel itself, both beyond the sixteen around them."""
    steps = torch.arange(-2, 3, device=light.device)
    rows = (row[:, None, None] + steps[:, None]).clamp(0, light.shape[1] - 1)
    square = light[color[:, None, None], rows, (column[:, None, None] + steps).clamp(0, light.shape[2] - 1)]
    own, three, five = square[:, 2, 2], square[:, 1:4, 1:4].sum((1, 2)), square.sum((1, 2))
    base = (five - three) / 16
    return ((three - own) / 8 - base) / (own - base)


def _repaired(part: Tensor, noise: MeasuredNoise) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
    """Return what takes the place of outliers in rows with a border of one pixel, which several colours show, where."""
    height, width = part.shape[-2] - 2, part.shape[-1] - 2
    moves = [(down, across) for down in range(3) for across in range(3) if (down, across) != (1, 1)]
    around = [part[:, down : down + height, across : across + width] for down, across in moves]
    own = part[:, 1:-1, 1:-1]
    highest, lowest = around[0].clone(), around[0].clone()
    for other in around[1:]:
        torch.maximum(highest, other, out=highest)
        torch.minimum(lowest, other, out=lowest)
    deviation = (noise.dark + noise.rise * highest).clamp(min=0).sqrt()
    beyond = torch.maximum(own - highest, lowest - own)
    place = (beyond > torch.maximum(BEYOND * deviation, CONTRAST * (highest - lowest))).nonzero(as_tuple=True)
    shared = (beyond[:, place[1], place[2]] > SHARED * beyond[place]).sum(0) >= min(2, len(part))
    found = torch.stack([other[place] for other in around])
    pairs = found[:4] + found[4:].flip(0)  # opposite neighbours, so that a picture that lies is repaired alike
    beside, corners = pairs[1] + pairs[3], pairs[0] + pairs[2]
    ordered = found.sort(0).values
    return ((2 * beside - corners) / 4).clamp(ordered[1], ordered[-2]), shared, place


class WithoutBands(NamedTuple):
    """A capture whose rows and columns have the same level as their neighbours."""

    light: Tensor
    """(C, H, W)."""
    size: float
    """Standard deviation of the levels of a sensor's bands; 0 for none."""
    rows: bool = True
    """Whether they are rows. False: columns."""


def repair_bands(light: Tensor, noise: float) -> WithoutBands:
    r"""Subtract the level by which each row, or each column, differs from its neighbours, where a sensor has bands.

    In the median along a row the second difference across rows shows its level, and little of a blurred scene: no more
    than that of the columns, unless the sensor adds bands. Those of stripes in a scene change less from row to row,
    since optics blur them, and stay. The levels l of second differences m are those of least
    :math:`|D^2 l - m|^2 / v + |l|^2 / b^2`, v the variance that the scene leaves, :math:`b^2` that of bands.

    Args:
        light: (C, H, W) linear light. It stays as it is where a side is shorter than 64 pixels.
        noise: standard deviation of its noise.

    Example:
        >>> light = 0.5 + 0.01 * torch.randn(3, 64, 64, generator=torch.Generator().manual_seed(0))
        >>> light[:, ::2] += 0.02
        >>> repaired = repair_bands(light, 0.01)
        >>> round(repaired.size, 2), bool((repaired.light[:, ::2].mean() - repaired.light[:, 1::2].mean()).abs() < 1e-3)
        (0.02, True)
    """
    if min(light.shape[-2:]) < SHORTEST:
        return WithoutBands(light, 0.0)
    steps = [_steps(part) for part in (light, light.transpose(1, 2))]
    spreads = [_spread(step) for step in steps]
    size = math.sqrt(abs(spreads[0] ** 2 - spreads[1] ** 2) / 6)
    rows = spreads[0] > spreads[1]
    along, across = (steps[0], steps[1]) if rows else (steps[1], steps[0])
    least = max(FAINT_BAND, OF_MEDIANS / math.sqrt(min(len(across), SAMPLED))) * noise
    if max(spreads) <= BANDS * min(spreads) or size <= least or _spread(along.diff(n=2)) < WHITE * max(spreads):
        return WithoutBands(light, 0.0)
    levels = _levels(along, max(min(spreads) ** 2 / size**2, 1e-3))
    known = light < CLIPPED
    return WithoutBands(torch.where(known, light - (levels[:, None] if rows else levels), light), size, rows)


def _steps(light: Tensor) -> Tensor:
    """Return the median of second differences across rows along each, (H,); borders are repeated."""
    some = light[..., :: max(1, light.shape[-1] // SAMPLED)]
    padded = torch.cat([some[:, :1], some, some[:, -1:]], 1)
    return padded.diff(n=2, dim=1).transpose(0, 1).flatten(1).nanmedian(1).values


def _spread(values: Tensor) -> float:
    """Return the standard deviation of normal values, by the median of their sizes."""
    return float(values.abs().median()) / HALF_NORMAL


def _levels(steps: Tensor, doubt: float) -> Tensor:
    """Return levels of least squares from their second differences, with mirrored borders."""
    mirrored = torch.cat([steps, steps.flip(0)]).double()
    response = 2 * (2 * math.pi * torch.fft.rfftfreq(len(mirrored), device=steps.device)).cos() - 2
    spectrum = torch.fft.rfft(mirrored) * response / (response.square() + doubt)
    return torch.fft.irfft(spectrum, n=len(mirrored))[: len(steps)].to(steps)


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
    found = _variances(light)
    if found is None:
        return None
    level, variance = found
    weight = 1 / variance.clamp(min=1e-12).square()
    rise = _slope(level, variance, weight)
    dark_variance = float(((variance - rise * level) * weight).sum() / weight.sum())
    if dark_variance < 0:
        rise, dark_variance = float((variance * level * weight).sum() / (level.square() * weight).sum()), 0.0
    return MeasuredNoise(dark_variance, rise)


def _variances(light: Tensor) -> tuple[Tensor, Tensor] | None:
    """Return levels of light, ascending, and the variance of noise at each."""
    if min(light.shape[-2:]) < BLOCK + 2:
        return None
    difference = light[:, None].diff(n=2, dim=-1).diff(n=2, dim=-2)
    squares = functional.avg_pool2d(difference.square(), BLOCK).flatten() / 36
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
    return torch.stack(levels).double(), torch.stack(variances).double()


def _off_the_law(light: Tensor, law: MeasuredNoise) -> float:
    """Return the standard deviation of the logarithm of variances over those of a sensor's law."""
    found = _variances(light)
    if found is None or len(found[0]) < LEVELS:
        return 0.0
    level, variance = found
    expected = (law.dark + law.rise * level).clamp(min=1e-12)
    return float((variance.clamp(min=1e-12) / expected).log().std())


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


def check_capture(light: Tensor, told: MeasuredNoise | None = None, softness: float = math.inf) -> CheckedCapture:
    """Repair the outliers of a capture, and compare its noise with the stated noise.

    Args:
        light: (C, H, W) linear light.
        told: the stated noise, with which the capture will be restored. Outliers exceed both it and the measured one.
            None: nothing is compared.
        softness: see :func:`repair_outliers`.

    Example:
        >>> light = 0.5 + 0.01 * torch.randn(3, 128, 128, generator=torch.Generator().manual_seed(0))
        >>> check_capture(light, MeasuredNoise(1e-6, 0.0)).notes
        ('its noise is 0.01 of full scale, 10 times the stated noise: --noise 0.01 or SensorNoise(0.01)',)
    """
    height, width = light.shape[-2:]
    top, left = max(0, (height - LARGEST) // 2), max(0, (width - LARGEST) // 2)
    middle = light[:, top : top + LARGEST, left : left + LARGEST]
    noise = measure_noise(middle)
    if noise is None:
        return CheckedCapture(light, None, ())
    notes = []
    level = float(middle.nanmedian())  # among the levels at which it was measured, also where few pixels have light
    found = noise.std(level)
    most = noise if told is None else MeasuredNoise(*map(max, noise, told))  # JPEG shows less than the sensor's
    repaired = repair_outliers(light, most, softness)
    if repaired.count:
        notes.append(f"{repaired.count} outliers, such as hot pixels, were replaced from their neighbours")
    even = repair_bands(repaired.light, found)
    if even.size:
        bands = "rows" if even.rows else "columns"
        notes.append(
            f"its {bands} differed by {even.size:.2g} of full scale, and were levelled: subtract a dark capture"
        )
    middle = even.light[:, top : top + LARGEST, left : left + LARGEST]
    if told is not None and found > TWICE * told.std(level):
        factor = found / max(told.std(level), 1e-9)
        notes.append(
            f"its noise is {found:.2g} of full scale, {factor:.0f} times the stated noise: "
            f"--noise {found:.2g} or SensorNoise({found:.2g})"
        )
    stated = found if told is None else told.std(level)
    quieter = found < QUIETER * stated or math.isclose(found, stated, rel_tol=1e-3)  # or measured in this capture
    blocks = quieter and blockiness(middle) > JPEG  # else the scene has blocks
    if blocks:
        notes.append(f"it shows the blocks of JPEG, taken for a noise of {JPEG_NOISE}: rather restore the raw file")
    elif noise.rise < FALLING * noise.dark:
        notes.append(
            "its noise falls with light, as in pictures that are encoded or tone-mapped: give it as sRGB (without "
            "--linear, or linear=False), or develop the raw file to linear light (kornia-tidy raw develop)"
        )
    elif _off_the_law(middle, told or noise) > LAW:
        notes.append(
            "its noise does not grow with light as a sensor's does, as behind a tone curve or a sensor of uneven "
            "pixels: develop the raw file to linear light (kornia-tidy raw develop), or divide by a flat field"
        )
    return CheckedCapture(even.light, noise, tuple(notes), JPEG_NOISE if blocks else 0.0)
