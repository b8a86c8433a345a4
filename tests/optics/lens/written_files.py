"""Prescriptions in millimetres as files of optical programs, written here from what their formats say."""

from __future__ import annotations

import copy
import json
import math
from typing import Any

from kornia_tidy.optics.lens import NAMED_LENSES, Prescription
from kornia_tidy.optics.lens.first_order import first_order

D_LINE = 587.5618e-9


def aspheric() -> dict[str, Any]:
    """A plastic element with even aspheres behind a stop, by its index and Abbe's number."""
    return {
        "name": "aspheric",
        "unit": "mm",
        "surfaces": [
            {"kind": "stop", "t": 0.6},
            {"R": 9.2, "k": -0.7, "poly": {4: -2e-5, 6: 3e-7}, "t": 3.1, "glass": "1.531/55.8", "r": 5.0},
            {"R": -14.5, "k": 1.3, "poly": {2: 1e-4, 4: 1.2e-4, 8: -2e-9}, "t": 0.0, "r": 5.0},
        ],
        "index": {"1.531/55.8": {"nd": 1.531, "vd": 55.8}},
    }


def doublet() -> dict[str, Any]:
    """A cemented achromat of catalogue glasses behind a stop."""
    return {
        "name": "doublet",
        "unit": "mm",
        "surfaces": [
            {"kind": "stop", "t": 2.0},
            {"R": 61.47, "t": 6.0, "glass": "N-BK7", "r": 12.0},
            {"R": -44.64, "t": 2.5, "glass": "N-SF5", "r": 12.0},
            {"R": -129.94, "t": 0.0, "r": 12.0},
        ],
        "index": {
            "N-BK7": {
                "sellmeier": [(1.03961212, 0.00600069867), (0.231792344, 0.0200179144), (1.01046945, 103.560653)]
            },
            "N-SF5": {"sellmeier": [(1.52481889, 0.011254756), (0.187085527, 0.0588995392), (1.42729015, 129.141675)]},
        },
    }


def named(name: str) -> dict[str, Any]:
    return copy.deepcopy(NAMED_LENSES[name]["prescription"])


WRITTEN = {
    "double-gauss": lambda: named("double-gauss-50mm"),
    "triplet": lambda: named("triplet-50mm"),
    "single": lambda: named("single-50mm"),
    "aspheric": aspheric,
    "doublet": doublet,
}


def back_focus(prescription: dict[str, Any], wavelength: float = D_LINE) -> float:
    """Millimetres from the last surface to the paraxial focus of a star."""
    optics = first_order(Prescription.read(prescription), 8.0, math.inf, wavelength)
    return 1e3 * (optics.sensor_z - float(optics.vertices[-1]))


def zemax(prescription: dict[str, Any], unit: str = "MM", shift: float = 0.0) -> str:
    """A .zmx file of spheres and even aspheres, focused at infinity in the d line, and ``shift`` mm beyond."""
    size = {"MM": 1.0, "CM": 0.1, "IN": 1 / 25.4, "METER": 1e-3}[unit]
    lines = [
        "VERS 140730 73 26155", "MODE SEQ", f"NAME {prescription['name']}", f"UNIT {unit} X W X CM MR CPMM",
        "FNUM 8.0 0", "GCAT SCHOTT MISC", "FTYP 0 0 3 3 0 0 0", "XFLN 0 0 0", "YFLN 0 3.0 6.0",
        "WAVM 1 0.4861327 1", "WAVM 2 0.5875618 1", "WAVM 3 0.6562725 1", "PWAV 2",
        "SURF 0", "  TYPE STANDARD", "  CURV 0.0 0 0 0 0 \"\"", "  DISZ INFINITY", "  DIAM 0 0 0 0 1 \"\"",
    ]  # fmt: skip
    rows = prescription["surfaces"]
    for i, row in enumerate(rows):
        gap = back_focus(prescription) + shift if i == len(rows) - 1 else row["t"]
        powers = row.get("poly") or {}
        lines += [f"SURF {i + 1}"] + ["  STOP"] * (row.get("kind") == "stop")
        lines += [f"  TYPE {'EVENASPH' if powers else 'STANDARD'}"]
        lines += [f'  CURV {1 / (row["R"] * size) if row.get("R") else 0.0!r} 0 0 0 0 ""', "  HIDE 0 0 0"]
        lines += [f"  CONI {row['k']!r}"] if row.get("k") else []
        lines += [f"  PARM {power // 2} {value * size ** (1 - power)!r}" for power, value in powers.items()]
        lines += [f"  DISZ {gap * size!r}"]
        if (glass := row.get("glass", "air")) != "air":
            index = prescription["index"][glass]
            model = f"___BLANK 1 0 {index['nd']} {index['vd']} 0 0 0 0 0 0" if "nd" in index else f"{glass} 0 0 1.5 40"
            lines += [f"  GLAS {model}"]
        lines += [f'  DIAM {row["r"] * size!r} 1 0 0 1 ""'] if row.get("r") else ['  DIAM 3.0 0 0 0 1 ""']
    lines += [f"SURF {len(rows) + 1}", "  TYPE STANDARD", '  CURV 0.0 0 0 0 0 ""', "  DISZ 0", "TOL TOFF 0 0"]
    return "\r\n".join(lines) + "\r\n"


