"""Lens tables without a prescription: an ideal lens with a wavefront of one's own."""

from __future__ import annotations

import csv
import math
import os
import re
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from kornia_tidy.checks import check_choice
from kornia_tidy.files import error_prefix, read_text
from kornia_tidy.optics.lens.field_table import mirrored_nodes
from kornia_tidy.optics.lens.lens_table import LensTable, count_of, osa_indices
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH
from kornia_tidy.optics.zernike import zernike_polynomials

ORDERS = ("noll", "fringe")
_COUNT, _DEGREE, _LEAST = 17, 12, 1e-3  # heights; of the polynomials; waves that count as none
_MOST_TERMS, _MOST_ROWS = 91, 20000

Wavefront = Callable[[float, float, Tensor, Tensor], Tensor]  # relative height, wavelength, x, y: radians at 530 nm


def ideal_table(
    wavefront: Wavefront,
    wavelengths: tuple[float, ...],
    field: float,
    reach: tuple[float, float],
    pupil_radius: float,
    image_distance: float,
    distortion: float = 0.0,
) -> LensTable:
    """Return the table of a thin lens with a wavefront that depends on the field and not on the depth.

    Args:
        wavefront: function of the height in parts of the field, the wavelength, and x (along the field) and y in the
            stop, that returns radians at 530 nm.
        wavelengths: in metres.
        field: largest height on the sensor in metres.
        reach: lowest and highest defocus in radians.
        pupil_radius: in metres.
        image_distance: from the lens to the sensor in metres.
        distortion: relative enlargement of images at the largest height; it grows as the square of the height.
    """
    nodes, _ = np.polynomial.legendre.leggauss(_DEGREE // 2 + 3)
    radius = torch.from_numpy(np.sqrt((nodes + 1) / 2))[:, None]
    angle = (torch.arange(2 * _DEGREE + 5, dtype=torch.float64) + 0.5) * 2 * math.pi / (2 * _DEGREE + 5)
    x, y = radius * torch.cos(angle), radius * torch.sin(angle)
    count = count_of(_DEGREE)
    polynomials = zernike_polynomials((_DEGREE + 1) * (_DEGREE + 2) // 2, y, x)[osa_indices(count)].flatten(1).T
    heights = mirrored_nodes(_COUNT if field else 1)
    found = [[wavefront(float(h), w, x.flatten(), y.flatten()) for h in heights] for w in wavelengths]
    values = torch.stack([torch.stack(row) for row in found])
    coefficients = torch.linalg.lstsq(polynomials, values.flatten(0, 1).T).solution.T.unflatten(0, values.shape[:2])
    ones = torch.ones(len(wavelengths), len(heights), 1, dtype=torch.float64)
    linear = -pupil_radius / image_distance / 2 * ones  # of the polynomials 2 x and 2 y
    zero = torch.zeros_like(linear)
    slope = 1 / (image_distance * (1 + distortion * heights.square()))
    return LensTable(
        torch.tensor(wavelengths, dtype=torch.float64),
        torch.tensor(reach, dtype=torch.float64),
        torch.tensor([field, 0.0], dtype=torch.float64),
        coefficients[:, None],
        torch.cat([zero, linear], 2),
        linear,
        (pupil_radius / image_distance * ones)[:, None],
        ones[:, None],
        ones[:, None, :, 0],
        slope[None],
        torch.zeros(len(heights), 0, 2, dtype=torch.float64),
    )


def seidel_wavefront(spherical: float, coma: float, astigmatism: float, field_curvature: float) -> Wavefront:
    r"""Return the third-order aberrations of a lens.

    .. math:: W = W_{040} \rho^4 + W_{131} h \rho^2 x + W_{222} h^2 x^2 + W_{220} h^2 \rho^2

    Args:
        spherical: W040 in waves of 530 nm, as all others at the edge of stop and field.
        coma: W131.
        astigmatism: W222.
        field_curvature: W220.
    """

    def wavefront(h: float, _: float, x: Tensor, y: Tensor) -> Tensor:
        squared = x.square() + y.square()
        waves = (
            spherical * squared.square()
            + coma * h * squared * x
            + h * h * (astigmatism * x.square() + field_curvature * squared)
        )
        return 2 * math.pi * waves

    return wavefront


def read_zernike_table(
    path: str | os.PathLike[str], order: str, sign: int
) -> tuple[Wavefront, tuple[float, ...], float]:
    """Read the Zernike coefficients of a lens over field and wavelength, as optical programs export them.

    Args:
        path: a CSV file with the columns ``field_mm``, ``wavelength_nm`` (may be missing: 530) and ``Z1``, ``Z2``, ...
            in waves of that wavelength, for fields along +y.
        order: ``"noll"``, orthonormal, or ``"fringe"`` (University of Arizona), of unit amplitude at the edge.
        sign: -1 if positive coefficients mean a wavefront that is ahead, 1 if they mean a longer path.

    Returns:
        The wavefront, wavelengths in metres, and the largest field in metres.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if the file is no CSV file, or a value is missing or no number.
    """
    check_choice("order", order, ORDERS)
    check_choice("sign", sign, (-1, 1))
    reader = csv.reader(read_text(path).splitlines())
    with error_prefix(f"cannot read {path}", csv.Error):
        rows = [(reader.line_num, row) for row in reader if row and not row[0].startswith("#")]
    if not 2 <= len(rows) <= _MOST_ROWS:
        raise ValueError(
            f"{path} must have a line of names and one or more of numbers, got {len(rows)} lines of 2 to {_MOST_ROWS}"
        )
    names = [name.strip() for name in rows[0][1]]
    terms = _terms(path, names)
    fields, waves, table = [], [], []
    for number, row in rows[1:]:
        if len(row) != len(names):
            raise ValueError(f"line {number} of {path} must have {len(names)} values, got {len(row)}")
        given = {name: _number(path, number, name, text) for name, text in zip(names, row, strict=True)}
        fields.append(given["field_mm"] * 1e-3)
        waves.append(given.get("wavelength_nm", 530.0) * 1e-9)
        table.append([given[name] for name in names if name.startswith("Z")])
    if min(fields) < 0 or not max(fields) <= 1:
        raise ValueError(
            f"field_mm of {path} must be from 0 to 1000, got {min(fields) * 1e3:g} to {max(fields) * 1e3:g}"
        )
    if not 100e-9 <= min(waves) <= max(waves) <= 20e-6:
        raise ValueError(
            f"wavelength_nm of {path} must be from 100 to 20000, got {min(waves) * 1e9:g} to {max(waves) * 1e9:g}"
        )
    values, largest = np.array(table), max(fields)
    _check_symmetry(path, values, np.array(fields), terms, order)
    splines = {}
    for wave in sorted(set(waves)):
        chosen = [i for i, other in enumerate(waves) if other == wave]
        chosen.sort(key=lambda i: fields[i])
        heights = np.array([fields[i] for i in chosen])
        if (np.diff(heights) <= 0).any():
            raise ValueError(
                f"{path} must have each field once for each wavelength, got one twice at {wave * 1e9:g} nm"
            )
        if heights[-1] < largest or (largest and len(heights) < 2):
            raise ValueError(
                f"{path} must have two fields or more for each wavelength, up to the largest of {largest * 1e3:g} mm, "
                f"got {', '.join(f'{height * 1e3:g}' for height in heights)[:80]} at {wave * 1e9:g} nm"
            )
        splines[wave] = _over_field(heights, values[chosen], terms, order)

    def wavefront(h: float, wavelength: float, x: Tensor, y: Tensor) -> Tensor:
        # The field lies along +x here and along +y in the file: turned by a right angle.
        basis = torch.stack([_polynomial(order, term, y, x) for term in terms], 1)
        return sign * 2 * math.pi * wavelength / REFERENCE_WAVELENGTH * (basis @ splines[wavelength](h * largest))

    return wavefront, tuple(splines), largest


def _terms(path: str | os.PathLike[str], names: list[str]) -> list[int]:
    if "field_mm" not in names or len(set(names)) < len(names):
        shown = ", ".join(names)[:200]
        raise ValueError(f"{path} must have columns between commas, field_mm among them and each once, got {shown}")
    terms = []
    for name in names:
        if name in ("field_mm", "wavelength_nm"):
            continue
        term = re.fullmatch(r"Z0*([0-9]{1,2})", name)
        if not (term and 1 <= int(term[1]) <= _MOST_TERMS) or int(term[1]) in terms:
            raise ValueError(
                f"columns of {path} must be field_mm, wavelength_nm and Z1 to Z{_MOST_TERMS} once, got {name!r:.60}"
            )
        terms.append(int(term[1]))
    if not terms:
        raise ValueError(f"{path} must have columns of coefficients such as Z4, got {', '.join(names)[:200]}")
    return terms


def _check_symmetry(
    path: str | os.PathLike[str], values: np.ndarray, fields: np.ndarray, terms: list[int], order: str
) -> None:
    """Refuse coefficients that are not mirrored at the plane of the field, x = 0 in the file, or turn with it at 0."""
    for term, column in zip(terms, values.T, strict=True):
        _, m = _orders(order, term)
        odd = (m > 0 and m % 2 == 1) or (m < 0 and m % 2 == 0)  # cosines of odd, sines of even multiples
        if odd and (worst := column[np.abs(column).argmax()]) and abs(worst) > _LEAST:
            raise ValueError(
                f"coefficients of {path} must be 0, as of a lens of revolution with fields along +y, got {worst:g} for "
                f"Z{term}"
            )
        axis = column[fields == 0]
        if m and axis.size and (worst := axis[np.abs(axis).argmax()]) and abs(worst) > _LEAST:
            raise ValueError(
                f"coefficients of {path} must be those of a lens of revolution, 0 on its axis, got {worst:g} for "
                f"Z{term} at field_mm 0"
            )


def _number(path: str | os.PathLike[str], line: int, name: str, text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"{name} in line {line} of {path} must be a finite number, got {text!r:.60}")
    return number


def _over_field(heights: np.ndarray, values: np.ndarray, terms: list[int], order: str) -> Callable[[float], Tensor]:
    """Return coefficients as a function of height, mirrored at the axis as each polynomial is."""
    from scipy.interpolate import CubicSpline  # noqa: PLC0415 (SciPy is loaded where it is needed)

    parity = np.array([(-1.0) ** _orders(order, term)[1] for term in terms])
    if len(heights) == 1:
        return lambda _: torch.from_numpy(values[0])
    inner = heights > 0
    spline = CubicSpline(
        np.concatenate([-heights[inner][::-1], heights]), np.concatenate([(values[inner] * parity)[::-1], values])
    )
    return lambda height: torch.from_numpy(np.atleast_1d(spline(height)))


def noll_orders(term: int) -> tuple[int, int]:
    """Return radial and azimuthal order of a polynomial in Noll's order, negative for a sine.

    Source: Noll, J. Opt. Soc. Am. 66, 207 (1976).

    Example:
        >>> [noll_orders(j) for j in range(1, 9)]
        [(0, 0), (1, 1), (1, -1), (2, 0), (2, -2), (2, 2), (3, -1), (3, 1)]
    """
    n = (math.isqrt(8 * (term - 1) + 1) - 1) // 2
    place = term - 1 - n * (n + 1) // 2
    m = 2 * ((place + 1) // 2) if n % 2 == 0 else 2 * (place // 2) + 1
    return n, m if term % 2 == 0 else -m


def fringe_orders(term: int) -> tuple[int, int]:
    """Return radial and azimuthal order of a polynomial in the fringe order, negative for a sine.

    Source: Wyant and Creath, Basic Wavefront Aberration Theory for Optical Metrology, in Applied Optics and Optical
    Engineering XI (1992), chapter 1.

    Example:
        >>> [fringe_orders(j) for j in range(1, 10)]
        [(0, 0), (1, 1), (1, -1), (2, 0), (2, 2), (2, -2), (3, 1), (3, -1), (4, 0)]
    """
    half = math.isqrt(term - 1)  # (n + |m|) / 2
    place = term - 1 - half * half
    m = half - place // 2
    n = 2 * half - m
    return n, -m if place % 2 else m


def _orders(order: str, term: int) -> tuple[int, int]:
    return noll_orders(term) if order == "noll" else fringe_orders(term)


def _polynomial(order: str, term: int, x: Tensor, y: Tensor) -> Tensor:
    n, m = _orders(order, term)
    index = (n * (n + 2) + m) // 2
    value = zernike_polynomials(index + 1, y, x)[index]
    return value if order == "noll" else value / math.sqrt((n + 1) * (2 if m else 1))
