"""Lenses in JSON as Optiland and DeepLens save them, in millimetres."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

from kornia_tidy.checks import described
from kornia_tidy.optics.lens.file_surfaces import AIR, FileLens, FileSurface, number

_OPTILAND_SHAPES = {"Plane": 0, "StandardGeometry": 0, "EvenAsphere": 2, "OddAsphere": 1}  # step of the powers
_DEEPLENS_STOPS, _DEEPLENS_SHAPES = ("Stop", "Aperture"), ("Spheric", "Aspheric", "Plane")
_EMPTY = ("air", "vacuum", "occluder")
_UNITS = {"nm": 1e-9, "um": 1e-6, "mm": 1e-3, "m": 1.0}
_HEIGHTS, _ANGLES = ("ParaxialImageHeightField", "RealImageHeightField"), ("AngleField",)


def read_json_lens(value: Any) -> FileLens | None:
    """Return the lens of a JSON file by Optiland or DeepLens, or None for one of neither.

    Args:
        value: of the file.

    Raises:
        ValueError: if it holds other things than surfaces of revolution between air and glass, or is damaged.
        TypeError: if a value is of another type.
    """
    if not isinstance(value, Mapping):
        return None
    if "surface_group" in value:
        return _optiland(value)
    surfaces = value.get("surfaces")
    if isinstance(surfaces, Sequence) and surfaces and isinstance(surfaces[0], Mapping) and "type" in surfaces[0]:
        return _deeplens(value, surfaces)
    return None


# ---------------------------------------------------------------------------------------------------- Optiland


def _optiland(value: Mapping[str, Any]) -> FileLens:
    rows = _part("surface_group", value["surface_group"], "surfaces", list)
    lens = FileLens(str(value.get("name") or ""))
    lens.wavelength, (lens.height, lens.angle) = _optiland_wavelength(value), _optiland_field(value)
    surfaces = [_optiland_surface(i, row, lens) for i, row in enumerate(rows)]
    places = [_place(i, row) for i, row in enumerate(rows)]
    for i, surface in enumerate(surfaces[:-1]):
        surface.gap = places[i + 1] - places[i]
    lens.take(surfaces)
    return lens


def _optiland_surface(i: int, row: Any, lens: FileLens) -> FileSurface:
    where = f"surface {i}"
    shape = _part(where, row, "geometry", Mapping)
    kind = shape.get("type")
    if kind not in _OPTILAND_SHAPES:
        raise ValueError(f"{where} must be one of {', '.join(_OPTILAND_SHAPES)}, got {kind!r:.60}")
    surface = FileSurface(where, stop=row.get("is_stop") is True)
    if kind != "Plane":
        radius = shape.get("radius")
        infinite = isinstance(radius, float) and math.isinf(radius)
        surface.curvature = 0.0 if infinite else _inverse(f"radius of {where}", radius)
        surface.conic = number(f"conic of {where}", shape.get("conic", 0.0))
    if step := _OPTILAND_SHAPES[kind]:
        terms = _part(f"geometry of {where}", shape, "coefficients", list)
        surface.powers = {step * (j + 1): number(f"coefficients of {where}", term) for j, term in enumerate(terms)}
    acts = row.get("interaction_model") or {}
    if not isinstance(acts, Mapping) or acts.get("is_reflective") or row.get("is_reflective"):
        raise ValueError(f"{where} is a mirror, and only lenses of refracting surfaces are read")
    if (acted := acts.get("type", "RefractiveReflectiveModel")) != "RefractiveReflectiveModel":
        raise ValueError(f"{where} must refract, got {acted!r:.60}")
    edge = row.get("aperture")
    if edge is not None:
        if not isinstance(edge, Mapping) or edge.get("type") != "RadialAperture" or edge.get("r_min"):
            raise ValueError(f"the aperture of {where} must be a disc about the axis, got {edge!r:.60}")
        surface.clear = number(f"r_max of {where}", edge.get("r_max"))
    surface.glass = _optiland_glass(where, _part(where, row, "material_post", Mapping), lens)
    return surface


def _optiland_glass(where: str, given: Mapping[str, Any], lens: FileLens) -> str:
    kind = given.get("type")
    if kind == "IdealMaterial":
        index = number(f"index of {where}", given.get("index"))
        if index == 1:
            return AIR
        return _added(lens, f"{index:g}", index)
    if kind == "AbbeMaterial":
        nd, vd = (number(f"{name} of {where}", given.get(name)) for name in ("index", "abbe"))
        return _added(lens, f"{nd:g}/{vd:g}", {"nd": nd, "vd": vd})
    if kind == "Material" and isinstance(given.get("name"), str):
        maker = given.get("reference") or given.get("catalog")
        return lens.glass(where, given["name"], [maker] if isinstance(maker, str) else ())
    if kind == "Mirror":
        raise ValueError(f"{where} is a mirror, and only lenses of refracting surfaces are read")
    raise ValueError(f"the glass of {where} must be Material, AbbeMaterial or IdealMaterial, got {kind!r:.60}")


def _place(i: int, row: Mapping[str, Any]) -> float:
    """Return where the vertex of a surface lies on the axis; objects at infinity at minus infinity."""
    frame = _part(f"geometry of surface {i}", row["geometry"], "cs", Mapping)
    for name in ("x", "y", "rx", "ry", "rz"):
        if (value := number(f"{name} of surface {i}", frame.get(name, 0.0))) and (name != "rz" or abs(value) > 1e-9):
            raise ValueError(f"surface {i} must stand on the axis, upright, got {name}={value:g}")
    if frame.get("reference_cs") is not None:
        raise ValueError(f"surface {i} must stand on the axis, got one in the frame of another")
    z = frame.get("z")
    return -math.inf if i == 0 and z == -math.inf else number(f"z of surface {i}", z)


def _optiland_wavelength(value: Mapping[str, Any]) -> float:
    rows = _part("wavelengths", value.get("wavelengths") or {"wavelengths": []}, "wavelengths", list)
    for row in rows:
        if isinstance(row, Mapping) and row.get("is_primary"):
            return number("its primary wavelength", row.get("value")) * _UNITS.get(str(row.get("unit", "um")), math.nan)
    return FileLens().wavelength


def _optiland_field(value: Mapping[str, Any]) -> tuple[float | None, float | None]:
    """Return the largest height on the sensor and the largest angle, as far as the file says one."""
    fields = value.get("fields")
    if not isinstance(fields, Mapping):
        return None, None
    definition = fields.get("field_definition")
    kind = definition.get("field_type") if isinstance(definition, Mapping) else None
    rows = [row for row in fields.get("fields") or [] if isinstance(row, Mapping)]
    sizes = [math.hypot(*(number("its fields", row.get(axis, 0.0)) for axis in ("x", "y"))) for row in rows]
    largest = max(sizes, default=0.0) or None
    return largest if kind in _HEIGHTS else None, largest if kind in _ANGLES else None


# ---------------------------------------------------------------------------------------------------- DeepLens


def _deeplens(value: Mapping[str, Any], rows: Sequence[Any]) -> FileLens:
    lens = FileLens(str(value.get("info") or ""))
    if value.get("r_sensor") is not None:
        lens.height = number("r_sensor", value["r_sensor"])
    lens.surfaces = [_deeplens_surface(i, row, lens) for i, row in enumerate(rows)]
    if lens.surfaces[-1].gap == 0:
        raise ValueError(f"d_next of {lens.surfaces[-1].where} must be the distance to the sensor, got 0")
    return lens


def _deeplens_surface(i: int, row: Any, lens: FileLens) -> FileSurface:
    where = f"surface {i}"
    if not isinstance(row, Mapping):
        raise TypeError(f"{where} must be a mapping, got {described(row)}")
    kind = row.get("type")
    if kind not in (*_DEEPLENS_STOPS, *_DEEPLENS_SHAPES):
        allowed = ", ".join((*_DEEPLENS_STOPS, *_DEEPLENS_SHAPES))
        raise ValueError(f"type of {where} must be one of {allowed}, got {kind!r:.60}")
    surface = FileSurface(where, gap=number(f"d_next of {where}", row.get("d_next")))
    surface.glass = _deeplens_glass(where, row.get("mat2"), lens)
    if kind in _DEEPLENS_STOPS:
        surface.stop = True
        return surface
    surface.clear = number(f"r of {where}", row.get("r"))
    if row.get("is_square") is True:
        raise ValueError(f"the aperture of {where} must be a disc, got a square")
    if kind == "Plane":
        return surface
    radius = row.get("roc")
    if radius is None:
        surface.curvature = number(f"c of {where}", row.get("c"))
    elif not (isinstance(radius, float) and math.isinf(radius)):
        surface.curvature = _inverse(f"roc of {where}", radius)
    if kind == "Aspheric":
        surface.conic = number(f"k of {where}", row.get("k", 0.0))
        terms = row.get("ai") or []
        if not isinstance(terms, list):
            raise TypeError(f"ai of {where} must be a list, got {described(terms)}")
        first = 4 if row.get("use_ai2") is False else 2
        surface.powers = {first + 2 * j: number(f"ai of {where}", term) for j, term in enumerate(terms)}
    return surface


def _deeplens_glass(where: str, name: Any, lens: FileLens) -> str:
    if not isinstance(name, str):
        raise TypeError(f"mat2 of {where} must be a name, got {described(name)}")
    if name.lower() in _EMPTY:
        return AIR
    if pair := re.fullmatch(r"(\d\.\d+)/(\d+\.?\d*)", name):
        return _added(lens, name, {"nd": float(pair[1]), "vd": float(pair[2])})
    return lens.glass(where, name)


# ---------------------------------------------------------------------------------------------------- both


def _part(where: str, owner: Any, key: str, kind: Any) -> Any:
    """Return an entry of a mapping, or raise an error if it is not of a kind."""
    if not isinstance(owner, Mapping):
        raise TypeError(f"{where} must be a mapping, got {described(owner)}")
    value = owner.get(key)
    if not isinstance(value, kind):
        raise TypeError(f"{key} of {where} must be a {'list' if kind is list else 'mapping'}, got {described(value)}")
    return value


def _inverse(what: str, value: Any) -> float:
    radius = number(what, value)
    return 1 / radius if radius else 0.0


def _added(lens: FileLens, label: str, index: Any) -> str:
    lens.indices[label] = index
    return label
