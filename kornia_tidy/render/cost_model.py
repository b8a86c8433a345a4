"""What rendering costs: counts of work go in, seconds come out.

A backend counts its work for a scene: blocks, pairs, strips, samples. The classes here turn such counts into the terms
that a :class:`~kornia_tidy.render.cost_profile.CostProfile` has a price for. Dispatcher and planner read the same
prices.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Protocol

from kornia_tidy.render.borders import next_fast_size
from kornia_tidy.render.cost_profile import CostProfile, Rates

# Bytes of a tile's planes in one channel, beyond which they leave the cache, or are fetched from the system each time.
TILE_CACHE, OCCLUSION_CACHE = 16 << 20, (64 << 20) // 3
WINDOW_CACHE = 1 << 20  # the same for one plane of a window that is transformed in C


class Work(Protocol):
    """Work of one backend for one scene."""

    @property
    def rates(self) -> str:
        """Name of the rates in a :class:`CostProfile` that price it."""
        ...

    @property
    def terms(self) -> tuple[float, ...]:
        """How much there is of each term of these rates."""
        ...


def seconds_of(work: Work, profile: CostProfile, threads: int = 1) -> float:
    """Return the time of some work on a machine, see :meth:`kornia_tidy.render.cost_profile.Rates.seconds`.

    Args:
        work: counts of a backend.
        profile: prices of the machine.
        threads: cores that share the work.

    Example:
        >>> from kornia_tidy.render.cost_profile import XEON
        >>> aloe = DirectWork(pixels=1110 * 1282, strips=29_650, psf_size=23, channels=3)
        >>> f"{1e3 * seconds_of(aloe, XEON):.0f} ms"
        '51 ms'
    """
    rates: Rates = getattr(profile, work.rates)
    return rates.seconds(work.terms, threads)


@dataclass(frozen=True)
class DirectWork:
    """Gather by direct convolution, see :mod:`kornia_tidy.render.backends.direct`.

    Args:
        pixels: of the output in one channel, over the batch.
        strips: pairs of a strip of 4 rows by 64 bytes and a layer present in it.
        psf_size: side P of the PSFs.
        channels: of the image.
        itemsize: bytes of a number. Vectors hold half as many of 8 bytes.
    """

    pixels: int
    strips: int
    psf_size: int
    channels: int = 1
    itemsize: int = 4
    rates: ClassVar[str] = "direct"

    @property
    def terms(self) -> tuple[float, ...]:
        """Strips take time by themselves, by the rows of a PSF and by its samples."""
        # Counted in strips of float64, there are twice as many already.
        each, numbers = self.channels * self.strips, self.channels * self.itemsize / 4
        return 1, numbers * self.pixels, each, each * self.psf_size, each * self.psf_size**2


@dataclass(frozen=True)
class TiledWork:
    """Gather or scatter by tiles, see :mod:`kornia_tidy.render.backends.tiled`.

    Args:
        size: side n of the tiles' windows in samples.
        blocks: pieces that the scene is cut into.
        pairs: blocks times the layers present in each.
        layers: layers present in the scene.
        pixels: of the output in one channel, over the batch.
        blended: layers that a pixel takes light from: 1 or 2.
        channels: of the image.
        itemsize: bytes of a number.
    """

    size: int
    blocks: int
    pairs: int
    layers: int
    pixels: int
    blended: int
    channels: int = 1
    itemsize: int = 4
    rates: ClassVar[str] = "tiled"

    @property
    def terms(self) -> tuple[float, ...]:
        """A block and a PSF are transformed once, a pair is transformed back."""
        each, samples = self.channels * self.itemsize / 4, self.size**2
        planes = 2 * self.itemsize * samples * self.pairs / max(1, self.blocks)
        return (
            1,
            each * self.pixels,
            each * self.pixels * self.blended,
            each * samples * 2 * math.log2(self.size) * (self.blocks + self.pairs + self.layers),
            each * samples * self.blocks,
            each * samples * self.pairs,
            each * samples * self.pairs * _spill(planes, TILE_CACHE),
            self.channels * self.pairs,
        )


@dataclass(frozen=True)
class OverlapWork(TiledWork):
    """Gather or scatter by overlapping windows in C, see :mod:`kornia_tidy.render.backends.overlap`.

    Its counts are those of :class:`TiledWork`; a block is a single tile.
    """

    rates: ClassVar[str] = "overlap"

    @property
    def terms(self) -> tuple[float, ...]:
        """A block and a PSF are transformed once, a pair is transformed back."""
        each, samples = self.channels * self.itemsize / 4, self.size**2
        transforms = samples * (self.blocks + self.pairs + self.layers)
        return (
            1,
            each * self.pixels,
            each * 2 * math.log2(self.size) * transforms,
            each * samples * self.blocks,
            each * samples * self.pairs,
            each * transforms * _spill(self.itemsize * samples, WINDOW_CACHE),
        )


@dataclass(frozen=True)
class DenseWork:
    """Gather or scatter by transforms of the whole plane, see :mod:`kornia_tidy.render.backends.dense`.

    Args:
        height: of the padded plane, in pixels.
        width: of the padded plane, in pixels.
        layers: layers present in the scene.
        pixels: of the output in one channel, over the batch.
        blended: layers that a pixel takes light from: 1 or 2.
        batch: images.
        channels: of the image.
        itemsize: bytes of a number.
    """

    height: int
    width: int
    layers: int
    pixels: int
    blended: int
    batch: int = 1
    channels: int = 1
    itemsize: int = 4
    rates: ClassVar[str] = "dense"

    @property
    def terms(self) -> tuple[float, ...]:
        """The image is transformed once; for each layer, its PSF and back."""
        each = self.channels * self.itemsize / 4
        samples, factors, odd = _transform(self.height, self.width)
        transforms = each * (self.batch + self.layers * (self.batch + 1)) * samples
        layers = each * self.layers
        return (
            1,
            each * self.pixels,
            transforms * factors,
            transforms * odd,
            layers * self.batch * samples,
            layers * self.pixels * self.blended,
        )


@dataclass(frozen=True)
class DirectOcclusionWork:
    """Occlusion by direct convolution, see :mod:`kornia_tidy.render.backends.direct_occlusion`.

    Args:
        pixels: of the output in one channel, over the batch.
        alone: pairs of blocks whose window is all of one layer; in float64 blocks are half as wide.
        pairs: pairs of another block and a layer present in its window.
        columns: columns of PSFs that meet a row of light, or of shared weights.
        edges: where runs of whole weights begin and end.
        psf_size: side P of the PSFs.
        layers: PSFs, present or not.
        channels: of the image.
        itemsize: bytes of a number.
    """

    pixels: int
    alone: int
    pairs: int
    columns: int
    edges: int
    psf_size: int
    layers: int = 0
    channels: int = 1
    itemsize: int = 4
    rates: ClassVar[str] = "occlusion_direct"

    @property
    def terms(self) -> tuple[float, ...]:
        """Blocks of one layer are convolved whole, others where a layer is."""
        each, samples = self.channels, self.psf_size**2
        return (
            1,
            each * self.pixels * self.itemsize / 4,
            each * self.alone,
            each * self.alone * samples,
            each * self.pairs,
            each * self.pairs * self.psf_size,
            each * self.columns,
            each * self.edges,
            each * self.layers * samples,
        )


@dataclass(frozen=True)
class TiledOcclusionWork:
    """Occlusion by tiles, computed in float64, see :mod:`kornia_tidy.render.backends.tiled_occlusion`.

    Args:
        size: side n of the windows in samples.
        windows: how many windows hold 0, 1, 2, ... layers. Those of one layer are computed in the image's precision.
        pixels: of the output in one channel, over the batch.
        channels: of the image.
    """

    size: int
    windows: tuple[int, ...]
    pixels: int = 0
    channels: int = 1
    rates: ClassVar[str] = "occlusion_tiled"

    @property
    def terms(self) -> tuple[float, ...]:
        """A layer takes one plane, between two others a second one."""
        samples = self.channels * self.size**2
        several = list(enumerate(self.windows))[2:]
        held = sum(layers * count for layers, count in several)
        large = sum(layers * count * _spill(16 * self.size**2 * layers, OCCLUSION_CACHE) for layers, count in several)
        alone = sum(self.windows[:2])
        return (
            1,
            self.channels * self.pixels,
            samples * alone,
            samples * held,
            samples * (held - 2 * sum(count for _, count in several)),
            samples * large,
            self.channels * (alone + held),
        )


@dataclass(frozen=True)
class DenseOcclusionWork:
    """Occlusion by transforms of the whole plane, see :mod:`kornia_tidy.render.backends.dense_occlusion`.

    Args:
        height: of the padded plane, in pixels.
        width: of the padded plane, in pixels.
        layers: layers present in the scene.
        pixels: of the output in one channel, over the batch.
        batch: images.
        channels: of the image.
    """

    height: int
    width: int
    layers: int
    pixels: int
    batch: int = 1
    channels: int = 1
    rates: ClassVar[str] = "occlusion_dense"

    @property
    def terms(self) -> tuple[float, ...]:
        """For each layer, the spectra of its light, two weights and its PSF; and three products back."""
        samples, factors, odd = _transform(self.height, self.width)
        planes = self.layers * (self.channels + self.batch * (4 * self.channels + 2)) * samples
        layers = self.channels * self.layers
        return (
            1,
            self.channels * self.pixels,
            planes * factors,
            planes * odd,
            layers * self.batch * samples,
            layers * self.pixels,
        )


@dataclass(frozen=True)
class BankWork:
    """PSFs of a bank, see :mod:`kornia_tidy.psf.propagation`.

    Args:
        products: operations of matrix products.
        intensities: operations of the mutual intensity in C.
        double: whether in float64, where an operation counts twice.
    """

    products: float
    intensities: float
    double: bool = False
    rates: ClassVar[str] = "bank"

    @property
    def terms(self) -> tuple[float, ...]:
        """The operations of either precision."""
        if self.double:
            return 1, 0, 2 * self.products, 0, 2 * self.intensities
        return 1, self.products, 0, self.intensities, 0


def _transform(height: int, width: int) -> tuple[int, float, float]:
    """Return the samples of a plane's transform, the factors of two of their number, and those along odd sides."""
    sides = next_fast_size(height), next_fast_size(width)
    return math.prod(sides), sum(map(math.log2, sides)), sum(math.log2(side) for side in sides if side % 2)


def _spill(planes: float, cache: int) -> float:
    """Return how far planes of some bytes exceed a cache, in factors of two; near 0 where they do not."""
    return math.log2(1 + planes / cache)