def codev(prescription: dict[str, Any], unit: str = "M", *, radii: bool = True) -> str:
    """A .seq file of spheres and even aspheres, focused at infinity in the d line."""
    size = {"M": 1.0, "C": 0.1, "I": 1 / 25.4}[unit]
    lines = [
        f"RDM{'' if radii else ' N'};LEN   \"VERSION: 11.2\"", f"TITLE '{prescription['name']}'", "EPD 5.0",
        f"DIM {unit}", "WL 656.2725 587.5618 486.1327", "REF 2", "YAN 0.0 3.0 6.0", "DOR 1.15 1.05",
        "SO 0.0 0.1e14 ! a star",
    ]  # fmt: skip
    rows = prescription["surfaces"]
    for i, row in enumerate(rows):
        gap = back_focus(prescription) if i == len(rows) - 1 else row["t"]
        radius = (row.get("R") or 0.0) * size
        shape = radius if radii or not radius else 1 / radius
        glass = row.get("glass", "air")
        index = {} if glass == "air" else prescription["index"][glass]
        if "nd" in index:
            digits = f"{index['nd'] - 1:.6f}"[2:]
            code = f"{digits}.{round(index['vd'] * 1e4)}"
        else:
            code = "" if glass == "air" else f"{glass.replace('-', '')}" + ("" if glass == "PMMA" else "_SCHOTT")
        lines += [f"S {shape!r} {gap * size!r} {code}", "  CCY 0; THC 0; GLC 0"]
        lines += ["  STO"] * (row.get("kind") == "stop")
        lines += [f"  CIR {row['r'] * size!r}"] if row.get("r") else []
        if row.get("poly") or row.get("k"):
            lines += ["  ASP", f"  K {row.get('k', 0.0)!r}"]
            letters = {power: letter for letter, power in zip("ABCD", (4, 6, 8, 10), strict=True)}
            terms = [f"{letters[power]} {value * size ** (1 - power)!r}" for power, value in row["poly"].items()]
            lines += ["  " + "; ".join(terms)]
    return "\n".join([*lines, "SI 0.0 0.0", "GO"])


def optiland(prescription: dict[str, Any]) -> str:
    """Optiland's JSON of spheres and even aspheres, focused at infinity in the d line."""

    def entry(kind: str, radius: float, place: float, glass: dict[str, Any], **more: Any) -> dict[str, Any]:
        frame = {"x": 0.0, "y": 0.0, "z": place, "rx": 0.0, "ry": 0.0, "rz": 0.0, "reference_cs": None}
        geometry = {"type": kind, "cs": frame, "radius": radius} | more.pop("shape", {})
        acts = {"type": "RefractiveReflectiveModel", "is_reflective": False, "coating": None, "bsdf": None}
        parts = {"geometry": geometry, "material_post": glass, "interaction_model": acts}
        return {"type": "Surface", "is_stop": False, "aperture": None} | parts | more

    air = {"type": "IdealMaterial", "index": 1.0, "absorp": 0.0}
    surfaces, place = [entry("Plane", math.inf, -math.inf, air)], 0.0
    for row in prescription["surfaces"]:
        name, powers = row.get("glass", "air"), row.get("poly") or {}
        index = {} if name == "air" else prescription["index"][name]
        glass = air if name == "air" else {"type": "Material", "name": name, "reference": None}
        if "nd" in index:
            glass = {"type": "AbbeMaterial", "index": index["nd"], "abbe": index["vd"], "model": "buchdahl"}
        shape: dict[str, Any] = {"conic": row.get("k", 0.0)}
        kind = "Plane" if not row.get("R") else "EvenAsphere" if powers else "StandardGeometry"
        if powers:
            shape["coefficients"] = [powers.get(power, 0.0) for power in range(2, 12, 2)]
        edge = {"type": "RadialAperture", "r_max": row["r"], "r_min": 0} if row.get("r") else None
        stop = row.get("kind") == "stop"
        surfaces.append(entry(kind, row.get("R") or math.inf, place, glass, shape=shape, is_stop=stop, aperture=edge))
        place += row["t"]
    surfaces.append(entry("Plane", math.inf, place + back_focus(prescription), air))
    wavelengths = [{"value": 0.5875618, "is_primary": True, "unit": "um"}]
    fields = {"fields": [{"x": 0.0, "y": 6.0}], "field_definition": {"field_type": "AngleField"}}
    value = {"version": 1.0, "name": prescription["name"], "aperture": {"type": "EPD", "value": 5.0}, "fields": fields}
    more = {"wavelengths": {"wavelengths": wavelengths}, "pickups": [], "solves": {"solves": []}}
    return json.dumps(value | more | {"surface_group": {"surfaces": surfaces}})


def deeplens(prescription: dict[str, Any]) -> str:
    """DeepLens' JSON of spheres and even aspheres, focused at infinity at 530 nm."""
    surfaces = []
    rows = prescription["surfaces"]
    for i, row in enumerate(rows):
        powers, name = row.get("poly") or {}, row.get("glass", "air")
        index = {} if name == "air" else prescription["index"][name]
        last = i == len(rows) - 1
        entry = {
            "type": "Aperture" if row.get("kind") == "stop" else "Aspheric" if powers else "Spheric",
            "r": row.get("r") or 20.0,
            "roc": row.get("R") or math.inf,
            "mat2": f"{index['nd']}/{index['vd']}" if "nd" in index else name.lower(),
            "d_next": back_focus(prescription, 530e-9) if last else row["t"],
        }
        if powers:
            terms = [powers.get(power, 0.0) for power in range(2, 12, 2)]
            entry |= {"k": row["k"], "ai": terms if 2 in powers else terms[1:], "use_ai2": 2 in powers}
        surfaces.append(entry)
    return json.dumps({"info": prescription["name"], "r_sensor": 5.0, "surfaces": surfaces})


WRITERS = {".zmx": zemax, ".seq": codev, ".optiland.json": optiland, ".deeplens.json": deeplens}
