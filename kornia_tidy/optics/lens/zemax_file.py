"""Zemax files (.zmx): surfaces of revolution in sequence, by the keywords of the text format."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from kornia_tidy.optics.lens.file_surfaces import AIR, FileLens, FileSurface, number
from kornia_tidy.optics.lens.glasses import catalogue_glass

UNITS = {"MM": 1.0, "CM": 10.0, "IN": 25.4, "INCH": 25.4, "METER": 1000.0, "M": 1000.0}
TYPES = ("STANDARD", "EVENASPH", "ODDASPHE")
MOST_TERMS = 8  # of an asphere
_ANGLES, _HEIGHTS = ("0",), ("2", "3")  # kinds of field: angles, and heights on the sensor
# Keywords of a surface that say how it is drawn, coated, made or found by the program, not what it is.
_WITHOUT_EFFECT = frozenset(
    "BLNK COAT COFN COMM EDGE FIMP HIDE MAZH MEMA MIRR OEMA PICK POPS PPAR PUSH PZUP SLAB VCON VDSZ VPAR".split()
)
_NUMBERS = {"CURV": "curvature", "CONI": "conic"}
_OF_SURFACES = frozenset("TYPE CURV CONI DISZ STOP PARM GLAS CLAP FLAP DIAM OBDC XDAT".split())
_MIRROR, _MODEL = "MIRROR", "1"


def read_zemax(text: str) -> FileLens:
    """Return the lens of a Zemax file.

    Args:
        text: of the file.

    Raises:
        ValueError: if it holds what is no surface of revolution between air and glass, or is damaged.

    Convention:
        - Of types of surfaces STANDARD, EVENASPH and ODDASPHE are read. Coordinate breaks, mirrors, apertures that are
          no discs about the axis and whatever else changes light are refused by name.
        - Light is cut at circular and floating apertures, and at diameters that the designer fixed; not at those that
          the program found.

    Source: ZEMAX Optical Design Program User's Guide (2011), chapters 4 to 7, for what the values mean.
    """
    header, blocks = _blocks(text)
    lens = FileLens(name=" ".join(header.get("NAME", [[]])[-1]))
    if (mode := _first(header, "MODE", "SEQ")) != "SEQ":
        raise ValueError(f"its MODE must be SEQ, for surfaces in sequence, got {mode!r:.60}")
    unit = _first(header, "UNIT", "MM")
    if unit not in UNITS:
        raise ValueError(f"its UNIT must be one of {', '.join(UNITS)}, got {unit!r:.60}")
    lens.unit = UNITS[unit]
    if len(blocks) < 3:
        raise ValueError(f"it must have an object, surfaces and a sensor, got {len(blocks)} of them")
    catalogues = header.get("GCAT", [[]])[-1]
    found = [_surface(i, block, lens.indices, catalogues) for i, block in enumerate(blocks)]
    first, sensor = found[0], found[-1]
    if first.glass != AIR:
        raise ValueError(f"the lens must stand in air, got {first.glass!r:.60} in front of it")
    if not sensor.plane:
        raise ValueError("its last surface is the sensor and must be a plane, got a curved one")
    lens.distance, lens.surfaces = first.gap, found[1:-1]
    if any(math.isinf(surface.gap) for surface in lens.surfaces):
        raise ValueError("distances between its surfaces must be finite, got INFINITY")
    lens.wavelength = _primary(header) or lens.wavelength
    kind = _first(header, "FTYP", "0")
    largest = _largest_field(header)
    lens.angle = largest if kind in _ANGLES else None
    lens.height = largest if kind in _HEIGHTS else None
    return lens


def _blocks(text: str) -> tuple[dict[str, list[list[str]]], list[list[list[str]]]]:
    """Return the words behind each keyword of the header, and the lines of each surface as words."""
    header: dict[str, list[list[str]]] = {}
    blocks: list[list[list[str]]] = []
    for line in text.splitlines():
        words = line.split()
        if not words:
            continue
        if words[0] == "SURF":
            blocks.append([])
        elif blocks and (line[0].isspace() or words[0] in _OF_SURFACES):
            blocks[-1].append(words)
        else:
            header.setdefault(words[0], []).append(words[1:])
    return header, blocks


def _first(header: dict[str, list[list[str]]], keyword: str, default: str) -> str:
    words = header.get(keyword, [[]])[-1]
    return words[0].upper() if words else default


def _primary(header: dict[str, list[list[str]]]) -> float | None:
    """Return the primary wavelength in metres."""
    wanted = _first(header, "PWAV", "1")
    for words in header.get("WAVM", []):
        if len(words) > 1 and words[0] == wanted:
            return 1e-6 * number("its primary wavelength", words[1])
    return None


def _largest_field(header: dict[str, list[list[str]]]) -> float | None:
    sides = []
    for keywords in (("XFLN", "XFLD"), ("YFLN", "YFLD")):
        words = next((header[keyword][-1] for keyword in keywords if keyword in header), [])
        sides.append(max((abs(number("fields", word)) for word in words), default=0.0))
    return math.hypot(*sides) or None


def _surface(i: int, block: Sequence[Sequence[str]], indices: dict[str, Any], catalogues: Sequence[str]) -> FileSurface:
    surface = FileSurface(f"surface {i}")
    kind, terms, edges, extra = "STANDARD", {}, {}, False
    for keyword, *words in block:
        if keyword in _NUMBERS:
            setattr(surface, _NUMBERS[keyword], number(f"{keyword} of {surface.where}", words[0] if words else ""))
        elif keyword == "TYPE":
            kind = words[0].upper() if words else ""
        elif keyword == "DISZ":
            infinite = bool(words) and words[0].upper() == "INFINITY"
            surface.gap = math.inf if infinite else number(f"DISZ of {surface.where}", words[0] if words else "")
        elif keyword == "STOP":
            surface.stop = True
        elif keyword == "PARM":
            term = number(f"PARM of {surface.where}", words[0] if words else "")
            terms[term] = number(f"PARM of {surface.where}", words[1] if len(words) > 1 else "")
        elif keyword == "GLAS":
            surface.glass = _glass(surface.where, words, indices, catalogues)
        elif keyword in ("CLAP", "FLAP", "DIAM"):
            edges[keyword] = _edge(surface.where, keyword, words)
        elif keyword == "OBDC":
            if any(number(f"OBDC of {surface.where}", word) for word in words[:2]):
                raise ValueError(
                    f"the aperture of {surface.where} must stand about the axis, got OBDC {' '.join(words):.60}"
                )
        elif keyword == "XDAT":
            extra = extra or any(number(f"XDAT of {surface.where}", word) for word in words[1:2])
        elif keyword not in _WITHOUT_EFFECT:
            raise ValueError(f"{surface.where} has {keyword!r:.60}, which is not read")
    if kind not in TYPES:
        raise ValueError(f"{surface.where} must be of type {', '.join(TYPES)}, got {kind!r:.60}")
    if extra:
        raise ValueError(f"{surface.where} has extra data (XDAT), which are not read")
    if kind != "STANDARD":
        step = 2 if kind == "EVENASPH" else 1
        if beyond := [term for term, value in terms.items() if value and term not in range(1, MOST_TERMS + 1)]:
            raise ValueError(f"PARM of {surface.where} must be from 1 to {MOST_TERMS}, got {beyond[0]:g}")
        surface.powers = {step * int(term): value for term, value in terms.items() if value}
    surface.clear = next((edges[keyword] for keyword in ("CLAP", "FLAP", "DIAM") if edges.get(keyword)), None)
    return surface


def _glass(where: str, words: Sequence[str], indices: dict[str, Any], catalogues: Sequence[str]) -> str:
    name = words[0] if words else ""
    if name.upper() == "AIR":
        return AIR
    if name.upper() == _MIRROR:
        raise ValueError(f"{where} is a mirror, and lenses of refracting surfaces alone are read")
    if len(words) > 4 and words[1] == _MODEL:
        nd, vd = number(f"index of {where}", words[3]), number(f"Abbe number of {where}", words[4])
        name = f"{nd:g}/{vd:g}"
        indices[name] = {"nd": nd, "vd": vd} if vd else nd
    elif name not in indices:
        try:
            indices[name] = catalogue_glass(name, catalogues)
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from None
    return name


def _edge(where: str, keyword: str, words: Sequence[str]) -> float | None:
    """Return the radius of an aperture, or None where light is not cut."""
    values = [number(f"{keyword} of {where}", word) for word in words[:2]]
    if keyword == "DIAM":  # found by the program unless a 1 follows
        return values[0] if values and (len(values) < 2 or values[1] == 1) else None
    if len(values) < 2 or values[0]:
        raise ValueError(f"the aperture of {where} must be a disc, got {keyword} {' '.join(words):.60}")
    return values[1]
