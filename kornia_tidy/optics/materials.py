"""Materials of phase masks and lenses: refractive index n(λ) from published dispersion formulas."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from kornia_tidy.optics.spectrum import check_wavelength

Terms = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Material:
    """A transparent material with a published dispersion formula. It is plain data that can be hashed and pickled.

    Args:
        name: name of the material.
        source: publication of the formula.
        dispersion: function of a wavelength in micrometres (the unit of all published formulas) and ``terms`` that
            returns the index.
        terms: coefficients of the formula, in the pairs that ``dispersion`` expects.
        valid: shortest and longest wavelength in metres for which the formula was published.

    Example:
        >>> round(FUSED_SILICA.index(530e-9), 5)
        1.4608
        >>> NOA61.index(400e-9)
        Traceback (most recent call last):
        ValueError: the index of NOA61 is published for 450 to 1550 nm, got 400 nm
    """

    name: str
    source: str
    dispersion: Callable[[float, Terms], float] = field(repr=False)
    terms: Terms
    valid: tuple[float, float] = (0.0, math.inf)

    def index(self, wavelength: float) -> float:
        """Return the refractive index n at a vacuum wavelength.

        Args:
            wavelength: in metres.

        Returns:
            The index, without unit.

        Raises:
            ValueError: if the wavelength is not in metres or outside the published range.
        """
        check_wavelength("wavelength", wavelength)
        shortest, longest = self.valid
        slack = 1e-9  # 0.45 * 1e-6 and 450e-9 differ in the last digit
        if not shortest * (1 - slack) <= wavelength <= longest * (1 + slack):
            allowed = f"{shortest * 1e9:g} to {longest * 1e9:g} nm"
            raise ValueError(f"the index of {self.name} is published for {allowed}, got {wavelength * 1e9:g} nm")
        try:
            index = self.dispersion(wavelength * 1e6, self.terms)
        except (ValueError, ZeroDivisionError):  # the root of a negative number, or a resonance
            index = math.nan
        if not 1 <= index < 5:
            raise ValueError(
                f"the index of {self.name} must be from 1 to 5, and its dispersion formula gives {index:.4g} at "
                f"{wavelength * 1e9:g} nm"
            )
        return index


def constant_index(index: float) -> Material:
    """Return a material without dispersion, the same index at every wavelength.

    Args:
        index: refractive index, above 1 (material of index 1 does not delay light).

    Returns:
        A material that is valid at every wavelength.

    Raises:
        ValueError: if the index is not finite and above 1.

    Source: Wu et al., PhaseCam3D, ICCP 2019, take 1.5 for all colours.

    Example:
        >>> constant_index(1.5).index(470e-9)
        1.5
    """
    if not 1 < index < math.inf:
        raise ValueError(f"index must be finite and above 1, got {index}")
    return Material(f"constant index {index:g}", "by definition", _power_series, ((float(index), 0),))


def cauchy_through(name: str, source: str, indices: tuple[tuple[float, float], ...]) -> Material:
    r"""Return a material by interpolating known indices with Cauchy's dispersion equation.

    .. math:: n(\lambda) = \sum_j c_j \, \lambda^{-2j}, \qquad \text{as many terms as there are indices}

    Args:
        name: name of the material.
        source: publication or data sheet of the indices.
        indices: pairs of a wavelength in metres and the index there.

    Returns:
        A material that is valid between the shortest and the longest of these wavelengths.

    Raises:
        ValueError: if there are fewer than two indices, a wavelength is repeated, or one is not in metres.

    Source: Cauchy (1836); Born and Wolf, Principles of Optics, section 2.3.4.

    Example:
        >>> glass = cauchy_through("glass", "a data sheet", ((450e-9, 1.53), (650e-9, 1.51)))
        >>> round(glass.index(450e-9), 6), round(glass.index(550e-9), 4)
        (1.53, 1.5173)
    """
    for wavelength, _ in indices:
        check_wavelength("wavelength", wavelength)
    waves = [wavelength * 1e6 for wavelength, _ in indices]
    if len(indices) < 2 or len(set(waves)) < len(waves):
        raise ValueError(f"indices must be known at two or more different wavelengths, got {indices}")
    powers = [-2 * j for j in range(len(waves))]
    terms = np.linalg.solve([[um**power for power in powers] for um in waves], [index for _, index in indices])
    known = tuple((float(term), power) for term, power in zip(terms, powers, strict=True))
    return Material(name, source, _power_series, known, (min(waves) * 1e-6, max(waves) * 1e-6))


def _sellmeier(um: float, terms: Terms) -> float:
    """Return sqrt(1 + sum b λ²/(λ² - c)) over pairs (b, c), c in µm²."""
    return math.sqrt(1 + sum(b * um**2 / (um**2 - c) for b, c in terms))


def _power_series(um: float, terms: Terms) -> float:
    """Return sum c λ^p over pairs (c, p); with p = 0, -2, -4 this is Cauchy's equation."""
    return sum(c * um**p for c, p in terms)


def _root_power_series(um: float, terms: Terms) -> float:
    """Return sqrt(sum c λ^p) over pairs (c, p): a power series of n²."""
    return math.sqrt(_power_series(um, terms))


DISPERSIONS = {formula.__name__: formula for formula in (_sellmeier, _power_series, _root_power_series)}
"""Dispersion formulas by their names, as a camera's state gives them."""

FUSED_SILICA = Material(
    "fused silica",
    "I. H. Malitson, J. Opt. Soc. Am. 55, 1205 (1965), at 20 °C",
    _sellmeier,
    ((0.6961663, 0.0684043**2), (0.4079426, 0.1162414**2), (0.8974794, 9.896161**2)),
    (210e-9, 3710e-9),
)
"""Fused silica (Malitson 1965): 1.46080 at 530 nm. Valid over Malitson's own range, 0.21 to 3.71 µm."""

PMMA = Material(
    "PMMA",
    "G. Beadie et al., Appl. Opt. 54, F139 (2015), at 20.1 °C",
    _root_power_series,
    (
        (2.1778, 0),
        (6.1209e-3, 2),
        (-1.5004e-3, 4),
        (2.3678e-2, -2),
        (-4.2137e-3, -4),
        (7.3417e-4, -6),
        (-4.5042e-5, -8),
    ),
    (420e-9, 1620e-9),
)
"""Poly(methyl methacrylate), acrylic glass (Beadie 2015): 1.49539 at 530 nm."""

PDMS = Material(
    "PDMS",
    "F. Schneider et al., Sens. Actuators A 151, 95 (2009), Sylgard 184",
    _sellmeier,
    ((1.0093, 0.013185),),
    (350e-9, 700e-9),
)
"""Silicone elastomer Sylgard 184 (Schneider 2009): 1.43492 at 530 nm."""

NOA61 = Material(
    "NOA61",
    "Norland Optical Adhesive 61, maker's Cauchy equation",
    _power_series,
    ((1.5375, 0), (0.00829045, -2), (-0.000211046, -4)),
    (450e-9, 1550e-9),
)
"""Cured Norland Optical Adhesive 61 by its maker's equation: 1.56434 at 530 nm.

Sources disagree: S. Joseph et al., ACS Applied Materials & Interfaces 12, 46519 (2020), measured 1.498 at 530 nm in a
film 1 µm thick. Ikoma et al., ICCP 2021, use the maker's equation.
"""
