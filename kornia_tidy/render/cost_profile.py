"""The constants of the cost model: every time that was fitted to a machine, in one named profile.

A profile holds, for each backend, the nanoseconds of each kind of work on one core, and the share of the work that
threads divide. The formulas stand in :mod:`kornia_tidy.render.cost_model`. ``kornia-tidy tune`` fits a profile of the
user's machine, see :mod:`kornia_tidy.render.tuning`.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, fields, replace
from typing import Any, Self


@dataclass(frozen=True)
class Rates:
    """Nanoseconds of each term of a backend's work on one core.

    Subclasses name the terms; their first one is paid once a call and is not divided among threads.

    Args:
        shared: share of the work after the first term that threads divide among themselves, 0 to 1.
    """

    shared: float

    @property
    def nanoseconds(self) -> tuple[float, ...]:
        """The nanoseconds of the terms, in their order."""
        return astuple(self)[1:]

    def seconds(self, terms: Sequence[float], threads: int = 1) -> float:
        r"""Return the time of some work.

        .. math:: t = c_0 n_0 + \left( 1 - s + \frac{s}{T} \right) \sum_{k > 0} c_k n_k

        Args:
            terms: n, how much there is of each term.
            threads: T.

        Example:
            >>> f"{BankRates(1.0, 1e6, 0.5, 0.5, 0.25, 0.25).seconds((1, 2e6, 0, 0, 0), threads=2):.4f}"
            '0.0015'
        """
        once, *each = (rate * term for rate, term in zip(self.nanoseconds, terms, strict=True))
        return 1e-9 * (once + (1 - self.shared + self.shared / threads) * sum(each))

    def with_nanoseconds(self, nanoseconds: Sequence[float]) -> Self:
        """Return these rates with other nanoseconds."""
        return type(self)(self.shared, *nanoseconds)

    def scaled(self, factor: float) -> Self:
        """Return the rates of a machine that takes ``factor`` times as long for everything."""
        return self.with_nanoseconds([factor * rate for rate in self.nanoseconds])


@dataclass(frozen=True)
class DirectRates(Rates):
    """Direct convolution for gather.

    Args:
        call: once.
        pixel: a pixel of the output.
        strip: a pair of a strip of pixels and a layer in it,
        strip_row: times the PSF's side, and
        strip_sample: times the PSF's samples.
    """

    call: float
    pixel: float
    strip: float
    strip_row: float
    strip_sample: float


@dataclass(frozen=True)
class TiledRates(Rates):
    """Tiles for gather and scatter.

    Args:
        call: once.
        pixel: a pixel of the output, and
        blended: a layer that it takes light from.
        transform: a sample of a transform and a factor of two of its samples.
        block: a sample of a block: cut out of the image.
        pair: a sample of a pair of block and layer: multiplied by the PSF's spectrum.
        large: the same for each factor of two by which the planes of a block exceed the cache.
        step: a pair that is called for.
    """

    call: float
    pixel: float
    blended: float
    transform: float
    block: float
    pair: float
    large: float
    step: float


@dataclass(frozen=True)
class OverlapRates(Rates):
    """Overlapping windows in C for gather and scatter.

    Args:
        call: once.
        pixel: a pixel of the output.
        transform: a sample of a transform and a factor of two of its samples.
        tile: a sample of a window: cut out of the image, with its labels.
        pair: a sample of a pair of window and layer: multiplied by the PSF's spectrum, and added to the tile's sums.
        large: a sample of a transform for each factor of two by which a window's plane exceeds the cache.
    """

    call: float
    pixel: float
    transform: float
    tile: float
    pair: float
    large: float


@dataclass(frozen=True)
class DenseRates(Rates):
    """Transforms of the whole plane, for all kinds of compositing.

    Args:
        call: once.
        pixel: a pixel of the output.
        transform: a sample of a transform and a factor of two of its samples, and
        odd: more along a side with an odd number of samples.
        product: a sample of a layer: multiplied by its spectrum.
        blended: a pixel of a layer: picked or laid over.
    """

    call: float
    pixel: float
    transform: float
    odd: float
    product: float
    blended: float


@dataclass(frozen=True)
class DirectOcclusionRates(Rates):
    """Direct convolution for occlusion.

    Args:
        call: once.
        pixel: a pixel of the output.
        alone: a block whose window is all of one layer, and
        alone_sample: times the PSF's samples.
        pair: a pair of another block and a layer in its window, and
        pair_row: times the PSF's side.
        column: a column of a PSF that meets a row of light.
        edge: where a run of whole weights begins or ends.
        table: a sample of a PSF whose sums are tabulated.
    """

    call: float
    pixel: float
    alone: float
    alone_sample: float
    pair: float
    pair_row: float
    column: float
    edge: float
    table: float


@dataclass(frozen=True)
class TiledOcclusionRates(Rates):
    """Tiles for occlusion.

    Args:
        call: once.
        pixel: a pixel of the output.
        alone: a sample of a window of one layer.
        layer: a sample of a layer in another window.
        between: a sample of a layer between the nearest and the farthest of its window.
        large: a sample of such a layer for each factor of two by which the planes of a window exceed the cache.
        step: a layer of a window that is called for.
    """

    call: float
    pixel: float
    alone: float
    layer: float
    between: float
    large: float
    step: float


@dataclass(frozen=True)
class BankRates(Rates):
    """Operations of a PSF bank.

    Args:
        call: once.
        product: an operation of a matrix product in float32, and
        product_double: in float64.
        intensity: an operation of the mutual intensity in C in float32, and
        intensity_double: in float64.
    """

    call: float
    product: float
    product_double: float
    intensity: float
    intensity_double: float


@dataclass(frozen=True)
class CostProfile:
    """Times of one kind of machine.

    Args:
        name: what it is called.
        direct: gather by direct convolution.
        tiled: gather and scatter by tiles.
        overlap: gather and scatter by overlapping windows in C.
        dense: gather and scatter by transforms of the whole plane.
        occlusion_direct: occlusion by direct convolution.
        occlusion_tiled: occlusion by tiles.
        occlusion_dense: occlusion by transforms of the whole plane.
        bank: PSF banks.
    """

    name: str
    direct: DirectRates
    tiled: TiledRates
    overlap: OverlapRates
    dense: DenseRates
    occlusion_direct: DirectOcclusionRates
    occlusion_tiled: TiledOcclusionRates
    occlusion_dense: DenseRates
    bank: BankRates

    def scaled(self, name: str, factors: Mapping[str, float]) -> CostProfile:
        """Return a profile in which some backends take ``factors`` times as long."""
        return replace(self, name=name, **{key: getattr(self, key).scaled(factor) for key, factor in factors.items()})

    def as_json(self) -> dict[str, Any]:
        """Return the profile as numbers and words."""
        return asdict(self)

    @classmethod
    def from_json(cls, document: Any) -> CostProfile:
        """Return the profile that :meth:`as_json` described.

        Raises:
            ValueError: if the document is not one, or holds a number that cannot be a time.

        Example:
            >>> CostProfile.from_json(EPYC.as_json()) == EPYC
            True
        """
        if not isinstance(document, dict) or set(document) != {field.name for field in fields(cls)}:
            raise ValueError(f"a cost profile has the fields {', '.join(field.name for field in fields(cls))}")
        if not isinstance(document["name"], str):
            raise ValueError(f"the name of a cost profile must be a string, got {document['name']!r:.80}")
        rates: dict[str, Any] = {name: _rates(name, document[name]) for name in RATES}
        return cls(document["name"], **rates)


def _rates(name: str, numbers: Any) -> Rates:
    kind = RATES[name]
    names = [field.name for field in fields(kind)]
    if not isinstance(numbers, dict) or set(numbers) != set(names):
        raise ValueError(f"{name} of a cost profile has the numbers {', '.join(names)}")
    for key, number in numbers.items():
        usable = isinstance(number, (int, float)) and not isinstance(number, bool)
        if not usable or not 0 <= number <= (1 if key == "shared" else sys.float_info.max):  # integers may be larger
            raise ValueError(f"{name}.{key} of a cost profile must be a finite number from 0, got {number!r:.80}")
    return kind(**numbers)


RATES: dict[str, type[Rates]] = {
    "direct": DirectRates,
    "tiled": TiledRates,
    "overlap": OverlapRates,
    "dense": DenseRates,
    "occlusion_direct": DirectOcclusionRates,
    "occlusion_tiled": TiledOcclusionRates,
    "occlusion_dense": DenseRates,
    "bank": BankRates,
}

# One core of an idle 2.5 GHz Xeon. Dense rates, overlapping windows and large
# planes were not measured there: they are EPYC's, scaled.
XEON = CostProfile(
    name="xeon-2.5",
    direct=DirectRates(1.0, 0, 0, 70, 0, 0.95),
    tiled=TiledRates(0.5, 0, 0, 8.5, 0.099, 1.98, 1.65, 1.7, 2200),
    overlap=OverlapRates(0.9, 7e5, 1.5, 0.04, 1.4, 0.25, 0.12),
    dense=DenseRates(0.5, 9e4, 2.8, 0.13, 0.13, 0, 1.35),
    occlusion_direct=DirectOcclusionRates(1.0, 0, 0, 250, 3.7, 320, 3, 2.3, 12, 25),
    occlusion_tiled=TiledOcclusionRates(0.5, 0, 0, 6.9, 19.6, 8, 60, 15000),
    occlusion_dense=DenseRates(0.5, 0, 0, 0.36, 0.17, 0, 0),
    bank=BankRates(0.5, 0, 1 / 52, 1 / 57, 1 / 90, 1 / 115),
)

# One core of a 2.6 GHz EPYC (Zen 4), fitted to images of 256 to 1024 pixels, windows of 5 to 129 and 1 to 21 layers;
# 81 to 87 % of the times are within 15 %, those of occlusion by transforms 65 to 69 %. The bank's rates are XEON's.
EPYC = CostProfile(
    name="epyc-2.6",
    direct=DirectRates(0.95, 0, 0.74, 78, 13.9, 1.68),
    tiled=TiledRates(0.85, 2.07e6, 0, 6.28, 0.203, 0, 0.92, 1.69, 8800),
    overlap=OverlapRates(0.9, 8e5, 1.6, 0.0437, 1.5, 0.27, 0.124),
    dense=DenseRates(0.7, 9.6e4, 3.1, 0.1425, 0.147, 0, 1.51),
    occlusion_direct=DirectOcclusionRates(0.95, 0, 1.44, 390, 4.84, 440, 0, 2.63, 7.06, 25),
    occlusion_tiled=TiledOcclusionRates(0.7, 2.07e6, 5, 7.94, 23.9, 1.8, 33.5, 3000),
    occlusion_dense=DenseRates(0.7, 0, 0, 0.398, 0.191, 0, 0),
    bank=BankRates(0.5, 0, 1 / 52, 1 / 57, 1 / 90, 1 / 115),
)
