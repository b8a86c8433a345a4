"""Surfaces as files of optical programs list them, and the prescription that they make."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from kornia_tidy.files import error_prefix
from kornia_tidy.optics.lens.first_order import first_order
from kornia_tidy.optics.lens.glasses import catalogue_glass
from kornia_tidy.optics.lens.prescription import Prescription
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH

AIR = "air"
FAR = 1e9  # in units of the file: objects beyond are at infinity, written as 1e10
_OUT_OF_FOCUS = 0.03  # focal lengths from the paraxial focus beyond which the file's sensor is not where its focus is
_ROUNDING = 1e-7
_VISIBLE = (380e-9, 1000e-9)


@dataclass
class FileSurface:
    """A surface of a file, in its unit of length.

    Args:
        where: for messages, such as ``"surface 3"``.
        curvature: 0 for a plane.
        conic: conic constant.
        powers: {power: coefficient}.
        gap: to the next surface.
        glass: behind it.
        clear: radius beyond which light is cut off; None for none.
        stop: whether it is the diaphragm.
    """

    where: str
    curvature: float = 0.0
    conic: float = 0.0
    powers: dict[int, float] = field(default_factory=dict)
    gap: float = 0.0
    glass: str = AIR
    clear: float | None = None
    stop: bool = False

    @property
    def plane(self) -> bool:
        """Whether it has no shape."""
        return not (self.curvature or any(self.powers.values()))


@dataclass
class FileLens:
    """A lens as a file has it.

    Args:
        name: of the lens.
        surfaces: between object and sensor.
        unit: of length in millimetres.
        indices: of each glass, as prescriptions hold them.
        distance: from the object to the first surface.
        wavelength: the primary one, in metres.
        height: largest height on the sensor, or None.
        angle: largest angle of the field in degrees, or None.
    """

    name: str = ""
    surfaces: list[FileSurface] = field(default_factory=list)
    unit: float = 1.0
    indices: dict[str, Any] = field(default_factory=dict)
    distance: float = math.inf
    wavelength: float = REFERENCE_WAVELENGTH
    height: float | None = None
    angle: float | None = None

    def take(self, rows: Sequence[FileSurface]) -> None:
        """Take the surfaces of a file, from the object to the sensor.

        Raises:
            ValueError: if they are fewer than three, or the object's medium or the sensor's shape is another.
        """
        if len(rows) < 3:
            raise ValueError(f"it must have an object, surfaces and a sensor, got {len(rows)} of them")
        first, *self.surfaces, sensor = rows
        if first.glass != AIR:
            raise ValueError(f"the lens must stand in air, got {first.glass!r:.60} in front of it")
        if not sensor.plane:
            raise ValueError("its last surface is the sensor and must be a plane, got a curved one")
        self.distance = math.inf if abs(first.gap) >= FAR else first.gap

    def glass(self, where: str, name: str, makers: Sequence[str] = ()) -> str:
        """Return the name of a glass, whose index is that of the file or of the catalogues of some makers."""
        if name not in self.indices:
            with error_prefix(where):
                self.indices[name] = catalogue_glass(name, makers)
        return name


def lens_of(lens: FileLens) -> tuple[Prescription, float | None]:
    """Return the prescription of a file's lens, and its largest height on the sensor in metres if it says.

    Raises:
        ValueError: if the surfaces are none of a lens.

    Convention:
        - A stop on a refracting surface becomes the plane through its vertex, on the side of air.
        - Planes that neither refract nor cut light are left out.
        - Where the object is at infinity, the sensor stands as far from the paraxial focus as in the file, each at the
          file's primary wavelength; where that is far out of focus, and for near objects, in the paraxial focus.
    """
    stops = [surface.where for surface in lens.surfaces if surface.stop]
    if len(stops) != 1:
        raise ValueError(f"it must have one stop, got {', '.join(stops) or 'none'}")
    rows = _without_idle_planes(_with_plane_stop(lens.surfaces))
    if not any(not row.stop for row in rows):
        raise ValueError("it must have a surface that refracts, got none")
    for row in rows:
        if row.gap < 0:
            raise ValueError(f"the distance behind {row.where} must not be negative, got {row.gap:g}")
    to_sensor = lens.unit * sum(row.gap for row in rows[next(i for i, row in enumerate(rows) if not row.stop) :])
    rows[-1] = replace(rows[-1], gap=0.0)
    if rows[-1].stop:  # air is behind it
        rows.append(FileSurface(rows[-1].where))
    surfaces = [_entry(row, lens.unit) for row in rows]
    given = {"name": lens.name[:200], "unit": "mm", "surfaces": surfaces, "index": lens.indices}
    prescription = Prescription.read(given)
    optics = first_order(prescription, 8.0, math.inf)
    if math.isinf(lens.distance):
        low, high = _VISIBLE
        primary = lens.wavelength if low <= lens.wavelength <= high else REFERENCE_WAVELENGTH
        shift = 1e-3 * to_sensor - first_order(prescription, 8.0, math.inf, primary).sensor_z
        if _ROUNDING < abs(shift) / optics.focal_length < _OUT_OF_FOCUS:
            prescription = replace(prescription, image_plane=optics.sensor_z + shift)
    height = None if lens.height is None else 1e-3 * lens.unit * lens.height
    if height is None and lens.angle is not None and lens.angle < 90:
        height = optics.focal_length * math.tan(math.radians(lens.angle))
    return prescription, height or None


def _with_plane_stop(surfaces: Sequence[FileSurface]) -> list[FileSurface]:
    """Return the surfaces with the stop as a plane in one medium."""
    found: list[FileSurface] = []
    before = AIR
    for surface in surfaces:
        if not surface.stop or (surface.plane and surface.glass == before):
            found.append(surface)
        else:
            shape = replace(surface, stop=False, clear=None)
            if before != AIR and surface.glass == AIR:  # air is behind it
                stop = FileSurface(surface.where, gap=surface.gap, stop=True)
                found += [replace(shape, gap=0.0), stop]
            else:
                found += [FileSurface(surface.where, glass=before, stop=True), shape]
        before = surface.glass
    return found


def _without_idle_planes(surfaces: Sequence[FileSurface]) -> list[FileSurface]:
    found: list[FileSurface] = []
    before = AIR
    for surface in surfaces:
        if surface.plane and surface.glass == before and surface.clear is None and not surface.stop:
            if found:
                found[-1] = replace(found[-1], gap=found[-1].gap + surface.gap)
        else:
            found.append(surface)
        before = surface.glass
    return found


def _entry(row: FileSurface, unit: float) -> dict[str, Any]:
    gap = row.gap * unit
    if row.stop:
        return {"kind": "stop", "t": gap, "glass": row.glass}
    return {
        "R": unit / row.curvature if row.curvature else None,
        "k": row.conic if row.curvature else 0.0,
        "poly": {power: value * unit ** (1 - power) for power, value in row.powers.items() if value},
        "t": gap,
        "glass": row.glass,
        "r": None if row.clear is None else row.clear * unit,
    }


def number(what: str, text: Any) -> float:
    """Return a number of a file, which must be finite.

    Args:
        what: it is, for the message.
        text: or a number of JSON.
    """
    try:
        value = float(text)
    except (TypeError, ValueError):
        value = math.nan
    if isinstance(text, bool) or not math.isfinite(value):
        raise ValueError(f"{what} must be a finite number, got {text!r:.60}")
    return value
