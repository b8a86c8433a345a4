"""Lens prescriptions: surfaces, glasses and stop of a lens as plain data, checked when they are read."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from kornia_tidy.checks import check_choice, check_number, check_positive, described
from kornia_tidy.optics.materials import DISPERSIONS, Material, cauchy_through, constant_index

UNITS = {"m": 1.0, "mm": 1e-3}
KINDS = ("surface", "stop")
LONGEST = 10.0  # metres from the first surface to the last; longer ones are millimetres read as metres
SMALLEST = 1e-5  # metres, of a clear radius: through smaller ones no rays are
MOST_SURFACES, HIGHEST_POWER = 200, 30
_SURFACE_KEYS = {"kind", "R", "k", "poly", "t", "glass", "r"}
_KEYS = {"name", "source", "unit", "surfaces", "index", "image_plane_infinity"}
_NOTES = {"index_source", "fnumbers", "focus", "pitch_um", "sensor"}  # of collections; pitch_um says millimetres
_FORMULAS = {"sellmeier": "_sellmeier", "powers": "_root_power_series"}  # of indices in a prescription
_LINES = (486.1327e-9, 587.5618e-9, 656.2725e-9)  # m; F, d and C, at which Abbe's number is defined


@dataclass(frozen=True)
class Surface:
    r"""A surface of revolution: :math:`z = c r^2 / (1 + \sqrt{1 - (1 + k) c^2 r^2}) + \sum_p a_p r^p`.

    Args:
        curvature: c in 1/m, 0 for a plane.
        conic: k, 0 for a sphere.
        powers: pairs (p, a_p), even and odd, a_p in m^(1 - p).
        gap: distance to the vertex of the next surface in metres.
        glass: medium behind the surface, ``"air"`` or a name of the prescription.
        clear: radius in metres beyond which light is cut off; inf for none.
        is_stop: whether it is the diaphragm, a plane whose radius follows from the f-number.
    """

    curvature: float
    conic: float = 0.0
    powers: tuple[tuple[int, float], ...] = ()
    gap: float = 0.0
    glass: str = "air"
    clear: float = math.inf
    is_stop: bool = False


@dataclass(frozen=True)
class Prescription:
    """The surfaces of a lens from object to sensor, in air, with one stop.

    Args:
        name: of the lens.
        source: publication of the numbers.
        surfaces: in the order of light.
        glasses: material of each glass.
        image_plane: distance from the first refracting vertex to the sensor where the lens is focused at infinity, in
            metres, of lenses that are not focused paraxially. None: the paraxial focus.

    Example:
        >>> lens = Prescription.read({"surfaces": [{"kind": "stop", "t": 0.0}, {"R": 25e-3, "t": 3e-3, "glass": "a"},
        ...     {"R": None, "t": 0.0}], "index": {"a": 1.5}})
        >>> lens.surfaces[1].curvature, lens.stop
        (40.0, 0)
    """

    name: str
    source: str
    surfaces: tuple[Surface, ...]
    glasses: Mapping[str, Material]
    image_plane: float | None = None

    @property
    def stop(self) -> int:
        """Index of the stop among the surfaces."""
        return next(i for i, surface in enumerate(self.surfaces) if surface.is_stop)

    def indices(self, wavelength: float) -> list[float]:
        """Return the refractive index behind each surface at a wavelength in metres."""
        return [1.0 if s.glass == "air" else self.glasses[s.glass].index(wavelength) for s in self.surfaces]

    @classmethod
    def read(cls, given: Mapping[str, Any]) -> Prescription:
        """Return a prescription from plain data.

        Args:
            given: ``"surfaces"``, a list of mappings with ``"kind"`` (``"surface"``, the default, or ``"stop"``),
                ``"R"`` (radius, None for a plane), ``"k"`` (conic constant), ``"poly"`` ({power: coefficient}),
                ``"t"`` (distance to the next vertex), ``"glass"`` (behind it, default ``"air"``) and ``"r"`` (clear
                radius or None); ``"index"``, {glass: index}, where an index is a number, {wavelength in nm: number},
                {"nd": ..., "vd": ...}, {"sellmeier": [[b, c in um^2], ...]} or {"powers": [[c, p], ...]} for
                n^2 as a sum of c um^p; and, if known,
                ``"name"``, ``"source"``, ``"image_plane_infinity"`` and ``"unit"`` of all lengths, ``"m"`` or
                ``"mm"``. Default: metres; millimetres where ``"pitch_um"`` stands, as in tables of reference lenses.

        Raises:
            TypeError: if a value is of another type.
            ValueError: if a value is missing, unknown or impossible.
        """
        _mapping("prescription", given)
        unknown = [key for key in given if key not in _KEYS | _NOTES]
        if unknown:
            raise ValueError(f"prescription must have the keys {_words(_KEYS)}, got {unknown[0]!r:.60}")
        unit = given.get("unit", "mm" if "pitch_um" in given else "m")
        check_choice("unit of the prescription", unit, tuple(UNITS))
        scale = UNITS[unit]
        rows = given.get("surfaces")
        if not isinstance(rows, Sequence) or isinstance(rows, (str, bytes)):
            raise TypeError(f"surfaces of the prescription must be a list of mappings, got {described(rows)}")
        if not 2 <= len(rows) <= MOST_SURFACES:
            raise ValueError(
                f"surfaces of the prescription must be 2 to {MOST_SURFACES} with the stop, got {len(rows)}"
            )
        surfaces = tuple(_surface(i, row, scale, last=i == len(rows) - 1) for i, row in enumerate(rows))
        stops = sum(surface.is_stop for surface in surfaces)
        if stops != 1:
            raise ValueError(f"surfaces of the prescription must have one of kind 'stop', got {stops}")
        if surfaces[-1].is_stop:
            raise ValueError("the stop of the prescription must have a surface behind it, got it as the last one")
        if surfaces[-1].glass != "air":
            raise ValueError(
                f"the last surface of the prescription must have air behind it, got {surfaces[-1].glass!r}"
            )
        for i, surface in enumerate(surfaces):
            if surface.is_stop and i and surfaces[i - 1].glass != surface.glass:
                raise ValueError(
                    f"the stop of the prescription must have the medium before it behind it, got {surface.glass!r} "
                    f"behind {surfaces[i - 1].glass!r}"
                )
        length = sum(surface.gap for surface in surfaces)
        if length > LONGEST:
            raise ValueError(
                f"a prescription must be at most {LONGEST:g} m long, got {length:g} m: if its lengths are millimetres, "
                f"give it 'unit': 'mm'"
            )
        plane = given.get("image_plane_infinity")
        return cls(
            _text("name", given.get("name", "")),
            _text("source", given.get("source", "")),
            surfaces,
            _glasses(given.get("index", {}), surfaces),
            None if plane is None else _number("image_plane_infinity", plane) * scale,
        )


def half_diagonal(prescription: Mapping[str, Any]) -> float | None:
    """Return half the diagonal of the sensor that a prescription names, in metres."""
    _mapping("prescription", prescription)
    sensor, pitch = prescription.get("sensor"), prescription.get("pitch_um")
    if sensor is None or pitch is None:
        return None
    if not isinstance(sensor, Sequence) or len(sensor) != 2 or isinstance(sensor, str):
        raise TypeError(f"sensor of the prescription must be (rows, columns), got {sensor!r:.60}")
    for value in (*sensor, pitch):
        check_positive("sensor and pitch_um of the prescription", value)
    return 0.5e-6 * pitch * math.hypot(*sensor)


def _surface(i: int, row: Any, scale: float, *, last: bool) -> Surface:
    what = f"surface {i}"
    _mapping(what, row)
    for key in row:
        if key not in _SURFACE_KEYS:
            raise ValueError(f"{what} must have the keys {_words(_SURFACE_KEYS)}, got {key!r:.60}")
    kind = row.get("kind", "surface")
    check_choice(f"kind of {what}", kind, KINDS)
    radius, clear, powers = row.get("R"), row.get("r"), row.get("poly") or {}
    curvature = 0.0 if radius is None else 1 / (_number(f"R of {what}", radius, nonzero=True) * scale)
    gap = _number(f"t of {what}", row.get("t", 0.0 if last else None))
    if gap < 0:
        raise ValueError(f"t of {what} must not be negative, got {gap}")
    _mapping(f"poly of {what}", powers)
    terms = tuple(sorted(_term(what, power, value, scale) for power, value in powers.items()))
    if len({power for power, _ in terms}) < len(terms):
        raise ValueError(f"poly of {what} must have each power once, got {_words(map(str, powers))}")
    conic = _number(f"k of {what}", row.get("k", 0.0))
    if kind == "stop" and (curvature or conic or terms):
        raise ValueError(f"{what} is the stop and must be a plane, got R={radius}, k={conic:g}, poly={dict(terms)}")
    glass = row.get("glass", "air")
    if not isinstance(glass, str):
        raise TypeError(f"glass of {what} must be a name, got {described(glass)}")
    edge = math.inf
    if clear is not None:
        edge = _number(f"r of {what}", clear) * scale
        if not edge >= SMALLEST:
            raise ValueError(f"r of {what} must be at least {SMALLEST:g} m or None, got {clear} ({edge:.3g} m)")
    return Surface(curvature, conic, terms, gap * scale, glass, edge, kind == "stop")


def _term(what: str, power: Any, value: Any, scale: float) -> tuple[int, float]:
    if not (isinstance(power, int) or (isinstance(power, str) and power.isdecimal())) or isinstance(power, bool):
        raise TypeError(f"powers in poly of {what} must be whole numbers, got {power!r:.60}")
    if not 1 < int(power) <= HIGHEST_POWER:
        raise ValueError(
            f"powers in poly of {what} must be from 2 to {HIGHEST_POWER}, got {power:.20}"
            if isinstance(power, str)
            else f"powers in poly of {what} must be from 2 to {HIGHEST_POWER}, got {power}"
        )
    coefficient = _number(f"coefficient of power {int(power)} of {what}", value)
    return int(power), coefficient * scale ** (1 - int(power))


def _glasses(given: Any, surfaces: Sequence[Surface]) -> dict[str, Material]:
    _mapping("index of the prescription", given)
    found = {}
    for glass in dict.fromkeys(s.glass for s in surfaces if s.glass != "air"):
        if glass not in given:
            raise ValueError(
                f"index of the prescription must have the glass {glass!r:.60}, got {_words(map(str, given))}"
            )
        found[glass] = _material(glass, given[glass])
    return found


def _material(glass: str, given: Any) -> Material:
    what = f"index of {glass!r:.60}"
    if not isinstance(given, Mapping):
        return constant_index(_index(what, given))
    if len(given) == 1 and (form := next(iter(given))) in _FORMULAS:
        terms = given[form]
        if (
            not isinstance(terms, Sequence)
            or not terms
            or any(not isinstance(pair, Sequence) or isinstance(pair, str) or len(pair) != 2 for pair in terms)
        ):
            raise ValueError(f"{what} must have pairs of numbers under {form!r}, got {terms!r:.60}")
        pairs = tuple((_number(f"numbers in {what}", b), _number(f"numbers in {what}", c)) for b, c in terms)
        return Material(glass, "prescription", DISPERSIONS[_FORMULAS[form]], pairs)
    if set(given) == {"nd", "vd"}:
        nd, vd = _index(f"nd in {what}", given["nd"]), _number(f"vd in {what}", given["vd"], nonzero=True)
        blue, line, red = (wavelength * 1e6 for wavelength in _LINES)
        slope = (nd - 1) / vd / (blue**-2 - red**-2)
        return Material(glass, "prescription", DISPERSIONS["_power_series"], ((nd - slope / line**2, 0), (slope, -2)))
    pairs = tuple((_wavelength(what, key), _index(what, value)) for key, value in given.items())
    if not pairs:
        raise ValueError(f"{what} must be known at one wavelength or more, got none")
    if len(pairs) == 1:
        return Material(
            glass, "prescription", DISPERSIONS["_power_series"], ((pairs[0][1], 0),), (pairs[0][0], pairs[0][0])
        )
    return cauchy_through(glass, "prescription", pairs)


def _wavelength(what: str, key: Any) -> float:
    try:
        nanometres = float(key)
    except (TypeError, ValueError):
        nanometres = math.nan
    if not 100 <= nanometres <= 20000:
        raise ValueError(f"{what} must be given by wavelengths of 100 to 20000 nm, got {key!r:.60}")
    return nanometres * 1e-9


def _index(what: str, value: Any) -> float:
    number = _number(what, value)
    if not 1 < number < 5:
        raise ValueError(f"{what} must be above 1 and below 5, got {number}")
    return number


def _number(what: str, value: Any, *, nonzero: bool = False) -> float:
    if isinstance(value, bool):
        raise TypeError(f"{what} must be a number, got {value}")
    check_number(what, value)
    number = float(value)
    if not math.isfinite(number) or (nonzero and number == 0):
        raise ValueError(f"{what} must be finite{' and not 0' if nonzero else ''}, got {number}")
    return number


def _mapping(what: str, value: Any) -> None:
    if not isinstance(value, Mapping):
        raise TypeError(f"{what} must be a mapping, got {described(value)}")


def _text(what: str, value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{what} of the prescription must be a text, got {described(value)}")
    return value


def _words(names: Any) -> str:
    return ", ".join(sorted(names))[:200] or "none"
