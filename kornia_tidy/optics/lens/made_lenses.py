"""Lenses made without a file: from a published prescription, surfaces of one's own, or a wavefront."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

from kornia_tidy.checks import check_choice, check_metres, check_number, check_positive
from kornia_tidy.optics.default_device import on_cpu
from kornia_tidy.optics.lens.first_order import first_order
from kornia_tidy.optics.lens.ideal_table import Wavefront, ideal_table
from kornia_tidy.optics.lens.lens_table import LensTable
from kornia_tidy.optics.lens.named_lenses import NAMED_LENSES
from kornia_tidy.optics.lens.prescription import Prescription, half_diagonal
from kornia_tidy.optics.lens.prescription_files import read_prescription_file
from kornia_tidy.optics.lens.table_fit import fit_table
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH, check_wavelength
from kornia_tidy.optics.thin_lens import FASTEST, ThinLensCamera

RGB = (470e-9, REFERENCE_WAVELENGTH, 610e-9)
WIDEST = 20.0  # radians; nearer depths than of this defocus are in a table only where focus is farther away


class LensParts(NamedTuple):
    """The parts of a lens; see :class:`~kornia_tidy.optics.lens.lens.Lens`."""

    name: str
    source: str
    focal_length: float
    f_number: float
    focus_distance: float
    table: LensTable
    residual: float = 0.0


@lru_cache(maxsize=16)
def named_parts(
    name: str, f_number: float, focus_distance: float, wavelengths: tuple[float, ...], field: float | None
) -> LensParts:
    """Return the lens of a name, traced once."""
    check_choice("name of a lens", name, tuple(NAMED_LENSES))
    entry = NAMED_LENSES[name]
    height = entry["field"] if field is None else field
    return traced_parts(entry["prescription"], f_number, focus_distance, wavelengths, height, None)


def named_focal_length(name: str) -> float:
    """Return the focal length of a named lens in metres, without tracing its wavefronts.

    Example:
        >>> round(named_focal_length("double-gauss-50mm"), 4)
        0.0515
    """
    check_choice("name of a lens", name, tuple(NAMED_LENSES))
    return first_order(Prescription.read(NAMED_LENSES[name]["prescription"]), 8.0, math.inf).focal_length


@on_cpu
def traced_parts(
    prescription: Mapping[str, Any] | Prescription | str | os.PathLike[str],
    f_number: float,
    focus_distance: float,
    wavelengths: Sequence[float],
    field: float | None,
    nearest: float | None,
) -> LensParts:
    """Return a lens traced from its surfaces. See :meth:`~kornia_tidy.optics.lens.lens.Lens.from_prescription`."""
    own = None
    if isinstance(prescription, (str, os.PathLike)):
        prescription, own = read_prescription_file(prescription)
    elif not isinstance(prescription, Prescription):
        own, prescription = half_diagonal(prescription), Prescription.read(prescription)
    field = own if field is None else field
    waves = checked_wavelengths(wavelengths)
    check_positive("f_number", f_number)
    if f_number < FASTEST:
        raise ValueError(f"f_number must be at least {FASTEST}, got {f_number}")
    check_number("focus_distance", focus_distance, "metres")
    f_number, focus_distance = float(f_number), float(focus_distance)
    if not focus_distance > 0:
        raise ValueError(f"focus_distance must be positive metres, got {focus_distance}")
    if field is None:
        raise ValueError("field must be the largest height on the sensor in metres, got None")
    _check_field(field)
    system = first_order(prescription, f_number, focus_distance)
    scale = math.pi * system.pupil_radius**2 / REFERENCE_WAVELENGTH
    low = -scale / focus_distance
    high = max(WIDEST, -low)
    if nearest is not None:
        check_positive("nearest", nearest, "metres")
        high = scale / nearest + low
    fit = fit_table(system, waves, float(field), (low, high))
    return LensParts(
        prescription.name,
        prescription.source,
        system.focal_length,
        f_number,
        focus_distance,
        fit.table,
        fit.residual,
    )


@on_cpu
def ideal_parts(
    name: str,
    source: str,
    wavefront: Wavefront,
    wavelengths: tuple[float, ...],
    focal_length: float,
    f_number: float,
    focus_distance: float,
    field: float,
    distortion: float = 0.0,
) -> LensParts:
    """Return a thin lens with a wavefront over the field. See :func:`ideal_table`."""
    _check_field(field)
    reach = (focal_length, math.inf)
    camera = ThinLensCamera(focal_length, focus_distance=focus_distance, f_number=f_number, depth_range=reach)
    radius = camera.aperture_radius
    low = -math.pi * radius**2 / REFERENCE_WAVELENGTH / focus_distance
    range_ = (low, max(WIDEST, -low))
    table = ideal_table(wavefront, wavelengths, field, range_, radius, float(camera.image_distance), distortion)
    return LensParts(name, source, focal_length, f_number, focus_distance, table)


def checked_wavelengths(given: Sequence[float]) -> tuple[float, ...]:
    """Return wavelengths in ascending order, each once, or raise if one is not in range."""
    if isinstance(given, str) or not hasattr(given, "__len__") or not len(given):
        raise TypeError(f"wavelengths must be one or more numbers in metres such as {RGB}, got {given!r:.60}")
    for wavelength in given:
        check_wavelength("wavelengths", wavelength)
    return tuple(sorted({float(wavelength) for wavelength in given}))


def _check_field(field: float) -> None:
    check_number("field", field, "metres")
    if field != 0:
        check_metres("field", field, 1e-6, 1.0, "21.6 mm is 21.6e-3")
