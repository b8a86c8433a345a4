"""Lens table: the effect of a lens on light over field height, defocus and wavelength, in a few thousand numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import cache, lru_cache
from typing import cast

import torch
from torch import Tensor

from kornia_tidy.optics.lens.field_table import defocus_terms, height_weights

EXACT = ("wavelengths", "defocus", "field")  # in float64 in files too


@dataclass(frozen=True, eq=False)
class LensTable:
    """Coefficients of a lens, for fields along +x; W wavelengths, S terms in defocus, H heights, J polynomials.

    Zernike polynomials are those of :func:`kornia_tidy.optics.zernike.zernike_polynomials` over the stop.
    Functions that are mirrored at the field's axis take the cosines; those that change sign there take the sines.

    Args:
        wavelengths: (W,) metres.
        defocus: lowest and highest defocus in radians, (2,).
        field: largest height on the sensor in metres, and the crowding of nodes at the axis, (2,); see
            :func:`~kornia_tidy.optics.lens.field_table.mirrored_nodes`.
        wavefront: optical path beyond that of an ideal lens, radians at 530 nm, cosines, (W, S, H, J).
        radial: direction cosine along the field in which light of a point of the stop arrives, less the chief ray's,
            cosines, (W, H, Jm).
        tangential: the same across the field, sines, (W, H, Jt).
        amplitude: of light on its way to the sensor, the square root of the object's light on an area of the stop times
            the area of direction cosines that it fills, cosines, (W, S, H, Ja).
        illumination: light of a point of the object on an area of the stop, in parts of its mean, cosines,
            (W, S, H, Ji).
        chief: height where light through the stop's centre lands, in parts of the height at 530 nm, (W, S, H).
        tangent: slope from the entrance pupil to the object over height on the sensor, 1/m, (S, H).
        edges: discs that a surface's rim leaves of the stop: centre along the field and radius in stop radii,
            (H, E, 2); the stop's own edge is not among them.
        mask_shift: of masks off the stop, see :meth:`~kornia_tidy.optics.lens.lens.Lens.with_masks_off_stop`.
    """

    wavelengths: Tensor
    defocus: Tensor
    field: Tensor
    wavefront: Tensor
    radial: Tensor
    tangential: Tensor
    amplitude: Tensor
    illumination: Tensor
    chief: Tensor
    tangent: Tensor
    edges: Tensor
    mask_shift: float = 0.0

    def tensors(self) -> dict[str, Tensor]:
        """Return all parts by their names."""
        return {part.name: getattr(self, part.name) for part in fields(self) if part.name != "mask_shift"}

    @lru_cache(maxsize=16)  # noqa: B019 (so that cameras with the same lens share what is remembered)
    def rounded(self) -> LensTable:
        """Return the table as files hold it: in float32, but for :data:`EXACT`."""
        parts = self.tensors().items()
        return replace(self, **{name: part if name in EXACT else part.float().to(part.dtype) for name, part in parts})

    @property
    def reach(self) -> tuple[float, float]:
        """Lowest and highest defocus in radians."""
        low, high = self.defocus.tolist()
        return low, high

    def at(self, heights: Tensor, defocus: Tensor, wavelength: float) -> LensSample:
        """Return the coefficients at heights (F,) in metres, defocus (D,) in radians, and a wavelength in metres.

        Beyond the table's range its edge stands in; the defocus of an ideal lens is not among the coefficients.
        """
        series = self.series(heights, wavelength)
        for name in ("wavefront", "amplitude", "illumination", "chief"):
            of_terms = getattr(series, name).movedim(1, 0)  # (S, F, ...)
            terms = defocus_terms(defocus, self.reach, len(of_terms)).T
            terms = terms.reshape(*terms.shape, *[1] * (of_terms.ndim - 1))  # (S, D, 1, ...)
            total = sum(term * own for term, own in zip(terms, of_terms, strict=True))  # alike for any number of depths
            series = replace(series, **{name: cast("Tensor", total).movedim(0, 1)})
        return series

    def series(self, heights: Tensor, wavelength: float) -> LensSample:
        """Return the same with the terms of :func:`~kornia_tidy.optics.lens.field_table.defocus_terms` for depths."""
        field, crowding = self.field.tolist()
        relative = (heights.double() / field).clamp(0, 1) if field else torch.zeros(len(heights), dtype=torch.float64)
        by_wave = self._wave_weights(wavelength)

        @cache
        def weights(count: int, odd: bool) -> Tensor:
            return height_weights(count, relative, crowding, odd=odd)

        def at_height(table: Tensor, parity: Tensor | int) -> Tensor:  # (W, ..., H, J) to (..., F, J)
            mixed = torch.tensordot(by_wave, table.double(), 1)
            even, odd = (weights(mixed.shape[-2], odd) @ mixed for odd in (False, True))
            return torch.where(torch.as_tensor(parity) % 2 == 1, odd, even)

        edges = self.edges.double().movedim(1, 0)  # (E, H, 2)
        centre_and_radius = torch.tensor([1, 0])
        return LensSample(
            at_height(self.wavefront, _orders(self.wavefront)).movedim(0, 1),
            at_height(self.radial, 1 + _orders(self.radial)),
            at_height(self.tangential, 1 + _orders(self.tangential, sines=True)),
            at_height(self.amplitude, _orders(self.amplitude)).movedim(0, 1),
            at_height(self.illumination, _orders(self.illumination)).movedim(0, 1),
            at_height(self.chief[..., None], 0)[..., 0].T,
            at_height(edges[None].expand(len(self.wavelengths), -1, -1, -1), centre_and_radius).movedim(0, 1),
        )

    def slopes(self, heights: Tensor, defocus: Tensor) -> Tensor:
        """Return the slope to the object over height on the sensor, (F, D) in 1/m."""
        field, crowding = self.field.tolist()
        relative = (heights.double() / field).clamp(0, 1) if field else torch.zeros(len(heights), dtype=torch.float64)
        terms = defocus_terms(defocus, self.reach, len(self.tangent))
        return height_weights(self.tangent.shape[1], relative, crowding) @ self.tangent.double().T @ terms.T

    def _wave_weights(self, wavelength: float) -> Tensor:
        """Return the weights of polynomial interpolation over wavelength, (W,), from three wavelengths at most.

        Over its inverse square, along which indices of glasses are nearly straight (Cauchy).
        """
        known, weights = self.wavelengths.double().pow(-2).tolist(), torch.zeros(len(self.wavelengths)).double()
        at = min(max(wavelength**-2, min(known)), max(known))
        nearest = sorted(range(len(known)), key=lambda i: abs(known[i] - at))[:3]
        for i in nearest:
            others = [known[j] for j in nearest if j != i]
            weights[i] = math.prod((at - x) / (known[i] - x) for x in others)
        return weights


@dataclass(frozen=True, eq=False)
class LensSample:
    """A lens at F heights, D depths and one wavelength; see :class:`LensTable` for the parts."""

    wavefront: Tensor  # (F, D, J)
    radial: Tensor  # (F, Jm)
    tangential: Tensor  # (F, Jt)
    amplitude: Tensor  # (F, D, Ja)
    illumination: Tensor  # (F, D, Ji)
    chief: Tensor  # (F, D)
    edges: Tensor  # (F, E, 2)


def modes_of(count: int, *, sines: bool = False) -> list[tuple[int, int]]:
    """Return radial and azimuthal order of the first polynomials that are mirrored at the x axis, or change sign there.

    Example:
        >>> modes_of(4), modes_of(2, sines=True)
        ([(0, 0), (1, 1), (2, 0), (2, 2)], [(1, 1), (2, 2)])
    """
    degree = degree_of(count, sines=sines)
    return [(n, m) for n in range(degree + 1) for m in range(2 - n % 2 if sines else n % 2, n + 1, 2)][:count]


def degree_of(count: int, *, sines: bool = False) -> int:
    """Return the highest radial order of the first so many polynomials of one parity.

    Example:
        >>> degree_of(4), degree_of(5), degree_of(2, sines=True)
        (2, 3, 2)
    """
    return next(n for n in range(count + 2) if count_of(n, sines=sines) >= count)


def count_of(degree: int, *, sines: bool = False) -> int:
    """Return how many polynomials of one parity there are up to a radial order.

    Example:
        >>> count_of(12), count_of(12, sines=True)
        (49, 42)
    """
    return sum((n + 1) // 2 if sines else n // 2 + 1 for n in range(degree + 1))


def osa_indices(count: int, *, sines: bool = False) -> list[int]:
    """Return where the polynomials of one parity stand in the order of OSA/ANSI.

    Example:
        >>> osa_indices(4), osa_indices(2, sines=True)
        ([0, 2, 4, 5], [1, 3])
    """
    return [(n * (n + 2) + (-m if sines else m)) // 2 for n, m in modes_of(count, sines=sines)]


def _orders(table: Tensor, *, sines: bool = False) -> Tensor:
    return torch.tensor([m for _, m in modes_of(table.shape[-1], sines=sines)])
